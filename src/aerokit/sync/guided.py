"""Guided set-points for programs without ``async``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.vehicle.setpoints import (
    AccelerationSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    VelocitySetpoint,
)

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.guided import Guided as AsyncGuided
    from aerokit.vehicle.guided import SetpointStream as AsyncSetpointStream

__all__ = ["Guided", "SetpointStream"]

SetpointT = TypeVar("SetpointT")

_VELOCITY, _BODY_VELOCITY, _ACCELERATION = VelocitySetpoint(), BodyVelocitySetpoint(), AccelerationSetpoint()


class Guided:
    """Opens set-point streams: ``with vehicle.guided.velocity() as stream: stream.set(...)``.

    As :class:`aerokit.vehicle.guided.Guided`: the stream lives as long as the code that feeds it. A program that sleeps
    longer than ``valid_for_s`` without a new set-point has stopped steering, and the vehicle holds.
    """

    def __init__(self, loop: LoopThread, guided: AsyncGuided) -> None:
        self._loop, self._guided = loop, guided

    def velocity(
        self,
        initial: VelocitySetpoint = _VELOCITY,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[VelocitySetpoint]:
        """Stream velocities over ground (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream(self._guided.velocity(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def body_velocity(
        self,
        initial: BodyVelocitySetpoint = _BODY_VELOCITY,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[BodyVelocitySetpoint]:
        """Stream velocities as seen from the vehicle (SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_BODY_NED)."""
        return self._stream(self._guided.body_velocity(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def acceleration(
        self,
        initial: AccelerationSetpoint = _ACCELERATION,
        *,
        rate_hz: float = 20.0,
        valid_for_s: float = 0.5,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[AccelerationSetpoint]:
        """Stream accelerations (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream(self._guided.acceleration(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def local_position(
        self,
        initial: LocalPositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[LocalPositionSetpoint]:
        """Stream places in the local frame (SET_POSITION_TARGET_LOCAL_NED)."""
        return self._stream(self._guided.local_position(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def position(
        self,
        initial: PositionSetpoint,
        *,
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> SetpointStream[PositionSetpoint]:
        """Stream places on the globe (SET_POSITION_TARGET_GLOBAL_INT)."""
        return self._stream(self._guided.position(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def attitude(
        self,
        initial: AttitudeSetpoint,
        *,
        rate_hz: float = 50.0,
        valid_for_s: float = 0.3,
        max_lag_s: float = 0.3,
    ) -> SetpointStream[AttitudeSetpoint]:
        """Stream attitudes with thrust (SET_ATTITUDE_TARGET)."""
        return self._stream(self._guided.attitude(initial, **_limits(rate_hz, valid_for_s, max_lag_s)))

    def _stream(self, stream: AsyncSetpointStream[SetpointT]) -> SetpointStream[SetpointT]:
        return SetpointStream(self._loop, stream)


class SetpointStream(Generic[SetpointT]):
    """Sends the latest set-point at a rate while its ``with`` block feeds it; leaving it, in any way, means hold.

    As :class:`aerokit.vehicle.guided.SetpointStream`.
    """

    def __init__(self, loop: LoopThread, stream: AsyncSetpointStream[SetpointT]) -> None:
        self._loop, self._stream = loop, stream

    @property
    def is_running(self) -> bool:
        """Whether set-points are being sent."""
        return self._stream.is_running

    def set(self, setpoint: SetpointT) -> None:
        """Take a new set-point; it is sent at the next tick, and resent until ``valid_for_s`` has passed.

        Raises:
            LocalProtocolError: a value is out of range; the one before stays in force until it is too old.
            SetpointStreamStopped: the stream has ended by itself, or the block was left.
        """
        self._loop.call(self._stream.set, setpoint)

    def fly(self, setpoint: SetpointT, duration_s: float) -> None:
        """Feed one set-point for ``duration_s`` seconds; SetpointStreamStopped when the stream ended meanwhile."""
        self._loop.run(self._stream.fly, setpoint, duration_s)

    def __enter__(self) -> Self:
        self._loop.enter(self._stream)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._loop.run(self._stream.__aexit__, exc_type, exc, traceback)


def _limits(rate_hz: float, valid_for_s: float, max_lag_s: float) -> dict[str, float]:
    return {"rate_hz": rate_hz, "valid_for_s": valid_for_s, "max_lag_s": max_lag_s}
