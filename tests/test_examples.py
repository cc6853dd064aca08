"""Run every example against a simulated copter, on virtual time or as a program on a socket."""

from __future__ import annotations

import json
import os
import runpy
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from served_copter import served_copter, without_loop_warnings

from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import run_virtual

EXAMPLES = Path(__file__).parent.parent / "examples"


class FakePad:
    """A gamepad whose right stick is pushed forward for two seconds, and then its button."""

    def __init__(self) -> None:
        self._reads = 0

    def get_axis(self, number: int, /) -> float:
        self._reads += number == 3
        return {3: -0.5, 0: 0.05}.get(number, 0.0)

    def get_button(self, number: int, /) -> bool:
        return number == 1 and self._reads > 50


ON_VIRTUAL_TIME: dict[str, tuple[list[Any], list[str]]] = {
    "fly_square": ([], ["at Position(", "landed"]),
    "watch_state": ([5.0], ["s old", "rad, 0 missed", "LinkReport(", "enough"]),
    "guided_velocity": ([], ["holding in BRAKE", "landed"]),
    "gamepad": ([FakePad()], ["you have the sticks in LOITER", "sticks released in BRAKE", "landed"]),
    "custom_mode_and_command": ([], ["mode BRAKE", "'FASTER'", "AutopilotVersion(", "result 4: "]),
    "land_on_low_battery": ([95.0], ["landing with 94 %"]),
    "mission": ([], ["item 3 was reached", "flown"]),
    "parameters": (
        [],
        ["1349 parameters", " instead of ", "LAND_SPEED is 40 for now", "LAND_SPEED is 50 again"],
    ),
    "fleet_formation": ([], ["field/1, field/2, field/3", "in formation", "m from its place", "3 of 3 done"]),
    "two_vehicles": ([], ["system 1 is at", "system 2 is at", "both landed"]),
}
"""Example name: arguments of ``main`` after the address, expected output."""
VEHICLE_COUNTS = {"two_vehicles": 2, "fleet_formation": 3}
"""Example name: number of vehicles, if more than one."""
AS_PROGRAMS: dict[str, list[str]] = {
    "hello": ["ArduCopter 4.7.0", "disarmed", "can be armed"],
    "blocking_hello": ["ArduCopter 4.7.0", "landed"],
    "download_logs": [" bytes", "log 2 is in log00002.bin"],
    "blocking_messages": ["m/s at", "holding in BRAKE"],
}
"""Example name: expected output."""
COMPONENTS = {"arm_authorizer", "camera_server", "landing_beacon", "payload"}
"""Tested in onboard/test_component_examples.py."""
TESTED_SEPARATELY = {"record_and_replay", "signed_link", "survey_photos", "web_server", *COMPONENTS}


def test_every_example_has_a_test() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {
        *ON_VIRTUAL_TIME,
        *AS_PROGRAMS,
        *TESTED_SEPARATELY,
    }


def run_on_virtual_time(name: str, *arguments: Any) -> None:
    """Run ``main`` of an example with a link in memory."""
    example = runpy.run_path(str(EXAMPLES / f"{name}.py"))

    async def main() -> None:
        homes = [(-35.363261, 149.165230 + 1e-4 * number, 584.0) for number in range(VEHICLE_COUNTS.get(name, 1))]
        copters = [
            SimulatedCopter(system_id=number, boot_time_s=0.0, home=home) for number, home in enumerate(homes, 1)
        ]
        async with simulated_link(copters if name in VEHICLE_COUNTS else copters[0]) as link:
            await example["main"](link, *arguments)

    run_virtual(main())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ON_VIRTUAL_TIME)
def test_example_on_virtual_time_prints_expected_output(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments, expected = ON_VIRTUAL_TIME[name]
    run_on_virtual_time(name, *arguments)
    output = capsys.readouterr().out
    for text in expected:
        assert text in output


def test_record_and_replay_example_counts_attitudes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    record = str(tmp_path / "flight.tlog")
    run_on_virtual_time("record_and_replay", record)
    live, recorded, replayed = capsys.readouterr().out.splitlines()
    assert recorded == f"recorded in {record}"
    assert live.endswith("attitudes, 0 missed")
    assert 0 < int(replayed.split()[0]) <= int(live.split()[0])


def test_signed_link_example_sets_and_removes_key(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    stamp = tmp_path / "stamp.txt"
    for _ in range(2):
        before = int(stamp.read_text()) if stamp.exists() else 0
        run_on_virtual_time("signed_link", "a long passphrase", stamp)
        assert int(stamp.read_text()) > before
        output = capsys.readouterr().out
        for text in ("signs with <SigningKey 0ee99475>", "0 frames were refused", "does not sign any more"):
            assert text in output


def command(name: str, *arguments: str) -> list[str]:
    return [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py"), *arguments]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", AS_PROGRAMS)
def test_example_as_program_prints_expected_output(name: str, tmp_path: Path) -> None:
    with served_copter() as address:
        done = subprocess.run(
            command(name, address), capture_output=True, text=True, timeout=200, check=False, cwd=tmp_path
        )
    assert (done.returncode, without_loop_warnings(done.stderr)) == (0, ""), done.stdout
    for text in AS_PROGRAMS[name]:
        assert text in done.stdout


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_web_server_example_serves_state() -> None:
    with (
        served_copter() as address,
        subprocess.Popen(command("web_server", address, "0"), stdout=subprocess.PIPE, text=True) as server,
    ):
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            with urllib.request.urlopen(url, timeout=30) as answer:
                state = json.load(answer)
            server.send_signal(signal.SIGTERM)
            server.wait(200)
        finally:
            server.kill()
    assert state["armed"] is False
    assert state["mode"] == "STABILIZE"


@pytest.mark.exhaustive
def test_survey_photos_example_writes_geotagged_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = runpy.run_path(str(EXAMPLES / "survey_photos.py"))
    run_virtual(example["simulated"](str(tmp_path)))
    pictures = sorted(tmp_path.glob("*.jpg"))
    assert f"{len(pictures)} pictures are in {tmp_path}" in capsys.readouterr().out
    lines = (tmp_path / "captures.csv").read_text().splitlines()
    assert len(lines) == len(pictures) + 1 > 15
    latitudes = set()
    for path in pictures:
        with Image.open(path) as image:
            latitudes.add(image.getexif().get_ifd(0x8825)[2])
    assert len(latitudes) > 8
