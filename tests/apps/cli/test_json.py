"""``--json``: the records of all commands have the fields that docs/command-line.md lists."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import pytest
from cli_harness import DOCUMENT, HOME, MISSION, documented, records, run_with

from aerokit.apps.cli import main
from aerokit.apps.cli.main import COMMANDS, make_parser
from aerokit.apps.cli.output import exit_codes_help
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal

PRINTED = {
    "params": "comparison error parameter parameter_difference parameter_write saved",
    "mission": "error note plan_item plan_part saved warning",
    "files and logs": "crc declined done fetched fetched_log file log sent",
    "camera and gimbal": "camera card declined done fetched_picture gimbal gimbal_attitude picture stream",
    "calibration": "calibration_result calibration_step",
    "link": "component event finding link recorded recording status",
    "fly": "flight flight_summary flown plan_item plan_part simulated",
    "demo": "connecting flight flight_summary simulated",
    "sim": "fault saved simulated stopped",
}
"""Types of records that each test of this file sees."""
TESTED_ELSEWHERE = {
    "conversion",
    "report",
    "serving",
    "bridging",
    "publishing",
    "bridged_vehicle",
    "hub",
    "hub_event",
    "endpoint",
}
"""Records of commands that need an extra, a browser or a viewer."""
RARE = {"missed", "gimbal_silent", "interrupted", "calibration_cancelled"}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def copter() -> SimulatedCopter:
    return SimulatedCopter(
        boot_time_s=0.0,
        home=HOME,
        components=[SimulatedCamera(streams=["rtsp://127.0.0.1:8554/main"]), SimulatedGimbal()],
    )


GROUPS = {
    "params": (
        ["params", "list", "RTL_*"],
        ["params", "get", "RTL_ALT"],
        ["params", "get", "NO_SUCH"],
        ["params", "set", "RTL_ALT=2000"],
        ["params", "save", "mine.param"],
        ["params", "set", "RTL_ALT=2100"],
        ["params", "diff", "mine.param"],
        ["params", "load", "mine.param"],
    ),
    "mission": (
        ["mission", "check", "m.waypoints"],
        ["mission", "upload", "m.waypoints"],
        ["mission", "show"],
        ["mission", "upload", "odd.waypoints"],
        ["mission", "download", "again.plan"],
        ["mission", "clear"],
        ["mission", "start"],
    ),
    "files and logs": (
        ["files", "mkdir", "/box"],
        ["files", "put", "m.waypoints", "/box/a"],
        ["files", "ls", "/box"],
        ["files", "crc", "/box/a"],
        ["files", "get", "/box/a", "b"],
        ["files", "rm", "/box/a"],
        ["logs", "list"],
        ["logs", "get"],
        ["logs", "erase"],
    ),
    "camera and gimbal": (
        ["camera", "info"],
        ["camera", "photo", "--to", "."],
        ["camera", "streams"],
        ["camera", "zoom", "30"],
        ["camera", "format"],
        ["gimbal", "info"],
        ["gimbal", "neutral"],
    ),
    "calibration": (["calibrate", "gyroscope"], ["calibrate", "compass"]),
    "link": (
        ["status"],
        ["events", "--seconds", "2", "--all"],
        ["record", "flight.tlog", "--seconds", "2"],
        ["doctor", "x.tlog", "--seconds", "3"],
    ),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("group", GROUPS)
def test_json_records_match_documentation(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(MISSION)
    Path("odd.waypoints").write_text(MISSION.replace("\t3\t22\t", "\t3\t16\t"))
    run_with(copter(), *([*arguments, "--json"] for arguments in GROUPS[group]))
    printed = records(capsys.readouterr().out)
    assert len(printed) >= len(GROUPS[group])
    assert_all_printed(group, printed)


@pytest.mark.exhaustive
def test_json_of_fly_matches_documentation(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.waypoints").write_text(MISSION)
    assert main(["fly", "m.waypoints", "--sim", "--speedup", "50", "--json"]) == 0
    printed = records(capsys.readouterr().out)
    assert printed[-1]["type"] == "flight_summary"
    assert_all_printed("fly", printed)


@pytest.mark.exhaustive
def test_json_of_demo_matches_documentation(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--altitude", "3", "--side", "3", "--speedup", "50", "--json"]) == 0
    printed = records(capsys.readouterr().out)
    assert [each["type"] for each in printed[:2]] == ["simulated", "connecting"]
    assert printed[-1]["recorded_in"] == "demo.tlog"
    assert_all_printed("demo", printed)


def test_json_of_sim_matches_documentation(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["sim", "tcpin:127.0.0.1:0", "--duration", "1", "--speedup", "20", "--picture", "track.svg"]
    assert main([*arguments, "--fault", "gps_lost@0.5", "--json"]) == 0
    printed = records(capsys.readouterr().out)
    assert [each["type"] for each in printed] == ["simulated", "fault", "stopped", "saved"]
    assert_all_printed("sim", printed)


def assert_all_printed(group: str, printed: list[dict[str, Any]]) -> None:
    assert set(PRINTED[group].split()) <= {record["type"] for record in printed}


def test_json_every_documented_record_is_tested() -> None:
    tested = {name for names in PRINTED.values() for name in names.split()}
    assert set(documented()) - tested == TESTED_ELSEWHERE | RARE


def test_json_option_exists_for_all_but_two_commands() -> None:
    without = set()
    for command in COMMANDS:
        own = below(make_parser(command.name))[command.name]
        for parser in below(own).values() or [own]:
            if "--json" not in parser._option_string_actions:
                without.add(command.name)
    assert without == {"monitor", "completion"}, "the others need add_json(parser), or add_action"


def below(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the subparsers of a parser."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def test_exit_codes_match_documentation() -> None:
    table = DOCUMENT.read_text(encoding="utf-8").partition("## Exit codes")[2].partition("## JSON")[0]
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", table, re.MULTILINE)
    assert "Exit codes: " + ", ".join(f"{code} {text}" for code, text in rows) + "." == exit_codes_help()


def test_every_command_is_documented() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for command in COMMANDS:
        assert f"aerokit {command.name}" in text, f"describe `aerokit {command.name}` in docs/command-line.md"
