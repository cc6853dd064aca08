"""The modes of a simulated ArduSub. MOTOR_DETECT and SURFTRAK hold still, ACRO and STABILIZE move by the sticks."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import SubMode
from aerokit.sim.ardupilot.level import LevelAuto, Target
from aerokit.sim.ardupilot.mode import VehicleMode, variant
from aerokit.sim.ardupilot.sub.host import SubHost
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import wrap_pi
from aerokit.sim.setpoints import rotated

_MIDDLE, _RANGE, _DEADZONE = 1500.0, 500.0, 0.06
_FULL_STICK_M_S = 1.0
_FULL_STICK_TURN_RAD_S = math.radians(90.0)
_THROTTLE, _YAW, _FORWARD, _LATERAL = 2, 3, 4, 5


class _Mode(VehicleMode):
    """Every mode has its submarine."""

    def __init__(self, sub: SubHost) -> None:
        self.sub = sub

    def stick(self, index: int) -> float:
        """-1 to 1; 0 around the middle."""
        share = (self.sub.rc[index] - _MIDDLE) / _RANGE
        return 0.0 if abs(share) < _DEADZONE else share

    def sideways(self) -> tuple[float, float]:
        """Wanted velocity north and east, and the turn, by the sticks."""
        motion = self.sub.motion
        motion.turn(self.stick(_YAW) * _FULL_STICK_TURN_RAD_S)
        forward, right = self.stick(_FORWARD) * _FULL_STICK_M_S, self.stick(_LATERAL) * _FULL_STICK_M_S
        north, east, _ = rotated((forward, right, 0.0), motion.yaw)
        return north, east


class _Manual(_Mode):
    """Thrusters by the sticks; with the throttle in the middle it drifts up."""

    number: int = SubMode.MANUAL
    name = "MANUAL"
    needs_position = False
    has_manual_throttle = True

    def update(self, dt: float) -> None:
        climb = self.stick(_THROTTLE) * self.sub.climb_speed
        if climb == 0.0:
            self.sub.motion.push(*self.sideways())
        else:
            self.sub.motion.seek_velocity(*self.sideways(), -climb)


class _AltHold(_Mode):
    """Depth held; the throttle stick changes it."""

    number: int = SubMode.ALT_HOLD
    name = "ALT_HOLD"
    needs_position = False

    def update(self, dt: float) -> None:
        self.sub.motion.seek_velocity(*self.sideways(), -self.stick(_THROTTLE) * self.sub.climb_speed)


class _Surftrak(_AltHold):
    """Without a range finder it holds the depth."""

    number: int = SubMode.SURFTRAK
    name = "SURFTRAK"

    def enter(self, *, force: bool) -> bool:
        self.sub.info("waiting for a rangefinder reading")
        return True


class _Surface(_AltHold):
    """Up with WPNAV_SPEED_UP; at the surface it goes into ALT_HOLD."""

    number: int = SubMode.SURFACE
    name = "SURFACE"
    is_landing = True

    def update(self, dt: float) -> None:
        if self.sub.is_at_surface:
            self.sub.set_mode(SubMode.ALT_HOLD)
        else:
            self.sub.motion.seek_velocity(*self.sideways(), -self.sub.parameters["WPNAV_SPEED_UP"] / 100.0)


class SubAuto(LevelAuto):
    """AUTO: see `LevelAuto`. After the last command it stays."""

    number: int = SubMode.AUTO
    name = "AUTO"

    vehicle: SubHost

    def default_speed(self) -> float:
        return self.vehicle.parameters["WPNAV_SPEED"] / 100.0

    def travel(self, place: Ned, *, stops: bool) -> None:
        """Straight there, depth and all; it looks where it goes."""
        self.vehicle.travel(place, self.speed)

    def has_arrived(self, place: Ned) -> bool:
        return self.vehicle.distance(place) <= self.vehicle.parameters["WPNAV_RADIUS"] / 100.0

    def stay(self) -> None:
        self.vehicle.motion.seek_velocity(0.0, 0.0, 0.0)

    def reached_text(self, index: int, seconds: float) -> str:
        return f"Reached command #{index}"


class SubGuided(_Mode):
    """GUIDED: a place that stays, or a velocity for three seconds; first it keeps still."""

    number: int = SubMode.GUIDED
    name = "GUIDED"
    can_change_speed = True

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        self.speed: float = 0.0
        self._place: Ned | None = None
        self._target: Target | None = None
        self._target_at = 0.0
        self._heading: float | None = None

    @property
    def destination(self) -> Ned | None:
        return self._place

    def enter(self, *, force: bool) -> bool:
        self._place = self._target = self._heading = None
        self.speed = self.sub.parameters["WPNAV_SPEED"] / 100.0
        return True

    def go_to(self, position: Ned) -> None:
        """Go there and stay; above the surface means at the surface."""
        self._place, self._target, self._heading = position, None, None

    def take(self, target: Target) -> None:
        """A position counts more than a velocity beside it. Its path begins anew, from standing, as seen."""
        if target.position is not None:
            motion = self.sub.motion
            motion.velocity_north = motion.velocity_east = motion.velocity_down = 0.0
            self.go_to(target.position)
        else:
            self._place, self._target, self._target_at = None, target, self.sub.now
        self._heading = target.yaw

    def face(self, heading: float) -> None:
        """Turn to a heading in radians."""
        self._heading = wrap_pi(heading)

    def update(self, dt: float) -> None:
        motion, target = self.sub.motion, self._target
        fresh = target is not None and self.sub.now - self._target_at <= target.patience_s
        if self._place is not None:
            self.sub.travel(self._place, self.speed, looks_ahead=False)
        elif target is not None and target.velocity is not None and fresh:
            motion.seek_velocity(*target.velocity)
        else:
            motion.seek_velocity(0.0, 0.0, 0.0)
        if self._heading is not None:
            motion.face(self._heading)
        else:
            motion.turn(target.yaw_rate or 0.0 if target is not None and fresh else 0.0)


SUB_MODES: tuple[Callable[[SubHost], VehicleMode], ...] = (
    _Manual,
    variant(_Manual, SubMode.STABILIZE, "STABILIZE"),
    variant(_Manual, SubMode.ACRO, "ACRO"),
    _AltHold,
    SubAuto,
    SubGuided,
    variant(_AltHold, SubMode.CIRCLE, "CIRCLE", needs_position=True),
    _Surface,
    variant(_AltHold, SubMode.POSHOLD, "POSHOLD", needs_position=True),
    variant(_AltHold, SubMode.MOTORDETECT, "MOTORDETECT"),
    _Surftrak,
)
"""All eleven."""
