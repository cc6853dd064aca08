from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.sim.motion import GlobalPoint, LocalFrame, Motion, SimulatedWind, approach_speed, wrap_pi

DT = 0.02


def hovering(wind: SimulatedWind | None = None, height: float = 20.0) -> Motion:
    motion = Motion(random.Random(1), wind=wind)
    motion.down = -height
    return motion


def fly(motion: Motion, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        motion.step(DT)


def go_to(motion: Motion, north: float, east: float, down: float, seconds: float) -> float:
    """Fly to a target and return the largest overshoot along the line of flight."""
    start = (motion.north, motion.east)
    length = math.hypot(north - start[0], east - start[1])
    beyond = 0.0
    for _ in range(round(seconds / DT)):
        motion.seek_position(north, east, down, speed=10.0, climb=2.5, descent=1.5)
        motion.step(DT)
        beyond = max(beyond, math.hypot(motion.north - start[0], motion.east - start[1]) - length)
    return beyond


def test_motion_arrives_without_overshoot() -> None:
    motion = hovering()
    assert go_to(motion, 60.0, 80.0, -30.0, 40.0) < 0.3
    assert (motion.north, motion.east, motion.down) == pytest.approx((60.0, 80.0, -30.0), abs=0.05)
    assert motion.ground_speed_m_s == pytest.approx(0.0, abs=0.01)


@given(
    north=st.floats(-300, 300),
    east=st.floats(-300, 300),
    down=st.floats(-100, -1),
)
def test_motion_respects_limits(north: float, east: float, down: float) -> None:
    motion = hovering()
    for _ in range(500):
        motion.seek_position(north, east, down, speed=8.0, climb=2.5, descent=1.5)
        motion.step(DT)
        assert motion.ground_speed_m_s <= 8.0 + 0.1
        assert -2.5 - 0.1 <= motion.velocity_down <= 1.5 + 0.1
        assert math.hypot(motion.acceleration_north, motion.acceleration_east) <= 2.5 + 1e-9
        assert abs(motion.pitch) <= motion.limits.lean_rad + 1e-9


def test_motion_leans_forward_to_start_and_back_to_stop() -> None:
    motion = hovering()
    motion.seek_velocity(10.0, 0.0, 0.0)
    fly(motion, 1.0)
    assert math.degrees(motion.pitch) < -10
    assert motion.roll == pytest.approx(0.0, abs=0.01)
    motion.seek_velocity(0.0, 0.0, 0.0)
    fly(motion, 0.5)
    assert math.degrees(motion.pitch) > 5


def test_hovering_in_wind_leans_into_wind() -> None:
    motion = hovering(SimulatedWind(north_m_s=-8.0))
    motion.seek_velocity(0.0, 0.0, 0.0)
    fly(motion, 5.0)
    assert math.degrees(motion.pitch) < -10
    assert motion.airspeed_m_s == pytest.approx(8.0)
    assert motion.ground_speed_m_s == pytest.approx(0.0, abs=1e-6)


def test_gusts_are_deterministic_for_seed() -> None:
    one, other = hovering(SimulatedWind(gusts_m_s=2.0)), hovering(SimulatedWind(gusts_m_s=2.0))
    fly(one, 5.0)
    fly(other, 5.0)
    assert one.airspeed_m_s == other.airspeed_m_s > 0.0


def test_motion_without_power_falls_and_records_impact() -> None:
    motion = hovering(height=20.0)
    while not motion.is_on_ground:
        motion.step(DT, powered=False)
    assert 12.0 < motion.impact_speed_m_s < math.sqrt(2 * 9.81 * 20.0)
    assert motion.down == 0.0


def test_motion_turns_shortest_way_at_turn_rate() -> None:
    motion = hovering()
    motion.yaw = math.radians(170)
    motion.face(math.radians(-170))
    fly(motion, 0.1)
    assert 0 < motion.yaw_rate <= motion.limits.turn_rate_rad_s
    fly(motion, 5.0)
    assert math.degrees(motion.yaw) == pytest.approx(-170, abs=0.5)


@given(st.floats(-100, 100))
def test_wrap_pi_keeps_direction(angle: float) -> None:
    assert -math.pi <= wrap_pi(angle) <= math.pi
    assert math.cos(wrap_pi(angle)) == pytest.approx(math.cos(angle), abs=1e-6)


@given(st.floats(0, 1000), st.floats(0.1, 10))
def test_approach_speed_allows_stop_in_time(distance: float, deceleration: float) -> None:
    speed = approach_speed(distance, deceleration)
    assert speed * speed / (2 * deceleration) <= distance + 1e-6


@given(st.floats(-3000, 3000), st.floats(-3000, 3000), st.floats(-60, 60))
def test_local_frame_conversion_round_trips(north: float, east: float, latitude: float) -> None:
    frame = LocalFrame(GlobalPoint(round(latitude * 1e7), 85_000_000, 400.0))
    place = frame.to_global(north, east, -10.0)
    assert frame.to_local(place.latitude_e7, place.longitude_e7) == pytest.approx((north, east), abs=0.02)
    assert place.altitude_m == 410.0
