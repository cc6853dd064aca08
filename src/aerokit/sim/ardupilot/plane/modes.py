"""ArduPlane's flight modes: what each needs and how it makes the aeroplane fly.

The modes of lifting rotors are refused, as without Q_ENABLE.
"""

from __future__ import annotations

import math

from aerokit.mavlink.enums import MavModeFlag, MavSeverity, PlaneMode
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.plane.host import Landing, PlaneHost
from aerokit.sim.local_frame import Ned

_MID_STICK, _STICK_RANGE, _LOW_THROTTLE = 1500, 500, 1100
_CIRCLE_BANK_SHARE = 1 / 3
_TAKE_OFF_DONE_M = 5.0
_NAVIGATES = MavModeFlag.GUIDED_ENABLED | MavModeFlag.STABILIZE_ENABLED


class PlaneModeBase(VehicleMode):
    """A mode of an aeroplane; it goes into each of them without knowing where it is."""

    needs_position = False
    flags: int = MavModeFlag.STABILIZE_ENABLED
    """MAV_MODE_FLAGs that HEARTBEAT shows."""

    def __init__(self, plane: PlaneHost) -> None:
        self.plane = plane

    def stick(self, index: int) -> float:
        """A stick, -1 to 1."""
        return (self.plane.rc[index] - _MID_STICK) / _STICK_RANGE

    def throttle(self) -> float:
        """The throttle stick, 0 to 1."""
        return max(0.0, min(1.0, (self.plane.rc[2] - 1000) / 1000))


class Piloted(PlaneModeBase):
    """The sticks fly: bank, climb and speed; with the throttle down it glides."""

    has_manual_throttle = True

    def update(self, dt: float) -> None:
        plane, wing, throttle = self.plane, self.plane.wing, self.throttle()
        if plane.is_landed and self.plane.rc[2] <= _LOW_THROTTLE:
            wing.roll_out()
            return
        plane.lift_off()
        climb = self.stick(1) * wing.wing.climb_m_s  # pulled back is above the middle
        if plane.rc[2] <= _LOW_THROTTLE:
            climb = min(climb, 0.0) - wing.wing.glide_sink_m_s
        wing.bank_and_climb(
            max(throttle * 2 * plane.cruise_m_s, 0.0), self.stick(0) * wing.wing.bank_rad, climb
        )


class FlyByWireB(PlaneModeBase):
    """Bank by stick, height and speed held."""

    number: int = PlaneMode.FLY_BY_WIRE_B
    name = "FLY_BY_WIRE_B"

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._down = 0.0

    def enter(self, *, force: bool) -> bool:
        self._down = self.plane.wing.down
        return True

    def update(self, dt: float) -> None:
        """Turn by stick; the pitch stick moves the height that is kept."""
        plane, wing = self.plane, self.plane.wing
        if plane.is_landed:
            wing.roll_out()
            return
        self._down -= self.stick(1) * plane.parameters["FBWB_CLIMB_RATE"] * dt
        self.steer(wing.climb_to(self._down))

    def steer(self, climb: float) -> None:
        wing = self.plane.wing
        wing.bank_and_climb(self.plane.cruise_m_s, self.stick(0) * wing.wing.bank_rad, climb)


class Cruise(FlyByWireB):
    """As FBWB, and without the stick on the same course over the ground."""

    number: int = PlaneMode.CRUISE
    name = "CRUISE"

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self._course: float | None = None

    def steer(self, climb: float) -> None:
        """The course is that when the stick was let go."""
        wing = self.plane.wing
        if abs(self.stick(0)) > 0.05:
            self._course = None
            super().steer(climb)
            return
        if self._course is None:
            self._course = math.atan2(wing.velocity_east, wing.velocity_north)
        wing.head(self._course, self.plane.cruise_m_s, climb)


class Circle(PlaneModeBase):
    """Keeps turning gently without GPS, and keeps its height."""

    number: int = PlaneMode.CIRCLE
    name = "CIRCLE"
    flags: int = _NAVIGATES

    def enter(self, *, force: bool) -> bool:
        self._down = self.plane.wing.down
        return True

    def update(self, dt: float) -> None:
        wing = self.plane.wing
        if self.plane.is_landed:
            wing.roll_out()
        else:
            bank = _CIRCLE_BANK_SHARE * wing.wing.bank_rad
            wing.bank_and_climb(self.plane.cruise_m_s, bank, wing.climb_to(self._down))


class NavigatingMode(PlaneModeBase):
    """Flies somewhere by itself, and circles there."""

    flags: int = _NAVIGATES

    def __init__(self, plane: PlaneHost) -> None:
        super().__init__(plane)
        self.speed: float = 0.0
        """Airspeed in m/s that was asked for; 0 is AIRSPEED_CRUISE."""
        self.radius: float = 0.0
        """Of the circle in metres; 0 is WP_LOITER_RAD."""
        self._place: Ned | None = None

    def enter(self, *, force: bool) -> bool:
        wing = self.plane.wing
        self.speed = 0.0
        self.radius = 0.0
        self._place = wing.place
        return True

    @property
    def destination(self) -> Ned | None:
        return self._place

    @property
    def airspeed(self) -> float:
        return self.speed or self.plane.cruise_m_s

    def update(self, dt: float) -> None:
        wing = self.plane.wing
        if self.plane.is_landed or self._place is None:
            wing.roll_out()
            return
        radius = self.radius or self.plane.parameters["WP_LOITER_RAD"]
        wing.circle(*self._place, radius=radius, airspeed=self.airspeed)


class Rtl(NavigatingMode):
    """Home at RTL_ALTITUDE, or to a rally point, to circle there with RTL_RADIUS."""

    number: int = PlaneMode.RTL
    name = "RTL"
    can_arm = False

    def enter(self, *, force: bool) -> bool:
        """To home, at RTL_ALTITUDE above it (below 0 at the present height), or to a rally point at its height."""
        super().enter(force=force)
        plane = self.plane
        home = plane.navigation.home or (0.0, 0.0, plane.wing.ground_down)
        height = plane.parameters["RTL_ALTITUDE"]
        self.radius: float = plane.parameters["RTL_RADIUS"]
        down = plane.wing.down if height < 0 else home[2] - height
        self._place = best_return_place(plane, (home[0], home[1], down))
        return True


class TakeOff(NavigatingMode):
    """Takes off when it is armed, climbs to TKOFF_ALT and circles TKOFF_DIST ahead."""

    number: int = PlaneMode.TAKEOFF
    name = "TAKEOFF"

    def enter(self, *, force: bool) -> bool:
        super().enter(force=force)
        self._place = None
        self._climbs = False
        return True

    @property
    def is_taking_off(self) -> bool:  # type: ignore[override]
        return self._climbs

    def update(self, dt: float) -> None:
        plane, wing = self.plane, self.plane.wing
        if self._place is None:
            self._begin()
        assert self._place is not None
        if self._climbs:
            climb_out(plane)
            self._climbs = wing.down > self._place[2] + _TAKE_OFF_DONE_M
        else:
            super().update(dt)

    def _begin(self) -> None:
        plane, wing = self.plane, self.plane.wing
        home = plane.navigation.home
        ground = wing.ground_down if home is None else home[2]
        height, distance = plane.parameters["TKOFF_ALT"], plane.parameters["TKOFF_DIST"]
        along = (distance * math.cos(wing.yaw), distance * math.sin(wing.yaw))
        self._place = (wing.north + along[0], wing.east + along[1], ground - height)
        self._climbs = wing.down > self._place[2] + _TAKE_OFF_DONE_M
        if plane.is_landed:
            heading = math.degrees(wing.yaw) % 360.0
            plane.info(f"Takeoff to {height:.0f}m for {distance:.1f}m heading {heading:.1f} deg")
        else:
            plane.info(
                "Climbing to TKOFF alt then loitering" if self._climbs else "Above TKOFF alt - loitering"
            )


class Autoland(NavigatingMode):
    """Lands where it has taken off and in that direction; only in flight. Armed after that, it disarms at once."""

    number: int = PlaneMode.AUTOLAND
    name = "AUTOLAND"
    is_landing = True

    def enter(self, *, force: bool) -> bool:
        plane = self.plane
        if plane.mode is self and plane.is_landed:  # armed again where it has landed
            return True
        if plane.is_landed:
            plane.send_text(MavSeverity.WARNING, "Must already be flying!")
            return False
        if plane.take_off_yaw is None:
            plane.send_text(MavSeverity.WARNING, "Takeoff initial direction not set")
            return False
        home = plane.navigation.home or (0.0, 0.0, plane.wing.ground_down)
        far, height = plane.parameters["AUTOLAND_WP_DIST"], plane.parameters["AUTOLAND_WP_ALT"]
        north, east = math.cos(plane.take_off_yaw), math.sin(plane.take_off_yaw)
        start = (home[0] - far * north, home[1] - far * east, home[2] - height)
        self._place, self._landing = home, Landing(plane, home, start)
        return True

    def update(self, dt: float) -> None:
        self._landing.update(dt)


def climb_out(plane: PlaneHost) -> None:
    """Full throttle straight on, and up as soon as it is fast enough."""
    wing = plane.wing
    plane.lift_off()
    if wing.is_on_ground:
        wing.bank_and_climb(plane.cruise_m_s, 0.0, wing.wing.climb_m_s)
    else:
        yaw = wing.yaw if plane.take_off_yaw is None else plane.take_off_yaw
        wing.head(yaw, plane.cruise_m_s, wing.wing.climb_m_s)


class Autotune(Piloted):
    """As FBWA; nothing is tuned."""

    number: int = PlaneMode.AUTOTUNE
    name = "AUTOTUNE"

    def enter(self, *, force: bool) -> bool:
        self.plane.info("Started autotune")
        self.plane.info("Autotuning roll pitch yaw")
        return True


class Refusing(PlaneModeBase):
    can_arm = False

    def enter(self, *, force: bool) -> bool:
        return False
