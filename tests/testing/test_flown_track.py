"""Properties and assertions of a track."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from aerokit import Position
from aerokit.testing import Track, TrackPoint
from aerokit.testing.track import min_distance_m

HOME = Position(47.0, 8.0, 400.0)
GROUND = Position(47.0, 8.0, altitude_relative_m=0.0)


def at(
    time_s: float,
    north_m: float,
    east_m: float,
    altitude_m: float,
    mode: str = "AUTO",
    speed_m_s: float = 0.0,
    *,
    armed: bool = True,
) -> TrackPoint:
    place = HOME.offset(north_m=north_m, east_m=east_m)
    battery = 100 - time_s / 4
    return TrackPoint(time_s, place.latitude_deg, place.longitude_deg, altitude_m, armed, mode, speed_m_s, battery)


@pytest.fixture
def track() -> Track:
    """Return a track of 100 m to the north at 20 m, and back to 5 m east of home."""
    return Track(
        HOME,
        [
            at(0, 0, 0, 0, "STABILIZE", armed=False),
            at(5, 0, 0, 20),
            at(15, 100, 0, 20, speed_m_s=10),
            at(25, 0, 5, 20, "RTL"),
            at(40, 0, 5, 0.0, "RTL", armed=False),
        ],
    )


def test_track_properties_of_a_flight(track: Track) -> None:
    assert track.max_altitude_m == 20
    assert track.max_distance_m == pytest.approx(100, abs=0.01)
    assert track.modes == ["STABILIZE", "AUTO", "RTL"]
    assert track.armed_s == 35
    assert track.end.time_s == 40
    assert track.max_speed_m_s == 10
    assert track.battery_used_percent == 10
    assert track.length_m == pytest.approx(20 + 100 + 100.1 + 20, abs=0.1)
    assert track.local()[2] == pytest.approx((100, 0, 20), abs=0.01)
    assert track.nearest_m(HOME.offset(north_m=50, east_m=7)) == pytest.approx(4.5, abs=0.01)  # Between two points.
    assert track.nearest_m(GROUND.offset(north_m=50, up_m=30)) == pytest.approx(10, abs=0.01)
    assert len(track[1:3]) == 2


def test_true_assertions_pass(track: Track) -> None:
    track.assert_reached_altitude(20)
    track.assert_stayed_below(20)
    track.assert_passed(GROUND.offset(north_m=100, up_m=20), within_m=1)
    track.assert_stayed_within(101)
    track.assert_stayed_inside([HOME.offset(north_m=n, east_m=e) for n, e in ((-9, -9), (120, 0), (-9, 20))])
    track.assert_landed_near(within_m=6)
    track.assert_landed_near(HOME.offset(east_m=5), within_m=0.1)
    track.assert_disarmed_at_end()
    track.assert_modes("AUTO", "RTL")
    track.assert_stayed_slower_than(10)


def test_minimum_distance_of_two_tracks(track: Track) -> None:
    other = Track(HOME.offset(up_m=5), [at(9, 50, 0, 20), at(11, 50, 20, 20)])
    distance, time_s = min_distance_m(other, track)
    assert distance == pytest.approx(11.2, abs=0.1)  # 10 m before the position and 5 m below it.
    assert time_s == 9
    assert min_distance_m(track, Track(HOME, [at(50, 0, 0, 0)]))[0] == float("inf")


SQUARE = [HOME.offset(north_m=n, east_m=e) for n, e in ((-9, -9), (50, -9), (50, 20), (-9, 20))]
WRONG: dict[str, Callable[[Track], None]] = {
    r"did not reach 30 m: the highest point was at 5\.0 s: .*, 20\.0 m above home, armed, AUTO": (
        lambda track: track.assert_reached_altitude(30)
    ),
    "rose above 19 m: at 5.0 s": lambda track: track.assert_stayed_below(19),
    r"within 5 m of .*: the minimum distance was 100\.0 m, at 15\.0 s": (
        lambda track: track.assert_passed(HOME.offset(north_m=200), within_m=5)
    ),
    r"left the 50 m around home: 100\.0 m away at 15\.0 s": lambda track: track.assert_stayed_within(50),
    r"1 of 5 points are outside, the first at 15\.0 s": lambda track: track.assert_stayed_inside(SQUARE),
    r"landed 5\.0 m from home, not within 2 m": lambda track: track.assert_landed_near(),
    r"faster than 9 m/s: 10\.0 m/s at 15\.0 s": lambda track: track.assert_stayed_slower_than(9),
    "is disarmed at the end, at 40.0 s": lambda track: track.assert_armed_at_end(),
    "AUTO is missing in RTL → AUTO → RTL: the modes were STABILIZE → AUTO → RTL": (
        lambda track: track.assert_modes("RTL", "AUTO", "RTL")
    ),
    "not on the ground: the track ends at 25.0 s": (
        lambda track: Track(track.home, track[:-1]).assert_landed_near(within_m=9)
    ),
    "never took off": lambda track: Track(track.home, track[:1]).assert_landed_near(),
    "the track is empty": lambda track: Track(track.home).assert_stayed_below(10),
    "at least three positions, not 2": lambda track: track.assert_stayed_inside(SQUARE[:2]),
}


@pytest.mark.parametrize("text", WRONG)
def test_failed_assertions_describe_the_flight(track: Track, text: str) -> None:
    with pytest.raises(AssertionError, match=text):
        WRONG[text](track)
