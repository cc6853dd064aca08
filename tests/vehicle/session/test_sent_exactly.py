"""Exact wire contents of orders, and the loop iteration in which calls return."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from exhaustive import exhaustive
from flight_harness import Flight, in_the_air, now, open_flight, open_px4

from aerokit import connect
from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    NotSupported,
    OperationRejected,
    OperationTimeout,
    SetpointStreamStopped,
)
from aerokit.events import VehicleSilent
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim import SimulatedCopter, SimulatedRover, simulated_link
from aerokit.sim.px4.modes import OFFBOARD
from aerokit.vehicle.commanding.progress import await_progress
from aerokit.vehicle.commanding.setpoints import AttitudeSetpoint, LocalPositionSetpoint, PositionSetpoint
from aerokit.vehicle.session.commands import PENDING_ACK_TIMEOUT_S, CommandSender

pytestmark = pytest.mark.anyio

BANNER = MavCmd.DO_SEND_BANNER


def params_of(command: m.CommandLong | m.CommandInt) -> list[float]:
    names = ("param1", "param2", "param3", "param4", "param5", "param6", "param7")
    return [value for name in names if (value := getattr(command, name, None)) is not None]


@pytest.mark.parametrize(("heading_deg", "yaw"), [(90.0, math.pi / 2), (270.0, -math.pi / 2)])
async def test_px4_set_heading_turns_and_keeps_speed(heading_deg: float, yaw: float) -> None:
    async with open_px4() as flight:
        await flight.take_off()
        await flight.vehicle.set_heading(heading_deg)
        (command,) = flight.wire.commands(MavCmd.DO_REPOSITION)
        params = params_of(command)
        assert params[:4] == pytest.approx([-1.0, 1.0, 0.0, yaw])
        assert all(math.isnan(param) for param in params[4:])


async def test_speed_and_roi_are_raw_commands(flying: Flight) -> None:
    await flying.vehicle.set_speed(4.0)
    assert params_of(flying.wire.commands(MavCmd.DO_CHANGE_SPEED)[0]) == [1.0, 4.0, -1.0, 0.0, 0.0, 0.0, 0.0]
    here = flying.vehicle.position.value
    await flying.vehicle.go_to(here.offset(north_m=5), speed_m_s=3.0, heading_deg=360.0)
    assert params_of(flying.wire.commands(MavCmd.DO_CHANGE_SPEED)[1])[:3] == [1.0, 3.0, -1.0]
    assert params_of(flying.wire.commands(MavCmd.CONDITION_YAW)[0])[:4] == [0.0, 0.0, 0.0, 0.0]
    reposition = params_of(flying.wire.commands(MavCmd.DO_REPOSITION)[0])
    assert reposition[:3] == [-1.0, 1.0, 0.0]
    assert math.isnan(reposition[3])


async def test_force_uses_magic_number(grounded: Flight) -> None:
    vehicle = grounded.vehicle
    await vehicle.arm(force=True)
    await vehicle.disarm(force=True)
    await vehicle.reboot(force=True)
    arm, disarm = grounded.wire.commands(MavCmd.COMPONENT_ARM_DISARM)
    assert params_of(arm) == [1.0, 21196.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert params_of(disarm) == [0.0, 21196.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    (reboot,) = grounded.wire.commands(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN)
    assert params_of(reboot) == [1.0, 0.0, 0.0, 0.0, 0.0, 20190226.0, 0.0]
    await vehicle.wait_ready()
    await vehicle.reboot()
    assert params_of(grounded.wire.commands(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN)[1])[5] == 0.0


# -------------------------------------------------------------------------------- set-points


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("kind", "rate_hz"),
    [
        (lambda guided, here: guided.velocity(), 10.0),
        (lambda guided, here: guided.body_velocity(), 10.0),
        (lambda guided, here: guided.acceleration(), 20.0),
        (lambda guided, here: guided.local_position(LocalPositionSetpoint(0, 0, -10)), 10.0),
        (lambda guided, here: guided.position(PositionSetpoint(here)), 10.0),
        (lambda guided, here: guided.attitude(AttitudeSetpoint(0.0, 0.0, 0.0, 0.5)), 50.0),
    ],
)
async def test_setpoint_stream_default_rate(flying: Flight, kind: Callable[[Any, Any], Any], rate_hz: float) -> None:
    stream = kind(flying.vehicle.guided, flying.vehicle.position.value)
    async with stream:
        await anyio.sleep(0.28)
        times = [at for at, _ in flying.wire.setpoints()]
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert gaps[:2] == pytest.approx([1 / rate_hz] * 2, abs=1e-6)


async def test_setpoint_validity_starts_with_mode_report() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        flight.px4.faults.delay_ack(MavCmd.DO_SET_MODE, 0.5)
        async with flight.vehicle.guided.velocity(valid_for_s=0.4) as stream:
            await anyio.sleep(0.3)
            assert stream.is_running


# ----------------------------------------------------------------------------------- returns


async def test_posted_order_already_in_effect_returns(grounded: Flight) -> None:
    started = now()
    await await_progress(
        grounded.vehicle._session,
        "nothing",
        is_done=lambda: True,
        failure_reason=lambda: None,
        describe=str,
        timeout=None,
    )
    assert now() == started


async def test_call_silence_exceeds_custom_limit_raises(grounded: Flight) -> None:
    """The instant of a heartbeat is no silence yet."""
    with grounded.vehicle.subscribe(m.Heartbeat) as heartbeats:
        await anext(heartbeats)
    started = now()
    with pytest.raises(HeartbeatTimeout):
        await await_progress(
            grounded.vehicle._session,
            "nothing",
            is_done=lambda: False,
            failure_reason=lambda: None,
            describe=str,
            timeout=None,
            max_silence_s=0.0,
        )
    assert now() > started


async def test_px4_arms_when_ready_in_new_mode() -> None:
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        flight.px4.switch_to(OFFBOARD)
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "OFFBOARD")
        await anyio.sleep(1.0)
        await flight.vehicle.arm()
        modes = [at for at, message in flight.wire.sent if getattr(message, "command", 0) == MavCmd.DO_SET_MODE]
        arms = [at for at, message in flight.wire.sent if getattr(message, "command", 0) == MavCmd.COMPONENT_ARM_DISARM]
        assert arms[0] - modes[0] < 2.5


# ------------------------------------------------------------------------- unexpected answers


@pytest.fixture
def sender(grounded: Flight) -> CommandSender:
    return CommandSender(grounded.vehicle.connection, 1, 1, lambda: "")


def awaits_answer(sender: CommandSender) -> bool:
    oldest = anyio.current_time() - PENDING_ACK_TIMEOUT_S
    return any(at >= oldest for at in sender._pending_acks.get((1, BANNER), ()))


async def test_unconfirmed_command_ack_is_expected_for_two_seconds(grounded: Flight, sender: CommandSender) -> None:
    assert not awaits_answer(sender)
    sender.send_unconfirmed(BANNER)
    assert awaits_answer(sender)
    await anyio.sleep(0.2)
    assert not awaits_answer(sender)  # it came
    grounded.copter.faults.ignore(BANNER)
    sender.send_unconfirmed(BANNER)
    await anyio.sleep(PENDING_ACK_TIMEOUT_S - 0.01)
    assert awaits_answer(sender)
    await anyio.sleep(0.02)
    assert not awaits_answer(sender)


async def test_expected_answers_after_lost_command_end_with_their_age(grounded: Flight, sender: CommandSender) -> None:
    grounded.copter.faults.ignore(BANNER)
    for _ in range(4):
        sender.send_unconfirmed(BANNER)
    await anyio.sleep(0.2)
    grounded.copter.faults.clear()
    await sender.send_long(BANNER, attempts=2)  # its first answer may be one of the four
    assert awaits_answer(sender)
    await anyio.sleep(
        PENDING_ACK_TIMEOUT_S - 1.1
    )  # sent again after a second; nothing is expected for longer than that
    assert not awaits_answer(sender)


async def test_ack_is_matched_to_oldest_pending_command(grounded: Flight, sender: CommandSender) -> None:
    grounded.copter.faults.ignore(BANNER, times=1)
    sender.send_unconfirmed(BANNER)
    await anyio.sleep(1.5)
    sender.send_unconfirmed(BANNER)
    await anyio.sleep(1.0)
    assert awaits_answer(sender)


# ---------------------------------------------------------------------------------- go_to


async def test_go_to_heading_refused_holds(flying: Flight) -> None:
    flying.copter.faults.refuse(MavCmd.CONDITION_YAW, MavResult.FAILED)
    with pytest.raises(CommandRejected, match="CONDITION_YAW"):
        await flying.vehicle.go_to(flying.vehicle.position.value.offset(north_m=100), heading_deg=90.0)
    await anyio.sleep(2.0)
    assert flying.wire.mode_orders() == [17]


async def test_go_to_legacy_message_is_repeated_each_second() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, unsupported_commands=[MavCmd.DO_REPOSITION])
    async with in_the_air(copter=copter) as flight:
        await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=40))
        times = flight.wire.times(m.SetPositionTargetGlobalInt)
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert len(gaps) > 3
    assert all(1.0 <= gap < 1.3 for gap in gaps)


async def test_go_to_on_ground_is_rejected(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    await grounded.vehicle.arm()
    assert grounded.vehicle.landed_state.value == 1
    with pytest.raises(OperationRejected, match=r"on the ground: call take_off\(\) first; nothing was sent"):
        await grounded.vehicle.go_to(grounded.vehicle.position.value.offset(north_m=10))
    assert not grounded.wire.commands(MavCmd.DO_REPOSITION)


# ------------------------------------------------------------------------------- refusals


async def test_rover_take_off_is_not_supported() -> None:
    async with simulated_link(SimulatedRover(boot_time_s=1.0)) as link, connect(link) as vehicle:
        with pytest.raises(NotSupported, match="take_off: Rover cannot take off"):
            await vehicle.take_off(5.0)


async def test_reboot_not_executed_raises_reason(flying: Flight) -> None:
    with pytest.raises(OperationRejected, match="reboot: the vehicle is armed; nothing was sent"):
        await flying.vehicle.reboot()


async def test_arm_default_timeout_is_ten_seconds(grounded: Flight) -> None:
    grounded.copter.faults.refuse(MavCmd.COMPONENT_ARM_DISARM, MavResult.ACCEPTED)
    with pytest.raises(OperationTimeout, match=r"^arm\(\): not done within 10 s"):
        await grounded.vehicle.arm()


async def test_px4_setpoint_stream_not_fed_after_entry_holds() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with pytest.raises(SetpointStreamStopped, match="no new set-point was supplied for"):
            async with flight.vehicle.guided.velocity(valid_for_s=1.0):
                await anyio.sleep(5.0)


# ---------------------------------------------------------------- block left in a silence


async def test_block_left_with_unconfirmed_hold_warns(caplog: pytest.LogCaptureFixture) -> None:
    async with in_the_air() as flight:
        with anyio.move_on_after(2.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        flight.copter.faults.silent = True
    assert "left before a hold was confirmed" in caplog.text


async def test_hold_unanswered_warns_and_is_repeated_after_silence(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with in_the_air() as flight:
        with anyio.move_on_after(2.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
            raise AssertionError
        flight.copter.faults.silent = True
        flight.copter.faults.frozen = True
        await anyio.sleep(12.0)
        assert "the hold after an abandoned flight is not confirmed yet" in caplog.text


async def test_hold_in_silence_is_sent_after_heartbeat() -> None:
    async with in_the_air() as flight:
        with flight.vehicle.subscribe(VehicleSilent) as events, anyio.move_on_after(60.0):
            with anyio.CancelScope() as scope:
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(flight.vehicle.go_to, flight.vehicle.position.value.offset(north_m=500))
                    await anyio.sleep(2.0)
                    flight.copter.faults.silent = True
                    await events.get(timeout=10.0)
                    flight.wire.clear()
                    scope.cancel()
        await anyio.sleep(5.0)
        assert not flight.wire.mode_orders()
        assert flight.vehicle.mode_name == "GUIDED"
        flight.copter.faults.silent = False
        await anyio.sleep(4.0)
        assert flight.wire.mode_orders() == [17]


async def test_takeover_in_silence_keeps_vehicle() -> None:
    async with in_the_air() as flight:
        with anyio.CancelScope() as scope:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(flight.vehicle.go_to, flight.vehicle.position.value.offset(north_m=500))
                await anyio.sleep(2.0)
                flight.copter.faults.silent = True
                await anyio.sleep(5.0)
                scope.cancel()
        flight.wire.clear()
        flight.pilot_takes_over()
        flight.copter.faults.silent = False
        await anyio.sleep(4.0)
        assert not flight.wire.mode_orders()
        assert flight.vehicle.mode_name == "LOITER"


async def test_block_left_with_unanswered_arm_warns(caplog: pytest.LogCaptureFixture) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.ignore(MavCmd.COMPONENT_ARM_DISARM)
        with pytest.raises(CommandTimeout):
            await flight.vehicle.arm()
    assert "left while an arm command may still be executed" in caplog.text


async def test_block_left_with_answered_arm_is_silent(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await flight.vehicle.disarm()
    assert "order to arm" not in caplog.text


@pytest.mark.exhaustive
@pytest.mark.parametrize(("order", "longest_s"), [("land", 300.0), exhaustive(pytest.param("return_to_launch", 600.0))])
async def test_land_and_return_default_timeouts_apply(flying: Flight, order: str, longest_s: float) -> None:
    flying.copter.motion.step = lambda *_, **__: None  # type: ignore[method-assign]
    begin = now()
    with pytest.raises(OperationTimeout, match=f"{order}: not done within {longest_s:g} s; the vehicle is at 10.0 m"):
        await getattr(flying.vehicle, order)()
    assert longest_s <= now() - begin < longest_s + 3.0
