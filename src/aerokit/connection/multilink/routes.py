"""``MultiLinkRoutes``: routes over several links to the same vehicles, and the state of each link."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import anyio

from aerokit.connection.cells import Source, StateCell
from aerokit.connection.multilink.duplicates import MergedStreams
from aerokit.connection.multilink.link_choice import LinkChoice
from aerokit.connection.multilink.link_probes import LinkProbes
from aerokit.connection.routes import EVERY_PEER, Routes
from aerokit.events import LinkSelected, LinkState, LinkStatus, MemberLinkOpenFailed, MemberLinkStateChanged
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavComponent
from aerokit.transport.multilink import LinkPeer

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from aerokit.connection.bus import Bus
    from aerokit.connection.multilink.duplicates import Copies
    from aerokit.connection.multilink.link_choice import Candidate
    from aerokit.errors import LinkOpenError
    from aerokit.events import Event
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.statistics import SourceStatistics
    from aerokit.transport.link import Peer
    from aerokit.transport.multilink import MultiLink

STATUS_INTERVAL_S = 0.95  # A little below 1 s, because the time is only checked ten times a second.


class LinkStates:
    """Keeps the status of all links in a cell, and publishes an event when the state of a link changes.

    ``choices`` maps each system id to the links over which the system is received.
    """

    def __init__(
        self,
        link: MultiLink,
        choices: Mapping[int, LinkChoice],
        clock: Callable[[], float],
        publish: Callable[[Event], object],
    ) -> None:
        self._link, self._choices, self._publish = link, choices, publish
        self._states = [LinkState.LOST] * len(link.names)
        self._updated_at = -math.inf  # time of the last update of the cell; −inf if an update is due
        self.cell: StateCell[tuple[LinkStatus, ...]] = StateCell("links", clock, "frame")

    def update(self, now: float) -> None:
        for link in range(len(self._states)):
            candidates = [choice.candidates[link] for choice in self._choices.values() if link in choice.candidates]
            if candidates and self._link.is_available(link):
                is_alive = any(candidate.is_alive(now) for candidate in candidates)
                self.set_state(link, LinkState.CONNECTED if is_alive else LinkState.SILENT, now)
        if now - self._updated_at >= STATUS_INTERVAL_S:
            self.set_cell(now)

    def set_state(self, link: int, state: LinkState, now: float) -> None:
        before, self._states[link] = self._states[link], state
        if before is not state:
            self._updated_at = -math.inf  # The next update refreshes the cell at once.
            self._publish(
                MemberLinkStateChanged(now, system_id=0, link=self._link.names[link], before=before, after=state)
            )

    def set_cell(self, now: float) -> None:
        self._updated_at = now
        self.cell.set(tuple(map(self._status, range(len(self._states)))), Source(0, 0, "link"))

    def _status(self, link: int) -> LinkStatus:
        candidates = {
            system_id: choice.candidates[link]
            for system_id, choice in self._choices.items()
            if link in choice.candidates
        }
        # The status has the worst loss and round trip of all systems that are received over the link.
        losses = [candidate.loss for candidate in candidates.values() if candidate.loss is not None]
        round_trips = [
            candidate.round_trip_s for candidate in candidates.values() if candidate.round_trip_s is not None
        ]
        return LinkStatus(
            self._link.names[link],
            self._states[link],
            is_costly=link in self._link.costly,
            systems=tuple(sorted(candidates)),
            used_for=tuple(sorted(system for system in candidates if self._choices[system].used is candidates[system])),
            loss_percent=100 * max(losses) if losses else None,
            round_trip_s=max(round_trips) if round_trips else None,
        )


logger: logging.Logger = logging.getLogger("aerokit")

POLL_INTERVAL_S = 0.1

# If a system was silent over a link for this time, the link is no longer probed until the system's next heartbeat.
CANDIDATE_TIMEOUT_S = 30.0

# Commands that a newer command must not overtake. A switch to a better link waits while such a command is in transit.
COMMANDS = frozenset(
    message_type.ID
    for message_type in (
        m.CommandLong, m.CommandInt, m.SetMode, m.MissionSetCurrent, m.MissionClearAll, m.ParamSet,
        m.SetPositionTargetGlobalInt, m.SetPositionTargetLocalNed, m.SetAttitudeTarget,
    )
)  # fmt: skip

# Broadcasts that do no harm if a vehicle receives them several times. They go to every peer on every link.
BROADCASTS = frozenset(message_type.ID for message_type in (m.Heartbeat, m.Timesync, m.Ping))


class MultiLinkRoutes:
    """Keeps one :class:`Routes` for each link, created by ``make_routes``, and chooses a link for each system.

    ``own_source`` is our own (system id, component id). ``vehicle_systems`` has the system ids with a vehicle object.
    """

    def __init__(
        self,
        link: MultiLink,
        make_routes: Callable[[], Routes],
        bus: Bus,
        *,
        own_source: tuple[int, int],
        vehicle_systems: Collection[int],
        send: Callable[[Message, Peer], object],
        now: Callable[[], float],
    ) -> None:
        self._link, self._bus, self._now = link, bus, now
        self._own_source, self._vehicle_systems = own_source, vehicle_systems
        self._routes = [make_routes() for _ in link.names]  # by index of the link
        self._choices: dict[int, LinkChoice] = {}  # system id → its links, and the link in use
        self._merged = MergedStreams(len(link.names), self._choices)
        self.copies: Copies = self._merged.copies
        # Maps (system id, link) to the counters of each component: component id → counters.
        self._counters: dict[tuple[int, int], dict[int, SourceStatistics]] = {}
        self._stalled: set[int] = set()  # links whose written data stays in this machine's buffers
        self._probes = LinkProbes(link.names, self._choices, bus, send)
        self._states = LinkStates(link, self._choices, now, bus.publish)
        self.status: StateCell[tuple[LinkStatus, ...]] = self._states.cell

    # ------------------------------------------------------------ the interface of Routes

    def record_heartbeat(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """Record a heartbeat and the link over which it arrived.

        Returns False if the routing table is full, or if the system id is 0.
        """
        link = _link_index(peer)
        if not frame.system_id or not self._routes[link].record_heartbeat(frame, peer, counters):
            return False
        heartbeat = self._bus.dialect.decode(frame)
        is_autopilot = getattr(heartbeat, "autopilot", MavAutopilot.INVALID) != MavAutopilot.INVALID
        choice = self._choices.get(frame.system_id)
        if choice is None:
            choice = self._choices[frame.system_id] = LinkChoice(has_autopilot=is_autopilot)
        candidate = choice.record_heartbeat(link, frame.received_at, is_costly=link in self._link.costly)
        candidate.is_stalled = link in self._stalled
        is_first_autopilot = is_autopilot and not choice.has_autopilot
        if is_first_autopilot:  # The links known so far lead to other components of this system.
            choice.record_autopilot(candidate)
        if counters is not None:
            self._counters.setdefault((frame.system_id, link), {})[frame.component_id] = counters
        if choice.used is None:
            self._choose(frame.system_id, choice, frame.received_at)
        return True

    def has_route(self, source: tuple[int, int]) -> bool:
        return any(routes.has_route(source) for routes in self._routes)

    def is_outdated(self, frame: Frame) -> bool:
        return any(routes.is_outdated(frame) for routes in self._routes)

    def arrived_on_other_peer(self, frame: Frame, peer: Peer) -> bool:
        return self._routes[_link_index(peer)].arrived_on_other_peer(frame, peer)

    def try_move_route(self, frame: Frame, peer: Peer, *, is_signed: bool) -> bool:
        return self._routes[_link_index(peer)].try_move_route(frame, peer, is_signed=is_signed)

    def record_duplicate_sender(self, frame: Frame) -> None:
        self._routes[0].record_duplicate_sender(frame)

    def exclude_pause(self, now: float, paused_s: float) -> None:
        for routes in self._routes:
            routes.exclude_pause(now, paused_s)

    def evict_idle_peer(self, peers: Iterable[Peer], now: float) -> Peer | None:
        for index, routes in enumerate(self._routes):
            evicted = routes.evict_idle_peer([peer for peer in peers if _link_index(peer) == index], now)
            if evicted is not None:
                return evicted
        return None

    def peers_of(self, system_id: int, component_id: int, message: Message | None = None) -> Collection[Peer]:
        """Return the peers to which a message for a component is sent. The call may change the link in use."""
        if system_id != 0:
            choice = self._choices.get(system_id)
            if choice is None or choice.used is None:
                return EVERY_PEER
            now = self._now()
            self._choose(system_id, choice, now)
            if choice.used.is_other_hardware:
                return ()  # The link leads to another vehicle, which DuplicateSender has reported. Nothing is sent.
            if message is None or message.ID in COMMANDS:  # None is a raw frame, which may be a command.
                choice.record_command(now)
            return self._peers_on(self._link_reaching(choice, (system_id, component_id)), system_id, component_id)
        if message is not None and message.ID in BROADCASTS:
            return EVERY_PEER
        return self._one_per_system(self._now())

    # -------------------------------------------------------------------- received frames

    def is_duplicate(self, frame: Frame, peer: Peer, *, is_other_peer: bool) -> bool:
        """Return True if the frame must be dropped: it was delivered over another link, or has our own ids.

        A dropped copy still shows that its link works, and to which vehicle it leads. ``is_other_peer`` is True if the
        route of the frame's sender leads to another peer of this link (see `arrived_on_other_peer`).
        """
        # PX4 forwards our heartbeats from one of its ports to the others, so they come back over another link.
        if (frame.system_id, frame.component_id) == self._own_source:
            return True
        link = _link_index(peer)
        if not self._merged.is_duplicate(frame, link, is_other_peer=is_other_peer):
            return False
        if is_other_peer:  # The copy may come from a second sender with the same ids, so it proves nothing.
            return True
        # The copy is dropped, but it proves that this link works, and shows to which vehicle the link leads.
        self._probes.record_hardware(frame, link)
        if frame.message_id == m.Heartbeat.ID:
            counters = self._counters.get((frame.system_id, link), {}).get(frame.component_id)
            self.record_heartbeat(frame, peer, counters)
        return True

    def accepts(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """Return True if the frame is to be delivered. Heartbeats are recorded in any case."""
        link = _link_index(peer)
        if frame.message_id == m.Timesync.ID and self._probes.record_answer(frame, link):
            return False
        self._probes.record_hardware(frame, link)
        if frame.message_id == m.Heartbeat.ID:
            self.record_heartbeat(frame, peer, counters)
        return self._merged.accepts(frame, link)

    # ------------------------------------------------------------------ state of the links

    def link_changed(self, link: int, is_available: bool) -> None:
        now = self._now()
        if not is_available:  # A lost link has no unsent data.
            self._stalled.discard(link)
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_available = is_available
                candidate.is_stalled = link in self._stalled
                self._choose(system_id, choice, now)
        self._states.set_state(link, LinkState.CONNECTED if is_available else LinkState.LOST, now)

    def link_stalled(self, link: int, is_stalled: bool) -> None:
        now = self._now()
        if is_stalled:
            self._stalled.add(link)
        else:
            self._stalled.discard(link)
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_stalled = is_stalled
                self._choose(system_id, choice, now)

    def link_open_failed(self, link: int, error: LinkOpenError) -> None:
        self._bus.publish(MemberLinkOpenFailed(self._now(), system_id=0, link=self._link.names[link], error=error))

    async def watch(self) -> None:
        while True:
            self.update(self._now())
            await anyio.sleep(POLL_INTERVAL_S)

    def update(self, now: float) -> None:
        for system_id, choice in self._choices.items():
            for link, candidate in choice.candidates.items():
                # This updates `received_at`, which would otherwise be too old after a pause of the event loop.
                if counters := self._counters.get((system_id, link), {}).values():
                    received = sum(counter.received for counter in counters)
                    lost = sum(counter.lost for counter in counters)
                    candidate.record_counts(received, lost, now)
                if now - candidate.received_at > CANDIDATE_TIMEOUT_S:  # The link no longer receives the system.
                    self._counters.pop((system_id, link), None)
                    continue
                self._probe(system_id, choice, candidate, now)
            self._choose(system_id, choice, now)
        self._states.update(now)

    # ---------------------------------------------------------------------------- internal

    def _link_reaching(self, choice: LinkChoice, source: tuple[int, int]) -> int:
        """Return the link in use or, if it has no route to the component, another usable link that has one."""
        assert choice.used is not None
        if not self._routes[choice.used.link].has_route(source):
            for link, candidate in choice.candidates.items():
                if choice.may_be_used(candidate) and self._routes[link].has_route(source):
                    return link
        return choice.used.link

    def _peers_on(self, link: int, system_id: int, component_id: int) -> Collection[Peer]:
        """Return the peers on this link that get a message for a component."""
        peers = self._routes[link].peers_of(system_id, component_id)
        # If the route has expired, `peers` is EVERY_PEER, so all peers of the link get the message.
        return (LinkPeer(link, None),) if None in peers else peers

    def _one_per_system(self, now: float) -> Collection[Peer]:
        """Return peers that together reach every system that has a link in use."""
        used = {system_id: choice for system_id, choice in self._choices.items() if choice.used is not None}
        options_by_system = [self._options(system_id, choice, now) for system_id, choice in used.items()]
        peers: set[Peer] = set()
        # The peers are chosen greedily. Systems with a single option come first, because their peers must be added in
        # any case. If these peers also reach a system with several options, no peer needs to be added for that system.
        for options in sorted(options_by_system, key=len):
            if not any(peers.issuperset(option) for option in options):
                peers.update(options[0])
        # Links without a known system are added as well, because they may lead to a system that is not known yet.
        links_with_systems = {link for choice in self._choices.values() for link in choice.candidates}
        peers.update(LinkPeer(link, None) for link in range(len(self._routes)) if link not in links_with_systems)
        return peers

    def _options(self, system_id: int, choice: LinkChoice, now: float) -> list[Collection[Peer]]:
        """Return the peers that reach a system, for each of its usable links. The link in use comes first."""
        usable = [
            candidate
            for candidate in choice.candidates.values()
            if candidate is choice.used or (choice.may_be_used(candidate) and candidate.is_alive(now))
        ]
        usable.sort(key=lambda candidate: candidate is not choice.used)
        return [self._peers_on(candidate.link, system_id, component_id=0) for candidate in usable]

    def _choose(self, system_id: int, choice: LinkChoice, now: float) -> None:
        before = choice.used
        reason = choice.choose(now)
        used = choice.used
        if reason is None or used is None:
            return
        link, previous_link = self._link.names[used.link], None
        if before is not None:
            # Unsent data is discarded, because it must not arrive after newer commands that are sent over the new link.
            # Data for other systems is discarded with it. Commands and transfers repeat what was discarded.
            self._link.discard_unsent_of(before.link)
            self._merged.reset(system_id)
            previous_link = self._link.names[before.link]
            log = logger.info if reason in ("better", "cheaper") else logger.warning
            disadvantage = _DISADVANTAGE_OF_PREVIOUS.get(reason, reason)
            log("system %d: switched to %s, because %s is %s", system_id, link, previous_link, disadvantage)
        self._bus.publish(LinkSelected(now, system_id, link=link, before=previous_link, reason=reason))
        self._states.set_cell(now)

    def _probe(self, system_id: int, choice: LinkChoice, candidate: Candidate, now: float) -> None:
        if choice.has_autopilot and candidate.is_available and not candidate.is_stalled:
            has_vehicle_object = system_id in self._vehicle_systems
            for peer in self._routes[candidate.link].peers_of(system_id, MavComponent.AUTOPILOT1):
                self._probes.probe(system_id, choice, candidate, peer, now, has_vehicle_object=has_vehicle_object)


# Maps the reason for a switch, which describes the new link, to the word that describes the previous link in the log.
_DISADVANTAGE_OF_PREVIOUS = {"better": "worse", "cheaper": "costly"}


def _link_index(peer: Peer) -> int:
    assert isinstance(peer, LinkPeer)
    return peer.link
