"""``Router``: decides where frames go, by MAVLink's rules (https://mavlink.io/en/guide/routing.html). Sans-IO.

The plan for a message, sender and target is cached, so that a frame costs a few look-ups. The cache is cleared when
senders or ports are added, removed or moved.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.connection.routes import MAX_ROUTES, PEER_TTL_S, SWEEP_INTERVAL_S
from aerokit.hub.senders import (
    DUPLICATE_WINDOW_S,
    LOOP_WINDOW_S,
    MAX_RECENT_FRAMES,
    MIN_LOOP_FRAMES,
    NEW_PORT_WINDOW_S,
    REPEAT_WINDOW_S,
    RecentFrames,
    Sender,
    is_autopilot,
)
from aerokit.mavlink.frame import RADIO_MESSAGE_IDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.hub.message_rules import TargetFields
    from aerokit.hub.senders import FrameRecord
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.frame import Frame

PortT = TypeVar("PortT")

MAX_PLANS = 4096
"""Maximum number of cached routing plans per port."""

_HEARTBEAT = 0
_SETUP_SIGNING = 256
_UNKNOWN_SENDER = Sender(0, 0, -math.inf)


class ForwardingPlan(Generic[PortT]):
    """Cached routing decision for all frames with the same message, sender, port and target."""

    __slots__ = ("identity", "is_plain", "key", "message_id", "outs", "rate_limited", "reason", "sender", "target")

    def __init__(
        self,
        key: int,
        message_id: int,
        target: tuple[int, int],
        outs: tuple[PortT, ...] = (),
        rate_limited: tuple[tuple[PortT, float], ...] = (),
        reason: str = "",
        sender: Sender = _UNKNOWN_SENDER,
    ) -> None:
        self.key: int = key
        """Number that identifies sender and message; the same for all targets."""
        self.message_id: int = message_id
        self.target: tuple[int, int] = target
        """System id and component id; 0 means all."""
        self.outs: tuple[PortT, ...] = outs
        """Ports that get each frame. Plans of one port use the same object for equal tuples, so `is` compares them."""
        self.rate_limited: tuple[tuple[PortT, float], ...] = rate_limited
        """(port, interval in seconds) of ports with a rate limit, which get at most one frame per interval."""
        self.reason: str = reason
        """Reason for dropping the frames, a key of `EndpointStatistics.dropped`; "" if there is none."""
        self.is_plain: bool = not (rate_limited or reason)
        """True if each frame goes to `outs`, and nothing else is to be done."""
        self.sender: Sender = sender
        """The sender of the frames; used in the plans of `Ingress.streams`."""
        self.identity: int = sender.source << 24
        """The sender's part of the numbers in `RecentFrames`."""


class Ingress(Generic[PortT]):
    """Data of the router for the frames that arrive at one port."""

    __slots__ = ("destinations", "echoes", "loop_until", "number", "plans", "port", "streams")

    def __init__(self, port: PortT, number: int) -> None:
        self.port: PortT = port
        self.number: int = number
        """Unique number above 0."""
        self.plans: dict[int, ForwardingPlan[PortT]] = {}
        """Maps message id, target and sender (as one number) to the plan for frames that arrive at this port."""
        self.streams: dict[bytes, ForwardingPlan[PortT]] = {}
        """Plans for messages without a target field, from senders whose port this is; not for HEARTBEAT.

        The keys are bytes 4 to 8 of `Frame.body`: system id, component id and message id.
        """
        self.destinations: dict[tuple[PortT, ...], tuple[PortT, ...]] = {}
        """Maps each tuple of ports to the equal tuple that all plans use."""
        self.echoes: dict[int, int] = {}
        """Maps senders to a count, 0 to `MIN_LOOP_FRAMES`: a returning frame adds 1, a new frame subtracts 1."""
        self.loop_until: float = -math.inf
        """Returning frames are dropped until this time."""

    def forget_plans(self) -> None:
        self.plans.clear()
        self.streams.clear()
        self.destinations.clear()


class Router(Generic[PortT]):
    """Learns at which ports each sender is received, and plans the destinations of frames.

    - A broadcast goes to all other ports. A broadcast command skips a port if all autopilots there get it through
      another port.
    - A message for a component goes to the ports at which the component was received. If the component is unknown, the
      message goes to the ports of its system. If the system is unknown, the message is dropped.
    - A vehicle that is received at several ports gets messages through the first one, so that no command arrives twice.
      When the vehicle is silent at that port for 3.5 s, another port takes its place.
    - A message for a whole system goes to the port of its autopilot, and to each port at which only other components of
      the system were received.
    - Ground stations that share ids all get the messages for these ids. An autopilot has priority over other senders
      with its ids. Before its first HEARTBEAT, a sender counts as a vehicle for 3.5 s.
    - A frame never goes back to the port at which it arrived. A copy that arrives at another port within two seconds is
      dropped (at a new port: within 0.1 s). Later copies are forwarded until several of them show that the ports form a
      loop.
    - SETUP_SIGNING, which contains a key, is not forwarded. Status messages of telemetry radios do not go to vehicles.

    At most `MAX_ROUTES` senders are remembered. A new sender replaces a sender without heartbeats, or a sender that was
    silent for `PEER_TTL_S`. If there is none, messages for the new sender are dropped.

    ``min_interval(port, message_id)`` returns the minimum interval of a message at a port in seconds: None if the
    message does not go there, 0 without a limit. The interval applies per sender, to broadcasts only.
    """

    def __init__(self, targets: TargetFields, min_interval: Callable[[PortT, int], float | None]) -> None:
        self._targets, self._min_interval = targets, min_interval
        self._offsets = targets.offsets
        self._ingresses: dict[int, Ingress[PortT]] = {}  # by port number
        self._senders: dict[int, Sender] = {}  # by system id + 256 · component id
        self._recent = RecentFrames()
        self._newest_port = 0  # number of the last created port
        self._without_heartbeat: dict[int, None] = {}  # keys: senders without a HEARTBEAT, oldest first
        self._swept_at = -math.inf  # time of the last removal of silent senders
        self._duplicate: ForwardingPlan[PortT] = ForwardingPlan(0, -1, (0, 0), reason="duplicate")
        self._loop: ForwardingPlan[PortT] = ForwardingPlan(0, -1, (0, 0), reason="loop")
        self._unknown: ForwardingPlan[PortT] = ForwardingPlan(0, -1, (0, 0), reason="unknown")
        self.on_autopilot: Callable[[PortT], object] | None = None
        """Called when an autopilot is received at a port for the first time."""
        self.on_change: Callable[[HubEventKind, tuple[int, int], PortT, PortT | None], object] | None = None
        """Called with the kind of event, the system id and component id of the sender, the port of the frame, and
        another port at which the sender was received; None if this port was removed since."""

    def add(self, port: PortT) -> Ingress[PortT]:
        self._newest_port += 1
        ingress = self._ingresses[self._newest_port] = Ingress(port, self._newest_port)
        self.forget_plans()
        return ingress

    def remove(self, ingress: Ingress[PortT]) -> None:
        if self._ingresses.pop(ingress.number, None) is not None:
            for key in [key for key, sender in self._senders.items() if sender.remove_port(ingress.number)]:
                del self._senders[key]
                self._without_heartbeat.pop(key, None)
            self.forget_plans()

    def forget_plans(self) -> None:
        for ingress in self._ingresses.values():
            ingress.forget_plans()

    @property
    def ports(self) -> Iterable[PortT]:
        return (ingress.port for ingress in self._ingresses.values())

    def exclude_pause(self, now: float, paused_s: float) -> None:
        for sender in self._senders.values():
            sender.exclude_pause(now, paused_s)

    def senders_at(self, ingress: Ingress[PortT]) -> list[tuple[int, int]]:
        return sorted(
            (sender.system_id, sender.component_id)
            for sender in self._senders.values()
            if ingress.number in sender.ports
        )

    def route_all(
        self, ingress: Ingress[PortT], frames: list[Frame], now: float, out_of_order: list[Frame]
    ) -> list[ForwardingPlan[PortT]]:
        """Return the plans for frames received together, of which some may have arrived ``out_of_order``."""
        # This is the hot path for new frames of known streams. `route` processes frames that are out of order or may
        # return in a loop, and all frames while the tables of recent frames are full or have expired.
        recent, streams, port_number = self._recent, ingress.streams, ingress.number
        must_rotate = now >= recent.rotate_at or len(recent.newer) + len(frames) > MAX_RECENT_FRAMES
        if out_of_order or ingress.echoes or must_rotate:
            return [self.route(ingress, frame, now, is_out_of_order=frame in out_of_order) for frame in frames]
        newer, older, plans = recent.newer, recent.older, []
        record = port_number, self._newest_port, now
        for frame in frames:
            body = frame.body
            plan = streams.get(body[4:9])  # system id, component id and message id
            if plan is not None:
                identity = plan.identity | body[3] << 16 | frame.checksum  # body[3] is the sequence number.
                is_new = identity not in newer and identity not in older
                # The first item of a record is the port of the earlier frame. A frame from the same port is no copy,
                # because its sequence number and checksum are equal by chance.
                if is_new or (newer.get(identity) or older[identity])[0] == port_number:
                    newer[identity] = record
                    plan.sender.received_at = now
                    plans.append(plan)
                    continue
            plans.append(self.route(ingress, frame, now))
            if ingress.echoes:
                # A frame came back. From now on, `route` must process every frame, because it counts returning and new
                # frames in `echoes` to detect a loop.
                streams = {}
        return plans

    def route(
        self, ingress: Ingress[PortT], frame: Frame, now: float, *, is_out_of_order: bool = False
    ) -> ForwardingPlan[PortT]:
        """Return the plan for a frame received at ``ingress``."""
        # Hot path. Sender and target are numbers: system id + 256 · component id. The sequence number and the sender's
        # ids are the bytes 3 to 5 of `Frame.body`.
        body, message_id = frame.body, frame.message_id
        source = body[4] | body[5] << 8
        sender = self._senders.get(source)
        if sender is None:
            if message_id not in self._offsets and self._targets.is_unknown(message_id):
                return self._unknown  # The checksum of an unknown message cannot be checked, so the frame may be noise.
            sender = self._add_sender(source, ingress, now, may_store=message_id not in RADIO_MESSAGE_IDS)
        number, recent = ingress.number, self._recent
        if now >= recent.rotate_at or len(recent.newer) >= MAX_RECENT_FRAMES:
            recent.rotate(now)
        identity = source << 24 | body[3] << 16 | frame.checksum
        earlier = recent.newer.get(identity) or recent.older.get(identity)
        if earlier is None:
            recent.newer[identity] = number, self._newest_port, now
            if ingress.echoes:
                self._record_new_frame(ingress, source)
        else:
            refusal = self._check_equal_frame(ingress, identity, earlier, now, is_out_of_order=is_out_of_order)
            if refusal is not None:
                return refusal
        if sender.port_number == number:
            sender.received_at = now
        elif message_id not in RADIO_MESSAGE_IDS:  # Anyone can forge these messages, so they make and move no route.
            # An autopilot has priority over other senders with its ids, so its first HEARTBEAT moves the route at once.
            must_move = message_id == _HEARTBEAT and not sender.is_autopilot and is_autopilot(body)
            self._record_at_other_port(sender, ingress, now, must_move)
        if not message_id:  # HEARTBEAT
            self._record_heartbeat(sender, ingress, body)
        # The following lines are `TargetFields.target_of` without its calls, which take longer.
        try:
            offsets = self._offsets[message_id]
        except KeyError:
            offsets = self._targets.look_up(message_id)
        target = 0
        if offsets is not None:
            size = len(body)
            system_offset, component_offset = offsets
            if system_offset < size:
                target = body[system_offset]
                if component_offset < size:
                    target |= body[component_offset] << 8
        key = message_id << 32 | target << 16 | source
        try:
            return ingress.plans[key]
        except KeyError:
            return self._add_plan(ingress, key)

    # ------------------------------------------------------------------------------------ senders

    def _add_sender(self, source: int, ingress: Ingress[PortT], now: float, *, may_store: bool) -> Sender:
        sender = Sender(source, ingress.number, now)
        if may_store and (len(self._senders) < MAX_ROUTES or self._make_room(now)):
            self._senders[source] = sender
            self._without_heartbeat[source] = None
            self.forget_plans()
        return sender

    def _make_room(self, now: float) -> bool:
        if self._without_heartbeat:
            source = next(iter(self._without_heartbeat))
            del self._without_heartbeat[source], self._senders[source]
        elif now - self._swept_at >= SWEEP_INTERVAL_S:
            self._swept_at = now
            expired = [key for key, sender in self._senders.items() if now - sender.received_at > PEER_TTL_S]
            for source in expired:
                del self._senders[source]
        return len(self._senders) < MAX_ROUTES

    def _record_at_other_port(self, sender: Sender, ingress: Ingress[PortT], now: float, must_move: bool) -> None:
        former_number = sender.port_number
        if sender.record_at_other_port(ingress.number, now, must_move):
            self.forget_plans()
        if sender.is_autopilot and sender.port_number != former_number:
            self._report("route_changed", sender.source, ingress, former_number)

    def _check_equal_frame(
        self, ingress: Ingress[PortT], identity: int, earlier: FrameRecord, now: float, *, is_out_of_order: bool
    ) -> ForwardingPlan[PortT] | None:
        """Return the plan that drops a frame, which equals an ``earlier`` one; None if it is to be forwarded."""
        number, newer = ingress.number, self._recent.newer
        first_port, newest_port, received_at = earlier
        age_s = now - received_at
        if first_port == number:
            # A restarted program numbers its frames from the start again, so its first command may equal an earlier
            # frame. A frame that was received at the same port and in sequence is therefore no copy.
            is_copy = is_out_of_order and age_s <= REPEAT_WINDOW_S
            may_be_echo = False
        else:
            # A port that was added after the earlier frame arrived cannot have returned it.
            may_be_echo = number <= newest_port and age_s <= LOOP_WINDOW_S
            # The frame may be a copy nevertheless: if the sender transmits every frame over two links, the first copy
            # over the second link is what adds that link's port (a new UDP peer), right after the earlier frame.
            max_age_s = DUPLICATE_WINDOW_S if may_be_echo else NEW_PORT_WINDOW_S
            is_copy = first_port in self._ingresses and age_s <= max_age_s
        if is_copy:
            return self._duplicate
        # A late frame may have returned through a slow loop, or may equal the earlier frame by chance, like the first
        # command of a restarted program. It is forwarded until several frames prove a loop.
        source = identity >> 24
        if may_be_echo and self._record_echo(ingress, source, first_port, now):
            return self._loop
        newer[identity] = (first_port, newest_port, now) if may_be_echo else (number, self._newest_port, now)
        return None

    def _record_echo(self, ingress: Ingress[PortT], source: int, first_port: int, now: float) -> bool:
        """Count a returning frame. Return True while a loop is proven."""
        count = min(ingress.echoes.get(source, 0) + 1, MIN_LOOP_FRAMES)
        ingress.echoes[source] = count
        if now >= ingress.loop_until:  # No loop is known at this port.
            if count < MIN_LOOP_FRAMES:
                return False
            self._report("loop", source, ingress, first_port)
        ingress.loop_until = now + LOOP_WINDOW_S
        return True

    def _record_new_frame(self, ingress: Ingress[PortT], source: int) -> None:
        # Each new frame cancels a returning frame in the count, so that single echoes do not count as a loop.
        count = ingress.echoes.pop(source, 0) - 1
        if count > 0:
            ingress.echoes[source] = count

    def _report(self, kind: HubEventKind, source: int, ingress: Ingress[PortT], other_number: int) -> None:
        if self.on_change is not None:
            other = self._ingresses.get(other_number)
            ids = source & 0xFF, source >> 8
            self.on_change(kind, ids, ingress.port, None if other is None else other.port)

    def _record_heartbeat(self, sender: Sender, ingress: Ingress[PortT], body: bytes) -> None:
        is_first = sender.source in self._without_heartbeat
        self._without_heartbeat.pop(sender.source, None)
        # A HEARTBEAT at another port may come from a second sender with the same ids. It must not turn a vehicle into a
        # ground station.
        if (is_first or sender.port_number == ingress.number) and sender.record_heartbeat(body):
            self.forget_plans()
        if sender.is_autopilot and ingress.number not in sender.autopilot_ports:
            sender.autopilot_ports.add(ingress.number)
            self.forget_plans()
            if self.on_autopilot is not None:
                self.on_autopilot(ingress.port)
            if sender.port_number != ingress.number:  # The autopilot was received at another port before.
                self._report("duplicate_sender", sender.source, ingress, sender.port_number)

    # -------------------------------------------------------------------------------------- plans

    def _add_plan(self, ingress: Ingress[PortT], key: int) -> ForwardingPlan[PortT]:
        """Make the plan for a key of `Ingress.plans`, and cache it."""
        if len(ingress.plans) >= MAX_PLANS:
            ingress.forget_plans()
        plan = self._make_plan(ingress, key)
        if plan.reason:  # Not cached, because a sender could fill the cache with unknown targets.
            return plan
        system_id, _ = plan.target
        if system_id and any(sender.may_become_vehicle for sender in self._senders_of(system_id)):
            return plan  # Not cached: the plan changes without `forget_plans` when the sender is no longer new.
        ingress.plans[key] = plan
        # The fast path of `route_all` is only for messages without a target. Heartbeats, and frames at another port
        # than the sender's, may change the data about the sender, so `route` must process them.
        message_id, source = plan.message_id, key & 0xFFFF
        has_target_field = self._offsets.get(message_id) is not None
        if message_id != _HEARTBEAT and plan.sender.port_number == ingress.number and not has_target_field:
            ingress.streams[source.to_bytes(2, "little") + message_id.to_bytes(3, "little")] = plan
        return plan

    def _make_plan(self, ingress: Ingress[PortT], key: int) -> ForwardingPlan[PortT]:
        message_id, target, source = key >> 32, key >> 16 & 0xFFFF, key & 0xFFFF
        ids = system_id, component_id = target & 0xFF, target >> 8
        stream_key = message_id << 16 | source
        sender = self._senders.get(source, _UNKNOWN_SENDER)
        if message_id == _SETUP_SIGNING:
            return ForwardingPlan(stream_key, message_id, ids, reason="secret")
        has_target = system_id != 0
        numbers = list(self._ingresses)
        if has_target:
            numbers = self._port_numbers_of_target(system_id, component_id, sender, ingress.number)
            if not numbers:
                return ForwardingPlan(stream_key, message_id, ids, reason="no_route")
        elif self._targets.is_command(message_id):
            numbers = [number for number in numbers if not self._is_redundant(number, sender)]
        # The radio's status is not sent to autopilots, because an autopilot adapts its message rates to any radio.
        if message_id in RADIO_MESSAGE_IDS:
            numbers = [number for number in numbers if not self._has_autopilot(number)]
        outs, rate_limited = [], []
        for number in numbers:
            if number == ingress.number:  # A frame never goes back to the port at which it arrived.
                continue
            port = self._ingresses[number].port
            interval_s = self._min_interval(port, message_id)
            if interval_s is None:
                continue
            if interval_s == 0 or has_target:  # Rate limits do not apply to messages with a target.
                outs.append(port)
            else:
                rate_limited.append((port, interval_s))
        # Equal tuples become the same object, so that plans can be compared by identity.
        shared_outs = ingress.destinations.setdefault(tuple(outs), tuple(outs))
        return ForwardingPlan(stream_key, message_id, ids, shared_outs, tuple(rate_limited), sender=sender)

    def _port_numbers_of_target(
        self, system_id: int, component_id: int, sender: Sender, ingress_number: int
    ) -> list[int]:
        """Return the ports for a message from ``sender`` to a component, or to a whole system (component 0).

        An empty list means that the target is unknown. If the target is the sender itself, the list has
        ``ingress_number``; the caller then drops the message without reporting an unknown target.
        """
        target = self._senders.get(system_id | component_id << 8) if component_id else None
        if target is not None:
            return [ingress_number] if target is sender else list(target.destinations)
        # A message for an unknown component goes to its whole system, to its autopilots first.
        components = self._senders_of(system_id)
        components.sort(key=lambda component: not component.is_autopilot)
        autopilots = [component for component in components if component.is_autopilot]
        numbers: list[int] = []
        for component in components:
            # A vehicle needs no further port if one of the chosen ports reaches it.
            is_reached = component.has_one_destination and any(component.is_at(number) for number in numbers)
            if is_reached:
                continue
            destinations = (ingress_number,) if component is sender else component.destinations
            for number in destinations:
                # A port at which an autopilot is received is left out for other components, because the autopilot would
                # get the command twice.
                reaches_autopilot = any(autopilot.is_at(number) for autopilot in autopilots)
                if number not in numbers and (component.is_autopilot or not reaches_autopilot):
                    numbers.append(number)
        return numbers

    def _senders_of(self, system_id: int) -> list[Sender]:
        return [sender for sender in self._senders.values() if sender.system_id == system_id]

    def _is_redundant(self, number: int, sender: Sender) -> bool:
        """Return True if all autopilots at a port get a broadcast command through other ports, or if one sent it."""
        autopilots = [member for member in self._senders.values() if member.is_autopilot and member.is_at(number)]
        if not autopilots:
            return False
        return sender in autopilots or all(autopilot.port_number != number for autopilot in autopilots)

    def _has_autopilot(self, number: int) -> bool:
        return any(sender.is_autopilot and number in sender.ports for sender in self._senders.values())
