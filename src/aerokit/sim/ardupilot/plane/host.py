"""What the parts of a simulated ArduPlane use of it beside what every ArduPilot has, and how it lands."""

from __future__ import annotations

import math

from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.fixed_wing import FixedWing
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import Motion, Wind

_FLARE_SINK_M_S = 0.5
_APPROACH_SHARE = 0.85
_NEAR_M = 60.0
_LOOK_AHEAD_M = 80.0


class PlaneHost(ArduPilotVehicle):
    """An aeroplane, as its modes and failsafes see it."""

    def make_motion(self, wind: Wind | None) -> Motion:
        """An aeroplane within the limits of the parameters."""
        self.wing: FixedWing = FixedWing(self.rng, wind=wind)
        """What flies; the same as ``motion``."""
        self._read_limits()
        return self.wing

    def _read_limits(self) -> None:
        limits, parameters = self.wing.wing, self.parameters
        limits.airspeed_min_m_s = parameters["AIRSPEED_MIN"]
        limits.airspeed_max_m_s = parameters["AIRSPEED_MAX"]
        limits.climb_m_s = parameters["TECS_CLMB_MAX"]
        limits.sink_m_s = parameters["TECS_SINK_MAX"]
        limits.glide_sink_m_s = parameters["TECS_SINK_MIN"]
        limits.bank_rad = math.radians(parameters["ROLL_LIMIT_DEG"])

    def reset_controllers(self) -> None:
        self.take_off_yaw: float | None = None
        """Where it has taken off to, in radians; None before."""
        self._rests_since = math.nan

    @property
    def cruise_m_s(self) -> float:
        """AIRSPEED_CRUISE."""
        return self.parameters["AIRSPEED_CRUISE"]

    def can_fly_at(self, airspeed: float) -> bool:
        """Whether an airspeed in m/s is between AIRSPEED_MIN and AIRSPEED_MAX."""
        return self.parameters["AIRSPEED_MIN"] <= airspeed <= self.parameters["AIRSPEED_MAX"]

    def lift_off(self) -> None:
        """The engine runs: from now on it moves, on the ground at first."""
        if self.is_landed:
            self._read_limits()
            self.is_landed: bool = False
            self._rests_since = math.nan
            self.take_off_yaw = self.wing.yaw


class Landing:
    """To the start of the approach, down the slope, flare, roll-out, disarming.

    Comes down on ``point``; with ``start`` it flies there first, to come in from there.
    """

    def __init__(self, plane: PlaneHost, point: Ned, start: Ned | None = None) -> None:
        self._plane = plane
        self.point: Ned = point
        self._start = start
        wing = plane.wing
        self._from: Ned = wing.place
        self._flares = self._is_told = False
        self._stopped_at = math.nan

    def update(self, dt: float) -> None:
        plane, wing = self._plane, self._plane.wing
        if plane.is_landed:
            self._wait()
        elif wing.is_on_ground:
            wing.roll_out()
        elif self._start is not None:
            self._join(self._start)
        else:
            self._approach()

    def _join(self, start: Ned) -> None:
        wing = self._plane.wing
        distance = math.hypot(start[0] - wing.north, start[1] - wing.east)
        if distance < _NEAR_M and abs(wing.down - start[2]) < _NEAR_M / 4:
            self._from, self._start = wing.place, None
            return
        wing.fly_to(*start, airspeed=self._plane.cruise_m_s)

    def _approach(self) -> None:
        plane, wing, (north, east, down) = self._plane, self._plane.wing, self.point
        height = down - wing.down
        left = self._left()
        if height < max(
            plane.parameters["LAND_FLARE_ALT"], wing.velocity_down * plane.parameters["LAND_FLARE_SEC"]
        ):
            self._flare(height, left)
        length = max(1.0, math.hypot(north - self._from[0], east - self._from[1]))
        wanted = down + (self._from[2] - down) * max(0.0, left) / length
        climb = -_FLARE_SINK_M_S if self._flares else -self._slope_sink(length) + wing.climb_to(wanted)
        speed = plane.wing.wing.airspeed_min_m_s if self._flares else _APPROACH_SHARE * plane.cruise_m_s
        course = math.atan2(east - self._from[1], north - self._from[0])
        wing.head(course + self._correction(course), speed, climb)

    def _slope_sink(self, length: float) -> float:
        return (self.point[2] - self._from[2]) * self._plane.wing.ground_speed_m_s / length

    def _left(self) -> float:
        """Metres to go along the approach; negative beyond the point."""
        wing, (north, east, _) = self._plane.wing, self.point
        course = math.atan2(east - self._from[1], north - self._from[0])
        return (north - wing.north) * math.cos(course) + (east - wing.east) * math.sin(course)

    def _correction(self, course: float) -> float:
        wing, (north, east, _) = self._plane.wing, self.point
        aside = (east - wing.east) * math.cos(course) - (north - wing.north) * math.sin(course)
        return math.atan2(aside, _LOOK_AHEAD_M)

    def _flare(self, height: float, left: float) -> None:
        if self._flares:
            return
        self._flares, wing = True, self._plane.wing
        speed, sink = wing.ground_speed_m_s, wing.velocity_down
        self._plane.info(f"Flare {height:.1f}m sink={sink:.2f} speed={speed:.1f} dist={left:.1f}")

    def _wait(self) -> None:
        """LAND_DISARMDELAY after it stands."""
        plane = self._plane
        if math.isnan(self._stopped_at):
            self._stopped_at = plane.now
        delay = plane.parameters["LAND_DISARMDELAY"]
        if plane.is_armed and delay > 0 and plane.now - self._stopped_at >= delay:
            plane.arming.disarm()
            plane.info("Auto disarmed")
            self._tell_distance()

    def _tell_distance(self) -> None:
        if not self._is_told:
            wing, self._is_told = self._plane.wing, True
            aside = math.hypot(self.point[0] - wing.north, self.point[1] - wing.east)
            self._plane.info(f"Distance from LAND point={aside:.2f}m")
