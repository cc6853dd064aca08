"""The modes of a simulated Rover. FOLLOW, DOCK and INITIALISING are refused; SIMPLE drives as MANUAL does."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import MavSeverity, RoverMode
from aerokit.mavlink.messages import MissionItemReached
from aerokit.sim.ardupilot.level import LevelAuto, Target
from aerokit.sim.ardupilot.mode import VehicleMode, variant
from aerokit.sim.ardupilot.navigation import best_return_place
from aerokit.sim.ardupilot.rover.host import RoverHost
from aerokit.sim.local_frame import Ned

_MIDDLE, _RANGE = 1500.0, 500.0
_FULL_STEERING_RAD_S = math.radians(90.0)


class _Mode(VehicleMode):
    """Every mode has its rover."""

    def __init__(self, rover: RoverHost) -> None:
        self.rover = rover

    def sticks(self) -> tuple[float, float]:
        """Throttle and steering, -1 to 1."""
        throttle, steering = ((self.rover.rc[index] - _MIDDLE) / _RANGE for index in (2, 0))
        return throttle, steering


class _Manual(_Mode):
    number: int = RoverMode.MANUAL
    name = "MANU"
    needs_position = False
    has_manual_throttle = True

    def update(self, dt: float) -> None:
        throttle, steering = self.sticks()
        self.rover.motion.drive(throttle * self.rover.top_speed, steering * _FULL_STEERING_RAD_S)


class _Standing(_Mode):
    """Where it stands it stays; a boat would drive back."""

    def update(self, dt: float) -> None:
        self.rover.motion.stop()


class _Refused(_Mode):
    text: str = ""

    def enter(self, *, force: bool) -> bool:
        if self.text:
            self.rover.send_text(MavSeverity.NOTICE, self.text)
        return False


class _Rtl(_Mode):
    """Straight home or to a rally point with RTL_SPEED, or WP_SPEED; there it stands and stays armed."""

    number: int = RoverMode.RTL
    name = "RTL"
    can_arm = False
    can_change_speed = True

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self.speed = 0.0
        self._way: list[Ned] = []
        """Where it has to go, one after the other."""

    def enter(self, *, force: bool) -> bool:
        rover, home = self.rover, self.rover.navigation.home
        if home is None:
            return False
        self._set_out([best_return_place(rover, home, is_allowed=rover.fence.contains)])
        return True

    def _set_out(self, way: list[Ned]) -> None:
        self._way, self._is_there = way, False
        self.speed = self.rover.parameters["RTL_SPEED"] or self.rover.parameters["WP_SPEED"]

    @property
    def destination(self) -> Ned | None:
        return self._way[0] if self._way else None

    def update(self, dt: float) -> None:
        if not self._way:
            self.rover.motion.stop()
            if not self._is_there:
                self._is_there = True
                self.rover.info("Reached destination")
        elif self._has_reached(self._way[0]):
            del self._way[0]
        else:
            north, east, _ = self._way[0]
            self.rover.motion.drive_to(north, east, speed=self.speed, stops=len(self._way) == 1)

    def _has_reached(self, place: Ned) -> bool:
        motion, on_the_way = self.rover.motion, len(self._way) > 1
        near = (
            math.hypot(place[0] - motion.north, place[1] - motion.east) <= self.rover.parameters["WP_RADIUS"]
        )
        return near if on_the_way else self.rover.has_arrived(place)


class _SmartRtl(_Rtl):
    """Back on the path it has come on, without its loops; refused while there is none. See `SmartPath`."""

    number: int = RoverMode.SMART_RTL
    name = "SRTL"
    returns_on_path = True

    def enter(self, *, force: bool) -> bool:
        if not self.rover.path.is_active:
            return False
        self._set_out(self.rover.path.take_all())
        return True

    def leave(self) -> None:
        self.rover.path.put_back(self._way)


class RoverAuto(LevelAuto):
    """AUTO: see `LevelAuto`."""

    number: int = RoverMode.AUTO
    name = "AUTO"

    vehicle: RoverHost

    def default_speed(self) -> float:
        return self.vehicle.parameters["WP_SPEED"] or self.vehicle.parameters["CRUISE_SPEED"]

    def refuse(self) -> None:
        self.vehicle.send_text(MavSeverity.NOTICE, "No Mission. Can't set AUTO.")

    def travel(self, place: Ned, *, stops: bool) -> None:
        """Drive there; what has been reached is where it stands."""
        if stops and self.has_arrived(place):
            self.vehicle.motion.stop()
        else:
            self.vehicle.motion.drive_to(place[0], place[1], speed=self.speed, stops=stops)

    def has_arrived(self, place: Ned) -> bool:
        """Within WP_RADIUS on the way through, at the place itself when it stops there."""
        motion = self.vehicle.motion
        if self._stops:
            return self.vehicle.has_arrived(place)
        away = math.hypot(place[0] - motion.north, place[1] - motion.east)
        return away <= self.vehicle.parameters["WP_RADIUS"]

    def stay(self) -> None:
        self.vehicle.motion.stop()

    def reached_text(self, index: int, seconds: float) -> str:
        text = f"Reached waypoint #{index}"
        return f"{text}. Loiter for {seconds:.0f} seconds" if seconds > 0 else text

    def finish(self) -> None:
        """MIS_DONE_BEHAVE other than standing is not simulated."""
        self.vehicle.send_text(MavSeverity.NOTICE, "Mission Complete")


class RoverGuided(_Mode):
    """GUIDED: a place to drive to, or a velocity, with or without a turn rate, for three seconds."""

    number: int = RoverMode.GUIDED
    name = "GUID"

    def __init__(self, rover: RoverHost) -> None:
        super().__init__(rover)
        self.speed: float = 0.0
        self._place: Ned | None = None
        self._is_there = False
        self._target: Target | None = None
        self._target_at = 0.0

    @property
    def can_change_speed(self) -> bool:  # type: ignore[override]
        return self._place is not None and not self._is_there

    @property
    def destination(self) -> Ned | None:
        return self._place

    def enter(self, *, force: bool) -> bool:
        self._place = self._target = None
        return True

    def go_to(self, position: Ned) -> None:
        self._place, self._is_there, self._target = position, False, None
        self.speed = self.rover.parameters["WP_SPEED"] or self.rover.parameters["CRUISE_SPEED"]

    def take(self, target: Target) -> None:
        """A position counts more than a velocity beside it."""
        if target.position is not None:
            self.go_to(target.position)
            return
        self._place, self._target, self._target_at = None, target, self.rover.now

    def update(self, dt: float) -> None:
        if self._place is not None:
            self._go(self._place)
        elif self._target is None or self._is_stale():
            self.rover.motion.stop()
        else:
            self._follow(self._target)

    def _go(self, place: Ned) -> None:
        if not self._is_there and self.rover.has_arrived(place):
            self._is_there = True
            self.rover.send(MissionItemReached(0))
        if self._is_there:
            self.rover.motion.stop()
        else:
            self.rover.motion.drive_to(place[0], place[1], speed=self.speed)

    def _is_stale(self) -> bool:
        if self._target is None or self.rover.now - self._target_at <= self._target.patience_s:
            return False
        self._target = None
        self.rover.send_text(MavSeverity.WARNING, "target not received last 3secs, stopping")
        return True

    def _follow(self, target: Target) -> None:
        north, east, _ = target.velocity or (0.0, 0.0, 0.0)
        parameters, motion = self.rover.parameters, self.rover.motion
        fastest = parameters["WP_SPEED"] or parameters["CRUISE_SPEED"]
        speed = min(fastest, math.hypot(north, east)) * (-1.0 if target.backwards else 1.0)
        if target.yaw_rate is not None:
            motion.drive(speed, target.yaw_rate)
        elif speed == 0.0:
            motion.stop()
        else:
            course = math.atan2(east, north) + (math.pi if target.backwards else 0.0)
            motion.head(speed, course if target.yaw is None else target.yaw)


ROVER_MODES: tuple[Callable[[RoverHost], VehicleMode], ...] = (
    _Manual,
    variant(_Manual, RoverMode.ACRO, "ACRO"),
    variant(_Manual, RoverMode.STEERING, "STER", needs_position=True),
    variant(_Standing, RoverMode.HOLD, "HOLD", needs_position=False),
    variant(_Standing, RoverMode.LOITER, "LOIT"),
    variant(_Refused, RoverMode.FOLLOW, "FOLL"),
    variant(_Manual, RoverMode.SIMPLE, "SMPL"),
    variant(_Standing, RoverMode.CIRCLE, "CIRC"),
    RoverAuto,
    _Rtl,
    _SmartRtl,
    RoverGuided,
    variant(_Refused, RoverMode.INITIALIZING, "INIT"),
    variant(_Refused, RoverMode.DOCK, "DOCK", text="Dock: target not acquired"),
)
"""In the order in which AVAILABLE_MODES lists them, with the names that it tells."""
