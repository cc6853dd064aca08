"""``Peers``: a framer for each peer of a link, and who of those that send something is a peer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.framer import Framer
from aerokit.mavlink.statistics import SourceLimit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from aerokit.links.link import Link, Peer
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame

__all__ = ["MOST_PEERS", "MOST_SENDERS", "MOST_STRANGERS", "Peers"]

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
