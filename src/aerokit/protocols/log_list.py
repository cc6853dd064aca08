"""The list of flight logs: LOG_REQUEST_LIST until every LOG_ENTRY has come."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import FileTimeout
from aerokit.mavlink.messages import LogEntry, LogRequestEnd, LogRequestList
from aerokit.protocols.message_stream import MessageStream
from aerokit.protocols.transfer import PATIENCE_S, OnProgress, Transfer, ranges

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.round_trip import RoundTrip

__all__ = ["LogList"]

LAST = 0xFFFF


class LogList(Transfer[tuple[LogEntry, ...]]):
    """The logs from ``start`` to ``end`` (None: the last one), by their entries as they came.

    Args:
        first_id: the id of the oldest log that this autopilot has.
        most_unanswered: give up after so many requests without any entry; None: after ``patience_s``.
    """

    expects: tuple[type[Message], ...] = (LogEntry,)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        first_id: int,
        start: int | None = None,
        end: int | None = None,
        most_unanswered: int | None = None,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(
            target_system,
            target_component,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self._first_id = first_id
        self._start = first_id if start is None else start
        self._end = end
        self._most_unanswered = most_unanswered
        self._entries: dict[int, LogEntry] = {}
        self._missing: dict[int, None] | None = None
        """None while nobody knows how many there are."""
        self._stream = MessageStream(self.round_trip)
        self._last_id = 0

    def start(self, now: float) -> None:
        """Ask for all of them."""
        self._begin(now)
        self._request(now, self._start, LAST if self._end is None else self._end)

    def receive(self, message: Message, now: float) -> None:
        """Take an entry."""
        if self.done or not isinstance(message, LogEntry) or not self._is_from_target(message):
            return
        if self._missing is None:
            self._expect(message)
        self._stream.heard(now, message.id - self._last_id)
        self._last_id = message.id
        assert self._missing is not None
        if message.id in self._missing:
            del self._missing[message.id]
            self._entries[message.id] = message
            self._move(now, len(self._entries), len(self._entries) + len(self._missing))
        if not self._missing:
            self._finish(tuple(self._entries[number] for number in sorted(self._entries)))
            self._outbox.append(LogRequestEnd(self.target_system, self.target_component))
        elif message.id > next(reversed(self._missing)):  # the last one: they are in order
            self._ask_for_missing(now)
        self._set_deadline()

    def expire(self, now: float) -> None:
        """Ask again for those that are missing, or give up."""
        self._stream.fails += 1
        is_unanswered = self._missing is None and self._stream.fails == self._most_unanswered
        if is_unanswered or self._is_out_of_patience(now):
            self._fail(self._timed_out())
            self._outbox.append(LogRequestEnd(self.target_system, self.target_component))
        elif self._missing is None:
            self._request(now, self._start, LAST if self._end is None else self._end)
        else:
            self._ask_for_missing(now)

    def _expect(self, entry: LogEntry) -> None:
        last = self._first_id + entry.num_logs - 1
        if self._end is not None:
            last = min(last, self._end)
        self._missing = dict.fromkeys(range(self._start, last + 1))

    def _ask_for_missing(self, now: float) -> None:
        assert self._missing
        self._request(now, min(self._missing), max(self._missing))

    def _request(self, now: float, first: int, last: int) -> None:
        self._outbox.append(LogRequestList(self.target_system, self.target_component, first, last))
        self._last_id = first
        self._stream.asked(now)
        self._set_deadline()

    def _set_deadline(self) -> None:
        if not self.done:
            self.deadline: float | None = min(self._stream.due_at, self._moved_at + self._patience_s)

    def _timed_out(self) -> FileTimeout:
        if self._missing is None:
            return FileTimeout("list of logs: the vehicle does not answer", missing=((self._start, 0),))
        missing = tuple((number, 1) for number in self._missing)
        return FileTimeout(
            f"list of logs: the entries of {ranges(self._missing)} are missing", missing=missing
        )
