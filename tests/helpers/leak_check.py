"""Does something to a program at a certain turn of the event loop, and sees what is left of it afterwards."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from aerokit.testing.clock import VirtualClockLoop

__all__ = ["CountingLoop", "Left", "RealCountingLoop", "look", "run_and_do"]

Program = Callable[[], Awaitable[object]]


class _Counting:
    """Counts the turns of a loop, and calls something before one of them."""

    turns = 0
    do_at = -1
    action: Callable[[], object] = staticmethod(lambda: None)

    def _run_once(self) -> None:
        self.turns += 1
        if self.turns == self.do_at:
            self.action()
        super()._run_once()  # type: ignore[misc]

    def do_in(self, turns: int, action: Callable[[], object]) -> None:
        """Call ``action`` before the turn after next, for 1, and so on."""
        self.action = action
        self.do_at = self.turns + 1 + turns


class CountingLoop(_Counting, VirtualClockLoop):
    """On virtual time."""


class RealCountingLoop(_Counting, asyncio.SelectorEventLoop):
    """With real sockets."""


@dataclass(frozen=True)
class Left:
    """What a program could leave behind."""

    tasks: frozenset[Any] = frozenset()
    timers: tuple[str, ...] = ()
    sockets: int = 0
    files: frozenset[str] = field(default_factory=frozenset)
    threads: int = 0


def look() -> Left:
    """What is there now, beside the task that asks."""
    loop: Any = asyncio.get_running_loop()
    current = asyncio.current_task()
    return Left(
        frozenset(task for task in asyncio.all_tasks() if task is not current),
        tuple(repr(timer) for timer in loop._scheduled if not timer.cancelled()),
        len(loop._selector.get_map()),
        frozenset(_open_files()),
        threading.active_count(),
    )


def _open_files() -> list[str]:
    try:
        return [f"{fd}: {os.readlink(f'/proc/self/fd/{fd}')}" for fd in _numbers()]
    except OSError:  # no /proc here, or one of them is gone meanwhile
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
    """Run a program to its end, doing something to it at one turn of the loop; nothing may be left of it.

    Gives its finished task.
    """
    loop: Any = loop_class()

    async def main() -> asyncio.Task[object]:
        before = look()
        task = asyncio.ensure_future(_as_coroutine(program))
        loop.do_in(turns, lambda: action(task))
        await asyncio.wait([task])
        loop.do_at = -1
        for _ in range(5):  # sockets close on a later turn
            await asyncio.sleep(0)
        patience = 300 if loop_class is RealCountingLoop else 0  # what was written may linger for a second
        while look() != before and patience:
            await asyncio.sleep(0.01)
            patience -= 1
        assert look() == before, f"after {turns} turns"
        return task

    try:
        return loop.run_until_complete(main())  # type: ignore[no-any-return]
    finally:
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()


async def _as_coroutine(program: Program) -> object:
    return await program()
