"""Measurements of a program: their messages, when they are dropped, required parameters, and flights without GPS."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Px4Flight, block_loop, open_flight, open_px4, suspend_computer

from aerokit import Position
from aerokit import messages as m
from aerokit.errors import (
    ConnectionClosed,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
    ParameterTimeout,
    SetpointStreamStopped,
    ValueUnknownError,
)
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.vehicle.external import values as v
from aerokit.vehicle.external.encoding import MeasurementEncoder
from aerokit.vehicle.external.streams import MeasurementStream
from aerokit.vehicle.state.movement import Attitude

pytestmark = pytest.mark.anyio

LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL = v.OdometryMeasurement((0.0, 0.0, 0.0), LEVEL)
COPTER_PARAMETERS: dict[str, float] = {
    "VISO_TYPE": 1,
    "GPS1_TYPE": 14,
    "PRX1_TYPE": 2,
    "RNGFND1_TYPE": 10,
    "FLOW_TYPE": 5,
    "PLND_ENABLED": 1,
    "PLND_TYPE": 1,
}
PX4_PARAMETERS: dict[str, float] = {"EKF2_EV_CTRL": 15, "EKF2_OF_CTRL": 1}


def copter(**parameters: float) -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameters={**COPTER_PARAMETERS, **parameters})


def px4(**parameters: float) -> SimulatedPx4:
    return SimulatedPx4(boot_time_s=1.0, parameters={**PX4_PARAMETERS, **parameters})


# ------------------------------------------------------------------------------------- encoding


def yaw_of(q: Sequence[float]) -> float:
    w, x, y, z = q
    return Attitude.from_quaternion(w, x, y, z, (None, None, None)).yaw_deg


async def first_sent(flight: Flight | Px4Flight, stream: MeasurementStream[Any], value: object) -> Any:
    async with stream:
        flight.wire.clear()
        stream.send(value)
        return flight.wire.sent[-1][1]


async def test_odometry_in_ros_axes_is_converted() -> None:
    """A vehicle that faces east, 2 m north and 1 m up, and moves forward and to the left."""
    ros = v.OdometryMeasurement((0.0, 2.0, 1.0), LEVEL, (3.0, 0.5, 0.0), "enu")
    async with open_px4(px4()) as flight:
        sent: m.Odometry = await first_sent(flight, flight.vehicle.external.odometry(), ros)
    assert (sent.frame_id, sent.child_frame_id) == (MavFrame.LOCAL_NED, MavFrame.BODY_FRD)
    assert (sent.x, sent.y, sent.z) == (2.0, 0.0, -1.0)
    assert (sent.vx, sent.vy, sent.vz) == (3.0, -0.5, 0.0)
    assert yaw_of(sent.q) == pytest.approx(90.0)


async def test_odometry_for_ardupilot_is_always_in_frd() -> None:
    value = v.OdometryMeasurement((1.0, 2.0, -3.0), Attitude(0.0, 0.0, 45.0), frame="ned", position_variance_m2=0.01)
    async with open_flight(copter()) as flight:
        sent: m.Odometry = await first_sent(flight, flight.vehicle.external.odometry(), value)
    assert (sent.frame_id, sent.child_frame_id) == (MavFrame.LOCAL_FRD, MavFrame.BODY_FRD)
    assert [sent.pose_covariance[place] for place in (0, 6, 11, 15)] == pytest.approx([0.01, 0.01, 0.01, 0.0])
    assert math.isnan(sent.velocity_covariance[0])
    assert math.isnan(sent.vx)


async def test_odometry_in_forward_left_up_is_mirrored() -> None:
    ros = v.OdometryMeasurement((1.0, 2.0, 3.0), Attitude(0.0, 0.0, 30.0), (1.0, 2.0, 3.0), "flu")
    async with open_px4(px4()) as flight:
        sent: m.Odometry = await first_sent(flight, flight.vehicle.external.odometry(), ros)
    assert sent.frame_id == MavFrame.LOCAL_FRD
    assert (sent.x, sent.y, sent.z, sent.vx, sent.vy, sent.vz) == (1.0, -2.0, -3.0, 1.0, -2.0, -3.0)
    assert yaw_of(sent.q) == pytest.approx(-30.0)


async def test_poses_and_speeds_use_message_of_firmware() -> None:
    pose, speed = v.PoseMeasurement(1.0, 2.0, -3.0, Attitude(0.0, 0.0, 90.0)), v.SpeedMeasurement(1.0, 2.0, 3.0)
    async with open_flight(copter()) as flight:
        external = flight.vehicle.external
        vision: m.VisionPositionEstimate = await first_sent(flight, external.vision_position(), pose)
        mocap: m.AttPosMocap = await first_sent(flight, external.motion_capture(), pose)
        velocity: m.VisionSpeedEstimate = await first_sent(flight, external.vision_speed(), speed)
    assert (vision.x, vision.y, vision.z, vision.yaw) == pytest.approx((1.0, 2.0, -3.0, math.pi / 2))
    assert (mocap.x, mocap.y, mocap.z, mocap.q[3]) == pytest.approx((1.0, 2.0, -3.0, math.sqrt(0.5)))
    assert (velocity.x, velocity.y, velocity.z) == (1.0, 2.0, 3.0)
    async with open_px4(px4()) as flight4:
        external = flight4.vehicle.external
        assert isinstance(await first_sent(flight4, external.motion_capture(), pose), m.VisionPositionEstimate)
        odometry: m.Odometry = await first_sent(flight4, external.vision_speed(), speed)
    assert math.isnan(odometry.x)
    assert math.isnan(odometry.q[0])
    assert (odometry.vx, odometry.vy, odometry.vz, odometry.child_frame_id) == (1.0, 2.0, 3.0, MavFrame.LOCAL_NED)


async def test_gps_measurement_is_encoded_with_week_and_flags() -> None:
    value = v.GpsMeasurement(47.0, 8.0, 500.0, (1.0, 2.0, 3.0), hdop=0.8, yaw_deg=0.0, unix_time_s=1_700_000_000.5)
    async with open_flight(copter()) as flight:
        sent: m.GpsInput = await first_sent(flight, flight.vehicle.external.gps(), value)
    assert (sent.lat, sent.lon, sent.alt, sent.vn, sent.ve, sent.vd) == (470000000, 80000000, 500.0, 1.0, 2.0, 3.0)
    assert (sent.time_week, sent.time_week_ms) == (2288, 252_818_500)
    assert sent.ignore_flags == 4 | 32 | 64 | 128  # vertical dilution, and the three accuracies
    assert sent.yaw == 36000  # 0 would mean "no heading"


async def test_obstacles_and_ranges_are_in_centimetres() -> None:
    sectors = v.ObstacleSectors((1.0, None, math.inf), min_m=0.2, max_m=10.0, step_deg=30.0)
    points = v.ObstaclePoints(((1.0, 2.0, 0.0), (3.0, 0.0, -1.0)), 0.2, 10.0)
    distance = v.RangeMeasurement(1.5, 0.1, 12.0, variance_m2=0.01, quality=80)
    async with open_flight(copter()) as flight:
        external = flight.vehicle.external
        around: m.ObstacleDistance = await first_sent(flight, external.obstacles(), sectors)
        assert (await first_sent(flight, external.obstacle_points(), points)).x == 3.0
        stamps = {message.time_boot_ms for message in flight.wire.all(m.ObstacleDistance3d)}
        below: m.DistanceSensor = await first_sent(flight, external.range_finder(), distance)
    assert tuple(around.distances[:4]) == (100, 65535, 1001, 65535)
    assert (around.min_distance, around.max_distance, around.increment_f, around.frame) == (20, 1000, 30.0, 12)
    assert len(stamps) == 1
    assert (below.current_distance, below.orientation, below.covariance, below.signal_quality) == (150, 25, 100, 80)


async def test_optical_flow_uses_message_of_firmware() -> None:
    value = v.FlowMeasurement(0.02, -0.01, 0.1, gyro_rad=(0.0, 0.1, 0.2), quality=200, distance_m=2.0)
    async with open_px4(px4()) as flight4:
        radians: m.OpticalFlowRad = await first_sent(flight4, flight4.vehicle.external.optical_flow(), value)
    assert (radians.integrated_x, radians.integrated_y) == pytest.approx((0.02, -0.01))
    assert (radians.integration_time_us, radians.quality, radians.distance) == (100_000, 200, 2.0)
    async with open_flight(copter()) as flight:
        pixels: m.OpticalFlow = await first_sent(flight, flight.vehicle.external.optical_flow(), value)
    assert (pixels.flow_x, pixels.flow_y) == (2, -1)


async def test_optical_flow_beyond_message_names_argument() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.optical_flow() as stream:
        stream.send(v.FlowMeasurement(327.67, -327.68, 0.1))
        with pytest.raises(InvalidArgument, match=r"y_rad = -328\.0 is not allowed: it must be -327\.68 to 327\.67"):
            stream.send(v.FlowMeasurement(0.0, -328.0, 0.1))


async def test_landing_target_is_in_frame_of_firmware() -> None:
    value = v.TargetMeasurement(2.0, 1.0, 10.0, is_level=True)
    async with open_flight(copter()) as flight:
        relative: m.LandingTarget = await first_sent(flight, flight.vehicle.external.landing_target(), value)
    assert (relative.frame, relative.x, relative.y, relative.z) == (MavFrame.LOCAL_FRD, 2.0, 1.0, 10.0)
    assert relative.distance == pytest.approx(math.sqrt(105.0))
    async with open_px4(px4()) as flight4:
        await flight4.vehicle.wait_ready()
        flight4.px4.motion.yaw = math.pi / 2  # east
        await anyio.sleep(1.0)
        local: m.LandingTarget = await first_sent(flight4, flight4.vehicle.external.landing_target(), value)
    assert (local.frame, local.position_valid) == (MavFrame.LOCAL_NED, 1)
    assert (local.x, local.y, local.z) == pytest.approx((-1.0, 2.0, 10.0), abs=0.05)


def test_target_of_camera_angles_is_at_its_height() -> None:
    target = v.TargetMeasurement.from_angles(45.0, 0.0, 10.0)
    assert (target.forward_m, target.right_m, target.down_m) == pytest.approx((10.0, 0.0, 10.0))


async def test_landing_target_needs_recent_local_position() -> None:
    """With an old position, the target would seem to have moved with the vehicle."""
    async with open_px4(px4()) as flight:
        await flight.take_off()
        async with flight.vehicle.external.landing_target() as stream:
            flight.px4.faults.lose(m.LocalPositionNed, times=1_000_000)
            await anyio.sleep(5.0)
            with pytest.raises(ValueUnknownError, match="too old"):
                stream.send(v.TargetMeasurement(2.0, 1.0, 10.0))
        assert not flight.wire.all(m.LandingTarget)


WRONG: list[tuple[str, Any]] = [
    ("odometry", v.OdometryMeasurement((math.nan, 0.0, 0.0), LEVEL)),
    ("odometry", v.OdometryMeasurement((0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0))),
    ("odometry", v.OdometryMeasurement((0.0, 0.0, 0.0), LEVEL, quality=101)),
    ("odometry", v.OdometryMeasurement((0.0, 0.0, 0.0), LEVEL, reset_counter=256)),
    ("odometry", v.OdometryMeasurement((0.0, 0.0, 0.0), LEVEL, measured_at=1e9)),
    ("odometry", v.OdometryMeasurement((0.0, 0.0, 0.0), LEVEL, position_variance_m2=-1.0)),
    ("odometry", v.SpeedMeasurement(0.0, 0.0, 0.0)),
    ("gps", v.GpsMeasurement(91.0, 0.0, 0.0)),
    ("gps", v.GpsMeasurement(0.0, 0.0, 0.0, unix_time_s=0.0)),
    ("gps", v.GpsMeasurement(0.0, 0.0, 0.0, (0.0, math.nan, 0.0))),
    ("gps", v.GpsMeasurement(0.0, 0.0, 0.0, hdop=math.nan)),
    ("gps", v.GpsMeasurement(0.0, 0.0, 0.0, speed_accuracy_m_s=math.inf)),
    ("gps", v.GpsMeasurement(0.0, 0.0, 0.0, yaw_deg=math.nan)),
    ("obstacles", v.ObstacleSectors((), 0.1, 10.0)),
    ("obstacles", v.ObstacleSectors((1.0,) * 73, 0.1, 10.0)),
    ("obstacles", v.ObstacleSectors((-1.0,), 0.1, 10.0)),
    ("range_finder", v.RangeMeasurement(1.0, 0.1, 700.0)),
    ("range_finder", v.RangeMeasurement(1.0, 0.1, 7.0, "sideways")),  # type: ignore[arg-type]
    ("landing_target", v.TargetMeasurement(0.0, 0.0, 0.0)),
    ("optical_flow", v.FlowMeasurement(0.0, 0.0, 0.0)),
    ("optical_flow", v.FlowMeasurement(0.0, 0.0, 0.1, (math.nan, 0.0, 0.0))),
]


@pytest.mark.parametrize(("kind", "value"), WRONG)
async def test_invalid_measurement_raises_and_is_not_sent(kind: str, value: object) -> None:
    async with open_flight(copter()) as flight, getattr(flight.vehicle.external, kind)() as stream:
        flight.wire.clear()
        with pytest.raises(InvalidArgument):
            stream.send(value)
        assert (stream.sent, flight.wire.sent) == (0, [])


# --------------------------------------------------------------------------------- life of a stream


async def test_measurement_is_sent_once_and_newest_wins() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.odometry(rate_hz=10.0) as stream:
        flight.wire.clear()
        for x in range(4):
            stream.send(v.OdometryMeasurement((float(x), 0.0, 0.0), LEVEL))
        await anyio.sleep(5.0)
        assert [message.x for message in flight.wire.all(m.Odometry)] == [0.0, 3.0]
        assert (stream.sent, stream.dropped) == (2, 2)


async def test_measurements_are_limited_to_rate() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.odometry(rate_hz=50.0) as stream:
        flight.wire.clear()
        for _ in range(400):
            stream.send(STILL)
            await anyio.sleep(0.005)
        assert len(flight.wire.all(m.Odometry)) == pytest.approx(100, abs=2)


async def test_old_measurement_is_dropped_after_blocked_loop() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.odometry(rate_hz=10.0) as stream:
        stream.send(STILL)
        stream.send(STILL)
        block_loop(1.0)
        await anyio.sleep(0.5)
        assert (stream.sent, stream.dropped) == (1, 1)
        stream.send(STILL.replace(measured_at=flight.vehicle.connection.now() - 0.3))
        assert (stream.sent, stream.dropped) == (1, 2)
        stream.send(STILL)
        assert stream.sent == 2


async def test_measurement_from_before_sleep_of_computer_is_dropped() -> None:
    async with open_flight(copter()) as flight:
        await flight.vehicle.wait_ready()
        async with flight.vehicle.external.odometry() as stream:
            measured_at = anyio.current_time()
            await anyio.sleep(0.1)
            suspend_computer(flight.vehicle, 60.0)
            stream.send(STILL.replace(measured_at=measured_at))
            assert (stream.sent, stream.dropped) == (0, 1)
            await anyio.sleep(0.1)
            stream.send(STILL)
            assert (stream.sent, stream.dropped) == (1, 1)


async def test_measurements_pause_while_vehicle_is_silent() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.odometry() as stream:
        flight.copter.faults.silent = True
        await anyio.sleep(10.0)
        stream.send(STILL)
        assert (stream.sent, stream.dropped) == (0, 1)
        flight.copter.faults.silent = False
        await anyio.sleep(3.0)
        stream.send(STILL)
        assert stream.sent == 1


async def test_measurement_outside_block_raises() -> None:
    async with open_flight(copter()) as flight:
        stream = flight.vehicle.external.odometry()
        with pytest.raises(SetpointStreamStopped, match="inside its `async with` block"):
            stream.send(STILL)
        async with stream:
            stream.send(STILL)
            stream.send(STILL)
        flight.wire.clear()
        await anyio.sleep(1.0)
        assert not flight.wire.all(m.Odometry)
        with pytest.raises(SetpointStreamStopped):
            stream.send(STILL)
        with pytest.raises(SetpointStreamStopped, match="only once"):
            async with stream:
                raise AssertionError("entered twice")


async def test_clock_requests_are_answered_only_inside_block() -> None:
    async with open_px4(px4()) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.command(MavCmd.SET_MESSAGE_INTERVAL, m.Timesync.ID, 100_000)
        await anyio.sleep(2.0)
        assert flight.px4.external.clock_answers == 0
        async with flight.vehicle.external.odometry(), flight.vehicle.external.range_finder():
            await anyio.sleep(2.05)
        answers = flight.px4.external.clock_answers
        assert answers >= 15
        answer = next(message for message in flight.wire.all(m.Timesync) if message.tc1)
        assert answer.tc1 / 1e9 <= flight.vehicle.connection.now()
        await anyio.sleep(2.0)
        assert flight.px4.external.clock_answers == answers


@pytest.mark.parametrize(
    ("kind", "parameter"),
    [
        ("odometry", "VISO_TYPE"),
        ("gps", "GPS1_TYPE"),
        ("obstacles", "PRX1_TYPE"),
        ("range_finder", "RNGFND1_TYPE"),
        ("landing_target", "PLND_ENABLED"),
        ("optical_flow", "FLOW_TYPE"),
    ],
)
async def test_parameter_that_ignores_measurements_raises(kind: str, parameter: str) -> None:
    async with open_flight(copter(**{parameter: 0.0})) as flight:
        with pytest.raises(OperationRejected, match=f"{parameter} = 0, so ArduCopter ignores the measurements"):
            async with getattr(flight.vehicle.external, kind)():
                raise AssertionError("entered")


async def test_missing_parameters_of_measurements_are_named() -> None:
    simulated = copter()
    simulated.parameters._rows.pop("PRX1_TYPE")
    simulated.parameters._names = None
    async with open_flight(simulated) as flight:
        error = "this build of ArduCopter ignores the measurements, because it has no parameter PRX1_TYPE or PRX_TYPE$"
        with pytest.raises(OperationRejected, match=error):
            async with flight.vehicle.external.obstacles():
                raise AssertionError("entered")


async def test_px4_without_external_vision_raises() -> None:
    async with open_px4(px4(EKF2_EV_CTRL=3.0)) as flight:
        async with flight.vehicle.external.odometry():
            pass
        with pytest.raises(OperationRejected, match=r"EKF2_EV_CTRL = 3, so .* set EKF2_EV_CTRL to 4 or 5"):
            async with flight.vehicle.external.vision_speed():
                raise AssertionError("entered")


@pytest.mark.parametrize("kind", ["gps", "obstacle_points"])
async def test_px4_does_not_read_some_measurements(kind: str) -> None:
    async with open_px4(px4()) as flight:
        with pytest.raises(NotSupported, match=f"{kind.replace('_', ' ')}: PX4"):
            async with getattr(flight.vehicle.external, kind)():
                raise AssertionError("entered")


async def test_unreported_parameters_raise_timeout() -> None:
    async with open_flight(copter()) as flight:
        flight.copter.faults.silent = True
        with pytest.raises(ParameterTimeout):
            async with flight.vehicle.external.odometry():
                raise AssertionError("entered")


async def test_no_points_after_end_raise_connection_closed() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.obstacle_points() as stream:
        flight.vehicle.connection.close()
        with pytest.raises(ConnectionClosed):
            stream.send(v.ObstaclePoints((), 0.2, 10.0))


async def test_px4_target_without_position_raises() -> None:
    async with open_px4(px4()) as flight, flight.vehicle.external.landing_target() as stream:
        flight.vehicle.telemetry.attitude.forget()
        with pytest.raises(ValueUnknownError, match="attitude or local position"):
            stream.send(v.TargetMeasurement(1.0, 0.0, 5.0))


# ----------------------------------------------------------------------------- origin and wind


async def test_set_wind_reaches_vehicle() -> None:
    async with open_px4() as flight4:
        await flight4.vehicle.external.set_wind(5.0, 270.0)
        assert flight4.px4.external.wind == (5.0, 270.0)
    async with open_flight() as flight:
        await flight.vehicle.external.set_wind(5.0, 270.0)
        assert flight.copter.external.wind == (5.0, 270.0)
        (sent,) = flight.wire.commands(MavCmd.EXTERNAL_WIND_ESTIMATE)
        assert (sent.param1, sent.param2, sent.param3, sent.param4) == (5.0, 1.0, 270.0, 15.0)
        with pytest.raises(InvalidArgument):
            await flight.vehicle.external.set_wind(5.0, 361.0)


ORIGIN = Position(-35.36, 149.16, 600.0)


async def test_ardupilot_keeps_its_origin() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        present = flight.vehicle.origin.value
        await flight.vehicle.external.set_origin(present)
        with pytest.raises(OperationRejected, match="keeps it until a reboot"):
            await flight.vehicle.external.set_origin(ORIGIN)
        assert not flight.wire.all(m.SetGpsGlobalOrigin)


async def test_set_origin_without_altitude_raises() -> None:
    async with open_flight() as flight:
        with pytest.raises(InvalidArgument, match="altitude_amsl_m"):
            await flight.vehicle.external.set_origin(Position(0.0, 0.0))


async def test_ignored_origin_times_out() -> None:
    async with open_flight(copter(EK3_SRC1_POSXY=6)) as flight:
        flight.copter.faults.gps_lost = True
        flight.copter.navigation.origin = None
        flight.vehicle.telemetry.origin.forget()
        flight.copter.handlers.pop(m.SetGpsGlobalOrigin.ID)
        with pytest.raises(OperationTimeout, match="did not report the origin within 3 s; it has reported no origin"):
            await flight.vehicle.external.set_origin(ORIGIN, timeout=3.0)
        assert len(flight.wire.all(m.SetGpsGlobalOrigin)) == 1


# ------------------------------------------------------------------------------- flight without GPS


def use_of(stream: MeasurementStream[Any]) -> str:
    return stream.estimator_use


def pose_of(motion: Any, place: Callable[[], tuple[float, float, float]]) -> v.OdometryMeasurement:
    attitude = Attitude(0.0, 0.0, math.degrees(motion.yaw))
    return v.OdometryMeasurement(place(), attitude, (0.0, 0.0, 0.0))


async def feed(stream: MeasurementStream[v.OdometryMeasurement], motion: Any) -> None:
    """Act as a tracking system: send the true pose thirty times a second."""
    while True:
        if stream.is_open:
            stream.send(pose_of(motion, lambda: motion.place))
        await anyio.sleep(1 / 30)


async def test_copter_without_gps_flies_by_odometry() -> None:
    without_gps = {**COPTER_PARAMETERS, "EK3_SRC1_POSXY": 6, "GPS1_TYPE": 0}
    simulated = SimulatedCopter(boot_time_s=5.0, parameters=without_gps)
    async with open_flight(simulated) as flight, anyio.create_task_group() as tasks:
        vehicle = flight.vehicle
        async with vehicle.external.odometry() as stream:
            assert use_of(stream) == "unknown"
            tasks.start_soon(feed, stream, simulated.motion)
            await anyio.sleep(8.0)
            await vehicle.external.set_origin(ORIGIN)
            await vehicle.position.wait_until(lambda _: True, timeout=10)
            await vehicle.estimator.wait_until(lambda health: health.has_absolute_position, timeout=10)
            assert use_of(stream) == "used"
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()
            await vehicle.take_off(5.0)
            start = vehicle.position.value
            await vehicle.go_to(start.offset(north_m=10.0))
            assert simulated.motion.north == pytest.approx(10.0, abs=2.0)
            tasks.cancel_scope.cancel()
        await vehicle.estimator.wait_until(lambda health: not health.has_absolute_position, timeout=30)
        assert use_of(stream) == "not used"


async def test_px4_without_gps_flies_by_odometry() -> None:
    simulated = px4(EKF2_GPS_CTRL=0.0)
    async with open_px4(simulated) as flight, anyio.create_task_group() as tasks:
        vehicle = flight.vehicle
        async with vehicle.external.odometry() as stream:
            tasks.start_soon(feed, stream, simulated.motion)
            await anyio.sleep(5.0)
            await vehicle.external.set_origin(ORIGIN)
            await vehicle.wait_ready()
            assert use_of(stream) == "used"
            await vehicle.arm()
            await vehicle.take_off(5.0)
            assert use_of(stream) == "used"
            await vehicle.go_to(vehicle.position.value.offset(east_m=10.0))
            assert simulated.motion.east == pytest.approx(10.0, abs=2.0)
        tasks.cancel_scope.cancel()


async def test_old_report_of_the_ground_excuses_no_constant_position() -> None:
    simulated = px4(EKF2_GPS_CTRL=0.0)
    async with open_px4(simulated) as flight, anyio.create_task_group() as tasks:
        async with flight.vehicle.external.odometry() as stream:
            tasks.start_soon(feed, stream, simulated.motion)
            await anyio.sleep(5.0)
            assert use_of(stream) == "used"
            simulated.faults.lost_messages[m.ExtendedSysState.ID] = 1000
            await anyio.sleep(6.0)
            assert use_of(stream) == "not used"
        tasks.cancel_scope.cancel()


async def test_use_beside_gps_is_unknown() -> None:
    async with open_flight(copter()) as flight, flight.vehicle.external.odometry() as stream:
        await flight.vehicle.wait_ready()
        stream.send(STILL)
        assert stream.estimator_use == "unknown"


async def test_encoder_stamps_use_clock_of_loop() -> None:
    async with open_flight(copter()) as flight:
        encoder = MeasurementEncoder(flight.vehicle._session)
        (sent,) = encoder.odometry(STILL.replace(measured_at=2.5))
        assert isinstance(sent, m.Odometry)
        assert sent.time_usec == 2_500_000
