"""Commands with NaN or huge params do not break a vehicle; programs send NaN for params that they leave unset."""

from __future__ import annotations

import math
from typing import Any

import pytest
from component_client import settled

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedGimbal
from aerokit.sim.kinds import simulated

KINDS = ("copter", "plane", "rover", "sub", "px4", "px4_plane")
# The vehicle is silent after this command.
LAST = (MavCmd.PREFLIGHT_REBOOT_SHUTDOWN,)
_ENDS = (*LAST, MavCmd.DO_FLIGHTTERMINATION, MavCmd.COMPONENT_ARM_DISARM)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("number", [math.nan, math.inf, -1e30])
@pytest.mark.parametrize("kind", KINDS)
def test_any_command_with_nan_params_is_answered(kind: str, number: float) -> None:
    devices = (SimulatedCamera(), SimulatedGimbal())
    client = settled(simulated(kind, boot_time_s=0.0, components=devices, parameter_count=100))
    for command in (*(kind for kind in MavCmd if kind not in LAST), *LAST):
        for first in (number, 0.0, 1.0, 2.0):
            client.send(m.CommandLong(0, 0, command, 0, first, *(number,) * 6))
            assert all(math.isfinite(when) for when, *_ in client.vehicle._timers), command
    client.run(3.0)


@pytest.mark.parametrize("kind", KINDS)
def test_nan_arms_or_disarms_nothing(kind: str) -> None:
    client = settled(simulated(kind, boot_time_s=0.0))
    results = client.ask(1, MavCmd.COMPONENT_ARM_DISARM, *(math.nan,) * 7)
    assert MavResult.ACCEPTED not in results


@pytest.mark.sampled(2)
@pytest.mark.parametrize("number", [math.nan, math.inf])
@pytest.mark.parametrize("kind", ["copter", "px4"])
def test_commands_with_nan_params_in_flight_are_answered(kind: str, number: float) -> None:
    """The position stays finite."""
    vehicle: Any = simulated(kind, boot_time_s=0.0, components=(SimulatedCamera(), SimulatedGimbal()))
    client = settled(vehicle)
    if kind == "copter":
        client.ask(1, MavCmd.DO_SET_MODE, 1, CopterMode.GUIDED)
    assert client.ask(1, MavCmd.COMPONENT_ARM_DISARM, 1) == [MavResult.ACCEPTED]
    client.ask(1, MavCmd.NAV_TAKEOFF, *(math.nan,) * 6, 10.0 if kind == "copter" else math.nan)
    client.run(8.0)
    assert vehicle.motion.down < -2.0
    for command in (kind for kind in MavCmd if kind not in _ENDS):
        client.send(m.CommandLong(0, 0, command, 0, *(number,) * 7))
        client.send(m.CommandLong(0, 0, command, 0, 1.0, *(number,) * 6))
        client.run(0.04)
        motion = vehicle.motion
        assert all(map(math.isfinite, (motion.north, motion.east, motion.down, motion.yaw))), command
