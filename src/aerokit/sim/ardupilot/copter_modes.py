"""ArduCopter's heading control, its piloted modes, and the modes that land and return."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.sim.ardupilot.host import RC_PITCH, RC_ROLL, RC_THROTTLE, RC_YAW, ArduPilotMode
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.commands import rotated
from aerokit.sim.motion import Ned, wrap_pi

_YAW_AHEAD, _YAW_AHEAD_EXCEPT_RTL = 1, 2  # values of WP_YAW_BEHAVIOR
_MIN_LOOK_AHEAD_M_S = 0.5
_HEADING_TOLERANCE_RAD = 0.02


class AutoYaw:
    """Controls the heading: holds it, looks ahead, turns to a heading or at a rate, or faces a region of interest."""

    def __init__(self, copter: ArduPilotVehicle) -> None:
        self._copter = copter
        self._control: Callable[[], None] = self._hold
        """The method that `update` calls at every tick."""
        self._roi: Ned | None = None  # region of interest
        self._heading = 0.0
        self._rate = 0.0
        """Turn rate (radians per second): set by `turn`, and by `turn_to` for a turn by the longer way; otherwise 0."""
        self._max_rate = math.inf  # limit of the turn rate to `_heading`

    def hold(self) -> None:
        self._control = self._hold
        self._copter.motion.turn(0.0)

    def apply_default(self, *, returning: bool = False) -> None:
        """Apply WP_YAW_BEHAVIOR. This ends a commanded heading or region of interest."""
        behaviour = int(self._copter.parameters["WP_YAW_BEHAVIOR"])
        if behaviour == _YAW_AHEAD or (behaviour == _YAW_AHEAD_EXCEPT_RTL and not returning):
            self._control = self._look_ahead
        else:
            self.hold()

    def turn_to(self, heading: float, rate: float = 0.0, direction: int = 0) -> None:
        """Turn to a heading in radians, at a rate in rad/s.

        A positive ``direction`` is clockwise, a negative one anticlockwise. 0 takes the shorter way.
        """
        motion = self._copter.motion
        self._heading = wrap_pi(heading)
        self._control = self._go_to_heading
        self._rate = 0.0
        self._max_rate = rate if rate > 0 else motion.limits.turn_rate_rad_s  # also for NaN (autoyaw.cpp)
        offset = wrap_pi(self._heading - motion.yaw)
        is_longer_way = offset * direction < 0
        # `Motion.face` always turns the shorter way. `_go_to_heading` uses `_rate` to turn the longer way.
        if is_longer_way and abs(offset) > _HEADING_TOLERANCE_RAD:
            self._rate = math.copysign(self._max_rate, direction)

    def turn_to_last_heading(self, tolerance: float) -> bool:
        """Turn to the heading that `turn_to` set last. Return True once within ``tolerance`` radians of it."""
        self._control = self._go_to_heading
        return abs(wrap_pi(self._heading - self._copter.motion.yaw)) <= tolerance

    @property
    def has_region_of_interest(self) -> bool:
        return self._control == self._look_at_roi

    def turn(self, rate: float) -> None:
        """Turn continuously at this rate in rad/s."""
        self._rate = rate
        self._control = self._turn

    def set_region_of_interest(self, point: Ned | None) -> None:
        """Face a place. With None, apply the default heading again."""
        gimbal = self._copter.gimbal
        # A fitted gimbal turns instead of the copter.
        gimbal.look_at(point)
        if point is None:
            self.apply_default()
        elif not gimbal.is_fitted:
            self._roi = point
            self._control = self._look_at_roi

    def stop_turning(self) -> None:
        if self._control == self._turn:
            self.hold()

    def update(self) -> None:
        self._control()

    def _hold(self) -> None:
        """Do nothing: `Motion` keeps the heading."""

    def _turn(self) -> None:
        self._copter.motion.turn(self._rate)

    def _look_ahead(self) -> None:
        motion = self._copter.motion
        if motion.ground_speed_m_s > _MIN_LOOK_AHEAD_M_S:
            motion.face(motion.course)

    def _go_to_heading(self) -> None:
        motion = self._copter.motion
        offset = wrap_pi(self._heading - motion.yaw)
        if self._rate and math.copysign(1, offset) != math.copysign(1, self._rate):
            motion.turn(self._rate)  # Keep the commanded direction until it is the shorter way to the heading.
            return
        self._rate = 0.0
        motion.face(self._heading, self._max_rate)

    def _look_at_roi(self) -> None:
        assert self._roi is not None
        motion = self._copter.motion
        motion.face(motion.bearing_to(self._roi))


class CopterHost(ArduPilotVehicle):
    """A copter as its modes and failsafes see it."""

    def reset_controllers(self) -> None:
        self.yaw: AutoYaw = AutoYaw(self)

    def look_at(self, place: Ned | None) -> None:
        self.yaw.set_region_of_interest(place)

    def speed_limit(self, name: str) -> float:
        """Return a parameter in cm/s as m/s."""
        return self.parameters[name] / 100.0

    def fly_to(self, target: Ned, speed: float) -> float:
        """Fly towards a target with the default climb and sink rates. Return the distance to the target in metres."""
        self.motors.spool_up_requested = True
        climb, descent = self.speed_limit("WPNAV_SPEED_UP"), self.speed_limit("WPNAV_SPEED_DN")
        self.motion.seek_position(*target, speed=speed, climb=climb, descent=descent)
        self.yaw.update()
        return math.dist(target, self.motion.place)

    def hold_position(self) -> None:
        """Hold the position. On the ground, let the motors idle."""
        self.motors.spool_up_requested = not self.is_landed
        self.motion.seek_velocity(0.0, 0.0, 0.0)

    def descend(self) -> None:
        """Descend with the speeds of the mode LAND, over the landing target if there is one. On the ground, let the
        motors idle.
        """
        self.motors.spool_up_requested = not self.is_landed
        if self.is_landed:
            return
        speed = self.speed_limit("LAND_SPEED")
        if self.navigation.altitude_above_home > self.parameters["LAND_ALT_LOW"] / 100.0:
            speed = self.speed_limit("LAND_SPEED_HIGH") or self.speed_limit("WPNAV_SPEED_DN")
        self.motion.seek_velocity(*self.external.velocity_to_target(), speed)

    def land(self) -> None:
        """Descend, and disarm once the motors idle on the ground."""
        self.descend()
        if self.is_landed and self.motors.is_armed and self.motors.is_idle:
            self.arming.disarm()


class CopterModeBase(ArduPilotMode):
    vehicle: CopterHost


_REACHED_M, _AT_REST_M_S = 0.1, 0.2
# Maximum speeds towards the target of a take-off: horizontally, and downwards after the copter has risen too high.
_DRIFT_CORRECTION_M_S, _OVERSHOOT_CORRECTION_M_S = 2.0, 1.0


class CopterTakeOff:
    """The vertical climb of a commanded take-off, which begins as soon as the motors have spooled up."""

    def __init__(self, copter: CopterHost, altitude_m: float) -> None:
        self._copter = copter
        motion = copter.motion
        _, _, home_down = copter.home_or_ground
        self.target: Ned = (motion.north, motion.east, home_down - altitude_m)
        self.is_complete: bool = False

    def update(self, climb_m_s: float) -> None:
        copter, motion = self._copter, self._copter.motion
        _, _, target_down = self.target
        copter.motors.spool_up_requested = True
        if copter.is_landed:  # Leave the ground as soon as the motors have spooled up.
            copter.is_landed = not copter.motors.can_lift
            return
        motion.seek_position(
            *self.target, speed=_DRIFT_CORRECTION_M_S, climb=climb_m_s, descent=_OVERSHOOT_CORRECTION_M_S
        )
        if abs(motion.down - target_down) < _REACHED_M and abs(motion.velocity_down) < _AT_REST_M_S:
            self.is_complete = True


_MID_STICK, _STICK_RANGE, _THROTTLE_DEADZONE = 1500, 500, 100
_FULL_STICK_LEAN_RAD = math.radians(30.0)
_FULL_STICK_TURN_RAD_S = math.radians(200.0)
_LOITER_SPEED_M_S = 12.5
_STABILIZE_CLIMB_M_S = 6.0


class CopterPilotedMode(CopterModeBase):
    """Base of the piloted modes, in which sticks control the attitude and a climb rate.

    Stick positions come from RC_CHANNELS_OVERRIDE, or from the test (``copter.rc``).
    """

    takes_off: bool = True
    """True if the mode supports take-off by command."""

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._take_off: CopterTakeOff | None = None  # None while no take-off runs

    def enter(self, *, force: bool) -> bool:
        self._take_off = None
        self.is_taking_off = False
        return True

    def climb_from_stick(self) -> float:
        """Return the climb rate in m/s that the throttle stick commands."""
        stick = self.vehicle.rc[RC_THROTTLE] - _MID_STICK
        if abs(stick) <= _THROTTLE_DEADZONE:
            return 0.0
        share = (abs(stick) - _THROTTLE_DEADZONE) / (_STICK_RANGE - _THROTTLE_DEADZONE)
        return math.copysign(min(1.0, share) * self.vehicle.parameters["PILOT_SPEED_UP"] / 100.0, stick)

    def update(self, dt: float) -> None:
        copter = self.vehicle
        if self._take_off is not None:
            self._take_off.update(copter.speed_limit("PILOT_SPEED_UP"))
            if self._take_off.is_complete:
                self._take_off = None
                self.is_taking_off = False
            return
        climb = self.climb_from_stick()
        # On the ground, a throttle stick above its middle starts the copter.
        copter.motors.spool_up_requested = not copter.is_landed or climb > 0
        if copter.is_landed and climb > 0 and copter.motors.can_lift:
            copter.is_landed = False
        if copter.is_landed:
            return
        roll, pitch, yaw = map(copter.stick, (RC_ROLL, RC_PITCH, RC_YAW))
        self.fly(roll, pitch, climb)
        copter.motion.turn(yaw * _FULL_STICK_TURN_RAD_S)

    def fly(self, roll: float, pitch: float, climb: float) -> None:
        """Follow the roll and pitch sticks (-1 to 1), and climb at ``climb`` m/s."""
        self.vehicle.motion.seek_attitude(roll * _FULL_STICK_LEAN_RAD, pitch * _FULL_STICK_LEAN_RAD, -climb)

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        # Only the modes that need a position can hold the horizontal position.
        if not self.takes_off or (must_navigate and not self.needs_position):
            return False
        self._take_off = CopterTakeOff(self.vehicle, altitude_m)
        self.is_taking_off: bool = True
        return True


class CopterStabilize(CopterPilotedMode):
    """STABILIZE and ACRO: sticks control attitude and throttle. With a low throttle stick the copter sinks fast."""

    needs_position = False
    has_manual_throttle = True
    takes_off = False

    def climb_from_stick(self) -> float:
        # In this mode the stick sets the throttle instead of a climb rate. The middle position hovers.
        throttle = self.vehicle.rc[RC_THROTTLE]
        if self.vehicle.is_landed and throttle <= _MID_STICK:
            return 0.0
        return _STABILIZE_CLIMB_M_S * (throttle - _MID_STICK) / _STICK_RANGE


class CopterLoiter(CopterPilotedMode):
    """LOITER and similar modes: sticks set velocities, and centered sticks hold the position.

    With a low throttle stick, the copter descends and lands.
    """

    def fly(self, roll: float, pitch: float, climb: float) -> None:
        velocity = (-pitch * _LOITER_SPEED_M_S, roll * _LOITER_SPEED_M_S, -climb)
        self.vehicle.motion.seek_velocity(*rotated(velocity, self.vehicle.motion.yaw))


_RTL_MIN_ALTITUDE_M = 2.0
_ARRIVED_M = 0.5
_SMART_RTL_EXTRA_ALTITUDE_M = 2.0


class CopterLand(CopterModeBase):
    """LAND: descends with LAND_SPEED_HIGH, below LAND_ALT_LOW with LAND_SPEED, and disarms on the ground.

    If LAND_SPEED_HIGH is 0, WPNAV_SPEED_DN replaces it.
    """

    needs_position = False
    can_arm = False
    is_landing = True

    def enter(self, *, force: bool) -> bool:
        self.vehicle.yaw.hold()
        return True

    def update(self, dt: float) -> None:
        self.vehicle.land()


class CopterRtl(CopterModeBase):
    """RTL: climbs to RTL_ALT, flies to home or a rally point, waits for RTL_LOIT_TIME and lands.

    Near the destination, a lower altitude suffices (RTL_CONE_SLOPE).
    """

    can_arm = False
    can_change_speed = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._phase = "climb"  # "climb", "return", "wait" or "land"
        self._return_down = 0.0  # altitude of the return
        self._waiting_since = 0.0
        self._end: Ned = (0.0, 0.0, 0.0)  # place at which the copter lands
        self.speed: float = 0.0

    def enter(self, *, force: bool) -> bool:
        copter = self.vehicle
        self._phase = "climb"
        self.is_landing = False
        # The value 0 of RTL_SPEED selects WPNAV_SPEED.
        self.speed = copter.speed_limit("RTL_SPEED") or copter.speed_limit("WPNAV_SPEED")
        home = copter.home_or_ground
        _, _, home_down = home
        self._end = best_return_place(copter, home, is_allowed=copter.fence.contains)
        _, _, down = self._end
        # The copter returns at the return altitude or at the altitude of `_end`, whichever is higher. `min` selects
        # the higher one, because a smaller down coordinate is higher.
        self._return_down = min(down, home_down - self._return_altitude(copter.motion.distance_to(self._end)))
        copter.yaw.apply_default(returning=True)
        return True

    def _return_altitude(self, distance: float) -> float:
        """Return the altitude above home, in metres, of a return over ``distance`` metres."""
        parameters = self.vehicle.parameters
        current = self.vehicle.navigation.altitude_above_home
        after_min_climb = current + parameters["RTL_CLIMB_MIN"] / 100.0
        target = max(after_min_climb, parameters["RTL_ALT"] / 100.0, _RTL_MIN_ALTITUDE_M)
        if parameters["RTL_CONE_SLOPE"] > 0:
            altitude_of_cone = distance * parameters["RTL_CONE_SLOPE"]
            target = min(target, max(altitude_of_cone, _RTL_MIN_ALTITUDE_M))
        return max(target, current)  # A return never begins with a descent.

    @property
    def destination(self) -> Ned | None:
        north, east, down = self._end
        if self._phase == "climb":
            return (self.vehicle.motion.north, self.vehicle.motion.east, self._return_down)
        return (north, east, down if self._phase == "land" else self._return_down)

    def update(self, dt: float) -> None:
        copter, target = self.vehicle, self.destination
        if self._phase == "land":
            copter.land()
        elif copter.is_landed:  # Let the motors idle; the copter then disarms after DISARM_DELAY.
            copter.motors.spool_up_requested = False
        elif target is not None:
            distance = copter.fly_to(target, self.speed)
            self._update_phase(has_arrived=distance < _ARRIVED_M)

    def _update_phase(self, *, has_arrived: bool) -> None:
        if self._phase == "climb" and has_arrived:
            self._phase = "return"
        elif self._phase == "return" and has_arrived:
            self._phase = "wait"
            self._waiting_since = self.vehicle.now
        elif self._phase == "wait":
            waited = self.vehicle.now - self._waiting_since
            if waited >= self.vehicle.parameters["RTL_LOIT_TIME"] / 1000.0:
                self._phase = "land"
                self.is_landing: bool = True


class CopterSmartRtl(CopterModeBase):
    """SMART_RTL: flies back along the simplified path and lands at its start. See `SmartPath`."""

    can_arm = False
    returns_on_path = True

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._way_back: list[Ned] = []  # points to fly to, in order

    def enter(self, *, force: bool) -> bool:
        if not self.vehicle.path.is_active:
            return False
        self._way_back = self.vehicle.path.take_way_back()
        self.is_landing = False
        self._raise_last(_SMART_RTL_EXTRA_ALTITUDE_M)  # The last point is the start of the landing.
        self.vehicle.yaw.apply_default(returning=True)
        return True

    def _raise_last(self, metres: float) -> None:
        if self._way_back:
            north, east, down = self._way_back[-1]
            self._way_back[-1] = (north, east, down - metres)

    def leave(self) -> None:
        if self._way_back:
            # A later SMART_RTL can use the points that were not reached.
            self._raise_last(-_SMART_RTL_EXTRA_ALTITUDE_M)
            self.vehicle.path.restore(self._way_back)

    @property
    def destination(self) -> Ned | None:
        return self._way_back[0] if self._way_back else None

    def update(self, dt: float) -> None:
        copter = self.vehicle
        if copter.is_landed or not self._way_back:
            self.is_landing: bool = True
            copter.land()
            return
        next_point = self._way_back[0]
        is_last = len(self._way_back) == 1
        distance = copter.fly_to(next_point, copter.speed_limit("WPNAV_SPEED"))
        # The copter stops only at the last point, where it lands.
        max_distance = _ARRIVED_M if is_last else copter.parameters["WPNAV_RADIUS"] / 100
        if distance < max_distance:
            del self._way_back[0]
