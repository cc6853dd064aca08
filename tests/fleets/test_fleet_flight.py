"""Fleet actions, lost members and policies with simulated copters on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import anyio
import pytest
from fleet_stage import open_stage
from flight_harness import now

from aerokit.errors import FleetError, InvalidArgument, OperationTimeout
from aerokit.fleets.events import (
    MemberBack,
    MemberFailed,
    MemberLost,
    MemberReclaimed,
    MemberTakenOver,
    PolicyApplied,
    PolicyCompleted,
)
from aerokit.fleets.members import Member, MemberState
from aerokit.fleets.policy import MemberFailure, PolicyName, PolicyOrder
from aerokit.mavlink.enums import MavCmd, MavState
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.position import Position

pytestmark = pytest.mark.anyio


def north(by_m: float) -> Any:
    def target(member: Member) -> Position:
        return member.vehicle.position.value.offset(north_m=by_m)

    return target


@pytest.mark.exhaustive
async def test_ten_members_land_by_policy_after_one_is_lost() -> None:
    async with open_stage(10, on_error="land_others") as stage:
        fleet = stage.fleet
        (await fleet.wait_ready()).raise_for_errors()
        (await fleet.arm()).raise_for_errors()
        result = await fleet.take_off(10, stagger_s=0.5)
        assert len(result) == 10
        assert result.is_complete
        await fleet.wait_at_altitude(10)
        stage.clear()
        stage.copters["north/4"].faults.silent = True
        result = await fleet.go_to(north(300))
        assert list(result.failed) == ["north/4"]
        assert len(result.stopped) == 9
        others = [name for name in stage.copters if name != "north/4"]
        assert all(not stage.copters[name].is_armed or stage.copters[name].motion.is_on_ground for name in others)
        assert all(stage.modes_ordered(name) == ["LAND"] for name in others)  # once, without a hold before
        assert stage.modes_ordered("north/4") == []
        (lost,) = [member for member in fleet if member.state is MemberState.LOST]
        assert lost.name == "north/4"
        received = stage.events()
        assert [type(event) for event in received] == [
            MemberLost,
            MemberFailed,
            PolicyApplied,
            PolicyCompleted,
        ]
        assert received[2].orders == dict.fromkeys(others, "land")
        with pytest.raises(FleetError, match="0 of 10 members succeeded") as caught:
            result.raise_for_errors()
        assert set(caught.value.errors) == set(stage.copters)


async def test_lost_member_returns_and_is_available_again() -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        stage.copters["north/2"].faults.silent = True
        await anyio.sleep(6)
        assert stage.fleet.members["north/2"].state is MemberState.LOST
        result = await stage.fleet.hold()
        assert list(result) == ["north/1"]
        assert "no heartbeat" in result.skipped["north/2"]
        stage.copters["north/2"].faults.silent = False
        await anyio.sleep(2)
        assert [type(event) for event in stage.events()] == [MemberLost, MemberBack]
        assert list(await stage.fleet.land()) == ["north/1", "north/2"]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("policy", "mode"), [("hold_others", "BRAKE"), ("return_others", "RTL"), ("land_others", "LAND")]
)
async def test_policy_orders_each_other_member_once(policy: str, mode: str) -> None:
    async with open_stage(3, on_error=policy) as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        result = await stage.fleet.go_to(north(100))
        await anyio.sleep(5)
        assert list(result.failed) == ["north/1"]
        assert stage.modes_ordered("north/2") == stage.modes_ordered("north/3") == [mode]
        assert stage.modes_ordered("north/1") == []
        assert f"the policy ordered north/2 to {policy.partition('_')[0]}" in str(result.stopped["north/2"])


async def test_policy_orders_members_that_have_finished() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        near, far = (stage.fleet.vehicles[name].position.value for name in ("north/1", "north/2"))
        targets = {"north/1": near.offset(north_m=3), "north/2": far.offset(north_m=300)}

        async def fail() -> None:
            await anyio.sleep(20)
            stage.copters["north/2"].faults.silent = True

        failing = asyncio.create_task(fail())
        result = await stage.fleet.go_to(targets)
        await failing
        assert stage.mode_of("north/1") == "BRAKE"
        assert list(result.stopped) == ["north/1"]


async def test_policy_continue_others_does_not_stop_them() -> None:
    async with open_stage(3, on_error="continue_others") as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        result = await stage.fleet.go_to(north(30))
        assert list(result.failed) == ["north/1"]
        assert not result.stopped
        assert result["north/2"] is None
        assert not stage.events(PolicyApplied)
        assert stage.fleet.members["north/1"].state is MemberState.FAILED
        stage.copters["north/1"].faults.commands.clear()
        assert (await stage.fleet.go_to(north(5))).is_complete
        assert [member.state for member in stage.fleet] == [MemberState.ACTIVE] * 3


async def test_policy_of_failed_members_group_applies() -> None:
    async with open_stage(
        3,
        groups={"camera": ["north/1"], "show": ["north/[23]"]},
        on_error_by_group={"camera": "continue_others"},
    ) as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        result = await stage.fleet.go_to(north(10))
        assert (list(result.failed), list(result.stopped)) == (["north/1"], [])
        stage.copters["north/1"].faults.commands.clear()
        stage.copters["north/3"].faults.refuse(MavCmd.DO_REPOSITION)
        result = await stage.fleet.go_to(north(100))
        assert (list(result.failed), list(result.stopped)) == (["north/3"], ["north/1", "north/2"])
        assert list(stage.fleet.group("show").members) == ["north/2", "north/3"]


@pytest.mark.exhaustive
async def test_policy_function_decides_per_member() -> None:
    failures: list[MemberFailure] = []

    def decide(failure: MemberFailure) -> Mapping[str, PolicyOrder]:
        failures.append(failure)
        return {"north/2": "land"}

    async with open_stage(3, on_error=decide) as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        result = await stage.fleet.go_to(north(20))
        assert [(failure.member, failure.action, failure.others) for failure in failures] == [
            ("north/1", "go_to", ("north/2", "north/3"))
        ]
        assert stage.modes_ordered("north/2") == ["LAND"]
        assert result["north/3"] is None
        assert stage.copters["north/2"].motion.is_on_ground


async def test_policy_function_with_invalid_result_makes_others_hold() -> None:
    def decide(failure: MemberFailure) -> PolicyName:
        return "explode"  # type: ignore[return-value]

    async with open_stage(2, on_error=decide) as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        with pytest.raises(InvalidArgument, match="the policy function returned 'explode'"):
            await stage.fleet.go_to(north(100))
        assert stage.mode_of("north/2") == "BRAKE"


async def test_cancellation_holds_all_members_at_once() -> None:
    async with open_stage(5) as stage:
        await stage.take_off()
        started = now()
        with anyio.move_on_after(3):
            await stage.fleet.go_to(north(300))
        assert now() - started == pytest.approx(3.0, abs=0.01)
        await anyio.sleep(5)
        times = {name: stage.orders_to(name)[-1][0] for name in stage.copters}
        assert set(stage.modes.values()) == {"BRAKE"}
        assert all(stage.modes_ordered(name) == ["BRAKE"] for name in stage.copters)
        assert max(times.values()) - min(times.values()) < 0.001


async def test_cancellation_holds_members_that_have_arrived() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        here = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        with anyio.move_on_after(15):
            await stage.fleet.go_to(
                {"north/1": here["north/1"].offset(north_m=5), "north/2": here["north/2"].offset(north_m=300)}
            )
        await anyio.sleep(3)
        assert stage.modes == {"north/1": "BRAKE", "north/2": "BRAKE"}


async def test_cancelled_landing_continues() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        with anyio.move_on_after(2):
            await stage.fleet.land()
        await anyio.sleep(3)
        assert set(stage.modes.values()) == {"LAND"}


async def test_member_taken_over_by_pilot_is_skipped_until_reclaimed() -> None:
    async with open_stage(3, on_error="continue_others") as stage:
        await stage.take_off()
        stage.pilot_takes("north/2")
        await anyio.sleep(2)
        member = stage.fleet.members["north/2"]
        assert (member.state, member.reason) == (MemberState.TAKEN_OVER, "the mode changed to LOITER")
        stage.clear()
        for order in (stage.fleet.go_to(north(10)), stage.fleet.hold(), stage.fleet.set_mode("GUIDED")):
            result = await order
            assert result.skipped == {"north/2": "taken over: the mode changed to LOITER"}
            assert result.is_complete
        assert stage.orders_to("north/2") == []
        stage.fleet.reclaim("north/2")
        assert [type(event) for event in stage.events()] == [MemberTakenOver, MemberReclaimed]
        assert len(await stage.fleet.land()) == 3
        assert stage.modes_ordered("north/2") == ["LAND"]


async def test_pilot_takeover_during_action_is_respected() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()

        async def take() -> None:
            await anyio.sleep(4)
            stage.pilot_takes("north/2")

        taking = asyncio.create_task(take())
        result = await stage.fleet.go_to(north(300))
        await taking
        await anyio.sleep(5)
        assert stage.modes == {"north/1": "BRAKE", "north/2": "LOITER", "north/3": "BRAKE"}
        assert "LOITER" in str(result.failed["north/2"])
        assert [command.command for _, command in stage.orders_to("north/2")] == [MavCmd.DO_REPOSITION]
        stage.pilot_takes("north/2", 9)
        (await stage.fleet.land()).raise_for_errors()


async def test_member_in_failsafe_gets_no_orders() -> None:
    async with open_stage(3, on_error="land_others") as stage:
        await stage.take_off()
        await stage.fleet.vehicles["north/3"].parameters.set("BATT_FS_LOW_ACT", 2)  # RTL
        await stage.fleet.vehicles["north/3"].parameters.set("BATT_LOW_MAH", 3000)
        stage.copters["north/3"].battery.percent = 5.0
        result = await stage.fleet.go_to(north(300))
        assert list(result.failed) == ["north/3"]
        assert stage.fleet.members["north/3"].state is MemberState.TAKEN_OVER
        assert stage.modes_ordered("north/3") == []
        assert stage.modes_ordered("north/1") == ["LAND"]


async def test_failed_arming_leaves_all_on_ground() -> None:
    async with open_stage(3) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        stage.copters["north/2"].faults.refuse(MavCmd.COMPONENT_ARM_DISARM)
        result = await stage.fleet.arm()
        assert list(result.failed) == ["north/2"]
        result = await stage.fleet.take_off(10)
        assert list(result.failed) == ["north/2"]
        await anyio.sleep(3)
        assert all(copter.motion.is_on_ground for copter in stage.copters.values())


async def test_barrier_waits_for_slowest_and_names_missing_members() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        began = now()

        def is_time(member: Member) -> bool:
            return now() - began > 3 * member.vehicle.system_id

        await stage.fleet.barrier(is_time)
        assert now() - began == pytest.approx(9.0, abs=0.5)
        with pytest.raises(FleetError, match="wait_at_altitude") as caught:
            await stage.fleet.wait_at_altitude(50, timeout=2)
        (late,) = [error for error in caught.value.errors.values() if isinstance(error, OperationTimeout)]
        assert "north/1, north/2, north/3" in str(late)


async def test_networks_with_same_system_ids_form_one_fleet() -> None:
    async with open_stage(2, networks=("north", "south")) as stage:
        assert list(stage.fleet.members) == ["north/1", "north/2", "south/1", "south/2"]
        await stage.take_off()
        south = stage.fleet["south/*"]
        assert list(south.vehicles) == ["south/1", "south/2"]
        (await south.land()).raise_for_errors()
        assert stage.modes["north/1"] == stage.modes["north/2"] == "GUIDED"
        assert not stage.orders_to("north/1")
        assert stage.copters["south/1"].motion.is_on_ground


async def test_do_accepts_method_name_or_function_with_timeout() -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        assert (await stage.fleet.do("set_mode", "LOITER")).is_complete
        assert stage.mode_of("north/1") == "LOITER"

        async def name_of(member: Member) -> str:
            await anyio.sleep(member.vehicle.system_id * 5)
            return member.name

        result = await stage.fleet.do(name_of, timeout=7)
        assert result["north/1"] == "north/1"
        assert isinstance(result["north/2"], OperationTimeout)
        for wrong in ("explode", "_holding.hold", "position"):
            with pytest.raises(InvalidArgument, match="action"):
                await stage.fleet.do(wrong)


async def test_stagger_delays_consecutive_members() -> None:
    async with open_stage(3) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        await stage.fleet.set_mode("GUIDED")
        stage.clear()
        await stage.fleet.take_off(5, stagger_s=2)
        times = [stage.orders_to(name)[0][0] for name in stage.copters]
        assert [later - times[0] for later in times] == pytest.approx([0.0, 2.0, 4.0], abs=0.3)


async def test_rejected_arguments_do_not_stop_running_action() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        flying = asyncio.create_task(stage.fleet.go_to(north(20)))
        await anyio.sleep(1)
        for wrong in (
            stage.fleet.take_off(-1),
            stage.fleet.set_mode("NOPE"),
            stage.fleet.go_to({}, speed_m_s=0),
        ):
            with pytest.raises(InvalidArgument):
                await wrong
        assert (await flying).is_complete


async def test_failed_landing_does_not_stop_other_landings() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        stage.copters["north/2"].faults.refuse(MavCmd.DO_SET_MODE)
        result = await stage.fleet.land()
        assert list(result.failed) == ["north/2"]
        assert not result.stopped
        assert stage.copters["north/1"].motion.is_on_ground
        assert stage.copters["north/3"].motion.is_on_ground
        assert not stage.events(PolicyApplied)


async def test_failure_during_policy_of_another_is_decided_too() -> None:
    """Both members of a lost link fail at once; only the second one's group has a policy with orders."""
    async with open_stage(
        2,
        networks=("north", "south"),
        groups={"camera": ["south/1"]},
        on_error_by_group={"camera": "continue_others"},
    ) as stage:
        await stage.take_off()
        flying = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(3)
        stage.wires["south"].lose()
        result = await flying
        assert set(result.failed) == {"south/1", "south/2"}
        assert set(result.stopped) == {"north/1", "north/2"}
        assert stage.modes["north/1"] == stage.modes["north/2"] == "BRAKE"


async def test_function_named_like_safe_action_has_policy() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)

        async def land(member: Member) -> None:
            await member.vehicle.go_to(member.vehicle.position.value.offset(north_m=300))

        result = await stage.fleet.do(land)
        assert (list(result.failed), list(result.stopped)) == (["north/1"], ["north/2"])
        assert stage.mode_of("north/2") == "BRAKE"


async def test_barrier_named_like_safe_action_has_policy() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        with pytest.raises(FleetError, match="hold"):
            await stage.fleet.barrier(lambda member: member.name == "north/2", timeout=1, description="hold")
        assert stage.modes_ordered("north/2") == ["BRAKE"]


async def test_wait_at_altitude_rejects_old_position() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        stage.copters["north/2"].faults.lost_messages[GlobalPositionInt.ID] = 10_000
        await anyio.sleep(3)
        with pytest.raises(FleetError, match="wait_at_altitude") as caught:
            await stage.fleet.wait_at_altitude(10, tolerance_m=2, timeout=2)
        assert "within 2 s by north/2" in str(caught.value.errors["north/2"])


async def test_member_repeated_failsafe_counts_after_end_while_disarmed() -> None:
    async with open_stage(2) as stage:
        copter, member = stage.copters["north/2"], stage.fleet.members["north/2"]
        await stage.take_off()
        cell = member.vehicle.system_status
        copter.faults.rc_lost = True
        await cell.wait_until(lambda state: state == MavState.CRITICAL, timeout=10)
        stage.fleet.reclaim("north/2")
        assert member._ignored_failsafe == MavState.CRITICAL
        (await stage.fleet.land()).raise_for_errors()
        copter.faults.rc_lost = False
        await cell.wait_until(lambda state: state == MavState.STANDBY, timeout=10)
        await anyio.sleep(1)
        assert member._ignored_failsafe is None
