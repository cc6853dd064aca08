"""``Fleet``: all vehicles of one or several networks as one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.wording import shown
from aerokit.connection.bus import Overflow, Subscription
from aerokit.errors import InvalidArgument
from aerokit.events import Event
from aerokit.fleets.actions import Actions, fragments, rtcm_messages
from aerokit.fleets.events import FleetEvent, StateTold, Told
from aerokit.fleets.formations import Formations
from aerokit.fleets.missions import Missions
from aerokit.fleets.shows.flying import Shows

if TYPE_CHECKING:
    from aerokit.connection.bus import Detach, Sink
    from aerokit.fleets.action import Crew

__all__ = ["Fleet", "Selection"]


@checks_arguments
class Selection(Actions, Missions, Formations, Shows):
    """Members that are ordered something in common: ``fleet``, ``fleet.group("alpha")``, ``fleet["north/*"]``.

    Every action goes to all of them at once that take part at that moment (not lost, not taken over), and returns a
    :class:`FleetResult` when each has come to its own end. When one fails, the others are told what the fleet's policy
    says, and the action ends when they have done that. Cancelled, all of them hold at once.
    """

    def __getitem__(self, pattern: str) -> Selection:
        found = self._crew.matching(pattern)
        return Selection(self._crew, tuple(name for name in found if name in self.members))

    def group(self, name: str) -> Selection:
        """Those of one group.

        Raises:
            InvalidArgument: there is no such group.
        """
        return self._those("group", name)

    def role(self, name: str) -> Selection:
        """Those with one role.

        Raises:
            InvalidArgument: nobody has it.
        """
        return self._those("role", name)

    def _those(self, what: str, name: str) -> Selection:
        found = tuple(each.name for each in self if getattr(each, what) == name)
        if not found:
            there = dict.fromkeys(getattr(each, what) for each in self if getattr(each, what))
            those = f"the {what}s are {', '.join(there)}" if there else f"there are no {what}s"
            raise InvalidArgument(f"{what} = {shown(name)} is not allowed: {those}")
        return Selection(self._crew, found)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self)}: {', '.join(self.members)}>"


@checks_arguments
class Fleet(Selection):
    """Made by :func:`aerokit.fleet`, for the time of its block. A selection of all, and what only the whole has."""

    def __init__(self, crew: Crew) -> None:
        super().__init__(crew, None)
        self._rtcm_sequence = 0

    def __contains__(self, name: object) -> bool:
        return name in self._crew.members

    def take_back(self, name: str) -> None:
        """Order a member again that a pilot, a failsafe or another program had taken over, or that was let go.

        Nothing is sent: the next action goes to it, too. **Ask the pilot first.**

        Raises:
            InvalidArgument: there is no such member.
        """
        for each in self._crew.matching(name):
            self._crew.members[each].take_back()

    def let_go(self, name: str, why: str = "the program let it go") -> None:
        """Order a member nothing any more, until :meth:`take_back`. Nothing is sent: it goes on with what it does.

        Raises:
            InvalidArgument: there is no such member.
        """
        for each in self._crew.matching(name):
            self._crew.members[each].leave(why)

    def send_corrections(self, rtcm: bytes) -> int:
        """Send RTCM corrections (RTK, DGPS) to all of them: once for each link, whoever is on it (GPS_RTCM_DATA).

        Args:
            rtcm: one or more RTCM 3 messages, each of 720 bytes at most.

        Returns:
            How many messages were sent on each link.

        Raises:
            InvalidArgument: one is longer, or there is none. Nothing was sent.
            ConnectionClosed, LinkLost: a link has ended; the others before it have got them.
        """
        pieces = [
            piece
            for number, message in enumerate(rtcm_messages(rtcm) if rtcm else [b""], self._rtcm_sequence)
            for piece in fragments(message, number)
        ]
        self._rtcm_sequence += len({piece.flags >> 3 for piece in pieces})
        links = {id(each): each for each in self._crew.networks.values()}
        for connection in links.values():
            for piece in pieces:
                connection.send(piece)
        return len(pieces)

    # -------------------------------------------------------------------------------------- streams

    def events(
        self,
        *types: type[Event],
        capacity: int = 1000,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[FleetEvent]:
        """One stream of what happens to all of them, for use in a ``with`` block.

        Args:
            *types: events of the fleet (``MemberLost``, ``PolicyCarriedOut`` …), and of vehicles (``ModeChanged`` …),
                which come as :class:`Told` with the member's name. None: all of both.
            capacity: how many may wait to be read.
            overflow: what happens to one that finds no place; ``missed`` of the stream counts them.

        Raises:
            InvalidArgument: a type is no event.
        """
        wanted: tuple[type[Event], ...] = types or (FleetEvent, Event)

        def attach(sink: Sink) -> list[Detach]:
            detach: list[Detach] = []
            for each in wanted:
                if issubclass(each, FleetEvent):
                    detach.append(self._crew.bus.attach_event(each, sink))
                if each is Told or not issubclass(each, FleetEvent):
                    detach += self._attach_told(Event if each is Told else each, sink)
            return detach

        return Subscription(attach, capacity=capacity, overflow=overflow)

    def states(
        self,
        *names: str,
        every_arrival: bool = False,
        capacity: int = 10_000,
        overflow: Overflow = "drop_oldest",
    ) -> Subscription[StateTold]:
        """One stream of states of all of them, for use in a ``with`` block.

        Args:
            *names: of docs/states.md: ``"position"``, ``"batteries"`` …
            every_arrival: also what is told again without having changed.
            capacity: how many may wait to be read.
            overflow: what happens to one that finds no place; ``missed`` of the stream counts them.

        Raises:
            InvalidArgument: there is no such state, or none is named.
        """
        for member in self:
            for name in names or ("",):
                if name not in member.vehicle.telemetry.cells:
                    raise InvalidArgument(f"names: {shown(name)} is no state; docs/states.md has them")

        def attach(sink: Sink) -> list[Detach]:
            detach: list[Detach] = []
            for member in self:
                for name in names:
                    tell = partial(
                        _tell_state, sink, self._crew.now, member.name, member.vehicle.system_id, name
                    )
                    cell = member.vehicle.telemetry.cells[name]
                    detach.append(cell.observe(tell, every_arrival=every_arrival))
            return detach

        return Subscription(attach, capacity=capacity, overflow=overflow)

    def _attach_told(self, kind: type[Event], sink: Sink) -> list[Detach]:
        names = {
            (member.network, member.vehicle.system_id): member.name for member in self._crew.members.values()
        }

        def tell(network: str, event: Event) -> None:
            member = names.get((network, event.system_id)) if event.system_id else network
            if member is not None:
                sink(Told(event.at, event.system_id, member, event))

        return [
            connection.bus.attach_event(kind, partial(tell, network))
            for network, connection in self._crew.networks.items()
        ]


def _tell_state(
    sink: Sink, now: Callable[[], float], member: str, system_id: int, name: str, _: Any, value: Any
) -> None:
    sink(StateTold(now(), system_id, member, name, value))
