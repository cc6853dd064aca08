"""``async_block``: ``contextlib.asynccontextmanager`` whose blocks say what to write when they are used another way."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from aerokit.errors import InvalidArgument, LinkOpenError

if TYPE_CHECKING:
    from types import TracebackType

__all__ = ["async_block"]

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
