"""Two orders at once, where the second needs the command that the first waits for: the newest one counts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager, suppress

import anyio
import pytest
from disturbed_link import Disturbances, DisturbedLink

import aerokit
from aerokit.errors import AerokitError, CommandTimeout, OperationRejected, SetpointStreamStopped
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.mavlink.messages import (
    CommandInt,
    CommandLong,
    GlobalPositionInt,
    SetMode,
    SetPositionTargetGlobalInt,
)
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing.track import true_point
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

pytestmark = pytest.mark.anyio

Stage = tuple[SimulatedCopter, aerokit.Vehicle, DisturbedLink]


@asynccontextmanager
async def _copter(*, flies: bool) -> AsyncIterator[Stage]:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        path = DisturbedLink(link)
        async with aerokit.connect(path, rates={GlobalPositionInt: 4.0}) as vehicle:
            await vehicle.wait_ready()
            await vehicle.set_mode("GUIDED")
            if flies:
                await vehicle.arm()
                await vehicle.take_off(10.0)
            await anyio.sleep(1.3)
            yield copter, vehicle, path


async def _ended(order: Awaitable[object]) -> None:
    with suppress(AerokitError):
        await order


def _prepare(path: DisturbedLink, disturbances: Disturbances) -> None:
    path.disturbances = disturbances
    path.begin()


def _commands(path: DisturbedLink, command: int) -> list[tuple[float, float]]:
    """Return when the command was sent, and its param1 (176: param2)."""
    return [
        (
            message.at - path.began_at,
            message.message.param2 if command == MavCmd.DO_SET_MODE else message.message.param1,
        )
        for message in path.sent
        if isinstance(message.message, (CommandLong, CommandInt)) and message.message.command == command
    ]


async def test_order_superseded_while_waiting_is_not_sent() -> None:
    async with _copter(flies=True) as (copter, vehicle, path):
        there = vehicle.position.value.offset(north_m=8)
        _prepare(path, Disturbances(command=MavCmd.DO_SET_MODE, lost_acks=9, lost_commands=9))
        async with anyio.create_task_group() as tasks:
            for order in (vehicle.set_mode("LOITER"), vehicle.land()):
                tasks.start_soon(_ended, order)
            await anyio.sleep(0.1)
            await vehicle.go_to(there, timeout=30)
        assert true_point(copter).mode == "GUIDED"
        assert CopterMode.LAND not in [mode for at, mode in _commands(path, MavCmd.DO_SET_MODE) if at >= 0.1]


async def test_order_does_not_wait_for_superseded_one() -> None:
    async with _copter(flies=True) as (_, vehicle, path):
        _prepare(path, Disturbances(command=MavCmd.DO_SET_MODE, lost_acks=1, lost_commands=1))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_ended, vehicle.set_mode("LOITER"))
            await anyio.sleep(0.1)
            await vehicle.hold()
        assert [(round(at, 2), mode) for at, mode in _commands(path, MavCmd.DO_SET_MODE)] == [
            (0.0, CopterMode.LOITER),
            (0.1, CopterMode.BRAKE),
        ]


async def test_takeover_while_order_waits_keeps_vehicle() -> None:
    """The program sends both commands, so the second waits for the answer to the first."""
    async with _copter(flies=True) as (copter, vehicle, path):
        _prepare(path, Disturbances(command=MavCmd.DO_CHANGE_SPEED, lost_acks=9))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_ended, vehicle.command(MavCmd.DO_CHANGE_SPEED, 1, 3, -1, attempt_timeout=3))
            await anyio.sleep(0.1)
            tasks.start_soon(_ended, vehicle.set_speed(7))
            copter.rc[2] = 1500
            copter.set_mode(CopterMode.ALT_HOLD)
        assert len(_commands(path, MavCmd.DO_CHANGE_SPEED)) == 1


async def test_disarm_supersedes_arm_immediately() -> None:
    async with _copter(flies=False) as (copter, vehicle, path):
        _prepare(path, Disturbances(command=MavCmd.COMPONENT_ARM_DISARM, lost_acks=9, lost_commands=1))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_ended, vehicle.arm())
            await anyio.sleep(0.1)
            tasks.start_soon(_ended, vehicle.disarm())
        sent = _commands(path, MavCmd.COMPONENT_ARM_DISARM)
        assert [(round(at, 2), arms) for at, arms in sent[:2]] == [(0.0, 1.0), (0.1, 0.0)]
        assert [arms for _, arms in sent[2:]].count(1.0) == 0
        assert not true_point(copter).armed


async def test_arm_and_disarm_commands_supersede_each_other() -> None:
    async with _copter(flies=False) as (copter, vehicle, path):
        _prepare(path, Disturbances(command=MavCmd.COMPONENT_ARM_DISARM, lost_acks=9, lost_commands=2))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_ended, vehicle.arm())
            await asyncio.sleep(0.1)
            tasks.start_soon(_ended, vehicle.command(MavCmd.COMPONENT_ARM_DISARM, 0))
            await asyncio.sleep(0.1)
            await vehicle.arm()
        sent = _commands(path, MavCmd.COMPONENT_ARM_DISARM)
        assert [arms for _, arms in sent] == [1.0, 0.0, 1.0]
        assert true_point(copter).armed


@pytest.mark.parametrize("legacy", [MavCmd.DO_SET_MODE, MavCmd.DO_REPOSITION])
async def test_legacy_set_mode_is_not_sent_for_ended_order(
    legacy: MavCmd,
) -> None:
    """SET_MODE would be sent 0.3 s after the refusal, because aerokit waits that long for the reasons."""
    async with _copter(flies=True) as (copter, vehicle, path):
        copter.faults.refuse(legacy, MavResult.UNSUPPORTED)
        there = vehicle.position.value.offset(north_m=8)
        _prepare(path, Disturbances())
        async with anyio.create_task_group() as tasks:
            order = vehicle.set_mode("LAND") if legacy == MavCmd.DO_SET_MODE else vehicle.go_to(there)
            tasks.start_soon(_ended, order)
            await anyio.sleep(0.1)
            await vehicle.set_heading(90.0)
        await anyio.sleep(2.0)
        old = [
            message
            for message in path.sent
            if isinstance(message.message, SetPositionTargetGlobalInt)
            or (isinstance(message.message, SetMode) and message.message.custom_mode == CopterMode.LAND)
        ]
        assert not old
        assert true_point(copter).mode == "GUIDED"


async def test_raw_command_supersedes_action() -> None:
    async with _copter(flies=True) as (_, vehicle, path):
        there = vehicle.position.value.offset(north_m=100)
        _prepare(path, Disturbances(command=MavCmd.DO_REPOSITION, lost_acks=9))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_ended, vehicle.go_to(there, timeout=8))
            await anyio.sleep(0.3)
            vehicle.send(CommandLong(1, 1, MavCmd.DO_PAUSE_CONTINUE, 0, *(0.0,) * 7))
        await anyio.sleep(2.0)
        assert len(_commands(path, MavCmd.DO_REPOSITION)) == 1
        assert _commands(path, MavCmd.DO_SET_MODE) == []


async def test_order_right_after_raw_mode_message_changes_mode_again() -> None:
    """HEARTBEAT reports GUIDED, although the vehicle has already received SET_MODE."""
    async with _copter(flies=True) as (copter, vehicle, _):
        vehicle.send(SetMode(copter.system_id, 1, CopterMode.BRAKE))
        await vehicle.set_heading(90.0)
        assert true_point(copter).mode == "GUIDED"


async def test_stream_replaced_by_newer_order_names_the_order() -> None:
    async with _copter(flies=True) as (_, vehicle, _path):
        with pytest.raises(SetpointStreamStopped, match="has stopped: another order was given"):
            async with vehicle.guided.velocity(rate_hz=2) as stream:
                await vehicle.set_mode("LOITER")
                stream.set(VelocitySetpoint())
                await anyio.sleep(1)


async def test_flight_order_replaced_before_acknowledgement_is_rejected() -> None:
    async with _copter(flies=True) as (_, vehicle, path), anyio.create_task_group() as tasks:
        _prepare(path, Disturbances(command=MavCmd.DO_SET_MODE, lost_acks=1, lost_commands=1))

        async def go_to() -> None:
            await anyio.sleep(0.3)
            await vehicle.go_to(vehicle.position.value.offset(north_m=8))

        tasks.start_soon(go_to)
        with pytest.raises(OperationRejected, match=r"no COMMAND_ACK for MAV_CMD_DO_SET_MODE.*another order was given"):
            await vehicle.set_mode("LOITER")


async def test_arm_replaced_by_disarm_promises_no_cleanup() -> None:
    async with _copter(flies=False) as (copter, vehicle, _), anyio.create_task_group() as tasks:
        copter.faults.ignore(MavCmd.COMPONENT_ARM_DISARM, times=1)

        async def disarm() -> None:
            await anyio.sleep(0.3)
            await vehicle.disarm()

        tasks.start_soon(disarm)
        with pytest.raises(OperationRejected, match=r"no COMMAND_ACK.*another order was given") as raised:
            await vehicle.arm()
        assert "aerokit disarms it" not in str(raised.value)


async def test_arm_ended_by_flight_order_is_watched() -> None:
    async with _copter(flies=False) as (copter, vehicle, _), anyio.create_task_group() as tasks:
        copter.faults.ignore(MavCmd.COMPONENT_ARM_DISARM, times=1)

        async def set_mode() -> None:
            await anyio.sleep(0.3)
            await vehicle.set_mode("LOITER")

        tasks.start_soon(set_mode)
        with pytest.raises(CommandTimeout, match=r"another order was given.*aerokit disarms it"):
            await vehicle.arm()


@pytest.mark.parametrize("is_replaced", [False, True])
async def test_unacknowledged_reboot_returns_when_vehicle_has_rebooted(is_replaced: bool) -> None:
    async with _copter(flies=False) as (copter, vehicle, _), anyio.create_task_group() as tasks:
        copter.faults.lose_ack(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN)

        async def set_mode() -> None:
            await anyio.sleep(0.1)
            await _ended(vehicle.set_mode("LOITER"))

        if is_replaced:
            tasks.start_soon(set_mode)
        uptime = copter.uptime
        await vehicle.reboot()
        assert copter.uptime < uptime


async def test_raw_command_awaits_late_acknowledgement_despite_newer_action() -> None:
    async with _copter(flies=False) as (copter, vehicle, _), anyio.create_task_group() as tasks:
        copter.faults.delay_ack(MavCmd.DO_SET_RELAY, 2.0)

        async def set_mode() -> None:
            await anyio.sleep(0.3)
            await vehicle.set_mode("LOITER")

        tasks.start_soon(set_mode)
        await vehicle.command(MavCmd.DO_SET_RELAY, 0, 1)


async def test_cancelled_replacement_of_flight_that_is_about_to_begin_holds() -> None:
    """The vehicle obeys the first order, but has not reported its mode yet. The second order has sent nothing."""
    async with _copter(flies=True) as (copter, vehicle, path):
        await vehicle.hold()
        await anyio.sleep(1.3)
        _prepare(path, Disturbances(latency_s=0.3))
        first = asyncio.create_task(_ended(vehicle.go_to(vehicle.position.value.offset(north_m=300))))
        await anyio.sleep(0.1)
        with anyio.move_on_after(0.1):
            async with vehicle.follow(lambda: None):
                raise AssertionError("entered without a target")
        assert vehicle.mode_name == "BRAKE"  # the report from before the first order
        await first
        await anyio.sleep(5.0)
        assert copter.mode.number == CopterMode.BRAKE
