"""Names of parameters, known without a vehicle: for completion, and for what was perhaps meant."""

from __future__ import annotations

from importlib.resources import files

__all__ = ["parameter_names"]

_TABLES = {
    "ArduPilot": tuple(f"sim/ardupilot/{kind}.param.csv" for kind in ("copter", "plane", "rover", "sub")),
    "PX4": ("sim/px4/quadrotor.param.csv", "sim/px4/airplane.param.csv"),
}


def parameter_names(autopilot: str | None = None) -> list[str]:
    """Those that the simulated vehicles of an autopilot have ("ArduPilot", "PX4"; others: of both), sorted."""
    paths = _TABLES.get(autopilot or "") or [path for group in _TABLES.values() for path in group]
    names = set()
    for path in paths:
        lines = files("aerokit").joinpath(path).read_text(encoding="utf-8").splitlines()
        names |= {line.partition(",")[0] for line in lines if line and not line.startswith("#")}
    return sorted(names)
