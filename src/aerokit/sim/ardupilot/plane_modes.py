"""ArduPlane's landing, and its flight modes except AUTO and GUIDED."""

from __future__ import annotations

import math

from aerokit.mavlink.enums import MavModeFlag, MavSeverity
from aerokit.sim.ardupilot.host import RC_PITCH, RC_ROLL, RC_THROTTLE, ArduPilotMode, ConditionTimer
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.motion import Motion, Ned, SimulatedWind
from aerokit.sim.vehicle_motion import FixedWing


class PlaneHost(ArduPilotVehicle):
    """The interface of a simulated plane for its flight modes and failsafes."""

    def make_motion(self, wind: SimulatedWind | None) -> Motion:
        self.wing: FixedWing = FixedWing(self.rng, wind=wind)
        """The motion model, which is the same object as ``motion``."""
        self._read_limits()
        return self.wing

    def _read_limits(self) -> None:
        limits, parameters = self.wing.wing_limits, self.parameters
        limits.airspeed_min_m_s = parameters["AIRSPEED_MIN"]
        limits.airspeed_max_m_s = parameters["AIRSPEED_MAX"]
        limits.climb_m_s = parameters["TECS_CLMB_MAX"]
        limits.sink_m_s = parameters["TECS_SINK_MAX"]
        limits.glide_sink_m_s = parameters["TECS_SINK_MIN"]
        limits.bank_rad = math.radians(parameters["ROLL_LIMIT_DEG"])

    def reset_controllers(self) -> None:
        self.take_off_yaw: float | None = None
        """Heading of the take-off in radians; None before the first take-off."""
        self.rest_timer: ConditionTimer = ConditionTimer()

    @property
    def cruise_m_s(self) -> float:
        return self.parameters["AIRSPEED_CRUISE"]

    @property
    def home_of_rtl(self) -> Ned:
        """Home at RTL_ALTITUDE. If RTL_ALTITUDE is negative, home at the current altitude."""
        north, east, home_down = self.home_or_ground
        height = self.parameters["RTL_ALTITUDE"]
        return (north, east, self.wing.down if height < 0 else home_down - height)

    def is_valid_airspeed(self, airspeed: float) -> bool:
        """Return True if an airspeed (m/s) is within AIRSPEED_MIN and AIRSPEED_MAX."""
        return self.parameters["AIRSPEED_MIN"] <= airspeed <= self.parameters["AIRSPEED_MAX"]

    def lift_off(self) -> None:
        """Begin a take-off, if the plane is landed. ``is_landed`` is False from the start of the roll."""
        if self.is_landed:
            self._read_limits()
            self.is_landed: bool = False
            self.rest_timer.reset()
            self.take_off_yaw = self.wing.yaw

    def climb_out(self) -> None:
        """Fly in the take-off direction at cruise speed, and climb as soon as the airspeed suffices."""
        wing = self.wing
        self.lift_off()
        if wing.is_on_ground:  # Keep straight ahead until the plane leaves the ground.
            wing.bank_and_climb(self.cruise_m_s, 0.0, wing.wing_limits.climb_m_s)
        else:
            yaw = wing.yaw if self.take_off_yaw is None else self.take_off_yaw
            wing.head(yaw, self.cruise_m_s, wing.wing_limits.climb_m_s)


_FLARE_SINK_M_S = 0.5
_APPROACH_SHARE = 0.85
# An approach begins within this distance and this height difference from its start.
_JOINED_M, _JOINED_HEIGHT_M = 60.0, 15.0
_CORRECTION_LENGTH_M = 80.0


class PlaneLanding:
    """Landing on ``point``, with the approach, the flare, the roll-out and disarming.

    The approach begins at ``start``, or at the current position if ``start`` is None.
    """

    def __init__(self, plane: PlaneHost, point: Ned, start: Ned | None = None) -> None:
        self._plane = plane
        self.point: Ned = point
        self._unreached_start = start  # Place to fly to before the approach; None once the approach has begun.
        self._approach_start: Ned = plane.wing.place
        self._is_flaring = False
        self._is_distance_reported = False
        self._stopped_at = math.nan  # NaN until the plane has stopped after the landing

    def update(self, dt: float) -> None:
        plane, wing = self._plane, self._plane.wing
        if plane.is_landed:
            self._disarm_after_stop()
        elif wing.is_on_ground:  # The plane has touched down, but still rolls.
            wing.roll_out()
        elif self._unreached_start is not None:
            self._fly_to_start(self._unreached_start)
        else:
            self._approach()

    def _fly_to_start(self, start: Ned) -> None:
        wing = self._plane.wing
        _, _, down = start
        if wing.distance_to(start) < _JOINED_M and abs(wing.down - down) < _JOINED_HEIGHT_M:
            self._approach_start = wing.place
            self._unreached_start = None
            return
        wing.fly_to(*start, airspeed=self._plane.cruise_m_s)

    def _approach(self) -> None:
        plane, wing = self._plane, self._plane.wing
        north, east, down = self.point
        start_north, start_east, _ = self._approach_start
        course = math.atan2(east - start_east, north - start_north)
        cos_course, sin_course = math.cos(course), math.sin(course)
        # Metres to the landing point along the approach line; negative once the plane has passed the point.
        remaining = (north - wing.north) * cos_course + (east - wing.east) * sin_course
        # Metres from the plane to the approach line; positive if the line is on the right.
        aside = (east - wing.east) * cos_course - (north - wing.north) * sin_course
        # The flare starts below LAND_FLARE_ALT, or when the plane would touch down within LAND_FLARE_SEC.
        height, sink_rate = down - wing.down, wing.velocity_down
        flare_height = max(plane.parameters["LAND_FLARE_ALT"], sink_rate * plane.parameters["LAND_FLARE_SEC"])
        if height < flare_height and not self._is_flaring:
            self._start_flare(height, remaining)
        if self._is_flaring:
            speed, climb = wing.wing_limits.airspeed_min_m_s, -_FLARE_SINK_M_S
        else:
            speed, climb = _APPROACH_SHARE * plane.cruise_m_s, self._climb_on_slope(max(0.0, remaining))
        # The farther the plane is from the approach line, the more directly its course points to the line.
        wing.head(course + math.atan2(aside, _CORRECTION_LENGTH_M), speed, climb)

    def _climb_on_slope(self, remaining: float) -> float:
        """Return the climb rate on the straight slope to the landing point, ``remaining`` metres from the point."""
        wing = self._plane.wing
        north, east, down = self.point
        start_north, start_east, start_down = self._approach_start
        length = max(1.0, math.hypot(north - start_north, east - start_east))
        down_on_slope = down + (start_down - down) * remaining / length
        slope_sink = (down - start_down) * wing.ground_speed_m_s / length
        return -slope_sink + wing.climb_rate_to(down_on_slope)

    def _start_flare(self, height: float, remaining: float) -> None:
        self._is_flaring = True
        wing = self._plane.wing
        speed, sink = wing.ground_speed_m_s, wing.velocity_down
        self._plane.info(f"Flare {height:.1f}m sink={sink:.2f} speed={speed:.1f} dist={remaining:.1f}")

    def _disarm_after_stop(self) -> None:
        plane, wing = self._plane, self._plane.wing
        if math.isnan(self._stopped_at):
            self._stopped_at = plane.now
        delay = plane.parameters["LAND_DISARMDELAY"]
        is_due = delay > 0 and plane.now - self._stopped_at >= delay
        if is_due and plane.is_armed:
            plane.arming.disarm()
            plane.info("Auto disarmed")
            if not self._is_distance_reported:
                self._is_distance_reported = True
                plane.info(f"Distance from LAND point={wing.distance_to(self.point):.2f}m")


_LOW_THROTTLE = 1100
_CENTERED_STICK = 0.05  # A stick with at most this deflection counts as centered.
_CIRCLE_BANK_SHARE = 1 / 3
# A take-off is complete when the plane is this many metres below the target altitude.
_TAKE_OFF_DONE_M = 5.0
_NAVIGATES = MavModeFlag.GUIDED_ENABLED | MavModeFlag.STABILIZE_ENABLED


class PlaneModeBase(ArduPilotMode):
    """Base of ArduPlane's modes. All of them can be entered while the vehicle does not know its position."""

    vehicle: PlaneHost
    needs_position = False
    flags: int = MavModeFlag.STABILIZE_ENABLED
    """MAV_MODE_FLAGs in HEARTBEAT."""


class PlanePilotedMode(PlaneModeBase):
    """Base of the piloted modes: sticks control bank, climb and speed. With a low throttle, the plane glides."""

    has_manual_throttle = True

    def update(self, dt: float) -> None:
        plane, wing = self.vehicle, self.vehicle.wing
        limits = wing.wing_limits
        throttle_pulse = plane.rc[RC_THROTTLE]
        is_idle = throttle_pulse <= _LOW_THROTTLE
        if plane.is_landed and is_idle:
            wing.roll_out()
            return
        plane.lift_off()
        climb = self.vehicle.stick(RC_PITCH) * limits.climb_m_s  # The value of a pulled stick is positive: a climb.
        if is_idle:  # Without thrust, the plane glides, and a pulled stick has no effect.
            climb = min(climb, 0.0) - limits.glide_sink_m_s
        throttle = max(0.0, min(1.0, (throttle_pulse - 1000) / 1000))
        speed = throttle * 2 * plane.cruise_m_s  # Half throttle flies at cruise speed.
        wing.bank_and_climb(speed, self.vehicle.stick(RC_ROLL) * limits.bank_rad, climb)


class PlaneAltitudeMode(PlaneModeBase):
    """FBWB, and base of the modes that hold altitude and speed. On the ground, the plane rolls to a stop."""

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._down = 0.0  # altitude to hold

    def enter(self, *, force: bool) -> bool:
        self._down = self.vehicle.wing.down
        return True

    def update(self, dt: float) -> None:
        wing = self.vehicle.wing
        if self.vehicle.is_landed:
            wing.roll_out()
            return
        self._down -= self.climb_rate() * dt
        self.steer(wing.climb_rate_to(self._down))

    def climb_rate(self) -> float:
        """Return the climb rate in m/s that the pitch stick commands."""
        return self.vehicle.stick(RC_PITCH) * self.vehicle.parameters["FBWB_CLIMB_RATE"]

    def steer(self, climb: float) -> None:
        """Bank as the roll stick commands, and climb at ``climb`` m/s."""
        wing = self.vehicle.wing
        wing.bank_and_climb(self.vehicle.cruise_m_s, self.vehicle.stick(RC_ROLL) * wing.wing_limits.bank_rad, climb)


class PlaneCruise(PlaneAltitudeMode):
    """CRUISE: works like FBWB, and holds the course over ground while the roll stick is centered."""

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._course: float | None = None  # course to hold, in radians from north; None while the pilot turns

    def steer(self, climb: float) -> None:
        wing = self.vehicle.wing
        if abs(self.vehicle.stick(RC_ROLL)) > _CENTERED_STICK:  # The pilot turns, so no course is held.
            self._course = None
            super().steer(climb)
            return
        if self._course is None:
            self._course = wing.course  # Hold the present course over ground.
        wing.head(self._course, self.vehicle.cruise_m_s, climb)


class PlaneCircle(PlaneAltitudeMode):
    """CIRCLE: turns with a small bank angle at constant altitude, without GPS."""

    flags: int = _NAVIGATES

    def climb_rate(self) -> float:
        return 0.0

    def steer(self, climb: float) -> None:
        wing = self.vehicle.wing
        wing.bank_and_climb(self.vehicle.cruise_m_s, _CIRCLE_BANK_SHARE * wing.wing_limits.bank_rad, climb)


class PlaneNavigatingMode(PlaneModeBase):
    """LOITER: circles the place where the mode was entered. Subclasses circle another place."""

    flags: int = _NAVIGATES

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self.speed: float = 0.0  # Commanded airspeed in m/s; 0 selects AIRSPEED_CRUISE.
        self.radius: float = 0.0  # Radius of the circle in metres; 0 selects WP_LOITER_RAD.

    def enter(self, *, force: bool) -> bool:
        self.speed = self.radius = 0.0
        self._place = self.vehicle.wing.place
        return True

    @property
    def airspeed(self) -> float:
        return self.speed or self.vehicle.cruise_m_s

    def update(self, dt: float) -> None:
        wing = self.vehicle.wing
        if self.vehicle.is_landed or self._place is None:
            wing.roll_out()
            return
        radius = self.radius or self.vehicle.parameters["WP_LOITER_RAD"]
        wing.circle(*self._place, radius=radius, airspeed=self.airspeed)


class PlaneRtl(PlaneNavigatingMode):
    """RTL: circles above a rally point or home at RTL_ALTITUDE. If RTL_ALTITUDE is negative, keeps the altitude."""

    can_arm = False

    def enter(self, *, force: bool) -> bool:
        super().enter(force=force)
        plane = self.vehicle
        self.radius: float = plane.parameters["RTL_RADIUS"]
        self._place = best_return_place(plane, plane.home_of_rtl)
        return True


class PlaneTakeOff(PlaneNavigatingMode):
    """TAKEOFF: takes off after arming, climbs to TKOFF_ALT, and circles TKOFF_DIST metres ahead of the start."""

    def enter(self, *, force: bool) -> bool:
        super().enter(force=force)
        self._place = None
        self._is_climbing = False
        return True

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        return self._is_climbing

    def update(self, dt: float) -> None:
        plane = self.vehicle
        if self._place is None:
            self._start()
        if self._is_climbing:
            plane.climb_out()
            self._is_climbing = self._missing_height_m() > _TAKE_OFF_DONE_M
        else:
            super().update(dt)

    def _missing_height_m(self) -> float:
        assert self._place is not None
        _, _, target_down = self._place
        return self.vehicle.wing.down - target_down

    def _start(self) -> None:
        plane, wing = self.vehicle, self.vehicle.wing
        height, distance = plane.parameters["TKOFF_ALT"], plane.parameters["TKOFF_DIST"]
        north = wing.north + distance * math.cos(wing.yaw)
        east = wing.east + distance * math.sin(wing.yaw)
        _, _, home_down = plane.home_or_ground
        self._place = (north, east, home_down - height)
        self._is_climbing = self._missing_height_m() > _TAKE_OFF_DONE_M
        if plane.is_landed:
            heading = math.degrees(wing.yaw) % 360.0
            plane.info(f"Takeoff to {height:.0f}m for {distance:.1f}m heading {heading:.1f} deg")
        elif self._is_climbing:
            plane.info("Climbing to TKOFF alt then loitering")
        else:
            plane.info("Above TKOFF alt - loitering")


class PlaneAutoland(PlaneNavigatingMode):
    """AUTOLAND: lands at home in the direction of the take-off. The mode can only be entered in flight.

    A plane that is armed again after the landing disarms at once.
    """

    is_landing = True

    def enter(self, *, force: bool) -> bool:
        plane = self.vehicle
        if plane.mode is self and plane.is_landed:  # Arming enters the current mode again.
            return True
        if plane.is_landed:
            plane.send_text(MavSeverity.WARNING, "Must already be flying!")
            return False
        if plane.take_off_yaw is None:
            plane.send_text(MavSeverity.WARNING, "Takeoff initial direction not set")
            return False
        home = plane.home_or_ground
        north, east, down = home
        distance, height = plane.parameters["AUTOLAND_WP_DIST"], plane.parameters["AUTOLAND_WP_ALT"]
        # The landing has the direction of the take-off, so the approach starts on the other side of home.
        start_north = north - distance * math.cos(plane.take_off_yaw)
        start_east = east - distance * math.sin(plane.take_off_yaw)
        self._place = home
        self._landing = PlaneLanding(plane, home, (start_north, start_east, down - height))
        return True

    def update(self, dt: float) -> None:
        self._landing.update(dt)
