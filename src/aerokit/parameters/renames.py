"""Parameters that ArduPilot renamed since 2015, most of them for version 4.7: old names on new firmware and back.

The vehicle converts its own values when it is updated; programs and files with the old names are what this is for.
What cannot be said one to one is not converted: :func:`replacement_of` says what does its work now. The facts are in
:mod:`aerokit.parameters.rename_table` (4.7, SI units) and :mod:`aerokit.parameters.rename_table` (before).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from decimal import Decimal
from functools import lru_cache
from types import MappingProxyType

from aerokit._internal.values import Snapshot
from aerokit.parameters.encoding import number_text
from aerokit.parameters.parameter import Parameter, ParameterType, to_float32
from aerokit.parameters.rename_table import GROUPS, INVERTED, OLDER, ONE_WAY, OTHER_NEW_NAMES, REPLACED

_ALL_CHECKS = 1
_CHECKS = 0x1FFFFE
"""Bits 1 to 20: every arming check that has a bit of its own."""
_EVERYTHING = -1


class ParameterRenamedWarning(UserWarning):
    """A parameter was named as another version of the firmware names it, and its value converted.

    Silence it with ``warnings.filterwarnings("ignore", category=ParameterRenamedWarning)``.
    """


class Rename(Snapshot):
    """One parameter under its old and its new name.

    ``divisor`` is what the old value is divided by to become the new one: 100 for centimetres that became metres.
    ``is_inverted`` is true for ARMING_CHECK (checks to make, 1 for all) and ARMING_SKIPCHK (checks to leave out).
    ``vehicles`` are the vehicle types that have it. ``also`` are other names in the new units, ``older`` other names
    in the old ones. It has its new name ``since`` a version of ArduPilot.
    """

    old: str
    new: str
    divisor: int = 1
    is_inverted: bool = False
    vehicles: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    older: tuple[str, ...] = ()
    since: str = "4.7"

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the newest first."""
        return (self.new, *self.also, *self.old_names)

    @property
    def old_names(self) -> tuple[str, ...]:
        """The names in the old units."""
        return (self.old, *self.older)

    @property
    def factor(self) -> float:
        """New value = old value × factor; it says nothing when the meaning is inverted."""
        return 1 / self.divisor

    def to_new(self, value: float) -> int | float:
        """The value in the new units; exact in decimal, so that 29 cm/s are 0.29 m/s and no neighbour of it."""
        if self.is_inverted:
            return _checks_to_skip(int(value))
        return value if self.divisor == 1 else _scaled(value, lambda decimal: decimal / self.divisor)

    def to_old(self, value: float) -> int | float:
        """The value in the old units."""
        if self.is_inverted:
            return _checks_to_make(int(value))
        return value if self.divisor == 1 else _scaled(value, lambda decimal: decimal * self.divisor)


class Renamed(Snapshot):
    """A parameter that was asked for under one name and that the vehicle has under another: ``name``."""

    asked: str
    name: str
    rename: Rename

    def to_vehicle(self, value: float, type: ParameterType | None = None) -> int | float:  # noqa: A002
        """What the program means, as the vehicle counts; rounded when ``type``, the vehicle's, is an integer type."""
        converted = self._convert(value, self.asked)
        return round(converted) if type is not None and type.is_integer else converted

    def to_asked(self, value: float) -> int | float:
        """What the vehicle has, as the program counts."""
        return self._convert(value, self.name)

    def parameter(self, parameter: Parameter) -> Parameter:
        """The vehicle's parameter under the name that was asked for, in its units; a scaled one is a REAL32."""
        default = None if parameter.default is None else self.to_asked(parameter.default)
        changed = parameter.replace(name=self.asked, value=self.to_asked(parameter.value), default=default)
        if self.rename.divisor == 1 or not self._is_of_other_units:
            return changed
        default = None if default is None else to_float32(default)
        return changed.replace(value=to_float32(changed.value), default=default, type=ParameterType.REAL32)

    @property
    def warning(self) -> str:
        """What to tell the user, once: it names the new name."""
        new = self.rename.new
        if self.asked in self.rename.old_names:
            text = f"{self.asked} is called {self.name} by this vehicle's firmware"
        else:
            text = f"{self.asked} is still called {self.name} by this vehicle's firmware"
        if not self._is_of_other_units:
            pass
        elif self.rename.is_inverted:
            text += "; the meaning of its bits is inverted, which was taken into account"
        elif self.rename.divisor != 1:
            old, other = sorted((self.asked, self.name), key=lambda name: name not in self.rename.old_names)
            text += f"; values were converted ({old} = {self.rename.divisor} × {other})"
        return text + f". Use {new}, its name since ArduPilot {self.rename.since}."

    def _convert(self, value: float, source: str) -> int | float:
        if not self._is_of_other_units:
            return value
        is_old = source in self.rename.old_names
        return self.rename.to_new(value) if is_old else self.rename.to_old(value)

    @property
    def _is_of_other_units(self) -> bool:
        old_names = self.rename.old_names
        return (self.asked in old_names) != (self.name in old_names)


def find_rename(name: str, other: str = "") -> Rename | None:
    """What is known of a parameter that was renamed, by any of its names; None for all others.

    Few names became different ones by the type of vehicle: ``other`` says which one is meant.
    """
    return next((row for row in _by_name().get(name, ()) if not other or other in row.names), None)


def other_names(name: str) -> tuple[str, ...]:
    """The other names of that parameter, the newest first; empty for one that was never renamed."""
    return tuple(other for row in _by_name().get(name, ()) for other in row.names if other != name)


def replacement_of(name: str) -> str:
    """What does the work of a parameter that has no successor of the same meaning, as a clause; empty if not known."""
    return REPLACED.get(name, "")


def to_known(name: str, known: Container[str]) -> Renamed | None:
    """How the vehicle with the ``known`` names calls ``name``.

    None when it knows that very name, or none of the parameter's names: then ask for it as it is.
    """
    if name in known:
        return None
    for other in other_names(name):
        if other in known:
            rename = find_rename(name, other)
            return None if rename is None else Renamed(name, other, rename)
    return None


def translate_values(
    values: Mapping[str, int | float],
    known: Container[str],
    types: Mapping[str, ParameterType] = MappingProxyType({}),
) -> tuple[dict[str, int | float], tuple[Renamed, ...]]:
    """The values of a file or table under the names and in the units of the vehicle that knows ``known``.

    Names that the vehicle does not know under any name stay as they are. Where the vehicle's own name is given, too,
    that one counts. ``types`` are the vehicle's, for rounding. Also returns what was renamed.
    """
    translated: dict[str, int | float] = {}
    renamed: list[Renamed] = []
    for name, value in values.items():
        found = to_known(name, known)
        if found is None:
            translated[name] = value
        elif found.name not in values:
            translated[found.name] = found.to_vehicle(value, types.get(found.name))
            renamed.append(found)
    return translated, tuple(renamed)


# ---------------------------------------------------------------------------------------- values


def _scaled(value: float, scale: Callable[[Decimal], Decimal]) -> float:
    """Scaled as a decimal number of the digits that a 32-bit number has."""
    try:
        return float(scale(Decimal(number_text(value))))
    except (ArithmeticError, ValueError):  # infinite, NaN, beyond 32 bits: nothing that a vehicle takes
        return value


def _checks_to_skip(checks: int) -> int:
    """All checks: skip none. None at all: skip everything, future checks included. Else: skip the others."""
    if checks & _ALL_CHECKS:
        return 0
    return ~checks & _CHECKS if checks & _CHECKS else _EVERYTHING


def _checks_to_make(skipped: int) -> int:
    return _ALL_CHECKS if skipped == 0 else ~skipped & _CHECKS


@lru_cache(maxsize=1)
def _by_name() -> Mapping[str, tuple[Rename, ...]]:
    rows: dict[str, Rename] = {}
    for vehicles, divisor, pairs in GROUPS:
        for old, new in _pairs(pairs):
            row = Rename(old, new, divisor, old in INVERTED, vehicles, OTHER_NEW_NAMES.get(new, ()))
            rows.update(dict.fromkeys(row.names, row))
    for since, vehicles, divisor, pairs in OLDER:
        for old, new in _pairs(pairs):
            row = rows.get(new) or Rename(old, new, divisor, vehicles=vehicles, since=since)
            if old not in row.names:  # its new name is the old one of a later renaming, in the same unit
                row = row.replace(older=(*row.older, old))
            rows.update(dict.fromkeys(row.names, row))
    found: dict[str, tuple[Rename, ...]] = {name: (row,) for name, row in rows.items()}
    for since, vehicles, divisor, pairs in ONE_WAY:
        for old, new in _pairs(pairs):
            row = Rename(old, new, divisor, vehicles=vehicles, since=since)
            found[old] = (*found.get(old, ()), row)
    return MappingProxyType(found)


def _pairs(text: str) -> list[list[str]]:
    return [pair.split(">") for pair in text.split()]
