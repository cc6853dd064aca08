"""A client-side protocol machine and a simulated vehicle with a bad radio between them, without a loop or sockets."""

from __future__ import annotations

import heapq
import itertools
from typing import TypeVar

from hypothesis import strategies as st

from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.protocols.exchange import Exchange
from aerokit.sim import SimulatedCopter, SimulatedLog, SimulatedPx4
from aerokit.sim.channel import Streams
from aerokit.testing.fault_model import FaultModel, FaultyPath

ResultT = TypeVar("ResultT")
Vehicle = SimulatedCopter | SimulatedPx4
PERFECT = FaultModel(delay_s=0.02)
KINDS = ("copter", "px4")
LOGS = (SimulatedLog(1000, 111), SimulatedLog(180, 222), SimulatedLog(5000, 333))

radios = st.builds(
    FaultModel,
    loss=st.floats(0.0, 0.3),
    duplication=st.floats(0.0, 0.3),
    reordering=st.floats(0.0, 0.3),
    corruption=st.floats(0.0, 0.1),
    delay_s=st.floats(0.0, 0.3),
    jitter_s=st.floats(0.0, 0.1),
)
seeds = st.integers(0, 99)


def vehicle_of(kind: str, parameter_count: int = 60) -> Vehicle:
    """Return a vehicle that boots fast and has few parameters."""
    if kind == "copter":
        return SimulatedCopter(boot_time_s=0.0, parameter_count=parameter_count, logs=LOGS)
    return SimulatedPx4(boot_time_s=0.0, parameter_count=parameter_count, logs=LOGS)


class Pair:
    """Frames of both directions take the same faulty path; the vehicle's streams are off."""

    def __init__(self, vehicle: Vehicle, radio: FaultModel = PERFECT, seed: int = 0) -> None:
        self.vehicle = vehicle
        self.is_px4 = isinstance(vehicle, SimulatedPx4)
        vehicle.step(vehicle.now)
        self.now = vehicle.now + 3.0
        self._paths = FaultyPath(radio, (seed, "up")), FaultyPath(radio, (seed, "down"))
        self._encoder, self._framer = FrameEncoder(255, 190), Framer()
        self._arrivals: list[tuple[float, int, bool, bytes]] = []  # (due, number, True for the vehicle, frame)
        self._numbers = itertools.count()
        vehicle.step(self.now)
        vehicle.take_outbox()
        vehicle.channels[0].streams = Streams()

    def run(self, exchange: Exchange[ResultT], *, limit_s: float = 900.0) -> ResultT:
        """Return the result or raise the error. Fails if a deadline is in the past or repeats without progress."""
        end = self.now + limit_s
        exchange.start(self.now)
        self._send(exchange)
        while not exchange.done:
            assert exchange.deadline is not None, "the exchange has no deadline and has not ended"
            assert exchange.deadline >= self.now - 1e-9, "a deadline in the past"
            assert self.now < end, "the exchange does not end"
            self._next(exchange)
            self._send(exchange)
        return exchange.result()

    def wait(self, seconds: float) -> None:
        """Deliver everything in transit; the client does not receive."""
        end = self.now + seconds
        while (due := min(end, self._next_due())) < end:
            self._pass_to(due)
        self._pass_to(end)

    def _next(self, exchange: Exchange[ResultT]) -> None:
        deadline = exchange.deadline
        assert deadline is not None
        if (due := self._next_due()) <= deadline:
            for data in self._pass_to(due):
                self._deliver(data, exchange)
        else:
            self.now = deadline
            exchange.expire(self.now)
            assert exchange.done or exchange.deadline is None or exchange.deadline > deadline, (
                "the exchange repeats without progress"
            )

    def _next_due(self) -> float:
        arrival = self._arrivals[0][0] if self._arrivals else float("inf")
        return max(self.now, min(arrival, self.vehicle.next_due))

    def _pass_to(self, when: float) -> list[bytes]:
        """Handle what arrives at the client."""
        self.now = when
        arrived = []
        while self._arrivals and self._arrivals[0][0] <= when:
            _, _, is_up, data = heapq.heappop(self._arrivals)
            if is_up:
                self.vehicle.receive(data, when)
            else:
                arrived.append(data)
        self.vehicle.step(when)
        self._post(self.vehicle.take_outbox(), is_up=False)
        return arrived

    def _deliver(self, data: bytes, exchange: Exchange[ResultT]) -> None:
        for frame in self._framer.receive(data, self.now):
            message = STANDARD.decode(frame)
            if isinstance(message, exchange.expects) and not exchange.done:
                exchange.receive(message, self.now)

    def _send(self, exchange: Exchange[ResultT]) -> None:
        for message in exchange.take_outbox():
            self._post(self._encoder.encode(message), is_up=True)

    def _post(self, data: bytes, *, is_up: bool) -> None:
        if data:
            for due, frame in self._paths[not is_up].carry(data, self.now):
                heapq.heappush(self._arrivals, (due, next(self._numbers), is_up, frame))
