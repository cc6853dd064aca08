"""Values: what users build and read."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit import enums, messages
from aerokit.connection.cells import Source
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavLandedState
from aerokit.missions.navigation import waypoint
from aerokit.position import Home, Position
from aerokit.vehicle.state import equipment as gimbal
from aerokit.vehicle.state.condition import EstimatorHealth, SensorHealth
from aerokit.vehicle.state.equipment import GpsReceiver
from aerokit.vehicle.state.movement import Attitude, Velocity
from aerokit.vehicle.state.telemetry import Telemetry, is_reported_on_ground

angles = st.floats(-179, 179)


def test_position_setpoint_is_encoded() -> None:
    place = Position(47.3977, 8.5456, altitude_relative_m=30)
    assert (place.latitude_deg, place.altitude_relative_m, place.altitude_amsl_m) == (47.3977, 30, None)
    with pytest.raises(AttributeError, match="immutable"):
        place.latitude_deg = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"latitude_deg": 91.0, "longitude_deg": 0.0}, "latitude_deg = 91.0 is not allowed: it must be -90 to 90"),
        ({"latitude_deg": 0.0, "longitude_deg": 473977000.0}, "longitude_deg"),
        ({"latitude_deg": math.nan, "longitude_deg": 0.0}, "latitude_deg = nan"),
        (
            {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_relative_m": math.inf},
            "altitude_relative_m = inf",
        ),
        ({"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_amsl_m": "30"}, "altitude_amsl_m = '30'"),
    ],
)
def test_nonsense_is_refused_by_name(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        Position(**fields)


def test_position_offset_wrong_type_is_named() -> None:
    north: Any = "30"
    with pytest.raises(InvalidArgument, match="north_m = '30' is not allowed: it must be a number"):
        Position(47.3977, 8.5456).offset(north_m=north)


def test_offsets_keep_and_raise_the_altitude() -> None:
    here = Position(47.3977, 8.5456, altitude_relative_m=30)
    there = here.offset(north_m=30, east_m=40, up_m=5)
    assert here.distance_to(there) == pytest.approx(50, abs=1e-6)
    assert here.bearing_to(there) == pytest.approx(math.degrees(math.atan2(40, 30)), abs=1e-3)
    assert (there.altitude_relative_m, there.altitude_amsl_m) == (35, None)


def test_home_as_a_target() -> None:
    """Without an altitude: going home must not mean flying into the ground."""
    home = Home(47.0, 8.0, 488.0)
    assert home.position == Position(47.0, 8.0)
    assert waypoint(home, altitude_relative_m=30.0) == waypoint(home.position, altitude_relative_m=30.0)
    with pytest.raises(InvalidArgument, match="give exactly one of altitude_relative_m"):
        waypoint(home)


def test_velocity_has_speed_and_course() -> None:
    assert Velocity(3, -4, 1).ground_speed_m_s == 5
    assert Velocity(0, -4, 1).course_deg == pytest.approx(270)


@given(angles, st.floats(-89, 89), angles)
def test_quaternions_and_euler_angles_agree(roll: float, pitch: float, yaw: float) -> None:
    attitude = Attitude(roll, pitch, yaw)
    assert math.hypot(*attitude.quaternion) == pytest.approx(1)
    back = Attitude.from_quaternion(*attitude.quaternion, (None, None, None))
    assert (back.roll_deg, back.pitch_deg, back.yaw_deg) == pytest.approx((roll, pitch, yaw), abs=1e-5)


def test_quaternion_of_quarter_turn_is_yaw_90() -> None:
    half = math.sqrt(0.5)
    assert Attitude(0, 0, 90).quaternion == pytest.approx((half, 0, 0, half))


@pytest.mark.parametrize(
    ("fix_type", "has_fix"),
    [(0, False), (2, False), (3, True), (6, True), (8, True), (9, False), (99, False)],
)
def test_fix(fix_type: int, has_fix: bool) -> None:
    assert GpsReceiver(0, fix_type).has_3d_fix is has_fix


@pytest.mark.parametrize(("passes", "blocking"), [(True, ()), (False, ("GPS",)), (None, ("GPS",))])
def test_failing_sensor_blocks_unless_checks_pass(passes: bool | None, blocking: tuple[str, ...]) -> None:
    assert SensorHealth(0, 0, 0, ("GPS",), passes, 0.0).blocks_arming == blocking


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("has_attitude", enums.EstimatorStatusFlags.ATTITUDE),
        ("has_horizontal_velocity", enums.EstimatorStatusFlags.VELOCITY_HORIZ),
        ("has_relative_position", enums.EstimatorStatusFlags.POS_HORIZ_REL),
        ("has_absolute_position", enums.EstimatorStatusFlags.POS_HORIZ_ABS),
        ("has_altitude", enums.EstimatorStatusFlags.POS_VERT_ABS),
    ],
)
def test_estimator_flags_have_properties(name: str, flag: int) -> None:
    assert getattr(EstimatorHealth("ESTIMATOR_STATUS", flag, ()), name) is True
    assert getattr(EstimatorHealth("ESTIMATOR_STATUS", 0xFFFF & ~flag, ()), name) is False


# ----------------------------------------------------------------------------------- gimbals

FROM_NOSE, FROM_NORTH, LOCK = (
    enums.GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME,
    enums.GimbalDeviceFlags.YAW_IN_EARTH_FRAME,
    enums.GimbalDeviceFlags.YAW_LOCK,
)


def test_mount_status_is_in_hundredths_of_degrees() -> None:
    attitude = gimbal.from_status(messages.MountStatus(1, 1, -4512, 150, 9001))
    assert attitude == gimbal.GimbalAttitude(-45.12, 1.5, 90.01)


@pytest.mark.parametrize(
    ("yaw", "absolute", "heading", "expected"),
    [
        (10.0, 0.0, 355.0, 5.0),
        (10.0, -90.0, 355.0, 270.0),
        (10.0, math.nan, 355.0, 5.0),
        (-10.0, 0.0, None, None),
        (math.nan, 0.0, None, None),
    ],
)
def test_mount_yaw_follows_vehicle_heading(
    yaw: float, absolute: float, heading: float | None, expected: float | None
) -> None:
    message = messages.MountOrientation(0, 1.25, -30.5, yaw, absolute)
    from_nose = yaw if math.isfinite(yaw) else None
    assert gimbal.from_orientation(message, heading) == gimbal.GimbalAttitude(-30.5, 1.25, expected, from_nose)


def pointing(q: tuple[float, ...], flags: int = 0, delta_yaw: float = 0.0) -> Any:
    return messages.GimbalDeviceAttitudeStatus(0, 0, 0, flags, q, 0, 0, 0, 0, delta_yaw)


def turned(roll_deg: float, pitch_deg: float, yaw_deg: float) -> tuple[float, ...]:
    """The quaternion of yaw, then pitch, then roll."""
    (sr, cr), (sp, cp), (sy, cy) = (
        (math.sin(math.radians(angle) / 2), math.cos(math.radians(angle) / 2))
        for angle in (roll_deg, pitch_deg, yaw_deg)
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@pytest.mark.parametrize(
    ("flags", "delta_deg", "heading", "yaw_deg", "from_nose_deg"),
    [
        (FROM_NORTH, 0.0, 100.0, 30.0, -70.0),
        (FROM_NORTH, 50.0, 100.0, 30.0, -20.0),
        (FROM_NORTH, math.nan, None, 30.0, None),
        (FROM_NOSE, 50.0, 100.0, 80.0, 30.0),
        (FROM_NOSE, 0.0, 100.0, 130.0, 30.0),
        (FROM_NOSE, math.nan, 100.0, 130.0, 30.0),
        (FROM_NOSE | LOCK, 0.0, 100.0, 130.0, 30.0),
        (FROM_NOSE, 0.0, None, None, 30.0),
        (LOCK, 50.0, 100.0, 30.0, -70.0),
        (LOCK, 50.0, 250.0, 30.0, 140.0),
        (0, 50.0, 100.0, 130.0, 30.0),
    ],
)
def test_gimbal_yaw_from_nose_or_north_is_converted(
    flags: int, delta_deg: float, heading: float | None, yaw_deg: float | None, from_nose_deg: float | None
) -> None:
    message = pointing(turned(10, -20, 30), flags, math.radians(delta_deg))
    attitude = gimbal.from_device(message, heading)
    assert attitude == gimbal.GimbalAttitude(-20.0, 10.0, yaw_deg, from_nose_deg)


@given(angles, st.floats(-89, 89), angles, st.floats(0.1, 10))
def test_gimbal_angles_match_rotation(roll: float, pitch: float, yaw: float, length: float) -> None:
    """For any length of the quaternion."""
    q = tuple(length * component for component in turned(roll, pitch, yaw))
    attitude = gimbal.from_device(pointing(q, FROM_NORTH), None)
    assert attitude.pitch_deg == pytest.approx(pitch, abs=0.02)
    assert attitude.roll_deg == pytest.approx(roll, abs=0.02)
    assert math.remainder((attitude.yaw_deg or 0.0) - yaw, 360) == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("pitch_deg", [-90.0, 90.0])
@pytest.mark.parametrize("roll_deg", [0.0, 25.0])
def test_vertical_camera_rotation_is_yaw(pitch_deg: float, roll_deg: float) -> None:
    attitude = gimbal.from_device(pointing(turned(roll_deg, pitch_deg, 40), FROM_NORTH), None)
    assert attitude == gimbal.GimbalAttitude(pitch_deg, 0.0, 40.0 - math.copysign(roll_deg, pitch_deg))


def test_zero_quaternion_has_no_attitude() -> None:
    attitude = gimbal.from_device(pointing((0.0, 0.0, 0.0, 0.0), FROM_NORTH), None)
    assert attitude == gimbal.GimbalAttitude(None, None, None)


@pytest.mark.parametrize(("age_s", "is_on_ground"), [(0.0, True), (4.9, True), (5.1, False)])
def test_old_landed_state_is_no_report_of_the_ground(age_s: float, is_on_ground: bool) -> None:
    now = [100.0]
    telemetry = Telemetry(lambda: now[0], system_id=1, component_id=1)
    assert not is_reported_on_ground(telemetry)
    telemetry.landed_state.set(MavLandedState.ON_GROUND, Source(1, 1, "the test"))
    now[0] += age_s
    assert is_reported_on_ground(telemetry) is is_on_ground
