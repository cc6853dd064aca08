"""Geodesy: known distances, and that offset and its inverse agree everywhere."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit._internal import geo
from aerokit.errors import InvalidArgument

latitudes = st.floats(-85, 85)
longitudes = st.floats(-180, 179.9)


def test_a_minute_of_latitude_is_a_nautical_mile() -> None:
    assert geo.distance_m(45, 8, 45 + 1 / 60, 8) == pytest.approx(1852, abs=1)


def test_distance_of_two_airports() -> None:
    # London Heathrow to New York JFK, the textbook figure for WGS 84
    assert geo.distance_m(51.4775, -0.461389, 40.639722, -73.778889) == pytest.approx(5_554_900, rel=1e-3)


@pytest.mark.parametrize(("north", "east", "bearing"), [(1, 0, 0), (0, 1, 90), (-1, 0, 180), (0, -1, 270)])
def test_bearings_are_clockwise_from_north(north: float, east: float, bearing: float) -> None:
    to = geo.offset(47.3977, 8.5456, north * 100, east * 100)
    assert geo.bearing_deg(47.3977, 8.5456, *to) == pytest.approx(bearing, abs=1e-3)


@given(latitudes, longitudes, st.floats(-5000, 5000), st.floats(-5000, 5000))
def test_offset_and_its_inverse_agree(latitude: float, longitude: float, north: float, east: float) -> None:
    there = geo.offset(latitude, longitude, north, east)
    assert geo.north_east_m(latitude, longitude, *there) == pytest.approx((north, east), abs=1e-3)
    geo.check_place(*there)


def test_geodesy_across_date_line() -> None:
    latitude, longitude = geo.offset(0, 179.9999, 0, 100)
    assert -180 <= longitude < -179.99
    assert geo.distance_m(0, 179.9999, latitude, longitude) == pytest.approx(100)


@pytest.mark.parametrize(
    ("latitude", "longitude", "text"),
    [
        (90.1, 0, "latitude_deg = 90.1"),
        (0, -181, "longitude_deg = -181"),
        (float("nan"), 0, "latitude_deg = nan"),
        ("47", 8, "latitude_deg = '47' is not allowed"),
        (47, None, "longitude_deg = None is not allowed"),
    ],
)
def test_check_place_names_invalid_field(latitude: Any, longitude: Any, text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        geo.check_place(latitude, longitude)


@given(st.floats(-1e6, 1e6))
def test_wrap_360_and_wrap_longitude(angle: float) -> None:
    assert 0 <= geo.wrap_360(angle) < 360
    assert -180 <= geo.wrap_longitude(angle) < 180


def test_wrap_360_of_tiny_negative_angle_is_zero() -> None:
    assert geo.wrap_360(-1e-20) == 0.0
