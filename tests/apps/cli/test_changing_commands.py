"""Commands that change something need an unambiguous vehicle, and do not replace files."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_harness import HOME, MISSION, run_with

from aerokit.apps.cli import main
from aerokit.sim import SimulatedCopter

CHANGING = (
    ("params", "set", "RTL_ALT=1700"),
    ("params", "load", "other.param"),
    ("mission", "upload", "square.waypoints"),
    ("mission", "clear"),
    ("mission", "start"),
    ("mission", "pause"),
    ("mission", "resume"),
    ("files", "mkdir", "/APM/there"),
    ("files", "rm", "/APM/there"),
    ("files", "put", "other.param", "/APM/there"),
    ("files", "mv", "/APM/there", "/APM/here"),
    ("logs", "erase", "--yes"),
    ("gimbal", "neutral"),
    ("camera", "photo"),
    ("calibrate", "gyroscope"),
    ("fly", "square.waypoints", "--yes"),
    ("demo",),
)


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("square.waypoints").write_text(MISSION)
    Path("other.param").write_text("RTL_ALT,1700\n")


@pytest.fixture
def pair() -> list[SimulatedCopter]:
    return [SimulatedCopter(system_id=number, boot_time_s=0.0, home=HOME) for number in (1, 2)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("command", CHANGING, ids=lambda command: " ".join(command[:2]))
def test_changing_command_with_two_vehicles_sends_nothing(
    pair: list[SimulatedCopter], command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    before = [each.parameters["RTL_ALT"] for each in pair]
    assert run_with(pair, command) == [2]
    assert (
        "several vehicles are on the link (system ids 1, 2): choose one with --system-id; nothing was sent"
        in capsys.readouterr().err
    )
    assert [each.parameters["RTL_ALT"] for each in pair] == before
    assert not any(each.is_armed or each.mission.is_present for each in pair)


def test_changing_command_with_system_id_changes_that_vehicle(
    pair: list[SimulatedCopter], capsys: pytest.CaptureFixture[str]
) -> None:
    commands = [
        ("params", "set", "RTL_ALT=1700", "--system-id", "2"),
        ("mission", "upload", "square.waypoints", "--system-id", "2"),
    ]
    assert run_with(pair, *commands) == [0, 0]
    assert [each.parameters["RTL_ALT"] for each in pair] == [1500, 1700]
    assert [each.mission.is_present for each in pair] == [False, True]
    assert "4 items uploaded to vehicle 2" in capsys.readouterr().out


def test_changing_command_with_one_vehicle_needs_no_id(pair: list[SimulatedCopter]) -> None:
    assert run_with(pair[1], ("params", "set", "RTL_ALT=1700")) == [0]
    assert pair[1].parameters["RTL_ALT"] == 1700


@pytest.mark.parametrize("command", [("params", "save"), ("mission", "download")], ids=lambda each: each[0])
def test_existing_output_file_needs_force(
    command: tuple[str, ...], pair: list[SimulatedCopter], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("mine.txt").write_text("mine")
    assert main([*command, "mine.txt"]) == 6
    assert capsys.readouterr().err == "aerokit: mine.txt: file exists; use --force to replace it\n"
    assert Path("mine.txt").read_text() == "mine"
    assert run_with(pair[0], [*command, "mine.txt", "--force"]) == [0]
    assert Path("mine.txt").read_text() != "mine"
