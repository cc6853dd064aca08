"""The air between a program and a vehicle: what it loses, delays and cuts, and everything that crossed it."""

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
class Weather:
    """What goes wrong, in seconds since the order was given.

    The first ``lost_acks`` answers to ``command`` are lost, the first ``lost_commands`` times that it is sent, too. In
    ``outage`` (from, until) nothing crosses; what is written in ``stall`` arrives at its end, in order.
    """

    command: int = 0
    lost_acks: int = 0
    lost_commands: int = 0
    outage: tuple[float, float] | None = None
    stall: tuple[float, float] | None = None
    latency_s: float = 0.02


@dataclass
class Crossing:
    """One message that the program wrote or read, or would have; ``number`` counts both, in their order."""

    number: int
    at: float
    message: Message
    is_lost: bool = False
    is_believed: bool = True
    """Whether the program took it: over a link that is not in use it does not."""
    raw: bytes = b""
    """The frame that it was."""
    arrives_at: float = 0.0
    """When it comes to the other end, if it is not lost."""


class Seen(Protocol):
    """What crossed, as the judge sees it: from the program's end."""

    @property
    def sent(self) -> list[Crossing]:
        """What the program has written."""
        ...

    @property
    def heartbeats(self) -> list[Crossing]:
        """What the program has heard the vehicle tell of itself."""
        ...


class Sky(Seen, Protocol):
    """All that is between a program and a vehicle."""

    @property
    def weather(self) -> Weather:
        """What goes wrong."""
        ...

    @weather.setter
    def weather(self, weather: Weather) -> None: ...

    def begin(self) -> None:
        """The order is given now."""


@dataclass(frozen=True)
class Silence:
    """One of two links falls silent, in seconds since the order was given: in both directions, or answers only."""

    begin_s: float
    end_s: float = float("inf")
    is_one_way: bool = False


class Diary:
    """Everything that crossed, over whichever link."""

    def __init__(self) -> None:
        self.sent: list[Crossing] = []
        self.heard: list[Crossing] = []
        self._numbers = itertools.count()

    def cross(self, into: list[Crossing], message: Message, is_lost: bool = False) -> Crossing:
        """It crosses now."""
        into.append(Crossing(next(self._numbers), _now(), message, is_lost))
        return into[-1]

    def begin(self) -> None:
        """Forget all but the last HEARTBEAT."""
        self.sent.clear()
        self.heard[:] = self.heartbeats[-1:]

    @property
    def heartbeats(self) -> list[Crossing]:
        """What the program has heard the vehicle tell of itself."""
        return [each for each in self.heard if _is_autopilots(each.message) and each.is_believed]


@dataclass
class Air(Link):
    """The program's end of a link through :class:`Weather`, which begins at :meth:`begin`."""

    link: Link
    weather: Weather = field(default_factory=Weather)
    diary: Diary = field(default_factory=Diary)
    silence: Silence | None = None

    def __post_init__(self) -> None:
        self.address = self.link.address
        self.began_at = float("inf")
        self._ups: deque[Callable[[], object]] = deque()
        self._downs: deque[Callable[[], object]] = deque()
        self._up, self._down = Framer(), Framer()
        self._receiver: Receiver | None = None

    def begin(self) -> None:
        """The order is given now."""
        self.began_at = _now()
        self.diary.begin()

    @property
    def sent(self) -> list[Crossing]:
        """What the program has written."""
        return self.diary.sent

    @property
    def heartbeats(self) -> list[Crossing]:
        """See `Diary.heartbeats`."""
        return self.diary.heartbeats

    # ------------------------------------------------------------------------------------ link

    async def open(self, receiver: Receiver) -> None:
        self._receiver = receiver
        await self.link.open(self)

    def write(self, data: bytes, peer: Peer = None) -> None:
        for frame in self._up.receive(data, _now()):
            message = STANDARD.decode(frame)
            is_lost = self._is_out(is_up=True) or self._loses(message)
            self._note_sent(frame, self.diary.cross(self.sent, message, is_lost))
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
            self._later(self._downs, self.weather.latency_s, arrive)

    def link_lost(self, error: Exception) -> None:
        if self._receiver is not None:
            self._receiver.link_lost(error)  # type: ignore[arg-type]

    def link_stalled(self, unsent_bytes: int) -> None:
        """It never does."""

    def link_drained(self) -> None:
        """It always does."""

    def _note_sent(self, frame: Frame, crossing: Crossing) -> None:
        crossing.raw, crossing.arrives_at = frame.raw, crossing.at + self._delay()

    def _arrive(self, raw: bytes, message: Message) -> None:
        self.diary.cross(self.diary.heard, message).raw = raw
        if self._receiver is not None:
            self._receiver.bytes_received(raw, None)

    @staticmethod
    def _later(queue: deque[Callable[[], object]], delay_s: float, act: Callable[[], object]) -> None:
        """In their order: the loop does not keep that of timers for the same instant."""
        queue.append(act)
        asyncio.get_running_loop().call_later(delay_s, lambda: queue.popleft()())

    def _is_out(self, *, is_up: bool) -> bool:
        since, outage, silence = _now() - self.began_at, self.weather.outage, self.silence
        if silence is not None and silence.begin_s <= since < silence.end_s:
            return not (is_up and silence.is_one_way)
        return outage is not None and outage[0] <= since < outage[1]

    def _loses(self, message: Message) -> bool:
        weather = self.weather
        if _now() < self.began_at or getattr(message, "command", None) != weather.command:
            return False
        if isinstance(message, CommandAck) and weather.lost_acks:
            weather.lost_acks -= 1
            return True
        if isinstance(message, (CommandLong, CommandInt)) and weather.lost_commands:
            weather.lost_commands -= 1
            return True
        return False

    def _delay(self) -> float:
        since, stall = _now() - self.began_at, self.weather.stall
        if stall is not None and stall[0] <= since < stall[1]:
            return stall[1] - since + self.weather.latency_s
        return self.weather.latency_s


def _is_autopilots(message: Message) -> bool:
    return isinstance(message, Heartbeat) and message.autopilot != MavAutopilot.INVALID


def _now() -> float:
    return asyncio.get_running_loop().time()
