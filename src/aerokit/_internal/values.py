"""``Snapshot``: an immutable value with named fields, like a dataclass, but quick to define and to make.

Thirty frozen, slotted dataclasses cost more to import than the rest of the package. This writes the one
method that must be written, ``__init__``, for the first value that is made, and shares the others.

What the command line prints with ``--json``, what ``aerokit serve`` answers and what is given to other programs is
made by this one function, so that a value has one shape everywhere.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from inspect import Signature

    from typing_extensions import Self, dataclass_transform
else:  # importing typing_extensions would cost more than everything else here

    def dataclass_transform(**_: object) -> Any:
        """Only the type checker cares."""
        return lambda cls: cls


@dataclass_transform(frozen_default=True)
class _SnapshotType(type):
    """Turns annotated names into slots and writes ``__init__``; the module must postpone annotations."""

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any]) -> _SnapshotType:
        annotations: dict[str, str] = namespace.get("__annotations__", {})
        own = tuple(field for field, kind in annotations.items() if not kind.startswith("ClassVar"))
        defaults = {field: value for base in bases for field, value in getattr(base, "_defaults", {}).items()}
        defaults.update({field: namespace.pop(field) for field in own if field in namespace})
        fields = (*(field for base in bases for field in getattr(base, "__match_args__", ())), *own)
        cls = super().__new__(mcs, name, bases, {**namespace, "__slots__": own, "__match_args__": fields})
        if own:
            type.__setattr__(cls, "__init__", _init_later(cls))
        type.__setattr__(cls, "_defaults", defaults)
        type.__setattr__(cls, "_values", attrgetter(*(fields or ("__class__",))))
        return cls

    @property
    def __signature__(cls) -> Signature:
        """What editors and notebooks show of a class before the first value of it is made."""
        from inspect import Signature, signature

        init: Any = getattr(cls, "__init__")  # noqa: B009 - mypy calls the plain access unsound
        if init is object.__init__:
            return Signature()
        to_be_written = getattr(init, "of", None)
        return signature((init if to_be_written is None else _written_init(to_be_written)).__get__(object()))


def _init_later(cls: Any) -> Callable[..., None]:
    """What writes ``__init__`` when it is first called: a program makes few of all the kinds of values there are."""

    def write_and_call(self: object, *args: Any, **kwargs: Any) -> None:
        init = _written_init(cls)
        type.__setattr__(cls, "__init__", init)
        init(self, *args, **kwargs)

    setattr(write_and_call, "of", cls)  # noqa: B010 - a plain assignment looks wrong to the type checker
    return write_and_call


def _written_init(cls: Any) -> Any:
    """``def __init__(self, a, b=default)``, which sets the slots directly, behind __setattr__'s back."""
    fields, defaults = cls.__match_args__, cls._defaults
    scope: dict[str, Any] = {f"_set_{field}": getattr(cls, field).__set__ for field in fields}
    scope.update({f"_default_{field}": value for field, value in defaults.items()})
    arguments = [f"{field}=_default_{field}" if field in defaults else field for field in fields]
    lines = [f"def __init__(self, {', '.join(arguments)}):", *(f" _set_{f}(self, {f})" for f in fields)]
    if hasattr(cls, "_check"):
        lines.append(" self._check()")
    exec("\n".join(lines), scope)
    init = scope["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    return init


class Snapshot(metaclass=_SnapshotType):
    """Base of the values that programs read: immutable, comparable, printable.

    A subclass may have a method ``_check(self)``, which raises when the fields make no sense together. The fields of
    a base class come first, with their defaults.
    """

    __match_args__: ClassVar[tuple[str, ...]]
    _values: ClassVar[attrgetter[Any]]

    def replace(self, **changes: Any) -> Self:
        """A copy with these fields changed."""
        return type(self)(**{**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Field names and values, in the order of the fields."""
        return {field: getattr(self, field) for field in self.__match_args__}

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable: use replace({name}=…)")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable")

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return bool(self._values(self) == self._values(other))

    def __hash__(self) -> int:
        return hash(self._values(self))

    def __repr__(self) -> str:
        fields = ", ".join(f"{field}={_short(getattr(self, field))}" for field in self.__match_args__)
        return f"{type(self).__name__}({fields})"

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple(self.to_dict().values())


def _short(value: object) -> str:
    """Seven digits behind the point are a centimetre on the globe."""
    return repr(round(value, 7) if isinstance(value, float) else value)
