"""Set-point messages for GUIDED: SET_POSITION_TARGET_LOCAL_NED, …_GLOBAL_INT and SET_ATTITUDE_TARGET.

Outside GUIDED they are ignored without a word. Inside, nonsense stops the vehicle, as in ArduCopter.
https://ardupilot.org/dev/docs/copter-commands-in-guided-mode.html
"""

from __future__ import annotations

import math

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavFrame
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.mavlink.messages import SetAttitudeTarget, SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion

_POSITION = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE
_VELOCITY = Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE
_ACCELERATION = Mask.AX_IGNORE | Mask.AY_IGNORE | Mask.AZ_IGNORE
_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_LOCAL = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED}) | _BODY
_ALL_RATES = (
    AttitudeMask.BODY_ROLL_RATE_IGNORE
    | AttitudeMask.BODY_PITCH_RATE_IGNORE
    | AttitudeMask.BODY_YAW_RATE_IGNORE
)
_FASTEST = 1000.0

PositionTarget = SetPositionTargetLocalNed | SetPositionTargetGlobalInt


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
        if point is None and not target.type_mask & _POSITION:
            self._guided.enter(force=False)
            return
        self._apply(target, (0.0, 0.0, 0.0) if point is None else point, rotate=False)

    def _apply(self, target: PositionTarget, point: Ned, *, rotate: bool) -> None:
        guided, mask = self._guided, target.type_mask
        velocity, acceleration = (target.vx, target.vy, target.vz), (target.afx, target.afy, target.afz)
        no_position, no_velocity = bool(mask & _POSITION), bool(mask & _VELOCITY)
        no_acceleration = bool(mask & _ACCELERATION)
        force_not_supported = bool(mask & Mask.FORCE_SET) and not no_acceleration
        is_sane = (no_velocity or _is_sane(velocity)) and (no_acceleration or _is_number(acceleration))
        if force_not_supported or not is_sane or not _is_number(point):
            guided.enter(force=False)
            return
        velocity = (0.0, 0.0, 0.0) if no_velocity else self._rotated(velocity, rotate=rotate)
        acceleration = (0.0, 0.0, 0.0) if no_acceleration else self._rotated(acceleration, rotate=rotate)
        if not no_position and not no_velocity:
            guided.follow(point, velocity, acceleration)
        elif no_position and not no_velocity:
            guided.move(velocity, acceleration)
        elif no_position and not no_acceleration:
            guided.accelerate(acceleration)
        elif not no_position and no_acceleration:
            guided.go_to(point)
        else:
            guided.enter(force=False)
            return
        self._set_yaw(target, relative=rotate)

    def _set_yaw(self, target: PositionTarget, *, relative: bool) -> None:
        yaw, mask = self._copter.yaw, target.type_mask
        if not mask & Mask.YAW_IGNORE:
            yaw.fixed(target.yaw + (self._copter.motion.yaw if relative else 0.0))
        elif not mask & Mask.YAW_RATE_IGNORE:
            yaw.turn(target.yaw_rate)
        else:
            yaw.default()

    def _local_point(self, target: SetPositionTargetLocalNed) -> Ned:
        frame, motion = target.coordinate_frame, self._copter.motion
        if frame == MavFrame.LOCAL_NED:
            return self._copter.navigation.world((target.x, target.y, target.z))
        offset = self._rotated((target.x, target.y, target.z), rotate=frame in _BODY)
        return (motion.north + offset[0], motion.east + offset[1], motion.down + offset[2])

    def _rotated(self, vector: Ned, *, rotate: bool) -> Ned:
        if not rotate:
            return vector
        cos_yaw, sin_yaw = math.cos(self._copter.motion.yaw), math.sin(self._copter.motion.yaw)
        forward, right, down = vector
        return (forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down)

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


def _is_sane(vector: Ned) -> bool:
    return all(abs(part) <= _FASTEST for part in vector)


def _is_number(vector: Ned) -> bool:
    return all(math.isfinite(part) for part in vector)
