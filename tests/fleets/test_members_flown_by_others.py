"""Members that a pilot or another ground station flies: the fleet monitors them and sends no orders."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable

import anyio
import pytest
from fleet_stage import Stage, open_stage

from aerokit.errors import AerokitError, OperationRejected
from aerokit.fleets.events import MemberTakenOver
from aerokit.fleets.members import Member, MemberState
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.missions import Mission, land, take_off
from aerokit.protocols.command import command_long

pytestmark = pytest.mark.anyio

PILOTS, OURS = "north/2", "north/1"
STATION = FrameEncoder(200, 190)


async def fly_by_another_station(stage: Stage, name: str) -> None:
    """Arm and take off from another ground station, then fly in LOITER."""
    copter, wire = stage.copters[name], stage.wires["north"]
    for command, params in (
        (MavCmd.DO_SET_MODE, (1.0, float(CopterMode.GUIDED))),
        (MavCmd.COMPONENT_ARM_DISARM, (1.0,)),
        (MavCmd.NAV_TAKEOFF, (*(0.0,) * 6, 10.0)),
    ):
        wire._link.write(STATION.encode(command_long(copter.system_id, 1, command, params)))
        await anyio.sleep(1.5)
    await anyio.sleep(10.0)
    stage.pilot_takes(name)
    await anyio.sleep(2.0)


async def barrier_fails(stage: Stage) -> None:
    await stage.fleet.barrier(lambda member: member.name == PILOTS, timeout=3)


async def barrier_is_cancelled(stage: Stage) -> None:
    with anyio.move_on_after(2.0):
        await stage.fleet.barrier(lambda member: member.name == PILOTS, timeout=30)


async def upload_fails(stage: Stage) -> None:
    stage.copters[OURS].faults.silent = True
    mission = Mission([take_off(altitude_relative_m=10), land()])
    await stage.fleet.upload({OURS: mission, PILOTS: mission})


async def reading_fails(stage: Stage) -> None:
    await stage.fleet.do(lambda member: member.vehicle.parameters.get("NO_SUCH" if member.name == OURS else "RTL_ALT"))


async def arming_fails(stage: Stage) -> None:
    stage.copters[OURS].faults.refuse(MavCmd.COMPONENT_ARM_DISARM, 4)
    await stage.fleet.arm()


@pytest.mark.sampled(8)
@pytest.mark.parametrize("fail", [barrier_fails, barrier_is_cancelled, upload_fails, reading_fails, arming_fails])
@pytest.mark.parametrize("policy", ["hold_others", "land_others", "return_others"])
async def test_pilots_member_gets_no_orders_from_policies(
    policy: str, fail: Callable[[Stage], Awaitable[None]]
) -> None:
    async with open_stage(2, spacing_m=30.0, on_error=policy) as stage:
        await stage.fleet.wait_ready()
        await fly_by_another_station(stage, PILOTS)
        assert stage.fleet.members[PILOTS].state is MemberState.TAKEN_OVER
        stage.clear()
        with contextlib.suppress(AerokitError):
            await fail(stage)
        await anyio.sleep(4.0)
        assert stage.orders_to(PILOTS) == []
        assert stage.mode_of(PILOTS) == "LOITER"


async def test_pilots_member_gets_no_orders_from_distance_monitor() -> None:
    async with open_stage(2, spacing_m=3.0, min_distance_m=10.0) as stage:
        await stage.fleet.wait_ready()
        await fly_by_another_station(stage, PILOTS)
        stage.clear()
        ours = stage.fleet.vehicles[OURS]
        await ours.set_mode("GUIDED")
        await ours.arm()
        with anyio.move_on_after(20.0):
            with contextlib.suppress(AerokitError):
                await ours.take_off(10.0)
        assert stage.orders_to(PILOTS) == []
        assert "BRAKE" in stage.modes_ordered(OURS)


async def test_member_armed_elsewhere_accepts_orders_after_reclaim() -> None:
    async with open_stage(2, spacing_m=30.0) as stage:
        await stage.fleet.wait_ready()
        await fly_by_another_station(stage, PILOTS)
        member = stage.fleet.members[PILOTS]
        assert member.reason == "this program did not arm it"
        member.reclaim()
        assert member.state is MemberState.ACTIVE
        assert not member.is_flown_by_program
        await barrier_is_cancelled(stage)
        assert stage.mode_of(PILOTS) == "LOITER"
        await member.vehicle.hold()
        assert member.is_flown_by_program


async def test_member_armed_elsewhere_again_after_reclaim_is_taken_over() -> None:
    """The pilot has landed and disarmed, the program reclaims the vehicle, and the pilot arms in the same mode."""
    async with open_stage(2, spacing_m=30.0) as stage:
        await stage.fleet.wait_ready()
        copter, wire, member = stage.copters[PILOTS], stage.wires["north"], stage.fleet.members[PILOTS]
        copter.set_mode(CopterMode.GUIDED)

        async def arm_elsewhere(armed: float) -> None:
            wire._link.write(STATION.encode(command_long(2, 1, MavCmd.COMPONENT_ARM_DISARM, (armed,))))
            await anyio.sleep(3)

        await arm_elsewhere(1.0)
        assert member.state is MemberState.TAKEN_OVER
        await arm_elsewhere(0.0)
        stage.fleet.reclaim(PILOTS)
        await anyio.sleep(3)
        await arm_elsewhere(1.0)
        assert copter.is_armed
        assert member.state is MemberState.TAKEN_OVER
        assert (await stage.fleet.set_mode("GUIDED")).skipped == {PILOTS: "taken over: this program did not arm it"}


async def test_disarmed_member_gets_no_orders_from_policy() -> None:
    """Two members fly, one is disarmed on the ground; one of the flying ones fails."""
    async with open_stage(3, on_error="land_others") as stage:
        await stage.take_off()
        await stage.fleet.vehicles["north/3"].land()
        await stage.fleet.vehicles["north/3"].armed.wait_until(lambda armed: not armed, timeout=30)
        stage.clear()

        async def fail_first(member: Member) -> None:
            if member.name == "north/1":
                raise OperationRejected("it does not")
            await anyio.sleep(30.0)

        await stage.fleet.do(fail_first)
        await anyio.sleep(3.0)
        assert stage.orders_to("north/3") == []
        assert stage.modes_ordered("north/2") == ["LAND"]


async def test_members_armed_by_cancelled_arming_are_not_taken_over() -> None:
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        with anyio.move_on_after(0):  # The commands are sent, but not acknowledged yet.
            await stage.fleet.arm()
        await anyio.sleep(5)
        assert not stage.events(MemberTakenOver)
        assert not any(copter.is_armed for copter in stage.copters.values())
        assert (await stage.fleet.arm()).is_complete


async def test_member_in_posted_mode_after_arming_is_not_taken_over() -> None:
    async with open_stage(1) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        vehicle = stage.fleet.vehicles[OURS]
        mode = vehicle.autopilot.find_mode("ALT_HOLD")
        with vehicle.posted("mode", modes=(mode,)) as posted:
            await posted.set_mode(mode)
        await anyio.sleep(2)
        assert not stage.events(MemberTakenOver)
