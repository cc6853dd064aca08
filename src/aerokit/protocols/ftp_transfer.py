"""MAVFTP: the content of an open file, down by bursts and up by many writes at a time.

What servers do (ArduPilot 4.7, PX4 1.17), and what follows from it:

- A burst is answered by blocks without further requests. ArduPilot sends 500 of them and looks at nothing else
  meanwhile; five requests wait, more are dropped. PX4 answers reads while it bursts, and a new burst replaces the
  one under way. So missing blocks are asked for at once, four at a time while the burst goes on, more afterwards.
- Blocks are always asked for whole and at multiples of their size: ``@PARAM/param.pck`` is packed for one block size.
- The size that ArduPilot gives for what begins with ``@`` is a guess. Only the end of file tells.
- The end of file of a burst comes as a NAK. ArduPilot's has the offset of the last block when that one was full.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from aerokit.errors import FileTimeout, RemoteProtocolError
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.blocks import BlockRequests
from aerokit.protocols.exchange import PATIENCE_S, OnProgress, RoundTrip
from aerokit.protocols.ftp import DATA_SIZE, SEQUENCES, FtpClient, FtpExchange, FtpMessage

if TYPE_CHECKING:
    from aerokit.protocols.blocks import Reassembly

__all__ = ["FtpDownload", "FtpUpload", "is_virtual"]

NO_BURST = (MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND)
WHILE_BURSTING = 4
MOST_GAPS = 512
"""With more blocks missing than that, they are fetched before the burst goes on: their followers are in memory."""
BURST_BLOCKS = 500
BUSY_BLOCKS = 3
FIRST_BLOCK_S = 0.5
"""A slow radio carries a few blocks in that time."""
SHORT_FILE = 20 * DATA_SIZE
MOST_REPEATED = 3
MOST_BURSTS = 32
"""So many that may still be on their way are remembered."""
MOST_AHEAD = SEQUENCES // 2 * DATA_SIZE
"""Beyond that, the number of a block could mean another one, too."""
FIRST_BLOCKS, SILENT_BLOCKS = 4, 10
"""So many blocks in a row are hardly ever lost: the burst has ended."""


def is_virtual(path: str) -> bool:
    """Whether the vehicle makes this file up when it is read: its size is a guess, and so is its checksum."""
    return path.startswith("@")


class _Sent(NamedTuple):
    """A request for one block: every sending has its own number, so that its answer measures."""

    offset: int
    at: float


class _Burst(NamedTuple):
    sequence: int
    offset: int
    sent_at: float

    def blocks_before(self, reply: FtpMessage) -> int:
        """How many blocks were sent before this reply to it."""
        return (reply.sequence - self.sequence - 1) % SEQUENCES

    def has_sent(self, reply: FtpMessage) -> bool:
        """Whether this block is of this burst: number and place belong together."""
        blocks, rest = divmod(reply.offset - self.offset, DATA_SIZE)
        return rest == 0 and blocks >= 0 and blocks % SEQUENCES == self.blocks_before(reply)

    def end(self, reply: FtpMessage) -> int | None:
        """Where the file ends according to this NAK; None when it is not of this burst."""
        blocks = self.blocks_before(reply)
        if blocks == 0:
            return self.offset
        last = self.offset + (blocks - 1) * DATA_SIZE
        if not last <= reply.offset <= last + DATA_SIZE:
            return None
        return reply.offset if reply.offset > last else last + DATA_SIZE


class FtpDownload(FtpExchange[int]):
    """All of an open file from ``into.position`` on; the result is its size. ``into`` keeps what came in any case.

    Args:
        session: of the open file.
        size: what the server said of it when it was opened.
    """

    def __init__(
        self,
        client: FtpClient,
        path: str,
        into: Reassembly,
        *,
        session: int,
        size: int,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(client, path, round_trip=round_trip, patience_s=patience_s, on_progress=on_progress)
        self._into, self._session = into, session
        self._size = None if is_virtual(path) or size == 0 else size
        self._seen = into.position
        self._requests = BlockRequests(self.round_trip)
        self._reads: dict[int, _Sent] = {}
        """By their sequence numbers."""
        self._bursts: list[_Burst] = []
        self._is_bursting = False
        self._burst_fails = 0
        self._repeated_bursts = 0
        """So many were asked for since something new has come."""
        self._sent: dict[int, int] = {}
        """Bursts by their numbers, and how many blocks of each have been sent, as far as is known."""
        self._has_burst = True
        self._burst_at = 0.0
        self._last_block: tuple[_Burst | None, float, int] = (None, 0.0, -1)
        self._interval = RoundTrip(shortest_s=0.001)

    def start(self, now: float) -> None:
        """Ask for the first burst, and for the blocks that are missing already."""
        self._begin(now)
        self._go_on(now)

    def expire(self, now: float) -> None:
        """Ask again for what is overdue, or give up."""
        if self._is_out_of_patience(now):
            self._fail(self._timed_out())
            return
        if self._is_bursting and now >= self._burst_due_at:
            self._is_bursting = False
            self._burst_fails += 1
        self._go_on(now)

    # ------------------------------------------------------------------------------- replies

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.request_opcode == MavFtpOpcode.BURSTREADFILE:
            self._receive_burst(reply, now)
        elif reply.request_opcode == MavFtpOpcode.READFILE:
            sent = self._reads.pop((reply.sequence - 1) % SEQUENCES, None)
            if sent is not None:
                self._receive_read(sent, reply, now)
        if not self.done:
            self._go_on(now)

    def _receive_burst(self, reply: FtpMessage, now: float) -> None:
        for burst in reversed(self._bursts):
            if reply.is_ack and burst.has_sent(reply):
                self._take_block(burst, reply, now)
                return
            end = None if reply.is_ack else burst.end(reply)
            if end is not None:
                self._end_burst(burst, end, reply)
                return

    def _take_block(self, burst: _Burst, reply: FtpMessage, now: float) -> None:
        if not self._is_plausible(reply.offset):
            return
        is_latest = burst is self._bursts[-1]
        self._note_time(burst, burst.blocks_before(reply), now)
        self._burst_at, self._burst_fails = now, 0
        self._requests.busy(now + BUSY_BLOCKS * (self._interval.smoothed_s or 0.0))
        if is_latest and reply.burst_complete:
            self._stop_bursting()
        self._add(reply.offset, reply.data, now)

    def _note_time(self, burst: _Burst, number: int, now: float) -> None:
        """How long answers take, and how fast the blocks follow each other.

        While a burst goes on the vehicle is not silent, even if we have its blocks from another one already.
        """
        if number > self._sent.get(burst.sequence, -1) and self._repeated_bursts <= MOST_REPEATED:
            self._sent[burst.sequence], self._moved_at = number, now
        last, before_at, before = self._last_block
        if last is None and number == 0 and len(self._bursts) == 1:  # else one before it may be sent first
            self.round_trip.measured(now - burst.sent_at)
        elif last is burst and number > before:
            self._interval.measured((now - before_at) / (number - before))
        self._last_block = (burst, now, max(number, before) if last is burst else number)

    def _stop_bursting(self) -> None:
        """The blocks have shown how many of them a round trip has room for."""
        self._is_bursting = False
        if self._interval.smoothed_s and self.round_trip.smoothed_s:
            self._requests.window.widen(self.round_trip.smoothed_s / self._interval.smoothed_s)

    def _end_burst(self, burst: _Burst, end: int, reply: FtpMessage) -> None:
        is_latest = burst is self._bursts[-1]
        if is_latest:
            self._burst_fails = 0
            self._stop_bursting()
        if reply.error_code == MavFtpErr.EOF:
            self._end_at(end)
        elif is_latest and reply.error_code in NO_BURST and self._into.done == self._into.start:
            self._has_burst = False
        elif is_latest:
            self._fail(self._refused(reply))

    def _receive_read(self, sent: _Sent, reply: FtpMessage, now: float) -> None:
        offset = sent.offset
        self._requests.answered(offset, now, sent_at=sent.at)
        if reply.is_ack and reply.data:
            self._add(offset, reply.data, now)
        elif reply.is_ack or reply.error_code == MavFtpErr.EOF or self._is_past_size(offset):
            self._end_at(offset)
        else:
            self._fail(self._refused(reply))

    def _end_at(self, end: int) -> None:
        self._into.end_at(end)
        self._requests.forget_from(end)

    def _is_plausible(self, offset: int) -> bool:
        """Whether a block can be there. What lies far behind all others would make millions of gaps."""
        return not self._is_past_size(offset) and offset - self._into.tail < MOST_AHEAD

    def _is_past_size(self, offset: int) -> bool:
        """PX4 says that a file exists already where it means its end, once it has said so of another file."""
        return self._size is not None and offset >= self._size

    def _add(self, offset: int, data: bytes, now: float) -> None:
        if self._size is not None:
            data = data[: self._size - offset]  # the file may have grown
        try:
            is_new = self._into.add(offset, data)
        except Exception as error:  # the disk is full: nothing that comes from now on can be kept
            self._fail(error)
            return
        if is_new:
            self._repeated_bursts = 0
            self._requests.forget(offset)
            self._move(now, self._into.done, self._total)

    # -------------------------------------------------------------------------------- requests

    def _go_on(self, now: float) -> None:
        """Finish, or ask for whatever can be asked for now."""
        into = self._into
        if self._size is not None and into.position >= self._size:
            self._finish(into.position)
            return
        if into.is_complete:
            self._end()
            return
        self._ask_for_gaps()
        if not self._has_burst:
            self._ask_ahead()
        limit = WHILE_BURSTING if self._is_bursting else None
        for offset in self._requests.take_due(now, limit=limit):
            self._read(offset, now)
        if self._wants_burst:
            self._burst(now)
        self._set_deadline()

    def _ask_for_gaps(self) -> None:
        """Those that were not seen before."""
        while self._seen < self._into.tail:
            if self._seen in self._into.gaps:
                self._requests.ask(self._seen)
            self._seen += DATA_SIZE

    @property
    def _wants_burst(self) -> bool:
        if self._is_bursting or not self._has_burst or self._into.end is not None:
            return False
        is_all_sent = self._size is not None and self._into.tail >= self._size
        return not is_all_sent and len(self._into.gaps) < MOST_GAPS

    def _ask_ahead(self) -> None:
        """Without bursts, ask for the blocks behind the last one, too."""
        if self._into.end is None:
            for number in range(self._requests.window.size):
                self._requests.ask(self._into.tail + number * DATA_SIZE)

    def _read(self, offset: int, now: float) -> None:
        sequence = self._client.next_sequence()
        self._reads[sequence] = _Sent(offset, now)
        self._send(FtpMessage(sequence, MavFtpOpcode.READFILE, self._session, DATA_SIZE, offset=offset))

    def _burst(self, now: float) -> None:
        """Ask for everything behind the last block. The numbers of its replies are kept free: else a server might take
        a later request for this one, and give its last reply again.
        """
        offset = self._into.tail
        blocks = BURST_BLOCKS if self._size is None else max(BURST_BLOCKS, (self._size - offset) // DATA_SIZE)
        sequence = self._client.next_sequence(min(blocks + 3, SEQUENCES // 2))
        self._bursts = [*self._bursts[1 - MOST_BURSTS :], _Burst(sequence, offset, now)]
        self._is_bursting, self._burst_at = True, now
        self._repeated_bursts += 1
        self._send(FtpMessage(sequence, MavFtpOpcode.BURSTREADFILE, self._session, DATA_SIZE, offset=offset))

    @property
    def _burst_due_at(self) -> float:
        """When the burst must have ended, or was never begun."""
        silence = self.round_trip.timeout_s(1 + self._burst_fails)
        if self._interval.smoothed_s is None:
            if self._size is not None and self._size > SHORT_FILE:  # a second burst of it would take long
                silence = max(silence, FIRST_BLOCK_S)
        else:
            blocks = SILENT_BLOCKS if self._last_block[0] is self._bursts[-1] else FIRST_BLOCKS
            silence += max(blocks * self._interval.smoothed_s, self._interval.timeout_s())
        return self._burst_at + silence

    def _set_deadline(self) -> None:
        deadline = self._moved_at + self._patience_s
        due_at = self._requests.deadline
        if due_at is not None:
            deadline = min(deadline, due_at)
        if self._is_bursting:
            deadline = min(deadline, self._burst_due_at)
        self.deadline: float | None = deadline

    # ------------------------------------------------------------------------------------ ends

    @property
    def _total(self) -> int | None:
        return self._size if self._into.end is None else self._into.end

    def _end(self) -> None:
        """The vehicle says that this is all: true unless it had said before that there is more."""
        end = self._into.position
        if self._size is None:
            self._finish(end)
        else:
            self._fail(
                RemoteProtocolError(
                    f"read {self._path}: it ended after {end} of the {self._size} bytes it had"
                )
            )

    def _timed_out(self) -> FileTimeout:
        missing = self._into.missing(self._size)
        return FileTimeout(
            f"read {self._path}: nothing has come for {self._patience_s:g} s, {self._into.done} bytes are there,"
            f" {len(missing)} ranges are missing, the first one from {missing[0][0] if missing else 0} on",
            missing=missing,
        )


class FtpUpload(FtpExchange[None]):
    """Write ``data`` to an open file: by blocks, several at a time, each of them until it is acknowledged."""

    def __init__(
        self,
        client: FtpClient,
        path: str,
        data: bytes,
        *,
        session: int,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(client, path, round_trip=round_trip, patience_s=patience_s, on_progress=on_progress)
        self._data, self._session = data, session
        self._requests = BlockRequests(self.round_trip)
        self._unwritten = dict.fromkeys(range(0, len(data), DATA_SIZE))
        self._written = 0
        self._writes: dict[int, _Sent] = {}
        """By their sequence numbers."""

    def start(self, now: float) -> None:
        """Send the first blocks."""
        self._begin(now)
        for offset in self._unwritten:
            self._requests.ask(offset)
        self._go_on(now)

    def expire(self, now: float) -> None:
        """Send again what is overdue, or give up."""
        if self._is_out_of_patience(now):
            missing = tuple((offset, len(self._block(offset))) for offset in self._unwritten)
            self._fail(
                FileTimeout(
                    f"write {self._path}: nothing was acknowledged for {self._patience_s:g} s,"
                    f" {len(missing)} of {-(-len(self._data) // DATA_SIZE)} blocks are missing",
                    missing=missing,
                )
            )
        else:
            self._go_on(now)

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.request_opcode != MavFtpOpcode.WRITEFILE:
            return
        sent = self._writes.pop((reply.sequence - 1) % SEQUENCES, None)
        if sent is None or sent.offset not in self._unwritten:
            return
        if not reply.is_ack:
            self._fail(self._refused(reply))
            return
        offset = sent.offset
        del self._unwritten[offset]
        self._requests.answered(offset, now, sent_at=sent.at)
        self._written += len(self._block(offset))
        self._move(now, self._written, len(self._data))
        self._go_on(now)

    def _go_on(self, now: float) -> None:
        if not self._unwritten:
            self._finish(None)
            return
        for offset in self._requests.take_due(now):
            self._write(offset, now)
        patient = self._moved_at + self._patience_s
        due_at = self._requests.deadline
        self.deadline: float | None = patient if due_at is None else min(patient, due_at)

    def _write(self, offset: int, now: float) -> None:
        sequence = self._client.next_sequence()
        self._writes[sequence] = _Sent(offset, now)
        data = self._block(offset)
        self._send(
            FtpMessage(sequence, MavFtpOpcode.WRITEFILE, self._session, len(data), offset=offset, data=data)
        )

    def _block(self, offset: int) -> bytes:
        return self._data[offset : offset + DATA_SIZE]
