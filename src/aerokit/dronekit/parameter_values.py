"""The values of parameters under any of their names: upper-cased, of this firmware or of another one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.parameters.parameter import MOST_PARAMETERS, to_float32
from aerokit.snapshot import Snapshot
from aerokit.vehicle.parameters.names import warn_of_rename

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.parameters.renames import Renamed

__all__ = ["KnownParameter", "ParameterValues"]


class KnownParameter(Snapshot):
    """What the vehicle calls a parameter that was asked for, and its value there."""

    name: str
    value: float
    renamed: Renamed | None = None

    @property
    def value_asked(self) -> float:
        """The value in the unit that belongs to the name that was asked for."""
        if self.renamed is None:
            return self.value
        value = self.renamed.to_asked(self.value)
        return float(value) if self.renamed.rename.divisor == 1 else to_float32(value)

    def to_vehicle(self, value: float) -> int | float:
        """A value in the vehicle's unit."""
        return value if self.renamed is None else self.renamed.to_vehicle(value)

    def warn(self) -> None:
        """Warn the program that the vehicle calls it something else, if it does."""
        if self.renamed is not None:
            warn_of_rename(self.renamed)


class ParameterValues:
    """Name → value as the vehicle spells and counts them. One thread writes, any thread reads."""

    def __init__(self) -> None:
        self._values: dict[str, float] = {}
        self._spelled: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._values)

    def copy(self) -> dict[str, float]:
        """All of them, in a dict of the caller's own."""
        return self._values.copy()

    def find(self, name: str) -> KnownParameter | None:
        """What is known of an upper-cased name."""
        values = self._values
        own = name if name in values else self._spelled.get(name, name)
        if own in values:
            return KnownParameter(own, values[own])
        from aerokit.parameters.renames import to_known

        renamed = to_known(name, values)
        return None if renamed is None else KnownParameter(renamed.name, values[renamed.name], renamed)

    def get(self, name: str) -> float | None:
        """The value of an upper-cased name, if it is the vehicle's own and known."""
        return self._values.get(name)

    def take(self, name: str, value: float) -> bool:
        """One has come; says whether that is news."""
        before = self._values.get(name)
        if before is not None and (before == value or (math.isnan(before) and math.isnan(value))):
            return False
        if before is None and len(self._values) >= MOST_PARAMETERS:
            return False
        if before is None and name != name.upper():
            self._spelled[name.upper()] = name
        self._values[name] = value
        return True

    def replace(self, values: Mapping[str, float]) -> dict[str, float]:
        """All have come; returns those that are news."""
        before, self._values = self._values, {name: float(value) for name, value in values.items()}
        self._spelled = {name.upper(): name for name in values if not name.isupper()}
        return {name: value for name, value in self._values.items() if before.get(name) != value}
