"""``ParameterTable``: the parameters of a vehicle at one moment, and comparison of tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from types import MappingProxyType

from aerokit._internal.values import Snapshot
from aerokit.errors import ValueUnknownError
from aerokit.parameters.encoding import number_text
from aerokit.parameters.parameter import Parameter, ParameterType, same_value


class ParameterTable(Mapping[str, Parameter]):
    """Maps names to :class:`Parameter`, in the order in which they were given; immutable.

    ``table["WP_SPD"].value`` is one value, ``table.values_by_name()`` a dict of all. If a name occurs twice, the last
    one counts.
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
        """Create a table from values, without converting them. Parameters without a type become REAL32."""
        return cls(
            Parameter(name, value, types.get(name, ParameterType.REAL32), None, index)
            for index, (name, value) in enumerate(values.items())
        )

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
        """Return a new dict of names and values."""
        return {name: parameter.value for name, parameter in self._by_name.items()}

    def types_by_name(self) -> dict[str, ParameterType]:
        """Return a new dict of names and types."""
        return {name: parameter.type for name, parameter in self._by_name.items()}

    @property
    def has_defaults(self) -> bool:
        """True if the default of every parameter is known."""
        return all(parameter.default is not None for parameter in self._by_name.values())

    def changed_from_default(self) -> ParameterTable:
        """Return the parameters whose value differs from their default. Those without a known default are left out.

        Raises:
            ValueUnknownError: no default is known, because the list protocol does not report defaults.
        """
        with_default = [parameter for parameter in self._by_name.values() if parameter.default is not None]
        if self._by_name and not with_default:
            raise ValueUnknownError("no default is known: only a download by MAVFTP reports defaults")
        return ParameterTable(parameter for parameter in with_default if parameter.is_changed)

    def updated_with(self, parameters: Iterable[Parameter]) -> ParameterTable:
        """Return a copy with these parameters: known parameters are replaced, new ones appended.

        If the default or the index of an update is None, the known one is kept.
        """
        merged = dict(self._by_name)
        for new in parameters:
            merged[new.name] = _merged(merged.get(new.name), new)
        return ParameterTable(merged.values())

    def without(self, names: Iterable[str]) -> ParameterTable:
        """Return a copy without these names. Unknown names are ignored."""
        excluded = set(names)
        return ParameterTable(parameter for name, parameter in self._by_name.items() if name not in excluded)

    def matching(self, pattern: str) -> ParameterTable:
        """Return the parameters whose names match a pattern such as ``"WP_*"``, ignoring case."""
        pattern = pattern.upper()
        return ParameterTable(
            parameter for name, parameter in self._by_name.items() if fnmatchcase(name.upper(), pattern)
        )

    def by_index(self) -> dict[int, Parameter]:
        """Return a dict of the parameters with a known index in the vehicle's list."""
        return {parameter.index: parameter for parameter in self._by_name.values() if parameter.index is not None}

    def in_order_of_index(self) -> ParameterTable:
        """Return a copy sorted by index. Parameters without an index come last."""
        return ParameterTable(sorted(self._by_name.values(), key=lambda param: (param.index is None, param.index or 0)))


def _merged(old: Parameter | None, new: Parameter) -> Parameter:
    """Return the new parameter. A missing default or index is taken from the old one."""
    if old is None or (new.default is not None and new.index is not None):
        return new
    default = old.default if new.default is None else new.default
    index = old.index if new.index is None else new.index
    return Parameter(new.name, new.value, new.type, default, index)


ParameterValues = Mapping[str, "int | float"] | Mapping[str, Parameter]
"""Anything with names and values: a :class:`ParameterTable`, a parameter file, a dict."""


class ParameterDifference(Snapshot):
    """A parameter that differs between two tables. ``before`` or ``after`` is None if that table lacks it."""

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
    """Compare parameters. Differences are in the order of ``before``; parameters missing in ``before`` come last.

    Numbers that are equal as 32-bit floats, or differ by at most ``tolerance``, count as the same. ``names`` restricts
    the comparison, and gives the order: ``diff(file, table, names=file)`` ignores parameters that the file does not
    have.
    """
    old, new = plain_values(before), plain_values(after)
    compared = dict.fromkeys(names) if names is not None else {**dict.fromkeys(old), **dict.fromkeys(new)}
    return tuple(
        ParameterDifference(name, old.get(name), new.get(name))
        for name in compared
        if not _same(old.get(name), new.get(name), tolerance)
    )


def plain_values(values: ParameterValues) -> dict[str, int | float]:
    if isinstance(values, ParameterTable):
        return values.values_by_name()
    return {name: value.value if isinstance(value, Parameter) else value for name, value in values.items()}


def _same(left: float | None, right: float | None, tolerance: float) -> bool:
    if left is None or right is None:
        return left is right
    try:
        return same_value(left, right) or abs(left - right) <= tolerance
    except OverflowError:  # An int is too large for a float.
        return False


def _text(value: float | None) -> str:
    if value is None:
        return "missing"
    try:
        return number_text(value)
    except (ArithmeticError, ValueError):  # A value is NaN, infinite or beyond 32 bits.
        return repr(value)
