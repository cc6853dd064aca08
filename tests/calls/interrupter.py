"""Ctrl-C at the k-th await of a blocking call: when the loop's thread has come there, the caller is interrupted."""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from typing import Any

import pytest
from suspensions import Counted

from aerokit.sync.loop_thread import LoopThread

__all__ = ["AT_ITS_END", "Interrupter"]

AT_ITS_END = 1 << 30
"""Interrupt when the work on the loop is done but its result has not reached the caller."""
PATIENCE_S = 200.0
"""For tests that hang."""


class Interrupter:
    """Watches what blocking calls do on their loop; their caller is interrupted while it waits for one of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._at = self.count = 0
        self._begun = self._ended = 0
        self._turn = threading.Condition()
        self._has_interrupted = False
        self._wait_for = LoopThread.wait_for
        for name in ("run", "run_shielded"):
            monkeypatch.setattr(LoopThread, name, self._watching(getattr(LoopThread, name)))
        monkeypatch.setattr(LoopThread, "open_context", self._holding_open(LoopThread.open_context))
        interrupter = self
        monkeypatch.setattr(LoopThread, "wait_for", lambda loop, *what: interrupter._wait(loop, *what))

    def interrupted(self, call: Callable[[], object], at: int) -> bool:
        """Make a call and interrupt it at this await; whether it was interrupted.

        When the call comes back, nothing that it began on the loop may go on.
        """
        self._at, self.count, self._has_interrupted = at, 0, False
        try:
            call()
        except KeyboardInterrupt:
            assert self._has_interrupted
        finally:
            self._at = 0
        assert self._ended == self._begun, "the call has returned, but its task still runs"
        return self._has_interrupted

    def _watching(self, run: Callable[..., Any]) -> Callable[..., Any]:
        def watching(loop: LoopThread, function: Callable[..., Awaitable[object]], *args: Any, **kwargs: Any) -> Any:
            self._begun += 1
            return run(loop, lambda: self._watched(lambda: function(*args, **kwargs)))

        return watching

    def _holding_open(self, open_context: Callable[..., Any]) -> Callable[..., Any]:
        def watching(loop: LoopThread, context: AbstractAsyncContextManager[Any]) -> Any:
            self._begun += 1
            return open_context(loop, _Entered(context, self._watched))

        return watching

    async def _watched(self, function: Callable[[], Awaitable[object]]) -> object:
        try:
            return await Counted(function(), lambda _: self._suspended())
        finally:
            with self._turn:
                self._ended += 1
                self._turn.notify_all()

    def _suspended(self) -> None:
        with self._turn:
            self.count += 1
            self._turn.notify_all()

    def _wait(self, loop: LoopThread, *what: Any) -> None:
        """Wait like the program, but raise Ctrl-C when the work reaches the await."""
        if self._at and not self._has_interrupted:
            with self._turn:
                is_there = self._turn.wait_for(lambda: self.count >= self._at or self._ended == self._begun, PATIENCE_S)
            assert is_there, "nothing happens on the loop"
            if self.count >= self._at or self._at == AT_ITS_END:
                self._has_interrupted = True
                raise KeyboardInterrupt
        self._wait_for(loop, *what)


class _Entered:
    """An asynchronous context manager whose beginning is watched."""

    def __init__(
        self,
        context: AbstractAsyncContextManager[Any],
        watched: Callable[[Callable[[], Awaitable[object]]], Awaitable[object]],
    ) -> None:
        self._context, self._watched = context, watched

    async def __aenter__(self) -> object:
        return await self._watched(self._context.__aenter__)

    async def __aexit__(self, *exc: Any) -> bool | None:
        return await self._context.__aexit__(*exc)
