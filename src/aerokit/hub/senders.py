"""Senders and recent frames of a hub, and ``IdentityGuard``, which drops frames with another peer's ids."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.routes import PEER_TTL_S, ROUTE_TIMEOUT_S, Routes
from aerokit.events import DuplicateSender, RouteChanged
from aerokit.mavlink.enums import MavAutopilot, MavType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.events import Event
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer
    from aerokit.transport.link import Link, Peer

DUPLICATE_WINDOW_S = 2.0
"""Seconds in which an equal frame (same sender, number and checksum) from another port counts as a duplicate."""

REPEAT_WINDOW_S = 0.5
"""Seconds in which an equal frame from the same port counts as a duplicate, if its number is out of order."""

NEW_PORT_WINDOW_S = 0.1
"""Like `DUPLICATE_WINDOW_S`, for a port added after the earlier frame arrived. A program takes longer to restart."""

LOOP_WINDOW_S = 60.0
"""Seconds after the first reception of a frame in which its return through another port is recognised.

The value is below 256 s, because the sequence numbers of a component that sends only heartbeats repeat after 256 s.
"""

MIN_LOOP_FRAMES = 8
"""This many returning frames of one sender prove a loop. Fewer may be equal by chance, e.g. those of two radios."""

MAX_RECENT_FRAMES = 1 << 15

# Offsets in `Frame.body` of a HEARTBEAT, whose payload follows nine bytes of header.
_TYPE = 9 + 4
_AUTOPILOT = 9 + 5
_GROUND_STATION = int(MavType.GCS)
_NO_AUTOPILOT = int(MavAutopilot.INVALID)


def is_autopilot(body: bytes) -> bool:
    return len(body) > _AUTOPILOT and body[_TYPE] != _GROUND_STATION and body[_AUTOPILOT] != _NO_AUTOPILOT


class Sender:
    """One component (system id, component id), and the ports at which it was received."""

    __slots__ = (
        "autopilot_ports",
        "component_id",
        "first_received_at",
        "has_heartbeat",
        "is_autopilot",
        "is_vehicle",
        "port_number",
        "ports",
        "received_at",
        "source",
        "system_id",
    )

    def __init__(self, source: int, port_number: int, now: float) -> None:
        self.source: int = source
        """System id + 256 · component id."""
        self.system_id: int = source & 0xFF
        self.component_id: int = source >> 8
        self.port_number: int = port_number
        """Number of the port to which messages for a vehicle go. Messages for a ground station go to all `ports`."""
        self.received_at: float = now
        """Time of the last frame at that port."""
        self.first_received_at: float = now
        self.has_heartbeat: bool = False
        self.ports: dict[int, float] = {port_number: now}
        """Maps port numbers to the time of the last frame there; for `port_number`, use :attr:`received_at`."""
        self.is_vehicle: bool = False
        """True if its HEARTBEAT is not that of a ground station. Messages for a vehicle go to one port only."""
        self.is_autopilot: bool = False
        self.autopilot_ports: set[int] = set()
        """Ports at which the sender was received as an autopilot."""

    @property
    def may_become_vehicle(self) -> bool:
        """True until the first HEARTBEAT of a sender, for `ROUTE_TIMEOUT_S` seconds at most."""
        return not self.has_heartbeat and self.received_at - self.first_received_at <= ROUTE_TIMEOUT_S

    @property
    def has_one_destination(self) -> bool:
        """True for a possible vehicle, which would execute a command twice if it was sent to all `ports`."""
        return self.is_vehicle or self.may_become_vehicle

    @property
    def destinations(self) -> Iterable[int]:
        return (self.port_number,) if self.has_one_destination else self.ports

    def is_at(self, number: int) -> bool:
        """Return True if the sender's frames arrive at port ``number``, which may be `port_number` or another port."""
        return number == self.port_number or self.ports.get(number, -math.inf) >= self.received_at - ROUTE_TIMEOUT_S

    def record_at_other_port(self, number: int, now: float, must_move: bool) -> bool:
        """Record a frame at another port than `port_number`. Return True if the routes change.

        If ``must_move`` is True, or after a silence at `port_number`, port ``number`` becomes the `port_number`.
        """
        is_new_there = now - self.ports.get(number, -math.inf) > ROUTE_TIMEOUT_S
        self.ports[number] = now
        if must_move or now - self.received_at > ROUTE_TIMEOUT_S:
            # If the sender is silent at its present port, messages go to the new port.
            self.ports[self.port_number] = self.received_at
            self.port_number, self.received_at = number, now
            return True
        return is_new_there

    def exclude_pause(self, now: float, paused_s: float) -> None:
        """Do not count the last ``paused_s`` seconds as silence."""
        self.received_at = min(now, self.received_at + paused_s)
        self.ports = {number: min(now, at + paused_s) for number, at in self.ports.items()}

    def record_heartbeat(self, body: bytes) -> bool:
        """Update `is_vehicle` and `is_autopilot` from a HEARTBEAT. Return True if either has changed."""
        if len(body) <= _AUTOPILOT:  # The payload is too short for a HEARTBEAT.
            return False
        before = self.is_vehicle, self.is_autopilot
        self.has_heartbeat = True
        self.is_vehicle = body[_TYPE] != _GROUND_STATION
        self.is_autopilot = is_autopilot(body)
        return before != (self.is_vehicle, self.is_autopilot)

    def remove_port(self, number: int) -> bool:
        """Forget a port. Return True if the sender is not known at any other port."""
        self.autopilot_ports.discard(number)
        self.ports.pop(number, None)
        if self.port_number == number and self.ports:
            self.port_number = max(self.ports, key=self.ports.__getitem__)
            self.received_at = self.ports[self.port_number]
        return not self.ports


FrameRecord = tuple[int, int, float]
"""Number of a frame's port, number of the newest port at that time, and the time. A NamedTuple takes 0.4 µs longer."""


class RecentFrames:
    """Recent frames in two tables. Every `LOOP_WINDOW_S`, the older table is dropped as a whole, without a search."""

    __slots__ = ("newer", "older", "rotate_at")

    def __init__(self) -> None:
        # The keys are sender, sequence number and checksum as one number.
        self.newer: dict[int, FrameRecord] = {}
        self.older: dict[int, FrameRecord] = {}
        self.rotate_at: float = -math.inf
        """Time at which to call :meth:`rotate`."""

    def rotate(self, now: float) -> None:
        is_expired = now - self.rotate_at >= LOOP_WINDOW_S
        self.older = {} if is_expired else self.newer
        self.newer = {}
        self.rotate_at = now + LOOP_WINDOW_S


REPEAT_EVENT_S = 60.0
"""Seconds in which the use of one autopilot's ids by other peers is reported once, for all these peers together."""


class IdentityGuard:
    """Rejects frames that one peer of an endpoint sends with the ids of another peer's autopilot.

    `Routes` decides which peer is the autopilot. Ground stations and companions may share ids.
    ``report(kind, peer, text)`` publishes an event.
    """

    def __init__(self, link: Link, report: Callable[[HubEventKind, Peer, str], object]) -> None:
        self.has_several_peers = False
        """True if the endpoint has several peers. With one peer, only heartbeats are checked."""
        self._routes = Routes(link, self._publish)
        self._report = report
        self._heartbeat_at: dict[Peer, float] = {}  # time of the last heartbeat of each peer
        self._reported_at: dict[str, float] = {}  # sender, e.g. "1/1" → time of the last event about it
        self._current_peer: Peer = None  # peer that sent the frame that is being checked

    def admits(self, frame: Frame, framer: Framer, peer: Peer) -> bool:
        """Return True if this peer may send this frame.

        Call it for every heartbeat and, if `has_several_peers` is true, for every other frame.
        """
        if self._routes.arrived_on_other_peer(frame, peer):
            self._current_peer = peer
            if not self._routes.try_move_route(frame, peer, is_signed=False):
                return False
        if frame.message_id == 0:  # HEARTBEAT
            self._heartbeat_at[peer] = frame.received_at
            if is_autopilot(frame.body):
                self._routes.record_heartbeat(frame, peer, framer.counters_of(frame))
        return True

    def exclude_pause(self, now: float, paused_s: float) -> None:
        self._routes.exclude_pause(now, paused_s)

    def evict_idle_peer(self, peers: Iterable[Peer], now: float) -> Peer | None:
        """Forget the first peer without a heartbeat in the last 30 s, and return it."""
        silent = (peer for peer in peers if now - self._heartbeat_at.get(peer, -math.inf) > PEER_TTL_S)
        return self._routes.evict_idle_peer(silent, now)

    def forget(self, peer: Peer) -> None:
        self._heartbeat_at.pop(peer, None)

    def _publish(self, event: Event) -> None:
        if not isinstance(event, (RouteChanged, DuplicateSender)):
            return
        sender = f"{event.system_id}/{event.component_id}"
        if isinstance(event, RouteChanged):
            self._reported_at.pop(sender, None)  # If the previous peer goes on sending, that is reported at once.
            text = f"messages for {sender} are sent here now, no longer to {event.before}"
            self._report("route_changed", self._current_peer, text)
        elif event.at - self._reported_at.get(sender, -math.inf) > REPEAT_EVENT_S:
            self._reported_at[sender] = event.at
            text = f"frames as {sender} are dropped, because another peer has these ids"
            self._report("duplicate_sender", self._current_peer, text)
