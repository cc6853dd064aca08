"""``weakly``: what the event loop calls must not keep a vehicle that the program has dropped."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["weakly"]


def weakly(method: Callable[..., object]) -> Callable[..., None]:
    """A function that calls a method of an object for as long as the object is there, and then does nothing.

    Args:
        method: a bound method; of its object only a weak reference is kept.
    """
    bound: Any = method
    owner, function = weakref.ref(bound.__self__), bound.__func__

    def call(*args: object) -> None:
        present = owner()
        if present is not None:
            function(present, *args)

    return call
