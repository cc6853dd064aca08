"""``Fleet`` and ``Selection``: the API of all or some members."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit.connection.bus import Overflow, Subscription
from aerokit.errors import AerokitError, ConnectionClosed, InvalidArgument, LinkLost
from aerokit.events import Event
from aerokit.fleets.actions import Actions
from aerokit.fleets.events import FleetEvent, MemberEvent, StateUpdate
from aerokit.fleets.formation import Formations
from aerokit.fleets.show_flight import Shows
from aerokit.fleets.travel import Missions
from aerokit.protocols.rtcm import rtcm_messages
from aerokit.vehicle.rtk.rtk import send_rtcm

if TYPE_CHECKING:
    from aerokit.connection.bus import Detach, Sink
    from aerokit.fleets.action import FleetContext
    from aerokit.fleets.members import Member

__all__ = ["Fleet", "Selection"]


@checks_arguments
class Selection(Actions, Missions, Formations, Shows):
    """Some members of a fleet: ``fleet.group("alpha")``, ``fleet["north/*"]``.

    Every action runs on all available members at once. A member is available unless it is lost, taken over or released.
    The action returns a :class:`FleetResult` when all these members have finished or failed. If a member fails, the
    fleet's policy may send orders to the other members; then the action returns after these orders were executed.

    If an action is cancelled, all members hold. Exceptions are ``arm``, ``wait_ready``, ``upload``, and actions that
    end the flight or make members hold.
    """

    def __getitem__(self, pattern: str) -> Selection:
        matching = self._context.matching(pattern)
        return Selection(self._context, tuple(name for name in matching if name in self.members))

    def group(self, name: str) -> Selection:
        """Select the members of one group.

        Raises:
            InvalidArgument: there is no such group.
        """
        return self._select("group", name)

    def role(self, name: str) -> Selection:
        """Select the members with this role.

        Raises:
            InvalidArgument: no member has this role.
        """
        return self._select("role", name)

    def _select(self, attribute: str, value: str) -> Selection:
        selected = tuple(member.name for member in self if getattr(member, attribute) == value)
        if not selected:
            existing = dict.fromkeys(getattr(member, attribute) for member in self if getattr(member, attribute))
            allowed = f"the {attribute}s are {', '.join(existing)}" if existing else f"there are no {attribute}s"
            raise InvalidArgument(f"{attribute} = {short_repr(value)} is not allowed: {allowed}")
        return Selection(self._context, selected)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self)}: {', '.join(self.members)}>"


@checks_arguments
class Fleet(Selection):
    """A fleet with all its members. :func:`aerokit.fleet` yields the fleet; it can be used only inside the block."""

    def __init__(self, context: FleetContext) -> None:
        super().__init__(context, None)

    def __contains__(self, name: object) -> bool:
        return name in self._context.members

    def reclaim(self, name: str) -> None:
        """Make members available again after they were taken over or released.

        Sends nothing. The next action includes these members. **Ask the pilot first.**

        Args:
            name: a member's name or a pattern.

        Raises:
            InvalidArgument: no member matches.
        """
        for member_name in self._context.matching(name):
            self._context.members[member_name].reclaim()

    def release(self, name: str, reason: str = "released by the program") -> None:
        """Exclude members from new actions until :meth:`reclaim`. Nothing is sent, and running actions continue.

        If a released member then fails in a running action, the policy sends no orders. The followers of a released
        leader hold, because the fleet no longer knows who flies the leader.

        Args:
            name: a member's name or a pattern.
            reason: text for ``Member.reason`` and for results.

        Raises:
            InvalidArgument: no member matches.
        """
        for member_name in self._context.matching(name):
            self._context.members[member_name].release(reason)

    def send_corrections(self, rtcm: bytes) -> int:
        """Send RTCM corrections (RTK, DGPS) as GPS_RTCM_DATA, once on each link.

        Args:
            rtcm: one or more complete RTCM 3 messages of at most 720 bytes each.

        Returns:
            The number of MAVLink messages sent on one link; if it differs between links, the largest number. A link
            does not get corrections that another sender has just sent on this link.

        Raises:
            InvalidArgument: a message is incomplete, damaged or too long, or ``rtcm`` is empty. Nothing was sent.
            ConnectionClosed, LinkLost: a link has ended. The other links got the corrections.
        """
        messages = rtcm_messages(rtcm)
        count = 0
        link_error: AerokitError | None = None
        for connection in dict.fromkeys(self._context.networks.values()):
            try:
                # `send_rtcm` leaves out a message that another sender has just sent on the same link.
                count = max(count, sum(send_rtcm(connection, message, self) for message in messages))
            except (ConnectionClosed, LinkLost) as error:
                link_error = error
        if link_error is not None:
            raise link_error
        return count

    # -------------------------------------------------------------------------------------- streams

    def events(
        self, *types: type[Event], capacity: int = 1000, overflow: Overflow = "drop_oldest"
    ) -> Subscription[FleetEvent]:
        """Subscribe to events of the fleet and its vehicles; use it in a ``with`` block.

        Args:
            *types: events of the fleet (``MemberLost``, ``PolicyCompleted`` …) and of vehicles (``ModeChanged`` …).
                Events of vehicles arrive as :class:`MemberEvent` with the member's name. Without arguments: all events.
            capacity: maximum number of unread events.
            overflow: what happens to an event when ``capacity`` is reached. ``Subscription.missed`` counts dropped
                events.

        Raises:
            InvalidArgument: a type is not an event.
        """
        event_types: tuple[type[Event], ...] = types or (FleetEvent, MemberEvent)

        def attach(sink: Sink) -> list[Detach]:
            detachments: list[Detach] = []
            for event_type in event_types:
                # The fleet's bus has only the fleet's own events. Each connection's bus has the events of its vehicles.
                is_fleet_event = issubclass(event_type, FleetEvent) and event_type is not MemberEvent
                if is_fleet_event or event_type is Event:
                    detachments.append(self._context.bus.attach_event(event_type, sink))
                if not is_fleet_event:
                    vehicle_event_type = Event if event_type is MemberEvent else event_type
                    detachments += self._attach_member_events(vehicle_event_type, sink)
            return detachments

        return Subscription(attach, capacity=capacity, overflow=overflow)

    def states(
        self, *names: str, every_arrival: bool = False, capacity: int = 10_000, overflow: Overflow = "drop_oldest"
    ) -> Subscription[StateUpdate]:
        """Subscribe to states of all members; use it in a ``with`` block.

        Args:
            *names: names of states (docs/states.md), such as ``"position"`` and ``"batteries"``.
            every_arrival: also report a value that arrives unchanged.
            capacity: maximum number of unread updates.
            overflow: what happens to an update when ``capacity`` is reached. ``Subscription.missed`` counts dropped
                updates.

        Raises:
            InvalidArgument: a name is unknown, or none is given.
        """
        if not names:
            raise InvalidArgument("names = () is not allowed: give the name of at least one state (docs/states.md)")
        for member in self:
            for name in names:
                if name not in member.vehicle.telemetry.cells:
                    raise InvalidArgument(f"names: {short_repr(name)} is not a state; docs/states.md lists them")

        def attach(sink: Sink) -> list[Detach]:
            def publish(member: Member, state: str, _: object, value: object) -> None:
                sink(StateUpdate(self._context.now(), member.vehicle.system_id, member.name, state, value))

            detachments: list[Detach] = []
            for member in self:
                for name in names:
                    cell = member.vehicle.telemetry.cells[name]
                    detachments.append(cell.observe(partial(publish, member, name), every_arrival=every_arrival))
            return detachments

        return Subscription(attach, capacity=capacity, overflow=overflow)

    def _attach_member_events(self, event_type: type[Event], sink: Sink) -> list[Detach]:
        members = self._context.members.values()
        member_names = {(member.network, member.vehicle.system_id): member.name for member in members}

        def publish(network: str, event: Event) -> None:
            is_about_link = event.system_id == 0
            name = network if is_about_link else member_names.get((network, event.system_id))
            if name is not None:  # A vehicle that is not a member has no name, and its events are not passed on.
                sink(MemberEvent(event.at, event.system_id, name, event))

        return [
            connection.bus.attach_event(event_type, partial(publish, network))
            for network, connection in self._context.networks.items()
        ]
