"""Message rates: requests the messages that subscribers need, checks that they arrive, and requests them again."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit._internal.arguments import check_range
from aerokit.autopilots.telemetry import STREAMED_MESSAGES
from aerokit.connection.bus import Overflow, Subscription
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.events import StreamSlow, StreamUnavailable
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import RequestDataStream
from aerokit.protocols.command import result_name
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.connection.bus import Detach, Sink
    from aerokit.connection.connection import Connection
    from aerokit.events import Event
    from aerokit.mavlink.frame import Frame
    from aerokit.vehicle.session.commands import CommandSender

WATCH_PERIOD_S = 1.0

# A rate is evaluated over this many watch periods.
WATCH_WINDOW = 5

SLOW_FACTOR = 0.5

RETRY_INTERVAL_S = 5.0
"""Seconds until a missing stream is requested again; doubled each time up to the maximum."""

MAX_RETRY_INTERVAL_S = 60.0

AUTOPILOT_DEFAULT = 0.0

SUBSCRIPTION_HZ = 4.0
"""Rate in Hz for subscriptions that name no rate, to a streamed message without a default rate."""


def subscription_rate_hz(message_type: type[Message]) -> float | None:
    """Return the rate for a subscription that names none; None for messages that are sent on demand."""
    name = message_type.__name__
    return DEFAULT_RATES_HZ.get(name, SUBSCRIPTION_HZ if name in STREAMED_MESSAGES else None)


def check_rate(message_type: type[Message], hz: float) -> None:
    """Raise InvalidArgument unless the rate is above 0 and at most 1000 Hz."""
    check_range(f"rate_hz of {message_type.NAME}", hz, 0, 1000, above=True)


class _Stream:
    """State of one message type: the rates that are needed, the rate last requested, and the count received."""

    def __init__(self, message_type: type[Message], component_id: int) -> None:
        self.message_type, self._component_id = message_type, component_id
        self.requests: dict[object, float] = {}
        self.is_optional = True
        self.requested_hz: float | None = None
        self.refused = False
        self.is_slow = False
        self.count = 0
        self.counts: deque[int] = deque([0], maxlen=WATCH_WINDOW + 1)
        self.retry_interval_s = RETRY_INTERVAL_S
        self.retry_at = math.inf
        self.failures = 0
        self.not_before = -math.inf
        self.detach: Detach | None = None

    @property
    def needed_hz(self) -> float:
        """The highest rate needed; 0 (the autopilot's own rate) if no rate is needed."""
        return max(self.requests.values(), default=AUTOPILOT_DEFAULT)

    @property
    def is_due(self) -> bool:
        return not self.refused and self.requested_hz != self.needed_hz

    def achieved_hz(self) -> float:
        return (self.counts[-1] - self.counts[0]) / ((len(self.counts) - 1) * WATCH_PERIOD_S)

    def mark_requested(self, now: float, hz: float) -> None:
        self.requested_hz = hz
        self.counts = deque([self.count], maxlen=WATCH_WINDOW + 1)
        self.retry_at = now + self.retry_interval_s if hz > 0 else math.inf

    def on_frame(self, frame: Frame) -> None:
        if frame.component_id == self._component_id:
            self.count += 1


class MessageRates:
    """Keeps one component sending the requested messages, each at the highest requested rate.

    Uses MAV_CMD_SET_MESSAGE_INTERVAL, or REQUEST_DATA_STREAM if the vehicle does not support that command
    (https://mavlink.io/en/mavgen_python/howto_requestmessages.html). A stream that does not arrive, for example after a
    reboot, is requested again. A stream that is too slow is reported as :class:`StreamSlow`.
    """

    def __init__(
        self,
        connection: Connection,
        commands: CommandSender,
        system_id: int,
        component_id: int,
        stream_groups: Mapping[int, int],
    ) -> None:
        self._connection, self._commands = connection, commands
        self._system_id, self._component_id = system_id, component_id
        self._groups = stream_groups
        self._streams: dict[int, _Stream] = {}
        self._dirty = asyncio.Event()
        self._legacy = False
        self._reset_count = 0

    def request(self, message_type: type[Message], hz: float, *, is_optional: bool = False) -> Detach:
        """Request ``message_type`` at ``hz`` (above 0, at most 1000) or faster until the returned function is called.

        For an optional message (e.g. of a sensor that may be missing) no StreamUnavailable event is published.
        """
        check_rate(message_type, hz)
        stream = self._streams.get(message_type.ID)
        if stream is None:
            stream = self._streams[message_type.ID] = self._new_stream(message_type)
        stream.is_optional = stream.is_optional and is_optional
        if stream.refused:  # A refusal may depend on the rate.
            stream.refused, stream.requested_hz = False, None
        token = object()
        stream.requests[token] = hz
        self._dirty.set()

        def release() -> None:
            if stream.requests.pop(token, None) is not None:
                self._dirty.set()

        return release

    def request_again(self) -> None:
        """Request everything again, as after a reboot."""
        for stream in self._streams.values():
            stream.requested_hz, stream.refused, stream.retry_interval_s = None, False, RETRY_INTERVAL_S
            stream.failures, stream.not_before = 0, -math.inf
        self._reset_count += 1
        self._dirty.set()

    async def run(self) -> None:
        """Send the requests until cancelled; :meth:`watch` must run concurrently."""
        while True:
            await self._dirty.wait()
            self._dirty.clear()
            await self._request_all_due()

    async def watch(self) -> None:
        """Evaluate the received rates once a second, until cancelled."""
        while True:
            await anyio.sleep(WATCH_PERIOD_S)
            for stream in self._streams.values():
                self._watch(stream)
            if self._most_urgent() is not None:
                self._dirty.set()

    def close(self) -> None:
        """Stop counting messages."""
        for stream in self._streams.values():
            if stream.detach is not None:
                stream.detach()
        self._streams.clear()

    # ------------------------------------------------------------------------------- asking

    def _new_stream(self, message_type: type[Message]) -> _Stream:
        stream = _Stream(message_type, self._component_id)
        stream.detach = self._connection.bus.attach_frames(message_type, stream.on_frame, system_id=self._system_id)
        return stream

    async def _request_all_due(self) -> None:
        """Request the due streams one at a time, the most urgent first; an unanswered stream is tried again last."""
        while not self._legacy and (stream := self._most_urgent()) is not None:
            await self._request_by_command(stream)
        if self._legacy:
            self._request_by_group()

    def _most_urgent(self) -> _Stream | None:
        now = self._connection.now()
        due = (stream for stream in self._streams.values() if stream.is_due and now >= stream.not_before)
        return min(due, key=lambda stream: (stream.failures, stream.is_optional), default=None)

    async def _request_by_command(self, stream: _Stream) -> None:
        hz = stream.needed_hz
        interval_us = 0.0 if hz == AUTOPILOT_DEFAULT else 1e6 / hz
        reset_count = self._reset_count
        try:
            await self._commands.send_long(
                MavCmd.SET_MESSAGE_INTERVAL,
                stream.message_type.ID,
                interval_us,
                component_id=self._component_id,
                attempts=1,
            )
        except CommandRejected as error:
            if error.result == MavResult.UNSUPPORTED:
                self._switch_to_groups()
                return
            self._was_refused(stream, error)
        except CommandTimeout:
            # A reboot in the meantime has made all streams due again, so the failure does not count.
            if reset_count == self._reset_count:
                stream.failures += 1
                stream.not_before = self._connection.now() + min(2.0**stream.failures, MAX_RETRY_INTERVAL_S)
            return
        stream.failures = 0
        stream.mark_requested(self._connection.now(), hz)

    def _switch_to_groups(self) -> None:
        self._legacy = True
        for stream in self._streams.values():
            stream.requested_hz = None

    def _was_refused(self, stream: _Stream, error: CommandRejected) -> None:
        stream.refused = True
        self._publish_unavailable(stream, result_name(error.result))

    def _request_by_group(self) -> None:
        """Request groups of messages. REQUEST_DATA_STREAM has no ack, so the watch repeats it when nothing arrives."""
        wanted: dict[int, float] = {}
        for stream in self._streams.values():
            if not stream.is_due:
                continue
            group = self._groups.get(stream.message_type.ID)
            if group is None:
                stream.refused = True
                self._publish_unavailable(stream, "in no group of REQUEST_DATA_STREAM")
            else:
                wanted[group] = self._fastest_of(group)
            stream.mark_requested(self._connection.now(), stream.needed_hz)
        for group, hz in wanted.items():
            if hz > 0:  # Another ground station may have started a group that no subscriber here needs.
                rate = math.ceil(hz)
                self._connection.send(RequestDataStream(self._system_id, self._component_id, group, rate, 1))

    def _fastest_of(self, group: int) -> float:
        members = (s for s in self._streams.values() if self._groups.get(s.message_type.ID) == group)
        return max((stream.needed_hz for stream in members), default=AUTOPILOT_DEFAULT)

    def _publish_unavailable(self, stream: _Stream, reason: str) -> None:
        if stream.is_optional:
            return
        fields = (self._connection.now(), self._system_id, stream.message_type.NAME, reason, self._component_id)
        self._connection.bus.publish(StreamUnavailable(*fields))

    # ------------------------------------------------------------------------------ watching

    def _watch(self, stream: _Stream) -> None:
        stream.counts.append(stream.count)
        if stream.requested_hz is None or stream.requested_hz <= 0 or stream.refused:
            return
        if stream.counts[-1] == stream.counts[0]:
            self._retry_if_silent(stream)
        else:
            stream.retry_interval_s, stream.retry_at = (
                RETRY_INTERVAL_S,
                self._connection.now() + RETRY_INTERVAL_S,
            )
        self._check_rate(stream)

    def _retry_if_silent(self, stream: _Stream) -> None:
        if self._connection.now() >= stream.retry_at:
            stream.retry_interval_s = min(2 * stream.retry_interval_s, MAX_RETRY_INTERVAL_S)
            stream.requested_hz = None
            self._dirty.set()

    def _check_rate(self, stream: _Stream) -> None:
        if stream.requested_hz is None or len(stream.counts) <= WATCH_WINDOW:
            return
        achieved = stream.achieved_hz()
        expected = SLOW_FACTOR * stream.requested_hz * WATCH_WINDOW * WATCH_PERIOD_S
        has_just_started = achieved > 0 and stream.counts[0] == stream.counts[1]
        if has_just_started and not stream.is_slow:
            return  # The stream has just started, so its rate is not known yet.
        was_slow, stream.is_slow = stream.is_slow, achieved * WATCH_WINDOW * WATCH_PERIOD_S < expected - 1
        if achieved == 0 and stream.is_optional:
            return
        if stream.is_slow and not was_slow:
            self._connection.bus.publish(
                StreamSlow(
                    self._connection.now(),
                    self._system_id,
                    stream.message_type.NAME,
                    stream.requested_hz,
                    achieved,
                    self._component_id,
                )
            )


ItemT = TypeVar("ItemT", bound="Message | Event")

MessageT = TypeVar("MessageT", bound=Message)


class ComponentSubscriber:
    """Subscriptions and cells for one component. ``keep`` registers a cell, ``at_close`` a callback."""

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
        entire_system: bool = False,
    ) -> Subscription[ItemT]:
        """Return a stream of messages of this component, or of the ``entire_system``, and of events; requests the
        rates.
        """
        self._connection.check_types(types)
        messages: list[type[Message]] = [type_ for type_ in types if issubclass(type_, Message)]
        if rate_hz is not None:
            for message in messages:
                check_rate(message, rate_hz)

        def attach(sink: Sink) -> list[Detach]:
            wanted = sink if entire_system else self._only(sink)
            detach = self._connection.attach(types, wanted, system_id=self._system_id)
            detach.append(self._connection.on_end(subscription.close))
            for message_type in messages:
                hz = subscription_rate_hz(message_type) if rate_hz is None else rate_hz
                if hz is not None:
                    detach.append(self._rates.request(message_type, hz))
            return detach

        subscription: Subscription[ItemT] = Subscription(attach, capacity=capacity, overflow=overflow)
        subscription._explain_timeout = lambda: self._connection.describe_signature_problems(self._system_id)
        return subscription

    def cell(self, message_type: type[MessageT], rate_hz: float | None) -> StateCell[MessageT]:
        """Return the cell with the latest message of a type; always the same cell, at the last requested rate."""
        cell = self._cells.get(message_type)
        if cell is None:
            self._connection.check_types((message_type,))
            cell = self._cells[message_type] = self._new_cell(message_type)
            self._keep(cell)
            rate_hz = subscription_rate_hz(message_type) if rate_hz is None else rate_hz
        if rate_hz is not None:
            release = self._cell_rates.pop(message_type, None)
            self._cell_rates[message_type] = self._rates.request(message_type, rate_hz)
            if release is not None:
                release()
        return cell

    def listen(self, message_type: type[MessageT], take: Callable[[MessageT], object]) -> None:
        """Call ``take`` with each message of a type, if the dialect contains it, until the vehicle's block is left."""
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
        """Pass messages of this component, events about it, and events about no particular component."""

        def filtered(item: Any) -> None:
            frame = getattr(item, "received_frame", None)
            source = getattr(item, "component_id", self._component_id) if frame is None else frame.component_id
            if source == self._component_id:
                sink(item)

        return filtered


class WatchedStream:
    """Feed of a cell that requests its message only while the program waits for the cell or follows it.

    ``request`` returns None if the message need not be requested now.
    """

    pending = False

    def __init__(self, cell: StateCell[Any], request: Callable[[], Detach | None]) -> None:
        self._cell, self._request = cell, request
        self._release: Detach | None = None

    def catch_up(self) -> None:
        """Do nothing: another feed decodes the message."""

    def watchers_changed(self) -> None:
        if not self._cell._is_watched and self._release is not None:
            self._release()
            self._release = None
        elif self._cell._is_watched and self._release is None:
            self._release = self._request()
