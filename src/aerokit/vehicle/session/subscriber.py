"""Subscriptions to the messages of one component, and state cells with their latest values.

Both request the rates that they need from the vehicle.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.autopilots.telemetry import STREAMED_MESSAGES
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.cells import Source, StateCell
from aerokit.mavlink.message import Message
from aerokit.vehicle.session.rates import check_rate
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Detach, EndSignal, Sink
    from aerokit.connection.connection import Connection
    from aerokit.events import Event
    from aerokit.vehicle.session.rates import MessageRates

SUBSCRIPTION_HZ = 4.0
"""Rate in Hz to request for a streamed message that has no default rate, if the program names no rate either."""


def subscription_rate_hz(message_type: type[Message]) -> float | None:
    """Return the default rate of a subscription; None for a message that vehicles do not send regularly."""
    name = message_type.__name__
    return DEFAULT_RATES_HZ.get(name, SUBSCRIPTION_HZ if name in STREAMED_MESSAGES else None)


ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)


class ComponentSubscriber:
    """Subscriptions to the messages of one component, and cells with its latest messages.

    ``register_cell`` adds a cell to the session. ``at_close`` registers a callback that is called when the session
    ends. ``end`` is the session's signal that ends all subscriptions.
    """

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        rates: MessageRates,
        *,
        register_cell: Callable[[StateCell[Any]], None],
        at_close: Callable[[Detach], None],
        end: EndSignal,
    ) -> None:
        self._connection = connection
        self._rates = rates
        self._system_id = system_id
        self._component_id = component_id
        self._register_cell = register_cell
        self._at_close = at_close
        self._end = end
        # Map each message type to the cell with its latest message, and to the function that ends its rate request.
        self._cells: dict[type[Message], StateCell[Any]] = {}
        self._rate_releases: dict[type[Message], Detach] = {}

    def subscribe(
        self,
        types: tuple[type[ItemT], ...],
        capacity: int,
        overflow: Overflow,
        rate_hz: float | None,
        *,
        entire_system: bool = False,
    ) -> Subscription[ItemT]:
        """Return a subscription that requests its messages during its `with` block.

        It receives the messages of this component, or of all components if ``entire_system`` is True.
        """
        self._connection.check_types(types)
        message_types: list[type[Message]] = [type_ for type_ in types if issubclass(type_, Message)]
        if rate_hz is not None:
            for message_type in message_types:
                check_rate(message_type, rate_hz)

        def attach(sink: Sink) -> list[Detach]:
            filtered_sink = sink if entire_system else self._of_component(sink)
            detach_callbacks = self._connection.attach(types, filtered_sink, system_id=self._system_id)
            detach_callbacks.append(self._end.on_end(subscription.close))  # `subscription` is assigned below.
            for message_type in message_types:
                hz = subscription_rate_hz(message_type) if rate_hz is None else rate_hz
                if hz is not None:
                    detach_callbacks.append(self._rates.request(message_type, hz))
            return detach_callbacks

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        subscription._explain_timeout = lambda: self._connection.describe_signature_problems(self._system_id)
        return subscription

    def cell(self, message_type: type[MessageT], rate_hz: float | None) -> StateCell[MessageT]:
        """Return the cell with the latest message of a type.

        All calls for a type return the same cell. A call with ``rate_hz`` replaces the rate of earlier calls.
        """
        if rate_hz is not None:
            check_rate(message_type, rate_hz)
        cell = self._cells.get(message_type)
        if cell is None:
            self._connection.check_types((message_type,))
            cell = self._new_cell(message_type)
            self._cells[message_type] = cell
            self._register_cell(cell)
            rate_hz = subscription_rate_hz(message_type) if rate_hz is None else rate_hz
        if rate_hz is not None:
            release_previous = self._rate_releases.pop(message_type, None)
            self._rate_releases[message_type] = self._rates.request(message_type, rate_hz)
            # Request the new rate first, because a message without any request returns to the autopilot's own rate.
            if release_previous is not None:
                release_previous()
        return cell

    def listen(self, message_type: type[MessageT], callback: Callable[[MessageT], object]) -> None:
        """Call ``callback`` with each message of a type, until the vehicle's `async with` block is left.

        Does nothing if the dialect does not contain the message.
        """
        bus = self._connection.bus
        if bus.dialect.get(message_type.ID) is not None:
            self._at_close(bus.attach(message_type, self._of_component(callback), system_id=self._system_id))

    def _new_cell(self, message_type: type[Message]) -> StateCell[Any]:
        arrived_at = math.nan  # Time of the message in the cell. `store` sets this variable first, and then the cell.
        name = message_type.NAME
        cell: StateCell[Any] = StateCell(name, self._connection.now, waits_for=name, stamp=lambda: arrived_at)
        source = Source(self._system_id, self._component_id, message_type.NAME)

        def store(message: Message) -> None:
            nonlocal arrived_at
            frame = message.received_frame
            if frame is not None:
                arrived_at = frame.received_at
                cell.set(message, source)

        self.listen(message_type, store)
        return cell

    def _of_component(self, sink: Callable[..., object]) -> Sink:
        """Return a sink that drops messages and events of other components."""

        def filtered(item: Any) -> None:
            frame = getattr(item, "received_frame", None)
            if frame is not None:
                component_id = frame.component_id
            else:  # An event without a component id is about the whole system, and thus about this component, too.
                component_id = getattr(item, "component_id", self._component_id)
            if component_id == self._component_id:
                sink(item)

        return filtered


class WatchedStream:
    """Requests the message of a state cell only while the program waits for the cell or iterates over its values.

    ``request`` returns None if the message need not be requested now.
    """

    pending = False

    def __init__(self, cell: StateCell[Any], request: Callable[[], Detach | None]) -> None:
        self._cell, self._request = cell, request
        # Releases the request; None while nothing is requested.
        self._release: Detach | None = None

    def catch_up(self) -> None:
        """Do nothing, because no message is ever pending here."""

    def watchers_changed(self) -> None:
        if not self._cell._is_watched and self._release is not None:
            self._release()
            self._release = None
        elif self._cell._is_watched and self._release is None:
            self._release = self._request()
