"""``Shadowable``: a property that gives way to an attribute of the same name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["Shadowable"]

T = TypeVar("T")


class Shadowable(Generic[T]):
    """Read as a property is, until an object gets an attribute of this name.

    For names that DroneKit 2.9 does not have: subclasses of its Vehicle may use them for their own things.
    """

    def __init__(self, getter: Callable[[Any], T]) -> None:
        self._getter = getter
        self.__doc__ = getter.__doc__

    @overload
    def __get__(self, instance: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type[Any]) -> T: ...
    def __get__(self, instance: object | None, owner: type[Any]) -> T | Self:
        return self if instance is None else self._getter(instance)
