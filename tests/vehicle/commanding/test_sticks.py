"""Sticks: their bytes on both autopilots, what releases them, and what refuses them."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import Flight, block_loop, in_the_air, open_flight, open_px4

from aerokit import StickInput
from aerokit import messages as m
from aerokit.errors import BusyError, InvalidArgument, NotSupported, OperationRejected, SetpointStreamStopped
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedRover, SimulatedSub
from aerokit.sim.px4.modes import POSITION

pytestmark = pytest.mark.anyio

FORWARD = StickInput(forward=0.5)
RELEASE = (32767, 32767, 32767, 32767)


def axes(message: m.ManualControl) -> tuple[int, int, int, int]:
    return (message.x, message.y, message.z, message.r)


async def test_sticks_fly_copter_and_release_after_hold() -> None:
    async with in_the_air() as flight:
        async with flight.vehicle.sticks() as sticks:
            assert flight.vehicle.mode_name == "LOITER"
            await sticks.move(FORWARD, 4.0)
            assert axes(flight.wire.last(m.ManualControl)) == (500, 0, 500, 0)
            assert flight.copter.motion.velocity_north > 1.0
        assert flight.vehicle.mode_name == "BRAKE"
        assert axes(flight.wire.last(m.ManualControl)) == RELEASE
        flight.wire.clear()
        await anyio.sleep(2.0)
        assert not any(value for value, _ in flight.copter.rc._overrides.values())
        assert not flight.wire.all(m.ManualControl)


async def test_sticks_full_range_is_scaled() -> None:
    async with in_the_air() as flight, flight.vehicle.sticks() as sticks:
        await sticks.move(StickInput(-1, 1, -1, -1, buttons=5), 0.2)
        message = flight.wire.last(m.ManualControl)
        assert (*axes(message), message.buttons) == (-1000, 1000, 0, -1000, 5)
        await sticks.move(StickInput(throttle=1), 0.2)
        assert flight.wire.last(m.ManualControl).z == 1000


async def test_sticks_fly_px4_without_release_message() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        async with flight.vehicle.sticks() as sticks:
            assert flight.vehicle.mode_name == "POSCTL"
            await sticks.move(FORWARD, 4.0)
            assert flight.px4.motion.velocity_north > 1.0
        assert flight.vehicle.mode_name == "LOITER"
        assert RELEASE not in [axes(message) for message in flight.wire.all(m.ManualControl)]
        flight.wire.clear()
        await anyio.sleep(3.0)
        assert not flight.wire.all(m.ManualControl)


async def test_sticks_takeover_releases_without_hold() -> None:
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped, match="left LOITER for ALT_HOLD"):
            async with flight.vehicle.sticks() as sticks:
                flight.wire.clear()
                flight.pilot_takes_over(CopterMode.ALT_HOLD)
                await sticks.move(FORWARD, 5.0)
        assert axes(flight.wire.last(m.ManualControl)) == RELEASE
        await anyio.sleep(3.0)
        assert flight.wire.mode_orders() == []
        assert flight.vehicle.mode_name == "ALT_HOLD"


async def test_sticks_failsafe_ends_stream() -> None:
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped, match="RTL"):
            async with flight.vehicle.sticks() as sticks:
                flight.copter.set_mode(CopterMode.RTL)
                await sticks.move(FORWARD, 5.0)
        assert axes(flight.wire.last(m.ManualControl)) == RELEASE


async def test_sticks_without_new_positions_hold() -> None:
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped, match=r"no new stick position .* a hold was ordered"):
            async with flight.vehicle.sticks() as sticks:
                sticks.set(FORWARD)
                await anyio.sleep(2.0)
                assert not sticks.is_running
        await anyio.sleep(2.0)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_sticks_blocked_loop_releases() -> None:
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped, match="event loop was blocked"):
            async with flight.vehicle.sticks() as sticks:
                block_loop(1.0)
                await sticks.move(FORWARD, 2.0)
        assert axes(flight.wire.last(m.ManualControl)) == RELEASE


async def test_sticks_dead_program_returns_to_transmitter() -> None:
    async with in_the_air() as flight:
        with pytest.raises(SetpointStreamStopped):
            async with flight.vehicle.sticks() as sticks:
                await sticks.move(FORWARD, 1.0)
                flight.wire.lose()
                await anyio.sleep(2.5)
                assert flight.copter.rc[1] != 1500
                await anyio.sleep(1.0)
                assert flight.copter.rc[1] == 1500


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"MAV_GCS_SYSID": 254.0}, r"only from system 254 .* source_system=254"),
        ({"RC_OVERRIDE_TIME": -1.0}, "RC_OVERRIDE_TIME = -1, ArduPilot never releases the sticks"),
        ({"RC_OVERRIDE_TIME": 0.0}, "RC_OVERRIDE_TIME = 0, ArduPilot ignores stick positions"),
        ({"RC_OPTIONS": 2.0}, "bit 1 of RC_OPTIONS"),
    ],
)
async def test_sticks_refused_by_parameter_raise(changed: dict[str, float], reason: str) -> None:
    async with in_the_air() as flight:
        for name, value in changed.items():
            flight.copter.parameters[name] = value
        with pytest.raises(OperationRejected, match=reason):
            async with flight.vehicle.sticks():
                raise AssertionError("entered")
        assert not flight.wire.all(m.ManualControl)
        assert not flight.wire.mode_orders()
        async with flight.vehicle.guided.velocity():
            pass  # the place is free again


async def test_pilot_while_parameters_are_read_keeps_vehicle() -> None:
    async with in_the_air() as flight:
        flight.copter.faults.drop_incoming = 6
        flight.wire.clear()
        flight.pilot_takes_over(CopterMode.ALT_HOLD)
        with pytest.raises(OperationRejected, match="from GUIDED to ALT_HOLD; the order was not sent"):
            async with flight.vehicle.sticks():
                raise AssertionError("entered")
        assert not flight.wire.mode_orders()
        assert not flight.wire.all(m.ManualControl)


async def test_sticks_after_earlier_takeover_keep_pilot_who_orders_hold_mode() -> None:
    """The hold of the first stream was lost. The pilot chooses its mode while the second stream reads parameters."""
    async with in_the_air(latency_s=0.3) as flight:
        with anyio.move_on_after(4.0):
            async with flight.vehicle.sticks() as sticks:
                await sticks.move(FORWARD, 60.0)
        flight.copter.faults.ignore(MavCmd.DO_SET_MODE)
        flight.copter.set_mode(CopterMode.ALT_HOLD)
        await anyio.sleep(10.0)
        flight.copter.faults.commands.clear()
        reported_at = flight.vehicle.armed.updated_at
        await flight.vehicle.armed.wait_until(lambda _: flight.vehicle.armed.updated_at > reported_at)
        await anyio.sleep(0.6)  # of the second from one HEARTBEAT to the next
        asyncio.get_running_loop().call_later(0.05, flight.copter.set_mode, CopterMode.BRAKE)
        with pytest.raises(OperationRejected, match="the mode changed from ALT_HOLD to BRAKE"):
            async with flight.vehicle.sticks():
                pass
        assert flight.vehicle.mode_name == "BRAKE"


async def test_sticks_again_after_cancellation_accept_own_late_hold() -> None:
    """HEARTBEAT reports the hold of the first stream while the second one reads parameters."""
    async with in_the_air(latency_s=0.3) as flight:
        with anyio.move_on_after(4.0):
            async with flight.vehicle.sticks() as sticks:
                await sticks.move(FORWARD, 60.0)
        async with flight.vehicle.sticks() as sticks:
            await sticks.move(FORWARD, 4.0)
            assert flight.copter.motion.velocity_north > 1.0


@pytest.mark.parametrize("source", [0.0, 4.0])
async def test_px4_ignoring_mavlink_sticks_raises(source: float) -> None:
    async with open_px4() as flight:
        await flight.take_off()
        flight.px4.parameters["COM_RC_IN_MODE"] = source
        with pytest.raises(OperationRejected, match=f"COM_RC_IN_MODE = {source:g}"):
            async with flight.vehicle.sticks():
                raise AssertionError("entered")
        assert not flight.wire.all(m.ManualControl)


@pytest.mark.parametrize(
    "wrong",
    [StickInput(forward=1.1), StickInput(right=-1.1), StickInput(throttle=float("nan")), StickInput(buttons=65536)],
)
async def test_sticks_out_of_range_raise_before_sending(wrong: StickInput) -> None:
    async with in_the_air() as flight:
        with pytest.raises(InvalidArgument):
            async with flight.vehicle.sticks(wrong):
                raise AssertionError("entered")
        assert not flight.wire.sent
        async with flight.vehicle.sticks() as sticks:
            with pytest.raises(InvalidArgument):
                sticks.set(wrong)


async def test_sticks_unknown_mode_raises(grounded: Flight) -> None:
    with pytest.raises(InvalidArgument, match="NONSENSE"):
        grounded.vehicle.sticks(mode="NONSENSE")


async def test_sticks_unsupported_vehicle_raises(grounded: Flight) -> None:
    from aerokit.autopilots import Autopilot

    grounded.vehicle._session.autopilot = Autopilot(2)
    with pytest.raises(NotSupported, match="MANUAL_CONTROL"):
        async with grounded.vehicle.sticks():
            raise AssertionError("entered")


async def test_sticks_during_setpoint_stream_are_busy() -> None:
    async with in_the_air() as flight, flight.vehicle.guided.velocity():
        with pytest.raises(BusyError):
            async with flight.vehicle.sticks():
                raise AssertionError("entered")


async def test_sticks_other_mode_is_entered() -> None:
    async with in_the_air() as flight, flight.vehicle.sticks(mode="ALT_HOLD"):
        assert flight.vehicle.mode_name == "ALT_HOLD"


async def test_px4_pilot_change_ends_sticks() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with pytest.raises(SetpointStreamStopped, match="left STABILIZED for POSCTL"):
            async with flight.vehicle.sticks(mode="STABILIZED") as sticks:
                flight.px4.switch_to(POSITION)
                await sticks.move(StickInput(), 5.0)


async def test_rover_throttle_is_signed() -> None:
    rover = SimulatedRover(boot_time_s=0.0)
    async with open_flight(rover) as flight, flight.vehicle.sticks(StickInput(throttle=-0.5)):  # type: ignore[arg-type]
        assert flight.wire.last(m.ManualControl).z == -500


async def test_sub_release_overrides_channels() -> None:
    sub = SimulatedSub(boot_time_s=0.0)
    async with open_flight(sub) as flight:  # type: ignore[arg-type]
        async with flight.vehicle.sticks():
            assert flight.wire.last(m.ManualControl).z == 500
        release = flight.wire.last(m.RcChannelsOverride)
        assert [release.chan1_raw, release.chan8_raw, release.chan9_raw, release.chan18_raw] == [0, 0, 65534, 65535]
        await anyio.sleep(0.1)
        assert not any(value for value, _ in sub.rc._overrides.values())
