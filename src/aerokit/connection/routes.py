"""``Routes``: maps components to peers of a link, and decides when another peer takes over a route."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from aerokit.events import DuplicateSender, RouteChanged, RouteChangeRefused
from aerokit.mavlink.enums import MavComponent
from aerokit.mavlink.frame import RADIO_MESSAGE_IDS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from aerokit.events import Event
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.statistics import SourceStatistics
    from aerokit.transport.link import Link, Peer

    ComponentId = tuple[int, int]
    BootClock = Callable[[float], float | None]

# Maps message ids to the offset of time_boot_ms in `Frame.body`. The messages are SYSTEM_TIME, ATTITUDE,
# ATTITUDE_QUATERNION, LOCAL_POSITION_NED and GLOBAL_POSITION_INT.
_BOOT_TIME_OFFSETS = {2: 17, 30: 9, 31: 9, 32: 9, 33: 9}

MIN_TAKEOVER_FRAMES = 3


class OtherPeer:
    """A peer that sends with the ids of a component, although the component's route leads to another peer.

    The peer to which the route leads is called the route's peer. Messages for the component are sent to it.
    """

    __slots__ = (
        "_began_at",
        "_clock_matches",
        "_expected",
        "_frames",
        "_sequence_matches",
        "is_duplicate_reported",
        "is_refusal_reported",
    )

    def __init__(self) -> None:
        self._expected: int | None = None  # `expected` in the last call of `add`; None before the first call
        self._sequence_matches: bool | None = None
        self._clock_matches: bool | None = None
        # Number of this peer's frames since the last frame of the route's peer, and the time of the first of them.
        self._frames, self._began_at = 0, 0.0
        self.is_duplicate_reported: bool = False
        self.is_refusal_reported: bool = False

    def add(self, frame: Frame, expected: int, sequence_matches: bool | None, clock_matches: bool | None) -> None:
        """Record a frame, and whether its sequence number and time since boot continue those of the route's peer.

        None means unknown. ``expected`` is the next sequence number of the route's peer, which changes with each of its
        frames.
        """
        if expected != self._expected:  # The route's peer has sent frames since the last call.
            self._expected = expected
            self._frames = 0
            self.is_refusal_reported = False
            # Only the first frame's sequence number counts, so that a peer cannot try until a number matches.
            self._sequence_matches = sequence_matches
            self._clock_matches = None
            self._began_at = frame.received_at
        self._frames += 1
        # A mismatch of the clock is final, so that another sender cannot try until a frame matches by chance.
        if clock_matches is not None and self._clock_matches is not False:
            self._clock_matches = clock_matches

    @property
    def is_same_sender(self) -> bool | None:
        """True if this peer is the component of the route at a new address, False if it is another sender.

        None while the recorded sequence numbers and times since boot do not show which of the two it is.
        """
        return False if self._sequence_matches is False else self._clock_matches

    def has_replaced_route_peer(self, now: float, frames_per_s: float) -> bool:
        """Return True if the component of the route has moved: it sends from this peer, and no longer from its old one.

        ``frames_per_s`` is the rate at which the component sent from the route's peer.
        """
        # In the time in which the component usually sends three frames, it has sent none from its old address.
        return (
            self.is_same_sender is True
            and self._frames >= MIN_TAKEOVER_FRAMES
            and (now - self._began_at) * frames_per_s >= MIN_TAKEOVER_FRAMES
        )


def boot_time_ms(frame: Frame) -> int | None:
    offset = _BOOT_TIME_OFFSETS.get(frame.message_id)
    return None if offset is None else int.from_bytes(frame.body[offset : offset + 4], "little")


logger: logging.Logger = logging.getLogger("aerokit")

ROUTE_TIMEOUT_S = 3.5
"""Another peer may take over a component's route after this silence of the component, e.g. on a new port."""

PEER_TTL_S = 30.0
"""Time without heartbeats after which a peer may be evicted. A peer with a vehicle object is never evicted."""

MAX_ROUTES = 1024
"""Maximum number of components with a route. Messages to other components go to every peer."""

MAX_OTHER_PEERS = 256
"""Maximum number of remembered `OtherPeer` objects. An evicted one is reported again when it sends again."""

SWEEP_INTERVAL_S = 1.0

EVERY_PEER: tuple[Peer, ...] = (None,)


class _Route:
    """Route to one component: its peer, and what is known about the frames that arrive from this peer."""

    __slots__ = ("counters", "expected", "heartbeat_at", "peer", "rate", "sequence", "silent_since")

    peer: Peer
    heartbeat_at: float
    silent_since: float  # `heartbeat_at`, or later if the event loop was blocked after that time
    sequence: int  # sequence number of the last heartbeat
    # `counters.expected` at the last heartbeat, used to compute `rate`. Unlike sequence numbers, it never wraps around.
    expected: int

    def __init__(self) -> None:
        self.counters: SourceStatistics | None = None  # the component's counters, which the peer's framer updates
        self.rate = 0.0  # frames per second


class Routes:
    """Routing table: maps each (system id, component id) to the peer to which the route leads, the route's peer.

    The first peer that sends a HEARTBEAT under these ids becomes the route's peer. Frames of other peers under the same
    ids are dropped (``DuplicateSender``). Their sequence numbers and, where known, their time since boot show whether
    it is the same sender, which has only changed its address. The route's peer is gone once it has disconnected, or
    after 3.5 s without a heartbeat, not counting pauses of the event loop.

    Another peer takes over the route (``RouteChanged``)

    1. at once, if it is another port of the same host, and the same sender has sent three frames from there and none
       from its old port;
    2. when the route's peer is gone, if the other peer is on the same host (as after a reboot), is the same sender, or
       signs with our key;
    3. when the route's peer is gone, from any host, if the system has no vehicle object, or if ``may_move`` is True.

    A peer that was refused (``RouteChangeRefused``) is compared again only after the route's peer has sent again. The
    route of a system with a vehicle object never expires.

    ``vehicle_systems`` has the system ids with a vehicle object. ``boot_clocks[component](received_at)`` returns the
    expected time since boot of a component in milliseconds. ``publish`` publishes events.
    """

    def __init__(
        self,
        link: Link,
        publish: Callable[[Event], object],
        vehicle_systems: Collection[int] = (),
        boot_clocks: Mapping[ComponentId, BootClock] | None = None,
        *,
        may_move: bool = False,
    ) -> None:
        self._link, self._publish, self._vehicle_systems = link, publish, vehicle_systems
        self._boot_clocks = {} if boot_clocks is None else boot_clocks
        self._may_move = may_move  # True if a silent system may continue at an address of another host
        self._routes: dict[ComponentId, _Route] = {}
        self._other_peers: dict[tuple[ComponentId, Peer], OtherPeer] = {}
        self._swept_at = 0.0  # time of the last removal of expired routes

    def record_heartbeat(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """Record a heartbeat received from this peer. Return False if the table is full."""
        source = frame.system_id, frame.component_id
        route = self._routes.get(source)
        if route is None:
            if len(self._routes) >= MAX_ROUTES and not self._sweep(frame.received_at):
                return False
            route = self._routes[source] = _Route()
        # The rate needs two heartbeats with the same counters. A new framer has new counters.
        if counters is not None and route.counters is counters and frame.received_at > route.heartbeat_at:
            route.rate = (counters.expected - route.expected) / (frame.received_at - route.heartbeat_at)
        route.counters = counters
        route.expected = 0 if counters is None else counters.expected
        route.peer, route.sequence = peer, frame.sequence
        route.heartbeat_at = route.silent_since = frame.received_at
        return True

    def has_route(self, source: ComponentId) -> bool:
        return source in self._routes

    def is_outdated(self, frame: Frame) -> bool:
        """Return True if an out-of-order heartbeat is older than the last recorded one."""
        route = self._routes.get((frame.system_id, frame.component_id))
        if route is None or frame.received_at - route.heartbeat_at > ROUTE_TIMEOUT_S:
            return False
        behind_by = (route.sequence - frame.sequence) & 0xFF
        return 0 < behind_by < 128  # Behind by half of the 256 numbers or more means ahead.

    def peers_of(self, system_id: int, component_id: int, message: Message | None = None) -> Collection[Peer]:
        """Return the peers to which a message for a component is sent.

        A message for component 0 or an unknown component goes to all peers of the system. A message for system 0 or an
        unknown system goes to every peer.
        """
        if system_id == 0:
            return EVERY_PEER
        # A sender may use the component id 0, but a message to component 0 is for all components.
        route = self._routes.get((system_id, component_id)) if component_id else None
        if route is not None:
            return (route.peer,)
        peers = {route.peer for (system, _), route in self._routes.items() if system == system_id}
        # Leave out a second vehicle with the same system id, which would also execute the message.
        if len(peers) > 1:
            peers -= self._peers_of_duplicate_autopilots(system_id)
        return peers or EVERY_PEER

    def arrived_on_other_peer(self, frame: Frame, peer: Peer) -> bool:
        """Return True if the frame came from ``peer``, but its sender's route leads to another peer."""
        route = self._routes.get((frame.system_id, frame.component_id))
        return route is not None and route.peer != peer

    def try_move_route(self, frame: Frame, peer: Peer, *, is_signed: bool) -> bool:
        """Make the route of the frame's sender lead to ``peer``, if the rules of this class allow the change.

        Returns True if the route was changed. ``is_signed`` is True if the frame is signed with our key.
        """
        if frame.message_id in RADIO_MESSAGE_IDS:  # Anyone can forge these messages, so they move no route.
            return False
        source, now = (frame.system_id, frame.component_id), frame.received_at
        route = self._routes[source]
        is_silent = now - route.silent_since > ROUTE_TIMEOUT_S or not self._link.has_peer(route.peer)
        is_same_host = self._link.host_of(peer) == self._link.host_of(route.peer)
        has_vehicle_object = frame.system_id in self._vehicle_systems
        needs_no_evidence = self._may_move or is_signed or is_same_host or not has_vehicle_object
        other = self._other_peer(source, peer)
        self._compare(other, route, frame)
        has_changed_port = is_same_host and other.has_replaced_route_peer(now, route.rate)
        may_take_over = is_silent and (needs_no_evidence or other.is_same_sender)
        if has_changed_port or may_take_over:
            self._move_route(route, frame, peer)
            return True
        self._report(other, frame, peer, is_silent=is_silent, is_same_host=is_same_host)
        return False

    def exclude_pause(self, now: float, paused_s: float) -> None:
        """Do not count the last ``paused_s`` seconds as silence, because the event loop read nothing."""
        # If a pause counted as silence, another vehicle with the same ids could take over a route.
        for route in self._routes.values():
            route.silent_since = min(now, route.silent_since + paused_s)

    def record_duplicate_sender(self, frame: Frame) -> None:
        """Record that two senders behind one peer use the ids of this frame."""
        other = self._other_peer((frame.system_id, frame.component_id), _SAME_PEER)
        if not other.is_duplicate_reported:
            other.is_duplicate_reported = True
            self._publish(DuplicateSender(frame.received_at, frame.system_id, frame.component_id))

    def evict_idle_peer(self, peers: Iterable[Peer], now: float) -> Peer | None:
        """Forget one peer that has neither recent heartbeats nor a vehicle object, and return it, or None."""
        live = {
            route.peer
            for (system_id, _), route in self._routes.items()
            if system_id in self._vehicle_systems or now - route.heartbeat_at <= PEER_TTL_S
        }
        evicted = next((peer for peer in peers if peer not in live), None)
        self._other_peers = {
            (source, peer): other for (source, peer), other in self._other_peers.items() if peer != evicted
        }
        return evicted

    def _peers_of_duplicate_autopilots(self, system_id: int) -> set[Peer]:
        """Return the peers of second autopilots with this system id, as reported by DuplicateSender."""
        autopilot = system_id, MavComponent.AUTOPILOT1
        return {
            peer
            for (source, peer), other in self._other_peers.items()
            if source == autopilot and other.is_duplicate_reported
        }

    def _other_peer(self, source: ComponentId, peer: Peer) -> OtherPeer:
        key = source, peer
        other = self._other_peers.get(key)
        if other is None:
            if len(self._other_peers) >= MAX_OTHER_PEERS:
                del self._other_peers[next(iter(self._other_peers))]  # the oldest one
            other = self._other_peers[key] = OtherPeer()
        return other

    def _compare(self, other: OtherPeer, route: _Route, frame: Frame) -> None:
        """Compare a frame of another peer with the frames of the route's peer."""
        silent_s = max(frame.received_at - route.heartbeat_at, 0.0)
        sequence_matches = _sequence_matches(frame, route, silent_s)
        clock = self._boot_clocks.get((frame.system_id, frame.component_id))
        expected_ms = None if clock is None else clock(frame.received_at)
        if expected_ms is not None:
            clock_matches = _boot_time_matches(frame, expected_ms, silent_s)
        else:
            # Without a time since boot from the route's present peer, the sequence numbers alone decide.
            clock_matches = None if sequence_matches is None else True
        expected = 0 if route.counters is None else route.counters.expected
        other.add(frame, expected, sequence_matches, clock_matches)

    def _move_route(self, route: _Route, frame: Frame, peer: Peer) -> None:
        before, route.peer = route.peer, peer
        # The frame counts as a heartbeat, so that the new peer has time to send its first heartbeat.
        route.heartbeat_at = route.silent_since = frame.received_at
        route.counters, route.rate = None, 0.0
        source = frame.system_id, frame.component_id
        # Forget the comparisons of other peers with the previous peer of this route.
        self._other_peers = {
            (component, peer): other for (component, peer), other in self._other_peers.items() if component != source
        }
        self._publish(RouteChanged(frame.received_at, *source, _peer_name(before), _peer_name(peer)))

    def _report(self, other: OtherPeer, frame: Frame, peer: Peer, *, is_silent: bool, is_same_host: bool) -> None:
        source = frame.system_id, frame.component_id
        may_be_same = is_same_host and other.is_same_sender is not False  # The sender may just have changed its port.
        if not other.is_duplicate_reported and not may_be_same:
            other.is_duplicate_reported = True
            self._publish(DuplicateSender(frame.received_at, *source))
        if is_silent and other.is_same_sender is False and not other.is_refusal_reported:
            other.is_refusal_reported = True
            logger.warning(
                "%d/%d is silent; frames from %s under the same ids are refused, because they do not continue its"
                " stream (may_move=True accepts them)",
                *source,
                _peer_name(peer),
            )
            self._publish(RouteChangeRefused(frame.received_at, *source, _peer_name(peer)))

    def _sweep(self, now: float) -> bool:
        """Remove expired routes. Return True if there is room for another route."""
        if now - self._swept_at >= SWEEP_INTERVAL_S:
            self._swept_at = now
            self._routes = {
                (system_id, component_id): route
                for (system_id, component_id), route in self._routes.items()
                if system_id in self._vehicle_systems or now - route.heartbeat_at <= PEER_TTL_S
            }
        return len(self._routes) < MAX_ROUTES


_SAME_PEER = object()  # key in `_other_peers` of a second sender that is received from the route's peer


def _sequence_matches(frame: Frame, route: _Route, silent_s: float) -> bool | None:
    """Return True if a frame could be the next one of the route's peer by its sequence number. None if unknown."""
    if route.counters is None:
        return None
    # If frames were lost since the last heartbeat, the number is ahead of the expected one. At its usual rate, the peer
    # sends `rate * silent_s` frames in that time.
    max_ahead = 8 + 1.5 * route.rate * silent_s
    if max_ahead >= 128:  # More than half of the 256 sequence numbers would match by chance.
        return None
    return (frame.sequence - route.counters.expected) & 0xFF <= max_ahead


def _boot_time_matches(frame: Frame, expected_ms: float, silent_s: float) -> bool | None:
    boot_ms = boot_time_ms(frame)
    tolerance_ms = 1500 + 50 * silent_s  # 1.5 s of delay, and a drift of 5 % of the silence
    return None if boot_ms is None else abs(boot_ms - expected_ms) <= tolerance_ms


def _peer_name(peer: Peer) -> str:
    peer = getattr(peer, "peer", peer)  # A peer of a MultiLink contains the peer of one of its links.
    if isinstance(peer, tuple) and len(peer) >= 2:
        host, port = peer[:2]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(peer)
