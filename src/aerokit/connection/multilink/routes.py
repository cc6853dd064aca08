"""``SeveralRoutes``: several links to the same vehicles: over which of them each is asked, told and ordered."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import anyio

from aerokit.connection.cells import Source, StateCell
from aerokit.connection.multilink.duplicates import MergedStreams
from aerokit.connection.multilink.link_choice import LinkChoice
from aerokit.connection.multilink.link_questions import LinkQuestions
from aerokit.connection.routes import EVERY_PEER, Routes
from aerokit.events import LinkChosen, LinkState, LinkStatus, OneLinkChanged, OneLinkNotOpened
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavComponent
from aerokit.transport.several import LinkPeer

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
    from aerokit.transport.several import SeveralLinks

PERIOD_S = 0.95
"""A second, looked at ten times a second."""


class LinkStates:
    """``choices`` is the choice for each system; ``publish`` tells an event."""

    def __init__(
        self,
        link: SeveralLinks,
        choices: Mapping[int, LinkChoice],
        clock: Callable[[], float],
        publish: Callable[[Event], object],
    ) -> None:
        self._link, self._choices, self._publish = link, choices, publish
        self._states = [LinkState.LOST] * len(link.names)
        self._told_at = -math.inf
        self.cell: StateCell[tuple[LinkStatus, ...]] = StateCell("links", clock, "frame")

    def look(self, now: float) -> None:
        """Tell what has changed, and once a second how all of them do."""
        for link in range(len(self._states)):
            candidates = [each.candidates[link] for each in self._choices.values() if link in each.candidates]
            if candidates and self._link.is_there(link):
                is_alive = any(each.is_alive(now) for each in candidates)
                self.become(link, LinkState.CONNECTED if is_alive else LinkState.SILENT, now)
        if now - self._told_at >= PERIOD_S:
            self.tell(now)

    def become(self, link: int, state: LinkState, now: float) -> None:
        """It is so with this link."""
        before, self._states[link] = self._states[link], state
        if before is not state:
            self._told_at = -math.inf
            self._publish(OneLinkChanged(now, 0, self._link.names[link], before, state))

    def tell(self, now: float) -> None:
        """How all of them do."""
        self._told_at = now
        self.cell.set(tuple(map(self._status, range(len(self._states)))), Source(0, 0, "link"))

    def _status(self, link: int) -> LinkStatus:
        candidates = {
            system_id: choice.candidates[link]
            for system_id, choice in self._choices.items()
            if link in choice.candidates
        }
        losses = [each.loss for each in candidates.values() if each.loss is not None]
        trips = [each.round_trip_s for each in candidates.values() if each.round_trip_s is not None]
        return LinkStatus(
            self._link.names[link],
            self._states[link],
            is_costly=link in self._link.costly,
            systems=tuple(sorted(candidates)),
            used_for=tuple(
                sorted(each for each in candidates if self._choices[each].used is candidates[each])
            ),
            loss_percent=100 * max(losses) if losses else None,
            round_trip_s=max(trips) if trips else None,
        )


logger: logging.Logger = logging.getLogger("aerokit")

LOOK_S = 0.1

GONE_S = 30.0
"""Who was not heard over a link for so long is neither asked nor counted there, until a heartbeat comes."""

ORDERS = frozenset(
    each.ID
    for each in (
        m.CommandLong, m.CommandInt, m.SetMode, m.MissionSetCurrent, m.MissionClearAll, m.ParamSet,
        m.SetPositionTargetGlobalInt, m.SetPositionTargetLocalNed, m.SetAttitudeTarget,
    )
)  # fmt: skip
"""What must not arrive after a newer one."""

FOR_ALL = frozenset(each.ID for each in (m.Heartbeat, m.Timesync, m.Ping))
"""What everybody on every link is told: it orders nothing."""


class SeveralRoutes:
    """One :class:`Routes` for each link (``make_routes``), and over them the choice of a link for each system.

    ``we`` are our own ids; ``attached`` are the system ids with a vehicle object; ``send(message, peer)`` sends.
    """

    def __init__(
        self,
        link: SeveralLinks,
        make_routes: Callable[[], Routes],
        bus: Bus,
        *,
        we: tuple[int, int],
        attached: Collection[int],
        send: Callable[[Message, Peer], object],
        now: Callable[[], float],
    ) -> None:
        self._link, self._bus, self._now = link, bus, now
        self._we, self._attached = we, attached
        self._routes = [make_routes() for _ in link.names]
        self._choices: dict[int, LinkChoice] = {}
        self._merged = MergedStreams(len(link.names), self._choices)
        self.copies: Copies = self._merged.copies
        # of (system, link), by component
        self._counters: dict[tuple[int, int], dict[int, SourceStatistics]] = {}
        self._questions = LinkQuestions(link.names, self._choices, bus, send)
        self._states = LinkStates(link, self._choices, now, bus.publish)
        self.status: StateCell[tuple[LinkStatus, ...]] = self._states.cell

    # ------------------------------------------------------- as Routes, for the connection

    def note(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """A heartbeat came from this peer; False when there is no room to remember it, or it is nobody's (system 0)."""
        if not frame.system_id or not self._routes[_link(peer)].note(frame, peer, counters):
            return False
        heartbeat = self._bus.dialect.decode(frame)
        is_autopilot = getattr(heartbeat, "autopilot", MavAutopilot.INVALID) != MavAutopilot.INVALID
        choice = self._choices.get(frame.system_id)
        if choice is None:
            choice = self._choices[frame.system_id] = LinkChoice(needs_proof=is_autopilot)
        is_costly = _link(peer) in self._link.costly
        candidate = choice.heard(_link(peer), frame.received_at, is_costly=is_costly)
        if is_autopilot and not choice.needs_proof:
            choice.begin_with(candidate)
        if counters is not None:
            self._counters.setdefault((frame.system_id, _link(peer)), {})[frame.component_id] = counters
        if choice.used is None:
            self._choose(frame.system_id, choice, frame.received_at)
        return True

    def is_known(self, source: tuple[int, int]) -> bool:
        """Whether a heartbeat of this component is remembered."""
        return any(routes.is_known(source) for routes in self._routes)

    def is_overtaken(self, frame: Frame) -> bool:
        """Whether a heartbeat that is late by its number is older than the last one that was noted."""
        return any(routes.is_overtaken(frame) for routes in self._routes)

    def is_elsewhere(self, frame: Frame, peer: Peer) -> bool:
        """Whether the component of this frame is known to be behind another peer of this link."""
        return self._routes[_link(peer)].is_elsewhere(frame, peer)

    def takes_place(
        self, frame: Frame, peer: Peer, counters: SourceStatistics | None, is_signed: bool
    ) -> bool:
        """See :meth:`Routes.takes_place`, of the same link."""
        return self._routes[_link(peer)].takes_place(frame, peer, counters, is_signed)

    def hear_double(self, frame: Frame) -> None:
        """Somebody behind the same peer speaks in this one's name."""
        self._routes[0].hear_double(frame)

    def least_wanted(self, peers: Iterable[Peer], now: float) -> list[Peer]:
        """The first behind which nobody lives, if there is one."""
        for index, routes in enumerate(self._routes):
            found = routes.least_wanted((peer for peer in peers if _link(peer) == index), now)
            if found:
                return found
        return []

    def peers_of(self, system_id: int, component_id: int, message: Message | None = None) -> Collection[Peer]:
        """Where to send what is for this component: over one link, the best one.

        What is for everybody goes once to each system that is known, as far as the links allow it, and to all links
        behind which none is; heartbeats and the like go everywhere.
        """
        if system_id != 0:
            choice = self._choices.get(system_id)
            if choice is None or choice.used is None:
                return EVERY_PEER
            now = self._now()
            self._choose(system_id, choice, now)
            if choice.used.is_other_hardware:
                return ()  # the vehicle was lost unnoticed, and there is no other link to it
            if message is None or message.ID in ORDERS:
                choice.ordered(now)
            return self._peers_on(self._link_to(choice, (system_id, component_id)), system_id, component_id)
        if message is not None and message.ID in FOR_ALL:
            return EVERY_PEER
        return self._one_for_each_system(self._now())

    # ---------------------------------------------------------------- what comes, and what of it is taken

    def is_copy(self, frame: Frame, peer: Peer) -> bool:
        """Whether this frame has come over another link already, and was taken; or is our own.

        PX4 passes our heartbeats on from one of its ports to the others.
        """
        if frame.system_id == self._we[0] and frame.component_id == self._we[1]:
            return True
        link = _link(peer)
        if not self._merged.was_taken(frame, link):
            return False
        self._questions.note_hardware(frame, link)
        if frame.message_id == m.Heartbeat.ID and not self.is_elsewhere(frame, peer):
            counters = self._counters.get((frame.system_id, link), {}).get(frame.component_id)
            self.note(frame, peer, counters)
        return True

    def takes(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """Whether it is to be delivered; heartbeats of a link that is not in use are noted here."""
        link = _link(peer)
        if frame.message_id == m.Timesync.ID and self._questions.is_answer(frame, link):
            return False
        self._questions.note_hardware(frame, link)
        if frame.message_id == m.Heartbeat.ID:
            self.note(frame, peer, counters)
        return self._merged.takes(frame, link)

    # ---------------------------------------------------------------------------- the links themselves

    def link_changed(self, link: int, is_there: bool) -> None:
        """A link has gone, or is there again."""
        now = self._now()
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_there = is_there
                if not is_there:
                    candidate.is_stalled = False
                self._choose(system_id, choice, now)
        self._states.become(link, LinkState.CONNECTED if is_there else LinkState.LOST, now)

    def link_stalled(self, link: int, is_stalled: bool) -> None:
        """What is written to a link does not leave, or leaves again."""
        now = self._now()
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_stalled = is_stalled
                self._choose(system_id, choice, now)

    def link_not_opened(self, link: int, error: LinkOpenError) -> None:
        """A link could not be opened, and is tried again."""
        event = OneLinkNotOpened(self._now(), 0, self._link.names[link], error)
        self._bus.publish(event)

    async def watch(self) -> None:
        """Count, ask and choose, until it is cancelled."""
        while True:
            self.look(self._now())
            await anyio.sleep(LOOK_S)

    def look(self, now: float) -> None:
        """Take stock: what has come over which link, who is to be asked, which link is to be used."""
        for system_id, choice in self._choices.items():
            for link, candidate in choice.candidates.items():
                if now - candidate.heard_at > GONE_S:
                    self._counters.pop((system_id, link), None)
                    continue
                counters = self._counters.get((system_id, link), {}).values()
                received, lost = sum(each.received for each in counters), sum(each.lost for each in counters)
                candidate.note_counts(received, lost, now)
                self._ask(system_id, choice, candidate, now)
            self._choose(system_id, choice, now)
        self._states.look(now)

    # ------------------------------------------------------------------------------------- inside

    def _link_to(self, choice: LinkChoice, source: tuple[int, int]) -> int:
        """The link in use, or, to a component that is not behind it, another one that leads to the same system."""
        assert choice.used is not None
        if not self._routes[choice.used.link].is_known(source):
            for link, candidate in choice.candidates.items():
                if choice.may_be_used(candidate) and self._routes[link].is_known(source):
                    return link
        return choice.used.link

    def _peers_on(self, link: int, system_id: int, component_id: int) -> Collection[Peer]:
        """Those of this link only, also when it has forgotten who they are."""
        peers = self._routes[link].peers_of(system_id, component_id)
        return (LinkPeer(link, None),) if None in peers else peers

    def _one_for_each_system(self, now: float) -> Collection[Peer]:
        """Whoever is reached by what another one needs anyway is not written to a second time."""
        peers: set[Peer] = set()
        reached: set[int] = set()
        ways: list[list[Collection[Peer]]] = []
        for system_id, choice in self._choices.items():
            reached.update(choice.candidates)
            if choice.used is not None:
                others = (each for each in choice.candidates.values() if each is not choice.used)
                usable = (each for each in others if choice.may_be_used(each) and each.is_alive(now))
                ways.append([self._peers_on(each.link, system_id, 0) for each in (choice.used, *usable)])
        for way in sorted(ways, key=len):
            if not any(peers.issuperset(each) for each in way):
                peers.update(way[0])
        peers.update(LinkPeer(link, None) for link in range(len(self._routes)) if link not in reached)
        return peers

    def _choose(self, system_id: int, choice: LinkChoice, now: float) -> None:
        before = choice.used
        reason = choice.choose(now)
        used = choice.used
        if reason is None or used is None:
            return
        if before is not None:
            self._link.discard_unsent_of(before.link)  # it may not arrive after what is ordered now
            self._merged.begin_anew(system_id)
            name, former = self._link.names[used.link], self._link.names[before.link]
            log = logger.info if reason in ("better", "cheaper") else logger.warning
            log(
                "system %d: %s is used now, %s is %s", system_id, name, former, _OF_FORMER.get(reason, reason)
            )
        self._bus.publish(
            LinkChosen(
                now,
                system_id,
                link=self._link.names[used.link],
                before=None if before is None else self._link.names[before.link],
                reason=reason,
            )
        )
        self._states.tell(now)

    def _ask(self, system_id: int, choice: LinkChoice, candidate: Candidate, now: float) -> None:
        if choice.needs_proof and candidate.is_there and not candidate.is_stalled:
            for peer in self._routes[candidate.link].peers_of(system_id, MavComponent.AUTOPILOT1):
                is_wanted = system_id in self._attached
                self._questions.ask(system_id, choice, candidate, peer, now, is_wanted=is_wanted)


_OF_FORMER = {"better": "worse", "cheaper": "costly"}


def _link(peer: Peer) -> int:
    assert isinstance(peer, LinkPeer)
    return peer.link
