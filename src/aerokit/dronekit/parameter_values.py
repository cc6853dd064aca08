"""The values of parameters under any of their names: upper-cased, of this firmware or of another one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.parameters.parameter import MOST_PARAMETERS, same_value
from aerokit.vehicle.parameters.names import found_among

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.parameters import Parameter
    from aerokit.vehicle.parameters.names import Found

__all__ = ["ParameterValues"]


class ParameterValues:
    """What the vehicle has told, through reboots, too. One thread writes, any thread reads."""

    def __init__(self) -> None:
        self._known: dict[str, Parameter] = {}
        self._spelled: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._known)

    def copy(self) -> dict[str, float]:
        """Name → value as the vehicle spells and counts them, in a dict of the caller's own."""
        return {name: float(each.value) for name, each in self._known.copy().items()}

    def find(self, name: str) -> Found | None:
        """What is known of an upper-cased name."""
        known = self._known
        return found_among(name if name in known else self._spelled.get(name, name), known)

    def get(self, name: str) -> float | None:
        """The value of an upper-cased name, if it is the vehicle's own and known."""
        known = self._known.get(name)
        return None if known is None else float(known.value)

    def take(self, parameter: Parameter) -> bool:
        """One has come; says whether that is news."""
        name, before = parameter.name, self._known.get(parameter.name)
        if before is None and len(self._known) >= MOST_PARAMETERS:
            return False
        if before is None and name != name.upper():
            self._spelled[name.upper()] = name
        self._known[name] = parameter
        return before is None or not same_value(before.value, parameter.value)

    def replace(self, known: Mapping[str, Parameter]) -> dict[str, float]:
        """All have come; returns those that are news."""
        before, self._known = self._known, dict(known)
        self._spelled = {name.upper(): name for name in known if not name.isupper()}
        return {
            name: float(each.value)
            for name, each in self._known.items()
            if name not in before or before[name].value != each.value
        }
