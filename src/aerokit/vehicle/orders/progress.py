"""Waits for something that takes a while, and gives up as soon as it cannot happen any more."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import Self

    from aerokit.position import Position
    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["LONGEST_SILENCE_S", "OLD_POSITION_S", "Arrivals", "Stillness", "await_progress"]

TICK_S = 0.25
"""Silence brings no message, so it is looked for this often."""
LONGEST_SILENCE_S = 10.0
OLD_POSITION_S = 2.0
STILL_S, MOVED_M = 12.0, 0.3


async def await_progress(
    talk: Talk,
    what: str,
    *,
    is_done: Callable[[], bool],
    trouble: Callable[[], str | None],
    describe: Callable[[], str],
    timeout: float | None,
    max_silence_s: float | None = LONGEST_SILENCE_S,
    held_for: float = 0.0,
    stillness: Callable[[], str | None] | None = None,
) -> None:
    """Return when ``is_done()`` has been true for ``held_for`` seconds; looked at whenever the vehicle's state changes.

    Raises:
        OperationRejected: ``trouble()`` gave a reason: it cannot happen any more.
        HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds (None: that is survived).
        OperationTimeout: ``timeout`` seconds have passed, or ``stillness()`` says that it does not move; ``describe()``
            tells how far it came.
        ConnectionClosed, LinkLost: the connection ended.
    """
    started = reasons_from = talk.connection.now()
    telemetry = talk.telemetry
    cells = (telemetry.mode, telemetry.armed, telemetry.position, telemetry.landed_state)
    done_since: float | None = None
    with Arrivals(talk, *cells) as news:
        while True:
            now = talk.connection.now()
            talk.connection.raise_if_ended()
            done_since = (now if done_since is None else done_since) if is_done() else None
            if done_since is not None and now - done_since >= held_for:
                return
            if done_since is None and (reason := trouble()):
                raise OperationRejected(f"{what}: {reason}", reasons=talk.texts_since(reasons_from))
            if max_silence_s is not None and talk.watch.silent_for_s > max_silence_s:
                raise HeartbeatTimeout(f"{what}: {talk.describe_link()}")
            if timeout is not None and now - started >= timeout:
                raise OperationTimeout(
                    f"{what}: not done within {timeout:g} s; {describe()}; {talk.describe_link()}"
                )
            if stillness is not None and (still := stillness()):
                raise OperationTimeout(f"{what}: {still}; {describe()}; {talk.describe_link()}")
            await news.next(TICK_S)


class Arrivals:
    """In its block: what is heard in any of these cells, and the end of the connection."""

    def __init__(self, talk: Talk, *cells: StateCell[Any], every_arrival: bool = False) -> None:
        self._talk, self._cells, self._every_arrival = talk, cells, every_arrival
        self._news = asyncio.Event()
        self._ends: list[Callable[[], None]] = []

    def __enter__(self) -> Self:
        hear = self._news.set
        self._ends = [
            cell.observe(lambda *_: hear(), every_arrival=self._every_arrival) for cell in self._cells
        ]
        self._ends.append(self._talk.connection.on_end(lambda _: hear()))
        return self

    def __exit__(self, *_: object) -> None:
        for end in self._ends:
            end()

    async def next(self, at_most_s: float) -> None:
        """Wait for news, or for so many seconds: silence brings none."""
        self._news.clear()
        # no cancel scope: on Python 3.10 one that runs out swallows a cancellation of the same turn of the loop
        tick = asyncio.get_running_loop().call_later(at_most_s, self._news.set)
        try:
            await self._news.wait()
        finally:
            tick.cancel()


class Stillness:
    """Notices a vehicle that has accepted an order to go somewhere and stays where it is.

    Nothing is said while its position is not heard, nor before ``STILL_S`` seconds: it turns first, or spools up.
    """

    # together with _from
    _since: float

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._from: Position | None = None

    def __call__(self) -> str | None:
        """How long it has not moved, in words; None: it moves, or that is not known."""
        now, cell = self._talk.connection.now(), self._talk.telemetry.position
        here = cell.latest
        if here is None or cell.age > OLD_POSITION_S:
            self._from = None
        elif self._from is None or _metres(here, self._from) > MOVED_M:
            self._from, self._since = here, now
        elif now - self._since >= STILL_S:
            return f"it has accepted the order and not moved for {now - self._since:.0f} s"
        return None


def _metres(one: Position, other: Position) -> float:
    above = [(each.altitude_relative_m, each.altitude_amsl_m) for each in (one, other)]
    climbed = next((abs(a - b) for a, b in zip(*above, strict=True) if a is not None and b is not None), 0.0)
    return one.distance_to(other) + climbed
