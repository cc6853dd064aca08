"""When a booting ArduPilot says and knows what, in seconds after power on."""

from __future__ import annotations

from dataclasses import dataclass, fields

__all__ = ["BootTimeline"]


@dataclass(frozen=True)
class BootTimeline:
    """The defaults are what ArduCopter 4.7-dev was seen to need in simulation; ``scaled`` squeezes them."""

    first_text: float = 0.12
    heartbeat: float = 0.92
    barometers: float = 1.83
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

    @classmethod
    def scaled(cls, seconds: float) -> BootTimeline:
        """The same boot, over after ``seconds``; 0 is ready at once."""
        factor = seconds / cls.position_good
        return cls(**{field.name: getattr(cls, field.name) * factor for field in fields(cls)})
