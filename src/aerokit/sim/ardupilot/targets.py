"""Set-points for rovers and submarines: SET_POSITION_TARGET_LOCAL_NED and …_GLOBAL_INT, in GUIDED only."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.messages import SetPositionTargetGlobalInt, SetPositionTargetLocalNed

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.navigation import Ned
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.channel import Channel

__all__ = ["Target", "TargetMode", "Targets"]

_POSITION = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE
_VELOCITY = Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE
_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_LOCAL = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED}) | _BODY

PositionTarget = SetPositionTargetLocalNed | SetPositionTargetGlobalInt


@dataclass(frozen=True)
class Target:
    """What one message wants; None is left out. Positions and velocities are north, east, down of the world."""

    position: Ned | None = None
    velocity: Ned | None = None
    backwards: bool = False
    """The velocity was given relative to the nose, and points behind it."""
    yaw: float | None = None
    yaw_rate: float | None = None


class TargetMode(Protocol):
    """The mode that follows targets."""

    number: ClassVar[int]

    def take(self, target: Target) -> None:
        """Follow it from now on."""
        ...


class Targets:
    """Hears the messages; those with nonsense in them are ignored."""

    def __init__(self, vehicle: ArduPilotVehicle, mode: TargetMode) -> None:
        self._vehicle, self._mode = vehicle, mode
        vehicle.on(SetPositionTargetLocalNed, self._on_local)
        vehicle.on(SetPositionTargetGlobalInt, self._on_global)

    def _on_local(self, message: SetPositionTargetLocalNed, _: Channel) -> None:
        if message.coordinate_frame in _LOCAL:
            self._take(message, self._local_point(message), body=message.coordinate_frame in _BODY)

    def _on_global(self, message: SetPositionTargetGlobalInt, _: Channel) -> None:
        frame = message.coordinate_frame
        point = self._vehicle.point(message.lat_int, message.lon_int, message.alt, frame)
        if point is not None or message.type_mask & _POSITION:
            self._take(message, point, body=False)

    def _take(self, message: PositionTarget, point: Ned | None, *, body: bool) -> None:
        mask, wanted = message.type_mask, (message.vx, message.vy, message.vz)
        if self._vehicle.mode.number != self._mode.number:
            return
        position = None if mask & _POSITION else point
        velocity = None if mask & _VELOCITY else wanted
        if (position is None and velocity is None) or not all(
            map(math.isfinite, (*(position or ()), *wanted))
        ):
            return
        if velocity is not None and body:
            velocity = self._rotated(velocity)
        here = self._vehicle.motion.yaw if body else 0.0
        yaw = None if mask & Mask.YAW_IGNORE else message.yaw + here
        rate = None if mask & Mask.YAW_RATE_IGNORE else message.yaw_rate
        self._mode.take(Target(position, velocity, body and message.vx < 0, yaw, rate))

    def _local_point(self, message: SetPositionTargetLocalNed) -> Ned:
        offset, motion = (message.x, message.y, message.z), self._vehicle.motion
        if message.coordinate_frame == MavFrame.LOCAL_NED:
            return self._vehicle.navigation.world(offset)
        if message.coordinate_frame in _BODY:
            offset = self._rotated(offset)
        return (motion.north + offset[0], motion.east + offset[1], motion.down + offset[2])

    def _rotated(self, vector: Ned) -> Ned:
        cos_yaw, sin_yaw = math.cos(self._vehicle.motion.yaw), math.sin(self._vehicle.motion.yaw)
        forward, right, down = vector
        return (forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down)
