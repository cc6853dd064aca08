"""`aerokit camera|gimbal`: what they print, what they leave on disk, and their exit codes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from served_copter import served

from aerokit.apps.cli import main
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def gimbal() -> SimulatedGimbal:
    return SimulatedGimbal()


@pytest.fixture(scope="module")
def camera() -> SimulatedCamera:
    return SimulatedCamera(streams=["rtsp://127.0.0.1:8554/main"])


@pytest.fixture(scope="module")
def address(camera: SimulatedCamera, gimbal: SimulatedGimbal) -> Iterator[str]:
    with served([SimulatedCopter(boot_time_s=0.0, components=[camera, gimbal])]) as address:
        yield address


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "aerokit.apps.cli.vehicle_command.LISTEN_S", 0.0
    )  # tests/apps/cli has several vehicles


@pytest.fixture
def run(address: str, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command that talks to the copter; gives exit code, standard output and standard error."""

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main([*arguments, "--connect", address])
        told = capsys.readouterr()
        return code, told.out, told.err

    return run


def test_what_the_camera_is(run: Run) -> None:
    code, out, _ = run("camera", "info")
    assert code == 0
    assert "100  aerokit Simulated camera" in out
    assert "capture_image" in out
    assert "card 1: " in out


def test_pictures_are_taken_and_fetched(run: Run, camera: SimulatedCamera, tmp_path: Path) -> None:
    before = camera.image_count
    code, out, _ = run("camera", "photo", "--to", str(tmp_path))
    assert (code, camera.image_count) == (0, before + 1)
    (file,) = tmp_path.iterdir()
    assert str(file) in out
    assert file.stat().st_size > 100
    code, out, _ = run("camera", "photo", "--count", "2", "--interval", "0.5")
    assert (code, camera.image_count) == (0, before + 3)
    assert len(out.splitlines()) == 2


def test_mode_video_and_zoom(run: Run, camera: SimulatedCamera) -> None:
    assert run("camera", "mode", "video")[0] == 0
    assert run("camera", "video", "start")[0] == 0
    assert run("camera", "video", "stop")[0] == 0
    assert run("camera", "mode", "photo")[0] == 0
    assert run("camera", "zoom", "30")[0] == 0
    assert camera.zoom == pytest.approx(30)


def test_streams_have_addresses(run: Run) -> None:
    code, out, _ = run("camera", "streams")
    assert code == 0
    assert "rtsp://127.0.0.1:8554/main" in out


def test_formatting_asks_first(run: Run, camera: SimulatedCamera) -> None:
    run("camera", "photo")
    assert run("camera", "format") == (1, "nothing was formatted\n", "")
    assert camera.image_count > 0
    assert run("camera", "format", "--yes")[0] == 0
    assert camera.image_count == 0


def test_a_camera_that_is_not_there(run: Run) -> None:
    code, _, err = run("camera", "info", "--camera", "105", "--patience", "1")
    assert code == 4
    assert "105" in err


@pytest.mark.parametrize("wrong", [["photo", "--count", "0"], ["zoom", "101"], ["mode", "x"], ["video"]])
def test_wrong_arguments(run: Run, wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run("camera", *wrong)
    assert caught.value.code == 2


def test_the_gimbal_points(run: Run, gimbal: SimulatedGimbal) -> None:
    assert run("gimbal", "point", "-45", "20")[0] == 0
    code, out, _ = run("gimbal", "info")
    assert code == 0
    assert "pitch -45" in out
    assert " to " in out


@pytest.mark.exhaustive
def test_the_gimbal_goes_back_to_neutral_and_is_released(run: Run, gimbal: SimulatedGimbal) -> None:
    assert run("gimbal", "neutral")[0] == 0
    assert "pitch 0" in run("gimbal", "info")[1]
    assert run("gimbal", "release")[0] == 0
