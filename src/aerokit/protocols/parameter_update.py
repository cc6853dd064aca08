"""What a PARAM_VALUE outside a list says of a parameter that is known."""

from __future__ import annotations

from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.parameter import same_value

__all__ = ["updated"]


def updated(known: Parameter, told: Parameter, bytewise: bool) -> Parameter:
    """What is known of a parameter after a PARAM_VALUE outside a list.

    Where values travel as numbers, such a message tells less than a list or a file. ArduPilot calls an integer a float
    in its answer to PARAM_SET when it holds its default, and an INT32 beyond 2**24 has lost its last bits.
    """
    value, type_ = told.value, told.type
    if not bytewise and known.type.is_integer:
        if type_ is ParameterType.REAL32 and value == value // 1:
            value, type_ = int(value), known.type
        if same_value(float(known.value), float(value)):
            value = known.value
    index = known.index if told.index is None else told.index
    return Parameter(known.name, value, type_, known.default, index)
