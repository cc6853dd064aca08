"""`gimbal.control()` and `gimbal.rates()`: taking, confirming, losing, releasing control; streams of rates."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from flight_harness import Px4Flight, block_loop, now, open_flight, open_px4, suspend_computer
from gimbal_stage import (
    CONFIGURE,
    MOUNT,
    OTHER,
    PITCHYAW,
    configured,
    mounted,
    own_ids,
    takes_control,
    with_gimbals,
)

import aerokit
from aerokit import errors, events
from aerokit import messages as m
from aerokit.errors import (
    BusyError,
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    GimbalTaken,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
    SetpointStreamStopped,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavResult
from aerokit.sim import SimulatedCopter, SimulatedGimbal, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

KEEP = (-1, -1)


class Boom(Exception):
    pass


# ------------------------------------------------------------------------------------------- control


async def test_control_is_taken_confirmed_and_released() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        async with flight.vehicle.gimbal.control() as control:
            assert gimbal.primary == own_ids(flight)
            assert (control.is_held, control.is_primary) == (True, True)
            assert flight.vehicle.gimbal.controllers.value.primary == own_ids(flight)
            await flight.vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
        assert gimbal.primary == (0, 0)
        assert not control.is_held
        assert configured(flight)[0] == (*own_ids(flight), *KEEP, 154)
        assert configured(flight)[-1] == (-3, -3, *KEEP, 154)


async def test_control_requests_status_from_autopilot() -> None:
    async with mounted() as flight:
        for _ in range(2):
            async with flight.vehicle.gimbal.control():
                assert flight.copter.gimbal.in_control == own_ids(flight)
            assert flight.copter.gimbal.in_control == (0, 0)
        assert configured(flight)[0] == (*own_ids(flight), *KEEP, 0)


async def test_secondary_control_coexists_with_primary() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        takes_control(flight)
        async with flight.vehicle.gimbal.control(secondary=True) as control:
            assert (gimbal.primary, gimbal.secondary) == (OTHER, own_ids(flight))
            assert not control.is_primary
            await flight.vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
            takes_control(flight, secondary=True)
            assert await control.until_lost() == OTHER
        assert (gimbal.primary, gimbal.secondary) == (OTHER, OTHER)


@pytest.mark.parametrize("how", ["raises", "is cancelled"])
async def test_control_released_without_waiting(how: str) -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        left_at = math.nan
        with anyio.CancelScope() as scope:
            try:
                async with flight.vehicle.gimbal.control():
                    left_at = now()
                    if how == "raises":
                        raise Boom
                    scope.cancel()
                    await anyio.sleep(9)
            except Boom:
                pass
        assert now() == left_at
        await anyio.sleep(1.0)
        assert gimbal.primary == (0, 0)


async def test_background_release_is_retried_until_acknowledged() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        with pytest.raises(Boom):
            async with flight.vehicle.gimbal.control():
                gimbal.faults.drop_incoming = 1
                raise Boom
        assert gimbal.primary == own_ids(flight)
        await anyio.sleep(3.0)
        assert gimbal.primary == (0, 0)


async def test_vehicle_block_end_releases_control() -> None:
    gimbal = SimulatedGimbal()
    async with anyio.create_task_group() as tasks:
        async with with_gimbals(gimbal) as flight:

            async def hold() -> None:
                async with flight.vehicle.gimbal.control():
                    await anyio.sleep(99)

            tasks.start_soon(hold)
            await anyio.sleep(1.0)
            assert gimbal.primary == own_ids(flight)
            await anyio.lowlevel.checkpoint()
        assert configured(flight)[-1] == (-3, -3, *KEEP, 154)
        tasks.cancel_scope.cancel()


async def test_mount_orders_after_lost_control_are_not_sent() -> None:
    async with mounted() as flight:
        gimbal = flight.vehicle.gimbal
        async with gimbal.control() as control:
            takes_control(flight, 1)
            await control.until_lost()
            for order in (gimbal.release(), gimbal.point(-20.0, 0.0, roll_deg=5.0, wait=False)):
                with pytest.raises(GimbalTaken):
                    await order
        assert not flight.wire.commands(MOUNT)


async def test_lost_control_publishes_event_and_ends_waits() -> None:
    gimbal = SimulatedGimbal(slew_deg_s=5.0)
    async with with_gimbals(gimbal) as flight:
        with flight.vehicle.subscribe(events.GimbalControlLost) as lost:
            async with flight.vehicle.gimbal.control() as control:
                asyncio.get_running_loop().call_later(1.0, takes_control, flight)
                began = now()
                with pytest.raises(GimbalTaken, match="254/190 has control now") as caught:
                    await flight.vehicle.gimbal.point(-80.0, 0.0, timeout=30)
                assert now() - began < 3.0
                assert (caught.value.system_id, caught.value.component_id) == OTHER
                assert not control.is_held
                sent = len(flight.wire.commands(PITCHYAW))
                with pytest.raises(GimbalTaken):
                    await flight.vehicle.gimbal.point(0.0, 0.0)
                assert len(flight.wire.commands(PITCHYAW)) == sent
            event = lost.get_nowait()
            assert event is not None
            assert (event.gimbal_device_id, event.is_primary) == (154, True)
            assert (event.to_system_id, event.to_component_id) == OTHER
        await anyio.sleep(1.0)
        assert gimbal.primary == OTHER, "control that another station has is not released"


async def test_unnoticed_loss_raises_on_block_exit() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        with pytest.raises(GimbalTaken):
            async with flight.vehicle.gimbal.control():
                takes_control(flight)
                await anyio.sleep(2.0)
        with pytest.raises(Boom):
            async with flight.vehicle.gimbal.control():
                takes_control(flight)
                await anyio.sleep(2.0)
                raise Boom


async def test_losing_one_of_two_controls_keeps_the_other() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        async with flight.vehicle.gimbal.control() as primary:
            with pytest.raises(GimbalTaken):
                async with flight.vehicle.gimbal.control(secondary=True) as secondary:
                    takes_control(flight, secondary=True)
                    await anyio.sleep(2.0)
                    assert (primary.is_held, secondary.is_held) == (True, False)
                    await flight.vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
        assert (gimbal.primary, gimbal.secondary) == ((0, 0), OTHER)


async def test_out_of_order_status_does_not_lose_control() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control() as control:
        status = m.GimbalManagerStatus(gimbal.time_boot_ms - 700, 0, 154, *OTHER, 0, 0)
        flight.wire.deliver(FrameEncoder(1, 154).encode(status))
        assert control.is_held
        await anyio.sleep(2.0)
        assert control.is_held


@pytest.mark.parametrize("sequence", [7, 255])
async def test_reordered_status_of_same_millisecond_keeps_control(sequence: int) -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control() as control:
        encoder, now_ms = FrameEncoder(1, 154), gimbal.time_boot_ms
        encoder.sequence = sequence
        before, after = (m.GimbalManagerStatus(now_ms, 0, 154, *ids, 0, 0) for ids in (OTHER, own_ids(flight)))
        first, second = encoder.encode(before), encoder.encode(after)
        flight.wire.deliver(second)
        flight.wire.deliver(first)
        assert control.is_held


async def test_second_control_block_is_busy() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        gimbal = flight.vehicle.gimbal
        async with gimbal.control() as control:
            for again in (gimbal.control(), flight.vehicle.gimbals[154].control()):
                with pytest.raises(BusyError, match="already"):
                    async with again:
                        pass
            async with gimbal.control(secondary=True):
                pass
            with pytest.raises(BusyError, match="once"):
                await control.__aenter__()
            assert control.is_held
            with anyio.move_on_after(1.0):
                await control.until_lost()
            control.raise_if_taken()


async def test_new_block_keeps_control_despite_unanswered_release() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        control = flight.vehicle.gimbal.control
        gimbal.faults.lose_ack(CONFIGURE, times=5)
        with pytest.raises(CommandTimeout):
            async with control():
                pass
        async with control() as held:
            await anyio.sleep(8.0)
            assert gimbal.primary == own_ids(flight)
            assert held.is_held
        await anyio.sleep(1.0)
        assert gimbal.primary == (0, 0)


async def test_cancelled_attempt_keeps_control_of_another_task() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        gimbal.faults.delay_ack(CONFIGURE, 0.6, times=1)

        async def give_up() -> None:
            with anyio.move_on_after(0.3):
                async with flight.vehicle.gimbal.control():
                    raise Boom

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(give_up)
            await anyio.sleep(0.1)
            gimbal.faults.clear()
            async with flight.vehicle.gimbals[154].control() as control:
                await anyio.sleep(3.0)
                assert gimbal.primary == own_ids(flight)
                assert control.is_held


@pytest.mark.parametrize("end", ["left", "refused"])
async def test_deferred_release_is_sent_by_later_block(end: str) -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        control = flight.vehicle.gimbal.control
        with pytest.raises(Boom):
            async with control():
                gimbal.faults.drop_incoming = 1
                raise Boom
        if end == "refused":
            gimbal.faults.refuse(CONFIGURE, MavResult.TEMPORARILY_REJECTED, times=2)  # both blocks use the same ids
            with pytest.raises(CommandRejected):
                async with control():
                    pass
        else:
            async with control():
                pass
        await anyio.sleep(3.0)
        assert gimbal.primary == (0, 0)


async def test_unconfirmed_secondary_control_is_released() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        gimbal.faults.lose_ack(CONFIGURE, times=4)
        with pytest.raises(CommandTimeout):
            async with flight.vehicle.gimbal.control(secondary=True):
                pass
        await anyio.sleep(1.0)
        assert (gimbal.primary, gimbal.secondary) == (own_ids(flight), (0, 0))


async def test_until_lost_raises_when_block_ends() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        async with flight.vehicle.gimbal.control() as control:
            waits = asyncio.ensure_future(control.until_lost())
            await anyio.sleep(0.5)
        with pytest.raises(OperationRejected, match="has ended"):
            await waits


async def test_control_refused_or_unconfirmed_raises() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        gimbal.faults.refuse(CONFIGURE, MavResult.TEMPORARILY_REJECTED, times=1)
        with pytest.raises(CommandRejected):
            async with flight.vehicle.gimbal.control():
                pass
        gimbal.faults.refuse(CONFIGURE, MavResult.ACCEPTED, times=1)
        with pytest.raises(OperationTimeout, match="confirmation of our control"):
            async with flight.vehicle.gimbal.control():
                pass
        await anyio.sleep(1.0)  # released, although the manager never confirmed it
        assert configured(flight)[-1][:2] == (-3, -3)
        gimbal.faults.refuse(CONFIGURE, MavResult.UNSUPPORTED, times=1)
        with pytest.raises(NotSupported, match="has no gimbal manager"):
            async with flight.vehicle.gimbal.control():
                pass


async def test_autopilot_secondary_control_is_not_supported() -> None:
    async with mounted() as flight:
        with pytest.raises(NotSupported, match="ArduCopter has no secondary control; nothing was sent"):
            async with flight.vehicle.gimbal.control(secondary=True):
                pass
        assert not configured(flight)


async def test_px4_retract_and_look_at_system_are_not_supported() -> None:
    async with open_px4() as flight:
        gimbal = flight.vehicle.gimbal
        for order in (gimbal.retract(), gimbal.look_at_system(2)):
            with pytest.raises(NotSupported, match=r"PX4 .*; nothing was sent"):
                await order
        assert not flight.wire.commands(PITCHYAW)


async def test_control_is_released_after_silence() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        with pytest.raises(OperationTimeout, match="the command was not sent yet, because the vehicle is silent"):
            async with flight.vehicle.gimbal.control():
                flight.copter.faults.silent = True
                await anyio.sleep(4.0)
        assert gimbal.primary == own_ids(flight)
        flight.copter.faults.silent = False
        await anyio.sleep(3.0)
        assert gimbal.primary == (0, 0)


async def test_release_of_control_is_retried_after_cancellation() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        with anyio.CancelScope() as scope:
            async with flight.vehicle.gimbal.control():
                gimbal.faults.drop_incoming = 1  # loses the release
                asyncio.get_running_loop().call_later(0.1, scope.cancel)
        assert scope.cancelled_caught
        assert gimbal.primary == own_ids(flight)
        await anyio.sleep(3.0)
        assert gimbal.primary == (0, 0)


# --------------------------------------------------------------------------------------------- rates


def pitchyaws(flight: Any) -> list[tuple[float, float]]:
    """Streamed rates in degrees per second."""
    return [
        (round(math.degrees(message.pitch_rate), 2), round(math.degrees(message.yaw_rate), 2))
        for message in flight.wire.all(m.GimbalManagerSetPitchyaw)
    ]


@pytest.mark.parametrize("frame", ["vehicle", "earth"])
async def test_rates_are_streamed_and_end_with_zero(frame: Any) -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        async with flight.vehicle.gimbal.rates(0.0, 0.0, frame=frame, rate_hz=10.0) as stream:
            was_running = stream.is_running
            await stream.turn(-10.0, 20.0, 2.0)
        assert (was_running, stream.is_running) == (True, False)
        assert pitchyaws(flight).count((-10.0, 20.0)) == pytest.approx(20, abs=2)
        assert pitchyaws(flight)[5] == (-10.0, 20.0)
        here = gimbal.angles()
        assert math.degrees(here[1]) == pytest.approx(-20, abs=2)
        await anyio.sleep(2.0)
        assert gimbal.angles() == pytest.approx(here, abs=0.02)
        commands: list[Any] = flight.wire.commands(PITCHYAW)
        first, last = commands[0], commands[-1]
        assert (last.param3, last.param4, last.param5) == (0, 0, 28 if frame == "earth" else 12)
        assert math.isnan(first.param1)


@pytest.mark.parametrize("how", ["left", "raises"])
async def test_zero_rate_that_overtakes_rates_is_sent_again(how: str) -> None:
    async with with_gimbals(SimulatedGimbal()) as flight, flight.vehicle.gimbal.control():
        with suppress(Boom):
            async with flight.vehicle.gimbal.rates(-5.0, 10.0) as stream:
                await stream.turn(-5.0, 10.0, 0.5)
                if how == "raises":
                    raise Boom
        await anyio.sleep(0.5)
        kinds = (m.CommandLong, m.GimbalManagerSetPitchyaw)
        last = [message for _, message in flight.wire.sent if isinstance(message, kinds)][-1]
        assert isinstance(last, m.GimbalManagerSetPitchyaw), "it has no acknowledgement, which could be mistaken"
        assert (last.pitch_rate, last.yaw_rate) == (0.0, 0.0)


@pytest.mark.parametrize("pause", ["sleep", "block"])
async def test_zero_rates_end_after_pause_of_program(pause: str) -> None:
    """Another station may have begun to turn the gimbal meanwhile."""
    zero_rate = anyio.Event()

    def on_message(message: m.GimbalManagerSetPitchyaw, *_: object) -> None:
        if message.pitch_rate == 0.0:
            zero_rate.set()

    async with with_gimbals(SimulatedGimbal()) as flight:
        with suppress(Boom):
            async with flight.vehicle.gimbal.rates(-5.0, 10.0):
                await anyio.sleep(0.5)
                flight.copter.observe(m.GimbalManagerSetPitchyaw, on_message)
                raise Boom
        await zero_rate.wait()
        if pause == "sleep":
            suspend_computer(flight.vehicle, 3600.0)
        else:
            block_loop(20.0)
        sent = pitchyaws(flight).count((0.0, 0.0))
        await anyio.sleep(1.0)
        assert pitchyaws(flight).count((0.0, 0.0)) == sent


async def test_rates_after_zero_rate_end_despite_lost_message() -> None:
    """A rate arrives after the acknowledged command with the rate of zero, and the next two messages are lost."""
    gimbal, stop_message = SimulatedGimbal(), anyio.Event()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        with suppress(Boom):
            async with flight.vehicle.gimbal.rates(-5.0, 10.0):
                await anyio.sleep(0.5)
                flight.copter.observe(m.GimbalManagerSetPitchyaw, lambda *_: stop_message.set())
                raise Boom
        await stop_message.wait()
        late, *_ = flight.wire.all(m.GimbalManagerSetPitchyaw)
        flight.copter.receive(FrameEncoder(*own_ids(flight)).encode(late), flight.copter.now)
        gimbal.faults.drop_incoming = 2
        await anyio.sleep(2.0)
        here = gimbal.angles()
        await anyio.sleep(1.0)
        assert gimbal.angles() == here


@pytest.mark.parametrize("how", ["raises", "is cancelled"])
async def test_rates_cancelled_end_with_zero_without_waiting(how: str) -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        stream = flight.vehicle.gimbal.rates(-5.0, 0.0)
        with anyio.CancelScope() as scope:
            try:
                async with stream:
                    await anyio.sleep(0.5)
                    gimbal.faults.drop_incoming = 1
                    if how == "raises":
                        raise Boom
                    scope.cancel()
                    await anyio.sleep(9)
            except Boom:
                pass
        await anyio.sleep(3.0)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert gimbal.angles() == here
        with pytest.raises(SetpointStreamStopped):
            stream.set(1.0, 1.0)


async def test_control_lost_while_zero_rate_is_sent_raises() -> None:
    """The other station's gimbal goes on turning."""
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        with pytest.raises(GimbalTaken, match="254/190 has control now"):
            async with flight.vehicle.gimbal.rates(0.0, 5.0):
                await anyio.sleep(0.5)
                gimbal.faults.ignore(PITCHYAW)
                asyncio.get_running_loop().call_later(0.2, takes_control, flight)


async def test_lost_zero_rate_is_repeated_despite_newer_flight_order() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        with pytest.raises(Boom):
            async with flight.vehicle.gimbal.rates(0.0, 5.0):
                await anyio.sleep(0.5)
                gimbal.faults.ignore(PITCHYAW, times=1)
                raise Boom
        await anyio.sleep(0.1)
        await flight.vehicle.set_mode("LOITER")
        await anyio.sleep(3.0)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert gimbal.angles() == here


async def test_unanswered_first_rates_end_with_zero() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        gimbal.faults.lose_ack(PITCHYAW, times=None)
        with pytest.raises(CommandTimeout):
            async with flight.vehicle.gimbal.rates(0.0, 5.0):
                pass
        await anyio.sleep(0.5)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert gimbal.angles() == here
        assert math.degrees(here[2]) > 5, "it had executed the command"
        commands: list[Any] = flight.wire.commands(PITCHYAW)
        assert (commands[-1].param3, commands[-1].param4) == (0, 0)


async def test_refused_first_rates_send_no_zero() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        gimbal.faults.refuse(PITCHYAW, MavResult.TEMPORARILY_REJECTED, times=1)
        with pytest.raises(CommandRejected):
            async with flight.vehicle.gimbal.rates(0.0, 5.0):
                pass
        await anyio.sleep(2.0)
        assert len(flight.wire.commands(PITCHYAW)) == 1


async def test_vehicle_block_stops_rates_before_releasing_control() -> None:
    """Without control, the gimbal's manager would deny the rate of zero, and the gimbal would turn on."""
    gimbal = SimulatedGimbal()
    copter = SimulatedCopter(boot_time_s=0.0, components=[gimbal])
    async with (
        simulated_link(copter) as link,
        aerokit.open_connection(link) as connection,
        anyio.create_task_group() as tasks,
    ):
        async with aerokit.connect(connection) as vehicle:
            await vehicle.gimbal.controllers.wait_until(lambda _: True, timeout=3)

            async def turn() -> None:
                async with vehicle.gimbal.control(), vehicle.gimbal.rates(0.0, 5.0, valid_for_s=60.0):
                    await anyio.sleep_forever()

            tasks.start_soon(turn)
            await anyio.sleep(2.0)
            assert gimbal.angles()[2] > 0
        await anyio.sleep(0.5)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert (gimbal.angles(), gimbal.primary) == (here, (0, 0))
        tasks.cancel_scope.cancel()


@pytest.mark.parametrize("entered", ["control", "rates"])
async def test_vehicle_block_ends_while_gimbal_block_is_entered(entered: str) -> None:
    gimbal = SimulatedGimbal()
    copter = SimulatedCopter(boot_time_s=0.0, components=[gimbal])
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await vehicle.gimbal.controllers.wait_until(lambda _: True, timeout=3)
            block: Any = vehicle.gimbal.control()
            if entered == "rates":
                await block.__aenter__()
                block = vehicle.gimbal.rates(0.0, 5.0)
            gimbal.faults.lose_ack(CONFIGURE if entered == "control" else PITCHYAW, times=None)
            entering = asyncio.create_task(block.__aenter__())
            await anyio.sleep(0.2)
        with pytest.raises(ConnectionClosed):
            await entering
        await anyio.sleep(0.5)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert (gimbal.angles(), gimbal.primary) == (here, (0, 0))


async def test_rates_stay_with_their_gimbal() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    async with with_gimbals(one, two) as flight:
        flight.wire.deliver(FrameEncoder(1, 1).encode(m.GimbalManagerStatus(0, 0, 154, 0, 0, 0, 0)))
        flight.copter.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        async with flight.vehicle.gimbal.rates(0.0, 5.0) as stream:
            one.faults.silent = True
            await stream.turn(0.0, 5.0, 15.0)
        commands: list[Any] = flight.wire.commands(PITCHYAW)
        assert {command.target_component for command in commands} == {1}
        assert {message.target_component for message in flight.wire.all(m.GimbalManagerSetPitchyaw)} == {1}
        assert flight.vehicle.gimbals.ids == (171, 154)


async def test_stale_rates_stop_the_stream() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        with pytest.raises(SetpointStreamStopped, match="no new pair of rates was supplied for"):
            async with flight.vehicle.gimbal.rates(-5.0, 0.0, valid_for_s=1.0):
                await anyio.sleep(3.0)
        assert math.degrees(gimbal.angles()[1]) == pytest.approx(-5.5, abs=1.0)
        with pytest.raises(SetpointStreamStopped, match="the event loop was blocked"):
            async with flight.vehicle.gimbal.rates(-5.0, 0.0, valid_for_s=9.0):
                await anyio.sleep(0.3)
                block_loop(2.0)
                await anyio.sleep(1.0)
        with pytest.raises(SetpointStreamStopped, match="the vehicle has been silent"):
            async with flight.vehicle.gimbal.rates(-5.0, 0.0, valid_for_s=30.0):
                flight.copter.faults.silent = True
                await anyio.sleep(8.0)
        flight.copter.faults.silent = False
        await anyio.sleep(3.0)


@pytest.mark.parametrize("silence_s", [0.0, 30.0])
async def test_silent_manager_stops_rates(silence_s: float) -> None:
    gimbal = SimulatedGimbal(yaw_deg=(-9999.0, 9999.0))
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        began = now()
        with pytest.raises(SetpointStreamStopped, match="manager has been silent for 3"):
            async with flight.vehicle.gimbal.rates(0.0, 5.0) as stream:
                await stream.turn(0.0, 5.0, 6.0)
                assert stream.is_running
                gimbal.faults.silent = True
                await stream.turn(0.0, 5.0, 9.0)
        assert now() - began == pytest.approx(9.5, abs=1.0)
        await anyio.sleep(silence_s)
        gimbal.faults.silent = False
        await anyio.sleep(3.0)
        here = gimbal.angles()
        await anyio.sleep(2.0)
        assert gimbal.angles() == here


async def test_newer_order_stops_rates_without_zero() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        with pytest.raises(SetpointStreamStopped, match="another order was given"):
            async with flight.vehicle.gimbal.rates(-5.0, 0.0) as stream:
                await anyio.sleep(0.3)
                await flight.vehicle.gimbal.point(-30.0, 0.0, frame="vehicle")
                stream.set(1.0, 1.0)
        await anyio.sleep(2.0)
        assert math.degrees(gimbal.angles()[1]) == pytest.approx(-30, abs=0.5)


async def test_lost_control_stops_rates() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight, flight.vehicle.gimbal.control():
        with pytest.raises(GimbalTaken):
            async with flight.vehicle.gimbal.rates(-5.0, 0.0) as stream:
                await anyio.sleep(0.3)
                takes_control(flight)
                await anyio.sleep(0.3)
                flight.wire.clear()
                await stream.turn(-5.0, 0.0, 1.0)
        assert not flight.wire.all(m.GimbalManagerSetPitchyaw)
        assert not flight.wire.commands(PITCHYAW)


async def test_denied_rates_claim_control() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        async with flight.vehicle.gimbal.rates(-5.0, 0.0) as stream:
            await stream.turn(-5.0, 0.0, 1.0)
        assert gimbal.primary == own_ids(flight)
        assert math.degrees(gimbal.angles()[1]) == pytest.approx(-5, abs=1)


async def test_old_mount_does_not_support_rates() -> None:
    async with open_flight() as flight:
        flight.copter.faults.refuse(PITCHYAW, MavResult.UNSUPPORTED)
        with pytest.raises(NotSupported, match="which is needed for rates"):
            async with flight.vehicle.gimbal.rates():
                pass
        assert not flight.wire.all(m.GimbalManagerSetPitchyaw)


async def test_px4_rates_use_set_attitude() -> None:
    async with open_px4() as flight:
        flight.px4.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        async with flight.vehicle.gimbal.rates(-5.0, 0.0) as stream:
            await stream.turn(-5.0, 10.0, 1.0)
        assert not flight.wire.all(m.GimbalManagerSetPitchyaw)
        sent = flight.wire.all(m.GimbalManagerSetAttitude)[5]  # The last messages have a rate of zero.
        assert all(map(math.isnan, sent.q))
        assert math.degrees(sent.angular_velocity_y) == pytest.approx(-5.0)
        assert math.degrees(sent.angular_velocity_z) == pytest.approx(10.0)


async def test_rates_are_validated_and_entered_once() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        gimbal = flight.vehicle.gimbal
        for wrong in (
            {"pitch_deg_s": 800.0},
            {"yaw_deg_s": math.nan},
            {"rate_hz": 1.0},
            {"valid_for_s": 99.0},
        ):
            with pytest.raises(InvalidArgument):
                gimbal.rates(**wrong)  # type: ignore[arg-type]
        assert not flight.wire.commands(PITCHYAW)
        stream = gimbal.rates()
        with pytest.raises(SetpointStreamStopped, match="inside its `async with`"):
            stream.set(1.0, 1.0)
        async with stream:
            with pytest.raises(InvalidArgument):
                stream.set(999.0, 0.0)
            with pytest.raises(BusyError, match="once"):
                await stream.__aenter__()
        assert isinstance(errors.GimbalTaken("x", system_id=1, component_id=2), errors.OperationRejected)


# ----------------------------------------------------------------------------------------------- PX4


@asynccontextmanager
async def px4_with_gimbal() -> AsyncIterator[Px4Flight]:
    async with open_px4(SimulatedPx4(boot_time_s=1.0, parameters={"MNT_MODE_IN": 4.0})) as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


async def test_px4_control_uses_explicit_ids() -> None:
    async with px4_with_gimbal() as flight:
        gimbal = flight.vehicle.gimbal
        assert await flight.vehicle.gimbals.discover() == (1,)
        assert (await gimbal.information()).pitch_deg == (-45.0, 45.0)
        async with gimbal.control():
            assert flight.px4.gimbal.in_control == (255, 190)
            await gimbal.point(-30.0, 90.0)
            await gimbal.point(-20.0, 10.0, frame="vehicle")
            await gimbal.neutral()
            async with gimbal.rates() as stream:
                await stream.turn(-100.0, 100.0, 1.0)
            turned = flight.px4.gimbal.angles()
            await anyio.sleep(3.0)
            assert flight.px4.gimbal.angles() == turned
            assert math.degrees(turned[1]) == pytest.approx(-6, abs=2), "as slow as the real one"
        assert flight.px4.gimbal.in_control == (0, 0)
        assert not flight.wire.all(m.GimbalManagerSetPitchyaw)


async def test_px4_return_takes_control() -> None:
    async with px4_with_gimbal() as flight:
        await flight.take_off(20.0)
        with pytest.raises(GimbalTaken, match="no controller has control now"):
            async with flight.vehicle.gimbal.control() as control:
                await flight.vehicle.set_mode("RTL")
                assert await control.until_lost() == (0, 0)
                control.raise_if_taken()
        assert flight.px4.gimbal.in_control == (0, 0)


async def test_px4_look_at_position() -> None:
    async with px4_with_gimbal() as flight:
        await flight.take_off(20.0)
        there = flight.vehicle.position.value.offset(east_m=60.0, up_m=-20.0)
        await flight.vehicle.gimbal.look_at(there)
        assert flight.vehicle.gimbal.attitude.value.yaw_deg == pytest.approx(90, abs=6)
        assert not configured(flight)
        await flight.vehicle.gimbal.stop_looking()
