"""What may stand at a place of the command line, for completion: looked up only when somebody presses Tab."""

from __future__ import annotations

import os
from glob import glob
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable

_USUAL = ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14540", "tcp:127.0.0.1:5760")

_DEVICES = ("/dev/serial/by-id/*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/cu.usb*")


def offer(action: argparse.Action, values: Callable[[], Iterable[str]]) -> None:
    """Have argcomplete offer these for an argument; which of them fit what is typed is its business."""
    setattr(action, "completer", lambda **_: list(values()))  # noqa: B010 - argparse does not know it


def addresses() -> list[str]:
    """Of vehicles: what the environment says, the usual ones, and serial ports that are there."""
    own = os.environ.get("AEROKIT_ADDRESS", "").strip()
    return [*([own] if own else []), *_USUAL, *(path for form in _DEVICES for path in sorted(glob(form)))]


def parameters() -> list[str]:
    """Names of parameters."""
    return parameter_names()


def assignments() -> list[str]:
    """The same with the mark behind them."""
    return [f"{name}=" for name in parameters()]


def kinds() -> tuple[str, ...]:
    """Kinds of simulated vehicles."""
    from aerokit.sim.kinds import kind_names

    return kind_names()


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
