"""``RequestWindow``: which of many independent requests are sent when, and which of them again."""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from aerokit.protocols.exchange import RoundTrip

KeyT = TypeVar("KeyT", bound=Hashable)

WINDOW = 20
"""ArduPilot keeps 20 PARAM_REQUEST_READ waiting, and drops what comes beside."""
WIDEST = 5
"""So many times the size at most are under way."""
QUEUED, QUEUED_S = 1.5, 0.02
"""An answer that takes longer than that many times the fastest one, and some, has waited in a queue."""
FEW, UNLUCKY = 5, 3
"""When so few are left, those that are sent the third time are sent twice: on a bad radio they would be waited for."""
LAST_S = 0.5
"""The last few are not waited for longer than that, or two round trips: asking for them costs little."""
LONGEST_S = 2.0
"""Nothing is waited for longer: a queue that made answers late may be gone by now."""
OVERTAKEN = 3
"""Answers come in the order of their requests. One that so many later ones have overtaken was lost."""


class _Asked:
    __slots__ = ("attempts", "due_at", "first_at", "first_order", "order", "sent_at", "was_doubled")

    def __init__(self, now: float, order: int) -> None:
        self.first_at = self.sent_at = self.due_at = now
        self.first_order = self.order = order
        self.was_doubled = False
        self.attempts = 0


class RequestWindow(Generic[KeyT]):
    """Requests by key, ``size`` of them under way, and more while that does not make answers take longer.

    One is sent again when its answer is overdue (:class:`RoundTrip`), or when later requests were answered before it.
    """

    def __init__(self, round_trip: RoundTrip, *, size: int = WINDOW, doubles_last: bool = True) -> None:
        self._round_trip, self._size, self._room = round_trip, size, size
        self._shortest_s = math.inf
        self._doubles_last = doubles_last
        self._answered_at = self._silent_until = -math.inf
        self._silences = 0
        self._waiting: dict[KeyT, None] = {}
        self._under_way: dict[KeyT, _Asked] = {}  # in the order of sending
        self._asked: dict[KeyT, _Asked] = {}
        self._ambiguous: dict[KeyT, float] = {}
        self._orders = 0

    def __len__(self) -> int:
        return len(self._waiting) + len(self._under_way)

    def __contains__(self, key: object) -> bool:
        return key in self._waiting or key in self._under_way

    @property
    def deadline(self) -> float | None:
        """When the next answer is overdue; None while nothing is under way."""
        return min((asked.due_at for asked in self._under_way.values()), default=None)

    def attempts(self, key: KeyT) -> int:
        """How often it was sent so far."""
        asked = self._asked.get(key)
        return 0 if asked is None else asked.attempts

    def overdue(self, now: float) -> list[KeyT]:
        """Those whose answers should have come by now."""
        return [key for key, asked in self._under_way.items() if asked.due_at <= now]

    def ask(self, key: KeyT) -> None:
        """Have it sent as soon as there is room; nothing happens when it waits or is under way."""
        if key not in self:
            self._waiting[key] = None

    def send(self, key: KeyT, now: float) -> None:
        """It is sent now, beside the window."""
        self._waiting.pop(key, None)
        self._send(key, now)

    def forget(self, key: KeyT) -> None:
        """Send it no more: its answer came from elsewhere, or is not wanted any longer."""
        self._waiting.pop(key, None)
        self._under_way.pop(key, None)
        self._asked.pop(key, None)

    def answered(self, key: KeyT, now: float, *, overtaken: int = OVERTAKEN) -> list[KeyT]:
        """Its answer has come; returns those that were sent ``overtaken`` or more before it and are taken for lost."""
        asked = self._asked.pop(key, None)
        self._waiting.pop(key, None)
        self._under_way.pop(key, None)
        self._answered_at, self._silences = now, 0
        if asked is None:
            self._answered_again(key)
            return []
        if asked.attempts == 1:
            self._measured(now - asked.first_at)
        elif not asked.was_doubled:
            self._ambiguous[key] = now - asked.first_at
        lost = []
        for other, each in self._under_way.items():
            if each.order > asked.first_order - overtaken:
                break
            lost.append(other)
        self._put_first(lost)
        return lost

    def take_due(self, now: float) -> list[KeyT]:
        """What has to be sent now, some of it twice; it counts as sent."""
        overdue = self.overdue(now)
        if any(self._under_way[key].sent_at >= self._answered_at for key in overdue):
            self._note_silence(now)
        self._put_first(overdue)
        due: list[KeyT] = []
        while self._waiting and len(self._under_way) < self._room:
            key = next(iter(self._waiting))
            del self._waiting[key]
            self._send(key, now)
            due.append(key)
        if self._doubles_last and len(self._under_way) <= FEW and not self._waiting:
            unlucky = [key for key in due if self._asked[key].attempts >= UNLUCKY]
            for key in unlucky:
                self._asked[key].was_doubled = True
            due += unlucky
        return due

    def _note_silence(self, now: float) -> None:
        """Nothing comes any more. These are no single losses: ask for less, and less often."""
        self._room = self._size
        if now >= self._silent_until:
            self._silences += 1
            self._silent_until = now + self._timeout_s(1)

    def _timeout_s(self, attempts: int) -> float:
        round_trip = self._round_trip
        seconds = round_trip.timeout_s(min(attempts, 2) + self._silences)
        if len(self) <= FEW and round_trip.smoothed_s is not None:
            seconds = min(seconds, max(LAST_S, 2 * round_trip.smoothed_s))
        return min(seconds, LONGEST_S)

    def _measured(self, seconds: float) -> None:
        """Ask for more at once as long as answers come as fast as ever: a queue is building up somewhere otherwise."""
        self._round_trip.measured(seconds)
        self._shortest_s = min(self._shortest_s, seconds)
        if seconds <= QUEUED * self._shortest_s + QUEUED_S:
            self._room = min(self._room + 1, WIDEST * self._size)
        else:
            self._room = max(self._room - 1, self._size)

    def _send(self, key: KeyT, now: float) -> None:
        self._orders += 1
        asked = self._asked.get(key)
        if asked is None:
            asked = self._asked[key] = _Asked(now, self._orders)
        asked.attempts += 1
        asked.order, asked.sent_at = self._orders, now
        asked.due_at = now + self._timeout_s(asked.attempts)
        self._under_way[key] = asked

    def _put_first(self, keys: list[KeyT]) -> None:
        if keys:
            for key in keys:
                del self._under_way[key]
            self._waiting = {**dict.fromkeys(keys), **self._waiting}

    def _answered_again(self, key: KeyT) -> None:
        """A second answer: the first one was to the first sending, which we had given up too early."""
        seconds = self._ambiguous.pop(key, None)
        if seconds is not None:
            self._round_trip.measured(seconds)
