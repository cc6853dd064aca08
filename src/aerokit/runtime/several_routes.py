"""``SeveralRoutes``: several links to the same vehicles: what is taken from which, and over which of them orders go."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

import anyio

from aerokit.links.several import LinkPeer
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavComponent
from aerokit.runtime.claims import boot_time_ms
from aerokit.runtime.copies import Copies
from aerokit.runtime.events import HeardTwice, LinkChosen, OneLinkNotOpened
from aerokit.runtime.hardware_id import HardwareId
from aerokit.runtime.link_choice import LinkChoice
from aerokit.runtime.link_questions import LinkQuestions
from aerokit.runtime.link_state import LinkState
from aerokit.runtime.link_states import LinkStates
from aerokit.runtime.routes import EVERY_PEER, Routes

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from aerokit.errors import LinkOpenError
    from aerokit.links.link import Peer
    from aerokit.links.several import SeveralLinks
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.statistics import SourceStatistics
    from aerokit.runtime.cells import StateCell
    from aerokit.runtime.connection import Connection
    from aerokit.runtime.link_candidate import Candidate
    from aerokit.runtime.link_state import LinkStatus

__all__ = ["SeveralRoutes"]

logger: logging.Logger = logging.getLogger("aerokit")

LOOK_S = 0.1
ANSWERS_WITHIN_S = 3.0
"""After a change what was asked over the former link is still answered over it."""
LIVES_S = 10.0
"""A component is taken for one behind a link for so long after something of it came there."""
GONE_S = 30.0
"""Who was not heard over a link for so long is neither asked nor counted there, until a heartbeat comes."""
MOST_SOURCES = 1024

ANSWERS = frozenset(
    each.ID
    for each in (
        m.CommandAck, m.ParamValue, m.ParamExtValue, m.ParamExtAck, m.MissionCount, m.MissionItem, m.MissionItemInt,
        m.MissionRequest, m.MissionRequestInt, m.MissionAck, m.FileTransferProtocol, m.LogEntry, m.LogData,
    )
)  # fmt: skip
"""What is no state of the vehicle: it does not grow old on its way."""
ACKNOWLEDGEMENTS = frozenset(each.ID for each in (m.CommandAck, m.MissionAck, m.ParamExtAck))
"""Of these PX4 sends one over each port where it has seen us: the second one would answer the next order."""
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


class _Stream:
    """The frames of one component."""

    __slots__ = ("acknowledgements", "heard_at", "newest")

    def __init__(self, links: int) -> None:
        self.heard_at = [-math.inf] * links
        self.newest = -1  # number of the newest frame that was taken; -1: none
        # Which have come how often over each link since the change, as long as the former one is listened to.
        self.acknowledgements: dict[bytes, list[int]] = {}

    def has_come(self, payload: bytes, link: int) -> bool:
        """Whether this acknowledgement came over another link as often as it has come over this one, by now."""
        counts = self.acknowledgements.setdefault(payload, [0] * len(self.heard_at))
        counts[link] += 1
        return counts[link] <= max(count for other, count in enumerate(counts) if other != link)


class SeveralRoutes:
    """One :class:`Routes` for each link, and over them the choice of a link for each system.

    Exactly the same frame is taken once, whichever copy comes first. Where two links carry streams of their own (two
    ports of an autopilot number their frames apart), only what comes over the link in use is taken: what came over the
    other one may be older.
    """

    def __init__(self, link: SeveralLinks, connection: Connection, *, may_move: bool) -> None:
        self._link, self._connection = link, connection
        self._count = len(link.names)
        self._we = connection.source_system, connection.source_component
        self._routes = [
            Routes(
                link, connection.bus.publish, connection.attached, connection.boot_clocks, may_move=may_move
            )
            for _ in range(self._count)
        ]
        self._choices: dict[int, LinkChoice] = {}
        self._streams: dict[int, _Stream] = {}
        self._counters: dict[
            tuple[int, int], dict[int, SourceStatistics]
        ] = {}  # of (system, link), by component
        self.copies: Copies = Copies()
        self._questions = LinkQuestions(self._count, connection.send_to_peer)
        self._doubts_told: set[tuple[int, int]] = set()
        self._states = LinkStates(link, self._choices, connection.now, connection.bus.publish)
        self.status: StateCell[tuple[LinkStatus, ...]] = self._states.cell
        connection.bus.attach(m.Timesync, _ignore)
        connection.bus.attach(m.AutopilotVersion, _ignore)

    # ------------------------------------------------------- as Routes, for the connection

    def note(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """A heartbeat came from this peer; False when there is no room to remember it, or it is nobody's (system 0)."""
        if not frame.system_id or not self._routes[_link(peer)].note(frame, peer, counters):
            return False
        heartbeat = self._connection.bus.dialect.decode(frame)
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
            now = self._connection.now()
            self._choose(system_id, choice, now)
            if choice.used.is_other_hardware:
                return ()  # the vehicle was lost unnoticed, and there is no other link to it
            if message is None or message.ID in ORDERS:
                choice.ordered(now)
            return self._peers_on(self._link_to(choice, (system_id, component_id)), system_id, component_id)
        if message is not None and message.ID in FOR_ALL:
            return EVERY_PEER
        return self._one_for_each_system(self._connection.now())

    # ---------------------------------------------------------------- what comes, and what of it is taken

    def is_copy(self, frame: Frame, peer: Peer) -> bool:
        """Whether this frame has come over another link already, and was taken; or is our own.

        PX4 passes our heartbeats on from one of its ports to the others.
        """
        if frame.system_id == self._we[0] and frame.component_id == self._we[1]:
            return True
        if not self.copies.is_copy(frame, _link(peer)):
            return False
        choice = self._choices.get(frame.system_id)
        # A heartbeat is like another one, also of another vehicle.
        if choice is not None and boot_time_ms(frame):
            for link in {_link(peer), -1 if choice.used is None else choice.used.link}:
                if (candidate := choice.candidates.get(link)) is not None:
                    candidate.note_copy(frame.received_at)
        if not self.copies.was_taken:
            return False
        self._stream(frame).heard_at[_link(peer)] = frame.received_at
        self._note_hardware(frame, peer)
        if frame.message_id == m.Heartbeat.ID and not self.is_elsewhere(frame, peer):
            counters = self._counters.get((frame.system_id, _link(peer)), {}).get(frame.component_id)
            self.note(frame, peer, counters)
        return True

    def takes(self, frame: Frame, peer: Peer, counters: SourceStatistics | None) -> bool:
        """Whether it is to be delivered; heartbeats of a link that is not in use are noted here."""
        if frame.message_id == m.Timesync.ID and self._is_answer(frame, peer):
            return False
        self._note_hardware(frame, peer)
        choice = self._choices.get(frame.system_id)
        if frame.message_id == m.Heartbeat.ID:
            self.note(frame, peer, counters)
            choice = self._choices.get(frame.system_id)
        stream = self._stream(frame)
        stream.heard_at[_link(peer)] = frame.received_at
        candidate = None if choice is None else choice.candidates.get(_link(peer))
        if choice is None or choice.used is None:
            self.copies.take()
            return True  # of somebody who sends no heartbeats: a radio
        used = choice.used
        if candidate is not None and not choice.may_be_used(candidate):
            return False
        if frame.received_at <= choice.fresh_after and frame.message_id not in ANSWERS:
            return False
        if self.copies.is_late and not self._may_be_alike(frame, peer, choice):
            return False
        if _link(peer) != used.link:
            if candidate is None:
                return False
            lives_there = frame.received_at - stream.heard_at[used.link] <= LIVES_S
            is_shared = choice.is_shared(candidate, frame.received_at)
            is_late = stream.newest >= 0 and (frame.sequence - stream.newest) & 0xFF >= 128
            is_late_answer = (
                frame.message_id in ANSWERS
                and candidate is choice.former
                and frame.received_at - choice.changed_at <= ANSWERS_WITHIN_S
            )
            if lives_there and not is_late_answer and not is_shared:
                return False
            if is_shared and is_late and frame.message_id not in ANSWERS:
                return False
        is_soon = frame.received_at - choice.changed_at <= ANSWERS_WITHIN_S
        if is_soon and frame.message_id in ACKNOWLEDGEMENTS:
            has_come = stream.has_come(frame.payload, _link(peer))
            if has_come and _link(peer) != used.link:
                return False
        stream.newest = frame.sequence
        self.copies.take()
        return True

    # ---------------------------------------------------------------------------- the links themselves

    def link_changed(self, link: int, is_there: bool) -> None:
        """A link has gone, or is there again."""
        now = self._connection.now()
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_there = is_there
                if not is_there:
                    candidate.is_stalled = False
                self._choose(system_id, choice, now)
        self._states.become(link, LinkState.CONNECTED if is_there else LinkState.LOST, now)

    def link_stalled(self, link: int, is_stalled: bool) -> None:
        """What is written to a link does not leave, or leaves again."""
        now = self._connection.now()
        for system_id, choice in self._choices.items():
            if (candidate := choice.candidates.get(link)) is not None:
                candidate.is_stalled = is_stalled
                self._choose(system_id, choice, now)

    def link_not_opened(self, link: int, error: LinkOpenError) -> None:
        """A link could not be opened, and is tried again."""
        event = OneLinkNotOpened(self._connection.now(), 0, self._link.names[link], error)
        self._connection.bus.publish(event)

    async def watch(self) -> None:
        """Count, ask and choose, as long as the connection is open."""
        while self._connection.is_open:
            self.look(self._connection.now())
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

    def _may_be_alike(self, frame: Frame, peer: Peer, choice: LinkChoice) -> bool:
        """Whether it is another frame than the one with the same bytes: of streams apart, heartbeats are."""
        candidate = choice.used
        if candidate is None or candidate.link != _link(peer) or frame.message_id != m.Heartbeat.ID:
            return False
        return not choice.is_shared(candidate, frame.received_at)

    def _stream(self, frame: Frame) -> _Stream:
        key = frame.component_id << 8 | frame.system_id
        stream = self._streams.get(key)
        if stream is None:
            if len(self._streams) >= MOST_SOURCES:
                del self._streams[next(iter(self._streams))]
            stream = self._streams[key] = _Stream(self._count)
        return stream

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
        peers.update(LinkPeer(link, None) for link in range(self._count) if link not in reached)
        return peers

    def _choose(self, system_id: int, choice: LinkChoice, now: float) -> None:
        before = choice.used
        reason = choice.choose(now)
        used = choice.used
        if reason is None or used is None:
            return
        if before is not None:
            self._link.discard_unsent_of(before.link)  # it may not arrive after what is ordered now
            self._streams = {key: each for key, each in self._streams.items() if key & 0xFF != system_id}
            name, former = self._link.names[used.link], self._link.names[before.link]
            log = logger.info if reason in ("better", "cheaper") else logger.warning
            log(
                "system %d: %s is used now, %s is %s", system_id, name, former, _OF_FORMER.get(reason, reason)
            )
        self._connection.bus.publish(
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
                is_wanted = system_id in self._connection.attached
                self._questions.ask(system_id, choice, candidate, peer, now, is_wanted=is_wanted)

    def _is_answer(self, frame: Frame, peer: Peer) -> bool:
        message = self._connection.bus.dialect.decode(frame)
        if not isinstance(message, m.Timesync) or not self._questions.is_ours(message):
            return False
        link, now = _link(peer), frame.received_at
        round_trip_s = self._questions.round_trip_of(message, frame.system_id, link, now)
        choice = self._choices.get(frame.system_id)
        if round_trip_s is not None and choice is not None and link in choice.candidates:
            choice.note_answer(link, now - round_trip_s / 2, message.tc1 / 1e9, round_trip_s, now)
            self._tell_doubt(frame, choice.candidates[link])
        return True

    def _note_hardware(self, frame: Frame, peer: Peer) -> None:
        choice, link = self._choices.get(frame.system_id), _link(peer)
        if frame.message_id != m.AutopilotVersion.ID or frame.component_id != MavComponent.AUTOPILOT1:
            return
        message = self._connection.bus.dialect.decode(frame)
        if isinstance(message, m.AutopilotVersion) and choice is not None and link in choice.candidates:
            choice.note_hardware(link, HardwareId.of(message))
            for candidate in choice.candidates.values():
                self._tell_doubt(frame, candidate)

    def _tell_doubt(self, frame: Frame, candidate: Candidate) -> None:
        key = frame.system_id, candidate.link
        if not candidate.is_doubted:
            self._doubts_told.discard(key)
        elif key not in self._doubts_told:
            self._doubts_told.add(key)
            logger.warning(
                "another vehicle speaks as system %d over %s: its %s is another one; it is not listened to",
                frame.system_id,
                self._link.names[candidate.link],
                "hardware id (AUTOPILOT_VERSION)" if candidate.is_other_hardware else "clock",
            )
            self._connection.bus.publish(HeardTwice(frame.received_at, frame.system_id, frame.component_id))


_OF_FORMER = {"better": "worse", "cheaper": "costly"}


def _link(peer: Peer) -> int:
    assert isinstance(peer, LinkPeer)
    return peer.link


def _ignore(message: object) -> None:
    pass
