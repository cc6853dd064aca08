"""GUIDED: targets and set-points from a companion or a ground station, as ArduCopter takes them."""

from __future__ import annotations

import math
from enum import Enum

from aerokit.mavlink.enums import CopterMode
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.copter.modes import Mode, TakeOff
from aerokit.sim.local_frame import Ned

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
            error = [target - now for target, now in zip(self.position, self._place(), strict=True)]
            north, east, down = (speed + gap for speed, gap in zip(self.velocity, error, strict=True))
            self._seek_velocity(north, east, down)

    def _place(self) -> Ned:
        motion = self.copter.motion
        return (motion.north, motion.east, motion.down)

    def _seek_velocity(self, north: float, east: float, down: float) -> None:
        size = math.hypot(north, east)
        if size > self.speed:
            north, east = north * self.speed / size, east * self.speed / size
        self.copter.motion.seek_velocity(north, east, max(-self.climb, min(self.descent, down)))
