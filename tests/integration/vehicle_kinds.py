"""Properties of each kind for the tests of any vehicle: abilities, and how to start and stop it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["KINDS", "Kind"]


@dataclass(frozen=True)
class Kind:
    """One firmware; metres and seconds, in its own time."""

    name: str
    """Name in `aerokit.sim.kinds`."""
    parameters: int
    """Minimum number of parameters."""
    parameter: tuple[str, float]
    """One that can be set, and what to."""
    modes: tuple[str, ...]
    """It can be put into these on the ground."""
    firmware: str = ""
    """The name of the binary, its model, and its files of defaults in ArduPilot's Tools/autotest."""
    model: str = ""
    defaults: str = ""
    home: tuple[float, float, float, float] = (47.397742, 8.545594, 488.0, 0.0)
    guided: str | None = "GUIDED"
    """The mode it is armed in; None: it is armed where it is."""
    altitude_m: float = 10.0
    """Altitude of take-off and travel."""
    takes_off: bool = True
    lands: bool = True
    returns: bool = True
    travel_m: float = 15.0
    near_m: float = 5.0
    """It stays within so much of where it was sent."""
    speed_m_s: float = 3.0
    turns: bool = True
    takes_velocities: bool = True
    has_rally: bool = True
    mission_lands: bool = False
    """It takes no mission without a landing."""

    @property
    def is_ardupilot(self) -> bool:
        return not self.name.startswith("px4")


_COPTER = Kind(
    "copter", 1300, ("BATT_CAPACITY", 4200.0), ("STABILIZE", "LOITER", "GUIDED"),
    firmware="arducopter", model="+", defaults="default_params/copter.parm",
)  # fmt: skip
_PLANE = Kind(
    "plane", 1300, ("BATT_CAPACITY", 4200.0), ("MANUAL", "FBWA", "GUIDED"),
    firmware="arduplane", model="plane", defaults="models/plane.parm",
    guided=None, altitude_m=40.0, travel_m=300.0, near_m=130.0, speed_m_s=20.0, turns=False,
    takes_velocities=False,
)  # fmt: skip
_ROVER = Kind(
    "rover", 1150, ("BATT_CAPACITY", 4200.0), ("MANUAL", "HOLD", "GUIDED"),
    firmware="ardurover", model="rover", defaults="default_params/rover.parm",
    altitude_m=0.0, takes_off=False, lands=False, turns=False, speed_m_s=2.0,
)  # fmt: skip
_SUB = Kind(
    "sub", 1300, ("BATT_CAPACITY", 4200.0), ("MANUAL", "ALT_HOLD", "POSHOLD"),
    firmware="ardusub", model="vectored", defaults="default_params/sub.parm",
    home=(33.810313, -118.393867, 0.0, 185.0), altitude_m=-4.0, takes_off=False, returns=False, speed_m_s=1.0,
)  # fmt: skip
_PX4 = Kind(
    "px4", 850, ("MPC_XY_CRUISE", 6.0), ("POSCTL", "LOITER"),
    firmware="px4", model="sihsim_quadx", guided=None,
)  # fmt: skip
_PX4_PLANE = Kind(
    "px4_plane", 900, ("FW_AIRSPD_TRIM", 16.0), ("POSCTL", "LOITER"),
    firmware="px4", model="sihsim_airplane", guided=None,
    altitude_m=60.0, travel_m=400.0, near_m=150.0, speed_m_s=17.0, turns=False, takes_velocities=False,
    mission_lands=True,
)  # fmt: skip

KINDS = {kind.name: kind for kind in (_COPTER, _PLANE, _ROVER, _SUB, _PX4, _PX4_PLANE)}
