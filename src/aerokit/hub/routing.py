"""``Router``: where a frame goes, by MAVLink's rules (https://mavlink.io/en/guide/routing.html).

No link and no clock here: frames and ``now`` come in, plans go out. What is worked out for a message, its sender and
its target is kept, so that a frame costs a few look-ups; it is forgotten whenever somebody comes, goes or moves.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.connection.routes import LIVE_FOR_S, MOST_ROUTES, SWEEP_AFTER_S
from aerokit.hub.senders import (
    DUPLICATE_WINDOW_S,
    LOOP_MEMORY_S,
    LOOP_RUN,
    MOST_RECENT,
    REPEATED_WITHIN_S,
    Recent,
    Sender,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.hub.targets import Targets
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.frame import Frame

PortT = TypeVar("PortT")

MOST_PLANS = 4096
"""So many plans are kept for each port."""

_SETUP_SIGNING = 256
_RADIOS = (109, 166)


class Plan(Generic[PortT]):
    """Where frames of one message, from one sender at one port to one target, go."""

    key: int
    message_id: int
    reason: str
    target: tuple[int, int]

    __slots__ = ("key", "message_id", "outs", "reason", "target", "thinned")

    def __init__(
        self,
        key: int,
        message_id: int,
        target: tuple[int, int],
        outs: tuple[PortT, ...] = (),
        thinned: tuple[tuple[PortT, float], ...] = (),
        reason: str = "",
    ) -> None:
        self.key = key
        """The same for all frames of this message from this sender, whatever the target."""
        self.message_id = message_id
        self.target = target
        """System id and component id; 0 is everybody."""
        self.outs: tuple[PortT, ...] = outs
        """Where each of them goes."""
        self.thinned: tuple[tuple[PortT, float], ...] = thinned
        """Where one goes in so many seconds at most."""
        self.reason = reason
        """Why it goes nowhere: ``"duplicate"``, ``"loop"``, ``"no_route"``, ``"secret"``; "" where nobody else is there
        or wants it."""


class Node(Generic[PortT]):
    """A port as the router knows it."""

    number: int

    __slots__ = ("echoes", "loop_until", "number", "plans", "port")

    def __init__(self, port: PortT, number: int) -> None:
        self.port: PortT = port
        self.number = number
        """Above 0, and never given twice."""
        self.plans: dict[int, Plan[PortT]] = {}
        self.echoes: dict[int, int] = {}
        """Sender → how many more of its frames have come back here than new ones have come."""
        self.loop_until: float = -math.inf
        """Until then what comes back here is dropped."""


class Router(Generic[PortT]):
    """Learns behind which ports everybody is, and says where frames go.

    - what is for everybody goes to all other ports; an order for everybody not to those by which it would reach
      vehicles a second time;
    - what is for one component, or for all of one system, goes to the ports behind which it was heard, and nowhere
      while it was not; what is for an unknown component of a known system goes where the system is;
    - to a vehicle that is heard at several ports it goes by one of them, so that no order is given twice: the first
      one, until nothing has come from there for 3.5 s; what is for all of a system goes to its autopilot in the same
      way, and to its other components where that is not heard. Ground stations that share their ids all get it;
    - nothing goes back to where it came from, and nothing is passed on twice: copies that come by another way, within
      two seconds, end here, and teach nothing; nor does what comes back later, once it is clear that it goes round;
    - SETUP_SIGNING, which holds a key, goes nowhere; a telemetry radio's word on its own link does not go to vehicles.

    As many senders are remembered as a connection has routes (`MOST_ROUTES`). One more takes the place of one that has
    sent no heartbeat, or that was not heard for `LIVE_FOR_S`; if there is none, what is for it goes nowhere.

    ``gate(port, message_id)`` says whether a port wants a message: None: no; 0: all of them; else one in so many
    seconds of each sender, unless it has a target.
    """

    def __init__(self, targets: Targets, gate: Callable[[PortT, int], float | None]) -> None:
        self._targets, self._gate = targets, gate
        self._places = targets.places
        self._nodes: dict[int, Node[PortT]] = {}
        self._senders: dict[int, Sender] = {}
        self._recent = Recent()
        self._count = 0
        self._unproven: dict[int, None] = {}
        self._swept_at = -math.inf
        self._duplicate: Plan[PortT] = Plan(0, -1, (0, 0), reason="duplicate")
        self._loop: Plan[PortT] = Plan(0, -1, (0, 0), reason="loop")
        self._stranger: Plan[PortT] = Plan(0, -1, (0, 0), reason="unknown")
        self.on_vehicle: Callable[[PortT], object] | None = None
        """Called when an autopilot was heard at a port for the first time."""
        self.on_change: Callable[[HubEventKind, int, PortT, PortT | None], object] | None = None
        """Called with ``"heard_twice"``, ``"moved"`` or ``"loop"``, the sender, the port, and the port where it was
        before (None: it has gone)."""

    def add(self, port: PortT) -> Node[PortT]:
        """A port has come."""
        self._count += 1
        node = self._nodes[self._count] = Node(port, self._count)
        self.forget_plans()
        return node

    def remove(self, node: Node[PortT]) -> None:
        """A port has gone, and whoever was heard there only."""
        if self._nodes.pop(node.number, None) is not None:
            for key in [key for key, sender in self._senders.items() if sender.leave(node.number)]:
                del self._senders[key]
                self._unproven.pop(key, None)
            self.forget_plans()

    def forget_plans(self) -> None:
        """Something has changed: who is there, or what ports want."""
        for node in self._nodes.values():
            node.plans.clear()

    def heard_at(self, node: Node[PortT]) -> list[tuple[int, int]]:
        """Who was heard at a port: (system id, component id), sorted."""
        return sorted(
            (sender.system_id, sender.component_id)
            for sender in self._senders.values()
            if node.number in sender.heard
        )

    def route(self, node: Node[PortT], frame: Frame, now: float, is_late: bool = False) -> Plan[PortT]:
        """Where a frame goes that came from ``node``.

        ``is_late``: by its number it was overtaken, or came before from there.
        """
        # This runs for every frame. Sender and target are numbers: system id + 256 · component id.
        body, message_id = frame.body, frame.message_id
        source = body[4] | body[5] << 8
        sender = self._senders.get(source)
        if sender is None:
            if message_id not in self._places and self._targets.is_unknown(message_id):
                return self._stranger  # its checksum could not be checked: it may be noise
            sender = self._add_sender(source, node, now)
        number, recent = node.number, self._recent
        if now >= recent.ends_at or len(recent.newer) >= MOST_RECENT:
            recent.begin_next(now)
        which = source << 24 | body[3] << 16 | frame.checksum
        before = recent.newer.get(which) or recent.older.get(which)
        if before is None:
            recent.newer[which] = number, self._count, now
            if node.echoes:
                self._note_fresh(node, source)
        elif self._is_copy(before, number, now, is_late):
            return self._duplicate
        elif self._is_echo(before, number, now):
            if self._is_loop(node, source, before[0], now):
                return self._loop
            recent.newer[which] = *before[:2], now
        else:
            recent.newer[which] = number, self._count, now
        if sender.number == number:
            sender.heard_at = now
        else:
            self._hear_elsewhere(sender, node, now)
        if not message_id:
            self._note_heartbeat(sender, node, body)
        try:
            places = self._places[message_id]
        except KeyError:
            places = self._targets.look_up(message_id)
        target = 0
        if places is not None:
            size, (system, component) = len(body), places
            if system < size:
                target = body[system] | (body[component] << 8 if component < size else 0)
        key = message_id << 32 | target << 16 | source
        try:
            return node.plans[key]
        except KeyError:
            return self._plan(node, key)

    # ------------------------------------------------------------------------------------ senders

    def _add_sender(self, source: int, node: Node[PortT], now: float) -> Sender:
        sender = Sender(source, node.number, now)
        if len(self._senders) < MOST_ROUTES or self._make_room(now):
            self._senders[source] = sender
            self._unproven[source] = None
            self.forget_plans()
        return sender

    def _make_room(self, now: float) -> bool:
        if self._unproven:
            source = next(iter(self._unproven))
            del self._unproven[source], self._senders[source]
        elif now - self._swept_at >= SWEEP_AFTER_S:
            self._swept_at = now
            for source in [key for key, each in self._senders.items() if now - each.heard_at > LIVE_FOR_S]:
                del self._senders[source]
        return len(self._senders) < MOST_ROUTES

    def _hear_elsewhere(self, sender: Sender, node: Node[PortT], now: float) -> None:
        before = sender.number
        if sender.hear_elsewhere(node.number, now):
            self.forget_plans()
        if sender.is_autopilot and sender.number != before:
            self._tell("moved", sender.source, node, before)

    def _is_copy(self, before: tuple[int, int, float], number: int, now: float, is_late: bool) -> bool:
        """Whether it is the frame that came before, and not the first one of a program that has been started again.

        Such a program begins its numbers anew, and its first order may be the same as before: it must not be lost. It
        comes from a port that was not there yet, or after the other one has gone, or from the same one after a while.
        """
        first, count, at = before
        if first == number:
            return is_late and now - at <= REPEATED_WITHIN_S
        return first in self._nodes and number <= count and now - at <= DUPLICATE_WINDOW_S

    def _is_echo(self, before: tuple[int, int, float], number: int, now: float) -> bool:
        """Whether the same frame came by another port long ago: by chance, or because it goes round."""
        first, count, at = before
        return first != number and number <= count and now - at <= LOOP_MEMORY_S

    def _is_loop(self, node: Node[PortT], source: int, first: int, now: float) -> bool:
        """Whether what this sender says comes back to a port often enough to be what this hub has passed on."""
        run = node.echoes[source] = min(node.echoes.get(source, 0) + 1, LOOP_RUN)
        if run < LOOP_RUN and now >= node.loop_until:
            return False
        if now >= node.loop_until:
            self._tell("loop", source, node, first)
        node.loop_until = now + LOOP_MEMORY_S
        return True

    def _note_fresh(self, node: Node[PortT], source: int) -> None:
        run = node.echoes.pop(source, 0) - 1
        if run > 0:
            node.echoes[source] = run

    def _tell(self, kind: HubEventKind, source: int, node: Node[PortT], before: int) -> None:
        if self.on_change is not None:
            other = self._nodes.get(before)
            self.on_change(kind, source, node.port, None if other is None else other.port)

    def _note_heartbeat(self, sender: Sender, node: Node[PortT], body: bytes) -> None:
        self._unproven.pop(sender.source, None)
        if sender.note_heartbeat(body):
            self.forget_plans()
        if sender.is_autopilot and node.number not in sender.told:
            sender.told.add(node.number)
            self.forget_plans()
            if self.on_vehicle is not None:
                self.on_vehicle(node.port)
            if sender.number != node.number:
                self._tell("heard_twice", sender.source, node, sender.number)

    # -------------------------------------------------------------------------------------- plans

    def _plan(self, node: Node[PortT], key: int) -> Plan[PortT]:
        message_id, target, source = key >> 32, key >> 16 & 0xFFFF, key & 0xFFFF
        where = target & 0xFF, target >> 8
        name = message_id << 16 | source
        if message_id == _SETUP_SIGNING:
            return Plan(name, message_id, where, reason="secret")
        if where[0]:
            found = self._ways_to(*where, source, node.number)
            if not found:
                return Plan(name, message_id, where, reason="no_route")  # not kept: there are many nobodies
        else:
            found = dict.fromkeys(self._nodes)
            if self._targets.is_order(message_id):
                found = {number: None for number in found if not self._would_be_second(number)}
        found.pop(node.number, None)
        if message_id in _RADIOS:
            found = {number: None for number in found if not self._has_autopilot(number)}
        outs, thinned = [], []
        for port in (self._nodes[number].port for number in found):
            period = self._gate(port, message_id)
            if period == 0 or (period is not None and where[0]):
                outs.append(port)
            elif period is not None:
                thinned.append((port, period))
        if len(node.plans) >= MOST_PLANS:
            node.plans.clear()
        plan = node.plans[key] = Plan(name, message_id, where, tuple(outs), tuple(thinned))
        return plan

    def _ways_to(self, system_id: int, component_id: int, source: int, here: int) -> dict[int, None]:
        """Numbers of the ports by which a component, or all of a system, is reached; ``source`` speaks from ``here``.

        Nothing is returned to who says it: a vehicle that is heard at two ports would get its own order by the other.
        """
        me = self._senders.get(source)
        exact = self._senders.get(system_id | component_id << 8) if component_id else None
        if exact is not None:
            return {here: None} if exact is me else dict.fromkeys(exact.ways)
        known = [each for each in self._senders.values() if each.system_id == system_id]
        autopilots = [each for each in known if each.is_autopilot]
        found: dict[int, None] = {}
        for sender in sorted(known, key=lambda each: not each.is_autopilot):
            # Whoever is heard where the autopilot is reached is reached there, too; and where the autopilot is heard as
            # well, it would be given the order a second time.
            is_reached = sender.is_vehicles and any(sender.is_heard_at(number) for number in found)
            if not is_reached:
                found.update(
                    (number, None)
                    for number in ((here,) if sender is me else sender.ways)
                    if sender.is_autopilot or not any(each.is_heard_at(number) for each in autopilots)
                )
        return found

    def _would_be_second(self, number: int) -> bool:
        """Whether the autopilots that are heard at a port are all reached by others."""
        here = [each for each in self._senders.values() if each.is_autopilot and each.is_heard_at(number)]
        return bool(here) and all(each.number != number for each in here)

    def _has_autopilot(self, number: int) -> bool:
        return any(each.is_autopilot and number in each.heard for each in self._senders.values())
