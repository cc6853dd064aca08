"""``FrameReceiver``: turns received bytes into checked frames, and delivers them to the bus and the observers."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from aerokit.connection.bus import once
from aerokit.connection.frame_observers import FrameObservers
from aerokit.connection.heartbeats import discovery_event
from aerokit.connection.loop_watch import IPYTHON_HINT, LoopWatch, is_unintegrated_ipython
from aerokit.connection.routes import MAX_ROUTES, Routes
from aerokit.events import ComputerSlept, LoopBlocked
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.statistics import SourceLimit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from aerokit.connection.bus import Bus, Detach
    from aerokit.connection.multilink.routes import MultiLinkRoutes
    from aerokit.connection.signatures import SignatureFilter
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.statistics import FramerStatistics
    from aerokit.transport.link import Link, Peer

MAX_PEERS = 256
"""Maximum number of peers that have sent a valid frame."""

MAX_UNVERIFIED_PEERS = 32
"""Maximum number of tracked peers without a valid frame. A new peer replaces the oldest peer."""

MAX_SOURCES = 2048
"""Maximum number of (system id, component id) pairs, over all peers, that have their own counters."""


class FrameCounts(NamedTuple):
    """Numbers of frames of one system."""

    received: int
    lost: int  # missing sequence numbers


class PeerTable:
    """Remote peers and their framers.

    A sender becomes a peer with its first valid frame, and from then on gets broadcasts. When the table is full, the
    oldest of the idle peers is evicted. If no peer is idle, new senders are ignored.

    ``evict_idle_peer`` is :meth:`Routes.evict_idle_peer`. ``configure(framer)`` is called with each new framer,
    ``on_evict(peer)`` with each evicted peer.
    """

    def __init__(
        self,
        link: Link,
        dialect: Dialect,
        evict_idle_peer: Callable[[Iterable[Peer], float], Peer | None],
        configure: Callable[[Framer], object],
        on_evict: Callable[[Peer], object] | None = None,
    ) -> None:
        self._link, self._dialect, self._configure = link, dialect, configure
        self._evict_idle_peer, self._on_evict = evict_idle_peer, on_evict
        self.framers: dict[Peer, Framer] = {}
        """Framers of verified peers."""
        self._unverified: dict[Peer, Framer] = {}  # framers of senders without a valid frame, oldest first
        self._limit = SourceLimit(MAX_SOURCES)  # shared by all framers

    def __iter__(self) -> Iterator[Framer]:
        yield from self.framers.values()
        yield from self._unverified.values()

    def receive_unverified(self, peer: Peer, data: bytes, now: float) -> tuple[Framer, list[Frame]]:
        """Process bytes from a sender that is not a peer yet. Return its framer, and the frames to deliver."""
        framer = self._unverified.get(peer)
        if framer is None:
            framer = self._add_unverified(peer)
        frames = framer.receive(data, now)
        if framer.statistics.frames:  # The first valid frame makes the sender a peer.
            del self._unverified[peer]
            if not self._make_room(now):
                framer.close()
                return framer, []
            self.framers[peer] = framer
            self._link.keep_peer(peer)
        return framer, frames

    def reset(self) -> None:
        for framer in self:
            framer.reset()
        for peer in self.framers:
            self._link.keep_peer(peer)

    def forget(self, peer: Peer) -> Framer | None:
        """Remove a peer here and in the link. Return its framer, or None if the peer is unknown."""
        framer = self.framers.pop(peer, None) or self._unverified.pop(peer, None)
        if framer is not None:
            framer.close()
        self._link.forget_peer(peer)
        return framer

    def _add_unverified(self, peer: Peer) -> Framer:
        if len(self._unverified) >= MAX_UNVERIFIED_PEERS:
            self._unverified.pop(next(iter(self._unverified))).close()
        framer = self._unverified[peer] = Framer(self._dialect, self._limit)
        self._configure(framer)
        return framer

    def _make_room(self, now: float) -> bool:
        """Evict a peer if the table is full. Return False if no peer may be evicted."""
        if len(self.framers) < MAX_PEERS:
            return True
        peer = self._evict_idle_peer(self.framers, now)
        if peer is None:
            return False
        if self._on_evict is not None:
            self._on_evict(peer)
        self.forget(peer)
        return True


_HEARTBEAT_ID = Heartbeat.ID

logger: logging.Logger = logging.getLogger("aerokit")

# Pauses of the event loop are logged from this length on, because they delay our heartbeat.
BLOCKED_WARNING_S = 1.0

BLOCKING_CODE_HINT = (
    "a coroutine did not await: use asyncio.sleep instead of time.sleep, and asyncio.to_thread for long work"
)


class FrameReceiver:
    """Checks the framing, signature and route of received frames, with one framer for each peer.

    Accepted frames go to ``bus``, then to the observers. ``clock`` is the clock of the event loop.
    """

    def __init__(
        self,
        link: Link,
        bus: Bus,
        routes: Routes | MultiLinkRoutes,
        signatures: SignatureFilter,
        clock: Callable[[], float],
    ) -> None:
        self._bus, self._signatures, self._clock = bus, signatures, clock
        self._routes = routes
        self._multilink = None if isinstance(routes, Routes) else routes  # None with a single link
        self._peers = PeerTable(link, bus.dialect, routes.evict_idle_peer, self._update_framer)
        self.framers: dict[Peer, Framer] = self._peers.framers
        self.heartbeats: dict[tuple[int, int], Heartbeat] = {}
        """Last HEARTBEAT of every (system id, component id) on the link."""
        self.observers: FrameObservers = FrameObservers(self._on_observers_changed)
        self._loop_watch = LoopWatch(self._on_blocked, self._on_slept, on_caught_up=self._on_caught_up)
        # Callbacks of `hold_back`, by system id.
        self._held_back: dict[int, list[Callable[[Frame], object]]] = {}
        self._is_closed = False  # True once the connection has ended; frames are then dropped
        bus.must_check_frames = self._multilink is not None
        signatures.on_change = self._update_checks
        bus.require_frames(Heartbeat)  # Routes, and the diagnosis of failed connections, need all heartbeats.

    def start(self) -> None:
        self._loop_watch.start()
        if is_unintegrated_ipython():
            logger.warning("no messages or heartbeats are processed between inputs: %s", IPYTHON_HINT)

    def close(self) -> None:
        self._is_closed = True
        self._update_checks()
        self._loop_watch.close()

    def slept_since(self, at: float) -> float:
        return self._loop_watch.slept_since(at)

    def reset(self) -> None:
        """Discard partial frames after the link was reopened."""
        self._peers.reset()

    def hold_back(self, system_id: int, on_frame: Callable[[Frame], object]) -> Detach:
        self._held_back.setdefault(system_id, []).append(on_frame)
        self._update_checks()
        return once(partial(self._deliver_again, system_id, on_frame))

    def _deliver_again(self, system_id: int, on_frame: Callable[[Frame], object]) -> None:
        self._held_back[system_id].remove(on_frame)
        if not self._held_back[system_id]:
            del self._held_back[system_id]
        self._update_checks()

    def is_held_back(self, system_id: int) -> bool:
        return system_id in self._held_back

    def receive(self, data: bytes, peer: Peer) -> None:
        now = self._clock()
        if now > self._loop_watch.late_after:
            now = self._loop_watch.arrival_time(now)
        framer = self.framers.get(peer)
        if framer is not None:
            frames = framer.receive(data, now)
        else:
            framer, frames = self._peers.receive_unverified(peer, data, now)
            self._update_checks()
        if not frames:
            return
        # `late` has frames out of order, `foreign` those that may be of a second sender with the same ids.
        if self._bus.must_check_frames or framer.late or framer.foreign:
            self._check_and_deliver(frames, framer, peer)
            return
        # Frames that need no checks are delivered together.
        last_delivered = self._bus.deliver_all(frames, self._record_heartbeat, framer, peer)
        if last_delivered is not None:
            # A sink of the last delivered frame closed the connection, set a signing key or added an observer. The
            # following frames now need checks. The observers have not got the last delivered frame yet.
            self.observers.notify_received(last_delivered, peer)
            # Frames are compared by identity, so `index` does not find an equal frame earlier in the list.
            remaining = frames[frames.index(last_delivered) + 1 :]
            self._check_and_deliver(remaining, framer, peer)

    def _check_and_deliver(self, frames: Iterable[Frame], framer: Framer, peer: Peer) -> None:
        # Suspects are frames out of order, and those that may be of a second sender with the same ids.
        has_suspects = bool(framer.late or framer.foreign)
        for frame in frames:
            if self._is_closed:  # A sink of an earlier frame has closed the connection.
                return
            if not self._check_and_record(frame, framer, peer, has_suspects=has_suspects):
                continue
            if frame.message_id == _HEARTBEAT_ID:
                self._record_heartbeat(frame, framer, peer)
            self._bus.deliver(frame)
            if self.observers.receive_callbacks:
                self.observers.notify_received(frame, peer)

    def _check_and_record(self, frame: Frame, framer: Framer, peer: Peer, *, has_suspects: bool) -> bool:
        """Check a frame, and write it to the recording of the connection. Return True if it is to be delivered."""
        multilink, signatures, observers = self._multilink, self._signatures, self.observers
        # True if the route of the frame's sender leads to another peer.
        is_other_peer = len(self.framers) > 1 and self._routes.arrived_on_other_peer(frame, peer)
        if multilink is not None and multilink.is_duplicate(frame, peer, is_other_peer=is_other_peer):
            return False
        # With several links, `_is_admitted` is always called, because it records the admission.
        must_check = multilink is not None or not signatures.admits_all
        if must_check and not self._is_admitted(frame, is_other_peer):
            return False
        # With several links, frames are recorded further below, because `accepts` refuses telemetry of links that are
        # not in use.
        if observers.recording is not None and multilink is None:
            observers.recording.write(frame.raw, self._clock())
        if is_other_peer and not self._routes.try_move_route(frame, peer, is_signed=signatures.has_verified(frame)):
            return False
        if has_suspects and self._must_be_dropped(framer, frame):
            return False
        if multilink is not None:
            if not multilink.accepts(frame, peer, framer.counters_of(frame)):
                return False
            observers.record_received(frame.raw, self._clock())
        for on_frame in tuple(self._held_back.get(frame.system_id, ())):
            on_frame(frame)
        return frame.system_id not in self._held_back

    def arrived_at(self) -> float:
        """Return the receive time of the current frame. It is earlier than now if the frame may have waited."""
        now, oldest = self._clock(), self._loop_watch.oldest_arrival
        return now if now < oldest else oldest

    def statistics(self) -> Iterator[FramerStatistics]:
        return (framer.statistics for framer in self._peers)

    def counts(self, system_id: int) -> FrameCounts:
        sources = [
            source
            for statistics in self.statistics()
            for source in statistics.sources.values()
            if source.system_id == system_id
        ]
        return FrameCounts(sum(source.received for source in sources), sum(source.lost for source in sources))

    def received_from(self, system_id: int, component_id: int) -> int:
        sources = [statistics.sources.get((system_id, component_id)) for statistics in self.statistics()]
        return max((source.received for source in sources if source is not None), default=0)

    def _on_blocked(self, seconds: float) -> None:
        if seconds >= BLOCKED_WARNING_S:
            logger.warning(
                "the event loop was blocked for %.1f s: no messages or heartbeats were processed; %s",
                seconds,
                IPYTHON_HINT if is_unintegrated_ipython() else BLOCKING_CODE_HINT,
            )
        self._bus.publish(LoopBlocked(self._clock(), system_id=0, seconds=seconds))

    def _on_slept(self, seconds: float) -> None:
        logger.warning("the computer slept for %.0f s: the age of all vehicle values includes this time", seconds)
        self._bus.publish(ComputerSlept(self._clock(), system_id=0, seconds=seconds))

    def _on_caught_up(self, paused_s: float) -> None:
        self._routes.exclude_pause(self._clock(), paused_s)

    def _update_checks(self) -> None:
        self._bus.must_check_frames = (
            self._is_closed
            or self._multilink is not None
            or not self._signatures.admits_all
            or bool(self._held_back)
            or self.observers.want_all
            or len(self.framers) > 1
        )

    def _on_observers_changed(self) -> None:
        self._update_checks()
        for framer in self._peers:
            self._update_framer(framer)

    def _update_framer(self, framer: Framer) -> None:
        framer.keep_unknown = self.observers.want_all
        framer.wanted = None if framer.keep_unknown else self._bus.wanted

    def _is_admitted(self, frame: Frame, is_other_peer: bool) -> bool:
        if self._multilink is None:
            return self._signatures.admits(frame, may_hand_over=not is_other_peer)
        current = self._multilink.copies.current  # the record of this frame
        if not current.is_admitted:  # A second check of an admitted frame would refuse it as a replay.
            current.is_admitted = self._signatures.admits(frame, may_hand_over=not is_other_peer)
        return current.is_admitted

    def _must_be_dropped(self, framer: Framer, frame: Frame) -> bool:
        """Return True for frames of a second sender with the same ids, and for outdated heartbeats."""
        is_foreign = frame in framer.foreign
        if not is_foreign and frame not in framer.late:
            return False
        counters = framer.counters_of(frame)
        # The counters show whether there are two senders, not which of them has sent this frame.
        if counters is not None and counters.has_duplicates(frame.received_at):
            self._routes.record_duplicate_sender(frame)
            if is_foreign:
                return True
        # The frame may be from a second sender, but this is not certain, so only heartbeats are dropped.
        return frame.message_id == Heartbeat.ID and (is_foreign or self._routes.is_outdated(frame))

    def _record_heartbeat(self, frame: Frame, framer: Framer, peer: Peer) -> None:
        heartbeat = self._bus.dialect.decode(frame)
        is_valid_sender = frame.system_id != 0  # 0 is the broadcast address
        if not is_valid_sender or not isinstance(heartbeat, Heartbeat):
            return
        if self._routes.record_heartbeat(frame, peer, framer.counters_of(frame)):
            source = frame.system_id, frame.component_id
            is_new = source not in self.heartbeats
            self.heartbeats[source] = heartbeat
            if is_new:
                self._bus.publish(discovery_event(heartbeat, self._clock(), *source))
            # There are at most MAX_ROUTES routes, so some of the stored heartbeats no longer have a route.
            if len(self.heartbeats) > MAX_ROUTES:
                for expired in [source for source in self.heartbeats if not self._routes.has_route(source)]:
                    del self.heartbeats[expired]
