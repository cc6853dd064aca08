"""Models of the autopilots' mission protocols, and a lossy radio link, in simulated time."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from aerokit import messages as m
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.missions.wire import from_wire, to_wire
from aerokit.protocols.exchange import Exchange

GCS = (255, 190)
NOBODY = (0, 0)


def items(number: int, *, seed: int = 0) -> list[MissionItem]:
    return [MissionItem(16, 3, x=470000000 + seed, y=80000000 + index, z=20.0) for index in range(number)]


class Store:
    """Base of both models: items, refusals chosen by the test, and received messages."""

    repeat_s = 1.0
    idle_timeout_s = 8.0

    def __init__(self, stored: Sequence[MissionItem] = (), *, refuses: int | None = None) -> None:
        self.stored = list(stored)
        self.refuses = refuses
        self.received: list[Message] = []
        self.out: list[Message] = []
        self.deadline: float | None = None
        self.partner: tuple[int, int] | None = None
        self.expected = self.end = 0
        self.heard_at = 0.0

    @property
    def is_receiving(self) -> bool:
        return self.partner is not None

    def receive(self, message: Message, now: float, sender: tuple[int, int] = GCS) -> None:
        self.received.append(message)
        handler: Callable[..., None] | None = getattr(self, f"on_{message.NAME.lower()}", None)
        if handler is not None:
            handler(message, now, sender)

    def ack(self, result: int, to: tuple[int, int]) -> None:
        self.out.append(m.MissionAck(*to, result))

    def ask(self, now: float) -> None:
        assert self.partner is not None
        self.out.append(m.MissionRequest(*self.partner, self.expected))
        self.deadline = now + self.repeat_s

    def give(self, seq: int, to: tuple[int, int]) -> None:
        item = to_wire(self.stored[seq], seq, target_system=to[0], target_component=to[1])
        self.out.append(item)

    def expire(self, now: float) -> None:
        if self.is_receiving and now - self.heard_at < self.idle_timeout_s:
            self.ask(now)
        else:
            self.stop()

    def stop(self) -> None:
        self.partner = self.deadline = None


class ArduPilotModel(Store):
    """ArduPilot: stores each next item at once; answers any request, refuses other senders."""

    def on_mission_count(self, message: m.MissionCount, now: float, sender: tuple[int, int]) -> None:
        if self.partner not in (None, sender):
            self.ack(Result.DENIED, sender)
            return
        del self.stored[message.count :]
        self.begin(0, message.count, now, sender)

    def on_mission_write_partial_list(
        self, message: m.MissionWritePartialList, now: float, sender: tuple[int, int]
    ) -> None:
        if self.is_receiving:
            self.ack(Result.DENIED, sender)
        elif message.end_index > len(self.stored):
            self.ack(Result.ERROR, sender)
        else:
            self.begin(message.start_index, message.end_index + 1, now, sender)

    def begin(self, first: int, end: int, now: float, sender: tuple[int, int]) -> None:
        self.expected, self.end, self.partner, self.heard_at = first, end, sender, now
        self.ask(now)

    def on_mission_item_int(self, message: m.MissionItemInt, now: float, sender: tuple[int, int]) -> None:
        if not self.is_receiving:
            self.ack(Result.ERROR, sender)
        elif message.seq != self.expected:
            self.ack(Result.INVALID_SEQUENCE, sender)
        elif sender != self.partner:
            self.ack(Result.DENIED, sender)
        elif message.seq == self.refuses:
            self.ack(Result.INVALID_PARAM1, sender)
            self.stop()
        else:
            self.stored[message.seq : message.seq + 1] = [from_wire(message)]
            self.expected, self.heard_at = message.seq + 1, now
            if self.expected < self.end:
                self.ask(now)
            else:
                self.ack(Result.ACCEPTED, sender)
                self.stop()

    def on_mission_request_list(self, _: Message, now: float, sender: tuple[int, int]) -> None:
        if self.is_receiving:
            self.ack(Result.DENIED, sender)
        else:
            self.out.append(m.MissionCount(*sender, len(self.stored)))

    def on_mission_request_int(self, message: m.MissionRequestInt, now: float, sender: tuple[int, int]) -> None:
        if self.is_receiving:
            self.ack(Result.DENIED, sender)
        elif message.seq < len(self.stored):
            self.give(message.seq, sender)
        else:
            self.out.append(m.MissionCount(*sender, len(self.stored)))
            self.ack(Result.INVALID_SEQUENCE, sender)

    def on_mission_clear_all(self, _: Message, now: float, sender: tuple[int, int]) -> None:
        self.stop()
        self.stored.clear()
        self.ack(Result.ACCEPTED, sender)

    def expire(self, now: float) -> None:
        partner = self.partner
        super().expire(now)
        if partner is not None and not self.is_receiving:
            self.ack(Result.OPERATION_CANCELLED, partner)


class Px4Model(Store):
    """PX4: keeps the old items until all new ones have arrived; sends items in sequence only."""

    repeat_s = 0.25
    idle_timeout_s = 5.0

    def __init__(self, stored: Sequence[MissionItem] = (), *, refuses: int | None = None) -> None:
        super().__init__(stored, refuses=refuses)
        self.coming: list[MissionItem] = []
        self.giving_to: tuple[int, int] | None = None

    @property
    def is_idle(self) -> bool:
        return not self.is_receiving and self.giving_to is None

    def on_mission_count(self, message: m.MissionCount, now: float, sender: tuple[int, int]) -> None:
        is_again = self.partner == sender and self.expected == 0
        if not self.is_idle and not is_again:
            self.ack(Result.ERROR, sender)
            return
        if self.is_idle:  # PX4 keeps the number of items of a transfer that is announced again.
            self.partner, self.expected, self.end = sender, 0, message.count
        self.heard_at = now
        self.coming = []
        self.ask(now)

    def on_mission_item_int(self, message: m.MissionItemInt, now: float, sender: tuple[int, int]) -> None:
        if not self.is_receiving:
            seems_done = self.is_idle and message.seq + 1 == self.expected
            self.ack(Result.ACCEPTED if seems_done else Result.ERROR, sender)
            return
        self.heard_at = now
        if message.seq != self.expected:
            return
        if message.seq == self.refuses:
            self.ack(Result.UNSUPPORTED, sender)
            self.stop()
            return
        self.coming.append(from_wire(message))
        self.expected += 1
        if self.expected < self.end:
            self.ask(now)
        else:
            self.stored = self.coming
            self.ack(Result.ACCEPTED, sender)
            self.stop()

    def on_mission_ack(self, message: m.MissionAck, now: float, sender: tuple[int, int]) -> None:
        if self.giving_to is not None:
            self.giving_to = self.deadline = None
        elif self.is_receiving and message.type == Result.OPERATION_CANCELLED:
            self.stop()

    def on_mission_request_list(self, _: Message, now: float, sender: tuple[int, int]) -> None:
        if self.is_receiving:
            return
        self.giving_to, self.expected, self.end, self.heard_at = sender, 0, len(self.stored), now
        self.out.append(m.MissionCount(*sender, len(self.stored)))
        self.deadline = now + self.repeat_s

    def on_mission_request_int(self, message: m.MissionRequestInt, now: float, sender: tuple[int, int]) -> None:
        if self.giving_to is None:
            return
        self.heard_at = now
        if message.seq == self.expected < self.end:
            self.expected += 1
        elif message.seq != self.expected - 1:
            self.giving_to = self.deadline = None
            self.ack(Result.ERROR, sender)
            return
        self.give(message.seq, sender)
        self.deadline = now + self.repeat_s

    def on_mission_clear_all(self, _: Message, now: float, sender: tuple[int, int]) -> None:
        if self.is_idle:
            self.stored = []
            self.ack(Result.ACCEPTED, sender)

    def expire(self, now: float) -> None:
        if self.giving_to is None:
            super().expire(now)
        elif now - self.heard_at >= self.idle_timeout_s:
            self.giving_to = self.deadline = None
        else:
            if self.expected == 0:
                self.out.append(m.MissionCount(*self.giving_to, len(self.stored)))
            self.deadline = now + self.repeat_s


@dataclass
class Radio:
    """A link with loss, duplicates, reordering by varying delays, and outages in both directions."""

    seed: int = 0
    loss: float = 0.0
    doubling: float = 0.0
    delay_s: float = 0.05
    jitter_s: float = 0.0
    silences: Sequence[tuple[float, float]] = ()
    drops: Callable[[Message], bool] = field(default=lambda message: False)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)

    def delays(self, message: Message, now: float) -> list[float]:
        copies = 2 if self.random.random() < self.doubling else 1
        is_silent = any(start <= now < end for start, end in self.silences)
        return [
            self.delay_s + self.random.random() * self.jitter_s
            for _ in range(copies)
            if self.random.random() >= self.loss and not is_silent and not self.drops(message)
        ]


@dataclass
class Run:
    """Time of the end, and messages sent."""

    seconds: float
    sent: list[Message]
    error: Exception | None


def run(
    exchange: Exchange[Any],
    vehicle: Store,
    radio: Radio,
    *,
    began: float = 0.0,
    others: Sequence[tuple[float, Message, tuple[int, int]]] = (),
    limit_s: float = 600.0,
) -> Run:
    """Run exchange and vehicle until the exchange ends. ``others``: messages of another station, and their times."""
    order, queue = count(), list[tuple[float, int, str, Message, tuple[int, int]]]()
    for at, message, sender in others:
        heapq.heappush(queue, (began + at, next(order), "up", message, sender))
    sent: list[Message] = []

    def flush(now: float) -> None:
        for message in exchange.take_outbox():
            sent.append(message)
            for delay in radio.delays(message, now):
                heapq.heappush(queue, (now + delay, next(order), "up", message, GCS))
        out, vehicle.out = vehicle.out, []
        for message in out:
            for delay in radio.delays(message, now):
                heapq.heappush(queue, (now + delay, next(order), "down", message, NOBODY))

    now = began
    exchange.start(now)
    flush(now)
    while not exchange.done:
        timers = [at for at in (exchange.deadline, vehicle.deadline) if at is not None]
        now = max(now, min([*timers, *(entry[0] for entry in queue[:1])]))
        assert now - began < limit_s
        if queue and queue[0][0] <= now:
            _, _, way, message, sender = heapq.heappop(queue)
            if way == "up":
                vehicle.receive(message, now, sender)
            else:
                exchange.receive(message, now)
        elif vehicle.deadline is not None and vehicle.deadline <= now:
            vehicle.expire(now)
        elif exchange.deadline is not None and exchange.deadline <= now:
            exchange.expire(now)
        flush(now)
    try:
        exchange.result()
    except Exception as error:
        return Run(now - began, sent, error)
    return Run(now - began, sent, None)
