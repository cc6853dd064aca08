"""Set-points for rovers and submarines: SET_POSITION_TARGET_LOCAL_NED, …_GLOBAL_INT and SET_ATTITUDE_TARGET.

In GUIDED only. Accelerations are not taken by either: a message that has one is ignored as a whole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.messages import SetAttitudeTarget, SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion
from aerokit.sim.setpoints import PositionTarget, Setpoint, is_finite, rotated

_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_FIXED = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED})


@dataclass(frozen=True)
class Target:
    """What one message wants; None is left out. Positions and velocities are north, east, down of the world."""

    position: Ned | None = None
    velocity: Ned | None = None
    backwards: bool = False
    """It is to move with its tail first: a velocity against the first axis, with a heading or a turn beside it."""
    yaw: float | None = None
    yaw_rate: float | None = None
    patience_s: float = 3.0
    """For how long it holds; a position stays."""


class TargetMode(Protocol):
    """The mode that follows targets."""

    number: int
    """The vehicle's number for it."""

    def take(self, target: Target) -> None:
        """Follow it from now on."""
        ...


class Targets:
    """Hears the messages; those with nonsense in them are ignored."""

    BODY_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs in which vectors are relative to the nose."""
    RELATIVE_YAW_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs in which a yaw is."""
    GLOBAL_YAW: ClassVar[bool] = True
    """Whether yaw and turn of a global target are taken."""

    def __init__(self, vehicle: ArduPilotVehicle, mode: TargetMode) -> None:
        self.vehicle: ArduPilotVehicle = vehicle
        self.mode: TargetMode = mode
        vehicle.on(SetPositionTargetLocalNed, self._on_local)
        vehicle.on(SetPositionTargetGlobalInt, self._on_global)
        vehicle.on(SetAttitudeTarget, self._on_attitude)

    def refuse_acceleration(self, message: PositionTarget) -> None:
        """What it says to a message that has one."""

    def steer(self, message: SetAttitudeTarget) -> None:
        """Do as SET_ATTITUDE_TARGET wants it."""

    def is_complete(self, target: Target) -> bool:
        """Whether there is enough in it to move by."""
        return target.position is not None or target.velocity is not None

    @property
    def _is_guided(self) -> bool:
        return self.vehicle.mode.number == self.mode.number

    def _on_attitude(self, message: SetAttitudeTarget, _: Channel) -> None:
        if self._is_guided and all(map(math.isfinite, (*message.q, message.thrust, message.body_yaw_rate))):
            self.steer(message)

    def _on_local(self, message: SetPositionTargetLocalNed, _: Channel) -> None:
        if message.coordinate_frame in _FIXED | self.BODY_FRAMES:
            self._take(message, self._local_point(message), has_yaw=True)

    def _on_global(self, message: SetPositionTargetGlobalInt, _: Channel) -> None:
        frame = message.coordinate_frame
        point = self.vehicle.point(message.lat_int, message.lon_int, message.alt, frame)
        if point is not None or not Setpoint.of(message).has_position:
            self._take(message, point, has_yaw=self.GLOBAL_YAW)

    def _take(self, message: PositionTarget, point: Ned | None, *, has_yaw: bool) -> None:
        asked, frame = Setpoint.of(message), message.coordinate_frame
        if not self._is_guided:
            return
        if asked.has_acceleration:
            self.refuse_acceleration(message)
            return
        position = point if asked.has_position else None
        velocity = asked.velocity if asked.has_velocity else None
        if not is_finite(position, velocity):
            return
        here = self.vehicle.motion.yaw if frame in self.RELATIVE_YAW_FRAMES else 0.0
        yaw = None if asked.yaw is None or not has_yaw else asked.yaw + here
        rate = asked.yaw_rate if has_yaw else None
        backwards = message.vx < 0 and not (yaw is None and rate is None)
        if velocity is not None and frame in self.BODY_FRAMES:
            velocity = rotated(velocity, self.vehicle.motion.yaw)
        target = Target(position, velocity, backwards, yaw, rate)
        if self.is_complete(target):
            self.mode.take(target)

    def _local_point(self, message: SetPositionTargetLocalNed) -> Ned:
        offset, motion = (message.x, message.y, message.z), self.vehicle.motion
        if message.coordinate_frame == MavFrame.LOCAL_NED:
            return self.vehicle.navigation.world(offset)
        if message.coordinate_frame in self.BODY_FRAMES:
            offset = rotated(offset, motion.yaw)
        return (motion.north + offset[0], motion.east + offset[1], motion.down + offset[2])


class RoverTargets(Targets):
    """A heading or a turn alone is enough; thrust is a share of the usual speed."""

    def refuse_acceleration(self, message: PositionTarget) -> None:
        self.vehicle.info(f"Ignoring {message.NAME}; set ACC_IGNORE in mask")

    def is_complete(self, target: Target) -> bool:
        """Of a heading and a turn without a velocity it cannot do both."""
        return super().is_complete(target) or (target.yaw is None) != (target.yaw_rate is None)

    def steer(self, message: SetAttitudeTarget) -> None:
        """The turn counts more than the heading; without thrust it is ignored."""
        if message.type_mask & AttitudeMask.THROTTLE_IGNORE:
            return
        parameters = self.vehicle.parameters
        speed = (parameters["WP_SPEED"] or parameters["CRUISE_SPEED"]) * max(-1.0, min(1.0, message.thrust))
        heading = euler_from_quaternion(*message.q)[2]
        velocity = (abs(speed) * math.cos(heading), abs(speed) * math.sin(heading), 0.0)
        if message.type_mask & AttitudeMask.BODY_YAW_RATE_IGNORE:
            self.mode.take(Target(None, velocity, speed < 0, heading))
        else:
            self.mode.take(Target(None, velocity, speed < 0, None, message.body_yaw_rate))


class SubTargets(Targets):
    """Thrust is a climb: 0.5 holds the depth; lean angles move nothing here. A yaw is relative in one frame only."""

    BODY_FRAMES: ClassVar[frozenset[int]] = _BODY | {MavFrame.BODY_FRD}
    RELATIVE_YAW_FRAMES = frozenset({MavFrame.BODY_OFFSET_NED})
    GLOBAL_YAW: ClassVar[bool] = False

    def steer(self, message: SetAttitudeTarget) -> None:
        """Only with both attitude and thrust; it holds for one second."""
        if message.type_mask & (AttitudeMask.ATTITUDE_IGNORE | AttitudeMask.THROTTLE_IGNORE):
            return
        share = 2.0 * (max(0.0, min(1.0, message.thrust)) - 0.5)
        parameters = self.vehicle.parameters
        climb = share * parameters["WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN"] / 100.0
        _, _, yaw = euler_from_quaternion(*message.q)
        self.mode.take(Target(None, (0.0, 0.0, -climb), False, yaw, patience_s=1.0))
