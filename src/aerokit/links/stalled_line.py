"""``StalledLine``: a line that takes bytes and does not carry them, for ``FaultyLink.stall``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from .link import Peer
from .outbox import Outbox

__all__ = ["StalledLine"]

LIMIT = 256 * 1024


class StalledLine:
    """As a TCP connection whose other side has stopped: the system takes ``system_bytes``, the rest waits.

    ``carry(data, peer)`` is what happens to bytes that leave; ``dropped`` and ``stalled`` are those of an `Outbox`.
    """

    def __init__(
        self,
        system_bytes: int,
        carry: Callable[[bytes, Peer], object],
        dropped: Callable[[int], object],
        stalled: Callable[[bool], object],
    ) -> None:
        self._room, self._carry, self._dropped, self._stalled = system_bytes, carry, dropped, stalled
        self._system: list[tuple[bytes, Peer]] = []
        self._outboxes: dict[Peer, Outbox] = {}
        self._stalled_ones: set[Peer] = set()
        self._is_stuck = True

    @property
    def unsent_bytes(self) -> int:
        """Bytes that wait here or in the system."""
        return sum(outbox.unsent_bytes for outbox in self._outboxes.values())

    def write(self, data: bytes, peer: Peer) -> None:
        """As `Link.write`."""
        outbox = self._outboxes.get(peer)
        if outbox is None:
            outbox = self._outboxes[peer] = self._new_outbox(peer)
        outbox.write(data)

    def discard(self) -> None:
        """Take back what the system does not have."""
        for outbox in self._outboxes.values():
            outbox.discard()

    def drain(self) -> None:
        """What the system has goes out, and what has not waited for too long."""
        self._is_stuck = False
        system, self._system = self._system, []
        for data, peer in system:
            self._carry(data, peer)
        for outbox in self._outboxes.values():
            outbox.resume()

    def close(self) -> None:
        """What the system has is forgotten with it."""
        for outbox in self._outboxes.values():
            outbox.discard()
            outbox.close()

    def _new_outbox(self, peer: Peer) -> Outbox:
        outbox = Outbox(
            partial(self._take, peer=peer),
            partial(self._in_system, peer),
            limit=LIMIT,
            dropped=self._dropped,
            stalled=partial(self._tell, peer),
        )
        if self._is_stuck and not self._room:
            outbox.pause()
        return outbox

    def _take(self, data: bytes, peer: Peer) -> None:
        if not self._is_stuck:
            self._carry(data, peer)
            return
        self._system.append((data, peer))
        if sum(len(piece) for piece, _ in self._system) >= self._room:
            for outbox in self._outboxes.values():
                outbox.pause()

    def _in_system(self, peer: Peer) -> int:
        return sum(len(data) for data, each in self._system if each == peer)

    def _tell(self, peer: Peer, is_stalled: bool) -> None:
        (self._stalled_ones.add if is_stalled else self._stalled_ones.discard)(peer)
        self._stalled(bool(self._stalled_ones))
