"""Shared code of the clients: the flight, and the report of its steps. Uses nothing of aerokit.

A client is started as ``python with_….py KIND PORT`` and listens on the UDP port. It prints a line for each completed
step and ends with 0 when all are done.
"""

# ruff: noqa: T201
from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

__all__ = ["STEPS", "Item", "Steps", "mission", "wait_for"]

STEPS = ("connect", "parameters", "upload", "download", "arm", "take off", "fly", "land")
HOMES = {"copter": (-35.3632610, 149.1652299), "px4": (47.397742, 8.545594)}
# Minimum number of parameters.
PARAMETERS = {"copter": 1300, "px4": 850}
ALTITUDE_M = 10.0
GLOBAL, GLOBAL_RELATIVE = 0, 3
WAYPOINT, RETURN, TAKEOFF = 16, 20, 22


class Item(NamedTuple):
    """A mission item in degrees and metres."""

    frame: int
    command: int
    hold_s: float
    latitude: float
    longitude: float
    altitude_m: float


def mission(kind: str) -> list[Item]:
    """Take-off and two waypoints around the start; ArduPilot has home for its first item."""
    latitude, longitude = HOMES[kind]
    items = [
        Item(GLOBAL_RELATIVE, TAKEOFF, 0, latitude, longitude, ALTITUDE_M),
        Item(GLOBAL_RELATIVE, WAYPOINT, 0, latitude + 0.00015, longitude, ALTITUDE_M),
        Item(GLOBAL_RELATIVE, WAYPOINT, 0, latitude + 0.00015, longitude + 0.0002, ALTITUDE_M),
    ]
    return [Item(GLOBAL, WAYPOINT, 0, latitude, longitude, 0.0), *items] if kind == "copter" else items


class Steps:
    """Prints completed steps and their durations."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._left = list(STEPS)

    def done(self, step: str, detail: object = "") -> None:
        """The next step is done; they come in the order of `STEPS`."""
        if self._left.pop(0) != step:
            raise AssertionError(f"{step} came before its time")
        now = time.monotonic()
        print(f"{step}\t{now - self._began:.1f} s\t{detail}", flush=True)
        self._began = now


def wait_for(condition: Callable[[], bool], what: str, timeout: float = 60.0, every: float = 0.05) -> None:
    """Poll until the condition holds; exits the program when it takes too long."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"not within {timeout:.0f} s: {what}")
        time.sleep(every)
