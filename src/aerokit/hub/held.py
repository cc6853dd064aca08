"""``HeldFrames``: what waits for a link that does not take more: bounded, and no order longer than a second."""

from __future__ import annotations

from typing import NamedTuple

from aerokit.hub.kinds import Kind

__all__ = ["MOST_BYTES", "MOST_FRAMES", "ORDERS_WAIT_S", "Held", "HeldFrames"]

ORDERS_WAIT_S = 1.0
"""An order that has waited longer is dropped: it would come when nobody reckons with it any more."""
MOST_FRAMES = 1024
"""So many wait at most."""
MOST_BYTES = 128 * 1024
"""So many bytes wait at most: some seconds of a mission or of parameters on a slow radio."""


class Held(NamedTuple):
    """One frame that waits."""

    raw: bytes
    kind: Kind
    message_id: int
    target: tuple[int, int]
    since: float


class HeldFrames:
    """A queue in which a newer telemetry message takes the place of the older one, and nothing else is replaced.

    What does not fit is dropped whole; telemetry makes room for the rest. Time is an argument.
    """

    def __init__(self) -> None:
        self._frames: dict[
            int, Held
        ] = {}  # telemetry by sender and message, others by numbers below 0; in order
        self._bytes = 0
        self._count = 0
        self._orders = self._telemetry = 0  # how many of them: none need not be searched for

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, held: Held, key: int) -> list[tuple[str, Held]]:
        """Have a frame wait; ``key`` is that of its sender and message. What is dropped for it, and why."""
        dropped: list[tuple[str, Held]] = []
        if held.kind is Kind.TELEMETRY:
            before = self._frames.get(key)
            if before is not None:
                self._bytes += len(held.raw) - len(before.raw)
                self._frames[key] = held
                return [("superseded", before)]
        else:
            self._count -= 1
            key = self._count
        while self._is_full(len(held.raw)):
            if not self._telemetry:
                return [*dropped, ("queue_full", held)]
            oldest = next(each for each, frame in self._frames.items() if frame.kind is Kind.TELEMETRY)
            dropped.append(("queue_full", self._take(oldest)))
        self._frames[key] = held
        self._bytes += len(held.raw)
        self._orders += held.kind is Kind.ORDER
        self._telemetry += held.kind is Kind.TELEMETRY
        return dropped

    def expire(self, now: float) -> list[tuple[str, Held]]:
        """Drop the orders that have waited too long."""
        if not self._orders:
            return []
        late = [
            key
            for key, frame in self._frames.items()
            if frame.kind is Kind.ORDER and now - frame.since > ORDERS_WAIT_S
        ]
        return [("late", self._take(key)) for key in late]

    def next(self) -> bytes | None:
        """Take the first one out; call :meth:`expire` before. None: nothing waits."""
        return self._take(next(iter(self._frames))).raw if self._frames else None

    def clear(self) -> list[tuple[str, Held]]:
        """Drop everything: the link has gone."""
        dropped = [("away", held) for held in self._frames.values()]
        self._frames.clear()
        self._bytes = self._orders = self._telemetry = 0
        return dropped

    def _is_full(self, size: int) -> bool:
        return len(self._frames) >= MOST_FRAMES or self._bytes + size > MOST_BYTES

    def _take(self, key: int) -> Held:
        held = self._frames.pop(key)
        self._bytes -= len(held.raw)
        self._orders -= held.kind is Kind.ORDER
        self._telemetry -= held.kind is Kind.TELEMETRY
        return held
