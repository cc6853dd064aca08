"""Values out of range are rejected by name, with the allowed range, before anything is sent."""

from __future__ import annotations

import math
import re
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from flight_harness import Flight

from aerokit import Position
from aerokit import messages as m
from aerokit._internal.arguments import check_range
from aerokit.errors import InvalidArgument

pytestmark = pytest.mark.anyio


def place(vehicle: Any, **altitudes: float) -> Position:
    home = vehicle.home.value
    return Position(home.latitude_deg, home.longitude_deg, **altitudes)


async def entered(block: Any) -> None:
    with block:
        raise AssertionError("entered")


REFUSED: dict[str, Callable[[Any], Awaitable[object]]] = {
    "altitude_m = -1 is not allowed: it must be above 0 and at most 10000": lambda v: v.take_off(-1),
    "altitude = 200000 is not allowed: it must be -12000 to 100000": lambda v: v.go_to(
        place(v, altitude_relative_m=200_000)
    ),
    "speed_m_s = -1 is not allowed: it must be above 0 and at most 1000": lambda v: v.set_speed(-1),
    "speed_m_s = -2 is not allowed: it must be above 0 and at most 1000": lambda v: v.go_to(place(v), speed_m_s=-2),
    "heading_deg = -1 is not allowed: it must be 0 to 360": lambda v: v.go_to(place(v), heading_deg=-1),
    "tolerance_m = -1 is not allowed: it must be above 0 and at most 100000": lambda v: v.go_to(
        place(v), tolerance_m=-1
    ),
    "heading_deg = 999 is not allowed: it must be -360 to 360": lambda v: v.set_heading(999),
    "rate_deg_s = -1 is not allowed: it must be 0 to 360": lambda v: v.set_heading(0, rate_deg_s=-1),
    "tolerance_deg = -1 is not allowed: it must be above 0 and at most 180": lambda v: v.set_heading(
        0, tolerance_deg=-1
    ),
    "pitch_deg = 999 is not allowed: it must be -360 to 360": lambda v: v.gimbal.point(999, 0),
    "rate_hz = 1 is not allowed: it must be 2 to 400": lambda v: entered(v.guided.velocity(rate_hz=1)),
    "valid_for_s = 61 is not allowed: it must be above 0 and at most 60": lambda v: entered(
        v.guided.velocity(valid_for_s=61)
    ),
    "max_lag_s = 61 is not allowed: it must be above 0 and at most 60": lambda v: entered(
        v.guided.velocity(max_lag_s=61)
    ),
    "rate_hz of ATTITUDE = -1 is not allowed: it must be above 0 and at most 1000": lambda v: entered(
        v.rate(m.Attitude, -1)
    ),
    "rate_hz = -1 is not allowed: it must be above 0 and at most 1000": lambda v: entered(v.streams(-1)),
}


ALLOWED = [(0, False), (1000, False), (1000, True), (1e-9, True)]
NOT_ALLOWED = [(0, True), (-1e-9, False), (1000.001, False), (math.nan, False), (math.inf, True)]


@pytest.mark.parametrize(("value", "above"), ALLOWED)
def test_range_limits_are_inclusive(value: float, above: bool) -> None:
    check_range("it", value, 0, 1000, above=above)


@pytest.mark.parametrize(("value", "above"), NOT_ALLOWED)
def test_range_limits_exceeded_raise(value: float, above: bool) -> None:
    with pytest.raises(InvalidArgument, match=r"^it = .* is not allowed: .*0 (to|and at most) 1000$"):
        check_range("it", value, 0, 1000, above=above)


async def test_out_of_range(flying: Flight) -> None:
    for text, call in REFUSED.items():
        with pytest.raises(InvalidArgument, match=f"^{re.escape(text)}$"):
            await call(flying.vehicle)
    kinds = (m.CommandLong, m.CommandInt, m.SetPositionTargetGlobalInt)
    assert not [message for kind in kinds for message in flying.wire.all(kind)]
