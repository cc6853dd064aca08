"""Set-point messages for GUIDED: SET_POSITION_TARGET_LOCAL_NED, …_GLOBAL_INT and SET_ATTITUDE_TARGET.

Outside GUIDED they are ignored without a word. Inside, nonsense stops the vehicle, as in ArduCopter.
https://ardupilot.org/dev/docs/copter-commands-in-guided-mode.html
"""

from __future__ import annotations

import math

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.messages import SetAttitudeTarget, SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion
from aerokit.sim.setpoints import PositionTarget, Setpoint, is_finite, rotated

_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_LOCAL = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED}) | _BODY
_ALL_RATES = (
    AttitudeMask.BODY_ROLL_RATE_IGNORE
    | AttitudeMask.BODY_PITCH_RATE_IGNORE
    | AttitudeMask.BODY_YAW_RATE_IGNORE
)
_FASTEST = 1000.0
_STILL: Ned = (0.0, 0.0, 0.0)


class Setpoints:
    """Turns the messages into what `Guided` understands."""

    def __init__(self, copter: CopterHost) -> None:
        self._copter = copter
        copter.on(SetPositionTargetLocalNed, self._on_local)
        copter.on(SetPositionTargetGlobalInt, self._on_global)
        copter.on(SetAttitudeTarget, self._on_attitude)

    @property
    def _guided(self) -> Guided:
        return self._copter.mode_of(Guided)

    @property
    def _is_guided(self) -> bool:
        return self._copter.mode is self._guided

    def _on_local(self, target: SetPositionTargetLocalNed, _: Channel) -> None:
        if not self._is_guided:
            return
        if target.coordinate_frame not in _LOCAL:
            self._guided.enter(force=False)
            return
        self._apply(target, self._local_point(target), rotate=target.coordinate_frame in _BODY)

    def _on_global(self, target: SetPositionTargetGlobalInt, _: Channel) -> None:
        if not self._is_guided:
            return
        point = self._copter.point(target.lat_int, target.lon_int, target.alt, target.coordinate_frame)
        if point is None and Setpoint.of(target).has_position:
            self._guided.enter(force=False)
            return
        self._apply(target, (0.0, 0.0, 0.0) if point is None else point, rotate=False)

    def _apply(self, target: PositionTarget, point: Ned, *, rotate: bool) -> None:
        guided, asked = self._guided, Setpoint.of(target)
        velocity = asked.velocity if asked.has_velocity else _STILL
        acceleration = asked.acceleration if asked.has_acceleration else _STILL
        is_sane = all(abs(part) <= _FASTEST for part in velocity)
        if asked.is_force or not is_sane or not is_finite(acceleration, point):
            guided.enter(force=False)
            return
        if rotate:
            yaw = self._copter.motion.yaw
            velocity, acceleration = rotated(velocity, yaw), rotated(acceleration, yaw)
        if asked.has_position and asked.has_velocity:
            guided.follow(point, velocity, acceleration)
        elif asked.has_velocity:
            guided.move(velocity, acceleration)
        elif asked.has_acceleration and not asked.has_position:
            guided.accelerate(acceleration)
        elif asked.has_position and not asked.has_acceleration:
            guided.go_to(point)
        else:
            guided.enter(force=False)
            return
        self._set_yaw(asked, relative=rotate)

    def _set_yaw(self, asked: Setpoint, *, relative: bool) -> None:
        yaw = self._copter.yaw
        if asked.yaw is not None:
            yaw.fixed(asked.yaw + (self._copter.motion.yaw if relative else 0.0))
        elif asked.yaw_rate is not None:
            yaw.turn(asked.yaw_rate)
        else:
            yaw.default()

    def _local_point(self, target: SetPositionTargetLocalNed) -> Ned:
        """The target's point in the world."""
        frame, motion, offset = target.coordinate_frame, self._copter.motion, (target.x, target.y, target.z)
        if frame == MavFrame.LOCAL_NED:
            return self._copter.navigation.world(offset)
        if frame in _BODY:
            offset = rotated(offset, motion.yaw)
        return (motion.north + offset[0], motion.east + offset[1], motion.down + offset[2])

    def _on_attitude(self, target: SetAttitudeTarget, _: Channel) -> None:
        copter, mask = self._copter, target.type_mask
        guided = copter.mode
        if not isinstance(guided, Guided):
            return
        rates_ignored = mask & _ALL_RATES
        size = math.sqrt(sum(part * part for part in target.q))
        ill = mask & AttitudeMask.THROTTLE_IGNORE or rates_ignored not in (0, _ALL_RATES)
        if ill or (not mask & AttitudeMask.ATTITUDE_IGNORE and not abs(size - 1.0) < 1e-3):
            guided.enter(force=False)
            return
        roll = pitch = 0.0
        if not mask & AttitudeMask.ATTITUDE_IGNORE:
            roll, pitch, yaw = euler_from_quaternion(*target.q)
            copter.motion.face(yaw)
        elif not rates_ignored:
            copter.motion.turn(target.body_yaw_rate)
        guided.lean(roll, pitch, self._climb(target.thrust))

    def _climb(self, thrust: float) -> float:
        """Thrust is a climb rate, 0.5 holds the height; the meaning by GUID_OPTIONS is not simulated."""
        share = (max(0.0, min(1.0, thrust)) - 0.5) * 2.0
        parameters = self._copter.parameters
        return share * parameters["WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN"] / 100.0
