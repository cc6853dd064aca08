"""``ParameterTable``: the parameters of a vehicle at one moment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from types import MappingProxyType

from aerokit._internal.values import Snapshot
from aerokit.errors import ValueUnknownError
from aerokit.parameters.encoding import number_text
from aerokit.parameters.parameter import Parameter, ParameterType, same_value


class ParameterTable(Mapping[str, Parameter]):
    """Name → :class:`Parameter`, in the vehicle's order; immutable.

    ``table["WP_SPD"].value`` is one value, ``table.values_by_name()`` all of them as a plain dict. Of several
    parameters with one name the last one counts.
    """

    __slots__ = ("_by_name",)

    def __init__(self, parameters: Iterable[Parameter] = ()) -> None:
        self._by_name = {parameter.name: parameter for parameter in parameters}

    @classmethod
    def from_values(
        cls,
        values: Mapping[str, int | float],
        types: Mapping[str, ParameterType] = MappingProxyType({}),
    ) -> ParameterTable:
        """A table of plain values; a name without a type becomes REAL32 (its value is kept as it is)."""
        rows = enumerate(values.items())
        real = ParameterType.REAL32
        return cls(Parameter(name, value, types.get(name, real), None, i) for i, (name, value) in rows)

    def __getitem__(self, name: str) -> Parameter:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __eq__(self, other: object) -> bool:
        return self._by_name == other._by_name if isinstance(other, ParameterTable) else NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self._by_name.values()))

    def __repr__(self) -> str:
        return f"<ParameterTable: {len(self)} parameters>"

    def values_by_name(self) -> dict[str, int | float]:
        """Name → value, a dict of the caller's own."""
        return {name: parameter.value for name, parameter in self._by_name.items()}

    def types_by_name(self) -> dict[str, ParameterType]:
        """Name → type, a dict of the caller's own."""
        return {name: parameter.type for name, parameter in self._by_name.items()}

    @property
    def has_defaults(self) -> bool:
        """Whether the default of every parameter is known."""
        return all(parameter.default is not None for parameter in self._by_name.values())

    def changed_from_default(self) -> ParameterTable:
        """Those whose value is another than their default.

        Raises :class:`ValueUnknownError` when no default is known at all: the list protocol tells none.
        """
        known = [parameter for parameter in self._by_name.values() if parameter.default is not None]
        if self._by_name and not known:
            raise ValueUnknownError("no default is known: only a download by MAVFTP brings them")
        return ParameterTable(parameter for parameter in known if parameter.is_changed)

    def with_(self, parameters: Iterable[Parameter]) -> ParameterTable:
        """A copy with these put in: a known one in its place, a new one at the end.

        A default or index that an update does not tell stays as it was.
        """
        merged = dict(self._by_name)
        for new in parameters:
            merged[new.name] = _merged(merged.get(new.name), new)
        return ParameterTable(merged.values())

    def without(self, names: Iterable[str]) -> ParameterTable:
        """A copy without these names; unknown ones do not matter."""
        dropped = set(names)
        return ParameterTable(p for p in self._by_name.values() if p.name not in dropped)

    def matching(self, pattern: str) -> ParameterTable:
        """Those whose name fits a pattern like ``"WP_*"``; case does not matter."""
        pattern = pattern.upper()
        return ParameterTable(p for p in self._by_name.values() if fnmatchcase(p.name.upper(), pattern))

    def by_index(self) -> dict[int, Parameter]:
        """Index in the vehicle's list → parameter, for those that have told their index."""
        return {p.index: p for p in self._by_name.values() if p.index is not None}

    def in_order_of_index(self) -> ParameterTable:
        """A copy in the vehicle's order, however the parameters arrived; those without an index come last."""
        last = 1 << 16
        return ParameterTable(
            sorted(self._by_name.values(), key=lambda p: last if p.index is None else p.index)
        )


def _merged(old: Parameter | None, new: Parameter) -> Parameter:
    if old is None or (new.default is not None and new.index is not None):
        return new
    default = old.default if new.default is None else new.default
    return Parameter(new.name, new.value, new.type, default, old.index if new.index is None else new.index)


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
