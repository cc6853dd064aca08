"""``Snapshot``: base class of immutable values, like a frozen dataclass but faster to define and to create.

Defining thirty frozen dataclasses with slots takes longer than importing the rest of the package. Here only
``__init__`` is generated for each class, when its first value is created; all other methods are shared.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable
    from inspect import Signature

    from typing_extensions import Self, dataclass_transform
else:  # Importing typing_extensions takes longer than importing aerokit.

    def dataclass_transform(**_: object) -> Any:
        return lambda cls: cls


@dataclass_transform(frozen_default=True)
class _SnapshotType(type):
    """Turns annotated names into slots and generates ``__init__``. Needs ``from __future__ import annotations``."""

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any]) -> _SnapshotType:
        annotations: dict[str, str] = namespace.get("__annotations__", {})
        own_fields = tuple(field for field, annotation in annotations.items() if not annotation.startswith("ClassVar"))
        defaults: dict[str, Any] = {}
        fields: tuple[str, ...] = ()
        for base in bases:
            defaults.update(getattr(base, "_defaults", {}))
            fields += getattr(base, "__match_args__", ())
        fields += own_fields
        # A default is removed from the class, because a slot and a class attribute cannot have the same name.
        defaults.update({field: namespace.pop(field) for field in own_fields if field in namespace})
        cls = super().__new__(mcs, name, bases, {**namespace, "__slots__": own_fields, "__match_args__": fields})
        if own_fields:
            type.__setattr__(cls, "__init__", _lazy_init(cls))
        type.__setattr__(cls, "_defaults", defaults)
        # attrgetter needs at least one name. With `__class__`, all instances of a class without fields compare equal.
        type.__setattr__(cls, "_values", attrgetter(*(fields or ("__class__",))))
        return cls

    @property
    def __signature__(cls) -> Signature:
        """The signature of the constructor, for editors and notebooks."""
        from inspect import Signature, signature

        init: Any = getattr(cls, "__init__")  # noqa: B009 - mypy calls the plain access unsound
        if init is object.__init__:
            return Signature()
        defining_class = getattr(init, "defining_class", None)
        if defining_class is not None:
            init = _generate_init(defining_class)
        return signature(init.__get__(object()))  # Binding the method, to any object, removes self from its signature.


def _lazy_init(cls: Any) -> Callable[..., None]:
    """Return an ``__init__`` that replaces itself by a generated one when it is first called."""

    # Generating the method takes time, and a program creates values of only a few of these classes.
    def generate_and_call(self: object, *args: Any, **kwargs: Any) -> None:
        init = _generate_init(cls)
        type.__setattr__(cls, "__init__", init)
        init(self, *args, **kwargs)

    setattr(generate_and_call, "defining_class", cls)  # noqa: B010 - a plain assignment looks wrong to the type checker
    return generate_and_call


def _generate_init(cls: Any) -> Any:
    """Generate ``def __init__(self, a, b=default)``."""
    fields, defaults = cls.__match_args__, cls._defaults
    # The generated method sets the slots directly, because `__setattr__` of an immutable class raises.
    scope: dict[str, Any] = {f"_set_{field}": getattr(cls, field).__set__ for field in fields}
    scope.update({f"_default_{field}": value for field, value in defaults.items()})
    arguments = [f"{field}=_default_{field}" if field in defaults else field for field in fields]
    lines = [f"def __init__(self, {', '.join(arguments)}):", *(f" _set_{field}(self, {field})" for field in fields)]
    if hasattr(cls, "_check"):
        lines.append(" self._check()")
    exec("\n".join(lines), scope)
    init = scope["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    return init


class Snapshot(metaclass=_SnapshotType):
    """Base class of immutable, comparable, printable values.

    A subclass may define ``_check(self)`` to raise InvalidArgument for invalid fields. In the constructor, the fields
    of base classes come first, with their defaults.
    """

    __match_args__: ClassVar[tuple[str, ...]]
    _values: ClassVar[attrgetter[Any]]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return type(self)(**{**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as a dictionary, in the order of their declaration."""
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
    # Seven decimal places suffice: 1e-7 degrees are about a centimetre on earth.
    return repr(round(value, 7) if isinstance(value, float) else value)
