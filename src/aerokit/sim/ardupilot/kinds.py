"""Data of the four ArduPilot firmwares: parameter tables and boot timelines."""

from __future__ import annotations

import functools
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Literal

from aerokit.sim.parameters import SimParameters

Kind = Literal["copter", "plane", "rover", "sub"]
"""Name of a firmware."""

KINDS: tuple[Kind, ...] = ("copter", "plane", "rover", "sub")


def parameters_of(kind: Kind, count: int | None = None) -> SimParameters:
    """Return all parameters of a firmware, or about ``count`` of them, with all that the simulation reads."""
    used = [name for (name,) in rows_of(kind, "used_parameters.csv")]
    return SimParameters.from_text(_read(f"{kind}.param.csv"), used=used, count=count)


def rows_of(kind: Kind, file: str) -> Iterator[list[str]]:
    """Yield the rows for ``kind`` of a table whose last column names the firmware. The last column is cut off."""
    for line in _read(file).splitlines():
        *row, kinds = line.split(",")
        if kinds == "all" or kind in kinds.split():
            yield row


@functools.cache
def _read(file: str) -> str:
    data = pkgutil.get_data(__name__, file)
    assert data is not None
    return data.decode()


@dataclass(frozen=True)
class BootTimeline:
    """Seconds from power-on to the events of the boot. The defaults are measured on ArduCopter 4.7-dev in SITL."""

    heartbeat: float = 0.92
    ready: float = 2.36
    """The vehicle is initialised: streams start and missions are accepted. 0.5 s later, MAV_STATE_BOOT ends."""
    estimator_active: float = 4.36
    tilt_aligned: float = 5.70
    yaw_aligned: float = 5.80
    gps_detected: float = 9.73
    gps_fix: float = 9.94
    origin_set: float = 19.93
    healthy: float = 22.40
    """The attitude estimate is healthy. A second later, the vehicle can be armed in modes without GPS."""
    position_good: float = 41.55
    """The estimator uses GPS, so that modes that need a position become available."""
    estimator_leads_early: bool = True
    """True if the estimator provides the attitude as soon as it is active; False if it first has to use GPS."""

    def scaled(self, seconds: float) -> BootTimeline:
        """Return this timeline, scaled so that it ends after ``seconds``. With 0, the vehicle is ready at once."""
        factor = seconds / self.position_good
        times = {field.name: getattr(self, field.name) * factor for field in fields(self) if field.type == "float"}
        return replace(self, **times)


# Times that were measured in SITL with default parameters, in the order of the fields of `BootTimeline`.
BOOT_TIMELINES: dict[Kind, BootTimeline] = {
    "copter": BootTimeline(),
    "plane": BootTimeline(0.92, 2.04, 9.94, 12.08, 12.12, 8.74, 8.94, 19.12, 21.40, 20.15, False),
    "rover": BootTimeline(0.92, 3.05, 4.00, 5.05, 5.90, 9.05, 9.90, 19.05, 22.90, 42.05, False),
    "sub": BootTimeline(0.92, 1.80, 3.70, 5.30, 5.33, 9.00, 9.10, 19.20, 21.80, 41.00),
}
