"""OFFBOARD mode of a simulated PX4, which follows streamed set-points.

https://docs.px4.io/main/en/flight_modes/offboard.html
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from aerokit.mavlink.enums import AttitudeTargetTypemask, MavFrame, MavSeverity
from aerokit.mavlink.messages import (
    SetActuatorControlTarget,
    SetAttitudeTarget,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.sim.channel import Channel
from aerokit.sim.commands import PositionTarget, Setpoint, rotated
from aerokit.sim.motion import Ned, euler_from_quaternion
from aerokit.sim.px4.flight import velocity_towards
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.modes import OFFBOARD, POSITION, RTL
from aerokit.sim.vehicle import MAX_TICK_S

_NAN3: Ned = (math.nan, math.nan, math.nan)
# The simulated ground is level, so altitudes above terrain are treated as altitudes above home.
_GLOBAL_FRAMES = (MavFrame.GLOBAL_INT, MavFrame.GLOBAL_RELATIVE_ALT_INT, MavFrame.GLOBAL_TERRAIN_ALT_INT)
_CLIMB_AT_FULL_THRUST_M_S = 5.0
# A set-point whose upward part exceeds this number of m, m/s or m/s² makes a vehicle on the ground take off.
_MIN_TAKE_OFF_COMPONENT = 0.1
_VERSION_1_14 = 1 << 24 | 14 << 16  # One byte each for the major and the minor version.
_FLIGHT_CONTROL_GROUP, _THRUST_CONTROL = 0, 3


def _vector(components: Iterable[float]) -> Ned:
    x, y, z = components
    return (x, y, z)


class Px4Offboard:
    """The latest set-point, which is stored in every mode, but followed only in OFFBOARD."""

    def __init__(self, vehicle: Px4Host) -> None:
        self._vehicle = vehicle
        self.updated_at: float = -math.inf
        # A component that is not commanded is NaN.
        self._position, self._velocity, self._acceleration = _NAN3, _NAN3, _NAN3
        self._yaw = math.nan
        self._yaw_rate = math.nan
        # Target attitude and body rates of SET_ATTITUDE_TARGET; None without such a target.
        self._attitude: tuple[float, float, float] | None = None
        self._body_rates: tuple[float, float, float] | None = None
        self._flown_at = 0.0  # time of the last call of `fly`
        self._thrust = 0.0  # thrust that belongs to `_attitude`, from 0 to 1
        vehicle.on(SetPositionTargetLocalNed, self._on_local)
        vehicle.on(SetPositionTargetGlobalInt, self._on_global)
        vehicle.on(SetAttitudeTarget, self._on_attitude)
        vehicle.on(SetActuatorControlTarget, self._on_actuators)

    @property
    def is_fresh(self) -> bool:
        return self._vehicle.now - self.updated_at <= self._vehicle.parameters["COM_OF_LOSS_T"]

    @property
    def position(self) -> Ned:
        return self._position

    @property
    def wants_up(self) -> bool:
        if self._attitude is not None:
            return self._thrust > 0.5
        _, _, position_down = self._position
        _, _, velocity_down = self._velocity
        _, _, acceleration_down = self._acceleration
        components = (position_down - self._vehicle.motion.down, velocity_down, acceleration_down)
        return any(down < -_MIN_TAKE_OFF_COMPONENT for down in components)  # False for components that are NaN

    def _on_local(self, target: SetPositionTargetLocalNed, _: Channel) -> None:
        frame = target.coordinate_frame
        if frame not in (MavFrame.LOCAL_NED, MavFrame.BODY_NED):
            self._warn(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported")
            return
        is_body = frame == MavFrame.BODY_NED
        # PX4 ignores a position in the body frame.
        position = _NAN3 if is_body else (target.x, target.y, target.z)
        if not self._store(target, position, is_body=is_body):
            self._warn("SET_POSITION_TARGET_LOCAL_NED invalid")

    def _on_global(self, target: SetPositionTargetGlobalInt, _: Channel) -> None:
        if target.coordinate_frame not in _GLOBAL_FRAMES:
            frame = target.coordinate_frame
            self._warn(f"SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {frame}")
            return
        local_frame = self._vehicle.frame
        north, east = local_frame.to_local(target.lat_int, target.lon_int)
        down = local_frame.origin.altitude_m - target.alt
        if target.coordinate_frame != MavFrame.GLOBAL_INT:  # In the other frames, the altitude is relative to home.
            _north, _east, home_down = self._vehicle.home
            down = home_down - target.alt
        self._store(target, (north, east, down), is_body=False)

    def _warn(self, text: str) -> None:
        self._vehicle.send_text(MavSeverity.CRITICAL, text)

    def _store(self, target: PositionTarget, position: Ned, *, is_body: bool) -> bool:
        setpoint = Setpoint.of(target)
        position, velocity, acceleration = setpoint.axes(position)
        if all(map(math.isnan, (*position, *velocity, *acceleration))):
            return False
        if is_body:
            yaw = self._vehicle.motion.yaw
            velocity, acceleration = rotated(velocity, yaw), rotated(acceleration, yaw)
        self._position, self._velocity, self._acceleration = position, velocity, acceleration
        self._yaw = math.nan if setpoint.yaw is None else setpoint.yaw
        self._yaw_rate = math.nan if setpoint.yaw_rate is None else setpoint.yaw_rate
        self._attitude = None
        self.updated_at = self._vehicle.now
        return True

    def _on_attitude(self, target: SetAttitudeTarget, _: Channel) -> None:
        motion = self._vehicle.motion
        if target.type_mask & AttitudeTargetTypemask.ATTITUDE_IGNORE:
            if self._attitude is None or self._body_rates is None:  # Rates start from the present attitude.
                self._attitude = motion.angles
            self._body_rates = (target.body_roll_rate, target.body_pitch_rate, target.body_yaw_rate)
        elif all(map(math.isfinite, target.q)):
            self._attitude = euler_from_quaternion(*target.q)
            self._body_rates = None
        if math.isfinite(target.thrust):
            self._thrust = target.thrust
        self.updated_at = self._vehicle.now

    def _on_actuators(self, target: SetActuatorControlTarget, _: Channel) -> None:
        # PX4 1.14 and later ignore the message.
        if self._vehicle.version_number >= _VERSION_1_14:
            return
        motion = self._vehicle.motion
        # Of the controls, only the thrust is simulated. The vehicle keeps its present attitude.
        self._attitude = motion.angles
        self._body_rates = None
        if target.group_mlx == _FLIGHT_CONTROL_GROUP:
            self._thrust = target.controls[_THRUST_CONTROL]
        self.updated_at = self._vehicle.now

    def watch(self) -> None:
        """Change the mode when the set-points stop, and back when they resume."""
        vehicle = self._vehicle
        if vehicle.intended_mode != OFFBOARD or vehicle.failsafes.acts:
            return
        if not vehicle.is_in_failsafe and not self.is_fresh:
            vehicle.is_in_failsafe = True
            vehicle.send_text(MavSeverity.CRITICAL, "Failsafe activated")
            vehicle.switch_to(POSITION if vehicle.version.startswith("1.16") else RTL)
        elif vehicle.is_in_failsafe and self.is_fresh:
            vehicle.is_in_failsafe = False
            vehicle.switch_to(OFFBOARD)

    def fly(self) -> None:
        motion = self._vehicle.motion
        # `fly` is called only in OFFBOARD. The limit leaves out the time in other modes.
        elapsed = min(MAX_TICK_S, self._vehicle.now - self._flown_at)
        self._flown_at = self._vehicle.now
        if self._attitude is not None:
            self._fly_attitude(self._attitude, elapsed)
            return
        if all(map(math.isnan, (*self._position, *self._velocity))):
            motion.seek_acceleration(*(0.0 if math.isnan(axis) else axis for axis in self._acceleration))
        else:
            motion.seek_velocity(*self._wanted_velocity())
        if math.isfinite(self._yaw):
            motion.face(self._yaw)
        else:
            motion.turn(self._yaw_rate if math.isfinite(self._yaw_rate) else 0.0)

    def _fly_attitude(self, attitude: tuple[float, float, float], elapsed: float) -> None:
        motion = self._vehicle.motion
        if self._body_rates is not None:
            angles_and_rates = zip(attitude, self._body_rates, strict=True)
            attitude = _vector(angle + rate * elapsed for angle, rate in angles_and_rates)
            self._attitude = attitude
        roll, pitch, yaw = attitude
        # In the simulation, a thrust of 0.5 holds the height.
        climb_share = (max(0.0, min(1.0, self._thrust)) - 0.5) * 2.0
        velocity_down = -climb_share * _CLIMB_AT_FULL_THRUST_M_S
        motion.seek_attitude(roll, pitch, velocity_down)
        motion.face(yaw)

    def _wanted_velocity(self) -> Ned:
        motion, limits = self._vehicle.motion, self._vehicle.parameters
        place = motion.place
        max_horizontal = limits["MPC_XY_VEL_MAX"]
        # In OFFBOARD, the limits of automatic flight (MPC_Z_V_AUTO_UP) do not apply (MulticopterPositionControl.cpp).
        max_climb, max_descent = limits["MPC_Z_VEL_MAX_UP"], limits["MPC_Z_VEL_MAX_DN"]
        lows, highs = (-max_horizontal, -max_horizontal, -max_climb), (max_horizontal, max_horizontal, max_descent)
        accelerations = (motion.limits.acceleration_m_s2,) * 2 + (motion.limits.vertical_acceleration_m_s2,)
        velocity = []
        for axis in range(3):
            speed = 0.0 if math.isnan(self._velocity[axis]) else self._velocity[axis]
            if math.isfinite(self._position[axis]):
                offset = self._position[axis] - place[axis]
                limit = highs[axis] if offset > 0 else -lows[axis]
                speed += velocity_towards(offset, limit, accelerations[axis])
            velocity.append(max(lows[axis], min(highs[axis], speed)))
        return _vector(velocity)
