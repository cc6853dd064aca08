"""PX4's modes as (main, sub) pairs, what custom_mode makes of them, and what each of them needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from aerokit.mavlink.enums import MavModeFlag

Px4Mode = tuple[int, int]

AUTO: Final = 4
"""The main mode of all that fly by themselves."""

MANUAL: Final[Px4Mode] = (1, 0)
ALTITUDE: Final[Px4Mode] = (2, 0)
POSITION: Final[Px4Mode] = (3, 0)
ORBIT: Final[Px4Mode] = (3, 1)
POSITION_SLOW: Final[Px4Mode] = (3, 2)
TAKEOFF: Final[Px4Mode] = (4, 2)
HOLD: Final[Px4Mode] = (4, 3)
MISSION: Final[Px4Mode] = (4, 4)
RTL: Final[Px4Mode] = (4, 5)
LAND: Final[Px4Mode] = (4, 6)
FOLLOW_TARGET: Final[Px4Mode] = (4, 8)
PRECISION_LAND: Final[Px4Mode] = (4, 9)
VTOL_TAKEOFF: Final[Px4Mode] = (4, 10)
EXTERNAL_1: Final[Px4Mode] = (4, 11)
ACRO: Final[Px4Mode] = (5, 0)
OFFBOARD: Final[Px4Mode] = (6, 0)
STABILIZED: Final[Px4Mode] = (7, 0)
TERMINATION: Final[Px4Mode] = (10, 0)
ALTITUDE_CRUISE: Final[Px4Mode] = (11, 0)

_CUSTOM = int(MavModeFlag.CUSTOM_MODE_ENABLED)
_STABILIZED = int(_CUSTOM | MavModeFlag.STABILIZE_ENABLED)
_BY_HAND = int(_STABILIZED | MavModeFlag.MANUAL_INPUT_ENABLED)
_AUTO = int(_STABILIZED | MavModeFlag.GUIDED_ENABLED | MavModeFlag.AUTO_ENABLED)


@dataclass(frozen=True)
class ModeTraits:
    """What a mode is called, what HEARTBEAT says in it, and what it needs."""

    name: str
    """As in "Switching to … is currently not available"."""
    base_mode: int
    """MAV_MODE_FLAGs while disarmed."""
    needs_sticks: bool = False
    needs_position: bool = True
    can_arm: bool = True
    """Whether it lets the vehicle be armed."""


KNOWN: Final[dict[Px4Mode, ModeTraits]] = {
    MANUAL: ModeTraits("Manual", _BY_HAND, needs_sticks=True, needs_position=False),
    ALTITUDE: ModeTraits("Altitude", _BY_HAND, needs_sticks=True, needs_position=False),
    POSITION: ModeTraits("Position", _BY_HAND, needs_sticks=True),
    ORBIT: ModeTraits("Orbit", _STABILIZED, can_arm=False),
    POSITION_SLOW: ModeTraits("Position Slow", _BY_HAND, needs_sticks=True),
    TAKEOFF: ModeTraits("Takeoff", _AUTO),
    HOLD: ModeTraits("Hold", _AUTO),
    MISSION: ModeTraits("Mission", _AUTO),
    RTL: ModeTraits("Return", _AUTO, can_arm=False),
    LAND: ModeTraits("Land", _AUTO, needs_position=False, can_arm=False),
    FOLLOW_TARGET: ModeTraits("Follow Target", _STABILIZED, can_arm=False),
    PRECISION_LAND: ModeTraits("Precision Landing", _AUTO, can_arm=False),
    VTOL_TAKEOFF: ModeTraits("VTOL Takeoff", _AUTO, can_arm=False),
    EXTERNAL_1: ModeTraits("External 1", _STABILIZED, can_arm=False),
    ACRO: ModeTraits(
        "Acro", int(_CUSTOM | MavModeFlag.MANUAL_INPUT_ENABLED), needs_sticks=True, needs_position=False
    ),
    OFFBOARD: ModeTraits("Offboard", _CUSTOM),
    STABILIZED: ModeTraits("Stabilized", _BY_HAND, needs_sticks=True, needs_position=False),
    ALTITUDE_CRUISE: ModeTraits("Altitude Cruise", _BY_HAND, needs_sticks=True, needs_position=False),
    TERMINATION: ModeTraits("Termination", _CUSTOM, needs_position=False, can_arm=False),
}
"""The modes that are simulated."""

SELECTABLE: Final = frozenset(KNOWN) - {ORBIT, TERMINATION, VTOL_TAKEOFF}
"""What DO_SET_MODE and SET_MODE take; ORBIT begins with DO_ORBIT."""

STICK_MODES: Final = frozenset(mode for mode, traits in KNOWN.items() if traits.needs_sticks)
"""Flown by hand."""

STANDARD_MODES: Final[dict[int, Px4Mode]] = {
    1: POSITION,
    2: ORBIT,
    4: ALTITUDE,
    5: RTL,
    6: MISSION,
    7: LAND,
    8: TAKEOFF,
}
"""MAV_STANDARD_MODE → mode, for DO_SET_STANDARD_MODE."""


def custom_mode(mode: Px4Mode) -> int:
    return mode[0] << 16 | mode[1] << 24


def mode_from_custom(value: int) -> Px4Mode:
    """The pair in a custom_mode."""
    return (value >> 16 & 0xFF, value >> 24 & 0xFF)
