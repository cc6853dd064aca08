"""Conversion of values to JSON."""

from __future__ import annotations

import enum
import json
import math
from datetime import datetime, timedelta, timezone
from pathlib import PurePosixPath

import pytest

from aerokit import Position
from aerokit._internal.formatting import format_value, to_jsonable
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavModeFlag, MavState
from aerokit.mavlink.messages import Heartbeat


class Kind(enum.Enum):
    ONE = "one"


def test_to_jsonable_values() -> None:
    value = {
        "texts": ("a", None, True),
        Kind.ONE: 1.5,
        3: [math.nan, math.inf, -1],
        "bytes": b"\x01\xff",
        "time": datetime(2026, 11, 23, tzinfo=timezone.utc),
        "span": timedelta(seconds=1.5),
        "state": MavState.ACTIVE,
        "flags": MavModeFlag.SAFETY_ARMED | MavModeFlag.GUIDED_ENABLED,
        "path": PurePosixPath("/a"),
        "error": AerokitError("no"),
        "set": {1},
    }
    made = to_jsonable(value)
    assert made == {
        "texts": ["a", None, True],
        "ONE": 1.5,
        "3": [None, None, -1],
        "bytes": "01ff",
        "time": "2026-11-23T00:00:00+00:00",
        "span": 1.5,
        "state": "ACTIVE",
        "flags": made["flags"],
        "path": "/a",
        "error": "no",
        "set": [1],
    }
    assert set(made["flags"]) == {"SAFETY_ARMED", "GUIDED_ENABLED"}
    json.dumps(made, allow_nan=False)


def test_to_jsonable_objects_and_messages() -> None:
    assert to_jsonable(Position(47.0, 8.0, altitude_relative_m=3))["altitude_relative_m"] == 3
    heartbeat = to_jsonable(Heartbeat(2, 3, 81, 4, 3))
    assert (heartbeat["message"], heartbeat["custom_mode"]) == ("HEARTBEAT", 4)
    assert to_jsonable(Heartbeat) == str(Heartbeat)


@pytest.mark.parametrize(
    ("value", "text"), [(0.1354, "0.135"), (999.4, "999"), (999.6, "1000"), (-999.6, "-1000"), (1234.5, "1234")]
)
def test_format_value_never_has_exponents_near_thousand(value: float, text: str) -> None:
    assert format_value(value) == text
