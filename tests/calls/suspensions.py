"""A coroutine that is counted: it can be cancelled at its k-th suspension, or some time into it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Generator
from dataclasses import dataclass, field
from typing import Any

import anyio

__all__ = ["Cancelled", "Counted", "Point", "cancel_at", "points_of"]

IN_THE_MIDDLE_S = 0.02
"""Longer waits are cancelled in their middle as well, because messages of the vehicle wake no task."""
MAX_WAIT_S = 900.0
Cancel = Callable[[], object]


class Counted:
    """Awaits a coroutine and records the duration of each suspension; ``on_suspension`` is called for each."""

    def __init__(self, work: Awaitable[object], on_suspension: Callable[[int], object] = lambda count: None) -> None:
        self._work, self._on_suspension = work, on_suspension
        self.waits: list[float] = []

    @property
    def count(self) -> int:
        return len(self.waits)

    def __await__(self) -> Generator[Any, Any, object]:
        step, loop = self._work.__await__(), asyncio.get_running_loop()
        resume: Callable[[], Any] = lambda: next(step)  # noqa: E731
        while True:
            try:
                waited_for = resume()
            except StopIteration as end:
                return end.value
            self.waits.append(0.0)
            self._on_suspension(self.count)
            began = loop.time()
            try:
                yield waited_for
            except BaseException as error:
                resume = _throw(step, error)
            else:
                resume = lambda: next(step)  # noqa: E731
            self.waits[-1] = loop.time() - began


def _throw(step: Generator[Any, Any, object], error: BaseException) -> Callable[[], Any]:
    return lambda: step.throw(error)


@dataclass(frozen=True)
class Point:
    """A point of cancellation: ``after_s`` seconds into the k-th suspension; ``how`` is ``"task"`` or ``"scope"``."""

    suspension: int
    after_s: float = 0.0
    how: str = "task"


def points_of(waits: list[float], most: int | None) -> list[Point]:
    """Return the points at which to cancel a call with these suspensions, in both ways alternately.

    Each of the first dozen, then increasingly fewer, and the middle of long ones; ``most`` limits them, evenly
    spread.
    """
    found: list[tuple[int, float]] = []
    suspension, stride = 1, 1
    while suspension <= len(waits):
        found.append((suspension, 0.0))
        if (wait := waits[suspension - 1]) > IN_THE_MIDDLE_S:
            found.append((suspension, wait / 2))
        stride = stride if suspension < 12 else stride * 2
        suspension += stride
    if most is not None and len(found) > most:
        found = [found[round(index * (len(found) - 1) / (most - 1))] for index in range(most)]
    return [Point(*place, how=("task", "scope")[number % 2]) for number, place in enumerate(found)]


@dataclass
class Cancelled:
    """Result of a cancelled call."""

    at: float | None = None
    """Time of the cancellation, None if the call had ended before."""
    ended_at: float = 0.0
    error: BaseException | None = None
    was_scope_caught: bool = False
    counted: Counted | None = field(default=None, repr=False)


async def cancel_at(work: Awaitable[object], point: Point | None) -> Cancelled:
    """Run a call in a separate task and cancel it at ``point``; None: never."""
    loop, outcome = asyncio.get_running_loop(), Cancelled()
    scope = anyio.CancelScope()

    async def run() -> None:
        with scope:
            await counted
        outcome.was_scope_caught = scope.cancelled_caught

    def cancel() -> None:
        if not task.done():
            outcome.at = loop.time()
            scope.cancel() if point is not None and point.how == "scope" else task.cancel()

    def suspended(count: int) -> None:
        if point is not None and count == point.suspension:
            if point.after_s:
                loop.call_later(point.after_s, cancel_at_point)
            else:
                cancel()

    def cancel_at_point() -> None:
        if point is not None and counted.count == point.suspension:
            cancel()

    counted = outcome.counted = Counted(work, suspended)
    task = loop.create_task(run(), name="the call")
    _, endless = await asyncio.wait([task], timeout=MAX_WAIT_S)
    assert not endless, f"it does not end within {MAX_WAIT_S:g} s: {point}"
    outcome.ended_at = loop.time()
    if not task.cancelled():
        outcome.error = task.exception()
    else:
        outcome.error = asyncio.CancelledError()
    return outcome
