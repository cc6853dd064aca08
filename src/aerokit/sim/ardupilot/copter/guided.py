"""GUIDED: targets and set-points from a companion or a ground station, as ArduCopter takes them."""

from __future__ import annotations

import math
from enum import Enum

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import CopterMode, MavFrame
from aerokit.mavlink.messages import SetAttitudeTarget, SetPositionTargetGlobalInt, SetPositionTargetLocalNed
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import Mode, TakeOff
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion
from aerokit.sim.setpoints import PositionTarget, Setpoint, is_finite, rotated

_STILL: Ned = (0.0, 0.0, 0.0)


class Submode(Enum):
    """Which of ArduCopter's guided controllers runs."""

    TAKE_OFF = "take-off"
    POSITION = "position"
    POSITION_VELOCITY = "position, velocity and acceleration"
    VELOCITY = "velocity and acceleration"
    ACCELERATION = "acceleration"
    ATTITUDE = "attitude"


class Guided(Mode):
    """Still at first. A position target stays, other set-points end GUID_TIMEOUT seconds after the last.

    A change from one kind of set-point to another resets the speed limits to WPNAV_SPEED and its siblings, as
    ArduCopter does: DO_CHANGE_SPEED is for the flight to the present kind of target.
    """

    number: int = CopterMode.GUIDED
    name = "GUIDED"
    arms_with_raised_throttle = True
    can_change_speed = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self.submode: Submode = Submode.VELOCITY
        self.speed: float = 0.0
        self.climb: float = 0.0
        self.descent: float = 0.0
        """Limits in m/s."""
        self.position: Ned = _STILL
        self.velocity: Ned = _STILL
        self.acceleration: Ned = _STILL
        """Targets in the world's frame: north, east, down."""
        self._attitude = (0.0, 0.0)
        self._attitude_climb = 0.0
        self._updated_at = -math.inf
        self._take_off: TakeOff | None = None
        self._is_paused = False

    def enter(self, *, force: bool) -> bool:
        self._start(Submode.VELOCITY)
        self._is_paused = False
        self.velocity, self.acceleration = _STILL, _STILL
        return True

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        self.submode = Submode.TAKE_OFF
        self._take_off = TakeOff(self.copter, altitude_m)
        self.copter.yaw.hold()
        return True

    def go_to(self, position: Ned) -> None:
        """Fly to a point of the world and stay there."""
        self._enter_submode(Submode.POSITION)
        self.position = position
        self._updated_at = self.copter.now

    def follow(self, position: Ned, velocity: Ned, acceleration: Ned) -> None:
        self._enter_submode(Submode.POSITION_VELOCITY)
        self.position, self.velocity, self.acceleration = position, velocity, acceleration
        self._updated_at = self.copter.now

    def move(self, velocity: Ned, acceleration: Ned) -> None:
        self._enter_submode(Submode.VELOCITY)
        self.velocity, self.acceleration = velocity, acceleration
        self._updated_at = self.copter.now

    def accelerate(self, acceleration: Ned) -> None:
        self._enter_submode(Submode.ACCELERATION)
        self.acceleration = acceleration
        self._updated_at = self.copter.now

    def lean(self, roll: float, pitch: float, climb: float) -> None:
        """Lean by angles in radians and climb; a climb on the ground takes off."""
        self.submode = Submode.ATTITUDE
        self._attitude, self._attitude_climb = (roll, pitch), climb
        self._updated_at = self.copter.now

    def pause(self) -> bool:
        self._is_paused = True
        return True

    def resume(self) -> bool:
        self._is_paused = False
        return True

    @property
    def destination(self) -> Ned | None:
        """The position target; None in the other submodes."""
        return self.position if self.submode is Submode.POSITION else None

    def _enter_submode(self, submode: Submode) -> None:
        if self.submode is not submode:
            self._start(submode)

    def _start(self, submode: Submode) -> None:
        self.submode = submode
        self._take_off, self.is_taking_off = None, False
        parameters = self.copter.parameters
        self.speed = parameters["WPNAV_SPEED"] / 100.0
        self.climb = parameters["WPNAV_SPEED_UP"] / 100.0
        self.descent = parameters["WPNAV_SPEED_DN"] / 100.0
        self.copter.yaw.default()

    def update(self, dt: float) -> None:
        """Run the controller of the submode."""
        self.is_taking_off = False
        if self._is_paused:
            self.stay()
        elif self.submode is Submode.TAKE_OFF:
            self._run_take_off()
        elif self.submode is Submode.ATTITUDE:
            self._run_attitude()
        elif self.copter.is_landed:
            self.stay()  # a target does not take off
        else:
            self.copter.motors.wanted = True
            self._run_target()
            self.copter.yaw.update()

    @property
    def _is_stale(self) -> bool:
        return self.copter.now - self._updated_at > self.copter.parameters["GUID_TIMEOUT"]

    def _run_take_off(self) -> None:
        assert self._take_off is not None
        self._take_off.update(self.copter.parameters["WPNAV_SPEED_UP"] / 100.0)
        self.is_taking_off: bool = not self._take_off.is_complete
        self.copter.yaw.update()

    def _run_attitude(self) -> None:
        copter = self.copter
        (roll, pitch), climb = self._attitude, self._attitude_climb
        if self._is_stale:
            roll = pitch = climb = 0.0
        copter.motors.wanted = not copter.is_landed or climb > 0
        if copter.is_landed:
            copter.is_landed = not (climb > 0 and copter.motors.can_lift)
            return
        copter.motion.seek_attitude(roll, pitch, -climb)

    def _run_target(self) -> None:
        motion = self.copter.motion
        if self._is_stale:
            self.copter.yaw.stop_turning()
            self.velocity = self.acceleration = _STILL
        if self.submode is Submode.POSITION:
            motion.seek_position(*self.position, speed=self.speed, climb=self.climb, descent=self.descent)
        elif self.submode is Submode.VELOCITY:
            self._seek_velocity(*self.velocity)
        elif self.submode is Submode.ACCELERATION:
            if self._is_stale:
                motion.seek_velocity(0.0, 0.0, 0.0)
            else:
                motion.seek_acceleration(*self.acceleration)
        else:
            error = [
                target - now for target, now in zip(self.position, self.copter.motion.place, strict=True)
            ]
            north, east, down = (speed + gap for speed, gap in zip(self.velocity, error, strict=True))
            self._seek_velocity(north, east, down)

    def _seek_velocity(self, north: float, east: float, down: float) -> None:
        size = math.hypot(north, east)
        if size > self.speed:
            north, east = north * self.speed / size, east * self.speed / size
        self.copter.motion.seek_velocity(north, east, max(-self.climb, min(self.descent, down)))


_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_LOCAL = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED}) | _BODY
_ALL_RATES = (
    AttitudeMask.BODY_ROLL_RATE_IGNORE
    | AttitudeMask.BODY_PITCH_RATE_IGNORE
    | AttitudeMask.BODY_YAW_RATE_IGNORE
)
_FASTEST = 1000.0


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
