"""Fuzz targets of the simulator: each vehicle type on the ground, in the air, and while it boots."""

from __future__ import annotations

import io
from functools import cache

from recorded import path_of
from simulator_script import play
from target import Target

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavCmd
from aerokit.sim.components import SimulatedCamera, SimulatedGimbal
from aerokit.sim.kinds import kind_names, simulated
from aerokit.sim.vehicle import SimulatedVehicle
from aerokit.testing import RecordedVehicle

__all__ = ["SIMULATOR_TARGETS"]

_MODES = {"copter": 4, "plane": 13, "rover": 15, "sub": 4}
_FORCE = 21196
_FLYING_AFTER_S = 8.0


def _tell(vehicle: SimulatedVehicle, command: int, *params: float) -> None:
    numbers = [*params, *(0.0,) * (7 - len(params))]
    message = m.CommandLong(vehicle.system_id, 1, command, 0, *numbers)
    vehicle.handlers[m.CommandLong.ID](message, vehicle.channels[0])


def take_off(vehicle: SimulatedVehicle, kind: str) -> None:
    """A vehicle in the air, or taking off."""
    if kind in _MODES:
        _tell(vehicle, MavCmd.DO_SET_MODE, 1, _MODES[kind])
    _tell(vehicle, MavCmd.COMPONENT_ARM_DISARM, 1, _FORCE)
    nan = float("nan")
    _tell(vehicle, MavCmd.NAV_TAKEOFF, nan, nan, nan, nan, nan, nan, 20.0 if kind in _MODES else 508.0)
    vehicle.step(vehicle.now + _FLYING_AFTER_S)


def _vehicle(kind: str, choice: int) -> SimulatedVehicle:
    components = [SimulatedCamera(), SimulatedGimbal()] if choice & 4 else []
    if choice & 3 == 3:
        return simulated(kind, components=components)
    vehicle = simulated(kind, boot_time_s=0.0, components=components)
    vehicle.step(3.0)
    if choice & 1:
        take_off(vehicle, kind)
    return vehicle


def _target(kind: str) -> Target:
    def fuzz_one(data: bytes) -> None:
        play(_vehicle(kind, data[0] if data else 0), data[1:])

    return Target(f"simulator_{kind}", fuzz_one)


@cache
def _recording() -> bytes:
    path = path_of("ardupilot-copter.tlog")
    assert path is not None
    return path.read_bytes()[:60_000]


def fuzz_recorded(data: bytes) -> None:
    """The project's own recording of a copter."""
    vehicle = RecordedVehicle(io.BytesIO(_recording()))
    assert STANDARD
    vehicle.step(1.0)
    play(vehicle, data)


SIMULATOR_TARGETS = (*map(_target, kind_names()), Target("simulator_recorded", fuzz_recorded))
