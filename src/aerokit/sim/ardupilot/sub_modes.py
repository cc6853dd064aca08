"""Flight modes of a simulated ArduSub. MOTORDETECT and SURFTRAK act like ALT_HOLD, ACRO and STABILIZE like MANUAL."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import ClassVar

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavFrame, SubMode
from aerokit.mavlink.messages import SetAttitudeTarget
from aerokit.sim.ardupilot.host import RC_THROTTLE, RC_YAW, SUB_FORWARD, SUB_LATERAL, ArduPilotMode, variant
from aerokit.sim.ardupilot.rover_sub_base import GuidedTarget, GuidedTargetMode, RoverSubAuto, RoverSubVehicle
from aerokit.sim.commands import rotated
from aerokit.sim.motion import Ned, euler_from_quaternion, wrap_pi
from aerokit.sim.vehicle_motion import UnderwaterMotion

_MIN_LOOK_AHEAD_M, _MIN_TRAVEL_M_S = 1.0, 0.05
_DEADZONE = 0.06
_FULL_STICK_M_S = 1.0
_FULL_STICK_TURN_RAD_S = math.radians(90.0)


class SubHost(RoverSubVehicle):
    """A submarine as its modes and failsafes see it."""

    display_names: cycle[str]
    """Names of `DISPLAY_VALUES` in the order in which they are sent."""
    motion: UnderwaterMotion  # pyright: ignore[reportIncompatibleVariableOverride]
    hull_pressure_pa: float = 101_325.0
    hull_temperature_c: float = 28.0

    @property
    def waypoint_speed(self) -> float:
        return self.parameters["WPNAV_SPEED"] / 100.0

    @property
    def is_at_surface(self) -> bool:
        """True within SURFACE_DEPTH of the surface."""
        return self.motion.down <= max(0.0, -self.parameters["SURFACE_DEPTH"] / 100.0)

    def distance(self, place: Ned) -> float:
        """Return the distance to a place in metres."""
        return math.dist(self._below_surface(place), self.motion.place)

    def travel(self, place: Ned, speed: float, *, looks_ahead: bool = True) -> None:
        """Move straight to a place. With ``looks_ahead``, also turn the nose towards the place.

        ``speed`` (m/s) applies to the longer one of the horizontal and the vertical distance. WPNAV_SPEED_UP and
        WPNAV_SPEED_DN limit the vertical speed.
        """
        motion, parameters = self.motion, self.parameters
        north, east, down = self._below_surface(place)
        max_climb = parameters["WPNAV_SPEED_UP"] / 100.0
        max_descent = parameters["WPNAV_SPEED_DN"] / 100.0
        distance = motion.distance_to(place)
        if looks_ahead and distance > _MIN_LOOK_AHEAD_M:
            motion.face(motion.bearing_to(place))
        depth_difference = abs(down - motion.down)
        # The longer of the two distances is covered at `speed`, the shorter one more slowly, so that the path is
        # straight. The minimum of 1e-3 avoids a division by zero.
        horizontal = speed * min(1.0, distance / max(depth_difference, 1e-3))
        vertical = speed * min(1.0, depth_difference / max(distance, 1e-3))
        horizontal = max(horizontal, _MIN_TRAVEL_M_S)
        climb, descent = min(max_climb, vertical), min(max_descent, vertical)
        motion.seek_position(north, east, down, speed=horizontal, climb=climb, descent=descent)

    def _below_surface(self, place: Ned) -> Ned:
        north, east, down = place
        return (north, east, max(down, self.motion.ground_down))


class _Mode(ArduPilotMode):
    """Base of ArduSub's modes, with the pilot's sticks."""

    vehicle: SubHost

    def stick(self, index: int) -> float:
        """Return a stick position, -1 to 1, with a dead zone around 0."""
        share = self.vehicle.stick(index)
        return 0.0 if abs(share) < _DEADZONE else share

    def turn_and_read_velocity(self) -> tuple[float, float]:
        """Turn by the yaw stick. Return the velocity (north, east) in m/s that the other sticks command."""
        motion = self.vehicle.motion
        motion.turn(self.stick(RC_YAW) * _FULL_STICK_TURN_RAD_S)
        forward = self.stick(SUB_FORWARD) * _FULL_STICK_M_S
        right = self.stick(SUB_LATERAL) * _FULL_STICK_M_S
        north, east, _ = rotated((forward, right, 0.0), motion.yaw)
        return north, east

    def climb(self) -> float:
        """Return the climb rate that the throttle stick commands, in m/s."""
        return self.stick(RC_THROTTLE) * (self.vehicle.parameters["PILOT_SPEED_UP"] / 100.0)


class _Manual(_Mode):
    """MANUAL, STABILIZE and ACRO: sticks control the thrust. With a centered throttle stick the vehicle drifts up."""

    needs_position = False
    has_manual_throttle = True

    def update(self, dt: float) -> None:
        climb = self.climb()
        if climb == 0.0:
            self.vehicle.motion.push(*self.turn_and_read_velocity())
        else:
            self.vehicle.motion.seek_velocity(*self.turn_and_read_velocity(), -climb)


class _AltHold(_Mode):
    """ALT_HOLD and similar modes: the submarine holds its depth, which the throttle stick changes."""

    needs_position = False

    def update(self, dt: float) -> None:
        self.vehicle.motion.seek_velocity(*self.turn_and_read_velocity(), -self.climb())


class _Surface(_AltHold):
    """SURFACE: rises with WPNAV_SPEED_UP, and changes to ALT_HOLD at the surface."""

    is_landing = True

    def update(self, dt: float) -> None:
        if self.vehicle.is_at_surface:
            self.vehicle.set_mode(SubMode.ALT_HOLD)
        else:
            climb = self.vehicle.parameters["WPNAV_SPEED_UP"] / 100.0
            self.vehicle.motion.seek_velocity(*self.turn_and_read_velocity(), -climb)


class SubAuto(RoverSubAuto):
    """AUTO of ArduSub: moves straight to each place, nose first, and stays after the last command."""

    number: int = SubMode.AUTO
    name = "AUTO"

    vehicle: SubHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def travel(self, place: Ned, *, stops: bool) -> None:
        self.vehicle.travel(place, self.speed)

    def has_arrived(self, place: Ned) -> bool:
        return self.vehicle.distance(place) <= self.vehicle.parameters["WPNAV_RADIUS"] / 100.0

    def reached_text(self, index: int, seconds: float) -> str:
        return f"Reached command #{index}"


class SubGuided(GuidedTargetMode):
    """GUIDED: moves to a place, or for up to three seconds with a velocity. Without a target it stops.

    In SET_ATTITUDE_TARGET, thrust sets a climb rate (0.5 holds the depth). Roll and pitch have no effect. Yaw is
    relative to the heading only in BODY_OFFSET_NED.
    """

    BODY_FRAMES: ClassVar[frozenset[int]] = GuidedTargetMode.BODY_FRAMES | {MavFrame.BODY_FRD}
    RELATIVE_YAW_FRAMES: ClassVar[frozenset[int]] = frozenset({MavFrame.BODY_OFFSET_NED})
    GLOBAL_YAW: ClassVar[bool] = False

    number: int = SubMode.GUIDED
    name = "GUIDED"
    can_change_speed = True
    vehicle: SubHost
    _heading: float | None = None  # heading to hold, in radians; None to follow `_target`

    def enter(self, *, force: bool) -> bool:
        self._place = self._target = self._heading = None
        self.speed: float = self.vehicle.waypoint_speed
        return True

    def go_to(self, position: Ned) -> None:
        super().go_to(position)
        self._heading = None

    def set_target(self, target: GuidedTarget) -> None:
        if target.position is not None:
            motion = self.vehicle.motion
            # As in SITL, the submarine loses its velocity when it gets a new target position.
            motion.velocity_north = motion.velocity_east = motion.velocity_down = 0.0
        super().set_target(target)
        self._heading = target.yaw

    def face(self, heading: float) -> None:
        """Turn to a heading in radians."""
        self._heading = wrap_pi(heading)

    def update(self, dt: float) -> None:
        motion, target = self.vehicle.motion, self._target
        if target is not None and self.vehicle.now - self._target_at > target.timeout_s:
            target = None  # An expired target stops the vehicle.
        if self._place is not None:
            self.vehicle.travel(self._place, self.speed, looks_ahead=False)
        elif target is not None and target.velocity is not None:
            motion.seek_velocity(*target.velocity)
        else:
            motion.stop()
        if self._heading is not None:
            motion.face(self._heading)
        elif target is not None and target.yaw_rate is not None:
            motion.turn(target.yaw_rate)
        else:
            motion.turn(0.0)  # Hold the heading.

    def steer(self, message: SetAttitudeTarget) -> None:
        if message.type_mask & (AttitudeMask.ATTITUDE_IGNORE | AttitudeMask.THROTTLE_IGNORE):
            return
        climb_share = 2.0 * (max(0.0, min(1.0, message.thrust)) - 0.5)  # A thrust of 0.5 holds the depth.
        max_climb_parameter = "WPNAV_SPEED_UP" if climb_share > 0 else "WPNAV_SPEED_DN"
        climb = climb_share * self.vehicle.parameters[max_climb_parameter] / 100.0
        _, _, yaw = euler_from_quaternion(*message.q)
        self.set_target(GuidedTarget(velocity=(0.0, 0.0, -climb), yaw=yaw, timeout_s=1.0))


SUB_MODES: tuple[Callable[[SubHost], ArduPilotMode], ...] = (
    variant(_Manual, SubMode.MANUAL, "MANUAL"),
    variant(_Manual, SubMode.STABILIZE, "STABILIZE"),
    variant(_Manual, SubMode.ACRO, "ACRO"),
    variant(_AltHold, SubMode.ALT_HOLD, "ALT_HOLD"),
    SubAuto,
    SubGuided,
    variant(_AltHold, SubMode.CIRCLE, "CIRCLE", needs_position=True),
    variant(_Surface, SubMode.SURFACE, "SURFACE"),
    variant(_AltHold, SubMode.POSHOLD, "POSHOLD", needs_position=True),
    variant(_AltHold, SubMode.MOTORDETECT, "MOTORDETECT"),
    variant(_AltHold, SubMode.SURFTRAK, "SURFTRAK", entry_texts=("waiting for a rangefinder reading",)),
)
"""Modes with the names and in the order of AVAILABLE_MODES."""
