"""``Mode`` and ``ModeTable``: flight modes with their names and numbers."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit._internal.formatting import did_you_mean, short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavModeFlag

CUSTOM_MODE_ENABLED = MavModeFlag.CUSTOM_MODE_ENABLED.value
SAFETY_ARMED = MavModeFlag.SAFETY_ARMED.value

NO_MODES: Mapping[int, str] = {}
_PREFIX_OF_NUMBER = "MODE"  # "MODE 42" is the name of a mode that is not in the table.
_MAX_CUSTOM_MODE = 0xFFFF_FFFF


class Mode(Snapshot):
    """A flight mode as reported by HEARTBEAT (https://mavlink.io/en/messages/minimal.html#HEARTBEAT).

    ``name`` is the autopilot's name (``"GUIDED"``, ``"POSCTL"``), or ``"MODE 42"`` for an unknown number;
    ``custom_mode`` is the number. ``base_mode`` (MAV_MODE_FLAG) changes with arming, so ``==`` ignores it.
    ``str(mode)`` is the name.
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
    """Table of names and numbers of the modes of one vehicle type. Lookups ignore case, spaces and underscores."""

    def __init__(self, names: Mapping[int, str], aliases: Mapping[str, str] | None = None) -> None:
        self._names = dict(names)
        self._numbers = {_key(name): number for number, name in names.items()}
        for alias, name in (aliases or {}).items():
            self._numbers.setdefault(_key(alias), self._numbers[_key(name)])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modes, in the order of their numbers."""
        return tuple(name for _, name in sorted(self._names.items()))

    @property
    def numbers(self) -> Mapping[int, str]:
        """Maps custom_mode to name."""
        return self._names

    def name_of(self, custom_mode: int, reported_names: Mapping[int, str] = NO_MODES) -> str:
        """Return the name of the mode with this number. ``reported_names`` has the modes that the vehicle reported by
        AVAILABLE_MODES.
        """
        return self._names.get(custom_mode) or reported_names.get(custom_mode) or f"{_PREFIX_OF_NUMBER} {custom_mode}"

    def find(self, mode: str | int | Mode, reported_names: Mapping[int, str] = NO_MODES) -> Mode:
        """Find a mode by name or number.

        Raises:
            InvalidArgument: the name is unknown; the text lists the known names.
        """
        if isinstance(mode, Mode):
            mode = mode.custom_mode
        number = self._check(mode) if isinstance(mode, int) else self._number_of(mode, reported_names)
        return Mode(self.name_of(number, reported_names), number)

    def _number_of(self, name: str, reported_names: Mapping[int, str]) -> int:
        """Return the number of a mode. The name may also be "MODE 42" or "42"."""
        key = _key(name)
        if key in self._numbers:
            return self._numbers[key]
        for number, reported_name in reported_names.items():
            if _key(reported_name) == key:
                return number
        # The mode number is in "MODE 42", or is the whole text.
        digits = key[len(_PREFIX_OF_NUMBER) :] if key.startswith(_PREFIX_OF_NUMBER) else key
        if digits.isdecimal() and len(digits) < 20:  # int() refuses thousands of digits with another error.
            return self._check(int(digits))
        raise InvalidArgument(self._unknown_name_text(name, reported_names))

    def _check(self, number: int) -> int:
        if not 0 <= number <= _MAX_CUSTOM_MODE:
            raise InvalidArgument(
                f"mode = {number} is not allowed: it must be a custom_mode from 0 to {_MAX_CUSTOM_MODE}"
            )
        return int(number)

    def _unknown_name_text(self, name: str, reported_names: Mapping[int, str]) -> str:
        further_names = (text for number, text in sorted(reported_names.items()) if number not in self._names)
        known_names = [*self.names, *further_names]
        hint = did_you_mean(name, known_names)
        return f"mode = {short_repr(name)} is not known{hint}; this vehicle's modes are {', '.join(known_names)}"


def is_armed(base_mode: int) -> bool:
    """Return True if HEARTBEAT.base_mode has the armed flag."""
    return bool(base_mode & SAFETY_ARMED)


def base_mode_name(base_mode: int) -> str:
    """Return the name of a mode that has no custom_mode."""
    names = {
        MavModeFlag.AUTO_ENABLED: "AUTO",
        MavModeFlag.GUIDED_ENABLED: "GUIDED",
        MavModeFlag.STABILIZE_ENABLED: "STABILIZE",
        MavModeFlag.MANUAL_INPUT_ENABLED: "MANUAL",
    }
    return next((name for flag, name in names.items() if base_mode & flag), "PREFLIGHT")


def _key(name: str) -> str:
    """Return the name as it is compared: ``"auto_rtl"`` becomes ``"AUTORTL"``."""
    return "".join(char for char in name.upper() if char.isalnum())
