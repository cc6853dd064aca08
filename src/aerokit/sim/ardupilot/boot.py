"""When a booting ArduPilot says and knows what, in seconds after power on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

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
