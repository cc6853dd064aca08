"""`Leftover`: what a call that was given up left to be done, in a task of the vehicle's own."""

from __future__ import annotations

import asyncio
import logging
from contextlib import contextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.runtime.cancellation import Cancellation

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.vehicle.talk.talk import Talk

__all__ = ["Leftover"]

logger: logging.Logger = logging.getLogger("aerokit")


class Leftover:
    """The latest of its tasks: it can be dropped, and the end of the vehicle's block gives it a moment.

    ``name`` is the task's, ``what_it_leaves`` how the warning ends when the block is left before it is done.
    """

    def __init__(self, talk: Talk, name: str, what_it_leaves: str) -> None:
        self._talk, self._name, self._what_it_leaves = talk, name, what_it_leaves
        self._scope: Cancellation | None = None
        self._is_over: asyncio.Event | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is still to be done."""
        return self._scope is not None

    def start(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do this, for as long as the connection is there."""
        scope, is_over = Cancellation(), asyncio.Event()
        self._scope, self._is_over = scope, is_over

        async def run() -> None:
            with scope:
                await work()
            if self._scope is scope:
                self._scope = None
            is_over.set()

        self._talk.background.start(run, self._name)

    def drop(self) -> None:
        """It is not to be done any more; what it has shielded it ends."""
        if self._scope is not None:
            self._scope.cancel()
            self._scope = None

    @contextmanager
    def spared(self) -> Iterator[None]:
        """Within, ``drop`` leaves it alone: for what it does itself."""
        scope, self._scope = self._scope, None
        try:
            yield
        finally:
            self._scope = scope

    async def finish(self, within_s: float) -> None:
        """At the end of everything: wait for so long, and say so if it is not done then."""
        if self._scope is None or self._is_over is None or not self._talk.connection.is_open:
            return
        if within_s:
            with anyio.CancelScope(shield=True), anyio.move_on_after(within_s):
                await self._is_over.wait()
        if self._scope is not None:
            logger.warning(
                "the block of this vehicle was left %s: %s", self._what_it_leaves, self._talk.describe_link()
            )
