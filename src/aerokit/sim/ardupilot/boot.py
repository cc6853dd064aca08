"""When a booting ArduPilot says and knows what, in seconds after power on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from aerokit.mavlink.enums import MavSeverity
from aerokit.sim.ardupilot.parameter_tables import Kind


@dataclass(frozen=True)
class BootTimeline:
    """The defaults are what ArduCopter 4.7-dev was seen to need in simulation; ``scaled`` squeezes them."""

    heartbeat: float = 0.92
    ready: float = 2.36
    """Initialised: streams start, missions are taken, the state leaves BOOT half a second later."""
    estimator_active: float = 4.36
    tilt_aligned: float = 5.70
    yaw_aligned: float = 5.80
    gps_detected: float = 9.73
    gps_fix: float = 9.94
    origin_set: float = 19.93
    healthy: float = 22.40
    """The attitude reference counts as healthy; a second later the vehicle can be armed without GPS modes."""
    position_good: float = 41.55
    """The estimator uses GPS: modes that need a position work from here."""
    factor: float = 1.0
    """How much faster or slower than the real one it is."""
    estimator_leads_early: bool = True
    """Whether the estimator is the reference from its start, and not only when it uses GPS."""

    def scaled(self, seconds: float) -> BootTimeline:
        """The same boot, over after ``seconds``; 0 is ready at once."""
        factor = seconds / self.position_good
        times = {
            field.name: getattr(self, field.name) * factor for field in fields(self) if field.type == "float"
        }
        return replace(self, **times)


BOOT_TIMELINES: dict[Kind, BootTimeline] = {
    "copter": BootTimeline(),
    "plane": BootTimeline(
        ready=2.04,
        estimator_active=9.94,
        tilt_aligned=12.08,
        yaw_aligned=12.12,
        gps_detected=8.74,
        gps_fix=8.94,
        origin_set=19.12,
        healthy=21.40,
        position_good=20.15,
        estimator_leads_early=False,
    ),
    "rover": BootTimeline(
        ready=3.05,
        estimator_active=4.00,
        tilt_aligned=5.05,
        yaw_aligned=5.90,
        gps_detected=9.05,
        gps_fix=9.90,
        origin_set=19.05,
        healthy=22.90,
        position_good=42.05,
        estimator_leads_early=False,
    ),
    "sub": BootTimeline(
        ready=1.80,
        estimator_active=3.70,
        tilt_aligned=5.30,
        yaw_aligned=5.33,
        gps_detected=9.00,
        gps_fix=9.10,
        origin_set=19.20,
        healthy=21.80,
        position_good=41.00,
    ),
}
"""What each kind was seen to need, with the parameters that its simulation starts with."""

_INFO, _DEBUG = MavSeverity.INFO, MavSeverity.DEBUG
_BAROMETERS = tuple((1.83, _INFO, f"Barometer {number} calibration complete") for number in (1, 2))
_STICKS = "RCInput: decoding UDP (Pulses)"


def _both(seconds: float, text: str) -> tuple[tuple[float, int, str], ...]:
    return tuple((seconds, _INFO, f"EKF2 IMU{core} {text}") for core in (0, 1))


BOOT_TEXTS: dict[Kind, tuple[tuple[float, int, str], ...]] = {
    "copter": (
        (0.10, _DEBUG, _STICKS),
        (0.12, _INFO, "Calibrating barometer"),
        *_BAROMETERS,
        (2.37, _INFO, "RC7: SaveWaypoint LOW"),
    ),
    "plane": (
        (0.10, _INFO, "Ground start"),
        (0.10, MavSeverity.ALERT, "Skipping INS calibration"),
        (0.12, _INFO, "Calibrating barometer"),
        (0.92, _DEBUG, _STICKS),
        *_BAROMETERS,
        (1.84, _INFO, "Airspeed 1 calibration started"),
        (2.05, MavSeverity.WARNING, "Throttle failsafe off"),
        (3.40, _INFO, "Airspeed 1 calibrated"),
        *_both(9.19, "MAG0 initial yaw alignment complete"),
        *_both(14.43, "tilt alignment complete"),
        *_both(19.11, "origin set"),
        *_both(45.18, "is using GPS"),
    ),
    "rover": (
        (0.12, _INFO, "Calibrating barometer"),
        *_BAROMETERS,
        (1.84, _INFO, "Beginning INS calibration. Do not move vehicle"),
        (1.84, _DEBUG, "INS: alloc 6144 bytes for ISB (free=524288)"),
        (3.06, _DEBUG, _STICKS),
    ),
    "sub": (
        (0.12, _INFO, "Calibrating barometer"),
        *((1.50, severity, text) for _, severity, text in _BAROMETERS),
        (1.81, _DEBUG, _STICKS),
    ),
}
"""Second, severity, text: what is said beside that which comes with an event of the timeline."""
