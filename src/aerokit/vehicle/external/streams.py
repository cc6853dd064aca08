"""`MeasurementStream`: sends measurements of your program to the vehicle, each once and only while it is recent."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Generic, Literal, NamedTuple, TypeAlias, TypeVar

from aerokit._internal.arguments import check_kind, check_range, checks_arguments
from aerokit.errors import NotSupported, OperationRejected, SetpointStreamStopped
from aerokit.mavlink.messages import Timesync
from aerokit.vehicle.commanding.streams import MAX_RATE_HZ, known_values
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import Self

    from aerokit.autopilots.external import ExternalKind
    from aerokit.connection.bus import Detach
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.streams import Probe
    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["EstimatorUse", "MeasurementStream", "MeasurementT"]

MeasurementT = TypeVar("MeasurementT")
EstimatorUse: TypeAlias = Literal["used", "not used", "unknown"]

# Flag of EKF_STATUS_REPORT and ESTIMATOR_STATUS: the estimator does not know the position and assumes a constant one.
CONSTANT_POSITION = 1 << 7
# A report of the estimator that is older than this many seconds does not show its present state.
ESTIMATOR_MAX_AGE_S = 2.5


class TimesyncAnswers:
    """Answers the vehicle's TIMESYNC requests with the clock of the event loop while a stream is open.

    PX4 needs the answers to convert the time stamps of measurements to its own clock (Timesync.cpp, sync_stamp). Until
    PX4 knows the offset between the clocks, it uses the time of arrival. ArduPilot always uses the time of arrival.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        self._open_streams = 0  # number of open streams, which all need the answers
        self._detach: Detach | None = None

    def open(self) -> None:
        """Start to answer requests. Each call must be paired with a call of `close`."""
        self._open_streams += 1
        if self._open_streams == 1:
            bus = self._session.connection.bus
            self._detach = bus.attach(Timesync, self._on_timesync, system_id=self._session.system_id)

    def close(self) -> None:
        self._open_streams -= 1
        if self._open_streams == 0 and self._detach is not None:
            self._detach()
            self._detach = None

    def _on_timesync(self, request: Timesync) -> None:
        frame = request.received_frame
        # In a request, tc1 is 0.
        if request.tc1 == 0 and frame is not None and frame.component_id == self._session.component_id:
            connection = self._session.connection
            if connection.is_open:
                answer = Timesync(tc1=int(frame.received_at * 1e9), ts1=request.ts1)
                connection.send(answer, to=self._session.system_id)


class _EncodedMeasurement(NamedTuple):
    messages: tuple[Message, ...]
    measured_at: float


@checks_arguments
class MeasurementStream(Generic[MeasurementT]):
    """Sends the measurements passed to ``send``: each at most once, and at most ``rate_hz`` measurements a second.

    If your program supplies no new measurement, nothing is sent, and the vehicle behaves as if its sensor had failed.
    Of several measurements within one period, only the newest is sent. A measurement is dropped if it is older than
    ``valid_for_s`` when it is due to be sent, for example after the event loop was blocked. While the vehicle is
    silent, all measurements are dropped. ``sent`` and ``dropped`` count measurements. The stream ends only with its
    `async with` block.

    Entering raises:
        NotSupported: this firmware does not read such measurements. Nothing was sent.
        OperationRejected: a parameter makes the vehicle ignore such measurements; the error text names it. No
            measurement was sent.
        ParameterTimeout: the vehicle did not report a parameter that aerokit must check first.
    """

    def __init__(
        self,
        session: VehicleSession,
        kind: ExternalKind,
        value_type: type[MeasurementT],
        encode: Callable[[MeasurementT], tuple[Message, ...]],
        timesync_answers: TimesyncAnswers,
        probe: Probe,
        rate_hz: float,
        valid_for_s: float,
    ) -> None:
        check_range("rate_hz", rate_hz, 0, MAX_RATE_HZ, above=True)
        check_range("valid_for_s", valid_for_s, 0, 60, above=True)
        self._session = session
        self._kind: ExternalKind = kind
        self._value_type = value_type
        self._encode = encode
        self._timesync_answers = timesync_answers
        self._probe = probe
        self._period_s = 1 / rate_hz
        self._valid_for_s = valid_for_s
        # Parameters that decide whether the vehicle uses the measurements. `__aenter__` reads them.
        self._parameters: dict[str, float] = {}
        # The measurement to send at the end of the period.
        self._waiting: _EncodedMeasurement | None = None
        # Calls `_send_waiting` at the end of the period, if a measurement waits.
        self._timer: asyncio.TimerHandle | None = None
        # End of the present period. The next measurement is sent at this time at the earliest.
        self._period_ends_at = -math.inf
        self._is_open = False
        self._was_entered = False
        self._sent = 0
        self._dropped = 0

    @property
    def sent(self) -> int:
        """Number of measurements that were sent."""
        return self._sent

    @property
    def dropped(self) -> int:
        """Number of measurements that were not sent: replaced, too old, or given while the vehicle was silent."""
        return self._dropped

    @property
    def is_open(self) -> bool:
        """True inside the stream's `async with` block."""
        return self._is_open

    @property
    def estimator_use(self) -> EstimatorUse:
        """Use of these measurements by the vehicle's estimator: ``"used"``, ``"not used"`` or ``"unknown"``.

        No message reports this, so aerokit derives it from EKF_STATUS_REPORT or ESTIMATOR_STATUS and from parameters
        that it read when the stream was entered. ``"used"``: the estimator has a position, and its parameters allow no
        other source of it. ``"not used"``: the estimator has no position. ``"unknown"``: all other cases, for example
        if the vehicle also has a GPS, for sensors that supply no position, or without a recent report.
        """
        rule = self._session.autopilot.external.kinds.get(self._kind)
        estimator = self._session.telemetry.estimator
        health = estimator.latest
        if rule is None or not rule.sole_source:  # These measurements supply no position.
            return "unknown"
        if health is None or estimator.age > ESTIMATOR_MAX_AGE_S:
            return "unknown"
        if not self._parameters or not self._sent:  # The stream was not entered, or has sent nothing.
            return "unknown"
        has_position = health.has_relative_position or health.has_absolute_position
        # PX4 also sets CONSTANT_POSITION while the vehicle stands still on the ground.
        is_resting = is_reported_on_ground(self._session.telemetry)
        is_flag_expected = is_resting and self._session.autopilot.external.constant_position_at_rest
        assumes_constant = health.flags & CONSTANT_POSITION and not is_flag_expected
        if assumes_constant or not has_position:
            return "not used"
        # The first parameter selects the source of the position and must exist. The others may be missing.
        selecting_parameter, _ = rule.sole_source[0]
        is_sole_source = selecting_parameter in self._parameters and all(
            self._parameters[name] in allowed for name, allowed in rule.sole_source if name in self._parameters
        )
        return "used" if is_sole_source else "unknown"

    def send(self, measurement: MeasurementT) -> None:
        """Send a measurement: now, or when the period of the previous measurement ends.

        Raises:
            InvalidArgument: a value is out of range; nothing was sent.
            SetpointStreamStopped: the `async with` block of this stream was left, or not entered.
            ValueUnknownError: PX4's attitude or local position is unknown, which a landing target requires.
            ConnectionClosed: the connection has ended.
        """
        check_kind("measurement", measurement, self._value_type)
        if not self._is_open:
            raise SetpointStreamStopped(f"this {self._kind} stream is not open: use it inside its `async with` block")
        messages = self._encode(measurement)
        for message in messages:
            message.encode()  # An invalid value raises here, and not when the timer sends the message.
        self._session.connection.raise_if_ended()
        now = self._session.connection.now()
        measured_at: float | None = getattr(measurement, "measured_at", None)
        if self._waiting is not None:  # The new measurement replaces the waiting one.
            self._dropped += 1
        self._waiting = _EncodedMeasurement(messages, now if measured_at is None else measured_at)
        if now >= self._period_ends_at:
            self._send_waiting()
        elif self._timer is None:
            self._timer = asyncio.get_running_loop().call_at(self._period_ends_at, self._send_waiting)

    def _send_waiting(self) -> None:
        """Send the waiting measurement, unless it is too old or the vehicle is silent, and begin the next period."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._waiting is None:
            return
        messages, measured_at = self._waiting
        self._waiting = None
        session, now = self._session, self._session.connection.now()
        age_s = now - measured_at + session.connection._slept_since(measured_at)
        if age_s > self._valid_for_s or session.watch.is_silent or not session.connection.is_open:
            self._dropped += 1
            return
        # A late transmission does not delay the following periods, so that the average rate is kept. After a pause of
        # more than a period, the periods start again from now.
        next_end = self._period_ends_at + self._period_s
        self._period_ends_at = next_end if next_end > now else now + self._period_s
        for message in messages:
            session.send(message)
        self._sent += 1

    async def __aenter__(self) -> Self:
        if self._was_entered:
            raise SetpointStreamStopped(f"this {self._kind} stream can be entered only once: open another one")
        self._was_entered = True
        self._parameters = await self._check_support()
        self._timesync_answers.open()
        self._is_open = True
        return self

    async def __aexit__(self, *_: object) -> None:
        self._is_open = False
        self._waiting = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._timesync_answers.close()

    async def _check_support(self) -> dict[str, float]:
        """Raise if the vehicle ignores these measurements. Return the parameters that decide this."""
        firmware, rule = self._session.autopilot.firmware, self._session.autopilot.external.kinds.get(self._kind)
        measurement = self._kind.replace("_", " ")
        if rule is None:
            raise NotSupported(f"{measurement}: {firmware} does not read these measurements from MAVLink")
        required_names = [name for names, _ in rule.required for name in names]
        values = await known_values(self._probe, *required_names, *(name for name, _ in rule.sole_source))
        for names, allowed in rule.required:  # ``names`` are the names of one parameter in several firmware versions.
            present_name = next((name for name in names if name in values), None)
            if present_name is None:
                raise OperationRejected(
                    f"{measurement}: this build of {firmware} ignores the measurements, because it has no parameter"
                    f" {' or '.join(names)}"
                )
            if values[present_name] not in allowed:
                choices = " or ".join(f"{value:g}" for value in allowed[:4])
                raise OperationRejected(
                    f"{measurement}: {present_name} = {values[present_name]:g}, so {firmware} ignores the measurements;"
                    f" set {present_name} to {choices} and reboot"
                )
        return values
