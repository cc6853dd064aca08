"""Flight logs by LOG_REQUEST_LIST and LOG_REQUEST_DATA: the older protocol, which has no checksums and no sessions.

What vehicles do (ArduPilot 4.7, PX4 1.17), and what follows from it:

- ArduPilot serves one request at a time and ignores what comes meanwhile; a request for one block is served at once.
  PX4 serves the latest request, and forgets the one before; over UDP it sends 256 kB at once, whatever becomes of them.
  So a long range is asked for alone; what was lost of it is asked for when it has ended: long holes as ranges of their
  own, single blocks many at a time and a little apart. The ranges get shorter when most of them is lost.
- ArduPilot answers nothing while it is armed, and sends nothing while it has not heard a heartbeat for three seconds.
- ArduPilot counts logs from 1, PX4 from 0. PX4 sends all logs from the first one that is asked for, and is silent when
  it has none. It gives data only after it has listed its logs since it was started.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import FileTimeout, RemoteProtocolError
from aerokit.mavlink.messages import LogData, LogEntry, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.protocols.blocks import BlockRequests
from aerokit.protocols.exchange import PATIENCE_S, OnProgress, Transfer, ranges
from aerokit.protocols.message_stream import MessageStream

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.blocks import Reassembly
    from aerokit.protocols.exchange import RoundTrip

__all__ = ["LOG_BLOCK", "LogDownload", "LogEnd", "LogList"]

LOG_BLOCK = 90
"""Bytes of a log in one message."""

SPACING_S = 0.005
"""Between requests for single blocks: PX4 looks at the latest one every 2 to 10 ms."""

FIRST_RANGE, SHORTEST_RANGE, LONGEST_RANGE = 512, 64, 40_000
"""In blocks."""

LONG_HOLE = 8

RANGE_ROUND_TRIPS = 60
"""A range lasts so many round trips at least, so that the pauses after it do not count."""

EARLY_ENDS = 3


class LogDownload(Transfer[int]):
    """One log from ``into.position`` on; the result is its size. ``into`` keeps what came, whatever happens.

    Args:
        size: of the log, as its entry says it.
    """

    expects: tuple[type[Message], ...] = (LogData,)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        log_id: int,
        size: int,
        into: Reassembly,
        *,
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
        self._id, self._size, self._into = log_id, size, into
        self._requests = BlockRequests(self.round_trip, at_once=1, spacing_s=SPACING_S)
        self._stream = MessageStream(self.round_trip)
        self._is_streaming = False
        self._until = into.position
        """Where the range ends that is being sent."""
        self._latest = self._until
        self._range, self._asked_for, self._received = FIRST_RANGE, 0, 0
        """In blocks."""
        self._early_ends = 0
        self._has_looked = True

    def start(self, now: float) -> None:
        """Ask for the first range."""
        self._begin(now)
        self._go_on(now)

    def receive(self, message: Message, now: float) -> None:
        """Take a block."""
        if self.done or not isinstance(message, LogData):
            return
        if message.id != self._id or not self._is_from_target(message) or not self._is_asked_for(message.ofs):
            return
        end = message.ofs + message.count
        if message.count < LOG_BLOCK and end < self._size:
            self._end_early(end)
        else:
            self._take_block(message, now)
        if not self.done:
            self._go_on(now)

    def expire(self, now: float) -> None:
        """Ask again for what is overdue, or give up."""
        if self._is_out_of_patience(now):
            missing = self._into.missing(self._size)
            self._fail(
                FileTimeout(
                    f"log {self._id}: nothing has come for {self._patience_s:g} s,"
                    f" {self._into.done} of {self._size} bytes are there",
                    missing=missing,
                )
            )
            self._say_end()
            return
        if self._is_streaming and now >= self._stream.due_at:
            self._is_streaming = False
            self._stream.fails += 1
        self._go_on(now)

    def _is_asked_for(self, offset: int) -> bool:
        """Whether a block of ours can be there. What lies far behind all others would make millions of gaps."""
        return offset < self._size and offset - self._into.tail < LONGEST_RANGE * LOG_BLOCK

    def _take_block(self, message: LogData, now: float) -> None:
        offset, into = message.ofs, self._into
        if self._is_streaming and offset > self._latest:
            self._stream.heard(now, (offset - self._latest) // LOG_BLOCK)
            self._latest = offset
            self._received += 1
            self._is_streaming = offset + LOG_BLOCK < self._until
        # PX4 sends whole blocks of a log that has grown
        length = min(message.count, self._size - offset)
        if into.add(offset, bytes(message.data[:length])):
            self._move(now, into.done, self._size)
        self._requests.answered(offset, now)

    def _end_early(self, end: int) -> None:
        """The vehicle could not read its own log; that may pass."""
        self._is_streaming = False
        self._early_ends += 1
        if self._early_ends >= EARLY_ENDS:
            self._fail(
                RemoteProtocolError(
                    f"log {self._id} ends after {end} bytes, although the vehicle lists it with {self._size}"
                )
            )
            self._say_end()

    def _go_on(self, now: float) -> None:
        into = self._into
        if into.position >= self._size:
            self._finish(into.position)
            self._say_end()
            return
        if not self._is_streaming:
            self._fill_holes(now)
        if not self._is_streaming and not into.gaps:
            self._stream_range(into.tail, self._size, now)
        self._set_deadline()

    def _fill_holes(self, now: float) -> None:
        """After a range: long holes one after the other, then whatever else is missing."""
        if not self._has_looked:
            hole = self._long_hole()
            if hole is not None:
                self._stream_range(*hole, now)
                return
            self._has_looked = True
            for offset in self._into.gaps:
                self._requests.ask(offset)
        for offset in self._requests.take_due(now):
            self._request(offset, LOG_BLOCK)

    def _long_hole(self) -> tuple[int, int] | None:
        """The first one, from where to where."""
        start = end = -1
        for offset in self._into.gaps:
            if offset != end:
                if end - start >= LONG_HOLE * LOG_BLOCK:
                    break
                start = offset
            end = offset + LOG_BLOCK
        return (start, end) if end - start >= LONG_HOLE * LOG_BLOCK else None

    def _stream_range(self, start: int, end: int, now: float) -> None:
        """Ask for a range, or its first part."""
        self._adapt_range()
        self._until = min(start + self._range * LOG_BLOCK, end, self._size)
        self._asked_for = -(-(self._until - start) // LOG_BLOCK)
        self._latest, self._received = start - LOG_BLOCK, 0
        self._is_streaming, self._has_looked = True, False
        self._stream.asked(now)
        self._request(start, self._until - start)

    def _adapt_range(self) -> None:
        """By what came of the last one. Radios lose a third of their messages; more is lost when a queue is full."""
        if self._stream.fails or not self._asked_for:
            return
        if self._received < self._asked_for / 2:
            self._range = max(self._range // 2, SHORTEST_RANGE)
        elif self._asked_for >= self._range and self._stream.interval_s:
            longest = RANGE_ROUND_TRIPS * self.round_trip.timeout_s() / self._stream.interval_s
            self._range = min(2 * self._range, max(int(longest), FIRST_RANGE), LONGEST_RANGE)

    def _request(self, offset: int, count: int) -> None:
        self._outbox.append(
            LogRequestData(self.target_system, self.target_component, self._id, offset, count)
        )

    def _say_end(self) -> None:
        self._outbox.append(LogRequestEnd(self.target_system, self.target_component))

    def _set_deadline(self) -> None:
        deadline = self._moved_at + self._patience_s
        due_at = self._stream.due_at if self._is_streaming else self._requests.deadline
        self.deadline: float | None = deadline if due_at is None else min(deadline, due_at)


class LogEnd(Transfer[None]):
    """LOG_REQUEST_END until nothing more comes. It is not acknowledged; silence is its answer.

    Args:
        is_sent: it was sent already, outside of this exchange.
    """

    expects: tuple[type[Message], ...] = (LogData, LogEntry)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        is_sent: bool = False,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        super().__init__(target_system, target_component, round_trip=round_trip, patience_s=patience_s)
        self._is_sent = is_sent
        self._is_heard = False

    @property
    def message(self) -> LogRequestEnd:
        """The request as it is sent."""
        return LogRequestEnd(self.target_system, self.target_component)

    def start(self, now: float) -> None:
        """Send it, unless that was done."""
        self._begin(now)
        if not self._is_sent:
            self._outbox.append(self.message)
        self._wait(now)

    def receive(self, message: Message, now: float) -> None:
        """What was on its way still comes for a while."""
        if not self.done and self._is_from_target(message):
            self._is_heard = True

    def expire(self, now: float) -> None:
        """Send it again when the vehicle has gone on, else be content."""
        if not self._is_heard or self._is_out_of_patience(now):
            self._finish(None)
            return
        self._outbox.append(self.message)
        self._wait(now)

    def _wait(self, now: float) -> None:
        self._is_heard = False
        self.deadline: float | None = now + 2.0 * self.round_trip.timeout_s()


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
