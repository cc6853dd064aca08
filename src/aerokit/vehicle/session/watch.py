"""Monitors one vehicle and its link: silence, reboots, packet loss, delay and data rate, published as events."""

from __future__ import annotations

import math
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import anyio

from aerokit.connection.cells import StateCell
from aerokit.connection.heartbeats import LinkStateTracker
from aerokit.connection.loop_watch import BLOCKED_THRESHOLD_S, CHECK_INTERVAL_S
from aerokit.errors import LinkLost, OperationRejected
from aerokit.events import (
    SILENT_AFTER_S,
    LinkInterrupted,
    LinkReport,
    VehicleRebooted,
    VehicleRecovered,
    VehicleSilent,
)
from aerokit.mavlink.messages import Attitude, GlobalPositionInt, Heartbeat, SystemTime, Timesync

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.events import LinkState
    from aerokit.mavlink.frame import Frame

# If the vehicle's time since boot decreases by more than this, the vehicle has rebooted. Reordered messages cause a
# smaller decrease. A reboot soon after the previous one also causes a smaller decrease and is not detected.
REBOOT_MIN_DECREASE_MS = 3000
# A decreased time shows a reboot only if it persists for this long and in at least two messages, because a single
# message may be late.
REBOOT_CONFIRM_S = 0.2
# After an order to reboot, a time since boot shows the reboot if it is more than this behind the expected time, because
# a boot takes longer. A late message is behind as well, so the time must also be less than the time since the order.
EXPECTED_REBOOT_MIN_LAG_MS = 2000
# When a lost link is back, the time since boot must have continued, with a tolerance of these seconds plus this
# fraction of the interruption. A larger difference shows a reboot or another vehicle if it persists for
# RESUME_CONFIRM_S. The first messages may be late.
RESUME_TOLERANCE_S, RESUME_TOLERANCE_RATIO = 1.5, 0.05
RESUME_CONFIRM_S = 1.0
# On a reopened link, the vehicle counts as rebooted if it sends no time since boot for RESUME_TIMEOUT_S. It also counts
# as rebooted if its clock proves nothing for MAX_HOLD_BACK_S, because its messages seem delayed.
RESUME_TIMEOUT_S, MAX_HOLD_BACK_S = 5.0, 30.0
# A simulation's clock may be faster than real time. Its speed is computed from two reports that are more than this
# many seconds apart.
CLOCK_SPAN_S = 5.0
# A greater time is not a time since boot: some firmware answers TIMESYNC with the time of day, equal on all vehicles.
MAX_RUNNING_TIME_MS = 100_000_000_000
# If the clock was observed for less than this before the loss of the link, its speed is not known.
MIN_CLOCK_SPAN_S = 1.0
# A clock that differs from real time by more than these seconds plus this fraction is that of a faster simulation.
REAL_TIME_TOLERANCE_S, REAL_TIME_TOLERANCE_RATIO = 0.05, 0.1
REPORT_PERIOD_S = 1.0
TIMESYNC_PERIOD_S = 2.0
# A round trip is unknown again after this many seconds without an answer to TIMESYNC. The link may have changed.
ROUND_TRIP_MAX_AGE_S = 10.0
BOOT_CLOCK, BOOT_CLOCK_RANGE_MS = "time_boot_ms", 1 << 32
OTHER_BOOT = "the vehicle's clock does not show that the reopened link leads to the same boot of the same vehicle"
"""Reason for the end of orders and transfers on a reopened link that may lead to another vehicle."""
# Maximum number of unanswered TIMESYNC requests; older ones are considered lost.
MAX_OPEN_REQUESTS = 64


class _ClockReading:
    """A time since boot that the vehicle has reported, and our time at which the report was processed.

    ``waited_s`` is how long the report may have waited before, because the event loop was blocked.
    """

    # Many messages create an instance, and this class is five times as fast as a NamedTuple.
    __slots__ = ("milliseconds", "read_at", "waited_s")

    def __init__(self, milliseconds: int, read_at: float, waited_s: float = 0.0) -> None:
        self.milliseconds = milliseconds
        self.read_at = read_at
        self.waited_s = waited_s


class _LostClock(NamedTuple):
    """The vehicle's clock when the link was lost."""

    last: _ClockReading
    speed: float  # ms/s
    tolerance_ratio: float  # by which ``speed`` may be wrong
    is_speed_known: bool  # False if real time is only assumed


def _is_real_time(first: _ClockReading, last: _ClockReading, span_s: float) -> bool:
    tolerance_s = REAL_TIME_TOLERANCE_S + REAL_TIME_TOLERANCE_RATIO * span_s + first.waited_s + last.waited_s
    return abs((last.milliseconds - first.milliseconds) / 1000 - span_s) <= tolerance_s


class VehicleWatch:
    """Detects when one vehicle falls silent, ends its silence, or reboots."""

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        on_reboot: Callable[[], None],
        heartbeat_at: float,
    ) -> None:
        self._connection = connection
        self._system_id = system_id
        self._component_id = component_id
        self._now = connection.now
        self._on_reboot = on_reboot
        self.last_heartbeat_at: float = heartbeat_at
        # Time at which the last HEARTBEAT was processed. The first HEARTBEAT may be old, but the vehicle must not count
        # as silent at once.
        self._heartbeat_read_at = max(self.last_heartbeat_at, connection.now() - SILENT_AFTER_S)
        self.link_state: StateCell[LinkState] = StateCell("link_state", connection.now, "HEARTBEAT")
        self._state_tracker = LinkStateTracker(
            self.link_state, connection.bus, system_id=system_id, component_id=component_id
        )
        self._state_tracker.record_activity(self.last_heartbeat_at)
        # True from `VehicleSilent` to `VehicleRecovered`.
        self._is_reported_silent = False
        self._has_ended = False
        self.reboots: int = 0
        """Number of reboots detected."""
        self.other_boots: int = 0
        """Number of `reboots` that were detected on a reopened link, which may lead to another vehicle."""
        self._last_readings: dict[str, _ClockReading] = {}
        # The first reading of each clock since the start of the session or a reboot.
        self._first_readings: dict[str, _ClockReading] = {}
        # The connection uses this clock to recognise a vehicle that returns from a new address.
        connection.boot_clocks[system_id, component_id] = self.boot_time_ms
        # The lowest reading of each decreased clock, until `_is_decrease_confirmed` decides if it shows a reboot.
        self._decreased_readings: dict[str, _ClockReading] = {}
        # Makes the connection deliver the vehicle's frames again. After a loss of the link, the connection holds them
        # back until the vehicle's clock shows whether it is the same boot of the same vehicle. None at other times.
        self._deliver_again: Detach | None = None
        # The clocks when the link was lost, as far as later readings can be compared with them.
        self._lost_clocks: dict[str, _LostClock] = {}
        # For each clock, the first reading since the loss that does not continue the clock.
        self._resumed_readings: dict[str, _ClockReading] = {}
        # Time of the first frame since the loss, and of the last reading since that frame.
        self._first_held_back_at: float | None = None
        self._clock_read_at = -math.inf
        # Time of an order to reboot that is in progress; None if there is none.
        self._reboot_ordered_at: float | None = None
        # The vehicle's time in the last answer to a TIMESYNC request.
        self._last_answer = _ClockReading(0, read_at=-math.inf)
        bus = connection.bus
        self._detach_callbacks: list[Detach] = [
            bus.attach(Heartbeat, self._on_heartbeat, system_id=system_id),
            bus.attach_event(LinkInterrupted, self._on_link_interrupted),
        ]
        self._clock_handlers: dict[int, Callable[[Frame], None]] = {}
        for message_type, handler in (
            (Attitude, self._on_boot_time),
            (GlobalPositionInt, self._on_boot_time),
            (SystemTime, self._on_system_time),
            (Timesync, self._on_timesync),
        ):
            self._clock_handlers[message_type.ID] = handler
            self._detach_callbacks.append(bus.attach_frames(message_type, handler, system_id=system_id))

    def raise_if_other_boot(self, other_boots_before: int, consequence: str, *, action: str = "") -> None:
        """Raise OperationRejected if `other_boots` has grown: the reopened link may lead to another vehicle."""
        if self.other_boots != other_boots_before:
            prefix = f"{action}: " if action else ""
            raise OperationRejected(f"{prefix}{OTHER_BOOT}; {consequence}")

    @property
    def is_silent(self) -> bool:
        """True if no heartbeat was received for more than 3.5 seconds, or the link is lost."""
        return self._is_reported_silent or self._has_ended or self.silent_for_s > SILENT_AFTER_S

    @property
    def silent_for_s(self) -> float:
        """Seconds since aerokit processed the last heartbeat, which arrived at :attr:`last_heartbeat_at`."""
        # A pause in which the event loop was blocked must not count as silence.
        return self._connection.now() - self._heartbeat_read_at

    def end(self, error: Exception) -> None:
        """Mark the link as lost."""
        self._has_ended = True
        self._state_tracker.mark_lost(self._connection.now(), publish=isinstance(error, LinkLost))
        self.link_state.close(error)

    def close(self) -> None:
        self._connection.boot_clocks.pop((self._system_id, self._component_id), None)
        self._end_hold_back()
        for detach in self._detach_callbacks:
            detach()

    def boot_time_ms(self, now: float) -> float | None:
        """Return the vehicle's time since boot at ``now``, or None if it is unknown."""
        last = self._last_readings.get(BOOT_CLOCK)
        if last is None or BOOT_CLOCK not in self._first_readings:
            return None
        age_s = now - last.read_at + self._connection._slept_since(last.read_at)
        return (last.milliseconds + self._clock_speed() * age_s) % BOOT_CLOCK_RANGE_MS

    def _clock_speed(self, clock: str = BOOT_CLOCK) -> float:
        """Return how many milliseconds this clock of the vehicle advances in a second."""
        first, last = self._first_readings.get(clock), self._last_readings.get(clock)
        # The clock of a simulation may be faster than real time.
        if first is None or last is None or last.read_at - first.read_at <= CLOCK_SPAN_S:
            return 1000.0
        return (last.milliseconds - first.milliseconds) / self._span_s(first, last)

    def _span_s(self, first: _ClockReading, last: _ClockReading) -> float:
        """Return the seconds between two readings."""
        # While the computer sleeps, our clock stands still.
        slept_since = self._connection._slept_since
        return last.read_at - first.read_at + slept_since(first.read_at) - slept_since(last.read_at)

    @contextmanager
    def expecting_reboot(self) -> Iterator[None]:
        """Detect a reboot during a `with` block even if the previous boot was very recent."""
        self._reboot_ordered_at = self._connection.now()
        try:
            yield
        finally:
            self._reboot_ordered_at = None

    def on_time_answer(self, requested_at: float, milliseconds: int) -> None:
        """Detect a reboot by the time since boot in an answer to our TIMESYNC request."""
        previous = self._last_answer
        # If this request was sent before the previous answer arrived, the two answers may have changed places.
        if requested_at <= previous.read_at:
            return
        self._last_answer = _ClockReading(milliseconds, self._connection.now())
        if milliseconds < previous.milliseconds:
            self._on_reboot_detected({"TIMESYNC": self._last_answer})

    def check(self) -> None:
        """Publish VehicleSilent if heartbeats have stopped. Called once a second."""
        now = self._connection.now()
        silent_for = self.silent_for_s
        self._state_tracker.check(now)
        if self._first_held_back_at is not None:
            has_clock_stopped = now - self._clock_read_at > RESUME_TIMEOUT_S
            if has_clock_stopped or now - self._first_held_back_at > MAX_HOLD_BACK_S:
                self._on_reboot_detected({})
        if silent_for > SILENT_AFTER_S and not self._is_reported_silent:
            self._is_reported_silent = True
            self._connection.bus.publish(VehicleSilent(now, self._system_id, silent_for))

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is None or frame.component_id != self._component_id:
            return
        now = self._connection.now()
        silent_for_s = self.silent_for_s  # Read it before the next line resets it to 0.
        self._heartbeat_read_at = now
        self.last_heartbeat_at = frame.received_at
        self._state_tracker.record_activity(now)
        if self._is_reported_silent:
            self._is_reported_silent = False
            self._connection.bus.publish(VehicleRecovered(now, self._system_id, silent_for_s))

    def _on_link_interrupted(self, event: LinkInterrupted) -> None:
        self._state_tracker.mark_lost(event.at)
        self._resumed_readings, self._first_held_back_at = {}, None
        if self._deliver_again is not None:  # The link was lost again before the clocks were compared.
            return
        self._lost_clocks = self._comparable_clocks()
        self._deliver_again = self._connection.hold_back(self._system_id, self._on_held_back_frame)

    def _comparable_clocks(self) -> dict[str, _LostClock]:
        """Return the clocks that must continue after the loss of the link; none if their speed is unknown."""
        lost_clocks: dict[str, _LostClock] = {}
        for clock, first in self._first_readings.items():
            last = self._last_readings[clock]
            if last.milliseconds > MAX_RUNNING_TIME_MS:
                continue
            span_s = self._span_s(first, last)
            speed, tolerance_ratio = 1000.0, RESUME_TOLERANCE_RATIO
            if span_s - last.waited_s > CLOCK_SPAN_S:
                speed = self._clock_speed(clock)
                tolerance_ratio += (RESUME_TOLERANCE_S + first.waited_s + last.waited_s) / (span_s - last.waited_s)
            elif not _is_real_time(first, last, span_s):
                return {}
            lost_clocks[clock] = _LostClock(last, speed, tolerance_ratio, is_speed_known=span_s >= MIN_CLOCK_SPAN_S)
        return lost_clocks

    def _on_held_back_frame(self, frame: Frame) -> None:
        """Compare the clock in a frame that arrived after a loss of the link with the clock before the loss."""
        if not self._lost_clocks:  # Without a clock to compare with, a reboot is assumed.
            self._on_reboot_detected({})
            return
        if self._first_held_back_at is None:
            self._first_held_back_at = self._clock_read_at = self._now()
        handler = self._clock_handlers.get(frame.message_id)
        if handler is not None:
            handler(frame)

    def _end_hold_back(self) -> None:
        self._lost_clocks, self._first_held_back_at = {}, None
        if self._deliver_again is not None:
            self._deliver_again()
            self._deliver_again = None

    def _on_boot_time(self, frame: Frame) -> None:
        if frame.component_id == self._component_id:
            # ``time_boot_ms`` is at the start of the payload, which begins at byte 9 of ``body``.
            self._record_time(frame, BOOT_CLOCK, int.from_bytes(frame.body[9:13], "little"))

    def _on_system_time(self, frame: Frame) -> None:
        if frame.component_id == self._component_id:
            # ``time_boot_ms`` follows the 8 bytes of ``time_unix_usec`` in the payload.
            self._record_time(frame, BOOT_CLOCK, int.from_bytes(frame.body[17:21], "little"))

    def _on_timesync(self, frame: Frame) -> None:
        # ``tc1`` in ns, which is 0 in a request, is at the start of the payload.
        vehicle_ns = int.from_bytes(frame.body[9:17], "little", signed=True)
        # The answers to TIMESYNC requests show a reboot even if the program requests no messages.
        if vehicle_ns != 0 and frame.component_id == self._component_id:
            self._record_time(frame, "TIMESYNC", vehicle_ns // 1_000_000)

    def _record_time(self, frame: Frame, clock: str, milliseconds: int) -> None:
        """Record a time since boot, and detect a reboot by it.

        ``clock`` names the message or field with the time.
        """
        now = self._now()
        previous = self._last_readings.get(clock)
        if clock == BOOT_CLOCK and previous is not None and milliseconds < previous.milliseconds:
            milliseconds = self._unwrapped(milliseconds, previous, now)
        reading = _ClockReading(milliseconds, now, now - frame.received_at)
        previous = previous or reading
        if self._is_expected_reboot(frame, previous, milliseconds):
            self._on_reboot_detected({clock: reading})
        elif previous.milliseconds - milliseconds <= REBOOT_MIN_DECREASE_MS:  # The decrease is too small for a reboot.
            self._last_readings[clock] = reading
            self._first_readings.setdefault(clock, reading)
            # If an earlier message reported a far smaller time, that message was late.
            self._decreased_readings.pop(clock, None)
        elif self._is_decrease_confirmed(clock, milliseconds):
            self._on_reboot_detected({clock: reading})
        if clock in self._lost_clocks and self._is_other_boot(clock, reading):
            self._on_reboot_detected({clock: reading})

    def _unwrapped(self, milliseconds: int, previous: _ClockReading, now: float) -> int:
        """Return a reading of ``time_boot_ms``, which begins at 0 again after 49.7 days, as a time that only grows."""
        expected = previous.milliseconds + self._clock_speed() * (now - previous.read_at)
        wraps = round((expected - milliseconds) / BOOT_CLOCK_RANGE_MS)
        unwrapped = milliseconds + wraps * BOOT_CLOCK_RANGE_MS
        return unwrapped if abs(unwrapped - expected) <= REBOOT_MIN_DECREASE_MS else milliseconds

    def _is_other_boot(self, clock: str, reading: _ClockReading) -> bool:
        """Return True if this reading confirms another boot. If it proves the same one, deliver frames again."""
        last, speed, tolerance_ratio, is_speed_known = self._lost_clocks[clock]
        away_s = reading.read_at - last.read_at + self._connection._slept_since(last.read_at)
        difference_ms = abs(reading.milliseconds - last.milliseconds - speed * away_s)
        tolerance_s = RESUME_TOLERANCE_S + last.waited_s + reading.waited_s + tolerance_ratio * away_s
        if difference_ms <= speed * tolerance_s:
            self._end_hold_back()
            return False
        if not is_speed_known:
            return True  # The confirmation below needs the speed.
        self._clock_read_at = reading.read_at
        resumed = self._resumed_readings.get(clock, reading)
        resumed_s = reading.read_at - resumed.read_at
        if reading.milliseconds - resumed.milliseconds > speed * (resumed_s + RESUME_CONFIRM_S / 2):
            resumed = reading  # The clock seems to run too fast, because delayed messages arrive in a burst.
        self._resumed_readings[clock] = resumed
        return reading.read_at - resumed.read_at >= RESUME_CONFIRM_S

    def _is_expected_reboot(self, frame: Frame, previous: _ClockReading, milliseconds: int) -> bool:
        """Return True if this time since boot shows that an order to reboot was executed."""
        if self._reboot_ordered_at is None:
            return False
        # How far the vehicle's clock is behind its expected time. If this or the previous message was late, the result
        # is wrong by the delay.
        behind_ms = 1000 * (frame.received_at - previous.read_at) - (milliseconds - previous.milliseconds)
        since_order_ms = self._clock_speed() * (self._now() - self._reboot_ordered_at)
        return behind_ms > EXPECTED_REBOOT_MIN_LAG_MS and milliseconds < since_order_ms

    def _is_decrease_confirmed(self, clock: str, milliseconds: int) -> bool:
        """Return True if the time decreased at least ``REBOOT_CONFIRM_S`` ago and has advanced since."""
        reading = _ClockReading(milliseconds, self._connection.now())
        lowest = self._decreased_readings.setdefault(clock, reading)
        if milliseconds < lowest.milliseconds:  # The time has decreased further, so the confirmation starts again.
            self._decreased_readings[clock] = reading
            return False
        return milliseconds > lowest.milliseconds and reading.read_at - lowest.read_at >= REBOOT_CONFIRM_S

    def _on_reboot_detected(self, readings: dict[str, _ClockReading]) -> None:
        """Report a reboot, which these readings have shown."""
        now = self._connection.now()
        # Discard older readings. A comparison with them would show the same reboot again.
        self._last_readings, self._first_readings = readings, {}
        self._decreased_readings = {}
        self._last_answer = _ClockReading(0, now)
        self._reboot_ordered_at = None
        self.reboots += 1
        if self._deliver_again is not None:  # The link was reopened, and the vehicle's frames are held back.
            self.other_boots += 1
        self._on_reboot()
        self._connection.bus.publish(VehicleRebooted(now, self._system_id))
        self._end_hold_back()  # The subscribers above can still see that the link was lost.


class _Counts(NamedTuple):
    """Counters at one time: frames received from the vehicle, its frames that were lost, and bytes on the link."""

    at: float
    received: int
    lost: int
    total_bytes: int


class LinkWatch:
    """Measures the link to one vehicle once a second: loss by sequence numbers, delay by TIMESYNC, rates by counting.

    ArduPilot and PX4 support TIMESYNC (https://mavlink.io/en/services/timesync.html).
    """

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        on_report: Callable[[LinkReport], None],
        on_answer: Callable[[float, int], None],
    ) -> None:
        self._connection = connection
        self._system_id = system_id
        self._component_id = component_id
        self._on_report = on_report
        # Called with each TIMESYNC answer: our time of the request (s), and the vehicle's time (ms).
        self._on_answer = on_answer
        self._round_trip_s: float | None = None
        self._measured_at = -math.inf  # time of the last measurement of the round trip
        # The times (ns) in the unanswered TIMESYNC requests. Each answer repeats the time of its request.
        self._open_requests: deque[int] = deque(maxlen=MAX_OPEN_REQUESTS)
        self._next_request_at = connection.now()
        # The counters at the last report.
        self._counts_before = self._count()
        self._detach = connection.bus.attach(Timesync, self._on_timesync, system_id=system_id)

    def close(self) -> None:
        self._detach()

    @property
    def round_trip_s(self) -> float | None:
        is_recent = self._connection.now() - self._measured_at <= ROUND_TRIP_MAX_AGE_S
        return self._round_trip_s if is_recent else None

    async def run(self, on_tick: Callable[[], None]) -> None:
        """Publish a report and call ``on_tick`` once a second, until the connection ends."""
        self.request_time()
        self._next_request_at = self._connection.now()  # The first iteration of the loop sends the second request.
        while self._connection.is_open:
            started = self._connection.now()
            await anyio.sleep(REPORT_PERIOD_S)
            if self._connection.now() - started > REPORT_PERIOD_S + BLOCKED_THRESHOLD_S:
                # The program blocked the event loop. Let the loop read the heartbeats that have arrived meanwhile.
                await anyio.sleep(CHECK_INTERVAL_S)
            if self._connection.is_open:
                if self._connection.now() >= self._next_request_at:
                    self.request_time()
                self._report()
                on_tick()

    def request_time(self) -> None:
        now = self._connection.now()
        self._next_request_at = now + TIMESYNC_PERIOD_S
        sent_at_ns = int(now * 1e9)
        self._open_requests.append(sent_at_ns)
        self._connection.send(Timesync(tc1=0, ts1=sent_at_ns), to=self._system_id)  # tc1 = 0 marks a request.

    def _on_timesync(self, message: Timesync) -> None:
        frame = message.received_frame
        # A companion computer may answer the same request.
        if frame is None or frame.component_id != self._component_id:
            return
        if message.tc1 != 0 and message.ts1 in self._open_requests:
            self._open_requests.remove(message.ts1)
            now = self._connection.now()
            # An answer that was processed long after its arrival would measure this program's delay, not the link's.
            if now - frame.received_at < CHECK_INTERVAL_S:
                self._round_trip_s, self._measured_at = now - message.ts1 / 1e9, now
            self._on_answer(message.ts1 / 1e9, message.tc1 // 1_000_000)

    def _report(self) -> None:
        counts, before = self._count(), self._counts_before
        self._counts_before = counts
        seconds = max(counts.at - before.at, 1e-9)
        frames = max(0, counts.received - before.received)
        missing = max(0, counts.lost - before.lost)
        report = LinkReport(
            counts.at,
            self._system_id,
            loss_percent=100 * missing / (frames + missing) if frames + missing else None,
            round_trip_s=self.round_trip_s,
            frames_per_s=frames / seconds,
            bytes_per_s=(counts.total_bytes - before.total_bytes) / seconds,
        )
        self._on_report(report)
        self._connection.bus.publish(report)

    def _count(self) -> _Counts:
        total_bytes = sum(statistics.bytes for statistics in self._connection.statistics())
        received, lost = self._connection.counts(self._system_id)
        return _Counts(self._connection.now(), received, lost, total_bytes)
