"""What decoders share: what they may know, and numbers that mean "unknown".

Values are immutable, in SI units and degrees, the unit in the name. A number that the standard marks as unknown
(UINT16_MAX, −1, NaN …) is None, never a number. Angles are degrees, lengths metres, speeds metres per second;
directions are clockwise from north; ``down`` is positive downwards.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.autopilots import Autopilot

__all__ = ["I16", "U8", "U16", "Context", "finite", "member", "scaled", "unless"]

U8, U16 = 0xFF, 0xFFFF
I16 = 0x7FFF


class Context:
    """What a decoder may know beside the message; ``before`` is the latest value of the state that it decodes."""

    __slots__ = ("autopilot", "base_mode", "before", "home_is_known", "mode_names")

    def __init__(
        self, autopilot: Autopilot, mode_names: Mapping[int, str], home_is_known: Callable[[], bool]
    ) -> None:
        self.autopilot: Autopilot = autopilot
        self.mode_names: Mapping[int, str] = mode_names
        self.home_is_known: Callable[[], bool] = home_is_known
        self.base_mode: int = 0
        self.before: Any = None


def member(enum: type[int], value: int) -> int:
    """The enum's member, or the number itself when the enum does not know it."""
    return enum._value2member_map_.get(value, value)  # type: ignore[attr-defined,no-any-return]


def finite(value: float) -> float | None:
    """The number, None for NaN and infinity."""
    return value if math.isfinite(value) else None


def unless(value: int, unknown: int) -> int | None:
    """The number, None when it is the one that stands for unknown."""
    return None if value == unknown else value


def scaled(value: int, unknown: int, divisor: int) -> float | None:
    """The number by ``divisor``, None when it is the one that stands for unknown."""
    return None if value == unknown else value / divisor
