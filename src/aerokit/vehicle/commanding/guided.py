"""Guided set-points, streamed at a fixed rate while a program supplies them.

An autopilot stops by itself when set-points stop arriving (ArduCopter after 3 s, PX4 after 1 s). A library that
resends the last set-point without limit defeats that protection. aerokit ends the stream and orders the vehicle to hold
when the code that supplies set-points ends, raises, is cancelled, stops supplying them, or blocks the event loop, and
when the vehicle falls silent.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from aerokit._internal.arguments import check_kind, checks_arguments
from aerokit.errors import NotSupported
from aerokit.vehicle.commanding.ground import ImpactDetector
from aerokit.vehicle.commanding.progress import StallDetector
from aerokit.vehicle.commanding.setpoints import (
    AccelerationSetpoint,
    ActuatorSetpoint,
    AttitudeRateSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    SetpointEncoder,
    TrajectorySetpoint,
    VelocitySetpoint,
    wants_motion,
)
from aerokit.vehicle.commanding.streams import SteeringStream

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["Guided", "SetpointStream"]

SetpointT = TypeVar("SetpointT")

# Some autopilots restart their path at each position set-point. They get a new set-point INITIAL_REPEATS times at the
# stream's rate, because a message may be lost, and after that only every REPEAT_INTERVAL_S seconds.
INITIAL_REPEATS, REPEAT_INTERVAL_S = 3, 5.0

# The autopilot limits the acceleration for these set-points. While it follows them, a sudden stop means an impact.
BRAKED_BY_AUTOPILOT = (
    VelocitySetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    TrajectorySetpoint,
)


@checks_arguments
class Guided:
    """Opens set-point streams: ``async with vehicle.guided.velocity() as stream: stream.set(...)``.

    All streams have the same arguments. ``rate_hz`` (2 to 400) is the transmission rate of the latest set-point. The
    stream stops if it gets no new set-point for ``valid_for_s`` seconds, or if the event loop is late by ``max_lag_s``
    seconds. NotSupported is raised for a kind of set-point that this type of vehicle does not support. Rates and
    seconds are in real time: a simulation at ten times the speed needs ten times the rate.
    """

    def __init__(self, context: VehicleContext) -> None:
        self._context = context
        self._encode = SetpointEncoder(context)

    def velocity(
        self,
        initial: VelocitySetpoint = VelocitySetpoint(),
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[VelocitySetpoint]:
        """Stream velocities over ground (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("velocity", self._encode.local, initial, rate_hz, valid_for_s, max_lag_s)

    def body_velocity(
        self,
        initial: BodyVelocitySetpoint = BodyVelocitySetpoint(),
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[BodyVelocitySetpoint]:
        """Stream velocities in the body frame (SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_BODY_NED).

        With ``yaw_deg`` on ArduPilot, the velocity does not turn with the vehicle: "forward" stays the direction of the
        vehicle's nose at the time of ``set``. Therefore call ``set`` often during a turn.
        """
        return self._stream("velocity", self._encode.body_velocity, initial, rate_hz, valid_for_s, max_lag_s)

    def acceleration(
        self,
        initial: AccelerationSetpoint = AccelerationSetpoint(),
        *,
        rate_hz: float = 20.0,
        valid_for_s: float = 0.5,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[AccelerationSetpoint]:
        """Stream accelerations (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("acceleration", self._encode.local, initial, rate_hz, valid_for_s, max_lag_s)

    def local_position(
        self,
        initial: LocalPositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[LocalPositionSetpoint]:
        """Stream positions in the local frame (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("local position", self._encode.local, initial, rate_hz, valid_for_s, max_lag_s)

    def position(
        self,
        initial: PositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[PositionSetpoint]:
        """Stream global positions (SET_POSITION_TARGET_GLOBAL_INT)."""
        return self._stream("global position", self._encode.position, initial, rate_hz, valid_for_s, max_lag_s)

    def attitude(
        self,
        initial: AttitudeSetpoint,
        *,
        rate_hz: float = 50.0,
        valid_for_s: float = 0.3,
        max_lag_s: float = 0.3,
    ) -> SetpointStream[AttitudeSetpoint]:
        """Stream attitudes with thrust (SET_ATTITUDE_TARGET)."""
        return self._stream("attitude", self._encode.attitude, initial, rate_hz, valid_for_s, max_lag_s)

    def attitude_rate(
        self,
        initial: AttitudeRateSetpoint = AttitudeRateSetpoint(),
        *,
        rate_hz: float = 100.0,
        valid_for_s: float = 0.1,
        max_lag_s: float = 0.1,
    ) -> SetpointStream[AttitudeRateSetpoint]:
        """Stream body rates with thrust to ArduCopter or PX4 (SET_ATTITUDE_TARGET without an attitude).

        Without ``initial``, the stream begins with rates of 0 and ``thrust`` 0.5; see :class:`AttitudeSetpoint`. The
        autopilot does not level the vehicle, which keeps turning at these rates until the next set-point. Without a new
        set-point for ``valid_for_s``, aerokit orders a hold.
        """
        return self._stream("attitude rate", self._encode.attitude_rate, initial, rate_hz, valid_for_s, max_lag_s)

    def trajectory(
        self,
        initial: TrajectorySetpoint,
        *,
        rate_hz: float = 50.0,
        valid_for_s: float = 0.5,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[TrajectorySetpoint]:
        """Stream local positions with velocity and acceleration feed-forward (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream("trajectory", self._encode.local, initial, rate_hz, valid_for_s, max_lag_s)

    def actuators(
        self,
        initial: ActuatorSetpoint,
        *,
        rate_hz: float = 100.0,
        valid_for_s: float = 0.1,
        max_lag_s: float = 0.1,
    ) -> SetpointStream[ActuatorSetpoint]:
        """Stream actuator controls (SET_ACTUATOR_CONTROL_TARGET).

        PX4 executes them up to version 1.13; newer versions, and ArduPilot, ignore the message.

        Raises:
            NotSupported: this firmware ignores the message, or its version is not known yet. Nothing was sent.
        """
        session = self._context.session
        version = session.telemetry.version.latest
        firmware, supported_before = session.autopilot.firmware, session.autopilot.actuators_until
        if supported_before is None:
            reason = f"{firmware} ignores SET_ACTUATOR_CONTROL_TARGET"
        elif version is None:
            reason = f"the version of {firmware} is not known yet"
        elif version.number[:2] >= supported_before:
            reason = f"{firmware} {version.firmware} ignores SET_ACTUATOR_CONTROL_TARGET"
        else:
            return SetpointStream(self._context, self._encode.actuators, initial, rate_hz, valid_for_s, max_lag_s)
        raise NotSupported(
            f"{reason}; only PX4 before 1.14 executes SET_ACTUATOR_CONTROL_TARGET; nothing was sent."
            " Use vehicle.guided.attitude_rate()"
        )

    def _stream(
        self, kind: str, encode: Callable[[SetpointT], Message], initial: SetpointT, *timing: float
    ) -> SetpointStream[SetpointT]:
        autopilot = self._context.session.autopilot
        if kind not in autopilot.setpoints.names:
            supported = ", ".join(autopilot.setpoints.names) or "none"
            raise NotSupported(f"{autopilot.firmware} does not support {kind} set-points; supported: {supported}")
        return SetpointStream(self._context, encode, initial, *timing)


@checks_arguments
class SetpointStream(SteeringStream[SetpointT]):
    """Sends the latest set-point at a fixed rate while the ``async with`` block supplies set-points.

    Entering the block changes to the set-point mode (GUIDED, OFFBOARD) with the initial set-point. Leaving the block in
    any way, or a stop of the stream, orders the vehicle to hold. After a newer order, or a takeover by a pilot or a
    failsafe, the stream sends nothing more, not even the hold.

    The stream stops by itself if there is no new set-point for ``valid_for_s``, or if the event loop is late by
    ``max_lag_s``. It stops if the vehicle leaves the mode, disarms or falls silent. It also stops if the vehicle hits
    the ground (velocities, positions and trajectories only), or stays in place for twelve seconds although it should
    move. The next ``set``, or else the end of the block, raises :class:`SetpointStreamStopped`.
    """

    _NAME, _VALUE = "set-point stream", "set-point"

    def __init__(
        self,
        context: VehicleContext,
        encode: Callable[[SetpointT], Message],
        initial: SetpointT,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        super().__init__(context, encode, initial, rate_hz, valid_for_s, max_lag_s)
        is_place = isinstance(initial, (PositionSetpoint, LocalPositionSetpoint))
        self._restarts_path = is_place and context.session.autopilot.setpoints.position_restarts_path
        # How often the present set-point is still sent at the stream's rate, and when it was sent last.
        self._repeats_left = INITIAL_REPEATS
        self._sent_at = -math.inf
        self._stall = StallDetector(context.session)
        if isinstance(initial, BRAKED_BY_AUTOPILOT):
            self._impact = ImpactDetector(context.session.telemetry)

    def set(self, setpoint: SetpointT) -> None:
        """Replace the set-point; it is sent at the next tick and resent until ``valid_for_s`` has passed.

        Raises:
            InvalidArgument: a value is out of range; the previous set-point remains in force until it expires.
            ValueUnknownError: a body velocity has a ``yaw_deg``, and ArduPilot has not reported its heading for 2 s.
            SetpointStreamStopped: the stream has ended by itself, or its `async with` block was left.
        """
        check_kind("setpoint", setpoint, type(self._value))
        self._set(setpoint)

    async def fly(self, setpoint: SetpointT, duration_s: float) -> None:
        """Send one set-point for ``duration_s`` seconds.

        Raises:
            SetpointStreamStopped: the stream ended meanwhile.
        """
        check_kind("setpoint", setpoint, type(self._value))
        await self._supply_for(setpoint, duration_s)

    def _stream_mode(self) -> Mode:
        return self._context.sender.mode_for("a set-point stream", "setpoint")

    def _replace_value(self, value: SetpointT) -> None:
        value_before = self._value
        super()._replace_value(value)
        if value != value_before:
            self._repeats_left = INITIAL_REPEATS

    def _send(self) -> None:
        is_due = self._repeats_left > 0 or self._now() - self._sent_at >= REPEAT_INTERVAL_S
        if is_due or not self._restarts_path:
            super()._send()
            self._repeats_left -= 1
            self._sent_at = self._now()

    def _stop_reason(self, lag: float) -> str | None:
        if self._mode is None or not wants_motion(self._value, self._context):
            # A vehicle that does not have to move cannot stall, so the detection starts again.
            self._stall = StallDetector(self._session)
        return super()._stop_reason(lag) or self._stall()
