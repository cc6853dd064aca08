"""``ParameterWriter``: resolves names and units, writes values, and reports the results."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Literal

from aerokit._internal.formatting import did_you_mean
from aerokit._internal.values import Snapshot
from aerokit.errors import AerokitError, InvalidArgument, ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.encoding import number_text
from aerokit.parameters.parameter import same_value, to_float32

if TYPE_CHECKING:
    from aerokit.parameters import ParameterTable
    from aerokit.parameters.renames import Renamed
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.parameter_requests import ParameterAnswer
    from aerokit.vehicle.parameters.access import ParameterAccess, UploadMethod

__all__ = ["Outcome", "ParameterWrite"]

ParameterFailure = ParameterRejected | ParameterTimeout


class ResolvedParameter(Snapshot):
    """A parameter of the vehicle, and the name that the program ``requested``.

    ``is_fresh`` is True if the parameter was just read from the vehicle.
    """

    requested: str
    parameter: Parameter
    is_fresh: bool
    renamed: Renamed | None = None

    @property
    def name(self) -> str:
        return self.parameter.name

    @property
    def note(self) -> str:
        return "" if self.renamed is None else f"{self.name} on this vehicle"

    def to_vehicle(self, value: float) -> int | float:
        return value if self.renamed is None else self.renamed.to_vehicle(value, self.parameter.type)

    def as_requested(self, parameter: Parameter) -> Parameter:
        """Convert a parameter of the vehicle to the name and unit of the program."""
        return parameter if self.renamed is None else self.renamed.as_requested(parameter)


def resolve_known(name: str, known: Mapping[str, Parameter]) -> ResolvedParameter | None:
    """Return the known parameter that has this name in older, present or newer firmware, or None."""
    if name in known:
        return ResolvedParameter(name, known[name], is_fresh=False)
    from aerokit.parameters.renames import resolve_rename

    renamed = resolve_rename(name, known)
    return None if renamed is None else ResolvedParameter(name, known[renamed.name], is_fresh=False, renamed=renamed)


class NameResolver:
    """Finds parameters of the vehicle, also by the names that older or newer firmware uses for them."""

    def __init__(self, access: ParameterAccess) -> None:
        self._access = access

    async def resolve(
        self, names: Iterable[str], idle_timeout_s: float
    ) -> dict[str, ResolvedParameter | ParameterFailure]:
        """Return the vehicle's parameter, or an error, for each name. Warns if the vehicle uses another name.

        Parameters that are unknown, or whose known value may be outdated, are requested from the vehicle.
        """
        normalized = {check_name(name): self._normalized(name) for name in names}
        results: dict[str, ResolvedParameter | ParameterFailure] = {}
        store = self._access.store
        await self._access.learn_encoding()  # The capabilities may arrive now, and clear the store.
        answers = await self._access.read(self._names_in_doubt(normalized.values()), idle_timeout_s)
        # If the vehicle reboots meanwhile, the store is cleared, and parameters that were known must also be read.
        while to_read := [name for name in self._unknown_names(normalized.values()) if name not in answers]:
            read = await self._access.read(to_read, idle_timeout_s, probe=True)
            # Late answers arrive in a burst. If the value has arrived right after an error, the error is obsolete.
            answers |= {name: read[name] for name in read if isinstance(read[name], Parameter) or name not in store}
        for requested, name in normalized.items():
            result = self._resolve_one(name, answers)
            if isinstance(result, ResolvedParameter):
                result = result.replace(requested=requested)
                if result.renamed is not None:
                    warn_of_rename(result.renamed)
            results[requested] = result
        return results

    def translated(self, values: Mapping[str, float], table: ParameterTable) -> dict[str, int | float]:
        """Convert values to the names and units of the vehicle. Warns of renamed parameters."""
        from aerokit.parameters.renames import translate_values

        values = {self._normalized(name): value for name, value in values.items()}
        translated, renamed = translate_values(values, table, table.types_by_name())
        for rename in renamed:
            warn_of_rename(rename)
        return translated

    def without_duplicates(self, values: Mapping[str, float], table: ParameterTable) -> dict[str, int | float]:
        """Drop a value if ``values`` also has the parameter under the name that the vehicle uses."""
        from aerokit.parameters.renames import resolve_rename

        remaining = {}
        for name, value in values.items():
            renamed = resolve_rename(name, table)
            if renamed is None or renamed.name not in values:
                remaining[name] = value
        return remaining

    def _normalized(self, name: str) -> str:
        # ArduPilot accepts lower case, but confirms the parameter in upper case.
        return name.upper() if self._access.has_upper_case_names else name

    def _names_in_doubt(self, names: Iterable[str]) -> list[str]:
        """Return the vehicle's names of those parameters whose known values may be outdated."""
        from aerokit.parameters.renames import resolve_rename

        store = self._access.store
        renamed = {name: None if name in store else resolve_rename(name, store) for name in names}
        known_names = [name if rename is None else rename.name for name, rename in renamed.items()]
        return [name for name in known_names if name in store and self._access.is_in_doubt(name)]

    def _unknown_names(self, names: Iterable[str]) -> dict[str, None]:
        """Return the old and new names of those parameters that are not known yet."""
        from aerokit.parameters.renames import other_names, resolve_rename

        store = self._access.store
        to_read: dict[str, None] = {}  # an ordered set: the names are requested in this order
        for name in names:
            if name not in store and resolve_rename(name, store) is None:
                to_read.update(dict.fromkeys((name, *other_names(name))))
        return to_read

    def _resolve_one(self, name: str, answers: Mapping[str, ParameterAnswer]) -> ResolvedParameter | ParameterFailure:
        direct = answers.get(name, self._access.store.get(name))
        if isinstance(direct, Parameter):
            return ResolvedParameter(name, direct, is_fresh=name in answers)
        from aerokit.parameters.renames import Renamed, find_rename, other_names

        failure = direct
        for other_name in other_names(name):
            answer = answers.get(other_name, self._access.store.get(other_name))
            rename = find_rename(name, other_name)
            if isinstance(answer, Parameter) and rename is not None:
                renamed = Renamed(name, other_name, rename)
                return ResolvedParameter(name, answer, is_fresh=other_name in answers, renamed=renamed)
            if isinstance(answer, ParameterTimeout) and not isinstance(failure, ParameterTimeout):
                failure = answer  # A time-out outweighs a refusal: the vehicle may have `other_name`.
        return self._with_hint(failure or ParameterRejected(f"the vehicle has no parameter {name}", name=name))

    def _with_hint(self, answer: ParameterFailure) -> ParameterFailure:
        if not isinstance(answer, ParameterRejected):
            return answer
        from aerokit.parameters.renames import replacement_of

        replacement = replacement_of(answer.name)
        hint = f"; replaced by {replacement}" if replacement else did_you_mean(answer.name, self._access.store.table)
        return ParameterRejected(f"{answer}{hint}", name=answer.name, code=answer.code)


def warn_of_rename(renamed: Renamed) -> None:
    """Issue a ParameterRenamedWarning that points to the line of the program that called aerokit."""
    from aerokit.parameters.renames import ParameterRenamedWarning

    # Frame 1 and `stacklevel` 2 both stand for the caller of this function.
    frame, stack_level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("aerokit."):
        frame = frame.f_back
        stack_level += 1
    warnings.warn(renamed.warning, ParameterRenamedWarning, stacklevel=stack_level)


Outcome = Literal["set", "unchanged", "rounded", "clamped", "failed"]

MAX_INTEGER_ROUNDING = 1.0
MAX_RELATIVE_ROUNDING = 1e-3


class ParameterWrite(Snapshot):
    """Result of writing one parameter. The name and the unit are the program's, even if the vehicle uses others.

    ``outcome`` is one of:

    - ``"set"``: the vehicle confirmed the value and its type.
    - ``"unchanged"``: the vehicle had this value before.
    - ``"rounded"``: the vehicle set a value near the ``requested`` value.
    - ``"clamped"``: the vehicle set another value.
    - ``"failed"``: see ``error``; ``value`` is the last known value, or NaN.

    ``note`` has further information: another name on this vehicle, a value outside its documented range, a reboot that
    is needed. ``before`` is the value that the vehicle had, None if unknown.
    """

    name: str
    requested: int | float
    value: int | float
    type: ParameterType
    outcome: Outcome
    note: str = ""
    error: AerokitError | None = None
    before: int | float | None = None


def _failed_write(name: str, requested: float, known: Parameter | None, error: AerokitError) -> ParameterWrite:
    value, type_ = (math.nan, ParameterType.REAL32) if known is None else (known.value, known.type)
    return ParameterWrite(name, requested, value, type_, outcome="failed", error=error)


def outcome_of(
    sent: Parameter, old: Parameter | None, answer: ParameterAnswer, *, bytewise: bool
) -> Outcome | AerokitError:
    if not isinstance(answer, Parameter):
        return answer
    is_old_value = old is not None and same_value(old.value, answer.value)
    if same_value(answer.value, sent.value):
        return "unchanged" if is_old_value else "set"
    # An integer that is sent as a 32-bit float may be rounded. An integer that is sent bytewise is exact.
    is_rounded = to_float32(answer.value) == to_float32(sent.value)
    was_refused = is_old_value and (bytewise or not is_rounded)
    if was_refused:
        kept = number_text(answer.value) if math.isfinite(answer.value) else answer.value
        text = f"{sent.name} = {number_text(sent.value)} was refused: the vehicle keeps {kept}"
        return ParameterRejected(text, name=sent.name)
    if is_rounded:
        return "rounded"
    difference = abs(answer.value - sent.value)
    if answer.type.is_integer:
        is_near = difference < MAX_INTEGER_ROUNDING
    else:
        is_near = difference <= MAX_RELATIVE_ROUNDING * abs(sent.value)
    return "rounded" if is_near else "clamped"


# Maximum number of rounds of writes. Parameters that appear after a round are looked up and set in the next one.
MAX_ROUNDS = 3

NoteOf = Callable[[str, float], str]
Resolve = Callable[[Iterable[str], float], Awaitable[dict[str, ResolvedParameter | ParameterFailure]]]


class _PlannedWrite(Snapshot):
    """One value to write: ``requested`` in the program's unit, and ``to_send`` with the vehicle's name and unit."""

    resolved: ResolvedParameter
    requested: int | float
    to_send: Parameter

    @property
    def old(self) -> Parameter:
        return self.resolved.parameter

    @property
    def is_unchanged(self) -> bool:
        return same_value(self.old.value, self.to_send.value)


class ParameterWriter:
    """Writes parameters by the names and in the units that the program uses, and reports the results."""

    def __init__(self, access: ParameterAccess, names: NameResolver, note_of: NoteOf) -> None:
        self._access = access
        self.names: NameResolver = names
        self._note_of = note_of

    async def write(
        self,
        values: Mapping[str, float],
        *,
        upload: UploadMethod | None = None,
        resolve: Resolve | None = None,
        idle_timeout_s: float,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Write the values, and return a result for each.

        With ``upload``, only changed values are sent, by this method. Without it, all values are sent by PARAM_SET.
        ``resolve`` replaces :meth:`NameResolver.resolve`.
        """
        resolve = resolve or self.names.resolve
        results: dict[str, ParameterWrite] = {}
        pending = check_values(values)
        for round_number in range(MAX_ROUNDS):
            resolved = await resolve(pending, idle_timeout_s)
            count_before = self._access.store.count
            plans, errors = self._plan_writes(resolved, pending, is_first_round=round_number == 0)
            answers = await self._send(plans, upload, idle_timeout_s, on_progress)
            results.update({name: _failed_write(name, pending[name], None, error) for name, error in errors.items()})
            results.update({plan.resolved.requested: self._result(plan, answers) for plan in plans})
            pending = {name: pending[name] for name, error in errors.items() if isinstance(error, ParameterRejected)}
            # A rejected parameter may exist now, because ArduPilot shows some only after an …_ENABLE was set.
            has_new_parameters = bool(plans) and self._access.store.count != count_before
            if not pending or not has_new_parameters:
                break
        return {name: results[name] for name in values}

    async def _send(
        self,
        plans: list[_PlannedWrite],
        upload: UploadMethod | None,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> dict[str, ParameterAnswer]:
        """Send the planned values. The answers are keyed by the names on the vehicle."""
        if upload is None:  # `write` sends each name once, even if two plans have it, and also sends unchanged values.
            return await self._access.write((plan.to_send for plan in plans), idle_timeout_s, on_progress)
        # Two names may mean the same parameter, which must be in the file only once.
        changed = {plan.to_send.name: plan.to_send for plan in plans if not plan.is_unchanged}
        answers: dict[str, ParameterAnswer] = {plan.old.name: plan.old for plan in plans if plan.is_unchanged}
        # The values of a file may be those of another vehicle, or of a time when this one had other plans.
        for name in changed.keys() & self._access.plan_size_parameters:
            del changed[name]
            answers[name] = ParameterRejected(
                f"{name} was not sent: it is the number of stored plan items, which only the upload of a plan changes",
                name=name,
            )
        return answers | await self._access.write_file(changed.values(), upload, idle_timeout_s, on_progress)

    def _plan_writes(
        self,
        resolved: Mapping[str, ResolvedParameter | AerokitError],
        values: Mapping[str, int | float],
        *,
        is_first_round: bool,
    ) -> tuple[list[_PlannedWrite], dict[str, AerokitError]]:
        """Return the planned writes, and the errors by name.

        An invalid value raises InvalidArgument in the first round, and is one of the errors in later rounds.
        """
        plans: list[_PlannedWrite] = []
        first_plans: dict[str, _PlannedWrite] = {}  # the first plan for each name on the vehicle
        errors: dict[str, AerokitError] = {}
        for name, result in resolved.items():
            if not isinstance(result, ResolvedParameter):
                errors[name] = result
                continue
            try:
                plan = _plan_write(result, values[name])
                # Two requested names may mean the same parameter.
                first_plan = first_plans.setdefault(plan.to_send.name, plan)
                _check_same_value(plan, first_plan)
                plans.append(plan)
            except InvalidArgument as error:
                if is_first_round:
                    raise
                errors[name] = error
        return plans, errors

    def _result(self, plan: _PlannedWrite, answers: Mapping[str, ParameterAnswer]) -> ParameterWrite:
        name, requested = plan.resolved.requested, plan.requested
        answer = answers[plan.to_send.name]
        outcome = outcome_of(plan.to_send, plan.old, answer, bytewise=self._access.store.bytewise)
        if isinstance(outcome, AerokitError):
            return _failed_write(name, requested, plan.resolved.as_requested(plan.old), outcome)
        assert isinstance(answer, Parameter)  # For all other answers, the outcome is an error.
        written = plan.resolved.as_requested(answer)
        notes = (plan.resolved.note, self._note_of(plan.to_send.name, answer.value))
        note = "; ".join(filter(None, notes))
        before = plan.resolved.as_requested(plan.old).value
        return ParameterWrite(name, requested, written.value, written.type, outcome, note, before=before)


def _plan_write(resolved: ResolvedParameter, value: int | float) -> _PlannedWrite:
    kind = resolved.parameter.type
    checked = checked_value(resolved.name, resolved.to_vehicle(value), kind)
    return _PlannedWrite(resolved, value, Parameter(resolved.name, checked, kind))


def _check_same_value(plan: _PlannedWrite, other_plan: _PlannedWrite) -> None:
    if not same_value(plan.to_send.value, other_plan.to_send.value):
        other_name = other_plan.resolved.requested
        raise InvalidArgument(
            f"{plan.resolved.requested} = {plan.requested:g} and {other_name} = {other_plan.requested:g}"
            f" contradict each other: both names mean {plan.to_send.name} on this vehicle"
        )


def check_values(values: Mapping[str, float]) -> dict[str, int | float]:
    """Return the values. Raises InvalidArgument for an invalid name or a value that is not finite."""
    return {check_name(name): _number(name, value) for name, value in values.items()}


def _number(name: str, value: float) -> int | float:
    # The range of an integer is checked later, when the parameter's type is known.
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    return checked_value(name, value, ParameterType.REAL64)
