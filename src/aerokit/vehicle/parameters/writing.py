"""``ParameterWriting``: values under any name and in its unit, checked, set, and their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError, InvalidArgument, ParameterRejected
from aerokit.parameters import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.parameter import same_value
from aerokit.snapshot import Snapshot
from aerokit.vehicle.parameters.names import Found, ParameterNames
from aerokit.vehicle.parameters.results import ParameterWrite, failed, outcome_of

if TYPE_CHECKING:
    from aerokit.protocols.parameter_requests import Answer
    from aerokit.protocols.transfer import OnProgress
    from aerokit.vehicle.parameters.access import ParameterAccess, UploadMethod

__all__ = ["ParameterWriting", "check_values"]

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
