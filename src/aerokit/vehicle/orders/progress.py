"""Waits for something that takes a while, and gives up as soon as it cannot happen any more."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.position import Position
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["LONGEST_SILENCE_S", "OLD_POSITION_S", "Stillness", "await_progress"]

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
    changed, loop = asyncio.Event(), asyncio.get_running_loop()
    started = talk.connection.now()
    reasons_from = started
    cells = (talk.telemetry.mode, talk.telemetry.armed, talk.telemetry.position)
    ends = [cell.observe(lambda *_: changed.set()) for cell in (*cells, talk.telemetry.landed_state)]
    ends.append(talk.connection.on_end(lambda _: changed.set()))
    done_since: float | None = None
    try:
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
            changed.clear()
            tick = loop.call_later(TICK_S, changed.set)  # no cancel scope: on Python 3.10 one that runs out
            try:  # swallows a cancellation that comes at the same turn of the loop
                await changed.wait()
            finally:
                tick.cancel()
    finally:
        for end in ends:
            end()


class Stillness:
    """Notices a vehicle that has accepted an order to go somewhere and stays where it is.

    Nothing is said while its position is not heard, nor before ``STILL_S`` seconds: it turns first, or spools up.
    """

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._from: Position | None = None
        self._since = 0.0

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
