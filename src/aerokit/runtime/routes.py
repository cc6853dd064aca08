"""``Routes``: behind which peer of a link each component is, by its heartbeats."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame

__all__ = ["Routes"]

MOVES_AFTER_S = 3.5
"""A component that was silent for so long may come from another peer: its port has changed, or the link."""
EVERY_PEER: tuple[Peer, ...] = (None,)


class Routes:
    """Where each (system id, component id) was last heard, and so where to send what is for it.

    ``has_peer`` says whether a peer is still there; ``on_double(frame)`` is told of each peer that says what another
    one says already, once.
    """

    def __init__(self, has_peer: Callable[[Peer], bool], on_double: Callable[[Frame], None]) -> None:
        self._has_peer, self._on_double = has_peer, on_double
        self._peers: dict[tuple[int, int], Peer] = {}
        self._noted_at: dict[tuple[int, int], float] = {}
        self._doubles: set[tuple[int, int, Peer]] = set()

    def note(self, frame: Frame, peer: Peer) -> None:
        """A heartbeat came from this peer."""
        source = frame.system_id, frame.component_id
        self._peers[source], self._noted_at[source] = peer, frame.received_at

    def peers_of(self, system_id: int, component_id: int) -> Collection[Peer]:
        """Where to send what is for this component, or for this system if the component is 0 or was never heard."""
        if system_id == 0:
            return EVERY_PEER
        try:
            return (self._peers[system_id, component_id],)
        except KeyError:
            return {peer for (system, _), peer in self._peers.items() if system == system_id} or EVERY_PEER

    def is_of_another(self, frame: Frame, peer: Peer) -> bool:
        """Whether it is heard from another peer already: two vehicles with the same ids, or two ways to one.

        The first one stays; another takes its place when it has gone, or been silent for ``MOVES_AFTER_S``.
        """
        source = frame.system_id, frame.component_id
        first = self._peers.get(source, peer)
        if first == peer or not self._has_peer(first):
            return False
        if frame.received_at - self._noted_at[source] > MOVES_AFTER_S:
            return False
        if (*source, peer) not in self._doubles:
            self._doubles.add((*source, peer))
            self._on_double(frame)
        return True

    def least_wanted(self, peers: Iterable[Peer]) -> Peer:
        """The first that no heartbeat came from, else the first; it is told of again if it comes again."""
        order, routes = list(peers), set(self._peers.values())
        forgotten = next((peer for peer in order if peer not in routes), order[0])
        self._doubles = {double for double in self._doubles if double[2] != forgotten}
        return forgotten
