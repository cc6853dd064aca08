"""ArduPlane's rarer flight modes: simple stand-ins, and those that refuse as they do without what they need."""

from __future__ import annotations

from typing import ClassVar

from aerokit.mavlink.enums import PlaneMode
from aerokit.sim.ardupilot.plane.modes import FlyByWireA, Loiter, PlaneModeBase, Stabilize


class Training(Stabilize):
    """Limits bank and pitch only; here as STABILIZE."""

    number: ClassVar[int] = PlaneMode.TRAINING
    name = "TRAINING"


class Acro(Stabilize):
    """Turn rates by stick; here as STABILIZE."""

    number: ClassVar[int] = PlaneMode.ACRO
    name = "ACRO"


class Autotune(FlyByWireA):
    """As FBWA; nothing is tuned."""

    number: ClassVar[int] = PlaneMode.AUTOTUNE
    name = "AUTOTUNE"

    def enter(self, *, force: bool) -> bool:
        self.plane.info("Started autotune")
        self.plane.info("Autotuning roll pitch yaw")
        return True


class AvoidAdsb(Loiter):
    """Circles: there is no traffic to avoid."""

    number: ClassVar[int] = PlaneMode.AVOID_ADSB
    name = "AVOID_ADSB"


class _Refusing(PlaneModeBase):
    can_arm = False

    def enter(self, *, force: bool) -> bool:
        return False


class Initialising(_Refusing):
    """What it is in while it boots; nobody can ask for it."""

    number: ClassVar[int] = PlaneMode.INITIALIZING
    name = "INITIALISING"


class Thermal(_Refusing):
    """Needs SOAR_ENABLE; soaring is not simulated."""

    number: ClassVar[int] = PlaneMode.THERMAL
    name = "THERMAL"
