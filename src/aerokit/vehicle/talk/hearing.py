"""``Hearing``: what one component says, in subscriptions and cells, at the rates that it is asked for."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.mavlink.message import Message
from aerokit.runtime.cells import Source, StateCell
from aerokit.runtime.subscription import Overflow, Subscription
from aerokit.vehicle.talk.rates import check_rate, subscription_rate_hz

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.bus import Detach, Sink
    from aerokit.runtime.connection import Connection
    from aerokit.runtime.events import Event
    from aerokit.vehicle.talk.rates import MessageRates

__all__ = ["Hearing"]

ItemT = TypeVar("ItemT", bound="Message | Event")
MessageT = TypeVar("MessageT", bound=Message)


class Hearing:
    """Listens to one component for a program. ``keep`` has a cell end with the talk, ``at_close`` what listens."""

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        rates: MessageRates,
        *,
        keep: Callable[[StateCell[Any]], None],
        at_close: Callable[[Detach], None],
    ) -> None:
        self._connection, self._rates = connection, rates
        self._system_id, self._component_id = system_id, component_id
        self._keep, self._at_close = keep, at_close
        self._cells: dict[type[Message], StateCell[Any]] = {}
        self._cell_rates: dict[type[Message], Detach] = {}

    def subscribe(
        self,
        types: tuple[type[ItemT], ...],
        capacity: int,
        overflow: Overflow,
        rate_hz: float | None,
        *,
        whole_system: bool = False,
    ) -> Subscription[ItemT]:
        """Messages of this component, or of the ``whole_system``, and events; this component is asked for rates."""
        self._connection.check_types(types)
        messages: list[type[Message]] = [each for each in types if issubclass(each, Message)]
        if rate_hz is not None:
            for message in messages:
                check_rate(message, rate_hz)

        def attach(sink: Sink) -> list[Detach]:
            wanted = sink if whole_system else self._only(sink)
            detach = self._connection.attach(types, wanted, system_id=self._system_id)
            detach.append(self._connection.on_end(subscription.close))
            for each in messages:
                hz = subscription_rate_hz(each) if rate_hz is None else rate_hz
                if hz is not None:
                    detach.append(self._rates.want(each, hz))
            return detach

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        subscription._explain_timeout = lambda: self._connection.describe_signatures(self._system_id)
        return subscription

    def cell(self, message_type: type[MessageT], rate_hz: float | None) -> StateCell[MessageT]:
        """The latest message of a kind from this component: the same cell each time, at the rate asked for last."""
        cell = self._cells.get(message_type)
        if cell is None:
            self._connection.check_types((message_type,))
            cell = self._cells[message_type] = self._new_cell(message_type)
            self._keep(cell)
            rate_hz = subscription_rate_hz(message_type) if rate_hz is None else rate_hz
        if rate_hz is not None:
            release = self._cell_rates.pop(message_type, None)
            self._cell_rates[message_type] = self._rates.want(message_type, rate_hz)
            if release is not None:
                release()
        return cell

    def listen(self, message_type: type[MessageT], take: Callable[[MessageT], object]) -> None:
        """Have its messages of a kind given to ``take``, if the dialect has them, until the vehicle is let go."""
        bus = self._connection.bus
        if bus.dialect.get(message_type.ID) is not None:
            self._at_close(bus.attach(message_type, self._only(take), system_id=self._system_id))

    def _new_cell(self, message_type: type[Message]) -> StateCell[Any]:
        arrived_at = math.nan
        cell: StateCell[Any] = StateCell(
            message_type.NAME, self._connection.now, message_type.NAME, stamp=lambda: arrived_at
        )
        source = Source(self._system_id, self._component_id, message_type.NAME)

        def take(message: Message) -> None:
            nonlocal arrived_at
            frame = message.received_frame
            if frame is not None:
                arrived_at = frame.received_at
                cell.set(message, source)

        self.listen(message_type, take)
        return cell

    def _only(self, sink: Callable[..., object]) -> Sink:
        """Let through what this component says; of events those that name it, or no component."""

        def filtered(item: Any) -> None:
            frame = getattr(item, "received_frame", None)
            source = (
                getattr(item, "component_id", self._component_id) if frame is None else frame.component_id
            )
            if source == self._component_id:
                sink(item)

        return filtered
