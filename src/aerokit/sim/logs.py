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
from typing import ClassVar

from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import LogData, LogErase, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.protocols.servers.files import FileTree
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import SimulatedVehicle

SAMPLE_LOG = b"aerokit simulator: sample log, contains no flight\n"
"""First bytes of each simulated log."""
BLOCK_SIZE = 90
"""Maximum number of bytes in a LOG_DATA message."""


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


DEFAULT_LOGS = (SimulatedLog(186_432, 1_789_990_000), SimulatedLog(45_103, 1_789_995_000))


class LogServer:
    """Sends lists and contents of logs at ``rate_hz`` messages per second, in groups of ``burst`` messages.

    The server makes one transfer at a time. Subclasses implement what differs between autopilots. Each log is also a
    file in ``files``.
    """

    FOLDER: ClassVar[str]
    """Folder of the log files."""
    burst = 10

    def __init__(self, vehicle: SimulatedVehicle, logs: Sequence[SimulatedLog], files: FileTree) -> None:
        self.logs: list[SimulatedLog] = list(logs)
        self.rate_hz: float = 4000.0
        self._vehicle = vehicle
        self._files = files
        for index, log in enumerate(logs):
            files.put(self.path(index), log.make, size=log.size)
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

    def path(self, index: int) -> str:
        """Return the path of the file with the log at this index."""
        raise NotImplementedError

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
        self._files.clear_folder(self.FOLDER)

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
        self._files.append(self.path(len(self.logs) - 1), self.logs[-1].make()[old.size :])

    def blocks(self, index: int, log_id: int, offset: int, count: int) -> list[Callable[[], Message]]:
        """Return functions that create the LOG_DATA messages of a range."""
        data = self.content(index)
        end = min(len(data), offset + count)
        # A range without data has one empty block.
        starts: Sequence[int] = range(offset, end, BLOCK_SIZE) if offset < end else [offset]
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
            build = self._outgoing.popleft()
            self._vehicle.send(build(), self._channel)
        if self._outgoing:
            self._vehicle.call_later(self.burst / self.rate_hz, lambda: self._send_next(transfer))


def _log_data(data: bytes, log_id: int, start: int, end: int) -> LogData:
    piece = data[start : min(end, start + BLOCK_SIZE)]
    return LogData(log_id, start, len(piece), piece)
