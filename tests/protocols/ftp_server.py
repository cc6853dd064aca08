"""A small MAVFTP server of either autopilot, and a channel with loss, duplicates and reordering, in simulated time."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.exchange import Exchange
from aerokit.protocols.ftp import DATA_SIZE, FtpClient, FtpMessage

ACK, NAK = MavFtpOpcode.ACK, MavFtpOpcode.NAK


def make_client(first_sequence: int = 0) -> FtpClient:
    return FtpClient(1, 1, source_system=255, source_component=190, first_sequence=first_sequence)


def reply_to(
    request: FtpMessage, data: bytes = b"", *, code: int | None = None, offset: int = 0, ahead: int = 1
) -> FtpMessage:
    """Return an ACK with data, or a NAK with a code; ``ahead`` numbers the replies of a burst."""
    content = data if code is None else bytes([code])
    return FtpMessage(
        (request.sequence + ahead) % 0x10000,
        ACK if code is None else NAK,
        request.session,
        len(content),
        request.opcode,
        offset=offset,
        data=content,
    )


def as_message(reply: FtpMessage) -> FileTransferProtocol:
    return FileTransferProtocol(0, 255, 190, reply.encode())


def requests_in(messages: list[Message]) -> list[FtpMessage]:
    return [FtpMessage.decode(message.payload) for message in messages if isinstance(message, FileTransferProtocol)]


@dataclass
class FileServer:
    """A server with one open file and bursts of ``burst_blocks`` blocks.

    ``queue`` requests wait during a burst (ArduPilot); None: all are answered at once (PX4).
    ``exact_end``: the NAK of a burst has the offset of the end.
    """

    content: bytearray
    burst_blocks: int = 500
    queue: int | None = 5
    interval_s: float = 0.001
    exact_end: bool = False
    has_burst: bool = True
    is_open: bool = True
    writes: int = 0
    _waiting: list[FtpMessage] = field(default_factory=list)
    _busy_until: float = 0.0

    def receive(self, request: FtpMessage, now: float) -> list[tuple[float, FtpMessage]]:
        """Return replies and the times they are sent at."""
        if self.queue is not None and now < self._busy_until:
            if len(self._waiting) >= self.queue:
                return []
            self._waiting.append(request)
            return self._answers(request, self._busy_until)
        self._waiting.clear()
        return self._answers(request, now)

    def _answers(self, request: FtpMessage, at: float) -> list[tuple[float, FtpMessage]]:
        if request.opcode == MavFtpOpcode.BURSTREADFILE and self.is_open and self.has_burst:
            return self._burst(request, at)
        return [(at, reply) for reply in self._answer(request)]

    def _answer(self, request: FtpMessage) -> list[FtpMessage]:
        if not self.is_open:
            return [reply_to(request, code=MavFtpErr.INVALIDSESSION)]
        if request.opcode == MavFtpOpcode.WRITEFILE:
            self.writes += 1
            end = request.offset + len(request.data)
            self.content.extend(bytes(max(0, end - len(self.content))))
            self.content[request.offset : end] = request.data
            return [reply_to(request, offset=request.offset)]
        if request.opcode == MavFtpOpcode.READFILE:
            data = bytes(self.content[request.offset : request.offset + request.size])
            if not data:
                return [reply_to(request, code=MavFtpErr.EOF)]
            return [reply_to(request, data, offset=request.offset)]
        return [reply_to(request, code=MavFtpErr.UNKNOWNCOMMAND)]

    def _burst(self, request: FtpMessage, now: float) -> list[tuple[float, FtpMessage]]:
        replies: list[tuple[float, FtpMessage]] = []
        offset = 0
        for number in range(self.burst_blocks):
            at = now + number * self.interval_s
            start = request.offset + number * DATA_SIZE
            data = bytes(self.content[start : start + DATA_SIZE])
            if not data:
                end = len(self.content) if self.exact_end or number == 0 else offset
                nak = reply_to(request, code=MavFtpErr.EOF, offset=end, ahead=number + 1)
                replies.append((at, nak))
                break
            block = reply_to(request, data, offset=start, ahead=number + 1)
            is_last = number == self.burst_blocks - 1
            replies.append((at, block.replace(burst_complete=is_last or len(data) < DATA_SIZE)))
            offset = start + len(data) if len(data) < DATA_SIZE else start
        self._busy_until = replies[-1][0] + self.interval_s if replies else now
        return replies


@dataclass
class Run:
    """Result of an exchange over a bad channel."""

    messages: int
    seconds: float


def run(
    exchange: Exchange[Any],
    server: FileServer,
    *,
    loss: float = 0.0,
    duplicates: float = 0.0,
    jitter_s: float = 0.0,
    delay_s: float = 0.05,
    seed: int = 0,
    longest_s: float = 1000.0,
) -> Run:
    """Run client and server until the exchange is done; jitter reorders frames."""
    chance = random.Random(seed)
    air: list[tuple[float, int, bool, FtpMessage]] = []
    sent = number = 0
    now = 0.0

    def carry(at: float, up: bool, message: FtpMessage) -> None:
        nonlocal number
        for _ in range(1 + (chance.random() < duplicates)):
            if chance.random() >= loss:
                number += 1
                heappush(air, (at + delay_s + chance.random() * jitter_s, number, up, message))

    exchange.start(now)
    while True:
        for request in requests_in(exchange.take_outbox()):
            sent += 1
            carry(now, True, request)
        if exchange.done or now > longest_s:
            return Run(sent, now)
        due = exchange.deadline
        if due is not None and (not air or due <= air[0][0]):
            now = max(now, due)
            exchange.expire(now)
        elif air:
            now, _, up, message = heappop(air)
            if up:
                for at, reply in server.receive(message, now):
                    carry(at, False, reply)
            else:
                exchange.receive(as_message(message), now)
        else:
            raise AssertionError("nothing is due and nothing is on its way")
