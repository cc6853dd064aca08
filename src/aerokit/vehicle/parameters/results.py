"""What came of writing parameters, as values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from aerokit.errors import AerokitError, ParameterRejected
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.parameter import same_value
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from aerokit.protocols.parameter_requests import Answer

__all__ = ["Outcome", "ParameterWrite", "failed", "outcome_of"]

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
