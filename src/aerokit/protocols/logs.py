"""Flight logs by LOG_REQUEST_LIST and LOG_REQUEST_DATA, the older protocol without checksums and sessions.

Behaviour of vehicles (ArduPilot 4.7, PX4 1.17) that determines this design:

- ArduPilot ignores further requests while it sends the blocks of a range. It sends a single block immediately, and can
  then answer the next request. PX4 drops the previous request; over UDP it sends 256 kB in one burst, regardless of
  losses. Therefore only one long range is requested at a time. Once it has ended, its gaps are requested: long gaps as
  ranges, single blocks many at a time with a short delay between them. Ranges become shorter if most of their blocks
  are lost.
- ArduPilot does not answer while armed, and sends nothing if it has received no heartbeat for three seconds.
- ArduPilot numbers logs from 1, PX4 from 0. PX4 lists all logs from the first requested log on, and does not answer if
  it has no logs. After a boot, PX4 sends no data before it has listed its logs.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.errors import FileTimeout, RemoteProtocolError
from aerokit.mavlink.messages import LogData, LogEntry, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.protocols.blocks import BlockRequests
from aerokit.protocols.exchange import MessageStream, Transfer, TransferOptions, format_ranges

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.mavlink.message import Message
    from aerokit.protocols.blocks import Reassembly

__all__ = ["LOG_BLOCK", "LogDownload", "LogList", "LogStop"]

LOG_BLOCK = 90
"""Number of log bytes in one message."""

# Pause between requests for single blocks. PX4 reads requests every 2 to 10 ms, and then only the latest one.
SPACING_S = 0.005

# Initial, minimum and maximum number of blocks that are requested as one range.
FIRST_RANGE, MIN_RANGE, MAX_RANGE = 512, 64, 40_000

# Gaps of at least this many blocks are requested as ranges.
LONG_GAP = 8

# Ranges grow until one lasts this many time-outs, so that the pause between two ranges is negligible.
MIN_RANGE_TIMEOUTS = 60

MAX_EARLY_ENDS = 3


class LogDownload(Transfer[int]):
    """Download of one log. The result is the size of the log.

    Args:
        size: the size in the log's entry.
        into: gets the log from ``into.position`` on. It keeps the received blocks even if the download fails.
    """

    expects: tuple[type[Message], ...] = (LogData,)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        log_id: int,
        size: int,
        into: Reassembly,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._id = log_id
        self._size = size
        self._reassembly = into
        self._requests = BlockRequests(self.round_trip, batch_size=1, spacing_s=SPACING_S)
        self._stream = MessageStream(self.round_trip)
        self._is_streaming = False
        self._range_end = into.position
        # Largest offset received of the current range; at first, the offset of the block before the range.
        self._latest_offset = into.position - LOG_BLOCK
        self._max_range_blocks = FIRST_RANGE
        self._requested_blocks = 0  # number of requested blocks of the current range
        self._received_blocks = 0
        self._early_ends = 0  # number of short blocks before the end of the log
        # True if the previous range, or an earlier download into the same `Reassembly`, may have left long gaps.
        self._may_have_long_gaps = bool(into.gaps)

    def _begin(self, now: float) -> None:
        self._proceed(now)

    def receive(self, message: Message, now: float) -> None:
        if self.done or not isinstance(message, LogData):
            return
        if message.id != self._id or not self._is_from_target(message) or not self._is_plausible(message.ofs):
            return
        end = message.ofs + message.count
        is_end_too_early = message.count < LOG_BLOCK and end < self._size
        if is_end_too_early:
            self._on_short_block(end)
        else:
            self._on_block(message, now)
        if not self.done:
            self._proceed(now)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            missing = self._reassembly.missing(self._size)
            self._fail(
                FileTimeout(
                    f"log {self._id}: no data received for {self._idle_timeout_s:g} s;"
                    f" {self._reassembly.received_bytes} of {self._size} bytes received",
                    missing=missing,
                )
            )
            self._send_end()
            return
        if self._is_streaming and now >= self._stream.due_at:  # The current range has ended early, or never started.
            self._is_streaming = False
            self._stream.failures += 1
        self._proceed(now)

    def _is_plausible(self, offset: int) -> bool:
        # A block far beyond the data received so far is ignored: millions of blocks before it would count as missing.
        return offset < self._size and offset - self._reassembly.tail < MAX_RANGE * LOG_BLOCK

    def _on_block(self, message: LogData, now: float) -> None:
        offset = message.ofs
        if self._is_streaming and offset > self._latest_offset:
            self._stream.on_message(now, (offset - self._latest_offset) // LOG_BLOCK)
            self._latest_offset = offset
            self._received_blocks += 1
            self._is_streaming = offset + LOG_BLOCK < self._range_end
        # If the log has grown since it was listed, PX4 sends a full block at the listed end. The new bytes are dropped.
        length = min(message.count, self._size - offset)
        try:
            is_new = self._reassembly.add(offset, bytes(message.data[:length]))
        except Exception as error:  # Writing failed, e.g. because the disk is full.
            self._fail(error)
            self._send_end()
            return
        if is_new:
            self._report_progress(now, self._reassembly.received_bytes, self._size)
        self._requests.on_answer(offset, now)

    def _on_short_block(self, end: int) -> None:
        # The vehicle could not read its own log here. It may succeed later, so the data is requested a few more times.
        self._is_streaming = False
        self._early_ends += 1
        if self._early_ends >= MAX_EARLY_ENDS:
            text = f"log {self._id} ends after {end} bytes, although the vehicle lists it with {self._size}"
            self._fail(RemoteProtocolError(text))
            self._send_end()

    def _proceed(self, now: float) -> None:
        reassembly = self._reassembly
        if reassembly.position >= self._size:
            self._finish(reassembly.position)
            self._send_end()
            return
        if not self._is_streaming:
            self._request_gaps(now)
        if not self._is_streaming and not reassembly.gaps:
            self._stream_range(reassembly.tail, self._size, now)
        self._wait_until(self._stream.due_at if self._is_streaming else self._requests.deadline)

    def _request_gaps(self, now: float) -> None:
        if self._may_have_long_gaps:
            gap = self._first_long_gap()
            if gap is not None:
                start, end = gap
                self._stream_range(start, end, now)
                return
            self._may_have_long_gaps = False
            for offset in self._reassembly.gaps:
                self._requests.request(offset)
        for offset in self._requests.take_due(now):
            self._request(offset, LOG_BLOCK)

    def _first_long_gap(self) -> tuple[int, int] | None:
        min_length = LONG_GAP * LOG_BLOCK
        start, end = 0, 0  # the current gap; `gaps` has the offset of each missing block
        for offset in self._reassembly.gaps:
            is_new_gap = offset != end
            if is_new_gap:
                if end - start >= min_length:
                    break
                start = offset
            end = offset + LOG_BLOCK
        return (start, end) if end - start >= min_length else None

    def _stream_range(self, start: int, end: int, now: float) -> None:
        """Request this range, or its beginning if it is too long for one request."""
        self._adapt_max_range()
        self._range_end = min(start + self._max_range_blocks * LOG_BLOCK, end, self._size)
        self._requested_blocks = math.ceil((self._range_end - start) / LOG_BLOCK)
        self._latest_offset = start - LOG_BLOCK
        self._received_blocks = 0
        self._is_streaming = True
        self._may_have_long_gaps = True
        self._stream.on_request(now)
        self._request(start, self._range_end - start)

    def _adapt_max_range(self) -> None:
        """Adapt the maximum length of a range to the losses in the previous range."""
        # After a time-out, missing blocks do not show that the range was too long: the link may have failed.
        if self._stream.failures or not self._requested_blocks:
            return
        # Radios lose up to a third of the messages. If more than half are lost, a queue overflows.
        if self._received_blocks < self._requested_blocks / 2:
            self._max_range_blocks = max(self._max_range_blocks // 2, MIN_RANGE)
        elif self._requested_blocks >= self._max_range_blocks and self._stream.interval_s:
            # There is a pause before each range. In a range of more than `useful_blocks`, this pause is negligible.
            useful_blocks = MIN_RANGE_TIMEOUTS * self.round_trip.timeout_s() / self._stream.interval_s
            self._max_range_blocks = min(2 * self._max_range_blocks, max(int(useful_blocks), FIRST_RANGE), MAX_RANGE)

    def _request(self, offset: int, count: int) -> None:
        self._outbox.append(LogRequestData(self.target_system, self.target_component, self._id, offset, count))

    def _send_end(self) -> None:
        self._outbox.append(LogRequestEnd(self.target_system, self.target_component))


class LogStop(Transfer[None]):
    """Repeats LOG_REQUEST_END, which is not acknowledged, until the vehicle sends no more log data.

    The caller sends the first LOG_REQUEST_END (`message`).
    """

    expects: tuple[type[Message], ...] = (LogData, LogEntry)

    @property
    def message(self) -> LogRequestEnd:
        return LogRequestEnd(self.target_system, self.target_component)

    def _begin(self, now: float) -> None:
        self._wait(now)

    def receive(self, message: Message, now: float) -> None:
        if not self.done and self._is_from_target(message):
            self._is_receiving = True

    def expire(self, now: float) -> None:
        if not self._is_receiving or self._is_idle(now):
            self._finish(None)
            return
        self._outbox.append(self.message)
        self._wait(now)

    def _wait(self, now: float) -> None:
        self._is_receiving = False
        self.deadline: float | None = now + 2.0 * self.round_trip.timeout_s()


LAST_ID = 0xFFFF


class LogList(Transfer[tuple[LogEntry, ...]]):
    """Requests the entries of the logs with ids from ``from_id`` (None: the first) to ``to_id`` (None: the last).

    Args:
        first_id: the id of this autopilot's oldest log.
        max_unanswered: the transfer fails after this number of unanswered requests. None means that it fails only after
            ``idle_timeout_s``.
    """

    expects: tuple[type[Message], ...] = (LogEntry,)

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        first_id: int,
        from_id: int | None = None,
        to_id: int | None = None,
        max_unanswered: int | None = None,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._first_id = first_id  # the lowest id that exists
        self._from_id = first_id if from_id is None else from_id  # the first requested id
        self._to_id = to_id
        self._max_unanswered = max_unanswered
        self._entries: dict[int, LogEntry] = {}
        self._missing: dict[int, None] | None = None  # ids of the missing entries; None before the first entry
        self._stream = MessageStream(self.round_trip)
        self._previous_id = 0  # id of the latest entry, or the first requested id if no entry has followed the request

    def _begin(self, now: float) -> None:
        self._request(now, self._from_id, LAST_ID if self._to_id is None else self._to_id)

    def receive(self, message: Message, now: float) -> None:
        if self.done or not isinstance(message, LogEntry) or not self._is_from_target(message):
            return
        if self._missing is None:
            self._determine_missing(message)
        self._stream.on_message(now, message.id - self._previous_id)
        self._previous_id = message.id
        assert self._missing is not None
        if message.id in self._missing:
            del self._missing[message.id]
            self._entries[message.id] = message
            self._report_progress(now, len(self._entries), len(self._entries) + len(self._missing))
        if not self._missing:
            self._finish(tuple(self._entries[number] for number in sorted(self._entries)))
            self._outbox.append(LogRequestEnd(self.target_system, self.target_component))
        # Entries arrive in the order of their ids. All missing ones precede this entry, so they are requested again.
        elif message.id > next(reversed(self._missing)):  # the largest missing id
            self._request_missing(now)
        self._set_deadline()

    def expire(self, now: float) -> None:
        self._stream.failures += 1
        # Before the first entry, `_missing` is None.
        is_unanswered = self._missing is None and self._stream.failures == self._max_unanswered
        if is_unanswered or self._is_idle(now):
            self._fail(self._timed_out())
            self._outbox.append(LogRequestEnd(self.target_system, self.target_component))
        elif self._missing is None:
            self._request(now, self._from_id, LAST_ID if self._to_id is None else self._to_id)
        else:
            self._request_missing(now)

    def _determine_missing(self, entry: LogEntry) -> None:
        """Determine the ids of the missing entries from the first entry."""
        last = self._first_id + entry.num_logs - 1
        if self._to_id is not None:
            last = min(last, self._to_id)
        self._missing = dict.fromkeys(range(self._from_id, last + 1))

    def _request_missing(self, now: float) -> None:
        assert self._missing
        self._request(now, min(self._missing), max(self._missing))

    def _request(self, now: float, first: int, last: int) -> None:
        self._outbox.append(LogRequestList(self.target_system, self.target_component, first, last))
        self._previous_id = first
        self._stream.on_request(now)
        self._set_deadline()

    def _set_deadline(self) -> None:
        if not self.done:
            self._wait_until(self._stream.due_at)

    def _timed_out(self) -> FileTimeout:
        if self._missing is None:
            return FileTimeout("log list: the vehicle does not answer", missing=((self._from_id, 0),))
        missing = tuple((number, 1) for number in self._missing)
        text = f"log list: the entries of logs {format_ranges(self._missing)} were not received"
        return FileTimeout(text, missing=missing)
