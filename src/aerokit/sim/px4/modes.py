"""Modes of PX4 as (main, sub) pairs, and their requirements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from aerokit.mavlink.enums import MavModeFlag

Px4Mode = tuple[int, int]

AUTO: Final = 4
"""Main mode of all automatic modes."""

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
class Px4ModeTraits:
    """Name, base mode and requirements of a mode."""

    name: str
    """Name in the status text "Switching to … is currently not available"."""
    base_mode: int
    """MAV_MODE_FLAGs that HEARTBEAT reports in this mode while the vehicle is disarmed."""
    needs_sticks: bool = False
    needs_position: bool = True
    can_arm: bool = True
    """True if the vehicle can be armed in this mode."""


MODES: Final[dict[Px4Mode, Px4ModeTraits]] = {
    MANUAL: Px4ModeTraits("Manual", _BY_HAND, needs_sticks=True, needs_position=False),
    ALTITUDE: Px4ModeTraits("Altitude", _BY_HAND, needs_sticks=True, needs_position=False),
    POSITION: Px4ModeTraits("Position", _BY_HAND, needs_sticks=True),
    ORBIT: Px4ModeTraits("Orbit", _STABILIZED, can_arm=False),
    POSITION_SLOW: Px4ModeTraits("Position Slow", _BY_HAND, needs_sticks=True),
    TAKEOFF: Px4ModeTraits("Takeoff", _AUTO),
    HOLD: Px4ModeTraits("Hold", _AUTO),
    MISSION: Px4ModeTraits("Mission", _AUTO),
    RTL: Px4ModeTraits("Return", _AUTO, can_arm=False),
    LAND: Px4ModeTraits("Land", _AUTO, needs_position=False, can_arm=False),
    FOLLOW_TARGET: Px4ModeTraits("Follow Target", _STABILIZED, can_arm=False),
    PRECISION_LAND: Px4ModeTraits("Precision Landing", _AUTO, can_arm=False),
    VTOL_TAKEOFF: Px4ModeTraits("VTOL Takeoff", _AUTO, can_arm=False),
    EXTERNAL_1: Px4ModeTraits("External 1", _STABILIZED, can_arm=False),
    ACRO: Px4ModeTraits(
        "Acro", int(_CUSTOM | MavModeFlag.MANUAL_INPUT_ENABLED), needs_sticks=True, needs_position=False
    ),
    OFFBOARD: Px4ModeTraits("Offboard", _CUSTOM),
    STABILIZED: Px4ModeTraits("Stabilized", _BY_HAND, needs_sticks=True, needs_position=False),
    ALTITUDE_CRUISE: Px4ModeTraits("Altitude Cruise", _BY_HAND, needs_sticks=True, needs_position=False),
    TERMINATION: Px4ModeTraits("Termination", _CUSTOM, needs_position=False, can_arm=False),
}
"""The simulated modes."""

SELECTABLE: Final = frozenset(MODES) - {ORBIT, TERMINATION, VTOL_TAKEOFF}
"""Modes that DO_SET_MODE and SET_MODE accept. ORBIT, for example, is started by DO_ORBIT instead."""

STICK_MODES: Final = frozenset(mode for mode, traits in MODES.items() if traits.needs_sticks)
"""The manual modes, which need stick positions."""

STANDARD_MODES: Final[dict[int, Px4Mode]] = {
    1: POSITION,
    2: ORBIT,
    4: ALTITUDE,
    5: RTL,
    6: MISSION,
    7: LAND,
    8: TAKEOFF,
}
"""The mode for each MAV_STANDARD_MODE, as DO_SET_STANDARD_MODE selects it."""


def custom_mode(mode: Px4Mode) -> int:
    main, sub = mode
    return main << 16 | sub << 24


def mode_from_custom(value: int) -> Px4Mode:
    return (value >> 16 & 0xFF, value >> 24 & 0xFF)
