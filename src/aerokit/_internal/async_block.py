"""``async_block``: ``contextlib.asynccontextmanager`` whose blocks say what to write when they are used another way."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument, LinkOpenError

if TYPE_CHECKING:
    from types import TracebackType

P = ParamSpec("P")

T = TypeVar("T")


def async_block(
    function: Callable[P, AsyncIterator[T]],
) -> Callable[P, AbstractAsyncContextManager[T]]:
    """Make a function that yields once one whose result is entered by ``async with``, and by nothing else."""
    make = asynccontextmanager(function)

    @wraps(function)
    def make_block(*args: P.args, **kwargs: P.kwargs) -> AbstractAsyncContextManager[T]:
        return _Block(function.__name__, make(*args, **kwargs))

    return make_block


class _Block(AbstractAsyncContextManager[T]):
    def __init__(self, name: str, block: AbstractAsyncContextManager[T]) -> None:
        self._name, self._block = name, block

    async def __aenter__(self) -> T:
        try:
            asyncio.get_running_loop()
        except RuntimeError:  # trio.run, for example
            raise InvalidArgument(
                f"{self._name}(…) runs on asyncio, and no event loop of asyncio is running here: start the program by"
                " asyncio.run(…), or, on trio, use aerokit.sync in a thread (trio.to_thread.run_sync)"
            ) from None
        try:
            return await self._block.__aenter__()
        except (
            LinkOpenError,
            InvalidArgument,
        ) as error:  # where in here it came from says nothing to a program
            raise error.with_traceback(None) from error.__cause__

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> bool | None:
        return await self._block.__aexit__(kind, error, traceback)

    def __await__(self) -> None:
        raise self._misused("await")

    def __enter__(self) -> None:
        raise self._misused("with")

    def __exit__(self, *_: object) -> None:
        """Never: it cannot be entered so. Python looks for it first."""

    def __getattr__(self, name: str) -> None:
        raise AttributeError(
            f"{self._name}(…) has no {name!r}: it is not open yet; write `async with {self._name}(…) as …:`",
            name=name,
            obj=self,
        )

    def _misused(self, word: str) -> TypeError:
        return TypeError(
            f"{self._name}(…) is not for `{word}`: write `async with {self._name}(…) as …:` in an async function,"
            " or take aerokit.sync for a program without async"
        )


CALLS = {
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
"""Attribute → the call that changes what it tells."""


class ReadOnly:
    """A base of public objects. ``vehicle.mode = "GUIDED"`` raises AttributeError, which names ``set_mode``.

    What the vehicle tells (cells, properties, parts) is refused; a program may add attributes of its own.
    """

    def __setattr__(self, name: str, value: object) -> None:
        found = inspect.getattr_static(type(self), name, None)
        is_setter = isinstance(found, property) and found.fset is not None
        if name.startswith("_") or is_setter or callable(found) or not hasattr(type(found), "__get__"):
            object.__setattr__(
                self, name, value
            )  # of the program, or made in the constructor; a method in a mock
            return
        text = f"{type(self).__name__}.{name} = {shown(value)} is not allowed"
        call = CALLS.get(name)
        if call is None or not hasattr(type(self), call.partition("(")[0]):
            raise AttributeError(f"{text}: it is only read")
        wait = "" if type(self).__module__.startswith("aerokit.sync") else "await "
        raise AttributeError(
            f"{text}: it tells what the vehicle does; write {wait}….{call.format(value=shown(value))}"
        )
