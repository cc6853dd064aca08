"""Data of the four ArduPilot firmwares: parameter tables and boot timelines."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from aerokit.sim.parameters import SimParameters

Kind = Literal["copter", "plane", "rover", "sub"]
"""Name of a firmware."""

KINDS: tuple[Kind, ...] = ("copter", "plane", "rover", "sub")


def parameters_of(kind: Kind, count: int | None = None) -> SimParameters:
    """Return the parameters of a firmware. ``count`` limits how many are listed."""
    return SimParameters(_read(f"{kind}.param.csv"), count)


def rows_of(kind: Kind, file: str) -> Iterator[list[str]]:
    """Yield the rows for ``kind``, without their last column, which names the kinds."""
    for line in _read(file).splitlines():
        *row, kinds = line.split(",")
        if kinds == "all" or kind in kinds.split():
            yield row


@functools.cache
def _read(file: str) -> str:
    return Path(__file__).with_name(file).read_text("utf-8")


@dataclass(frozen=True)
class BootTimeline:
    """Seconds from power-on to the events of the boot. The defaults are measured on ArduCopter 4.7-dev in SITL."""

    heartbeat: float = 0.92
    ready: float = 2.36
    """The vehicle is initialised: streams start and missions are accepted. MAV_STATE_BOOT ends about 0.5 s later."""
    estimator_active: float = 4.36
    tilt_aligned: float = 5.70
    yaw_aligned: float = 5.80
    gps_detected: float = 9.73
    gps_fix: float = 9.94
    origin_set: float = 19.93
    healthy: float = 22.40
    """The attitude estimate is healthy. About a second after this time, modes without GPS can be armed."""
    position_good: float = 41.55
    """The estimator uses GPS, so that modes that need a position become available."""
    uses_dcm_until_gps: bool = False
    """True if DCM provides the attitude until the estimator uses GPS; False if only until the estimator is active."""

    def scaled(self, seconds: float) -> BootTimeline:
        """Return this timeline, scaled so that it ends after ``seconds``. With 0, the vehicle is ready at once."""
        factor = seconds / self.position_good
        times = {field.name: getattr(self, field.name) * factor for field in fields(self) if field.type == "float"}
        return replace(self, **times)


# Times that were measured in SITL with default parameters.
BOOT_TIMELINES: dict[Kind, BootTimeline] = {
    "copter": BootTimeline(),
    "plane": BootTimeline(
        ready=2.04, estimator_active=9.94, tilt_aligned=12.08, yaw_aligned=12.12, gps_detected=8.74, gps_fix=8.94,
        origin_set=19.12, healthy=21.40, position_good=20.15, uses_dcm_until_gps=True,
    ),
    "rover": BootTimeline(
        ready=3.05, estimator_active=4.00, tilt_aligned=5.05, yaw_aligned=5.90, gps_detected=9.05, gps_fix=9.90,
        origin_set=19.05, healthy=22.90, position_good=42.05, uses_dcm_until_gps=True,
    ),
    "sub": BootTimeline(
        ready=1.80, estimator_active=3.70, tilt_aligned=5.30, yaw_aligned=5.33, gps_detected=9.00, gps_fix=9.10,
        origin_set=19.20, healthy=21.80, position_good=41.00,
    ),
}  # fmt: skip
