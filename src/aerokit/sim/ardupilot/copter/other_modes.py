"""ArduCopter's rarer flight modes: simple stand-ins, and those that refuse as they do without what they need."""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink.enums import CopterMode, MavSeverity
from aerokit.sim.ardupilot.copter.guided import Guided
from aerokit.sim.ardupilot.copter.modes import AltHold, Loiter, Mode, Stabilize


class Acro(Stabilize):
    """Turn rates by stick; here as STABILIZE."""

    number: ClassVar[int] = CopterMode.ACRO
    name = "ACRO"


class Drift(AltHold):
    """Turns like an aeroplane; here as ALT_HOLD, but it needs a position."""

    number: ClassVar[int] = CopterMode.DRIFT
    name = "DRIFT"
    needs_position = True

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        return False


class ZigZag(Loiter):
    """Flies by stick, as LOITER, until two points are stored; here always."""

    number: ClassVar[int] = CopterMode.ZIGZAG
    name = "ZIGZAG"


class _Holding(Mode):
    """Stays where it is."""

    def update(self, dt: float) -> None:
        self.stay()


class Throw(_Holding):
    """Waits to be thrown, with motors that stand still; thrown it would hold, as it does here in the air."""

    number: ClassVar[int] = CopterMode.THROW
    name = "THROW"
    _told_at = -math.inf

    def update(self, dt: float) -> None:
        """Says so once after each arming."""
        if self._told_at < self.copter.motors.armed_at:
            self._told_at = self.copter.now
            self.copter.info("waiting for throw")
        super().update(dt)


class AvoidAdsb(_Holding):
    """Holds: there is no traffic to avoid."""

    number: ClassVar[int] = CopterMode.AVOID_ADSB
    name = "AVOID_ADSB"
    can_arm = False


class Follow(_Holding):
    """FOLL_ENABLE lets it in; it holds, as the real one does without somebody to follow."""

    number: ClassVar[int] = CopterMode.FOLLOW
    name = "FOLLOW"
    can_arm = False

    def enter(self, *, force: bool) -> bool:
        if self.copter.parameters["FOLL_ENABLE"]:
            return True
        self.copter.send_text(MavSeverity.WARNING, "Set FOLL_ENABLE = 1")
        return False


class GuidedNoGps(Guided):
    """GUIDED for attitudes only."""

    number: ClassVar[int] = CopterMode.GUIDED_NOGPS
    name = "GUIDED_NOGPS"
    needs_position = False


class _Refusing(Mode):
    """What it needs is never there; says what."""

    needs_position = False
    can_arm = False
    TEXT: ClassVar[str] = ""

    def enter(self, *, force: bool) -> bool:
        if self.TEXT:
            self.copter.send_text(MavSeverity.WARNING, self.TEXT)
        return False


class Flip(_Refusing):
    """Needs a flight by stick; flips are not simulated."""

    number: ClassVar[int] = CopterMode.FLIP
    name = "FLIP"


class Autotune(_Refusing):
    """Needs a flight in ALT_HOLD, LOITER or POSHOLD; tuning is not simulated."""

    number: ClassVar[int] = CopterMode.AUTOTUNE
    name = "AUTOTUNE"


class FlowHold(_Refusing):
    """Needs a sensor of optical flow."""

    number: ClassVar[int] = CopterMode.FLOWHOLD
    name = "FLOWHOLD"


class SystemId(_Refusing):
    """Needs SID_AXIS; exciting the controllers is not simulated."""

    number: ClassVar[int] = CopterMode.SYSTEMID
    name = "SYSTEMID"
    TEXT: ClassVar[str] = "No axis selected, SID_AXIS = 0"


class Turtle(_Refusing):
    """Needs motors that turn backwards."""

    number: ClassVar[int] = CopterMode.TURTLE
    name = "TURTLE"


class AutoRtl(_Refusing):
    """AUTO from a DO_LAND_START or DO_RETURN_PATH_START of the mission on; jumping there is not simulated."""

    number: ClassVar[int] = CopterMode.AUTO_RTL
    name = "AUTO RTL"
    TEXT: ClassVar[str] = "Unable to start landing sequence"
    refused_because = "No return path or landing sequence found"
