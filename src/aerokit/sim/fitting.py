"""What a firmware does with a number that a field cannot hold, and a simulation must not end by."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, TypeVar

from aerokit.mavlink.message import INTEGER_RANGES, Field, Message

__all__ = ["fitted"]

MessageT = TypeVar("MessageT", bound=Message)
_LARGEST_FLOAT = 3.4028234663852886e38


def fitted(message: MessageT) -> MessageT:
    """The message with what does not fit cut off: whole numbers at their range, floats to infinity, texts at their end.

    What is of a wrong type stays, as it is a mistake of the simulation and no consequence of what a vehicle heard.
    """
    found = copy.copy(message)
    for field in found.FIELDS:
        value = getattr(found, field.name)
        if field.complaint(value) is not None:
            setattr(found, field.name, _fitting(field, value))
    return found


def _fitting(field: Field, value: Any) -> Any:
    if field.type == "char":
        if not field.is_text:
            return value[: field.array_length] if isinstance(value, bytes) else value
        is_text = isinstance(value, str)
        return (
            value.encode(errors="replace")[: field.array_length or 1].decode(errors="ignore")
            if is_text
            else value
        )
    fit = _fit_of(field.type)
    return tuple(map(fit, value)) if isinstance(value, tuple) else fit(value)


def _fit_of(kind: str) -> Callable[[Any], Any]:
    if kind in INTEGER_RANGES:
        low, high = INTEGER_RANGES[kind]
        return lambda value: max(low, min(high, value)) if isinstance(value, int) else value
    return lambda value: (
        math.copysign(math.inf, value) if kind == "float" and abs(value) > _LARGEST_FLOAT else value
    )
