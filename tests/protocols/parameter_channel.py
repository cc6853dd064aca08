"""A vehicle with parameters, a bad channel and an exchange, without event loop or clock."""

from __future__ import annotations

import heapq
import itertools
import random
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import value_message, value_of
from aerokit.protocols.exchange import Exchange

M = TypeVar("M", bound=Message)
ResultT = TypeVar("ResultT")
HASH = Parameter("_HASH_CHECK", 0xFFC00001, ParameterType.UINT32)


def framed(message: Message, *, system_id: int = 1, component_id: int = 1) -> Message:
    """Encode and decode a message, as transmission does."""
    raw = FrameEncoder(system_id, component_id).encode(message)
    return STANDARD.decode(Framer().receive(raw, 0.0)[0])


def table_of(count: int) -> list[Parameter]:
    kinds = (ParameterType.INT8, ParameterType.REAL32, ParameterType.INT32)
    return [Parameter(f"PARAM_{i:04}", i % 100 if i % 3 != 1 else i / 2, kinds[i % 3], None, i) for i in range(count)]


class FakeVehicle:
    """Answers as ArduPilot does, or, with ``bytewise``, as PX4. Subclasses add faults."""

    tick_s = 0.01
    burst = 5
    refuses = False
    hash_first = False

    def __init__(self, parameters: Iterable[Parameter], *, bytewise: bool = False) -> None:
        self.parameters = {parameter.name: parameter for parameter in parameters}
        self.bytewise = bytewise
        self.channel: Channel | None = None

    def value(self, name: str, index: int | None) -> m.ParamValue:
        return value_message(self.parameters[name].replace(index=index), len(self.parameters), self.bytewise)

    def receive(self, message: Message) -> None:
        if isinstance(message, m.ParamRequestList):
            self.on_list()
        elif isinstance(message, m.ParamRequestRead):
            self.on_read(message)
        elif isinstance(message, m.ParamSet):
            self.on_set(message)

    def say(self, message: Message, after: float = 0.0) -> None:
        assert self.channel is not None
        self.channel.from_vehicle(message, after)

    def on_list(self) -> None:
        if self.hash_first:
            self.say(value_message(HASH, len(self.parameters), self.bytewise))
        for index, name in enumerate(self.parameters):
            self.say(self.value(name, index), self.tick_s * (index // self.burst))

    def on_read(self, request: m.ParamRequestRead) -> None:
        names = list(self.parameters)
        if request.param_index >= 0:
            if request.param_index < len(names):
                self.say(self.value(names[request.param_index], request.param_index))
        elif request.param_id in self.parameters:
            self.say(self.value(request.param_id, None))
        elif self.refuses:
            self.say(m.ParamError(255, 190, request.param_id, 31_000, 1))

    def on_set(self, request: m.ParamSet) -> None:
        if request.param_id not in self.parameters:
            if self.refuses:
                self.say(m.ParamError(255, 190, request.param_id, 31_000, 1))
            return
        self.store(request.param_id, value_of(request, self.bytewise))
        self.say(self.value(request.param_id, None))

    def store(self, name: str, value: float) -> None:
        self.parameters[name] = self.parameters[name].replace(value=value)


class Channel:
    """Each message, in either direction, is lost with the same probability and delayed by ``delay_s``."""

    def __init__(
        self,
        vehicle: FakeVehicle,
        *,
        loss: float = 0.0,
        delay_s: float = 0.05,
        jitter_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.vehicle, self.loss, self.delay_s, self.jitter_s = vehicle, loss, delay_s, jitter_s
        self.random = random.Random(seed)
        self.now = 0.0
        self.sent: list[tuple[float, Message]] = []
        self.is_lost: Callable[[Message], bool] = lambda message: self.random.random() < self.loss
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._exchange: Exchange[Any] | None = None
        vehicle.channel = self

    def at(self, when: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when, next(self._numbers), action))

    def from_vehicle(self, message: Message, after: float = 0.0, *, component_id: int = 1) -> None:
        """Deliver a message from the vehicle or another component."""
        if not self.is_lost(message):
            arrived = framed(message, component_id=component_id)
            delay = self.delay_s + self.random.random() * self.jitter_s
            self.at(self.now + after + delay, lambda: self._arrive(arrived))

    def run(self, exchange: Exchange[ResultT], *, limit_s: float = 600.0) -> ResultT:
        """Return the result, or raise the exchange's error."""
        self._exchange = exchange
        exchange.start(self.now)
        self._send()
        while not exchange.done:
            due = exchange.deadline
            assert due is not None, "the exchange has no deadline and has not ended"
            if self._events and self._events[0][0] <= due:
                self.now, _, action = heapq.heappop(self._events)
                action()
            else:
                assert due >= self.now - 1e-9, "a deadline in the past"
                self.now = due
                exchange.expire(self.now)
                assert exchange.done or exchange.deadline is None or exchange.deadline > due, (
                    "the exchange repeats without progress"
                )
            self._send()
            assert self.now < limit_s, "the exchange does not end"
        return exchange.result()

    def kinds(self) -> Counter[str]:
        return Counter(type(message).NAME for _, message in self.sent)

    def all(self, kind: type[M]) -> list[M]:
        return [message for _, message in self.sent if isinstance(message, kind)]

    def _arrive(self, message: Message) -> None:
        assert self._exchange is not None
        if not self._exchange.done:
            self._exchange.receive(message, self.now)

    def _send(self) -> None:
        assert self._exchange is not None
        for message in self._exchange.take_outbox():
            self.sent.append((self.now, message))
            if not self.is_lost(message):
                arrived = framed(message, system_id=255, component_id=190)
                self.at(self.now + self.delay_s, partial(self.vehicle.receive, arrived))
