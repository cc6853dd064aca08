"""``Routes``: behind which peer of a link each component is, and who may take the place of whom."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from aerokit.events import HeardTwice, MoveRefused, VehicleMoved
from aerokit.mavlink.enums import MavComponent

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from aerokit.events import Event
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.statistics import SourceStatistics
    from aerokit.transport.link import Link, Peer

    Source = tuple[int, int]
    BootClock = Callable[[float], float | None]

# Message id → where its time_boot_ms begins in a frame's body: SYSTEM_TIME, ATTITUDE, ATTITUDE_QUATERNION,
# LOCAL_POSITION_NED, GLOBAL_POSITION_INT.
_BOOT_TIME_AT = {2: 17, 30: 9, 31: 9, 32: 9, 33: 9}

ENOUGH = 3


class Claim:
    """One peer's, to one (system id, component id), judged by its first frame after the last one of who had the place.

    While that one is silent nobody gets a second chance, so that numbers cannot be tried out.
    """

    __slots__ = (
        "_clock_is_right",
        "_expected",
        "_follows",
        "_frames",
        "_since",
        "is_refusal_told",
        "is_told",
    )

    def __init__(self) -> None:
        self._expected: int | None = None
        self._follows: bool | None = None
        self._clock_is_right: bool | None = None
        self._frames, self._since = 0, 0.0  # since the other one was heard last
        self.is_told: bool = False
        self.is_refusal_told: bool = False

    def hear(self, frame: Frame, evidence: tuple[int, bool | None, bool | None]) -> None:
        """One more frame: how far the other one has come, and whether number and clock go on there (None: unknown)."""
        expected, follows, clock_is_right = evidence
        if expected != self._expected:
            self._expected = expected
            self._frames = 0
            self.is_refusal_told = False
            self._follows, self._clock_is_right, self._since = follows, None, frame.received_at
        self._frames += 1
        if clock_is_right is not None and self._clock_is_right is not False:
            self._clock_is_right = clock_is_right

    @property
    def goes_on(self) -> bool:
        """Whether it goes on where the other one stopped."""
        return self._follows is not False and self._clock_is_right is True

    def has_replaced(self, now: float, rate: float) -> bool:
        """Whether it goes on, for as long as the other one, at so many frames a second, sends three frames in."""
        return self.goes_on and self._frames >= ENOUGH and (now - self._since) * rate >= ENOUGH

    @property
    def may_go_on(self) -> bool:
        """Whether it may yet turn out to."""
        return self._follows is not False and self._clock_is_right is not False


def boot_time_ms(frame: Frame) -> int | None:
    """The sender's time since boot that a frame tells, in milliseconds; None if its message has none."""
    begin = _BOOT_TIME_AT.get(frame.message_id)
    return None if begin is None else int.from_bytes(frame.body[begin : begin + 4], "little")


logger: logging.Logger = logging.getLogger("aerokit")

MOVES_AFTER_S = 3.5
"""A component that was silent for so long may come from another peer: its port has changed, or the link."""

LIVE_FOR_S = 30.0
"""A peer is not forgotten for another one before its heartbeats have been missing for so long; a vehicle's never."""

MOST_ROUTES = 1024
"""So many components that send heartbeats are remembered; others have no route, and what is for them goes to all."""

MOST_CLAIMS = 256
"""So many peers that speak in the name of others are remembered; of the first, it is told again."""

SWEEP_AFTER_S = 1.0

EVERY_PEER: tuple[Peer, ...] = (None,)


class _Route:
    __slots__ = ("counters", "expected", "noted_at", "peer", "rate", "sequence")

    peer: Peer
    noted_at: float
    sequence: int  # of the last heartbeat
    expected: int  # by `counters`, then

    def __init__(self) -> None:
        self.counters: SourceStatistics | None = None  # those of the peer's framer, always up to date
        self.rate = 0.0  # frames a second


class Routes:
    """Where each (system id, component id) was last heard, and so where to send what is for it.

    Who is first heard under these ids, by a HEARTBEAT, keeps the place; what others say in its name is not listened to
    (``HeardTwice``). Another peer takes the place (``VehicleMoved``)

    1. at once, if it is another port of the same host, and goes on where the first one stopped: three frames whose
       sequence numbers, and times since boot if they are known, continue its own, and nothing more of the first one in
       the time in which it would send three;
    2. when no heartbeat has come for 3.5 s, or a TCP client has gone, if it is of the same host (a reboot, a program
       started again: its numbers may begin anew), or goes on as above from whatever host, or signs with our key;
    3. then anybody, while no vehicle object stands for the system, or if the program allows it (``may_move``).

    Who was refused by 2 (``MoveRefused``) is judged again when the first one has been heard again. A system with a
    vehicle object keeps its place however long it is silent.

    ``attached`` are the system ids with a vehicle object, ``boot_clocks`` say at which time since boot (milliseconds)
    a component is at an instant of ``received_at``; ``publish`` tells events.
    """

    def __init__(
        self,
        link: Link,
        publish: Callable[[Event], object],
        attached: Collection[int] = (),
        boot_clocks: Mapping[Source, BootClock] | None = None,
        *,
        may_move: bool = False,
    ) -> None:
        self._link, self._publish, self._attached = link, publish, attached
        self._boot_clocks = {} if boot_clocks is None else boot_clocks
        self._may_move = may_move
        self._routes: dict[Source, _Route] = {}
        self._claims: dict[tuple[Source, Peer], Claim] = {}
        self._swept_at = 0.0

    def note(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """A heartbeat came from this peer; False when there is no room to remember it."""
        source = frame.system_id, frame.component_id
        route = self._routes.get(source)
        if route is None:
            if len(self._routes) >= MOST_ROUTES and not self._sweep(frame.received_at):
                return False
            route = self._routes[source] = _Route()
        if counters is not None:
            if route.counters is counters and (elapsed := frame.received_at - route.noted_at) > 0:
                route.rate = (counters.expected - route.expected) / elapsed
            route.counters, route.expected = counters, counters.expected
        route.peer, route.noted_at, route.sequence = peer, frame.received_at, frame.sequence
        return True

    def is_known(self, source: Source) -> bool:
        """Whether a heartbeat of this component is remembered."""
        return source in self._routes

    def is_overtaken(self, frame: Frame) -> bool:
        """Whether a heartbeat that is late by its number is older than the last one that was noted."""
        route = self._routes.get((frame.system_id, frame.component_id))
        if route is None or frame.received_at - route.noted_at > MOVES_AFTER_S:
            return False
        return 0 < (route.sequence - frame.sequence) & 0xFF < 128

    def peers_of(self, system_id: int, component_id: int, message: Message | None = None) -> Collection[Peer]:
        """Where to send what is for this component, or for this system if the component is 0 or was never heard.

        Who speaks in another one's name is not part of the system: it would obey what is for all components.
        """
        if system_id == 0:
            return EVERY_PEER
        try:
            return (self._routes[system_id, component_id].peer,)
        except KeyError:
            peers = {route.peer for (system, _), route in self._routes.items() if system == system_id}
            if len(peers) > 1:
                peers -= self._doubles_of(system_id)
            return peers or EVERY_PEER

    def is_elsewhere(self, frame: Frame, peer: Peer) -> bool:
        """Whether the component of this frame is known to be behind another peer."""
        route = self._routes.get((frame.system_id, frame.component_id))
        return route is not None and route.peer != peer

    def takes_place(
        self, frame: Frame, peer: Peer, counters: SourceStatistics | None, is_signed: bool
    ) -> bool:
        """Whether a peer that :meth:`is_elsewhere` takes the place of the one that had it; see the class."""
        source, now = (frame.system_id, frame.component_id), frame.received_at
        route = self._routes[source]
        is_silent = now - route.noted_at > MOVES_AFTER_S or not self._link.has_peer(route.peer)
        is_same_host = self._link.host_of(peer) == self._link.host_of(route.peer)
        is_free = self._may_move or is_signed or is_same_host or frame.system_id not in self._attached
        claim = self._claim(source, peer)
        claim.hear(frame, self._evidence(route, frame, counters))
        has_replaced = is_same_host and claim.has_replaced(now, route.rate)
        if has_replaced or (is_silent and (is_free or claim.goes_on)):
            self._move(route, frame, peer)
            return True
        self._tell(claim, frame, peer, is_silent=is_silent, is_same_host=is_same_host)
        return False

    def hear_double(self, frame: Frame) -> None:
        """Somebody behind the same peer speaks in this one's name."""
        claim = self._claim((frame.system_id, frame.component_id), _SAME_PEER)
        if not claim.is_told:
            claim.is_told = True
            self._publish(HeardTwice(frame.received_at, frame.system_id, frame.component_id))

    def least_wanted(self, peers: Iterable[Peer], now: float) -> list[Peer]:
        """The first behind which nobody lives (a heartbeat in the last 30 s, or a vehicle object), if there is one.

        What was told of it is told anew when it comes again.
        """
        live = {
            route.peer
            for (system_id, _), route in self._routes.items()
            if system_id in self._attached or now - route.noted_at <= LIVE_FOR_S
        }
        forgotten = next((peer for peer in peers if peer not in live), None)
        if forgotten is None:
            return []
        self._claims = {key: claim for key, claim in self._claims.items() if key[1] != forgotten}
        return [forgotten]

    # ------------------------------------------------------------------------------- inside

    def _doubles_of(self, system_id: int) -> set[Peer]:
        """Peers that speak in the name of this system's autopilot, and are not believed."""
        autopilot = system_id, MavComponent.AUTOPILOT1
        return {
            peer for (source, peer), claim in self._claims.items() if source == autopilot and claim.is_told
        }

    def _claim(self, source: Source, peer: Peer) -> Claim:
        key = source, peer
        claim = self._claims.get(key)
        if claim is None:
            if len(self._claims) >= MOST_CLAIMS:
                del self._claims[next(iter(self._claims))]
            claim = self._claims[key] = Claim()
        return claim

    def _evidence(
        self, route: _Route, frame: Frame, counters: SourceStatistics | None
    ) -> tuple[int, bool | None, bool | None]:
        """How far the first one has come; whether this frame's number, and its clock, go on there (None: unknown)."""
        follows: bool | None = None
        silent_for = max(frame.received_at - route.noted_at, 0.0)
        expected = 0
        if route.counters is not None:
            expected = route.counters.expected
            may_be_ahead = 8 + 1.5 * route.rate * silent_for
            if may_be_ahead < 128:
                follows = (frame.sequence - expected) & 0xFF <= may_be_ahead
        clock = self._boot_clocks.get((frame.system_id, frame.component_id))
        should_be = None if clock is None else clock(frame.received_at)
        if should_be is None:
            return expected, follows, None if follows is None else True
        boot_ms = boot_time_ms(frame)
        in_time = None if boot_ms is None else abs(boot_ms - should_be) <= 1500 + 50 * silent_for
        return expected, follows, in_time

    def _move(self, route: _Route, frame: Frame, peer: Peer) -> None:
        before, route.peer, route.noted_at = route.peer, peer, frame.received_at
        route.counters, route.rate = None, 0.0
        source = frame.system_id, frame.component_id
        self._claims = {key: claim for key, claim in self._claims.items() if key[0] != source}
        self._publish(VehicleMoved(frame.received_at, *source, _name(before), _name(peer)))

    def _tell(self, claim: Claim, frame: Frame, peer: Peer, *, is_silent: bool, is_same_host: bool) -> None:
        source = frame.system_id, frame.component_id
        if not claim.is_told and not (is_same_host and claim.may_go_on):
            claim.is_told = True
            self._publish(HeardTwice(frame.received_at, *source))
        if is_silent and not claim.may_go_on and not claim.is_refusal_told:
            claim.is_refusal_told = True
            logger.warning(
                "%d/%d is silent, and %s speaks in its name without going on where it stopped: it is not listened to"
                " (may_move=True allows it)",
                *source,
                _name(peer),
            )
            self._publish(MoveRefused(frame.received_at, *source, _name(peer)))

    def _sweep(self, now: float) -> bool:
        """Forget components that were not heard for a while, once a second at most; whether there is room then."""
        if now - self._swept_at >= SWEEP_AFTER_S:
            self._swept_at = now
            self._routes = {
                source: route
                for source, route in self._routes.items()
                if source[0] in self._attached or now - route.noted_at <= LIVE_FOR_S
            }
        return len(self._routes) < MOST_ROUTES


class _SamePeer:
    """Stands for somebody else behind the same peer."""


_SAME_PEER = _SamePeer()


def _name(peer: Peer) -> str:
    peer = getattr(peer, "peer", peer)  # of several links: the peer by its link's own reckoning
    if isinstance(peer, tuple) and len(peer) >= 2:
        host, port = peer[:2]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(peer)
