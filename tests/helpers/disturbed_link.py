"""A disturbed link between a program and a vehicle: losses, delays and outages, with a record of all traffic."""

from __future__ import annotations

import asyncio
import functools
import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavAutopilot
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong, Heartbeat
from aerokit.transport.link import Link, Peer, Receiver


@dataclass
class Disturbances:
    """Disturbances, in seconds since the order was given.

    The first ``lost_commands`` transmissions of ``command`` and its first ``lost_acks`` answers are lost. During
    ``outage`` (begin, end) all messages are lost. Messages sent during ``stall`` arrive at its end, in order.
    """

    command: int = 0
    lost_acks: int = 0
    lost_commands: int = 0
    outage: tuple[float, float] | None = None
    stall: tuple[float, float] | None = None
    latency_s: float = 0.02


@dataclass
class TrafficEntry:
    """A message to or from the program, which may have been lost. ``number`` counts both directions, in order."""

    number: int
    at: float
    message: Message
    is_lost: bool = False
    is_believed: bool = True
    """True if the program accepted the message. It ignores messages over a link that is not selected."""
    raw: bytes = b""
    """The frame of the message."""
    arrives_at: float = 0.0
    """Time of arrival at the other end, unless it is lost."""


class RecordedTraffic(Protocol):
    """Recorded traffic at the program's end, on which tests make their assertions."""

    @property
    def sent(self) -> list[TrafficEntry]:
        """Messages sent by the program."""
        ...

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        """State messages of the vehicle that the program received."""
        ...


class DisturbedPath(RecordedTraffic, Protocol):
    """A path between a program and a vehicle, with disturbances."""

    @property
    def disturbances(self) -> Disturbances:
        """The current disturbances; may be replaced before :meth:`begin`."""
        ...

    @disturbances.setter
    def disturbances(self, disturbances: Disturbances) -> None: ...

    def begin(self) -> None:
        """Start the disturbances; call it when the order is given."""


@dataclass(frozen=True)
class Silence:
    """Failure of one of two links, in both directions or for answers only. Times count from the order, in seconds."""

    begin_s: float
    end_s: float = float("inf")
    is_one_way: bool = False


class TrafficLog:
    """Record of the traffic over all links."""

    def __init__(self) -> None:
        self.sent: list[TrafficEntry] = []
        self.received: list[TrafficEntry] = []
        self._numbers = itertools.count()

    def cross(self, into: list[TrafficEntry], message: Message, is_lost: bool = False) -> TrafficEntry:
        """Record a message."""
        into.append(TrafficEntry(next(self._numbers), _now(), message, is_lost))
        return into[-1]

    def begin(self) -> None:
        """Clear the record, except for the last HEARTBEAT."""
        self.sent.clear()
        self.received[:] = self.heartbeats[-1:]

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        """State messages of the vehicle that the program received."""
        return [message for message in self.received if _is_autopilots(message.message) and message.is_believed]


@dataclass
class DisturbedLink(Link):
    """The program's end of a link with :class:`Disturbances`, which starts with :meth:`begin`."""

    link: Link
    disturbances: Disturbances = field(default_factory=Disturbances)
    traffic_log: TrafficLog = field(default_factory=TrafficLog)
    silence: Silence | None = None

    def __post_init__(self) -> None:
        self.address = self.link.address
        self.began_at = float("inf")
        self._ups: deque[Callable[[], object]] = deque()
        self._downs: deque[Callable[[], object]] = deque()
        self._up, self._down = Framer(), Framer()
        self._receiver: Receiver | None = None

    def begin(self) -> None:
        """Start the disturbances; call it when the order is given."""
        self.began_at = _now()
        self.traffic_log.begin()

    @property
    def sent(self) -> list[TrafficEntry]:
        """Messages sent by the program."""
        return self.traffic_log.sent

    @property
    def heartbeats(self) -> list[TrafficEntry]:
        """See `TrafficLog.heartbeats`."""
        return self.traffic_log.heartbeats

    # ------------------------------------------------------------------------------------ link

    async def open(self, receiver: Receiver) -> None:
        self._receiver = receiver
        await self.link.open(self)

    def write(self, data: bytes, peer: Peer = None) -> None:
        for frame in self._up.receive(data, _now()):
            message = STANDARD.decode(frame)
            is_lost = self._is_out(is_up=True) or self._loses(message)
            self._note_sent(frame, self.traffic_log.cross(self.sent, message, is_lost))
            if not is_lost:
                self._later(self._ups, self._delay(), functools.partial(self.link.write, frame.raw))

    def close(self) -> None:
        self.link.close()

    async def wait_closed(self) -> None:
        await self.link.wait_closed()

    # -------------------------------------------------------------------------------- receiver

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        for frame in self._down.receive(data, _now()):
            message = STANDARD.decode(frame)
            is_lost = self._is_out(is_up=False) or self._loses(message)
            if is_lost or self._receiver is None:
                continue
            arrive = functools.partial(self._arrive, frame.raw, message)
            self._later(self._downs, self.disturbances.latency_s, arrive)

    def link_lost(self, error: Exception) -> None:
        if self._receiver is not None:
            self._receiver.link_lost(error)  # type: ignore[arg-type]

    def link_stalled(self, unsent_bytes: int) -> None:
        """Ignore it: the inner link never stalls."""

    def link_drained(self) -> None:
        """Ignore it: the inner link never stalls."""

    def _note_sent(self, frame: Frame, crossing: TrafficEntry) -> None:
        crossing.raw, crossing.arrives_at = frame.raw, crossing.at + self._delay()

    def _arrive(self, raw: bytes, message: Message) -> None:
        self.traffic_log.cross(self.traffic_log.received, message).raw = raw
        if self._receiver is not None:
            self._receiver.bytes_received(raw, None)

    @staticmethod
    def _later(queue: deque[Callable[[], object]], delay_s: float, act: Callable[[], object]) -> None:
        """Call actions later in their order, which the loop does not keep for timers with the same time."""
        queue.append(act)
        asyncio.get_running_loop().call_later(delay_s, lambda: queue.popleft()())

    def _is_out(self, *, is_up: bool) -> bool:
        since, outage, silence = _now() - self.began_at, self.disturbances.outage, self.silence
        if silence is not None and silence.begin_s <= since < silence.end_s:
            return not (is_up and silence.is_one_way)
        return outage is not None and outage[0] <= since < outage[1]

    def _loses(self, message: Message) -> bool:
        disturbances = self.disturbances
        if _now() < self.began_at or getattr(message, "command", None) != disturbances.command:
            return False
        if isinstance(message, CommandAck) and disturbances.lost_acks:
            disturbances.lost_acks -= 1
            return True
        if isinstance(message, (CommandLong, CommandInt)) and disturbances.lost_commands:
            disturbances.lost_commands -= 1
            return True
        return False

    def _delay(self) -> float:
        since, stall = _now() - self.began_at, self.disturbances.stall
        if stall is not None and stall[0] <= since < stall[1]:
            return stall[1] - since + self.disturbances.latency_s
        return self.disturbances.latency_s


def _is_autopilots(message: Message) -> bool:
    return isinstance(message, Heartbeat) and message.autopilot != MavAutopilot.INVALID


def _now() -> float:
    return asyncio.get_running_loop().time()
