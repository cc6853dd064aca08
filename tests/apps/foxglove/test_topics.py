"""Foxglove topics: messages match the vehicle state, and the schemas match the messages."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from aerokit import messages as m
from aerokit.logs.convert import topics
from aerokit.position import Position
from aerokit.vehicle.state.condition import StatusText
from aerokit.vehicle.state.movement import Attitude, Home, Velocity

PLACE = Position(47.4, 8.5, altitude_amsl_m=500.0, altitude_relative_m=12.0)


def fits(value: Any, schema: Any) -> bool:
    """Check a value against the parts of JSON Schema that aerokit uses."""
    kinds: dict[str, Any] = {
        "object": dict,
        "array": list,
        "string": str,
        "number": (int, float),
        "integer": int,
        "boolean": bool,
    }
    if not schema or value is None:
        return True
    if not isinstance(value, kinds[schema["type"]]):
        return False
    if schema["type"] == "object":
        known = schema["properties"]
        return set(schema.get("required", ())) <= value.keys() <= known.keys() and all(
            fits(each, known[name]) for name, each in value.items()
        )
    return schema["type"] != "array" or all(fits(each, schema["items"]) for each in value)


def rotated(rotation: dict[str, float], x: float, y: float, z: float) -> tuple[float, ...]:
    """A vector turned by a quaternion."""
    w, a, b, c = (rotation[name] for name in "wxyz")
    return (
        (1 - 2 * (b * b + c * c)) * x + 2 * (a * b - w * c) * y + 2 * (a * c + w * b) * z,
        2 * (a * b + w * c) * x + (1 - 2 * (a * a + c * c)) * y + 2 * (b * c - w * a) * z,
        2 * (a * c - w * b) * x + 2 * (b * c + w * a) * y + (1 - 2 * (a * a + b * b)) * z,
    )


@pytest.mark.parametrize(
    ("attitude", "axis", "points"),
    [
        (Attitude(0, 0, 0), (1, 0, 0), (0, 1, 0)),  # nose: north
        (Attitude(0, 0, 90), (1, 0, 0), (1, 0, 0)),  # nose: east
        (Attitude(0, 30, 0), (1, 0, 0), (0, math.cos(math.pi / 6), 0.5)),  # nose: up
        (Attitude(90, 0, 0), (0, 1, 0), (0, 0, 1)),  # right side down: the left one is up
        (Attitude(0, 0, 0), (0, 0, 1), (0, 0, 1)),
    ],
)
def test_rotation_uses_axes_of_viewer(
    attitude: Attitude, axis: tuple[float, float, float], points: tuple[float, float, float]
) -> None:
    fields = topics.frame_transform(0.0, 1, (1, 2, 3), attitude)
    assert rotated(fields["rotation"], *axis) == pytest.approx(points, abs=1e-12)
    assert fields["translation"] == {"x": 1, "y": 2, "z": 3}
    assert fields["child_frame_id"] == "vehicle_1"


def test_map_origin_is_first_position_at_home_height() -> None:
    frame = topics.MapFrame()
    assert frame.east_north_up_m(PLACE) == pytest.approx((0, 0, 12))
    assert frame.east_north_up_m(PLACE.offset(north_m=100, east_m=-20, up_m=5)) == pytest.approx(
        (-20, 100, 17), abs=1e-3
    )


def test_map_origin_height_is_of_first_known_altitude() -> None:
    frame = topics.MapFrame()
    assert frame.east_north_up_m(Position(47.4, 8.5, altitude_relative_m=12.0)) == pytest.approx((0, 0, 12))
    assert frame.east_north_up_m(PLACE) == pytest.approx((0, 0, 12))


def test_location_fix_omits_unknown_velocity() -> None:
    fix = topics.location_fix(0.0, 1, PLACE, velocity=Velocity(1.0, 2.0, math.nan))
    assert "velocity" not in fix


def test_location_fix_uses_units_of_viewer() -> None:
    fix = topics.location_fix(1_700_000_000.25, 7, PLACE, 90.0, Velocity(1.0, 2.0, 3.0))
    assert fix["timestamp"] == {"sec": 1_700_000_000, "nsec": 250_000_000}
    assert (fix["latitude"], fix["longitude"], fix["altitude"]) == (47.4, 8.5, 500.0)
    assert fix["heading"] == pytest.approx(math.pi / 2)
    assert fix["velocity"] == {"x": 2.0, "y": 1.0, "z": -3.0}


@pytest.mark.parametrize(("severity", "level"), [(0, 5), (2, 5), (3, 4), (4, 3), (5, 2), (6, 2), (7, 1), (99, 0)])
def test_severity_maps_to_log_level(severity: int, level: int) -> None:
    entry = topics.log_entry(5.0, 1, StatusText(severity, "hello"))
    assert (entry["level"], entry["message"], entry["name"]) == (level, "hello", "vehicle_1")


def test_messages_match_schemas() -> None:
    attitude = Attitude(1.0, 2.0, 3.0)
    written = [
        (topics.location_fix(1.0, 1, PLACE), topics.LOCATION_FIX),
        (topics.location_fix(1.0, 1, PLACE, 1.0, Velocity(1, 2, 3)), topics.LOCATION_FIX),
        (topics.frame_transform(1.0, 1, (1.0, 2.0, 3.0), None), topics.FRAME_TRANSFORM),
        (topics.pose_in_frame(1.0, (1.0, 2.0, 3.0), attitude), topics.POSE_IN_FRAME),
        (topics.log_entry(1.0, 1, StatusText(3, "x")), topics.LOG),
    ]
    for value in (attitude, Home(1.0, 2.0, 3.0), 3.5, True, (PLACE, PLACE), ()):
        topic = topics.state_topic(1, "it", value)
        written.append((topics.state_fields(value), topic.schema))  # type: ignore[arg-type]
    for fields, schema in written:
        assert fits(json.loads(topics.encoded(fields)), schema), schema


def test_schema_of_unknown_field_has_declared_type() -> None:
    schema = topics.state_topic(3, "home", Home(1.0, 2.0, 3.0)).schema
    assert schema["properties"]["north_m"] == {"type": "number"}
    assert schema["title"] == "aerokit.home"


def test_raw_topic_has_units_and_no_secrets() -> None:
    position = m.GlobalPositionInt(1, 474000000, 85000000, 5, 6, 7, 8, 9, 10)
    topic = topics.raw_topic(1, 1, m.GlobalPositionInt)
    assert topic.name == "/mavlink/1/1/GLOBAL_POSITION_INT"
    assert topic.schema["properties"]["lat"]["description"].endswith("[degE7]")
    assert fits(topics.raw_fields(position), topic.schema)
    assert topics.raw_fields(position)["lat"] == 474000000
    secret = m.SetupSigning(1, 1, b"k" * 32, 5)
    assert "secret_key" not in topics.raw_fields(secret)
    assert "secret_key" not in topics.raw_topic(1, 1, m.SetupSigning).schema["properties"]


def test_nan_is_encoded_as_null() -> None:
    nowhere = m.VfrHud(math.nan, math.inf, 0, 0, 0.0, 0.0)
    assert json.loads(topics.encoded(topics.raw_fields(nowhere)))["airspeed"] is None
