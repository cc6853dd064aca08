"""The examples of DroneKit's API reference run."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any

import pytest
from dronekit_reference import EXAMPLES
from dronekit_scenarios_state import POSITION
from dronekit_stage import Stage, on_stage, until
from dronekit_streams import READY, answer_streams
from flight_controller import FlightController

import aerokit.dronekit as dronekit


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}, READY, answer_streams) as opened:
        opened.settle()
        until(lambda: opened.vehicle.home_location)  # requested by the library in the background
        yield opened


def test_connect_bare_address() -> None:
    with FlightController() as fc:
        answer_streams(fc)
        names: dict[str, Any] = {}
        address = fc.address.removeprefix("udpin:")
        exec(
            f"from aerokit.dronekit import connect\nvehicle = connect({address!r}, wait_ready=True)",
            names,
        )
        with names["vehicle"] as vehicle:
            assert vehicle.attitude.pitch == 0.5


PRINTED = {
    "overrides": [" Channel overrides: {'3': 500, '2': 200}", " Ch2 override: 200"],
    "command": ["16"],
    "mission": ["LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0", "1"],
    "gimbal": [],
    "location": [
        "Global Location: LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0",
        "Global Location (relative altitude): LocationGlobalRelative:lat=-35.363261,lon=149.16523,alt=10.0",
        "Local Location: LocationLocal:north=3.0,east=4.0,down=-12.0",
        "Altitude (global frame): 584.0",
        "Altitude (global relative frame): 10.0",
        "Altitude (NED frame): -12.0",
    ],
    "location listeners": [
        " global_frame: LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0",
        " Global: LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0",
        " Global: LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0",
        " GlobalRelative: LocationGlobalRelative:lat=-35.363261,lon=149.16523,alt=10.0",
        " Local: LocationLocal:north=3.0,east=4.0,down=-12.0",
    ],
    "attitude listener": ["attitude attribute is: Attitude:pitch=0.5,yaw=0.0,roll=0.0"],
    "parameters": [
        "Param: 130.0",
        " PARAMETER CALLBACK: THR_MIN changed to: 100.0",
        " PARAMETER CALLBACK: THR_MIN changed to: 100.0",
        " PARAMETER CALLBACK: THR_MIN changed to: 110.0",
    ],
    "logging": [],
    "message listeners": ["HEARTBEAT 4", "decorated HEARTBEAT"],
    "armed": ["Armed: False", "Armed: True"],
    "channels": [
        "Channel values from RC Tx: {'1': 1001, '2': 1002, '3': 1003, '4': 1004, '5': 1005, '6': 1006, "
        "'7': 1007, '8': 1008}",
        " Ch1: 1001",
        " Ch2: 1002",
    ],
    "heartbeat": ["True"],
    "messages": [],
    "modes": ["LOITER"],
    "mode listener": ["Vehicle Mode VehicleMode:AUTO"],
    "goto": [],
    "ready": ["ready"],
}

SENT = {
    "gimbal": ("COMMAND_LONG", lambda frame: frame.command == 205),
    "goto": ("COMMAND_INT", lambda frame: frame.command == 192 and round(frame.z) == 30 - 584),
    "messages": (
        "COMMAND_LONG",
        lambda frame: frame.command == 115 and frame.param1 == 90 and frame.target == (1, 0),
    ),
    "mission": ("MISSION_ITEM_INT", lambda frame: frame.x == -343641140),
    "overrides": ("RC_CHANNELS_OVERRIDE", lambda frame: frame.chan3_raw == 500),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_example(stage: Stage, name: str) -> None:
    lines: list[str] = []
    fc = stage.fc
    fc.heartbeat_s = None
    stage.settle()
    names: dict[str, Any] = {
        "vehicle": stage.vehicle,
        "print": lambda *values: lines.append(" ".join(map(str, values))),
        "settle": stage.settle,
        "fence": stage.reached,
        "beat": stage.beat,
        "move": lambda: stage.report("GLOBAL_POSITION_INT", **POSITION),
        "tilt": lambda: stage.report("ATTITUDE", pitch=0.5),
    }
    exec("from aerokit.dronekit import *", names)
    program = textwrap.dedent(EXAMPLES[name])
    with stage.logged(having="Exception") as logged:
        exec(compile(program, name, "exec"), names)
        stage.settle()
    assert lines == PRINTED[name]
    assert logged == []
    if name in SENT:
        fc.wait_for(*SENT[name])


def test_every_reference_example_is_listed() -> None:
    assert set(EXAMPLES) == set(PRINTED)
