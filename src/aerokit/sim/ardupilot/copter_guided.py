"""GUIDED of a simulated ArduCopter: targets and set-points from a companion computer or a ground station."""

from __future__ import annotations

import math
from enum import Enum

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import CopterMode, MavFrame
from aerokit.mavlink.messages import SetAttitudeTarget, SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.ardupilot.copter_modes import CopterHost, CopterModeBase, CopterTakeOff
from aerokit.sim.ardupilot.host import GuidedMode
from aerokit.sim.channel import Channel
from aerokit.sim.commands import PositionTarget, Setpoint, constrained, is_finite, rotated
from aerokit.sim.motion import Ned, euler_from_quaternion

_ZERO: Ned = (0.0, 0.0, 0.0)
_UNIT_LENGTH_TOLERANCE = 1e-3


_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_LOCAL = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED}) | _BODY
_ALL_RATES = (
    AttitudeMask.BODY_ROLL_RATE_IGNORE | AttitudeMask.BODY_PITCH_RATE_IGNORE | AttitudeMask.BODY_YAW_RATE_IGNORE
)
_MAX_VELOCITY_M_S = 1000.0


class GuidedSubmode(Enum):
    """ArduCopter's guided controllers."""

    TAKE_OFF = "take-off"
    POSITION = "position"
    POSITION_VELOCITY = "position, velocity and acceleration"
    VELOCITY = "velocity and acceleration"
    ACCELERATION = "acceleration"
    ATTITUDE = "attitude"


class CopterGuided(CopterModeBase, GuidedMode):
    """GUIDED: holds the position until the first target. Targets other than a position expire after GUID_TIMEOUT.

    DO_CHANGE_SPEED sets a speed limit. When the type of target changes (position, velocity, acceleration), the limits
    are WPNAV_SPEED, WPNAV_SPEED_UP and WPNAV_SPEED_DN again, as in ArduCopter. An invalid set-point stops the copter.
    """

    number: int = CopterMode.GUIDED
    name = "GUIDED"
    arms_with_raised_throttle = True
    can_change_speed = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self.submode: GuidedSubmode = GuidedSubmode.VELOCITY
        # The maximum horizontal speed, climb rate and sink rate in m/s.
        self.speed: float = 0.0
        self.climb: float = 0.0
        self.descent: float = 0.0
        # Targets in the world frame: north, east, down.
        self.position: Ned = _ZERO
        self.velocity: Ned = _ZERO
        self.acceleration: Ned = _ZERO
        self._attitude = (0.0, 0.0)  # target roll and pitch in radians
        # Target roll rate and pitch rate in rad/s, which change `_attitude`. None if no rates were commanded.
        self._body_rates: tuple[float, float] | None = None
        self._attitude_climb = 0.0  # climb rate in m/s that goes with `_attitude`
        self._updated_at = -math.inf  # time of the last target
        self._take_off: CopterTakeOff | None = None  # the take-off that was commanded, if no other target replaced it
        self._is_paused = False

    def enter(self, *, force: bool) -> bool:
        self._start(GuidedSubmode.VELOCITY)
        self._is_paused = False
        self.velocity = self.acceleration = _ZERO
        return True

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        self.submode = GuidedSubmode.TAKE_OFF
        self._take_off = CopterTakeOff(self.vehicle, altitude_m)
        self.vehicle.yaw.hold()
        return True

    def go_to(self, position: Ned) -> None:
        self._set_targets(GuidedSubmode.POSITION, position=position)

    def _set_targets(
        self,
        submode: GuidedSubmode,
        *,
        position: Ned | None = None,
        velocity: Ned | None = None,
        acceleration: Ned | None = None,
    ) -> None:
        """Enter a submode and replace the targets that are not None."""
        if self.submode is not submode:
            self._start(submode)
        self.position = self.position if position is None else position
        self.velocity = self.velocity if velocity is None else velocity
        self.acceleration = self.acceleration if acceleration is None else acceleration
        self._updated_at = self.vehicle.now

    def set_target(self, position: Ned | None, velocity: Ned | None, acceleration: Ned | None) -> bool:
        """Follow the vectors of a set-point. Return False if the firmware does not support their combination."""
        if velocity is not None:
            submode = GuidedSubmode.VELOCITY if position is None else GuidedSubmode.POSITION_VELOCITY
            acceleration = acceleration or _ZERO
        elif position is None and acceleration is not None:
            submode = GuidedSubmode.ACCELERATION
        elif position is not None and acceleration is None:
            submode = GuidedSubmode.POSITION
        else:
            return False
        self._set_targets(submode, position=position, velocity=velocity, acceleration=acceleration)
        return True

    def set_attitude(
        self, angles: tuple[float, float], climb: float, body_rates: tuple[float, float] | None = None
    ) -> None:
        """Hold roll and pitch in radians and a climb rate in m/s.

        ``body_rates`` in rad/s replace the angles. They begin at the vehicle's roll and pitch or, if rates were already
        commanded, continue from the commanded ones.
        """
        if body_rates is None:
            self._attitude = angles
        elif self.submode is not GuidedSubmode.ATTITUDE or self._body_rates is None:
            self._attitude = (self.vehicle.motion.roll, self.vehicle.motion.pitch)
        self.submode = GuidedSubmode.ATTITUDE
        self._attitude_climb = climb
        self._body_rates = body_rates
        self._updated_at = self.vehicle.now

    def pause(self) -> bool:
        self._is_paused = True
        return True

    def resume(self) -> bool:
        self._is_paused = False
        return True

    @property
    def destination(self) -> Ned | None:
        return self.position if self.submode is GuidedSubmode.POSITION else None

    def _start(self, submode: GuidedSubmode) -> None:
        copter = self.vehicle
        self.submode = submode
        self._take_off = None
        self.is_taking_off = False
        self.speed = copter.speed_limit("WPNAV_SPEED")
        self.climb, self.descent = copter.speed_limit("WPNAV_SPEED_UP"), copter.speed_limit("WPNAV_SPEED_DN")
        copter.yaw.apply_default()

    def update(self, dt: float) -> None:
        copter = self.vehicle
        self.is_taking_off = False
        if self._is_paused:
            copter.hold_position()
        elif self._take_off is not None and self.submode is GuidedSubmode.TAKE_OFF:
            self._take_off.update(copter.speed_limit("WPNAV_SPEED_UP"))
            self.is_taking_off: bool = not self._take_off.is_complete
            copter.yaw.update()
        elif self.submode is GuidedSubmode.ATTITUDE:
            self._run_attitude(dt)
        elif copter.is_landed:
            copter.hold_position()  # On the ground, only a take-off command or an attitude target has an effect.
        else:
            copter.motors.spool_up_requested = True
            self._run_target()
            copter.yaw.update()

    @property
    def _is_stale(self) -> bool:
        return self.vehicle.now - self._updated_at > self.vehicle.parameters["GUID_TIMEOUT"]

    def _run_attitude(self, dt: float) -> None:
        copter = self.vehicle
        if self._body_rates is not None and not copter.is_landed:  # The body rates change the commanded attitude.
            roll, pitch = (angle + rate * dt for angle, rate in zip(self._attitude, self._body_rates, strict=True))
            self._attitude = (roll, pitch)
        roll, pitch = self._attitude
        climb = self._attitude_climb
        if self._is_stale:  # The firmware levels the copter after GUID_TIMEOUT.
            roll = pitch = climb = 0.0
        copter.motors.spool_up_requested = not copter.is_landed or climb > 0
        if copter.is_landed:
            lifts_off = climb > 0 and copter.motors.can_lift
            copter.is_landed = not lifts_off
            return
        # The motion model expects the vertical velocity as positive downwards.
        copter.motion.seek_attitude(roll, pitch, -climb)

    def _run_target(self) -> None:
        motion = self.vehicle.motion
        if self._is_stale:
            self.vehicle.yaw.stop_turning()
            self.velocity = self.acceleration = _ZERO
        if self.submode is GuidedSubmode.POSITION:
            motion.seek_position(*self.position, speed=self.speed, climb=self.climb, descent=self.descent)
        elif self.submode is GuidedSubmode.VELOCITY:
            self._seek_velocity(*self.velocity)
        elif self.submode is GuidedSubmode.ACCELERATION:
            if self._is_stale:  # An acceleration of zero would keep the velocity, so stop instead.
                motion.seek_velocity(*_ZERO)
            else:
                motion.seek_acceleration(*self.acceleration)
        else:
            # For each metre of distance to the target position, 1 m/s towards that position is added to the target
            # velocity.
            offsets = (target - current for target, current in zip(self.position, motion.place, strict=True))
            north, east, down = (speed + offset for speed, offset in zip(self.velocity, offsets, strict=True))
            self._seek_velocity(north, east, down, acceleration=self.acceleration)

    def _seek_velocity(self, north: float, east: float, down: float, *, acceleration: Ned = _ZERO) -> None:
        horizontal_speed = math.hypot(north, east)
        if horizontal_speed > self.speed:
            north, east = north * self.speed / horizontal_speed, east * self.speed / horizontal_speed
        down = max(-self.climb, min(self.descent, down))
        self.vehicle.motion.follow_trajectory((north, east, down), acceleration)

    def on_local_target(self, target: SetPositionTargetLocalNed, _: Channel) -> None:
        if not self.is_active:
            return
        frame = target.coordinate_frame
        point = self.vehicle.local_point(target, _BODY)
        if frame not in _LOCAL or not self._follow(target, point, rotate=frame in _BODY):
            self.enter(force=False)  # An invalid message stops the vehicle.

    def on_global_target(self, target: SetPositionTargetGlobalInt, _: Channel) -> None:
        if not self.is_active:
            return
        point = self.vehicle.world_point(target.lat_int, target.lon_int, target.alt, target.coordinate_frame)
        is_position_missing = point is None and Setpoint.of(target).has_position
        # If the message has no position, `_follow` ignores its argument `point`.
        is_followed = not is_position_missing and self._follow(target, point or _ZERO, rotate=False)
        if not is_followed:
            self.enter(force=False)  # An invalid message stops the vehicle.

    def _follow(self, target: PositionTarget, point: Ned, *, rotate: bool) -> bool:
        """Follow a set-point. Return False if it is invalid.

        ``point`` is the position in the world frame. With ``rotate``, velocity, acceleration and yaw are in the body
        frame.
        """
        setpoint, motion, yaw = Setpoint.of(target), self.vehicle.motion, self.vehicle.yaw
        velocity = setpoint.velocity if setpoint.has_velocity else None
        acceleration = setpoint.acceleration if setpoint.has_acceleration else None
        is_velocity_valid = all(abs(part) <= _MAX_VELOCITY_M_S for part in velocity or _ZERO)
        if setpoint.is_force or not is_velocity_valid or not is_finite(acceleration, point):
            return False
        if rotate:
            velocity = None if velocity is None else rotated(velocity, motion.yaw)
            acceleration = None if acceleration is None else rotated(acceleration, motion.yaw)
        position = point if setpoint.has_position else None
        if not self.set_target(position, velocity, acceleration):
            return False
        if setpoint.yaw is not None:
            yaw.turn_to(setpoint.yaw + (motion.yaw if rotate else 0.0))  # In a body frame, yaw is relative to the nose.
        elif setpoint.yaw_rate is not None:
            yaw.turn(setpoint.yaw_rate)
        else:
            yaw.apply_default()
        return True

    def on_attitude_target(self, target: SetAttitudeTarget, _: Channel) -> None:
        copter, mask = self.vehicle, target.type_mask
        guided = copter.mode
        if not isinstance(guided, CopterGuided):
            return
        has_attitude = not mask & AttitudeMask.ATTITUDE_IGNORE
        ignored_rates = mask & _ALL_RATES
        quaternion_norm = math.sqrt(sum(component * component for component in target.q))
        has_one_or_two_rates = ignored_rates not in (0, _ALL_RATES)  # The firmware needs all rates or none.
        is_thrust_missing = mask & AttitudeMask.THROTTLE_IGNORE
        is_mask_invalid = is_thrust_missing or has_one_or_two_rates
        is_quaternion_invalid = has_attitude and not abs(quaternion_norm - 1.0) < _UNIT_LENGTH_TOLERANCE
        if is_mask_invalid or is_quaternion_invalid:
            guided.enter(force=False)  # An invalid message stops the vehicle.
            return
        roll = pitch = 0.0
        if has_attitude:
            roll, pitch, yaw = euler_from_quaternion(*target.q)
            copter.motion.face(yaw)
        elif not ignored_rates:
            copter.motion.turn(target.body_yaw_rate)
        # The field `thrust` sets a climb rate, and 0.5 holds the altitude. Bit 3 of GUID_OPTIONS, with which `thrust`
        # sets the throttle, is not simulated.
        climb_share = (constrained(target.thrust, 0.0, 1.0) - 0.5) * 2.0
        max_climb_parameter = "WPNAV_SPEED_UP" if climb_share > 0 else "WPNAV_SPEED_DN"
        climb = climb_share * copter.parameters[max_climb_parameter] / 100.0
        has_rates_only = not has_attitude and not ignored_rates
        body_rates = (target.body_roll_rate, target.body_pitch_rate) if has_rates_only else None
        guided.set_attitude((roll, pitch), climb, body_rates)
