"""Values: what users build and read."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import LocalProtocolError
from aerokit.position import Position
from aerokit.vehicle.state.condition import SensorHealth
from aerokit.vehicle.state.equipment import GpsReceiver
from aerokit.vehicle.state.movement import Attitude, Home, Velocity

angles = st.floats(-179, 179)


def test_a_position_as_users_write_it() -> None:
    place = Position(47.3977, 8.5456, altitude_relative_m=30)
    assert (place.latitude_deg, place.altitude_relative_m, place.altitude_amsl_m) == (47.3977, 30, None)
    with pytest.raises(AttributeError, match="immutable"):
        place.latitude_deg = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"latitude_deg": 91.0, "longitude_deg": 0.0}, "latitude_deg = 91.0 is not allowed: -90 to 90"),
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
    with pytest.raises(LocalProtocolError, match=text):
        Position(**fields)


def test_an_offset_of_a_wrong_type_is_refused_by_name() -> None:
    north: Any = "30"
    with pytest.raises(LocalProtocolError, match="north_m = '30' is not allowed: a number"):
        Position(47.3977, 8.5456).offset(north_m=north)


def test_offsets_keep_and_raise_the_altitude() -> None:
    here = Position(47.3977, 8.5456, altitude_relative_m=30)
    there = here.offset(north_m=30, east_m=40, up_m=5)
    assert here.distance_to(there) == pytest.approx(50, abs=1e-6)
    assert here.bearing_to(there) == pytest.approx(math.degrees(math.atan2(40, 30)), abs=1e-3)
    assert (there.altitude_relative_m, there.altitude_amsl_m) == (35, None)


def test_home_as_a_target() -> None:
    """Without an altitude: going home must not mean flying into the ground."""
    assert Home(47.0, 8.0, 488.0).position == Position(47.0, 8.0)


def test_velocity_as_speed_and_course() -> None:
    assert Velocity(3, -4, 1).ground_speed_m_s == 5
    assert Velocity(0, -4, 1).course_deg == pytest.approx(270)


@given(angles, st.floats(-89, 89), angles)
def test_quaternions_and_euler_angles_agree(roll: float, pitch: float, yaw: float) -> None:
    attitude = Attitude(roll, pitch, yaw)
    assert math.hypot(*attitude.quaternion) == pytest.approx(1)
    back = Attitude.from_quaternion(*attitude.quaternion, (None, None, None))
    assert (back.roll_deg, back.pitch_deg, back.yaw_deg) == pytest.approx((roll, pitch, yaw), abs=1e-5)


def test_a_quarter_turn_to_the_right() -> None:
    half = math.sqrt(0.5)
    assert Attitude(0, 0, 90).quaternion == pytest.approx((half, 0, 0, half))


@pytest.mark.parametrize(
    ("fix_type", "has_fix"),
    [(0, False), (2, False), (3, True), (6, True), (8, True), (9, False), (99, False)],
)
def test_fix(fix_type: int, has_fix: bool) -> None:
    assert GpsReceiver(0, fix_type).has_3d_fix is has_fix


@pytest.mark.parametrize(("passes", "blocking"), [(True, ()), (False, ("GPS",)), (None, ("GPS",))])
def test_what_fails_blocks_unless_the_checks_pass(passes: bool | None, blocking: tuple[str, ...]) -> None:
    assert SensorHealth(0, 0, 0, ("GPS",), passes, 0.0).blocks_arming == blocking
