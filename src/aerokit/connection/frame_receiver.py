"""``Intake``: from the bytes that a link brings to the frames that are let in, listened to and delivered."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from aerokit.connection.components import found_by
from aerokit.connection.frame_observers import Taps
from aerokit.connection.loop_watch import TERMINAL_IPYTHON, LoopWatch, stands_still_between_inputs
from aerokit.connection.routes import MOST_ROUTES
from aerokit.events import ComputerSlept, LoopBlocked
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.statistics import SourceLimit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from aerokit.connection.bus import Bus
    from aerokit.connection.multilink.routes import SeveralRoutes
    from aerokit.connection.routes import Routes
    from aerokit.connection.signatures import SignatureGate
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.statistics import FramerStatistics
    from aerokit.transport.link import Link, Peer

MOST_PEERS = 256
"""So many that have sent a good frame are remembered."""

MOST_STRANGERS = 32
"""So many that have sent no good frame yet are listened to; one more pushes out the first of them, and nobody else."""

MOST_SENDERS = 2048
"""So many (system id, component id) of all peers together have counters of their own."""


class Peers:
    """Who sends a good frame becomes a peer, is written to, and is forgotten only for want of room.

    Then the first one makes room that no vehicle is behind; while there is none, nobody new is listened to.
    ``least_wanted(peers, now)`` is which, as `Routes.least_wanted`; ``prepare(framer)`` is called with each new framer,
    ``forgotten(peer)`` for each peer that makes room.
    """

    def __init__(
        self,
        link: Link,
        dialect: Dialect,
        least_wanted: Callable[[Iterable[Peer], float], Iterable[Peer]],
        prepare: Callable[[Framer], object],
        forgotten: Callable[[Peer], object] | None = None,
    ) -> None:
        self._link, self._dialect, self._prepare = link, dialect, prepare
        self._least_wanted, self._forgotten = least_wanted, forgotten
        self.framers: dict[Peer, Framer] = {}
        """One for each peer."""
        self._strangers: dict[Peer, Framer] = {}
        self._limit = SourceLimit(MOST_SENDERS)

    def __iter__(self) -> Iterator[Framer]:
        """All framers, those of strangers too."""
        yield from self.framers.values()
        yield from self._strangers.values()

    def receive_from_stranger(self, peer: Peer, data: bytes, now: float) -> tuple[Framer, list[Frame]]:
        """Bytes of somebody who is no peer (yet), and whose frames do not count while there is no room."""
        framer = self._strangers.get(peer)
        if framer is None:
            framer = self._new_stranger(peer)
        frames = framer.receive(data, now)
        if framer.statistics.frames:
            del self._strangers[peer]
            if not self._has_room(now):
                framer.retire()
                return framer, []
            self.framers[peer] = framer
            self._link.keep_peer(peer)
        return framer, frames

    def begin_anew(self) -> None:
        """The link has been opened again: another one, which knows nobody yet."""
        for framer in self:
            framer.begin_anew()
        for peer in self.framers:
            self._link.keep_peer(peer)

    def forget(self, peer: Peer) -> Framer | None:
        """A peer, or a stranger, has gone; its framer, if it had one."""
        framer = self.framers.pop(peer, None) or self._strangers.pop(peer, None)
        if framer is not None:
            framer.retire()
        self._link.forget_peer(peer)
        return framer

    def _new_stranger(self, peer: Peer) -> Framer:
        if len(self._strangers) >= MOST_STRANGERS:
            self._strangers.pop(next(iter(self._strangers))).retire()
        framer = self._strangers[peer] = Framer(self._dialect, self._limit)
        self._prepare(framer)
        return framer

    def _has_room(self, now: float) -> bool:
        if len(self.framers) < MOST_PEERS:
            return True
        unwanted = list(self._least_wanted(self.framers, now))
        for peer in unwanted:
            if self._forgotten is not None:
                self._forgotten(peer)
            self.forget(peer)
        return bool(unwanted)


logger: logging.Logger = logging.getLogger("aerokit")

WARN_AFTER_S = 1.0
"""A heartbeat is missing then."""

BLOCKING_CODE = (
    "a coroutine did not await: use asyncio.sleep instead of time.sleep, and asyncio.to_thread for long work"
)


class Intake:
    """Frames are checked by one framer for each remote peer, by their signature and by who may speak in whose name.

    What is left goes to ``bus``, and then to the taps. ``several`` are the routes, where they are those of several
    links; ``clock`` is the loop's.
    """

    def __init__(
        self,
        link: Link,
        bus: Bus,
        routes: Routes | SeveralRoutes,
        several: SeveralRoutes | None,
        gate: SignatureGate,
        clock: Callable[[], float],
    ) -> None:
        self._bus, self._gate, self._clock = bus, gate, clock
        self._routes, self._several = routes, several
        self._peers = Peers(link, bus.dialect, routes.least_wanted, self._let_through)
        self.framers: dict[Peer, Framer] = self._peers.framers
        """One for each peer."""
        self.heard: dict[tuple[int, int], Heartbeat] = {}
        """The last HEARTBEAT of every (system id, component id) on the link."""
        self.taps: Taps = Taps(self._let_all_through)
        self._loop_watch = LoopWatch(self._on_blocked, self._on_slept)
        self._is_closed = False
        bus.want(Heartbeat)  # routes and diagnosis need every heartbeat

    def start(self) -> None:
        """The link is open: notice when the loop is kept from running."""
        self._loop_watch.start()
        if stands_still_between_inputs():
            logger.warning("nothing is received and no heartbeat sent between inputs: %s", TERMINAL_IPYTHON)

    def close(self) -> None:
        """Nothing more is delivered."""
        self._is_closed = True
        self._loop_watch.close()

    def begin_anew(self) -> None:
        """The link has been opened again."""
        self._peers.begin_anew()

    def receive(self, data: bytes, peer: Peer) -> None:
        """Take bytes off the link."""
        framer, several, taps = self.framers.get(peer), self._several, self.taps
        now = self._clock()
        if now > self._loop_watch.late_after:
            now = self._loop_watch.arrival(now)
        if framer is not None:
            frames = framer.receive(data, now)
        else:
            framer, frames = self._peers.receive_from_stranger(peer, data, now)
        for frame in frames:
            if self._is_closed:  # by a sink
                return
            if several is not None and several.is_copy(frame, peer):
                continue
            is_elsewhere = len(self.framers) > 1 and self._routes.is_elsewhere(frame, peer)
            if not self._gate.is_open and not self._admits(frame, is_elsewhere):
                continue
            if taps.recording is not None and several is None:
                taps.recording.write(frame.raw, self._clock())
            if is_elsewhere and not self._takes_place(framer, frame, peer):
                continue
            if (framer.late or framer.foreign) and self._is_stale(framer, frame):
                continue
            if several is not None:
                if not several.takes(frame, peer, framer.counters_of(frame)):
                    continue
                taps.keep_received(frame.raw, self._clock())
            if frame.message_id == Heartbeat.ID:
                self._note_heartbeat(framer, frame, peer)
            self._bus.deliver(frame)
            if taps.received:
                taps.give(frame, peer)

    def arrived_at(self) -> float:
        """When what is delivered now arrived: now, or before a pause of the loop if it may have waited."""
        return min(self._clock(), self._loop_watch.oldest_arrival)

    def statistics(self) -> Iterator[FramerStatistics]:
        """The counters of every peer that is remembered."""
        return (framer.statistics for framer in self._peers)

    def counts(self, system_id: int) -> tuple[int, int]:
        """Frames of this system that were received, and frames that its sequence numbers say were lost."""
        sources = [
            source
            for statistics in self.statistics()
            for source in statistics.sources.values()
            if source.system_id == system_id
        ]
        return sum(source.received for source in sources), sum(source.lost for source in sources)

    # ------------------------------------------------------------------------------- inside

    def _on_blocked(self, seconds: float) -> None:
        if seconds >= WARN_AFTER_S:
            logger.warning(
                "the event loop was blocked for %.1f s: nothing was received and no heartbeat sent meanwhile; %s",
                seconds,
                TERMINAL_IPYTHON if stands_still_between_inputs() else BLOCKING_CODE,
            )
        self._bus.publish(LoopBlocked(self._clock(), 0, seconds))

    def _on_slept(self, seconds: float) -> None:
        logger.warning("the computer slept for %.0f s: what is known of vehicles is older by that", seconds)
        self._bus.publish(ComputerSlept(self._clock(), 0, seconds))

    def _let_all_through(self) -> None:
        for framer in self._peers:
            self._let_through(framer)

    def _let_through(self, framer: Framer) -> None:
        """Recordings and taps get everything, also what nobody wants and what the dialect does not know."""
        framer.keep_unknown = self.taps.want_all
        framer.wanted = None if framer.keep_unknown else self._bus.wanted

    def _admits(self, frame: Frame, is_elsewhere: bool) -> bool:
        """By its signature; once for all copies of a frame, of which the first need not be the one that is taken."""
        if self._several is not None and self._several.copies.was_admitted:
            return True
        is_admitted = self._gate.admits(frame, may_hand_over=not is_elsewhere)
        if is_admitted and self._several is not None:
            self._several.copies.admit()
        return is_admitted

    def _takes_place(self, framer: Framer, frame: Frame, peer: Peer) -> bool:
        return self._routes.takes_place(frame, peer, framer.counters_of(frame), self._gate.has_checked(frame))

    def _is_stale(self, framer: Framer, frame: Frame) -> bool:
        """Whether a frame out of order is not listened to: another sender's, or a heartbeat that was overtaken."""
        is_foreign = frame in framer.foreign
        if not is_foreign and frame not in framer.late:
            return False
        counters = framer.counters_of(frame)
        if counters is not None and counters.is_double(frame.received_at):
            self._routes.hear_double(frame)
            if is_foreign:
                return True
        return frame.message_id == Heartbeat.ID and (is_foreign or self._routes.is_overtaken(frame))

    def _note_heartbeat(self, framer: Framer, frame: Frame, peer: Peer) -> None:
        heartbeat = self._bus.dialect.decode(frame)
        if frame.system_id == 0 or not isinstance(heartbeat, Heartbeat):
            return
        if self._routes.note(frame, peer, framer.counters_of(frame)):
            source = frame.system_id, frame.component_id
            is_new = source not in self.heard
            self.heard[source] = heartbeat
            if is_new:
                self._bus.publish(found_by(heartbeat, self._clock(), *source))
            if len(self.heard) > MOST_ROUTES:
                for source in [source for source in self.heard if not self._routes.is_known(source)]:
                    del self.heard[source]
