"""Message rates: requests the messages that the program needs, and requests a message again if it does not arrive."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.events import StreamSlow, StreamUnavailable
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.messages import RequestDataStream
from aerokit.protocols.command import result_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.session.commands import CommandSender

# Seconds between checks of the rates at which messages arrive.
WATCH_PERIOD_S = 1.0

# A received rate is averaged over this many periods of ``WATCH_PERIOD_S``.
WATCH_WINDOW = 5

# A stream counts as slow if it arrives at less than this fraction of the requested rate.
SLOW_FACTOR = 0.5

RETRY_INTERVAL_S = 5.0
"""If no message of a stream arrives for this many seconds after a request, the stream is requested again.

The interval doubles with each further request of the stream, up to ``MAX_RETRY_INTERVAL_S``.
"""

MAX_RETRY_INTERVAL_S = 60.0

# This number in place of a rate in Hz restores the autopilot's own default rate.
AUTOPILOT_DEFAULT = 0.0

# Value of REQUEST_DATA_STREAM.start_stop.
START_STREAM = 1


def check_rate(message_type: type[Message], hz: float) -> None:
    check_range(f"rate_hz of {message_type.NAME}", hz, 0, 1000, above=True)


class _Stream:
    """One message type: the rates that callers need, the rate last requested, and the number of messages received."""

    def __init__(self, message_type: type[Message], component_id: int) -> None:
        self.message_type, self._component_id = message_type, component_id
        # The rates that callers need. Each call of `MessageRates.request` has its own key.
        self.requests: dict[object, float] = {}
        # The keys of the requests that are not optional.
        self.required: set[object] = set()
        # The rate last requested; None if the needed rate must be requested again.
        self.requested_hz: float | None = None
        # The rates that the vehicle has refused. A refusal leaves the rate of the stream as it was.
        self.refused_hz: set[float] = set()
        self.is_slow = False
        # Number of messages received so far, and this number at each of the last checks.
        self.received = 0
        self.counts_at_checks: deque[int] = deque([0], maxlen=WATCH_WINDOW + 1)
        # The stream is requested again at `retry_at` if none of its messages has arrived by then.
        self.retry_interval_s = RETRY_INTERVAL_S
        self.retry_at = math.inf
        # Number of consecutive requests without an ack. The next request is not sent before `next_attempt_at`.
        self.failures = 0
        self.next_attempt_at = -math.inf
        self.detach: Detach | None = None

    @property
    def needed_hz(self) -> float:
        """The highest requested rate that the vehicle has not refused; ``AUTOPILOT_DEFAULT`` if there is none."""
        return max((hz for hz in self.requests.values() if hz not in self.refused_hz), default=AUTOPILOT_DEFAULT)

    @property
    def is_optional(self) -> bool:
        return not self.required

    @property
    def is_due(self) -> bool:
        return self.requested_hz != self.needed_hz

    def achieved_hz(self) -> float:
        received_in_window = self.counts_at_checks[-1] - self.counts_at_checks[0]
        return received_in_window / ((len(self.counts_at_checks) - 1) * WATCH_PERIOD_S)

    def mark_requested(self, now: float, hz: float) -> None:
        self.requested_hz = hz
        self.counts_at_checks = deque([self.received], maxlen=WATCH_WINDOW + 1)
        self.retry_at = now + self.retry_interval_s if hz > 0 else math.inf

    def postpone(self, now: float) -> None:
        """Wait longer before the next request, because this one was not answered."""
        self.failures += 1
        self.next_attempt_at = now + min(2**self.failures, MAX_RETRY_INTERVAL_S)

    def on_frame(self, frame: Frame) -> None:
        if frame.component_id == self._component_id:
            self.received += 1


def _is_slow(achieved_hz: float, requested_hz: float) -> bool:
    window_s = WATCH_WINDOW * WATCH_PERIOD_S
    received_messages = achieved_hz * window_s
    # One message may be missing, because it may have arrived just outside the window.
    return received_messages < SLOW_FACTOR * requested_hz * window_s - 1


class MessageRates:
    """Requests the messages of one component, each at the highest rate that a caller of `request` needs.

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
        self._connection = connection
        self._commands = commands
        self._system_id = system_id
        self._component_id = component_id
        self._group_of_message = stream_groups
        # Maps message ids to the streams that were ever requested.
        self._streams: dict[int, _Stream] = {}
        self._has_due_streams = asyncio.Event()
        # True if the vehicle does not support SET_MESSAGE_INTERVAL, so that messages are requested in groups.
        self._uses_groups = False
        # Number of calls of `request_again`.
        self._reset_count = 0
        self._is_closed = False

    def request(self, message_type: type[Message], hz: float, *, is_optional: bool = False) -> Detach:
        """Request a message at ``hz`` or faster until the returned function is called.

        The rate is above 0 and at most 1000. Pass ``is_optional=True`` if the vehicle may lack the message, for example
        because it has no such sensor. If all requests for a message are optional, no event reports that it is missing.
        """
        check_rate(message_type, hz)
        stream = self._streams.get(message_type.ID)
        if stream is None:
            stream = self._new_stream(message_type)
            self._streams[message_type.ID] = stream
        stream.refused_hz.clear()  # The vehicle may accept now what it has refused before.
        token = object()
        stream.requests[token] = hz
        if not is_optional:
            stream.required.add(token)
        self._has_due_streams.set()

        def release() -> None:
            if stream.requests.pop(token, None) is not None:
                stream.required.discard(token)
                self._has_due_streams.set()

        return release

    def request_again(self) -> None:
        # The vehicle may have lost the requests, for example by a reboot.
        for stream in self._streams.values():
            stream.requested_hz = None
            stream.refused_hz.clear()
            stream.retry_interval_s = RETRY_INTERVAL_S
            stream.failures = 0
            stream.next_attempt_at = -math.inf
        self._reset_count += 1
        self._has_due_streams.set()

    async def run(self) -> None:
        """Send the requests that are due, until cancelled. Needs `watch`, which decides what is sent again."""
        while True:
            await self._has_due_streams.wait()
            self._has_due_streams.clear()
            await self._request_all_due()

    async def watch(self) -> None:
        """Check the received rates once a second, until cancelled."""
        while True:
            await anyio.sleep(WATCH_PERIOD_S)
            for stream in self._streams.values():
                self._check_stream(stream)
            # A request that was not answered becomes due again later, and nothing else sets the event then.
            if any(stream.failures for stream in self._streams.values()):
                self._has_due_streams.set()

    def close(self) -> None:
        self._is_closed = True
        for stream in self._streams.values():
            if stream.detach is not None:
                stream.detach()
        self._streams.clear()

    # --------------------------------------------------------------------------- requesting

    def _new_stream(self, message_type: type[Message]) -> _Stream:
        stream = _Stream(message_type, self._component_id)
        if not self._is_closed:
            attach = self._connection.bus.attach_frames
            stream.detach = attach(message_type, stream.on_frame, system_id=self._system_id)
        return stream

    async def _request_all_due(self) -> None:
        while not self._uses_groups:
            stream = self._most_urgent()
            if stream is None:
                return
            await self._request_by_command(stream)  # This may set `_uses_groups`.
        self._request_by_group()

    def _most_urgent(self) -> _Stream | None:
        now = self._connection.now()
        due = (stream for stream in self._streams.values() if stream.is_due and now >= stream.next_attempt_at)
        return min(due, key=lambda stream: (stream.failures, stream.is_optional), default=None)

    async def _request_by_command(self, stream: _Stream) -> None:
        hz = stream.needed_hz
        interval_us = 0.0 if hz == AUTOPILOT_DEFAULT else 1e6 / hz
        reset_count = self._reset_count
        refusal: CommandRejected | None = None
        try:
            await self._commands.send_long(
                MavCmd.SET_MESSAGE_INTERVAL,
                stream.message_type.ID,
                interval_us,
                component_id=self._component_id,
                # COMMAND_ACK does not name the message. With only one attempt, `send_long` would accept a late ack of a
                # request for another message.
                attempts=2,
            )
        except CommandRejected as error:
            if error.result == MavResult.UNSUPPORTED:
                self._switch_to_groups()
                return
            refusal = error
        except CommandTimeout:
            # If `request_again` was called meanwhile, the stream is due at once and not postponed.
            if reset_count == self._reset_count:
                stream.postpone(self._connection.now())
            return
        if reset_count != self._reset_count:
            # `request_again` was called meanwhile. The answer may be from before a reboot, so the stream stays due.
            return
        # The vehicle has accepted or refused the rate, so this rate is not due any more.
        stream.failures = 0
        if refusal is None:
            stream.mark_requested(self._connection.now(), hz)
        else:
            self._mark_refused(stream, hz, result_name(refusal.result))

    def _switch_to_groups(self) -> None:
        self._uses_groups = True
        for stream in self._streams.values():
            stream.requested_hz = None

    def _mark_refused(self, stream: _Stream, hz: float, reason: str) -> None:
        # `needed_hz` ignores refused rates. If a caller needs a lower rate, that one is requested next.
        stream.refused_hz.add(hz)
        if stream.requested_hz is None or hz == AUTOPILOT_DEFAULT:
            stream.mark_requested(self._connection.now(), AUTOPILOT_DEFAULT)
        self._publish_unavailable(stream, reason)

    def _request_by_group(self) -> None:
        rates_by_group: dict[int, float] = {}
        for stream in self._streams.values():
            if not stream.is_due:
                continue
            group = self._group_of_message.get(stream.message_type.ID)
            if group is None:
                stream.refused_hz.update(stream.requests.values())  # so that the stream is not due any more
                self._publish_unavailable(stream, "in no group of REQUEST_DATA_STREAM")
            else:
                rates_by_group[group] = self._rate_of_group(group)
            # REQUEST_DATA_STREAM has no ack, so `watch` repeats it if nothing arrives.
            stream.mark_requested(self._connection.now(), stream.needed_hz)
        for group, hz in rates_by_group.items():
            if hz > 0:  # A rate of 0 would stop a group that another ground station may use.
                request = RequestDataStream(
                    target_system=self._system_id,
                    target_component=self._component_id,
                    req_stream_id=group,
                    req_message_rate=math.ceil(hz),
                    start_stop=START_STREAM,
                )
                self._connection.send(request)

    def _rate_of_group(self, group: int) -> float:
        needed_rates_hz = (
            stream.needed_hz
            for stream in self._streams.values()
            if self._group_of_message.get(stream.message_type.ID) == group
        )
        return max(needed_rates_hz, default=AUTOPILOT_DEFAULT)

    def _publish_unavailable(self, stream: _Stream, reason: str) -> None:
        if stream.is_optional:
            return
        fields = (self._connection.now(), self._system_id, stream.message_type.NAME, reason, self._component_id)
        self._connection.bus.publish(StreamUnavailable(*fields))

    # ------------------------------------------------------------------------------ watching

    def _check_stream(self, stream: _Stream) -> None:
        stream.counts_at_checks.append(stream.received)
        if stream.requested_hz is None or stream.requested_hz <= 0:  # There is no rate to compare with.
            return
        if stream.counts_at_checks[-1] == stream.counts_at_checks[0]:  # No message has arrived in the window.
            self._retry_if_due(stream)
        else:
            stream.retry_interval_s = RETRY_INTERVAL_S
            stream.retry_at = self._connection.now() + RETRY_INTERVAL_S
        self._publish_if_slow(stream)

    def _retry_if_due(self, stream: _Stream) -> None:
        if self._connection.now() >= stream.retry_at:
            stream.retry_interval_s = min(2 * stream.retry_interval_s, MAX_RETRY_INTERVAL_S)
            stream.requested_hz = None
            self._has_due_streams.set()

    def _publish_if_slow(self, stream: _Stream) -> None:
        is_window_full = len(stream.counts_at_checks) > WATCH_WINDOW
        if stream.requested_hz is None or not is_window_full:
            return
        achieved_hz = stream.achieved_hz()
        if achieved_hz == 0 and stream.is_optional:  # The vehicle may lack an optional message.
            return
        # If no message arrived in the first period of the window, the stream began later. Its average is then too low.
        has_just_started = achieved_hz > 0 and stream.counts_at_checks[0] == stream.counts_at_checks[1]
        if has_just_started and not stream.is_slow:
            return
        was_slow = stream.is_slow
        stream.is_slow = _is_slow(achieved_hz, stream.requested_hz)
        if stream.is_slow and not was_slow:
            now, name = self._connection.now(), stream.message_type.NAME
            rates = (stream.requested_hz, achieved_hz)
            self._connection.bus.publish(StreamSlow(now, self._system_id, name, *rates, self._component_id))
