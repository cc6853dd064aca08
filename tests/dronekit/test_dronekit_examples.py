"""Every example in the classic style is an unmodified DroneKit program, and flies a simulated copter."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from served_copter import served_copter, without_loop_warnings

from aerokit.dronekit.runner import run_script, uninstall

ROOT = Path(__file__).parent.parent.parent
EXAMPLES = ROOT / "examples" / "dronekit"
PAGE = (ROOT / "docs" / "from-dronekit.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python[^\n]*\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
RECORDING = ROOT / "tests" / "recordings" / "ardupilot-copter.tlog"


@pytest.fixture(autouse=True)
def pymavlink_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading a recording of MAVLink 2 makes pymavlink change its dialect and the environment, for everybody."""
    monkeypatch.setattr(mavutil, "mavlink", mavutil.mavlink)
    monkeypatch.setattr(mavutil, "current_dialect", mavutil.current_dialect)
    monkeypatch.setenv("MAVLINK20", "")
    monkeypatch.delenv("MAVLINK20")


EXPECTED: dict[str, tuple[float, list[str], list[str]]] = {
    "hello": (20, [], ["firmware: APM:Copter-4.7.0", "mode: STABILIZE", "can be armed: True"]),
    "vehicle_state": (
        20,
        ["--seconds", "0.2"],
        [
            "LocationGlobal:lat=-35.363261",
            "location.global_frame",
            "1349 parameters",
            "was 5000.0, is 5001.0",
        ],
    ),
    "simple_goto": (20, ["--altitude", "5"], ["at 5 m", "there\n", "landed"]),
    "basic_mission": (
        20,
        ["--altitude", "5", "--side", "20"],
        ["6: command 20", "executing command 6 of 6", "landed"],
    ),
    "guided_velocity_and_yaw": (
        25,
        ["--seconds", "0.2", "--altitude", "5"],
        [" at [2.0, ", "heading ", "landed"],
    ),
    "channel_overrides": (20, [], ["'3': 1100", "overrides: {'1': 1600, '2': 1400}"]),
    "create_attribute": (20, [], ["first: Vibration: x=", "\nvibration: Vibration: x="]),
    "gimbal": (20, ["--seconds", "0.05"], ["Gimbal: pitch=-", "pitch -45, yaw 90", "released"]),
    "follow_me": (
        25,
        ["--seconds", "0.6", "--walking-speed", "20", "--altitude", "5"],
        ["m behind", "followed for ", "landed"],
    ),
    "flight_replay": (20, [str(RECORDING)], ["4 waypoints", "to waypoint ", "at the end of the track"]),
}
"""Example: speed-up, additional arguments, expected output."""

PARAMETERS = {"gimbal": {"MNT1_TYPE": 1.0}}
"""Parameters of the vehicle that differ from the defaults."""


@pytest.fixture(autouse=True)
def without_alias() -> Iterator[None]:
    yield
    uninstall()


def test_every_example_has_a_test() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_example_imports_dronekit_only(name: str) -> None:
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    imported = [node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    assert "dronekit" in imported
    assert "import aerokit" not in text
    assert "from aerokit" not in text


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", EXPECTED)
def test_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    speedup, arguments, expected = EXPECTED[name]
    with served_copter(speedup=speedup, parameters=PARAMETERS.get(name)) as address:
        run_script(EXAMPLES / f"{name}.py", [*arguments, "--connect", address])
    notified = capsys.readouterr()
    assert notified.err == ""
    for text in expected:
        assert text in notified.out


@pytest.mark.exhaustive
def test_example_as_program() -> None:
    with served_copter() as address:
        done = subprocess.run(
            [
                sys.executable,
                "-W",
                "error",
                "-m",
                "aerokit",
                "run",
                EXAMPLES / "hello.py",
                "--connect",
                address,
            ],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
    assert (done.returncode, without_loop_warnings(done.stderr)) == (0, "")
    assert "mode: STABILIZE" in done.stdout


def test_from_dronekit_page_blocks() -> None:
    """The blocks of docs/from-dronekit.md; the second one continues the first."""
    names: dict[str, Any] = {}
    assert len(BLOCKS) == 2
    with served_copter(speedup=20) as address:
        try:
            for block in BLOCKS:
                code = block.replace("udpin:0.0.0.0:14550", address)
                exec(compile(code, "docs/from-dronekit.md", "exec"), names)
                assert names["vehicle"].armed
        finally:
            names["vehicle"].close()
