"""What differs between two sets of parameters: tables, files, or plain values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from aerokit.parameters.number_text import number_text
from aerokit.parameters.parameter import Parameter, same_value
from aerokit.parameters.table import ParameterTable
from aerokit.snapshot import Snapshot

__all__ = ["ParameterDifference", "ParameterValues", "diff", "plain_values"]

ParameterValues = Mapping[str, "int | float"] | Mapping[str, Parameter]
"""Whatever has names and values: a :class:`ParameterTable`, a file that was read, a dict."""


class ParameterDifference(Snapshot):
    """One parameter that is not the same on both sides; None where it is missing."""

    name: str
    before: int | float | None
    after: int | float | None

    def __str__(self) -> str:
        return f"{self.name}: {_text(self.before)} → {_text(self.after)}"


def diff(
    before: ParameterValues,
    after: ParameterValues,
    tolerance: float = 0.0,
    *,
    names: Iterable[str] | None = None,
) -> tuple[ParameterDifference, ...]:
    """What differs, in the order of ``before``, then what only ``after`` has.

    Numbers that a vehicle cannot tell apart (0.1 and the 32-bit number nearest to it) are the same, and so are numbers
    not further apart than ``tolerance``. ``names`` restricts it: ``diff(file, table, names=file)`` says nothing
    about parameters that the file does not mention.
    """
    old, new = plain_values(before), plain_values(after)
    chosen = dict.fromkeys(names) if names is not None else {**dict.fromkeys(old), **dict.fromkeys(new)}
    pairs = ((name, old.get(name), new.get(name)) for name in chosen)
    return tuple(ParameterDifference(*pair) for pair in pairs if not _same(pair[1], pair[2], tolerance))


def plain_values(values: ParameterValues) -> dict[str, int | float]:
    """Name → number."""
    if isinstance(values, ParameterTable):
        return values.values_by_name()
    return {name: each.value if isinstance(each, Parameter) else each for name, each in values.items()}


def _same(one: float | None, other: float | None, tolerance: float) -> bool:
    if one is None or other is None:
        return one is other
    return same_value(one, other) or abs(one - other) <= tolerance


def _text(value: float | None) -> str:
    if value is None:
        return "missing"
    try:
        return number_text(value)
    except (ArithmeticError, ValueError):  # NaN, infinite, beyond 32 bits
        return repr(value)
