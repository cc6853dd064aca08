"""Flight modes: the value a program sees, and the table that knows their names and numbers."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import did_you_mean, shown
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavModeFlag

CUSTOM_MODE_ENABLED = MavModeFlag.CUSTOM_MODE_ENABLED.value
"""``custom_mode`` tells the mode."""
SAFETY_ARMED = MavModeFlag.SAFETY_ARMED.value

NO_MODES: Mapping[int, str] = {}
"""No modes beside the built-in ones."""
_UNKNOWN = "MODE"
_MAX_CUSTOM_MODE = 0xFFFF_FFFF


class Mode(Snapshot):
    """A flight mode, as HEARTBEAT tells it (https://mavlink.io/en/messages/minimal.html#HEARTBEAT).

    ``name`` is the autopilot's own name for it (``"GUIDED"``, ``"POSCTL"``), ``"MODE 42"`` for a number that
    no table knows; ``custom_mode`` is its number. ``base_mode`` (MAV_MODE_FLAG bits) is left out of
    comparisons, because it changes with arming. ``str(mode)`` is the name.
    """

    name: str
    custom_mode: int
    base_mode: int = CUSTOM_MODE_ENABLED

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Mode):
            return NotImplemented
        return self.custom_mode == other.custom_mode and self.name == other.name

    def __hash__(self) -> int:
        return hash((self.name, self.custom_mode))

    def __str__(self) -> str:
        return self.name


class ModeTable:
    """Names and numbers of one kind of vehicle. Case, spaces and underscores do not matter."""

    def __init__(self, names: Mapping[int, str], aliases: Mapping[str, str] | None = None) -> None:
        self._names = dict(names)
        self._numbers = {_key(name): number for number, name in names.items()}
        for alias, name in (aliases or {}).items():
            self._numbers.setdefault(_key(alias), self._numbers[_key(name)])

    @property
    def names(self) -> tuple[str, ...]:
        """The names in the order of their numbers."""
        return tuple(name for _, name in sorted(self._names.items()))

    @property
    def numbers(self) -> Mapping[int, str]:
        """custom_mode → name."""
        return self._names

    def name_of(self, custom_mode: int, extra: Mapping[int, str] = NO_MODES) -> str:
        """The name of a number; ``extra`` holds modes that the vehicle told by AVAILABLE_MODES."""
        return self._names.get(custom_mode) or extra.get(custom_mode) or f"{_UNKNOWN} {custom_mode}"

    def find(self, mode: str | int | Mode, extra: Mapping[int, str] = NO_MODES) -> Mode:
        """The mode of this name or number.

        Raises :class:`InvalidArgument` with the names that are known when there is none of this name.
        """
        if isinstance(mode, Mode):
            mode = mode.custom_mode
        number = self._check(mode) if isinstance(mode, int) else self._number_of(mode, extra)
        return Mode(self.name_of(number, extra), number)

    def _number_of(self, name: str, extra: Mapping[int, str]) -> int:
        key = _key(name)
        if key in self._numbers:
            return self._numbers[key]
        for number, extra_name in extra.items():
            if _key(extra_name) == key:
                return number
        digits = key[len(_UNKNOWN) :] if key.startswith(_UNKNOWN) else key
        if digits.isdecimal():
            return self._check(int(digits))
        raise InvalidArgument(self._unknown(name, extra))

    def _check(self, number: int) -> int:
        if not 0 <= number <= _MAX_CUSTOM_MODE:
            raise InvalidArgument(f"mode = {number}: a custom_mode is a number from 0 to {_MAX_CUSTOM_MODE}")
        return int(number)

    def _unknown(self, name: str, extra: Mapping[int, str]) -> str:
        known = [*self.names, *(extra[n] for n in sorted(extra) if n not in self._names)]
        hint = did_you_mean(name, known)
        return f"mode = {shown(name)} is not known{hint}; this vehicle's modes are " + ", ".join(known)


def is_armed(base_mode: int) -> bool:
    """Whether HEARTBEAT.base_mode says that the motors are armed."""
    return bool(base_mode & SAFETY_ARMED)


def base_mode_name(base_mode: int) -> str:
    """A name for a mode that is told by the flags of base_mode alone (MAV_MODE_FLAG)."""
    for bit, name in ((4, "AUTO"), (8, "GUIDED"), (16, "STABILIZE"), (64, "MANUAL")):
        if base_mode & bit:
            return name
    return "PREFLIGHT"


def _key(name: str) -> str:
    return "".join(character for character in name.upper() if character.isalnum())
