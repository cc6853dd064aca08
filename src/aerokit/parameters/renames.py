"""Parameters that ArduPilot renamed since 2015, most of them in version 4.7: old names on new firmware and vice versa.

A vehicle converts its own values on a firmware update. This module is for programs and files that have old names.
Changes that are not one to one are not converted; :func:`replacement_of` describes them. The data is in
:mod:`aerokit.parameters.rename_table`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from decimal import Decimal
from functools import lru_cache
from types import MappingProxyType

from aerokit._internal.values import Snapshot
from aerokit.parameters import rename_table
from aerokit.parameters.encoding import number_text
from aerokit.parameters.parameter import Parameter, ParameterType, to_float32

# Bit 0 of ARMING_CHECK enables all checks, bits 1 to 20 enable single checks. ARMING_SKIPCHK = -1 skips all.
_ALL_BIT = 1
_SINGLE_CHECKS = 0x1FFFFE
_SKIP_ALL = -1


class ParameterRenamedWarning(UserWarning):
    """A parameter was used under the name of another firmware version. If its units differ, its value was converted.

    Silence it with ``warnings.filterwarnings("ignore", category=ParameterRenamedWarning)``.
    """


class Rename(Snapshot):
    """A renamed parameter.

    Old values are divided by ``divisor``: 100 for centimetres that became metres. ``is_inverted`` is True for
    ARMING_CHECK (checks to make, 1 for all) and ARMING_SKIPCHK (checks to skip). ``vehicles`` are the vehicle types
    that have the parameter. ``other_new`` are further names with the units of ``new``, ``other_old`` with those of
    ``old``. ``since`` is the ArduPilot version that introduced the new name.
    """

    old: str
    new: str
    divisor: int = 1
    is_inverted: bool = False
    vehicles: tuple[str, ...] = ()
    other_new: tuple[str, ...] = ()
    other_old: tuple[str, ...] = ()
    since: str = "4.7"

    @property
    def names(self) -> tuple[str, ...]:
        """All names of the parameter, newest first."""
        return (self.new, *self.other_new, *self.old_names)

    @property
    def old_names(self) -> tuple[str, ...]:
        """All names whose values are in the units of ``old``."""
        return (self.old, *self.other_old)

    @property
    def factor(self) -> float:
        """Conversion factor: new value = old value × factor. The factor does not apply if ``is_inverted``."""
        return 1 / self.divisor

    def to_new(self, value: float) -> int | float:
        """Convert a value to the units of the new name. Decimal arithmetic makes 29 cm/s exactly 0.29 m/s."""
        if self.is_inverted:
            return _checks_to_skip(int(value)) if _is_mask(value) else value
        return value if self.divisor == 1 else _scaled(value, lambda decimal: decimal / self.divisor)

    def to_old(self, value: float) -> int | float:
        """Convert a value to the units of the old name; see `to_new`."""
        if self.is_inverted:
            return _checks_to_make(int(value)) if _is_mask(value) else value
        return value if self.divisor == 1 else _scaled(value, lambda decimal: decimal * self.divisor)


class Renamed(Snapshot):
    """A parameter that was ``requested`` by another name than its ``name`` on the vehicle."""

    requested: str
    name: str
    rename: Rename

    def to_vehicle(self, value: float, type: ParameterType | None = None) -> int | float:  # noqa: A002
        """Convert a value from the program's to the vehicle's units.

        A value that is multiplied or divided is also rounded if ``type`` is an integer type. A value that the parameter
        cannot have, such as NaN or a fraction of a bit mask, is returned unchanged.
        """
        converted = self._convert(value, from_name=self.requested)
        is_scaled_integer = self._is_scaled and type is not None and type.is_integer
        return round(converted) if is_scaled_integer and math.isfinite(converted) else converted

    def to_requested(self, value: float) -> int | float:
        """Convert a value of the vehicle to the program's units."""
        return self._convert(value, from_name=self.name)

    def as_requested(self, parameter: Parameter) -> Parameter:
        """Return the vehicle's parameter with the name and units that the program asked for.

        A scaled value becomes a REAL32.
        """
        default = None if parameter.default is None else self.to_requested(parameter.default)
        converted = parameter.replace(name=self.requested, value=self.to_requested(parameter.value), default=default)
        if not self._is_scaled:
            return converted
        default = None if default is None else to_float32(default)
        return converted.replace(value=to_float32(converted.value), default=default, type=ParameterType.REAL32)

    @property
    def warning(self) -> str:
        """Text of the warning for the user."""
        text = f"{self.requested} is called {self.name} by this vehicle's firmware"
        is_old_firmware = self.name in self.rename.old_names
        if self._has_other_units and self.rename.is_inverted:
            text += "; the bits are inverted, and the value was converted"
        elif self._is_scaled:
            old, new = (self.name, self.requested) if is_old_firmware else (self.requested, self.name)
            text += f"; values were converted ({old} = {self.rename.divisor} × {new})"
        if is_old_firmware:
            return f"{text}. The firmware, perhaps a -dev version, is older than the change in {self.rename.since}."
        return f"{text}. Use {self.name}, its name since ArduPilot {self.rename.since}."

    def _convert(self, value: float, from_name: str) -> int | float:
        if not self._has_other_units:
            return value
        is_old = from_name in self.rename.old_names
        return self.rename.to_new(value) if is_old else self.rename.to_old(value)

    @property
    def _is_scaled(self) -> bool:
        return self._has_other_units and self.rename.divisor != 1

    @property
    def _has_other_units(self) -> bool:
        old_names = self.rename.old_names
        return (self.requested in old_names) != (self.name in old_names)


def find_rename(name: str, other: str = "") -> Rename | None:
    """Find a renamed parameter by any of its names; return None for parameters that were not renamed.

    A few old names have a new name for each vehicle type. Pass one of the new names as ``other`` to select it.
    """
    return next((rename for rename in _by_name().get(name, ()) if not other or other in rename.names), None)


def other_names(name: str) -> tuple[str, ...]:
    """Return the other names of a parameter, newest first; empty if it was never renamed."""
    renames = _by_name().get(name, ())
    return tuple(other for rename in renames for other in rename.names if other != name)


def replacement_of(name: str) -> str:
    """Describe what replaces a parameter that has no one-to-one replacement; empty if unknown."""
    return rename_table.REPLACED.get(name, "")


def resolve_rename(name: str, known: Container[str]) -> Renamed | None:
    """Find the other name under which a vehicle has parameter ``name``. ``known`` are the names of its parameters.

    Returns None if the vehicle has ``name`` itself, or has no such parameter.
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
    """Convert the values of a file or table to the names and units that a vehicle uses.

    ``known`` are the names of the vehicle's parameters, and ``types`` their types, for rounding. A parameter that the
    vehicle does not have keeps its name and value. If ``values`` contains several names of one parameter, the vehicle's
    own name takes precedence, otherwise the last name. The second result lists the converted parameters.
    """
    translated: dict[str, int | float] = {}
    renamed: list[Renamed] = []
    for name, value in values.items():
        resolved = resolve_rename(name, known)
        if resolved is None:
            translated[name] = value
        elif resolved.name not in values:
            translated[resolved.name] = resolved.to_vehicle(value, types.get(resolved.name))
            renamed.append(resolved)
    return translated, tuple(renamed)


# ---------------------------------------------------------------------------------------- values


def _scaled(value: float, scale: Callable[[Decimal], Decimal]) -> float:
    """Return the converted value, with as many digits as a 32-bit float has."""
    try:
        return float(scale(Decimal(number_text(value))))
    except (ArithmeticError, ValueError):  # The value is infinite, NaN or beyond 32 bits, which no vehicle accepts.
        return value


def _is_mask(value: float) -> bool:
    # Only a bit mask can be converted between ARMING_CHECK and ARMING_SKIPCHK.
    return -(2**31) <= value < 2**31 and value == int(value)


def _checks_to_skip(checks: int) -> int:
    """Convert ARMING_CHECK to ARMING_SKIPCHK."""
    if checks & _ALL_BIT:
        return 0
    # If no checks are enabled, all are skipped, including future checks.
    return ~checks & _SINGLE_CHECKS if checks & _SINGLE_CHECKS else _SKIP_ALL


def _checks_to_make(skipped: int) -> int:
    return _ALL_BIT if skipped == 0 else ~skipped & _SINGLE_CHECKS


@lru_cache(maxsize=1)
def _by_name() -> Mapping[str, tuple[Rename, ...]]:
    """Map each old or new name to its renames."""
    two_way: dict[str, Rename] = {}
    for vehicles, divisor, pairs in rename_table.RENAMED_IN_4_7:
        for old, new in _pairs(pairs):
            rename = Rename(
                old,
                new,
                divisor,
                is_inverted=old in rename_table.INVERTED,
                vehicles=vehicles,
                other_new=rename_table.OTHER_NEW_NAMES.get(new, ()),
            )
            two_way.update(dict.fromkeys(rename.names, rename))
    for since, vehicles, divisor, pairs in rename_table.RENAMED_BEFORE_4_7:
        for old, new in _pairs(pairs):
            # If `new` was renamed again in a later version, the later rename gets `old` as a further old name. Its
            # divisor is right for `old`, too, because the earlier rename has not changed the units.
            rename = two_way.get(new) or Rename(old, new, divisor, vehicles=vehicles, since=since)
            if old not in rename.names:
                rename = rename.replace(other_old=(*rename.other_old, old))
            two_way.update(dict.fromkeys(rename.names, rename))
    by_name: dict[str, tuple[Rename, ...]] = {name: (rename,) for name, rename in two_way.items()}
    # The renames in ONE_WAY are found only by the old name.
    for since, vehicles, divisor, pairs in rename_table.ONE_WAY:
        for old, new in _pairs(pairs):
            rename = Rename(old, new, divisor, vehicles=vehicles, since=since)
            by_name[old] = (*by_name.get(old, ()), rename)
    return MappingProxyType(by_name)


def _pairs(text: str) -> list[list[str]]:
    return [pair.split(">") for pair in text.split()]
