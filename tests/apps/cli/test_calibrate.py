"""`aerokit calibrate`: pictures, results, confirmation, cancellation."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from typing import Any

import anyio
import pytest
from cli_harness import records, run_on

from aerokit.apps.cli import calibrate
from aerokit.apps.cli.calibrate import bar, lines_of
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.testing import run_virtual
from aerokit.vehicle.calibration.calibration import Calibration
from aerokit.vehicle.calibration.values import CalibrationPose as Pose
from aerokit.vehicle.calibration.values import CalibrationStep


def run(vehicle: SimulatedVehicle, *arguments: str, interrupt_after_s: float | None = None) -> int:
    async def on_link() -> int:
        async with simulated_link(vehicle) as link:
            if interrupt_after_s is not None:
                asyncio.get_running_loop().call_later(interrupt_after_s, os.kill, os.getpid(), signal.SIGINT)
            return await run_on(link, "calibrate", *arguments)

    return run_virtual(on_link())


@pytest.fixture
def entered(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Replace the question whether the pose is reached by these answers, then by True."""
    answers: list[bool] = []

    async def wait_for_enter() -> bool:
        return answers.pop(0) if answers else True

    monkeypatch.setattr(calibrate, "wait_for_enter", wait_for_enter)
    return answers


@pytest.mark.parametrize("pose", Pose)
def test_picture_fits_small_terminal(pose: Pose) -> None:
    step = CalibrationStep("accelerometer", 0.5, "x" * 300, pose, tuple(Pose), needs_confirmation=True)
    lines = lines_of(step)
    assert len(lines) <= 20
    assert all(len(line) < 80 and line.isascii() for line in [*lines, bar(0.5)])


def test_long_instruction_is_shown_to_its_end() -> None:
    text = "Place the vehicle on its left side on a level surface, do not move it, and keep away from the propellers"
    lines = lines_of(CalibrationStep("accelerometer", 0.5, text))
    assert " ".join(line.strip() for line in lines) == text


def test_pictures_of_poses_differ() -> None:
    assert len({"\n".join(lines_of(CalibrationStep("level", None, "", pose))) for pose in Pose}) == len(Pose)


def test_accelerometer_shows_each_pose(entered: list[bool], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(SimulatedCopter(boot_time_s=0.0), "accelerometer") == 0
    out = capsys.readouterr().out
    for pose in Pose:
        assert f"  {pose.value.upper()} (seen from" in out
    assert out.splitlines()[-2:] == ["accelerometer: done", "  reboot the vehicle before the next flight"]


def test_compass_prints_fitness(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(SimulatedCopter(boot_time_s=0.0), "compass") == 0
    assert "  compass 2: fitness 5.0 mgauss" in capsys.readouterr().out


def test_end_of_input_cancels_on_vehicle(entered: list[bool], capsys: pytest.CaptureFixture[str]) -> None:
    entered += [True, False]
    assert run(SimulatedCopter(boot_time_s=0.0), "accelerometer", "--json") == 130
    cancellation = records(capsys.readouterr().out)[-1]
    assert cancellation["type"] == "calibration_cancelled"
    assert cancellation["is_cancelled"] is False
    assert "not cancelled on the vehicle" in cancellation["text"]


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPx4])
def test_interrupt_cancels_on_vehicle(kind: type[Any], capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = kind(boot_time_s=0.0)
    assert run(vehicle, "compass", interrupt_after_s=8.0) == 130
    assert capsys.readouterr().out.splitlines()[-1] == "compass: cancelled on the vehicle"
    is_running = vehicle.calibration.is_running if kind is SimulatedPx4 else vehicle.calibrations.compasses.is_running
    assert not is_running


def test_unanswered_cancellation_says_how_long_it_waited(
    entered: list[bool], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entered += [False]
    monkeypatch.setattr(Calibration, "cancel", lambda calibration: anyio.sleep_forever())
    assert run(SimulatedCopter(boot_time_s=0.0), "accelerometer") == 130
    assert "not cancelled on the vehicle: it did not confirm within 20 s\n" in capsys.readouterr().out


def test_json_has_steps_and_result(entered: list[bool], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(SimulatedCopter(boot_time_s=0.0), "accelerometer", "--json") == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    steps = [record for record in records if record["type"] == "calibration_step"]
    assert [step["pose"] for step in steps] == ["LEVEL", "LEFT", "RIGHT", "NOSE_DOWN", "NOSE_UP", "BACK"]
    assert records[-1]["type"] == "calibration_result"
    assert records[-1]["reboot_due"] is True


def test_armed_vehicle_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.call_later(0.5, lambda: copter.motors.set_armed(armed=True))
    assert run(copter, "gyroscope") == 5
    assert "the vehicle is armed; nothing was sent" in capsys.readouterr().err


def test_escs_without_confirmation_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(SimulatedCopter(boot_time_s=0.0), "escs") == 2
    assert "--propellers-removed" in capsys.readouterr().err
