"""Navigator of a simulated PX4, which controls the motion in each mode."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavMissionType
from aerokit.sim.motion import BRAKING_SHARE, Ned, approach_speed, velocity_to_landing_target
from aerokit.sim.px4 import modes
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.manual import Px4ManualFlight
from aerokit.sim.px4.modes import Px4Mode

_MIN_CLIMB_SHARE = 0.05
_MIN_RADIUS_M, _MAX_RADIUS_M = 1.0, 100.0
_BACK_TO_CIRCLE_PER_S = 0.5


class Px4Orbit:
    """The circle of the mode ORBIT. A negative radius is counter-clockwise."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.middle: tuple[float, float] = (0.0, 0.0)
        self.down: float = 0.0
        self.radius_m: float = 20.0
        self.speed_m_s: float = 1.0

    def plan(self, radius_m: float, speed_m_s: float, place: tuple[float, float], down: float) -> bool:
        """Set a new circle. Return False, and keep the old one, if the radius is out of range."""
        if not _MIN_RADIUS_M <= abs(radius_m) <= _MAX_RADIUS_M:
            return False
        self.radius_m = radius_m
        self.speed_m_s = speed_m_s
        self.middle = place
        self.down = down
        return True

    def update(self) -> None:
        motion = self._px4.motion
        middle_north, middle_east = self.middle
        north, east = motion.north - middle_north, motion.east - middle_east
        # Bearing and distance of the vehicle, seen from the middle of the circle.
        angle, distance = math.atan2(east, north), math.hypot(north, east)
        turn_sign = math.copysign(1.0, self.radius_m)
        tangent = angle + turn_sign * math.pi / 2
        speed = self.speed_m_s
        # The radial velocity, which leads back to the circle: positive away from the middle, negative towards it.
        outwards = max(-speed, min(speed, _BACK_TO_CIRCLE_PER_S * (abs(self.radius_m) - distance)))
        motion.seek_velocity(
            speed * math.cos(tangent) + outwards * math.cos(angle),
            speed * math.sin(tangent) + outwards * math.sin(angle),
            max(-1.0, min(1.0, self.down - motion.down)),
        )
        motion.face(angle + math.pi)  # The nose points to the middle.

    def status(self) -> m.OrbitExecutionStatus:
        px4 = self._px4
        place = px4.frame.to_global(*self.middle, self.down)
        return m.OrbitExecutionStatus(px4.time_boot_us, self.radius_m, MavFrame.GLOBAL, *place)


_MIN_TOLERANCE_M = 0.05


class PrecisionLanding:
    """Precision landing: approaches the target from above, then descends.

    If the target is lost, the vehicle climbs to PLD_SRCH_ALT to search for it, at most PLD_MAX_SRCH times.
    """

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.enter()

    def enter(self) -> None:
        self._search_began_at: float | None = None  # None while the target is visible
        self._search_count = 0
        self._has_given_up = False

    def update(self) -> None:
        px4, motion, parameters = self._px4, self._px4.motion, self._px4.parameters
        target = px4.external.target
        # After too many or too long searches, the vehicle lands without the target, even if it becomes visible again.
        if self._has_given_up:
            px4.flight.descend()
            return
        if target is None:
            self._search()
            return
        self._search_began_at = None
        target_north, target_east = target
        north, east = target_north - motion.north, target_east - motion.east
        # The vehicle never is exactly above the target, so a minimum tolerance replaces a parameter of 0.
        is_above = math.hypot(north, east) <= max(parameters["PLD_HACC_RAD"], _MIN_TOLERANCE_M)
        descent = px4.flight.descent_speed_m_s if is_above else 0.0
        motion.seek_velocity(*velocity_to_landing_target(north, east), descent)

    def _search(self) -> None:
        px4, motion, parameters = self._px4, self._px4.motion, self._px4.parameters
        if self._search_began_at is None:
            self._search_began_at = px4.now
            self._search_count += 1
        has_timed_out = px4.now - self._search_began_at > parameters["PLD_SRCH_TOUT"]
        if has_timed_out or self._search_count > parameters["PLD_MAX_SRCH"]:
            self._has_given_up = True
            px4.flight.descend()
            return
        _, _, home_down = px4.home
        search_down = home_down - parameters["PLD_SRCH_ALT"]
        # Search from above: hold the place, and climb to the search altitude.
        motion.seek_position(motion.north, motion.east, search_down, speed=1.0, climb=2.0, descent=1.0)


# Values of RTL_TYPE.
_NEAREST, _RALLY_FIRST = (0, 3), 1


def return_destination(px4: Px4Host) -> Ned:
    """Return the destination of RTL. The heights in parameters of RTL are relative to the destination."""
    rtl_type = round(px4.parameters["RTL_TYPE"])
    rally_points = [px4.place_of(item) for item in px4.missions.items(MavMissionType.RALLY)]
    if rtl_type not in (*_NEAREST, _RALLY_FIRST) or not rally_points:
        return px4.home
    candidates = rally_points if rtl_type == _RALLY_FIRST else [px4.home, *rally_points]
    return min(candidates, key=px4.motion.distance_to)


_SPOOL_UP_S = 1.8
_ARRIVED_M = 0.5
_MIN_SPEED_TO_TURN_M_S = 0.5


class Px4Flight:
    """Navigator of a multicopter, with the target, the speeds, and the phase of a take-off or return."""

    def __init__(self, vehicle: Px4Host) -> None:
        self._vehicle = vehicle
        self.target: Ned = (0.0, 0.0, 0.0)  # Point of the local frame to which HOLD, TAKEOFF and RTL fly.
        self.destination: Ned = (0.0, 0.0, 0.0)  # Landing point of RTL, which is home or a rally point.
        self.heading: float | None = None  # Heading in radians; None if the nose points in the direction of flight.
        self.speed_m_s: float = 0.0
        self.radius_m: float = 0.0  # Radius of a plane's circle; a negative radius is counter-clockwise.
        self.lifts_off: bool = False  # True if the mode makes the vehicle leave the ground.
        self.manual_flight: Px4ManualFlight = Px4ManualFlight(vehicle)
        self.precision_landing: PrecisionLanding = PrecisionLanding(vehicle)
        self.orbit: Px4Orbit = Px4Orbit(vehicle)
        self._phase = ""  # phase of a return: "climb", "return" or "land"
        self._ramp_began_at = 0.0  # time of the lift-off, from which the climb rate grows
        self._is_default_height = False  # True if the take-off command had no altitude

    @property
    def cruise_speed_m_s(self) -> float:
        return self._vehicle.parameters["MPC_XY_CRUISE"]

    @property
    def top_speed_m_s(self) -> float:
        return self._vehicle.parameters["MPC_XY_VEL_MAX"]

    def enter(self, mode: Px4Mode) -> None:
        self.speed_m_s = self.cruise_speed_m_s
        self.heading = None
        self._phase = "climb"
        self.stay_here()
        self.manual_flight.enter()
        self.precision_landing.enter()
        if mode == modes.RTL and self._vehicle.is_armed:
            self._plan_return()
        elif mode == modes.MISSION:
            self._vehicle.mission.enter()

    def stay_here(self) -> None:
        # A moving vehicle would overshoot its present place and fly back (navigator_main.cpp, preproject_stop_point).
        self.target = self._vehicle.motion.stopping_place

    def update(self) -> None:
        vehicle = self._vehicle
        mode = vehicle.mode
        self.lifts_off = (
            mode == modes.TAKEOFF
            or self.manual_flight.wants_up
            or (mode == modes.OFFBOARD and vehicle.offboard.wants_up)
            or (mode == modes.MISSION and vehicle.mission.wants_up)
        )
        if vehicle.is_landed:
            if self.lifts_off:
                self._lift_off()
            return
        if mode == modes.TAKEOFF:
            self._take_off()
        elif mode == modes.LAND:
            self.descend()
        elif mode == modes.PRECISION_LAND:
            self.precision_landing.update()
        elif mode == modes.RTL:
            self._return()
        elif mode == modes.OFFBOARD:
            vehicle.offboard.fly()
        elif mode == modes.MISSION:
            vehicle.mission.update()
        elif mode in modes.STICK_MODES:
            self.manual_flight.update()
        elif mode == modes.ORBIT:
            self.orbit.update()
        elif mode == modes.TERMINATION:
            pass  # The motors are off.
        else:
            self.fly_to_target()

    def _lift_off(self) -> None:
        vehicle = self._vehicle
        if vehicle.now - vehicle.arming.armed_at >= _SPOOL_UP_S:
            self._ramp_began_at = vehicle.now
            vehicle.leave_ground()

    def _take_off(self) -> None:
        vehicle = self._vehicle
        ramp_duration_s = max(0.1, vehicle.parameters["MPC_TKO_RAMP_T"])  # The parameter may be 0.
        ramp = (vehicle.now - self._ramp_began_at) / ramp_duration_s
        climb_share = max(_MIN_CLIMB_SHARE, min(1.0, ramp))  # The climb rate grows during MPC_TKO_RAMP_T.
        climb = vehicle.parameters["MPC_TKO_SPEED"] * climb_share
        vehicle.motion.seek_position(*self.target, speed=self.speed_m_s, climb=climb, descent=1.0)
        target = self.target
        _, _, target_down = target
        if abs(vehicle.motion.down - target_down) < _ARRIVED_M:
            vehicle.mission.is_finished = True  # takeoff.cpp sets mission_result.finished.
            vehicle.switch_to(modes.HOLD)  # This sets the target to the current position.
            self.target = target

    def plan_take_off(self, down: float | None = None) -> None:
        """Plan a vertical climb to ``down``. None selects MIS_TAKEOFF_ALT above home."""
        vehicle, motion = self._vehicle, self._vehicle.motion
        self._is_default_height = down is None
        vehicle.mission.is_finished = False
        if down is None:
            # A smaller down coordinate is higher.
            _, _, home_down = vehicle.home
            down = min(home_down - vehicle.parameters["MIS_TAKEOFF_ALT"], motion.down)
        self.target = (motion.north, motion.east, down)
        if vehicle.is_armed:
            vehicle.call_later(0.0, self.announce_take_off)

    def announce_take_off(self) -> None:
        if self._is_default_height:
            altitude = self._vehicle.parameters["MIS_TAKEOFF_ALT"]
            self._vehicle.info(f"Using default takeoff altitude: {altitude:.1f} m")

    def fly_to_target(self) -> None:
        vehicle, limits = self._vehicle, self._vehicle.parameters
        climb, descent = limits["MPC_Z_V_AUTO_UP"], limits["MPC_Z_V_AUTO_DN"]
        vehicle.motion.seek_position(*self.target, speed=self.speed_m_s, climb=climb, descent=descent)
        self._turn_nose()

    def _turn_nose(self) -> None:
        motion = self._vehicle.motion
        if self.heading is not None:
            motion.face(self.heading)
        elif motion.ground_speed_m_s > _MIN_SPEED_TO_TURN_M_S:
            motion.face(motion.course)

    def descend(self) -> None:
        self._vehicle.motion.seek_velocity(0.0, 0.0, self.descent_speed_m_s)

    @property
    def descent_speed_m_s(self) -> float:
        vehicle, limits = self._vehicle, self._vehicle.parameters
        fast, slow = limits["MPC_Z_V_AUTO_DN"], limits["MPC_LAND_SPEED"]
        high, low = limits["MPC_LAND_ALT1"], limits["MPC_LAND_ALT2"]
        share = min(1.0, max(0.0, (vehicle.altitude_m - low) / max(0.1, high - low)))
        return slow + (fast - slow) * share

    def _plan_return(self) -> None:
        vehicle = self._vehicle
        self.destination = return_destination(vehicle)
        north, east, down = vehicle.motion.place
        _, _, destination_down = self.destination
        current_height = destination_down - down
        is_near = vehicle.motion.distance_to(self.destination) < vehicle.parameters["RTL_MIN_DIST"]
        return_height = vehicle.parameters["RTL_DESCEND_ALT" if is_near else "RTL_RETURN_ALT"]
        # The return begins with a climb at the present place, and never with a descent.
        height = max(return_height, current_height)
        return_down = destination_down - height
        self.target = (north, east, return_down)
        amsl = vehicle.frame.origin.altitude_m - return_down
        text = f"RTL: start return at {amsl:.0f} m ({height:.0f} m above destination)"
        vehicle.call_later(0.0, lambda: vehicle.info(text))  # PX4 sends this text after the text of the command.

    def _return(self) -> None:
        vehicle, motion = self._vehicle, self._vehicle.motion
        if self._phase == "land":
            self.descend()
            return
        self.fly_to_target()
        if math.dist(self.target, motion.place) > _ARRIVED_M:
            return
        # In the phase "climb", the vehicle has arrived above its starting point. In the phase "return", it has arrived
        # above the destination.
        if self._phase == "climb":
            self._phase = "return"
            north, east, _ = self.destination
            _, _, return_down = self.target
            self.target = (north, east, return_down)
        else:
            self._phase = "land"
            vehicle.info("RTL: land at destination")


def velocity_towards(offset: float, limit: float, acceleration: float) -> float:
    """Return the velocity in m/s along one axis that lets a vehicle stop at a point ``offset`` metres away.

    The velocity is at most ``limit``. ``acceleration`` (m/s²) limits the braking.
    """
    speed = approach_speed(abs(offset), BRAKING_SHARE * acceleration)
    return math.copysign(min(limit, speed), offset)
