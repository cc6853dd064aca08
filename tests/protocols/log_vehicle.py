"""A vehicle with flight logs, and a channel with loss, in simulated time."""

from __future__ import annotations

import random
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any

from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import LogData, LogEntry, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.protocols.exchange import Exchange
from aerokit.protocols.logs import LOG_BLOCK

DELAY_S, INTERVAL_S = 0.05, 0.002


def content(size: int) -> bytes:
    return random.Random(size).randbytes(size)


@dataclass
class LogVehicle:
    """Logs with ids from ``first_id`` on. ``latest_wins``: a request replaces the current one, else it is ignored."""

    logs: list[bytes]
    first_id: int = 1
    latest_wins: bool = False

    def __post_init__(self) -> None:
        self.queue: list[Message] = []

    def receive(self, request: Message) -> None:
        if isinstance(request, LogRequestEnd):
            self.queue.clear()
        elif self.latest_wins or not self.queue:
            if isinstance(request, LogRequestList):
                self.queue = self._entries(request)
            elif isinstance(request, LogRequestData):
                self.queue = self._blocks(request)

    def _entries(self, request: LogRequestList) -> list[Message]:
        count, last = len(self.logs), self.first_id + len(self.logs) - 1
        if not self.logs:
            return [LogEntry(0, 0, 0, 0, 0)]
        first = max(request.start, self.first_id)
        return [
            LogEntry(number, count, last, 1000 + number, len(self.logs[number - self.first_id]))
            for number in range(first, min(request.end, last) + 1)
        ]

    def _blocks(self, request: LogRequestData) -> list[Message]:
        log = self.logs[request.id - self.first_id][: request.ofs + request.count]
        blocks = []
        for offset in range(request.ofs, len(log), LOG_BLOCK):
            data = log[offset : offset + LOG_BLOCK]
            blocks.append(LogData(request.id, offset, len(data), data.ljust(LOG_BLOCK, b"\0")))
        return list(blocks)


def run(
    exchange: Exchange[Any],
    vehicle: LogVehicle,
    *,
    loss: float = 0.0,
    seed: int = 0,
    longest_s: float = 300.0,
) -> int:
    """Run exchange and vehicle until done; return the number of messages sent."""
    chance = random.Random(seed)
    air: list[tuple[float, int, bool, Message]] = []
    now = next_at = 0.0
    sent = number = 0
    exchange.start(now)
    while True:
        for message in exchange.take_outbox():
            sent += 1
            number += 1
            if chance.random() >= loss:
                heappush(air, (now + DELAY_S, number, True, message))
        if exchange.done or now > longest_s:
            return sent
        dues = [
            *([air[0][0]] if air else []),
            *([max(next_at, now)] if vehicle.queue else []),
            *([] if exchange.deadline is None else [exchange.deadline]),
        ]
        now = max(now, min(dues))
        if air and air[0][0] <= now:
            _, _, up, message = heappop(air)
            if up:
                vehicle.receive(message)
            else:
                exchange.receive(message, now)
        elif vehicle.queue and next_at <= now:
            next_at, number = now + INTERVAL_S, number + 1
            message = vehicle.queue.pop(0)
            if chance.random() >= loss:
                heappush(air, (now + DELAY_S, number, False, message))
        else:
            exchange.expire(now)
