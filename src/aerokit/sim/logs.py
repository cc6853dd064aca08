"""Flight logs of a simulated vehicle, served by LOG_REQUEST_LIST, LOG_REQUEST_DATA and LOG_ERASE.

The protocol is documented with its messages only: https://mavlink.io/en/messages/common.html#LOG_REQUEST_LIST
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import LogData, LogEntry, LogErase, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import SimulatedVehicle

SAMPLE_LOG = b"aerokit simulator: sample log, contains no flight\n"
"""First bytes of each simulated log."""
_BLOCK = 90


@dataclass(frozen=True)
class SimulatedLog:
    """A log file of a simulated vehicle. Its content does not describe a flight.

    The content is `SAMPLE_LOG`, then pseudo-random bytes.
    """

    size: int
    time_utc: int = 1_790_000_000
    """Time of the log in seconds since 1970."""
    seed: int | None = None
    """Seed of the pseudo-random content. If None, the content depends on size and time."""

    def make(self) -> bytes:
        """Return the content. A larger log with the same seed has the same first bytes."""
        words = math.ceil(self.size / 4)  # A word has 32 bits.
        return (SAMPLE_LOG + random.Random(self._content_seed).randbytes(4 * words))[: self.size]

    def grown(self, count: int, time_utc: int) -> SimulatedLog:
        """Return this log extended by ``count`` bytes."""
        return SimulatedLog(self.size + count, time_utc, self._content_seed)

    @property
    def _content_seed(self) -> int:
        return self.size * 31 + self.time_utc if self.seed is None else self.seed


class LogServer:
    """Sends lists and contents of logs at ``rate_hz`` messages per second, in groups of ``burst`` messages.

    The server makes one transfer at a time. Subclasses implement what differs between autopilots. If the logs are also
    files on the vehicle, ``erase_files`` and ``append_to_file`` keep these files equal to the logs.
    """

    burst = 10

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        logs: Sequence[SimulatedLog],
        *,
        rate_hz: float = 4000.0,
        erase_files: Callable[[], None] = lambda: None,
        append_to_file: Callable[[int, bytes], None] = lambda number, data: None,
    ) -> None:
        self.logs: list[SimulatedLog] = list(logs)
        self.rate_hz = rate_hz
        self._vehicle = vehicle
        self._erase_files = erase_files
        self._append_to_file = append_to_file
        # Functions that build the messages of the present transfer.
        self._outgoing: deque[Callable[[], Message]] = deque()
        self._channel: Channel | None = None  # where the present transfer is sent
        self._transfer_number = 0  # number of the present transfer; scheduled calls for earlier transfers do nothing
        # Content of the log that was requested last, and the index of this log in `logs`; -1 if there is none.
        self._content = b""
        self._content_index = -1
        vehicle.on(LogRequestList, self._on_list)
        vehicle.on(LogRequestData, self._on_data)
        vehicle.on(LogErase, self._on_erase)
        vehicle.on(LogRequestEnd, self._on_end)

    @property
    def is_busy(self) -> bool:
        return bool(self._outgoing)

    def restart(self) -> None:
        """Abort the running transfer."""
        self._transfer_number += 1
        self._outgoing.clear()

    def _on_list(self, request: LogRequestList, channel: Channel) -> None:
        raise NotImplementedError

    def _on_data(self, request: LogRequestData, channel: Channel) -> None:
        raise NotImplementedError

    def _on_erase(self, request: LogErase, channel: Channel) -> None:
        self.restart()
        self.logs.clear()
        self._content_index = -1
        self._erase_files()

    def _on_end(self, request: LogRequestEnd, channel: Channel) -> None:
        self.restart()

    def content(self, index: int) -> bytes:
        log = self.logs[index]
        if index != self._content_index or len(self._content) != log.size:  # The size differs if the log has grown.
            self._content_index = index
            self._content = log.make()
        return self._content

    def write_on(self, count: int, time_utc: int) -> None:
        """Extend the newest log by ``count`` bytes, and set its time to ``time_utc``."""
        old = self.logs[-1]
        self.logs[-1] = old.grown(count, time_utc)
        self._append_to_file(len(self.logs) - 1, self.logs[-1].make()[old.size :])

    def blocks(self, index: int, log_id: int, offset: int, count: int) -> list[Callable[[], Message]]:
        """Return functions that create the LOG_DATA messages of a range."""
        data = self.content(index)
        end = min(len(data), offset + count)
        # A range without data has one empty block.
        starts: Sequence[int] = range(offset, end, _BLOCK) if offset < end else [offset]
        return [partial(_log_data, data, log_id, start, end) for start in starts]

    def transfer(self, messages: Sequence[Callable[[], Message]], channel: Channel) -> None:
        """Abort the running transfer, and send these messages."""
        self.restart()
        self._outgoing.extend(messages)
        self._channel = channel
        self._send_next(self._transfer_number)

    def _send_next(self, transfer: int) -> None:
        if transfer != self._transfer_number:  # This transfer was aborted or replaced.
            return
        for _ in range(min(self.burst, len(self._outgoing))):
            self._vehicle.send(self._outgoing.popleft()(), self._channel)
        if self._outgoing:
            self._vehicle.call_later(self.burst / self.rate_hz, lambda: self._send_next(transfer))


class ArduPilotLogServer(LogServer):
    """ArduPilot's log server. Log numbers start at 1, and requests are refused while the vehicle is armed.

    A request during a transfer, or for an unknown log, gets no data.
    """

    def __init__(
        self, vehicle: SimulatedVehicle, logs: Sequence[SimulatedLog], *, is_armed: Callable[[], bool], **options: Any
    ) -> None:
        super().__init__(vehicle, logs, **options)
        self._is_armed = is_armed
        self._has_warned = False

    def _on_list(self, request: LogRequestList, channel: Channel) -> None:
        if self._refuses():
            return
        if self.is_busy:
            self._vehicle.info("Log download in progress")
            return
        first, last = max(1, request.start), min(len(self.logs), request.end)
        if not self.logs:  # Without logs, answer with a single empty entry that has the number 0.
            first = last = 0
        numbers = range(first, last + 1)
        self.transfer([partial(self._entry, number, last) for number in numbers], channel)

    def _entry(self, number: int, last: int) -> LogEntry:
        if number == 0:
            return LogEntry(id=0, num_logs=0, last_log_num=0, time_utc=0, size=0)
        log = self.logs[number - 1]
        return LogEntry(number, len(self.logs), last, log.time_utc, log.size)

    def _on_data(self, request: LogRequestData, channel: Channel) -> None:
        is_known = 1 <= request.id <= len(self.logs)
        if self._refuses() or self.is_busy or not is_known:
            return
        self.transfer(self.blocks(request.id - 1, request.id, request.ofs, request.count), channel)

    def _on_erase(self, request: LogErase, channel: Channel) -> None:
        if not self._refuses():
            super()._on_erase(request, channel)

    def _on_end(self, request: LogRequestEnd, channel: Channel) -> None:
        if not self._refuses():
            super()._on_end(request, channel)

    def _refuses(self) -> bool:
        armed = self._is_armed()
        if armed and not self._has_warned:
            self._vehicle.send_text(MavSeverity.ERROR, "Disarm for log download")
        self._has_warned = armed
        return armed


class Px4LogServer(LogServer):
    """PX4's log server. Log numbers start at 0, and data is sent only after a list request.

    All logs from ``start`` are listed, and ``end`` is only copied to ``last_log_num``. A new request replaces the
    transfer. The last block is not cut to the requested size. Without logs, a list request is not answered.
    """

    _was_listed = False

    def _on_list(self, request: LogRequestList, channel: Channel) -> None:
        self._was_listed = True
        count = len(self.logs)
        last = count if request.end == 0xFFFF else request.end
        numbers = range(request.start, count)
        self.transfer([partial(self._entry, number, last) for number in numbers], channel)

    def _entry(self, number: int, last: int) -> LogEntry:
        log = self.logs[number]
        return LogEntry(number, len(self.logs), last, log.time_utc, log.size)

    def _on_data(self, request: LogRequestData, channel: Channel) -> None:
        is_available = self._was_listed and request.id < len(self.logs)
        if not is_available or request.ofs >= self.logs[request.id].size:
            self.restart()
            return
        whole_blocks = max(1, math.ceil(request.count / _BLOCK))
        self.transfer(self.blocks(request.id, request.id, request.ofs, whole_blocks * _BLOCK), channel)


def _log_data(data: bytes, log_id: int, start: int, end: int) -> LogData:
    piece = data[start : min(end, start + _BLOCK)]
    return LogData(log_id, start, len(piece), piece)
