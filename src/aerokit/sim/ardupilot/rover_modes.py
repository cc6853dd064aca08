"""Flight modes of a simulated ArduRover. FOLLOW, DOCK and INITIALISING are refused. SIMPLE drives like MANUAL."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavSeverity, RoverMode
from aerokit.mavlink.messages import MissionItemReached, SetAttitudeTarget
from aerokit.sim.ardupilot.host import RC_ROLL, RC_THROTTLE, ArduPilotMode, variant
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.rover_sub_base import GuidedTarget, GuidedTargetMode, RoverSubAuto, RoverSubVehicle
from aerokit.sim.commands import PositionTarget
from aerokit.sim.motion import Ned, euler_from_quaternion, wrap_pi
from aerokit.sim.vehicle_motion import GroundMotion

_ARRIVED_M, _STANDING_M_S = 0.3, 0.1
_FULL_STEERING_RAD_S = math.radians(90.0)


class RoverHost(RoverSubVehicle):
    """A rover as its modes and failsafes see it."""

    motion: GroundMotion  # pyright: ignore[reportIncompatibleVariableOverride]

    def reset_controllers(self) -> None:
        self.rc[RC_THROTTLE] = 1500

    @property
    def top_speed(self) -> float:
        """Top speed in m/s: SPEED_MAX or, if SPEED_MAX is 0, CRUISE_SPEED extrapolated to full throttle."""
        parameters = self.parameters
        return parameters["SPEED_MAX"] or 100.0 * parameters["CRUISE_SPEED"] / parameters["CRUISE_THROTTLE"]

    @property
    def waypoint_speed(self) -> float:
        return self.parameters["WP_SPEED"] or self.parameters["CRUISE_SPEED"]

    def has_arrived(self, place: Ned) -> bool:
        """Return True if the rover has reached, or just passed, a place at which it should stop."""
        motion = self.motion
        distance = motion.distance_to(place)
        bearing_from_nose = wrap_pi(motion.bearing_to(place) - motion.yaw)
        is_behind = abs(bearing_from_nose) > math.pi / 2
        is_moving = motion.ground_speed_m_s > _STANDING_M_S
        has_just_passed = is_behind and is_moving and distance <= self.parameters["WP_RADIUS"] / 2.0
        return distance <= _ARRIVED_M or has_just_passed

    def has_passed(self, place: Ned) -> bool:
        """Return True within WP_RADIUS of a place that the vehicle passes without a stop."""
        return self.motion.distance_to(place) <= self.parameters["WP_RADIUS"]


class _Mode(ArduPilotMode):
    vehicle: RoverHost


class _Manual(_Mode):
    needs_position = False
    has_manual_throttle = True

    def update(self, dt: float) -> None:
        throttle, steering = self.vehicle.stick(RC_THROTTLE), self.vehicle.stick(RC_ROLL)  # The roll stick steers.
        self.vehicle.motion.drive(throttle * self.vehicle.top_speed, steering * _FULL_STEERING_RAD_S)


class _Hold(_Mode):
    """HOLD, LOITER and CIRCLE: the rover stops and stays."""

    def update(self, dt: float) -> None:
        self.vehicle.motion.stop()


class _Rtl(_Mode):
    """RTL: drives straight to home or a rally point with RTL_SPEED or WP_SPEED, and stays armed there."""

    can_arm = False
    can_change_speed = True

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self.speed = 0.0
        self._path: list[Ned] = []  # places to drive to, in order

    def enter(self, *, force: bool) -> bool:
        rover, home = self.vehicle, self.vehicle.navigation.home
        if home is None:
            return False
        self._start_return([best_return_place(rover, home, is_allowed=rover.fence.contains)])
        return True

    def _start_return(self, path: list[Ned]) -> None:
        self._path = path
        self._has_arrived = False
        self.speed = self.vehicle.parameters["RTL_SPEED"] or self.vehicle.parameters["WP_SPEED"]

    @property
    def destination(self) -> Ned | None:
        return self._path[0] if self._path else None

    def update(self, dt: float) -> None:
        rover = self.vehicle
        if not self._path:
            rover.motion.stop()
            if not self._has_arrived:
                self._has_arrived = True
                rover.info("Reached destination")
            return
        next_place = self._path[0]
        is_last = len(self._path) == 1
        # The rover stops only at the last place.
        is_reached = rover.has_arrived(next_place) if is_last else rover.has_passed(next_place)
        if is_reached:
            del self._path[0]
        else:
            rover.motion.drive_to(next_place, speed=self.speed, stops=is_last)


class _SmartRtl(_Rtl):
    """SMART_RTL: returns along the simplified path. See `SmartPath`."""

    returns_on_path = True

    def enter(self, *, force: bool) -> bool:
        if not self.vehicle.path.is_active:
            return False
        self._start_return(self.vehicle.path.take_way_back())
        return True

    def leave(self) -> None:
        self.vehicle.path.restore(self._path)


class RoverAuto(RoverSubAuto):
    """AUTO of ArduRover."""

    number: int = RoverMode.AUTO
    name = "AUTO"

    vehicle: RoverHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def travel(self, place: Ned, *, stops: bool) -> None:
        if stops and self.has_arrived(place):
            self.vehicle.motion.stop()
        else:
            self.vehicle.motion.drive_to(place, speed=self.speed, stops=stops)

    def has_arrived(self, place: Ned) -> bool:
        return self.vehicle.has_arrived(place) if self._stops else self.vehicle.has_passed(place)

    def reached_text(self, index: int, seconds: float) -> str:
        text = f"Reached waypoint #{index}"
        return f"{text}. Loiter for {seconds:.0f} seconds" if seconds > 0 else text


class RoverGuided(GuidedTargetMode):
    """GUIDED: drives to a place, or for up to three seconds with a velocity and a turn rate.

    ArduRover also accepts a heading or a turn rate without a velocity. A thrust of 1 means the waypoint speed.
    """

    number: int = RoverMode.GUIDED
    name = "GUID"
    vehicle: RoverHost
    _has_arrived = False

    @property
    def can_change_speed(self) -> bool:  # type: ignore[override]
        return self._place is not None and not self._has_arrived

    def enter(self, *, force: bool) -> bool:
        self._place = self._target = None
        return True

    def go_to(self, position: Ned) -> None:
        super().go_to(position)
        self._has_arrived = False
        self.speed: float = self.vehicle.waypoint_speed

    def update(self, dt: float) -> None:
        rover, target = self.vehicle, self._target
        if self._place is not None:
            self._drive_to(self._place)
        elif target is None:
            rover.motion.stop()
        elif rover.now - self._target_at <= target.timeout_s:
            self._follow(target)
        else:
            self._target = None  # so that the text is sent only once
            rover.send_text(MavSeverity.WARNING, "target not received last 3secs, stopping")
            rover.motion.stop()

    def _drive_to(self, place: Ned) -> None:
        rover = self.vehicle
        if not self._has_arrived and rover.has_arrived(place):
            self._has_arrived = True
            rover.send(MissionItemReached(0))  # ArduRover reports the arrival at a guided target in this way.
        if self._has_arrived:
            rover.motion.stop()
        else:
            rover.motion.drive_to(place, speed=self.speed)

    def _follow(self, target: GuidedTarget) -> None:
        north, east, _ = target.velocity or (0.0, 0.0, 0.0)
        motion = self.vehicle.motion
        speed = min(self.vehicle.waypoint_speed, math.hypot(north, east))
        if target.backwards:
            speed = -speed
        if target.yaw_rate is not None:
            motion.drive(speed, target.yaw_rate)
        elif speed == 0.0:
            motion.stop()
        else:
            # When the rover drives backwards, its nose points away from the direction of travel.
            heading = math.atan2(east, north) + (math.pi if target.backwards else 0.0)
            motion.head(speed, heading if target.yaw is None else target.yaw)

    def refuse_acceleration(self, message: PositionTarget) -> None:
        self.vehicle.info(f"Ignoring {message.NAME}; set ACC_IGNORE in mask")

    def accepts(self, target: GuidedTarget) -> bool:
        # A target without a velocity must have either a heading or a turn rate, but not both.
        return super().accepts(target) or (target.yaw is None) != (target.yaw_rate is None)

    def steer(self, message: SetAttitudeTarget) -> None:
        if message.type_mask & AttitudeMask.THROTTLE_IGNORE:
            return
        speed = self.vehicle.waypoint_speed * max(-1.0, min(1.0, message.thrust))
        _, _, heading = euler_from_quaternion(*message.q)
        # The velocity has the direction of the heading. A negative speed is expressed by `backwards`.
        velocity = (abs(speed) * math.cos(heading), abs(speed) * math.sin(heading), 0.0)
        backwards = speed < 0
        if message.type_mask & AttitudeMask.BODY_YAW_RATE_IGNORE:
            target = GuidedTarget(velocity=velocity, backwards=backwards, yaw=heading)
        else:
            target = GuidedTarget(velocity=velocity, backwards=backwards, yaw_rate=message.body_yaw_rate)
        self.set_target(target)


ROVER_MODES: tuple[Callable[[RoverHost], ArduPilotMode], ...] = (
    variant(_Manual, RoverMode.MANUAL, "MANU"),
    variant(_Manual, RoverMode.ACRO, "ACRO"),
    variant(_Manual, RoverMode.STEERING, "STER", needs_position=True),
    variant(_Hold, RoverMode.HOLD, "HOLD", needs_position=False),
    variant(_Hold, RoverMode.LOITER, "LOIT"),
    variant(_Mode, RoverMode.FOLLOW, "FOLL", is_available=False),
    variant(_Manual, RoverMode.SIMPLE, "SMPL"),
    variant(_Hold, RoverMode.CIRCLE, "CIRC"),
    RoverAuto,
    variant(_Rtl, RoverMode.RTL, "RTL"),
    variant(_SmartRtl, RoverMode.SMART_RTL, "SRTL"),
    RoverGuided,
    variant(_Mode, RoverMode.INITIALIZING, "INIT", is_available=False),
    variant(
        _Mode, RoverMode.DOCK, "DOCK", is_available=False,
        entry_texts=("Dock: target not acquired",), entry_severity=MavSeverity.NOTICE,
    ),
)  # fmt: skip
"""Modes with the names and in the order of AVAILABLE_MODES."""
