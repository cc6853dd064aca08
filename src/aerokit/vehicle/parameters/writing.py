"""``ParameterWriting``: values under any name and in its unit, checked, set, and their results."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import did_you_mean
from aerokit.errors import AerokitError, InvalidArgument, ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.parameter import same_value

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.parameters import ParameterTable
    from aerokit.parameters.renames import Renamed
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.parameter_requests import Answer
    from aerokit.vehicle.parameters.access import ParameterAccess, UploadMethod

__all__ = [
    "Found",
    "NotFound",
    "Outcome",
    "ParameterNames",
    "ParameterWrite",
    "ParameterWriting",
    "check_values",
    "failed",
    "found_among",
    "outcome_of",
    "warn_of_rename",
]

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


Outcome = Literal["set", "unchanged", "rounded", "clamped", "failed"]

ROUNDED_WITHIN = 1.0

ROUNDED_RELATIVE = 1e-3


class ParameterWrite(Snapshot):
    """What came of writing one parameter, in the name and unit that the program used.

    ``outcome`` is ``"set"``: the vehicle confirmed the value and its type; ``"unchanged"``: it had this value before;
    ``"rounded"`` or ``"clamped"``: it took another value, which is ``value``, near to the ``requested`` one or not;
    ``"failed"``: see ``error``, ``value`` is the last that is known, or NaN. ``note`` says what else there is to know:
    another name on this vehicle, a documented range that the value is outside of, a reboot that it needs.
    """

    name: str
    requested: int | float
    value: int | float
    type: ParameterType
    outcome: Outcome
    note: str = ""
    error: AerokitError | None = None


def failed(name: str, requested: float, known: Parameter | None, error: AerokitError) -> ParameterWrite:
    """The result of a write that did not succeed."""
    value, type_ = (math.nan, ParameterType.REAL32) if known is None else (known.value, known.type)
    return ParameterWrite(name, requested, value, type_, "failed", "", error)


def outcome_of(wanted: Parameter, before: Parameter | None, answer: Answer) -> Outcome | AerokitError:
    """What the vehicle's answer to a write means."""
    if not isinstance(answer, Parameter):
        return answer
    if same_value(answer.value, wanted.value):
        return "unchanged" if before is not None and same_value(before.value, answer.value) else "set"
    if before is not None and same_value(before.value, answer.value):
        text = f"{wanted.name} = {wanted.value:g} was refused: the vehicle keeps {answer.value:g}"
        return ParameterRejected(text, name=wanted.name)
    if same_value(float(answer.value), float(wanted.value)):
        return "rounded"  # an integer that a float does not hold
    distance = abs(answer.value - wanted.value)
    near = (
        distance < ROUNDED_WITHIN
        if answer.type.is_integer
        else distance <= ROUNDED_RELATIVE * abs(wanted.value)
    )
    return "rounded" if near else "clamped"


ROUNDS = 3
"""How often parameters are looked for that appear when others have been set."""

NoteOf = Callable[[str, float], str]


class _Plan(Snapshot):
    """One value that was asked for, and what it means on the vehicle."""

    found: Found
    requested: int | float
    wanted: Parameter
    before: Parameter

    @property
    def is_done(self) -> bool:
        """Whether the vehicle is known to have this value."""
        return same_value(self.before.value, self.wanted.value)


class ParameterWriting:
    """Sets what programs ask for, and says what came of it."""

    def __init__(self, access: ParameterAccess, names: ParameterNames, note_of: NoteOf) -> None:
        self._access = access
        self.names: ParameterNames = names
        self._note_of = note_of

    async def write(
        self,
        values: Mapping[str, float],
        *,
        upload: UploadMethod | None = None,
        patience_s: float,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """One result for each value, in their order; with ``upload`` only what differs is sent, in one go if possible.

        Raises :class:`InvalidArgument` before anything is set.
        """
        results: dict[str, ParameterWrite] = {}
        left = check_values(values)
        for attempt in range(ROUNDS):
            found = await self.names.find(left, patience_s)
            count = self._access.store.count
            plans, errors = self._plans(found, left, is_first=attempt == 0)
            answers = await self._send(plans, upload, patience_s, on_progress)
            results.update({name: failed(name, left[name], None, error) for name, error in errors.items()})
            results.update({each.found.asked: self._result(each, answers) for each in plans})
            left = {
                name: left[name] for name, error in errors.items() if isinstance(error, ParameterRejected)
            }
            if not left or not plans or self._access.store.count == count:
                break
        return {name: results[name] for name in values}

    async def _send(
        self,
        plans: list[_Plan],
        upload: UploadMethod | None,
        patience_s: float,
        on_progress: OnProgress | None,
    ) -> dict[str, Answer]:
        if upload is None:
            return await self._access.write((each.wanted for each in plans), patience_s, on_progress)
        changed = [each.wanted for each in plans if not each.is_done]
        unchanged: dict[str, Answer] = {each.before.name: each.before for each in plans if each.is_done}
        return unchanged | await self._access.write_pack(changed, upload, patience_s, on_progress)

    def _plans(
        self,
        found: Mapping[str, Found | AerokitError],
        values: Mapping[str, int | float],
        *,
        is_first: bool,
    ) -> tuple[list[_Plan], dict[str, AerokitError]]:
        """What to set, and what cannot be. A value that does not fit is raised as long as nothing was set."""
        plans: dict[str, _Plan] = {}
        errors: dict[str, AerokitError] = {}
        for name, each in found.items():
            if not isinstance(each, Found):
                errors[name] = each
                continue
            try:
                plan = _plan(each, values[name])
                _check_same(plan, plans.setdefault(plan.wanted.name, plan))
                plans[name] = plan
            except InvalidArgument as error:
                if is_first:
                    raise
                errors[name] = error
        return [plan for name, plan in plans.items() if name == plan.found.asked], errors

    def _result(self, plan: _Plan, answers: Mapping[str, Answer]) -> ParameterWrite:
        name, requested, answer = plan.found.asked, plan.requested, answers[plan.wanted.name]
        outcome = outcome_of(plan.wanted, plan.before, answer)
        if not isinstance(outcome, str) or not isinstance(answer, Parameter):
            error = outcome if isinstance(outcome, AerokitError) else ParameterRejected(name, name=name)
            return failed(name, requested, plan.found.in_terms_asked(plan.before), error)
        told = plan.found.in_terms_asked(answer)
        notes = (plan.found.note, self._note_of(plan.wanted.name, answer.value))
        return ParameterWrite(name, requested, told.value, told.type, outcome, "; ".join(filter(None, notes)))


def _plan(found: Found, value: int | float) -> _Plan:
    on_vehicle = found.parameter
    checked = checked_value(found.name, found.to_vehicle(value), on_vehicle.type)
    return _Plan(found, value, Parameter(found.name, checked, on_vehicle.type), on_vehicle)


def _check_same(one: _Plan, other: _Plan) -> None:
    """Two names of one parameter must not be given different values."""
    if not same_value(one.wanted.value, other.wanted.value):
        raise InvalidArgument(
            f"{one.found.asked} = {one.requested:g} and {other.found.asked} = {other.requested:g} contradict:"
            f" both are {one.wanted.name} on this vehicle"
        )


def check_values(values: Mapping[str, float]) -> dict[str, int | float]:
    """The values; raises :class:`InvalidArgument` unless all of them are finite numbers with possible names."""
    return {check_name(name): _number(name, value) for name, value in values.items()}


def _number(name: str, value: float) -> int | float:
    """The value if it is a finite number: what its type can hold is checked when the type is known."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    return checked_value(name, value, ParameterType.REAL64)
