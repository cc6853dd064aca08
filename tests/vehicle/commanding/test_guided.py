"""Set-point streams: their messages, and their end when the program stops supplying set-points."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Px4Flight, block_loop, in_the_air, now, open_flight, open_px4, speed_of

from aerokit import Position, missions
from aerokit import messages as m
from aerokit.errors import (
    BusyError,
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    NotSupported,
    SetpointStreamStopped,
    StaleValueError,
)
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.sim import SimulatedPx4
from aerokit.sim.px4.modes import POSITION
from aerokit.vehicle.commanding.guided import SetpointStream
from aerokit.vehicle.commanding.setpoints import (
    AccelerationSetpoint,
    ActuatorSetpoint,
    AttitudeRateSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    TrajectorySetpoint,
    VelocitySetpoint,
)

pytestmark = pytest.mark.anyio

BRAKE, GUIDED, LOITER = CopterMode.BRAKE, CopterMode.GUIDED, CopterMode.LOITER
NORTH = VelocitySetpoint(north_m_s=3.0)


async def sends_nothing(flight: Flight, seconds: float = 6.0) -> None:
    """Assert that nothing more is sent and the vehicle stands still in its hold mode."""
    flight.wire.clear()
    await anyio.sleep(seconds)
    assert flight.wire.setpoints() == []


# ---------------------------------------------------------------------------- bytes on the wire


async def first_sent(flight: Flight, stream: SetpointStream[Any], setpoint: object = None) -> Any:
    async with stream:
        flight.wire.clear()
        if setpoint is not None:
            stream.set(setpoint)
        await anyio.sleep(0.25)
        return flight.wire.setpoints()[-1][1]


@pytest.mark.parametrize(
    ("setpoint", "mask", "yaw", "yaw_rate"),
    [
        (VelocitySetpoint(1.0, -2.0, 0.5), 0xDC7, 0.0, 0.0),
        (VelocitySetpoint(1.0, -2.0, 0.5, yaw_deg=90.0), 0x9C7, math.pi / 2, 0.0),
        (VelocitySetpoint(1.0, -2.0, 0.5, yaw_rate_deg_s=18.0), 0x5C7, 0.0, math.pi / 10),
    ],
)
async def test_velocity(flying: Flight, setpoint: VelocitySetpoint, mask: int, yaw: float, yaw_rate: float) -> None:
    sent = await first_sent(flying, flying.vehicle.guided.velocity(), setpoint)
    assert isinstance(sent, m.SetPositionTargetLocalNed)
    assert (sent.target_system, sent.target_component, sent.coordinate_frame) == (1, 1, 1)
    assert sent.type_mask == mask
    assert (sent.vx, sent.vy, sent.vz) == (1.0, -2.0, 0.5)
    assert (sent.x, sent.y, sent.z, sent.afx, sent.afy, sent.afz) == (0,) * 6
    assert (sent.yaw, sent.yaw_rate) == pytest.approx((yaw, yaw_rate))


async def test_body_velocity(flying: Flight) -> None:
    sent = await first_sent(flying, flying.vehicle.guided.body_velocity(), BodyVelocitySetpoint(2.0, 1.0, -0.5))
    assert isinstance(sent, m.SetPositionTargetLocalNed)
    assert (sent.coordinate_frame, sent.type_mask) == (8, 0xDC7)
    assert (sent.vx, sent.vy, sent.vz) == (2.0, 1.0, -0.5)


async def test_acceleration(flying: Flight) -> None:
    sent = await first_sent(flying, flying.vehicle.guided.acceleration(), AccelerationSetpoint(0.5, 0.25, -0.125))
    assert isinstance(sent, m.SetPositionTargetLocalNed)
    assert (sent.coordinate_frame, sent.type_mask) == (1, 0xC3F)
    assert (sent.afx, sent.afy, sent.afz) == (0.5, 0.25, -0.125)
    assert (sent.x, sent.y, sent.z, sent.vx, sent.vy, sent.vz) == (0,) * 6


async def test_local_position(flying: Flight) -> None:
    sent = await first_sent(flying, flying.vehicle.guided.local_position(LocalPositionSetpoint(5.0, 6.0, -12.0)))
    assert isinstance(sent, m.SetPositionTargetLocalNed)
    assert (sent.coordinate_frame, sent.type_mask) == (1, 0xDF8)
    assert (sent.x, sent.y, sent.z) == (5.0, 6.0, -12.0)


@pytest.mark.parametrize("above_sea", [False, True])
async def test_global_position(flying: Flight, above_sea: bool) -> None:
    altitude = {"altitude_amsl_m": 600.0} if above_sea else {"altitude_relative_m": 12.0}
    place = Position(-35.3630000, 149.1652000, **altitude)
    sent = await first_sent(flying, flying.vehicle.guided.position(PositionSetpoint(place, yaw_deg=180.0)))
    assert isinstance(sent, m.SetPositionTargetGlobalInt)
    assert (sent.coordinate_frame, sent.type_mask) == (5 if above_sea else 6, 0x9F8)
    assert (sent.lat_int, sent.lon_int, sent.alt) == (-353630000, 1491652000, 600.0 if above_sea else 12.0)
    assert sent.yaw == pytest.approx(math.pi)


async def test_attitude(flying: Flight) -> None:
    sent = await first_sent(flying, flying.vehicle.guided.attitude(AttitudeSetpoint(0.0, -10.0, 90.0, 0.5)))
    assert isinstance(sent, m.SetAttitudeTarget)
    assert (sent.target_system, sent.type_mask, sent.thrust) == (1, 0x07, 0.5)
    cos, sin, root = math.cos(math.radians(5.0)), math.sin(math.radians(5.0)), math.sqrt(0.5)
    assert sent.q == pytest.approx((cos * root, sin * root, -sin * root, cos * root), abs=1e-6)
    assert (sent.body_roll_rate, sent.body_pitch_rate, sent.body_yaw_rate) == (0, 0, 0)


async def test_attitude_rate(flying: Flight) -> None:
    setpoint = AttitudeRateSetpoint(-10.0, 20.0, 90.0, 0.25)
    sent = await first_sent(flying, flying.vehicle.guided.attitude_rate(setpoint, valid_for_s=1.0))
    assert isinstance(sent, m.SetAttitudeTarget)
    assert (sent.target_system, sent.type_mask, sent.thrust) == (1, 0x80, 0.25)
    rates = (sent.body_roll_rate, sent.body_pitch_rate, sent.body_yaw_rate)
    assert rates == pytest.approx((-math.pi / 18, math.pi / 9, math.pi / 2))


async def test_trajectory(flying: Flight) -> None:
    setpoint = TrajectorySetpoint(1.0, 2.0, -10.0, 0.5, 0.25, -0.125, 0.0625, 0.03125, -0.5, yaw_deg=90.0)
    sent = await first_sent(flying, flying.vehicle.guided.trajectory(setpoint))
    assert isinstance(sent, m.SetPositionTargetLocalNed)
    assert (sent.coordinate_frame, sent.type_mask) == (1, 0x800)
    assert (sent.x, sent.y, sent.z, sent.vx, sent.vy, sent.vz) == (1.0, 2.0, -10.0, 0.5, 0.25, -0.125)
    assert (sent.afx, sent.afy, sent.afz) == (0.0625, 0.03125, -0.5)


async def test_attitude_rate_is_flown(flying: Flight) -> None:
    async with flying.vehicle.guided.attitude_rate(rate_hz=100.0) as stream:
        await stream.fly(AttitudeRateSetpoint(roll_deg_s=10.0), 1.0)
        assert math.degrees(flying.copter.motion.roll) == pytest.approx(10.0, abs=1.5)
        assert flying.copter.motion.velocity_east > 0.2


async def test_trajectory_with_velocity_lags_less_than_position(flying: Flight) -> None:
    """A point that moves north at 2 m/s is followed within half a metre."""
    here = flying.copter.motion
    north, east, down, started = here.north, here.east, here.down, now()

    def place(moving: bool) -> TrajectorySetpoint:
        return TrajectorySetpoint(north + 2.0 * (now() - started), east, down, north_m_s=2.0 * moving)

    async with flying.vehicle.guided.trajectory(place(True)) as stream:
        for _ in range(200):
            stream.set(place(True))
            await anyio.sleep(0.05)
        assert here.north == pytest.approx(place(True).north_m, abs=0.5)


async def test_actuators_of_new_firmware_raise_not_supported(flying: Flight) -> None:
    with pytest.raises(NotSupported, match="ArduCopter ignores SET_ACTUATOR_CONTROL_TARGET"):
        flying.vehicle.guided.actuators(ActuatorSetpoint((0.0,) * 8))
    assert flying.wire.setpoints() == []


async def test_px4_actuators_of_unknown_version_raise_not_supported() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0, version="1.13.3")
    px4.faults.lose(m.AutopilotVersion, times=1_000)
    async with open_px4(px4) as flight:
        with pytest.raises(NotSupported, match="the version of PX4 is not known yet; only PX4"):
            flight.vehicle.guided.actuators(ActuatorSetpoint((0.0,) * 8))


async def test_px4_actuators_of_old_firmware_are_flown() -> None:
    async with open_px4(SimulatedPx4(boot_time_s=1.0, version="1.13.3")) as flight:
        await flight.vehicle.version.wait_until(lambda version: version.number[:2] == (1, 13))
        stream = flight.vehicle.guided.actuators(ActuatorSetpoint((0.5, *(0.0,) * 7), group=1))
        sent: Any = stream._encode(stream._value)
        assert (sent.group_mlx, sent.target_system, tuple(sent.controls)) == (1, 1, (0.5, *(0.0,) * 7))
        with pytest.raises(InvalidArgument, match="8 numbers"):
            async with flight.vehicle.guided.actuators(ActuatorSetpoint((0.5,))):
                raise AssertionError("entered")
        await flight.take_off()
        climb = ActuatorSetpoint((0.0, 0.0, 0.0, 0.7, *(0.0,) * 4))
        async with flight.vehicle.guided.actuators(climb) as actuators:
            await actuators.fly(climb, 2.0)
            assert flight.px4.motion.velocity_down < -1.0


async def test_px4_attitude_rate_is_flown() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        async with flight.vehicle.guided.attitude_rate() as stream:
            await stream.fly(AttitudeRateSetpoint(roll_deg_s=10.0, thrust=0.5), 1.0)
            assert math.degrees(flight.px4.motion.roll) > 5.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("rate_hz", [400.0, 2.0, 10.0, 40.0])
async def test_setpoint_stream_rate_is_kept(flying: Flight, rate_hz: float) -> None:
    async with flying.vehicle.guided.velocity(rate_hz=rate_hz) as stream:
        flying.wire.clear()
        await stream.fly(NORTH, 5.0)
        times = [at for at, _ in flying.wire.setpoints()]
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert gaps == pytest.approx([1 / rate_hz] * len(gaps), abs=1e-6)
    assert len(times) == pytest.approx(5.0 * rate_hz, abs=1)


# ---------------------------------------------------------------------------------- behaviour


async def test_setpoint_stream_is_flown(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity() as stream:
        await stream.fly(NORTH, 6.0)
        assert flying.copter.motion.velocity_north == pytest.approx(3.0, abs=0.1)
        await stream.fly(VelocitySetpoint(east_m_s=-2.0), 6.0)
        assert flying.copter.motion.velocity_east == pytest.approx(-2.0, abs=0.1)
    assert flying.vehicle.mode_name == "BRAKE"


async def test_body_velocity_is_in_body_frame(flying: Flight) -> None:
    await flying.vehicle.set_heading(90.0, tolerance_deg=0.5)
    async with flying.vehicle.guided.body_velocity() as stream:
        await stream.fly(BodyVelocitySetpoint(forward_m_s=2.0), 6.0)
        assert flying.copter.motion.velocity_east == pytest.approx(2.0, abs=0.2)


async def test_body_velocity_with_heading_keeps_heading(flying: Flight) -> None:
    """In MAV_FRAME_BODY_NED ArduPilot measures yaw from the nose; users give degrees from north."""
    await flying.vehicle.set_heading(40.0)
    async with flying.vehicle.guided.body_velocity() as stream:
        await stream.fly(BodyVelocitySetpoint(forward_m_s=2.0, yaw_deg=180.0), 10.0)
        assert abs(math.degrees(flying.copter.motion.yaw)) == pytest.approx(180.0, abs=3.0)
        assert flying.copter.motion.velocity_north == pytest.approx(-2.0, abs=0.2)


async def test_body_velocity_with_old_heading_is_not_sent(flying: Flight) -> None:
    async with flying.vehicle.guided.body_velocity(valid_for_s=10.0) as stream:
        for message_type in (m.GlobalPositionInt, m.VfrHud):
            flying.copter.faults.lose(message_type, times=1000)
        await anyio.sleep(3.0)
        with pytest.raises(StaleValueError, match="heading_deg"):
            stream.set(BodyVelocitySetpoint(forward_m_s=2.0, yaw_deg=180.0))
        flying.wire.clear()
        await anyio.sleep(1.0)
        assert {(sent.vx, sent.vy) for sent in flying.wire.all(m.SetPositionTargetLocalNed)} == {(0.0, 0.0)}


async def test_setpoint_stream_entry_changes_to_guided(flying: Flight) -> None:
    flying.pilot_takes_over()
    await anyio.sleep(1.0)
    async with flying.vehicle.guided.local_position(LocalPositionSetpoint(10.0, 0.0, -10.0)) as stream:
        assert flying.vehicle.mode_name == "GUIDED"
        await stream.fly(LocalPositionSetpoint(10.0, 0.0, -10.0), 12.0)
        assert flying.copter.motion.north == pytest.approx(10.0, abs=0.5)


# ------------------------------------------------------------------------ end of the stream


async def test_block_left_normally_vehicle_holds(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity() as stream:
        await stream.fly(NORTH, 3.0)
    assert not stream.is_running
    assert flying.vehicle.mode_name == "BRAKE"
    await sends_nothing(flying)
    assert speed_of(flying.copter) < 0.1


async def test_setpoint_stream_body_raises_holds(flying: Flight) -> None:
    with pytest.raises(ZeroDivisionError):
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, 3.0)
            _ = 1 / 0
    assert flying.wire.mode_orders()[-1] == BRAKE  # The hold was sent before the exception left the block.
    await sends_nothing(flying)
    assert flying.copter.mode.number == BRAKE
    assert speed_of(flying.copter) < 0.1


async def test_setpoint_stream_cancelled_holds(flying: Flight) -> None:
    async def fly_on() -> None:
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, math.inf)

    with anyio.move_on_after(4.0):
        await fly_on()
    assert flying.wire.mode_orders()[-1] == BRAKE
    await sends_nothing(flying)
    assert flying.copter.mode.number == BRAKE


async def test_setpoint_stream_cancelled_while_entering_holds() -> None:
    async with in_the_air(latency_s=0.5) as flying:
        flying.pilot_takes_over()
        await anyio.sleep(2.0)
        with anyio.move_on_after(0.7) as scope:
            async with flying.vehicle.guided.velocity():
                raise AssertionError("entered too early")
        assert scope.cancelled_caught
        await anyio.sleep(3.0)
        assert flying.copter.mode.number == BRAKE
        await sends_nothing(flying)


async def test_program_cancelled_leaves_nothing() -> None:
    """The hold command is sent although the connection and the loop are about to end."""
    flight: Flight | None = None
    with anyio.move_on_after(30.0):
        async with in_the_air() as flight, flight.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, math.inf)
    assert flight is not None
    assert flight.wire.mode_orders() == [GUIDED, BRAKE] or flight.wire.mode_orders() == [BRAKE]


async def test_setpoint_stream_not_fed_stops(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match=r"no new set-point was supplied for 1\.\d s \(valid_for_s = 1\)"):
        async with flying.vehicle.guided.velocity(valid_for_s=1.0) as stream:
            stream.set(NORTH)
            fed_at = now()
            await anyio.sleep(5.0)
            assert not stream.is_running
            last = flying.wire.setpoints()[-1][0]
            assert fed_at + 0.8 <= last <= fed_at + 1.01
            assert flying.copter.mode.number == BRAKE
    await sends_nothing(flying)


async def test_setpoint_stream_program_error_is_cause_of_stop(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match=r"has stopped: AssertionError\(\)") as caught:
        async with flying.vehicle.guided.velocity() as stream:
            stream._message = None
            await anyio.sleep(1.0)
    assert isinstance(caught.value.__cause__, AssertionError)


async def test_setpoint_stream_stop_is_raised_once(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity(valid_for_s=0.5) as stream:
        await anyio.sleep(2.0)
        with pytest.raises(SetpointStreamStopped, match="a hold was ordered"):
            stream.set(NORTH)
    await sends_nothing(flying)


async def test_setpoint_stream_exit_by_exception_keeps_it(flying: Flight) -> None:
    with pytest.raises(ZeroDivisionError):
        async with flying.vehicle.guided.velocity(valid_for_s=0.5):
            await anyio.sleep(2.0)
            _ = 1 / 0


async def test_setpoint_stream_fly_raises_when_stopped(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity() as stream, anyio.create_task_group() as tasks:

        async def pilot() -> None:
            await anyio.sleep(2.0)
            flying.pilot_takes_over()

        tasks.start_soon(pilot)
        with pytest.raises(SetpointStreamStopped, match="left GUIDED for LOITER"):
            await stream.fly(NORTH, 60.0)


async def test_setpoint_stream_loop_blocked_stops(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match=r"event loop was blocked for 1\.\d s; a hold was ordered"):
        async with flying.vehicle.guided.velocity(valid_for_s=60.0, max_lag_s=0.5) as stream:
            stream.set(NORTH)
            await anyio.sleep(2.0)
            flying.wire.clear()
            block_loop(2.0)
            await anyio.sleep(1.0)
            assert not stream.is_running
            assert not flying.wire.setpoints()  # no stale one after the blockade
            assert flying.wire.mode_orders()[0] == BRAKE
    await sends_nothing(flying)
    assert flying.copter.mode.number == BRAKE


async def test_setpoint_stream_short_loop_delay_continues(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity(max_lag_s=0.5) as stream:
        await stream.fly(NORTH, 1.0)
        flying.wire.clear()
        block_loop(0.4)
        await stream.fly(NORTH, 1.0)
        assert stream.is_running
        assert len(flying.wire.setpoints()) <= 12  # Missed set-points are not sent in a burst.


async def test_setpoint_stream_pilot_takes_over_stops(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match="left GUIDED for LOITER") as caught:
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, 3.0)
            flying.pilot_takes_over()
            await anyio.sleep(1.0)
    assert "a hold was ordered" not in str(caught.value)
    assert BRAKE not in flying.wire.mode_orders()
    await sends_nothing(flying)
    assert flying.copter.mode.number == LOITER


async def test_setpoint_stream_takeover_before_exit_sends_no_hold() -> None:
    """The stream has not noticed the takeover yet; the pilot keeps control."""
    async with in_the_air() as flying:
        with pytest.raises(SetpointStreamStopped, match="left GUIDED for LOITER"):
            async with flying.vehicle.guided.velocity(rate_hz=2.0) as stream:
                await stream.fly(NORTH, 3.05)
                flying.pilot_takes_over()
                await flying.vehicle.mode.wait_until(lambda mode: mode.name == "LOITER")
                assert stream.is_running
        await anyio.sleep(2.0)
        assert BRAKE not in flying.wire.mode_orders()
        assert flying.copter.mode.number == LOITER


async def test_land_ends_with_disarming(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match="disarmed"):
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, 1.0)
            flying.copter.arming.disarm()
            await stream.fly(NORTH, 3.0)
    await sends_nothing(flying)


async def test_setpoint_stream_survives_disarm_and_arm(grounded: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match="disarmed"):
        async with grounded.vehicle.guided.velocity(valid_for_s=60.0) as stream:
            await grounded.vehicle.arm()
            await anyio.sleep(3.0)
            assert stream.is_running
            grounded.copter.arming.disarm()
            await stream.fly(VelocitySetpoint(), 3.0)
    await sends_nothing(grounded)


async def test_setpoint_stream_connection_lost_raises(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match="cable was unplugged") as caught:
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, 1.0)
            flying.wire.lose()
            await anyio.sleep(1.0)
            assert not stream.is_running
    assert "a hold was ordered" not in str(caught.value)


async def test_setpoint_stream_vehicle_silent_stops(flying: Flight) -> None:
    with pytest.raises(SetpointStreamStopped, match=r"silent for .*; a hold will be ordered after the next HEARTBEAT"):
        async with flying.vehicle.guided.velocity() as stream:
            await stream.fly(NORTH, 1.0)
            flying.copter.faults.silent = True
            await stream.fly(NORTH, 30.0)


# --------------------------------------------------------------------------------- entering


async def test_setpoint_stream_mode_refused_raises_without_hold(flying: Flight) -> None:
    flying.pilot_takes_over()
    await anyio.sleep(1.0)
    flying.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.FAILED, "Mode change to GUIDED failed: no")
    with pytest.raises(CommandRejected, match="Mode change to GUIDED failed: no"):
        async with flying.vehicle.guided.velocity():
            raise AssertionError("entered")
    await anyio.sleep(3.0)
    assert flying.wire.mode_orders() == [GUIDED]
    assert flying.wire.setpoints() == []


async def test_set_mode_silent_vehicle_times_out(flying: Flight) -> None:
    flying.pilot_takes_over()
    await anyio.sleep(1.0)
    flying.copter.faults.silent = True
    with pytest.raises(CommandTimeout):
        async with flying.vehicle.guided.velocity():
            raise AssertionError("entered")


async def test_setpoint_stream_outside_block_or_reused_raises(flying: Flight) -> None:
    stream = flying.vehicle.guided.velocity()
    with pytest.raises(SetpointStreamStopped, match="not running"):
        stream.set(NORTH)
    async with stream:
        pass
    with pytest.raises(SetpointStreamStopped):
        stream.set(NORTH)
    with pytest.raises(SetpointStreamStopped):
        async with stream:
            raise AssertionError("entered twice")
    await sends_nothing(flying)


BAD: list[Callable[[Any], object]] = [
    lambda guided: guided.velocity(rate_hz=1.0),
    lambda guided: guided.velocity(rate_hz=401.0),
    lambda guided: guided.velocity(rate_hz=math.nan),
    lambda guided: guided.velocity(valid_for_s=0.0),
    lambda guided: guided.velocity(valid_for_s=math.inf),
    lambda guided: guided.velocity(max_lag_s=-1.0),
]


@pytest.mark.parametrize("make", BAD)
async def test_wrong_arguments(grounded: Flight, make: Callable[[Any], object]) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed"):
        make(grounded.vehicle.guided)


async def test_second_setpoint_stream_raises_busy(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity() as stream:
        with pytest.raises(BusyError, match="another set-point stream is open"):
            async with flying.vehicle.guided.body_velocity():
                raise AssertionError("entered")
        assert stream.is_running


async def test_block_left_after_silence_warns_nothing_was_sent(flying: Flight) -> None:
    """The silence is too short to stop the stream, and too long to exclude a takeover."""
    with pytest.raises(SetpointStreamStopped, match=r"silent for (2\.[5-9]|3\.\d) s"):
        async with flying.vehicle.guided.velocity() as stream:
            flying.copter.faults.silent = True
            while flying.vehicle.heartbeat_age <= 2.6:
                await stream.fly(NORTH, 0.1)
            flying.wire.clear()
    assert not flying.wire.mode_orders()


async def test_invalid_setpoints_raise_before_sending(flying: Flight) -> None:
    guided = flying.vehicle.guided
    for stream in (
        guided.velocity(VelocitySetpoint(math.nan)),
        guided.velocity(VelocitySetpoint(1e39)),  # finite, and no float of MAVLink
        guided.velocity(VelocitySetpoint(1.0, yaw_deg=1.0, yaw_rate_deg_s=1.0)),
        guided.acceleration(AccelerationSetpoint(math.inf)),
        guided.local_position(LocalPositionSetpoint(0.0, math.nan, 0.0)),
        guided.attitude(AttitudeSetpoint(0.0, 0.0, 0.0, 1.1)),
        guided.attitude(AttitudeSetpoint(math.nan, 0.0, 0.0, 0.5)),
        guided.attitude_rate(AttitudeRateSetpoint(roll_deg_s=3601.0)),
        guided.attitude_rate(AttitudeRateSetpoint(thrust=-0.1)),
        guided.trajectory(TrajectorySetpoint(0.0, 0.0, 0.0, north_m_s=math.nan)),
    ):
        with pytest.raises(InvalidArgument):
            async with stream:
                raise AssertionError("entered")
    await anyio.sleep(1.0)
    assert not flying.wire.mode_orders()
    assert not flying.wire.setpoints()


async def test_invalid_setpoint_keeps_previous(flying: Flight) -> None:
    async with flying.vehicle.guided.velocity(valid_for_s=5.0) as stream:
        stream.set(NORTH)
        for wrong in (math.nan, 1e39):
            with pytest.raises(InvalidArgument):
                stream.set(VelocitySetpoint(wrong))
        flying.wire.clear()
        await anyio.sleep(1.0)
        assert {message.vx for message in flying.wire.all(m.SetPositionTargetLocalNed)} == {3.0}


async def test_unsupported_setpoint_kinds_raise() -> None:
    """ArduPlane obeys attitudes only; a velocity would be ignored."""
    from aerokit.autopilots import ArduPlane

    async with open_flight() as flight:
        flight.vehicle._session.autopilot = ArduPlane(1)
        with pytest.raises(NotSupported, match=r"velocity.*attitude"):
            async with flight.vehicle.guided.velocity():
                raise AssertionError("entered")
        assert not flight.wire.mode_orders()


# -------------------------------------------------------------------------------------- PX4


async def px4_in_the_air(flight: Px4Flight) -> None:
    await flight.take_off()


async def test_px4_stream_starts_before_offboard_request() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        async with flight.vehicle.guided.velocity(rate_hz=20.0) as stream:
            first = flight.wire.setpoints()[0][0]
            asked = next(
                at
                for at, message in flight.wire.sent
                if isinstance(message, m.CommandLong) and message.command == MavCmd.DO_SET_MODE
            )
            assert asked - first >= 0.9
            await stream.fly(NORTH, 6.0)
            assert flight.px4.motion.velocity_north == pytest.approx(3.0, abs=0.3)
        assert flight.vehicle.mode_name == "LOITER"
        flight.wire.clear()
        await anyio.sleep(5.0)
        assert not flight.wire.setpoints()


async def test_px4_refuses_offboard() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        flight.px4.faults.refuse(MavCmd.DO_SET_MODE, MavResult.DENIED, "Offboard denied")
        with pytest.raises(CommandRejected, match="Offboard denied"):
            async with flight.vehicle.guided.velocity():
                raise AssertionError("entered")
        flight.wire.clear()
        await anyio.sleep(5.0)
        assert not flight.wire.setpoints()
        assert flight.vehicle.mode_name == "LOITER"


async def test_px4_stream_stopped_during_offboard_request_raises() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        asyncio.get_running_loop().call_later(1.005, block_loop, 1.5)
        with pytest.raises(SetpointStreamStopped, match=r"event loop was blocked for 1\.\d s; a hold was ordered"):
            async with flight.vehicle.guided.velocity(NORTH, valid_for_s=5):
                raise AssertionError("entered")


async def test_px4_setpoint_stream_exit_by_exception_holds() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        with pytest.raises(ZeroDivisionError):
            async with flight.vehicle.guided.velocity() as stream:
                await stream.fly(NORTH, 3.0)
                _ = 1 / 0
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "LOITER"
        flight.wire.clear()
        await anyio.sleep(5.0)
        assert not flight.wire.setpoints()
        assert math.hypot(flight.px4.motion.velocity_north, flight.px4.motion.velocity_east) < 0.2


async def test_px4_setpoint_stream_cancelled_while_entering_holds() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        for seconds in (0.5, 1.01, 1.3):
            with anyio.move_on_after(seconds):
                async with flight.vehicle.guided.velocity(NORTH):
                    await anyio.sleep(0.05)
            await anyio.sleep(6.0)
            assert flight.vehicle.mode_name == "LOITER"
            flight.wire.clear()
            await anyio.sleep(3.0)
            assert not flight.wire.setpoints()


async def test_following_cancelled_without_target_keeps_mode_of_other_station() -> None:
    """The other station has chosen the mode that the stream would have set."""
    async with in_the_air() as flight:
        assert flight.copter.set_mode(LOITER)
        await anyio.sleep(2.0)
        asyncio.get_running_loop().call_later(1.0, flight.copter.set_mode, GUIDED)
        with anyio.move_on_after(3.0) as scope:
            async with flight.vehicle.follow(lambda: None, valid_for_s=5):
                raise AssertionError("entered")
        assert scope.cancelled_caught
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "GUIDED"


async def test_px4_entry_cancelled_before_offboard_request_keeps_pilot() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        flight.px4.switch_to(POSITION)
        await anyio.sleep(2.0)
        with anyio.move_on_after(0.5):
            async with flight.vehicle.guided.velocity(NORTH):
                raise AssertionError("entered")
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "POSCTL"


@pytest.mark.sampled(2)
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.6, 0.9])
async def test_setpoint_stream_stops_after_silence(
    phase: float,
) -> None:
    """The result does not depend on the phase of the one-second silence check."""
    async with in_the_air() as flight:
        await anyio.sleep(phase)
        silent_since = math.inf
        with pytest.raises(SetpointStreamStopped, match="silent"):
            async with flight.vehicle.guided.velocity() as stream:
                await stream.fly(NORTH, 2.0)
                flight.copter.faults.silent = True
                silent_since = now() - flight.vehicle.heartbeat_age
                await stream.fly(NORTH, 8.0)
        assert max(at for at, _ in flight.wire.setpoints()) - silent_since <= 3.5
        assert flight.vehicle.is_silent


async def test_px4_mission_cancelled_before_mode_request_keeps_pilot() -> None:
    async with open_px4() as flight:
        await flight.take_off()
        here = flight.vehicle.position.value
        place = missions.waypoint(here.latitude_deg, here.longitude_deg, altitude_relative_m=20)
        await flight.vehicle.mission.upload(missions.Mission([place, place]))
        flight.px4.switch_to(POSITION)
        await anyio.sleep(2.0)
        flight.px4.faults.silent = True
        with anyio.move_on_after(0.5) as scope:
            try:
                await flight.vehicle.mission.start(1)
            finally:
                flight.px4.faults.silent = False
        assert scope.cancelled_caught
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "POSCTL"
