"""``async_block`` and ``ReadOnly``: their errors explain how to use the public API correctly."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from aerokit._internal.formatting import short_repr
from aerokit.errors import InvalidArgument, LinkOpenError

if TYPE_CHECKING:
    from types import TracebackType

P = ParamSpec("P")

T = TypeVar("T")


def async_block(function: Callable[P, AsyncIterator[T]]) -> Callable[P, AbstractAsyncContextManager[T]]:
    """Like contextlib.asynccontextmanager, but any use without ``async with`` raises a helpful TypeError."""
    make = asynccontextmanager(function)

    @wraps(function)
    def make_block(*args: P.args, **kwargs: P.kwargs) -> AbstractAsyncContextManager[T]:
        return _Block(function.__name__, make(*args, **kwargs))

    return make_block


class _Block(AbstractAsyncContextManager[T]):
    """Context manager that forwards to ``block``, and raises helpful errors when it is misused."""

    def __init__(self, name: str, block: AbstractAsyncContextManager[T]) -> None:
        self._name, self._block = name, block

    async def __aenter__(self) -> T:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # No asyncio loop is running, for example in trio.run.
            raise InvalidArgument(
                f"{self._name}(…) requires asyncio, and no asyncio event loop is running here: start the program with"
                " asyncio.run(…), or, on trio, use aerokit.sync in a thread (trio.to_thread.run_sync)"
            ) from None
        try:
            return await self._block.__aenter__()
        except (LinkOpenError, InvalidArgument) as error:
            # A traceback through the code of this library does not help a user.
            raise error.with_traceback(None) from error.__cause__

    async def __aexit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool | None:
        return await self._block.__aexit__(error_type, error, traceback)

    def __await__(self) -> None:
        raise self._misused("await")

    def __enter__(self) -> None:
        raise self._misused("with")

    def __exit__(self, *_: object) -> None:
        # Never called. It must exist, because Python looks it up before it calls `__enter__`.
        ...

    def __getattr__(self, name: str) -> None:
        raise AttributeError(
            f"{self._name}(…) has no {name!r} before it is opened; write `async with {self._name}(…) as …:`",
            name=name,
            obj=self,
        )

    def _misused(self, word: str) -> TypeError:
        return TypeError(
            f"{self._name}(…) does not support `{word}`: write `async with {self._name}(…) as …:` in an async function,"
            " or use aerokit.sync in a program without async"
        )


# For error texts: maps a read-only attribute to the method call that changes the value on the vehicle.
_SETTER_CALLS = {
    "mode": "set_mode({value})",
    "mode_name": "set_mode({value})",
    "armed": "arm() or disarm()",
    "is_armed": "arm() or disarm()",
    "home": "set_home(place)",
    "position": "go_to(place)",
    "heading_deg": "set_heading(degrees)",
    "ground_speed_m_s": "set_speed(metres per second)",
    "current": "set_current(item)",
}


class ReadOnly:
    """Base class of public objects whose attributes report the state of the vehicle.

    Assigning to a state cell, a property or a sub-object raises AttributeError. The error text names the method to
    call, for example ``set_mode`` for ``vehicle.mode = "GUIDED"``. A program may add attributes.
    """

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse to set an attribute that reports the vehicle's state. Set any other attribute."""
        attribute = inspect.getattr_static(type(self), name, None)
        is_private = name.startswith("_")
        has_setter = isinstance(attribute, property) and attribute.fset is not None
        is_method = callable(attribute)  # A program may replace a method, for example by a mock.
        # An attribute without a descriptor is set by the constructor, or added by the program.
        is_descriptor = hasattr(type(attribute), "__get__")
        if is_private or has_setter or is_method or not is_descriptor:
            object.__setattr__(self, name, value)
            return
        text = f"{type(self).__name__}.{name} = {short_repr(value)} is not allowed"
        call = _SETTER_CALLS.get(name, "")
        setter, _, _ = call.partition("(")
        if not setter or not hasattr(type(self), setter):
            raise AttributeError(f"{text}: this attribute is read-only")
        wait = "" if type(self).__module__.startswith("aerokit.sync") else "await "
        replacement = f"{wait}….{call.format(value=short_repr(value))}"
        raise AttributeError(f"{text}: this attribute reports the state of the vehicle; write {replacement}")
