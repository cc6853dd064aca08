"""Mode changes in recordings: commanded, or the reaction to a failsafe."""

from __future__ import annotations

from pathlib import Path

import pytest

from aerokit import messages as m
from aerokit.logs.flights import FlightLog, failsafes, read_flight
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter

AUTO, LAND = 3, 9
SET_LAND = m.CommandLong(1, 1, MavCmd.DO_SET_MODE, 0, 1, LAND, 0, 0, 0, 0, 0)
START_MISSION = m.CommandLong(1, 1, MavCmd.MISSION_START, 0, 0, 0, 0, 0, 0, 0, 0)


def heartbeat(mode: int) -> Message:
    return m.Heartbeat(2, 3, 0x80 | 0x51, mode, 4, 3)


def recorded(path: Path, command: Message, *, landing_s: float, speed: float = 1.0) -> FlightLog:
    """A copter in AUTO gets a command at 10 s, and changes to LAND just before a text about a failsafe."""
    rows: list[tuple[float, int, Message]] = [
        (0.0, 1, heartbeat(AUTO)),
        (10.0, 255, command),
        (landing_s, 1, heartbeat(LAND)),
        (landing_s + 0.01, 1, m.Statustext(2, "Battery 1 is low 10.44V used 80 mAh")),
        *((float(second), 1, m.Attitude(second * 1000, 0, 0, 0, 0, 0, 0)) for second in range(60)),
    ]
    encoders = {system: FrameEncoder(system, 1) for system in (1, 255)}
    with TlogWriter(path) as writer:
        for time_s, system, message in sorted(rows, key=lambda row: row[0]):
            writer.write(encoders[system].encode(message), 1.7e9 + time_s / speed)
    return read_flight(path)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_failsafe_mode_long_after_command_is_reaction(tmp_path: Path, speed: float) -> None:
    """Twenty seconds of the vehicle are two of a recording at ten times real speed."""
    flight = recorded(tmp_path / "log.tlog", SET_LAND, landing_s=30.0, speed=speed)
    (failsafe,) = failsafes(flight)
    assert failsafe.reaction == "mode AUTO → LAND immediately"


def test_failsafe_mode_after_command_for_other_mode_is_reaction(tmp_path: Path) -> None:
    (failsafe,) = failsafes(recorded(tmp_path / "log.tlog", START_MISSION, landing_s=12.0))
    assert failsafe.reaction == "mode AUTO → LAND immediately"


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_commanded_mode_is_no_reaction(tmp_path: Path, speed: float) -> None:
    flight = recorded(tmp_path / "log.tlog", SET_LAND, landing_s=12.0, speed=speed)
    (failsafe,) = failsafes(flight)
    assert (flight.modes[-1].reason, failsafe.reaction) == ("ordered", "no mode change followed")
