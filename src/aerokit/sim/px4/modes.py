"""PX4's modes as (main, sub) pairs, and what custom_mode makes of them."""

from __future__ import annotations

from typing import Final

__all__ = [
    "ALTITUDE",
    "HOLD",
    "KNOWN",
    "LAND",
    "MANUAL",
    "MISSION",
    "OFFBOARD",
    "POSITION",
    "RTL",
    "TAKEOFF",
    "Px4Mode",
    "custom_mode",
    "mode_from_custom",
]

Px4Mode = tuple[int, int]

MANUAL: Final[Px4Mode] = (1, 0)
ALTITUDE: Final[Px4Mode] = (2, 0)
POSITION: Final[Px4Mode] = (3, 0)
TAKEOFF: Final[Px4Mode] = (4, 2)
HOLD: Final[Px4Mode] = (4, 3)
MISSION: Final[Px4Mode] = (4, 4)
RTL: Final[Px4Mode] = (4, 5)
LAND: Final[Px4Mode] = (4, 6)
ACRO: Final[Px4Mode] = (5, 0)
OFFBOARD: Final[Px4Mode] = (6, 0)
STABILIZED: Final[Px4Mode] = (7, 0)

KNOWN: Final = {
    MANUAL: "Manual",
    ALTITUDE: "Altitude",
    POSITION: "Position",
    TAKEOFF: "Takeoff",
    HOLD: "Hold",
    MISSION: "Mission",
    RTL: "Return",
    LAND: "Land",
    ACRO: "Acro",
    OFFBOARD: "Offboard",
    STABILIZED: "Stabilized",
}
"""The modes that are simulated; the names are for "Switching to … is currently not available"."""


def custom_mode(mode: Px4Mode) -> int:
    """As HEARTBEAT carries it."""
    return mode[0] << 16 | mode[1] << 24


def mode_from_custom(value: int) -> Px4Mode:
    """The pair in a custom_mode."""
    return (value >> 16 & 0xFF, value >> 24 & 0xFF)
