"""Leak checks: run an action at one iteration of a program's event loop, then count the remaining resources."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from aerokit.testing.clock import VirtualClockLoop

__all__ = ["CountingLoop", "RealCountingLoop", "Resources", "resources", "run_and_do"]

Program = Callable[[], Awaitable[object]]


class _Counting:
    """Counts the iterations of a loop, and calls a function before one of them."""

    turns = 0
    do_at = -1
    action: Callable[[], object] = staticmethod(lambda: None)

    def _run_once(self) -> None:
        self.turns += 1
        if self.turns == self.do_at:
            self.action()
        super()._run_once()  # type: ignore[misc]

    def run_in(self, turns: int, action: Callable[[], object]) -> None:
        """Call ``action`` before a later iteration: 0 is the next one."""
        self.action = action
        self.do_at = self.turns + 1 + turns


class CountingLoop(_Counting, VirtualClockLoop):
    """Counting loop on virtual time."""


class RealCountingLoop(_Counting, asyncio.SelectorEventLoop):
    """Counting loop with real sockets."""


@dataclass(frozen=True)
class Resources:
    """Resources that a program could leak."""

    tasks: frozenset[Any] = frozenset()
    timers: tuple[str, ...] = ()
    sockets: int = 0
    files: frozenset[str] = field(default_factory=frozenset)
    threads: int = 0


def resources() -> Resources:
    """Collect the current resources, except for the calling task."""
    loop: Any = asyncio.get_running_loop()
    current = asyncio.current_task()
    return Resources(
        frozenset(task for task in asyncio.all_tasks() if task is not current),
        tuple(repr(timer) for timer in loop._scheduled if not timer.cancelled()),
        len(loop._selector.get_map()),
        frozenset(_open_files()),
        threading.active_count(),
    )


def _open_files() -> list[str]:
    try:
        return [f"{fd}: {os.readlink(f'/proc/self/fd/{fd}')}" for fd in _numbers()]
    except OSError:  # there is no /proc, or an entry has disappeared meanwhile
        return []


def _numbers() -> list[str]:
    folder = os.open("/proc/self/fd", os.O_RDONLY)
    try:
        return [number for number in os.listdir(folder) if int(number) != folder]
    finally:
        os.close(folder)


def run_and_do(
    program: Program,
    turns: int,
    action: Callable[[asyncio.Task[object]], object],
    loop_class: type[Any] = CountingLoop,
) -> asyncio.Task[object]:
    """Run a program to its end, run ``action`` at one iteration of the loop, and check that no resources remain.

    Returns the finished task of the program.
    """
    loop: Any = loop_class()

    async def main() -> asyncio.Task[object]:
        before = resources()
        task = asyncio.ensure_future(_as_coroutine(program))
        loop.run_in(turns, lambda: action(task))
        await asyncio.wait([task])
        loop.do_at = -1
        for _ in range(5):  # sockets close in a later iteration
            await asyncio.sleep(0)
        patience = 300 if loop_class is RealCountingLoop else 0  # written data may linger for a second
        while resources() != before and patience:
            await asyncio.sleep(0.01)
            patience -= 1
        assert resources() == before, f"after {turns} turns"
        return task

    try:
        return loop.run_until_complete(main())  # type: ignore[no-any-return]
    finally:
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()


async def _as_coroutine(program: Program) -> object:
    return await program()
