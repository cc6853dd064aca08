"""What builders share: a place with exactly one altitude, numbers in their ranges, items without a place."""

from __future__ import annotations

import math

from aerokit.errors import InvalidArgument
from aerokit.geo import check_place
from aerokit.mavlink.enums import MavFrame
from aerokit.missions.item import MissionItem

__all__ = ["HIGHEST_M", "action", "altitude_and_frame", "heading", "in_range", "place", "whole"]

HIGHEST_M = 83_000.0
"""ArduPilot stores no altitude beyond (its LOCATION_ALT_MAX_M)."""

Altitudes = tuple["float | None", "float | None", "float | None"]


def place(
    command: int,
    latitude_deg: float | None,
    longitude_deg: float | None,
    altitudes: Altitudes,
    *parameters: float,
) -> MissionItem:
    """An item at a place; ``altitudes`` are those relative to home, above the sea, above the terrain: one is given.

    Without latitude and longitude it is 0°, 0°, by which ArduPilot means where the vehicle is then.
    """
    z, frame = altitude_and_frame(*altitudes)
    if latitude_deg is None and longitude_deg is None:
        return MissionItem(command, frame, *_four(parameters), z=z)
    if latitude_deg is None or longitude_deg is None:
        raise InvalidArgument("latitude_deg and longitude_deg: give both or none of them")
    in_range("latitude_deg", latitude_deg, -90, 90)
    in_range("longitude_deg", longitude_deg, -180, 180)
    check_place(latitude_deg, longitude_deg)
    x, y = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    return MissionItem(command, frame, *_four(parameters), x, y, z)


def altitude_and_frame(
    relative_m: float | None, amsl_m: float | None, terrain_m: float | None
) -> tuple[float, MavFrame]:
    """The one altitude that is given, and the frame that says what it is above."""
    given = {
        name: (value, frame)
        for name, value, frame in (
            ("altitude_relative_m", relative_m, MavFrame.GLOBAL_RELATIVE_ALT),
            ("altitude_amsl_m", amsl_m, MavFrame.GLOBAL),
            ("altitude_terrain_m", terrain_m, MavFrame.GLOBAL_TERRAIN_ALT),
        )
        if value is not None
    }
    if len(given) != 1:
        raise InvalidArgument(
            "give exactly one of altitude_relative_m (above home), altitude_amsl_m (above mean sea level) and"
            f" altitude_terrain_m (above the ground), not {' and '.join(given) or 'none'}"
        )
    ((name, (value, frame)),) = given.items()
    in_range(name, value, -HIGHEST_M, HIGHEST_M)
    return float(value), frame


def action(command: int, *parameters: float, z: float = 0.0) -> MissionItem:
    """An item without a place, in the frame that PX4 wants for those: MISSION."""
    return MissionItem(command, MavFrame.MISSION, *_four(parameters), z=z)


def in_range(name: str, value: object, low: float, high: float, *, or_: tuple[float, ...] = ()) -> float:
    """The value; :class:`InvalidArgument` unless it is a number from low to high, or one of ``or_``."""
    if (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and (low <= value <= high or value in or_)
    ):
        return float(value)
    others = "".join(f", or {other:g}" for other in or_)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: {low:g} to {high:g}{others}")


def whole(name: str, value: object, low: int, high: int) -> float:
    """The value; :class:`InvalidArgument` unless it is a whole number from low to high."""
    if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
        return float(value)
    raise InvalidArgument(f"{name} = {value!r} is not allowed: a whole number from {low} to {high}")


def heading(name: str, value: float | None) -> float:
    """The heading in degrees, NaN (the standard's "not given") for None."""
    return math.nan if value is None else in_range(name, value, -360, 360)


def _four(parameters: tuple[float, ...]) -> tuple[float, float, float, float]:
    one, two, three, four = (*parameters, 0.0, 0.0, 0.0, 0.0)[:4]
    return one, two, three, four
