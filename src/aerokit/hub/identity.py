"""``IdentityGuard``: which peer of an endpoint may speak as an autopilot, and which peers are live."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.hub.senders import is_autopilot
from aerokit.runtime.events import HeardTwice, VehicleMoved
from aerokit.runtime.routes import LIVE_FOR_S, Routes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.hub.values import HubEventKind
    from aerokit.links.link import Link, Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer
    from aerokit.runtime.events import Event

__all__ = ["IdentityGuard"]

REPEAT_EVENT_S = 60.0
"""A second peer that speaks as the same autopilot is told of at most this often, whatever number of peers it uses."""


class IdentityGuard:
    """Applies the rules of a connection (`Routes`) to the peers of one endpoint.

    The first peer that is heard as an autopilot keeps the place while it is heard; what other peers say in its name is
    not passed on. Ground stations and companions may share their ids. ``tell(kind, peer, text)`` is called for events.
    """

    def __init__(self, link: Link, tell: Callable[[HubEventKind, Peer, str], object]) -> None:
        self.is_shared = False
        """Whether the endpoint has more than one peer; of one alone only heartbeats are of interest."""
        self._routes = Routes(link, self._publish)
        self._tell = tell
        self._heartbeat_at: dict[Peer, float] = {}
        self._told_at: dict[tuple[int, int], float] = {}
        self._speaker: Peer = None

    def admits(self, frame: Frame, framer: Framer, peer: Peer) -> bool:
        """Whether this peer may say this frame. Call it with each heartbeat, and with all frames if `is_shared`."""
        if self._routes.is_elsewhere(frame, peer):
            self._speaker = peer
            if not self._routes.takes_place(frame, peer, framer.counters_of(frame), is_signed=False):
                return False
        if frame.message_id == 0:
            self._heartbeat_at[peer] = frame.received_at
            if is_autopilot(frame.body):
                self._routes.note(frame, peer, framer.counters_of(frame))
        return True

    def least_wanted(self, peers: Iterable[Peer], now: float) -> Iterable[Peer]:
        """The first peer that has sent no heartbeat in the last 30 s, if there is one."""
        silent = (peer for peer in peers if now - self._heartbeat_at.get(peer, -math.inf) > LIVE_FOR_S)
        return self._routes.least_wanted(silent, now)

    def forget(self, peer: Peer) -> None:
        """A peer has gone."""
        self._heartbeat_at.pop(peer, None)

    def _publish(self, event: Event) -> None:
        if isinstance(event, VehicleMoved):
            source = event.system_id, event.component_id
            self._told_at.pop(source, None)
            self._tell(
                "moved",
                self._speaker,
                f"{source[0]}/{source[1]} is there now, and not at {event.before} any more",
            )
        elif isinstance(event, HeardTwice):
            source = event.system_id, event.component_id
            if event.at - self._told_at.get(source, -math.inf) > REPEAT_EVENT_S:
                self._told_at[source] = event.at
                self._tell(
                    "heard_twice",
                    self._speaker,
                    f"it speaks as {source[0]}/{source[1]}, which is heard from another peer: what it says is dropped",
                )
