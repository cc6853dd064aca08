"""Observed behaviour of DroneKit 2.9.2, row by row; unchanged rows are scenarios.

If ``AEROKIT_DRONEKIT_PYTHON`` names an interpreter with DroneKit, the scenarios run with DroneKit as well, which
verifies the expected results.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from dronekit_scenarios import SCENARIOS, Scenario
from dronekit_scenarios_orders import HOME, places
from dronekit_stage import Stage, as_json, caught, on_stage, play, until
from flight_controller import FlightController

import aerokit.dronekit as dronekit

DRONEKIT_PYTHON = os.environ.get("AEROKIT_DRONEKIT_PYTHON", "")
QUICK = [scenario for scenario in SCENARIOS if not scenario.is_slow]
SLOW = [scenario for scenario in SCENARIOS if scenario.is_slow]


@pytest.fixture
def copter() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}) as stage:
        yield stage


@pytest.fixture(scope="module", autouse=True)
def waiting(request: pytest.FixtureRequest) -> Iterator[dict[str, Future[Any]]]:
    """Run slow scenarios in the background while other tests run; each collects its own log records."""
    slow: dict[str, Callable[[], Any]] = {
        f"test_slow_scenario[{scenario.name}]": partial(play, dronekit, scenario) for scenario in SLOW
    }
    slow["test_row_40_silence"] = silence
    with contextlib.ExitStack() as stack:
        for name in ("dronekit", "autopilot"):
            logger = logging.getLogger(name)
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.DEBUG)
        pool = stack.enter_context(ThreadPoolExecutor(len(slow)))
        chosen = {item.name for item in request.session.items}
        yield {name: pool.submit(function) for name, function in slow.items() if name in chosen}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.name)
def test_scenario(case: Scenario, version: int) -> None:
    if case.controller.get("version", version) != version:
        pytest.skip("the message is of the other version")
    assert as_json(play(dronekit, case, version=version)) == as_json(case.expected)


@pytest.mark.skipif(not DRONEKIT_PYTHON, reason="AEROKIT_DRONEKIT_PYTHON names no interpreter with DroneKit")
def test_dronekit_itself_matches_reference() -> None:
    here = Path(__file__).parent
    program = [DRONEKIT_PYTHON, str(here / "real_dronekit.py")]
    output = subprocess.run(program, capture_output=True, text=True, timeout=300, check=True).stdout
    observed = json.loads(output.splitlines()[-1])
    expected = {scenario.name: as_json(scenario.expected) for scenario in SCENARIOS if scenario.is_kept}
    assert observed == expected


# ------------------------------------------------------------------ rows with a different result


@pytest.mark.parametrize("version", [1, 2])
def test_row_03_messages_target_the_vehicle(version: int) -> None:
    """Messages are not broadcast to other vehicles on the link."""
    with on_stage(dronekit, {"version": version, "mode": 4}, prepare=_use_system_7) as stage:
        vehicle, factory = stage.vehicle, stage.vehicle.message_factory
        place = dronekit.LocationGlobalRelative(-35.1, 149.2, 20)
        vehicle.mode = "LOITER"
        vehicle.armed = True
        vehicle.simple_takeoff(10)
        vehicle.simple_goto(place, airspeed=5, groundspeed=6)
        vehicle.home_location = dronekit.LocationGlobal(-35.1, 149.2, 600)
        vehicle.channels.overrides = {"3": 1500}
        vehicle.gimbal.rotate(-90, 0, 0)
        vehicle.gimbal.target_location(place)
        vehicle.send_calibrate_gyro()
        vehicle.reboot()
        vehicle.parameters["FOO"] = 2
        vehicle.send_mavlink(factory.command_long_encode(0, 0, 31010, 0, 1, 2, 3, 4, 5, 6, 7))
        commands = vehicle.commands
        commands.download()
        commands.wait_ready()
        commands.add(dronekit.Command(0, 0, 0, 3, 16, 0, 0, 0, 0, 0, 0, -35.1, 149.2, 10))
        commands.upload()
        commands.next = 1
        stage.reached()
        sent = stage.fc.received()
        assert {frame.target[0] for frame in sent} <= {7, -1}
        assert {frame.version for frame in sent[-20:]} == {version}
        orders = {frame.command: frame.target[1] for frame in stage.fc.commands()}
        assert set(orders) >= {176, 400, 22, 178, 241, 246, 31010}
        assert {orders[number] for number in (176, 400, 22, 178, 241, 246, 31010)} == {0}


def _use_system_7(fc: FlightController) -> None:
    fc.source = (7, 1)
    fc.missions.items = [HOME]
    fc.capabilities &= ~(8192 if fc.version == 1 else 0)


def test_row_05_unknown_mode_of_px4() -> None:
    with on_stage(dronekit, {"autopilot": 12, "mode": 3 << 16}) as stage:
        assert caught(stage.assign("mode", "NOPE")) == "KeyError: 'NOPE'"
        assert stage.commands_of(lambda: caught(stage.assign("mode", "GUIDED_NOGPS"))) == []


def test_row_08_rejected_arming_raises_at_once_with_reason(copter: Stage) -> None:
    copter.fc.results[400] = 4
    copter.fc.reasons[400] = "PreArm: Compass not healthy"
    with pytest.raises(dronekit.TimeoutError, match=r"(?s)failed to arm vehicle.*Compass not healthy") as refusal:
        copter.vehicle.arm(timeout=300)
    assert isinstance(refusal.value, TimeoutError)
    assert isinstance(refusal.value, dronekit.APIException)


def test_row_09_rejected_mode_raises_at_once(copter: Stage) -> None:
    copter.fc.results[176] = 4
    with pytest.raises(dronekit.TimeoutError, match="failed to set flight mode"):
        copter.vehicle.wait_for_mode("AUTO", timeout=300)


def test_row_11_goto_positions_are_exact(copter: Stage) -> None:
    place = dronekit.LocationGlobalRelative(-35.3632611, 149.1652301, 20)
    (goto,) = copter.sent_by(lambda: copter.vehicle.simple_goto(place), "COMMAND_INT")
    assert (goto.command, goto.x, goto.y, goto.z) == (192, -353632611, 1491652301, 20)


def test_row_11_goto_without_reposition_support(copter: Stage) -> None:
    copter.fc.results[192] = 3
    place = dronekit.LocationGlobalRelative(-35.1, 149.2, 20)
    copter.vehicle.simple_goto(place)
    target = copter.fc.wait_for("SET_POSITION_TARGET_GLOBAL_INT")
    assert (target.coordinate_frame, target.lat_int, target.lon_int) == (6, -351000000, 1492000000)
    assert target.type_mask & 0b111111111000 == 0b110111111000  # place only


def test_row_12_unknown_home_is_requested(copter: Stage) -> None:
    assert places(copter, dronekit.LocationGlobal(-35.1, 149.2, 600)) == [("goto", -35.1, 149.2, 16.0)]
    assert str(copter.vehicle.home_location) == "LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0"


def test_row_14_home_is_exact_and_invalid_home_rejected(copter: Stage) -> None:
    place = dronekit.LocationGlobal(-35.3632611, 149.1652301, 600)
    (home,) = copter.sent_by(copter.assign("home_location", place), "COMMAND_INT")
    assert (home.command, home.param1, home.x, home.y, home.z) == (179, 0, -353632611, 1491652301, 600)
    before = str(copter.vehicle.home_location)
    wrong = copter.assign("home_location", dronekit.LocationGlobal(1, 2))
    assert copter.commands_of(lambda: caught(wrong)) == []
    assert str(copter.vehicle.home_location) == before


def test_row_17_location_without_fix_is_none(copter: Stage) -> None:
    copter.report("GLOBAL_POSITION_INT", lat=0, lon=0, alt=0, relative_alt=0)
    frame = copter.vehicle.location.global_relative_frame
    assert (frame.lat, frame.lon) == (None, None)


def test_row_28_channels_of_mavlink_2(copter: Stage) -> None:
    channels, events = copter.vehicle.channels, copter.listen("channels")
    pulses = {f"chan{number}_raw": 1000 + number for number in range(1, 19)}
    copter.report("RC_CHANNELS", chancount=16, **pulses)
    assert dict(channels) == {str(number): 1000 + number for number in range(1, 9)}
    assert (len(channels), channels.count, channels[8]) == (8, 8, 1008)
    assert len(events) == 1


def test_row_28_channel_count_can_be_increased(copter: Stage) -> None:
    channels = copter.vehicle.channels
    channels.count = 16
    copter.report("RC_CHANNELS", chancount=16, **{f"chan{number}_raw": 1000 + number for number in range(1, 19)})
    assert (len(channels), channels[9], channels["16"]) == (16, 1009, 1016)


def test_row_30_wrong_key_changes_nothing(copter: Stage) -> None:
    overrides = copter.vehicle.channels.overrides
    caught(lambda: overrides.__setitem__("9", 1))
    caught(lambda: setattr(copter.vehicle.channels, "overrides", {"9": 900}))
    sent = copter.sent_by(lambda: copter.vehicle.channels.overrides.__setitem__("1", 1234), "RC_CHANNELS_OVERRIDE")
    assert [(frame.chan1_raw, frame.chan2_raw) for frame in sent] == [(1234, 0)]


def test_row_33_parameters_have_their_own_type() -> None:
    def prepare(fc: FlightController) -> None:
        fc.parameters.types = {"FOO": 6, "BAR": 9}
        fc.parameters.adjust = lambda name, value: float(int(value)) if name == "FOO" else value

    with on_stage(dronekit, prepare=prepare) as stage:
        parameters = stage.vehicle.parameters
        parameters.wait_ready()
        assert parameters.set("FOO", 2.7)
        assert parameters.set("BAR", 2.75)
        sent = {(frame.param_id, frame.param_type, frame.param_value) for frame in stage.fc.received("PARAM_SET")}
        assert sent == {("FOO", 6, 2.0), ("BAR", 9, 2.75)}
        assert (parameters["FOO"], parameters["BAR"]) == (2.0, 2.75)


def test_row_33_integers_of_px4() -> None:
    def prepare(fc: FlightController) -> None:
        fc.capabilities |= 1 << 4  # parameters byte by byte
        fc.parameters.is_bytewise = True
        fc.parameters.values = {"SYS_AUTOSTART": 4001, "MPC_XY_CRUISE": 5.0}
        fc.parameters.types = {"SYS_AUTOSTART": 6}

    with on_stage(dronekit, {"autopilot": 12, "mode": 3 << 16}, prepare=prepare) as stage:
        parameters = stage.vehicle.parameters
        assert (parameters["SYS_AUTOSTART"], parameters["MPC_XY_CRUISE"]) == (4001.0, 5.0)
        assert parameters.set("SYS_AUTOSTART", 4010)
        assert (parameters["SYS_AUTOSTART"], stage.fc.parameters.values["SYS_AUTOSTART"]) == (4010.0, 4010)


# ------------------------------------------------------------------------- slow scenarios


def silence() -> dict[str, Any]:
    """Row 40: no messages for more than five seconds, then again."""
    with (
        on_stage(dronekit, {"mode": 4}, {"heartbeat_timeout": 6}) as stage,
        stage.logged(having="ink") as lines,
    ):
        vehicle = stage.vehicle
        ages: list[float] = []
        vehicle.add_attribute_listener("last_heartbeat", lambda _, name, age: ages.append(age))
        stage.fc.heartbeat_s = None
        until(lambda: (vehicle.last_heartbeat or 0) > 6.2)
        orders: tuple[Any, ...] = (
            stage.assign("mode", "LOITER"),
            stage.assign("armed", True),
            lambda: vehicle.simple_takeoff(10),
            lambda: vehicle.wait_for_armable(timeout=100),
            lambda: vehicle.parameters.set("FOO", 3),
            vehicle.reboot,
        )
        raised = [caught(order).split(":")[0] for order in orders]
        stage.fc.heartbeat_s = 0.05
        until(lambda: any("restored" in line for line in lines))
        stage.commands_of(stage.assign("mode", "LOITER"))
        stage.settle()
        return {"notified": lines, "raised": raised, "oldest": max(ages) > 5.5, "mode": vehicle.mode.name}


def test_row_40_silence(waiting: dict[str, Future[Any]]) -> None:
    assert waiting["test_row_40_silence"].result(timeout=60) == {
        "notified": ["WARNING Link timeout, no heartbeat in last 5 seconds", "INFO ...link restored."],
        "raised": ["APIException"] * 6,
        "oldest": True,
        "mode": "LOITER",
    }


@pytest.mark.parametrize("case", SLOW, ids=lambda case: case.name)
def test_slow_scenario(case: Scenario, waiting: dict[str, Future[Any]]) -> None:
    assert as_json(waiting[f"test_slow_scenario[{case.name}]"].result(timeout=60)) == as_json(case.expected)
