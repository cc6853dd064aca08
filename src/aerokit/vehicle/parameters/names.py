"""Parameters by any name that they have: ArduPilot 4.7 renamed many and changed their units."""

from __future__ import annotations

import sys
import warnings
from typing import TYPE_CHECKING

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter, check_name
from aerokit.snapshot import Snapshot
from aerokit.wording import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from aerokit.parameters import ParameterTable
    from aerokit.parameters.renames import Renamed
    from aerokit.protocols.parameter_requests import Answer
    from aerokit.vehicle.parameters.access import ParameterAccess

__all__ = ["Found", "NotFound", "ParameterNames", "found_among", "warn_of_rename"]

NotFound = ParameterRejected | ParameterTimeout


class Found(Snapshot):
    """A parameter that a program asked for by ``asked``, as the vehicle has it; ``is_fresh``: it was read just now."""

    asked: str
    parameter: Parameter
    is_fresh: bool
    renamed: Renamed | None = None

    @property
    def name(self) -> str:
        """What the vehicle calls it."""
        return self.parameter.name

    @property
    def note(self) -> str:
        """What there is to say of its name."""
        return "" if self.renamed is None else f"{self.name} on this vehicle"

    def to_vehicle(self, value: float) -> int | float:
        """A value in the vehicle's unit."""
        return value if self.renamed is None else self.renamed.to_vehicle(value, self.parameter.type)

    def in_terms_asked(self, parameter: Parameter) -> Parameter:
        """A parameter of the vehicle under the name and in the unit that was asked for."""
        return parameter if self.renamed is None else self.renamed.parameter(parameter)


def found_among(name: str, known: Mapping[str, Parameter]) -> Found | None:
    """A parameter under any of its names, among those that are known."""
    if name in known:
        return Found(name, known[name], False)
    from aerokit.parameters.renames import to_known

    renamed = to_known(name, known)
    return None if renamed is None else Found(name, known[renamed.name], False, renamed)


class ParameterNames:
    """Finds what programs ask for among what the vehicle has."""

    def __init__(self, access: ParameterAccess) -> None:
        self._access = access

    async def find(self, names: Iterable[str], patience_s: float) -> dict[str, Found | NotFound]:
        """Each of them as the vehicle has it; what is not known yet is read. Warns of other names.

        Raises :class:`InvalidArgument` for a name that no message can carry, before anything is sent.
        """
        spelled = {check_name(name): self._spelled(name) for name in names}
        found: dict[str, Found | NotFound] = {}
        answers = await self._access.read(self._to_read(spelled.values()), patience_s, are_doubtful=True)
        for asked, name in spelled.items():
            each = self._found(name, answers)
            found[asked] = each = each.replace(asked=asked) if isinstance(each, Found) else each
            if isinstance(each, Found) and each.renamed is not None:
                warn_of_rename(each.renamed)
        return found

    def translated(self, values: Mapping[str, float], table: ParameterTable) -> dict[str, int | float]:
        """Values under the names and in the units of the vehicle; names that it does not know stay."""
        from aerokit.parameters.renames import translate_values

        values = {self._spelled(name): value for name, value in values.items()}
        translated, renamed = translate_values(values, table, table.types_by_name())
        for each in renamed:
            warn_of_rename(each)
        return translated

    def without_doubles(self, values: Mapping[str, float], table: ParameterTable) -> dict[str, int | float]:
        """The values without those that are given under the vehicle's own name, too."""
        from aerokit.parameters.renames import to_known

        renamed = {name: to_known(name, table) for name in values}
        return {
            name: value
            for name, value in values.items()
            if (own := renamed[name]) is None or own.name not in values
        }

    def _spelled(self, name: str) -> str:
        """ArduPilot finds ``wp_spd``, too, but confirms it as ``WP_SPD``."""
        return name.upper() if self._access.has_upper_case_names else name

    def _to_read(self, names: Iterable[str]) -> dict[str, None]:
        """What is not known under any of its names, under all of them."""
        from aerokit.parameters.renames import other_names, to_known

        store = self._access.store
        wanted: dict[str, None] = {}
        for name in names:
            if name not in store and to_known(name, store) is None:
                wanted.update(dict.fromkeys((name, *other_names(name))))
        return wanted

    def _found(self, name: str, answers: Mapping[str, Answer]) -> Found | NotFound:
        own = answers.get(name, self._access.store.get(name))
        if isinstance(own, Parameter):
            return Found(name, own, name in answers)
        from aerokit.parameters.renames import Renamed, find_rename, other_names

        for other in other_names(name):
            answer = answers.get(other, self._access.store.get(other))
            rename = find_rename(name, other)
            if isinstance(answer, Parameter) and rename is not None:
                return Found(name, answer, other in answers, Renamed(name, other, rename))
        return self._with_hint(own or ParameterRejected(f"the vehicle has no parameter {name}", name=name))

    def _with_hint(self, answer: NotFound) -> NotFound:
        """The same, and what was perhaps meant, by the names that are known."""
        if not isinstance(answer, ParameterRejected):
            return answer
        from aerokit.parameters.renames import replacement_of

        replaced = replacement_of(answer.name)
        hint = (
            f"; replaced by {replaced}" if replaced else did_you_mean(answer.name, self._access.store.table)
        )
        return ParameterRejected(f"{answer}{hint}", name=answer.name, code=answer.code)


def warn_of_rename(renamed: Renamed) -> None:
    """Warn in the name of the program's own line, however deep inside aerokit this is."""
    from aerokit.parameters.renames import ParameterRenamedWarning

    depth, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("aerokit."):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(renamed.warning, ParameterRenamedWarning, stacklevel=depth)
