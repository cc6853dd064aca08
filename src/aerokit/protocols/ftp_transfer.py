"""MAVFTP downloads by bursts, and uploads by windowed writes.

Behaviour of servers (ArduPilot 4.7, PX4 1.17) that determines this design:

- The answer to a burst request is a sequence of blocks. ArduPilot sends 500 blocks, and processes nothing else
  meanwhile; it queues five requests and drops further ones. PX4 answers reads during a burst, and a new burst request
  replaces the current burst. Missing blocks are therefore requested as soon as they are noticed: four at a time during
  a burst, more afterwards.
- Requests are always for whole blocks at multiples of the block size, because the vehicle pads ``@PARAM/param.pck`` so
  that no value crosses the end of a block.
- The size that ArduPilot reports for files whose names begin with ``@`` is an estimate. Only the EOF error is reliable.
- A burst ends with a NAK that has the EOF error. If the last block was full, ArduPilot's NAK has the offset of this
  block.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from aerokit.errors import FileTimeout, RemoteProtocolError
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.blocks import BlockRequests
from aerokit.protocols.exchange import RoundTrip, TransferOptions
from aerokit.protocols.ftp import DATA_SIZE, SEQUENCE_COUNT, FtpClient, FtpExchange, FtpMessage

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from aerokit.protocols.blocks import Reassembly

__all__ = ["FtpDownload", "FtpUpload", "is_virtual"]

# Errors by which servers answer a burst request if they do not support bursts.
NO_BURST = (MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND)
WINDOW_DURING_BURST = 4
# While this many blocks or more are missing, no burst is requested, because all blocks after the first missing one stay
# in memory.
MAX_GAPS = 512
# Number of blocks that ArduPilot sends in one burst.
BURST_BLOCKS = 500
# After the latest block of a burst, the server counts as busy for this many block intervals.
BUSY_BLOCKS = 3
# Minimum seconds to wait for the first block of a long file. In this time, even a slow radio carries a few blocks.
FIRST_BLOCK_TIMEOUT_S = 0.5
SHORT_FILE = 20 * DATA_SIZE  # If a file has at most this many bytes, repeating its burst costs little.
MAX_REPEATED_BURSTS = 3
# Maximum number of remembered bursts. Blocks of earlier bursts may still arrive.
MAX_BURSTS = 32
# A block that is this many bytes or more beyond all others is ignored. Its sequence number does not prove that the
# block belongs to the burst, because sequence numbers wrap around.
MAX_BLOCK_DISTANCE = SEQUENCE_COUNT // 2 * DATA_SIZE
# A burst counts as ended if no block arrives in the time that this many blocks usually take. The first number applies
# until the burst's first block arrives, the second one afterwards. Radios hardly ever lose so many blocks in a row.
MAX_LOST_FIRST_BLOCKS, MAX_LOST_BLOCKS = 4, 10


def is_virtual(path: str) -> bool:
    """Return True if the vehicle generates the file while it is read. Size and checksum are then estimates."""
    return path.startswith("@")


class _SentRequest(NamedTuple):
    """One transmission of a request. Each has its own sequence number, so every answer measures the round trip."""

    offset: int
    sent_at: float


class _Burst:
    """A burst request, and the last of its blocks that was received so far."""

    __slots__ = ("highest_at", "highest_block", "offset", "sent_at", "sequence")

    def __init__(self, sequence: int, offset: int, sent_at: float) -> None:
        self.sequence, self.offset, self.sent_at = sequence, offset, sent_at
        self.highest_block = -1  # number of the block with the largest offset; -1 before the first block
        self.highest_at = sent_at  # time at which that block arrived; before it, the time of the request

    def blocks_before(self, reply: FtpMessage) -> int:
        """Return how many blocks the server sent in this burst before this reply: each has the next sequence number."""
        return (reply.sequence - self.sequence - 1) % SEQUENCE_COUNT

    def contains(self, reply: FtpMessage) -> bool:
        blocks, remainder = divmod(reply.offset - self.offset, DATA_SIZE)
        return remainder == 0 and blocks >= 0 and blocks % SEQUENCE_COUNT == self.blocks_before(reply)

    def file_end(self, reply: FtpMessage) -> int | None:
        """Return the end of the file, or None if this NAK does not belong to the burst."""
        blocks = self.blocks_before(reply)
        if blocks == 0:  # The burst began at or after the end of the file.
            return self.offset
        last_offset = self.offset + (blocks - 1) * DATA_SIZE
        if not last_offset <= reply.offset <= last_offset + DATA_SIZE:
            return None
        # PX4's NAK has the offset of the end of the file. If the last block was full, ArduPilot's NAK has the offset of
        # this block instead.
        return reply.offset if reply.offset > last_offset else last_offset + DATA_SIZE


class FtpDownload(FtpExchange[int]):
    """Download of an open file. The result is the size of the file.

    Args:
        into: gets the file from ``into.position`` on. It keeps the received blocks even if the download fails.
        session: the session of the open file.
        size: the size that the server reported on opening; 0 if the server does not know it.
    """

    def __init__(
        self,
        client: FtpClient,
        path: str,
        into: Reassembly,
        *,
        session: int,
        size: int,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(client, path, **options)
        self._reassembly = into
        self._session = session
        self._size = None if is_virtual(path) or size == 0 else size
        self._scanned_until = into.position  # Missing blocks before this offset were already requested.
        self._requests = BlockRequests(self.round_trip)
        self._reads: dict[int, _SentRequest] = {}  # requests by sequence number
        self._bursts: deque[_Burst] = deque(maxlen=MAX_BURSTS)
        self._is_bursting = False
        self._failed_bursts = 0
        self._bursts_without_new_block = 0  # number of bursts requested since the last new block arrived
        self._supports_bursts = True
        self._burst_active_at = 0.0  # time of the latest burst request or block of a burst
        self._interval = RoundTrip(min_s=0.001)  # smoothed time between two blocks of a burst

    def _begin(self, now: float) -> None:
        """Request the first burst, and the blocks that are already known to be missing."""
        self._proceed(now)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            self._fail(self._timeout_error())
            return
        if self._is_bursting and now >= self._next_block_deadline:  # The burst has ended, or its request was lost.
            self._is_bursting = False
            self._failed_bursts += 1
        self._proceed(now)

    # ------------------------------------------------------------------------------- replies

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.request_opcode == MavFtpOpcode.BURSTREADFILE:
            self._receive_burst(reply, now)
        elif reply.request_opcode == MavFtpOpcode.READFILE:
            # A reply has the sequence number of its request plus 1.
            request = self._reads.pop((reply.sequence - 1) % SEQUENCE_COUNT, None)
            if request is not None:
                self._receive_read(request, reply, now)
        if not self.done:
            self._proceed(now)

    def _receive_burst(self, reply: FtpMessage, now: float) -> None:
        for burst in reversed(self._bursts):
            if reply.is_ack:
                if burst.contains(reply):
                    self._on_block(burst, reply, now)
                    return
            # A NAK, whatever its error, belongs to a burst if the file may end at the offset of the NAK.
            elif (end := burst.file_end(reply)) is not None:
                self._end_burst(burst, end, reply)
                return

    def _on_block(self, burst: _Burst, reply: FtpMessage, now: float) -> None:
        if not self._is_plausible(reply.offset):
            return
        is_latest = burst is self._bursts[-1]
        self._record_block(burst, burst.blocks_before(reply), now)
        self._burst_active_at = now
        self._failed_bursts = 0
        self._requests.set_busy(now + BUSY_BLOCKS * (self._interval.smoothed_s or 0.0))
        if is_latest and reply.burst_complete:
            self._stop_bursting()
        self._add(reply.offset, reply.data, now)

    def _record_block(self, burst: _Burst, number: int, now: float) -> None:
        if number <= burst.highest_block:  # The block is late or repeated.
            return
        # Blocks that a repeated burst sends again also count as progress, because they show that the server works. The
        # number of such bursts is limited, so that the download cannot go on forever.
        if self._bursts_without_new_block <= MAX_REPEATED_BURSTS:
            self._progress_at = now
        if burst.highest_block >= 0:
            self._interval.add_sample((now - burst.highest_at) / (number - burst.highest_block))
        # Only the first burst measures the round trip, because a later burst may have to wait for the end of an earlier
        # one.
        elif number == 0 and len(self._bursts) == 1:
            self.round_trip.add_sample(now - burst.sent_at)
        burst.highest_block, burst.highest_at = number, now

    def _stop_bursting(self) -> None:
        self._is_bursting = False
        # The quotient is the number of blocks that the server sends in one round trip. With so many requests in flight,
        # none waits in a queue.
        if self._interval.smoothed_s and self.round_trip.smoothed_s:
            self._requests.window.widen(self.round_trip.smoothed_s / self._interval.smoothed_s)

    def _end_burst(self, burst: _Burst, end: int, reply: FtpMessage) -> None:
        is_latest = burst is self._bursts[-1]
        if is_latest:
            self._failed_bursts = 0
            self._stop_bursting()
        if reply.error_code == MavFtpErr.EOF:
            self._end_at(end)
            return
        if not is_latest:
            return
        # Before the first block, the errors in NO_BURST mean that the server does not support bursts. After it, they
        # mean that the transfer has failed. `received_bytes` includes the bytes before `start`.
        has_no_block = self._reassembly.received_bytes == self._reassembly.start
        if has_no_block and reply.error_code in NO_BURST:
            self._supports_bursts = False
        else:
            self._fail(self._refused(reply))

    def _receive_read(self, request: _SentRequest, reply: FtpMessage, now: float) -> None:
        offset = request.offset
        self._requests.on_answer(offset, now, sent_at=request.sent_at)
        if reply.is_ack and reply.data and not self._is_past_size(offset):
            self._add(offset, reply.data, now)
        # EOF or an ACK without data marks the end of the file. Data beyond the known size is dropped: the file has
        # grown.
        elif reply.is_ack or reply.error_code == MavFtpErr.EOF or self._is_past_size(offset):
            self._end_at(offset)
        else:
            self._fail(self._refused(reply))

    def _end_at(self, end: int) -> None:
        self._reassembly.end_at(end)
        self._requests.discard_from(end)

    def _is_plausible(self, offset: int) -> bool:
        # A block far beyond all others is ignored, because millions of blocks before it would count as missing.
        return not self._is_past_size(offset) and offset - self._reassembly.tail < MAX_BLOCK_DISTANCE

    def _is_past_size(self, offset: int) -> bool:
        # After a FILEEXISTS, PX4 answers FILEEXISTS instead of EOF. Any error after the known size therefore counts as
        # the end of the file.
        return self._size is not None and offset >= self._size

    def _add(self, offset: int, data: bytes, now: float) -> None:
        if self._size is not None:
            data = data[: self._size - offset]  # The file may have grown since it was opened.
        try:
            is_new = self._reassembly.add(offset, data)
        except Exception as error:  # Writing failed, e.g. because the disk is full.
            self._fail(error)
            return
        if is_new:
            self._bursts_without_new_block = 0
            self._requests.discard(offset)
            self._report_progress(now, self._reassembly.received_bytes, self._total)

    # -------------------------------------------------------------------------------- requests

    def _proceed(self, now: float) -> None:
        reassembly = self._reassembly
        if self._size is not None and reassembly.position >= self._size:
            self._finish(reassembly.position)
            return
        if reassembly.is_complete:  # The size is unknown, or the file has become shorter than the reported size.
            self._finish_at_end()
            return
        self._request_gaps()
        if not self._supports_bursts:
            self._request_ahead()
        limit = WINDOW_DURING_BURST if self._is_bursting else None
        for offset in self._requests.take_due(now, limit=limit):
            self._read(offset, now)
        if self._needs_burst:
            self._request_burst(now)
        self._wait_until(self._requests.deadline, self._next_block_deadline if self._is_bursting else None)

    def _request_gaps(self) -> None:
        while self._scanned_until < self._reassembly.tail:
            if self._scanned_until in self._reassembly.gaps:
                self._requests.request(self._scanned_until)
            self._scanned_until += DATA_SIZE

    @property
    def _needs_burst(self) -> bool:
        if self._is_bursting or not self._supports_bursts or self._reassembly.end is not None:
            return False
        was_sent_completely = self._size is not None and self._reassembly.tail >= self._size
        return not was_sent_completely and len(self._reassembly.gaps) < MAX_GAPS

    def _request_ahead(self) -> None:
        if self._reassembly.end is None:
            for number in range(self._requests.window.size):
                self._requests.request(self._reassembly.tail + number * DATA_SIZE)

    def _read(self, offset: int, now: float) -> None:
        sequence = self._client.next_sequence()
        self._reads[sequence] = _SentRequest(offset, now)
        self._send(FtpMessage(sequence, MavFtpOpcode.READFILE, session=self._session, size=DATA_SIZE, offset=offset))

    def _request_burst(self, now: float) -> None:
        offset = self._reassembly.tail
        # Maximum number of full blocks in the burst. If the size is unknown, ArduPilot's burst length is assumed.
        blocks = BURST_BLOCKS if self._size is None else max(BURST_BLOCKS, (self._size - offset) // DATA_SIZE)
        # Later requests must not have the numbers of this burst, because the server could take them for repetitions.
        # The request, a shorter last block and the NAK also need one number each.
        sequence = self._client.next_sequence(min(blocks + 3, SEQUENCE_COUNT // 2))
        self._bursts.append(_Burst(sequence, offset, now))
        self._is_bursting = True
        self._burst_active_at = now
        self._bursts_without_new_block += 1
        self._send(
            FtpMessage(sequence, MavFtpOpcode.BURSTREADFILE, session=self._session, size=DATA_SIZE, offset=offset)
        )

    @property
    def _next_block_deadline(self) -> float:
        silence_s = self.round_trip.timeout_s(1 + self._failed_bursts)
        if self._interval.smoothed_s is None:  # The time between two blocks has not been measured yet.
            # Repeating the burst of a long file is expensive, so the burst gets more time to start.
            if self._size is not None and self._size > SHORT_FILE:
                silence_s = max(silence_s, FIRST_BLOCK_TIMEOUT_S)
        else:
            has_started = self._bursts[-1].highest_block >= 0
            max_lost = MAX_LOST_BLOCKS if has_started else MAX_LOST_FIRST_BLOCKS
            silence_s += max(max_lost * self._interval.smoothed_s, self._interval.timeout_s())
        return self._burst_active_at + silence_s

    # ------------------------------------------------------------------------------------ ends

    @property
    def _total(self) -> int | None:
        return self._size if self._reassembly.end is None else self._reassembly.end

    def _finish_at_end(self) -> None:
        end = self._reassembly.position
        if self._size is None:  # The size of a virtual file is known only now.
            self._finish(end)
        else:
            text = f"read {self._path}: the file ended after {end} bytes, but its size is {self._size}"
            self._fail(RemoteProtocolError(text))

    def _timeout_error(self) -> FileTimeout:
        missing = self._reassembly.missing(self._size)  # Not empty, because the download is not complete.
        received = self._reassembly.received_bytes
        first_offset, _ = missing[0]
        return FileTimeout(
            f"read {self._path}: no data received for {self._idle_timeout_s:g} s; {received} bytes received,"
            f" {len(missing)} ranges missing, the first from byte {first_offset}",
            missing=missing,
        )


class FtpUpload(FtpExchange[None]):
    """Upload of ``data`` to an open file: blocks are sent in a window and repeated until acknowledged.

    With ``first_block_last``, the first block is sent when all others are acknowledged. When a virtual file, whose
    name begins with ``@``, is closed, ArduPilot evaluates it even if the upload was interrupted. From an incomplete
    ``@PARAM/param.pck``, it would set all parameters that have arrived, and an incomplete one to 0 or to a part of its
    value (AP_Filesystem_Param.cpp, param_upload_parse). Without the magic number in the first block, it ignores the
    file.
    """

    def __init__(
        self,
        client: FtpClient,
        path: str,
        data: bytes,
        *,
        session: int,
        first_block_last: bool = False,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(client, path, **options)
        self._data = data
        self._is_first_block_held = first_block_last
        self._session = session
        self._requests = BlockRequests(self.round_trip)
        self._unwritten = dict.fromkeys(range(0, len(data), DATA_SIZE))  # offsets of the blocks not yet acknowledged
        self._written_bytes = 0
        self._sent_by_sequence: dict[int, _SentRequest] = {}

    def _begin(self, now: float) -> None:
        for offset in self._unwritten:
            if offset or not self._is_first_block_held:
                self._requests.request(offset)
        self._proceed(now)

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            missing = tuple((offset, len(self._block(offset))) for offset in self._unwritten)
            block_count = math.ceil(len(self._data) / DATA_SIZE)
            self._fail(
                FileTimeout(
                    f"write {self._path}: no block acknowledged for {self._idle_timeout_s:g} s;"
                    f" {len(missing)} of {block_count} blocks missing",
                    missing=missing,
                )
            )
        else:
            self._proceed(now)

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.request_opcode != MavFtpOpcode.WRITEFILE:
            return
        # A reply has the sequence number of its request plus 1.
        request = self._sent_by_sequence.pop((reply.sequence - 1) % SEQUENCE_COUNT, None)
        is_repeated = request is not None and request.offset not in self._unwritten
        if request is None or is_repeated:
            return
        if not reply.is_ack:
            self._fail(self._refused(reply))
            return
        offset = request.offset
        del self._unwritten[offset]
        self._requests.on_answer(offset, now, sent_at=request.sent_at)
        self._written_bytes += len(self._block(offset))
        self._report_progress(now, self._written_bytes, len(self._data))
        self._proceed(now)

    def _proceed(self, now: float) -> None:
        if not self._unwritten:
            self._finish(None)
            return
        if self._is_first_block_held and len(self._unwritten) == 1:
            self._is_first_block_held = False
            self._requests.request(0)
        for offset in self._requests.take_due(now):
            self._write(offset, now)
        self._wait_until(self._requests.deadline)

    def _write(self, offset: int, now: float) -> None:
        sequence = self._client.next_sequence()
        self._sent_by_sequence[sequence] = _SentRequest(offset, now)
        data = self._block(offset)
        self._send(
            FtpMessage(
                sequence, MavFtpOpcode.WRITEFILE, session=self._session, size=len(data), offset=offset, data=data
            )
        )

    def _block(self, offset: int) -> bytes:
        return self._data[offset : offset + DATA_SIZE]
