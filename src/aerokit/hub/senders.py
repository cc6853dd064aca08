"""``Sender``: one component that was heard: at which ports, and what it is. ``Recent``: which frames came."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.routes import MOVES_AFTER_S
from aerokit.mavlink.enums import MavAutopilot, MavType

if TYPE_CHECKING:
    from collections.abc import Iterable

DUPLICATE_WINDOW_S = 2.0
"""A frame with the sender, number and checksum of one that came from elsewhere so short a time ago is the same one."""
REPEATED_WITHIN_S = 0.5
"""And one that comes again from the same place was doubled on its way only if it comes so soon."""
LOOP_MEMORY_S = 60.0
"""A frame that comes back by another port is recognised for this long. Below 256 s, in which the numbers of a sender of
nothing but heartbeats come round."""
LOOP_RUN = 8
"""Frames of one sender that come back before a port is taken for the end of a loop: constant messages may be equal by
chance, where a vehicle is heard over two radios."""
MOST_RECENT = 1 << 15
"""Of more frames than that the memory is shorter."""

_TYPE = 9 + 4  # of a HEARTBEAT, in `Frame.body`
_AUTOPILOT = 9 + 5
_STATION = int(MavType.GCS)
_NO_AUTOPILOT = int(MavAutopilot.INVALID)


def is_autopilot(body: bytes) -> bool:
    """Whether a HEARTBEAT is an autopilot's."""
    return len(body) > _AUTOPILOT and body[_TYPE] != _STATION and body[_AUTOPILOT] != _NO_AUTOPILOT


class Sender:
    """One component, (system id, component id)."""

    heard_at: float
    is_autopilot: bool
    is_vehicles: bool
    number: int
    source: int

    __slots__ = (
        *(
            "component_id",
            "heard",
            "heard_at",
            "is_autopilot",
            "is_vehicles",
            "number",
            "source",
            "system_id",
            "told",
        ),
    )

    def __init__(self, source: int, number: int, now: float) -> None:
        self.source = source
        """System id + 256 · component id."""
        self.system_id: int = source & 0xFF
        self.component_id: int = source >> 8
        self.number = number
        """Of the port by which it is reached, where one is enough."""
        self.heard_at = now
        """When something came from there."""
        self.heard: dict[int, float] = {number: now}
        """All ports where it was heard; when, of those beside `number`."""
        self.is_vehicles = False
        """Whether it has said to be no ground station: what is for it goes one way only."""
        self.is_autopilot = False
        self.told: set[int] = set()
        """Ports of which it is known that an autopilot is behind them."""

    @property
    def ways(self) -> Iterable[int]:
        """Numbers of the ports that what is for it goes to."""
        return (self.number,) if self.is_vehicles else self.heard

    def is_heard_at(self, number: int) -> bool:
        """Whether it has lately been heard at a port, as of the time when it was heard at `number` last."""
        return number == self.number or self.heard.get(number, -math.inf) >= self.heard_at - MOVES_AFTER_S

    def hear_elsewhere(self, number: int, now: float) -> bool:
        """Something came by another port than `number`; whether that changes where to send."""
        is_new = now - self.heard.get(number, -math.inf) > MOVES_AFTER_S
        self.heard[number] = now
        if now - self.heard_at > MOVES_AFTER_S:
            self.heard[self.number] = self.heard_at
            self.number, self.heard_at = number, now
            return True
        return is_new

    def note_heartbeat(self, body: bytes) -> bool:
        """What it says it is; whether that is news."""
        if len(body) <= _AUTOPILOT:
            return False
        before = self.is_vehicles, self.is_autopilot
        self.is_vehicles = body[_TYPE] != _STATION
        self.is_autopilot = is_autopilot(body)
        return before != (self.is_vehicles, self.is_autopilot)

    def leave(self, number: int) -> bool:
        """A port has gone; whether it was the last one."""
        self.told.discard(number)
        self.heard.pop(number, None)
        if self.number == number and self.heard:
            self.number = max(self.heard, key=self.heard.__getitem__)
            self.heard_at = self.heard[self.number]
        return not self.heard


class Recent:
    """The frames of the last `LOOP_MEMORY_S` to twice that, in two generations: nothing has to be searched."""

    ends_at: float

    __slots__ = ("ends_at", "newer", "older")

    def __init__(self) -> None:
        self.newer: dict[int, tuple[int, int, float]] = {}
        """Sender, sequence number and checksum as one number → the number of the port it came from, how many ports
        there had been by then, and when."""
        self.older: dict[int, tuple[int, int, float]] = {}
        self.ends_at = float("-inf")
        """When the next generation begins."""

    def begin_next(self, now: float) -> None:
        """Forget the older ones."""
        is_over = now - self.ends_at >= LOOP_MEMORY_S
        self.older, self.newer = {} if is_over else self.newer, {}
        self.ends_at = now + LOOP_MEMORY_S
