"""`aerokit camera|gimbal`: output, files and exit codes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from served_copter import served

from aerokit.apps.cli import devices, main
from aerokit.apps.cli.main import make_parser
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def gimbal() -> SimulatedGimbal:
    return SimulatedGimbal()


@pytest.fixture
def camera() -> SimulatedCamera:
    return SimulatedCamera(streams=["rtsp://127.0.0.1:8554/main"])


@pytest.fixture
def address(camera: SimulatedCamera, gimbal: SimulatedGimbal) -> Iterator[str]:
    with served([SimulatedCopter(boot_time_s=0.0, components=[camera, gimbal])]) as address:
        yield address


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.cli.connecting._OTHER_VEHICLES_TIMEOUT_S", 0.0)


@pytest.fixture
def run(address: str, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command on the copter; return exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main([*arguments, "--connect", address])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


@pytest.mark.parametrize("success", [True, None])
def test_picture_without_address_is_reported_as_not_downloaded(
    success: bool | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = make_parser("camera").parse_args(["camera", "photo", "--to", str(tmp_path)])
    capture: Any = SimpleNamespace(index=3, place=None, file_url="", success=success, to_dict=dict)
    camera: Any = None  # is not needed, because nothing is downloaded
    assert asyncio.run(devices._print_and_download(options, camera, capture)) is False
    assert "not downloaded: its address was not reported" in capsys.readouterr().out


def test_camera_info_prints_model_capabilities_and_storage(run: Run) -> None:
    code, out, _ = run("camera", "info")
    assert code == 0
    assert "100  aerokit Simulated camera" in out
    assert "capture_image" in out
    assert "card 1: " in out


def test_camera_photo_takes_and_downloads_pictures(run: Run, camera: SimulatedCamera, tmp_path: Path) -> None:
    before = camera.image_count
    code, out, _ = run("camera", "photo", "--to", str(tmp_path))
    assert (code, camera.image_count) == (0, before + 1)
    (file,) = tmp_path.iterdir()
    assert str(file) in out
    assert file.stat().st_size > 100
    code, out, _ = run("camera", "photo", "--count", "2", "--interval", "0.5")
    assert (code, camera.image_count) == (0, before + 3)
    assert len(out.splitlines()) == 2


def test_camera_mode_video_and_zoom_change_camera(run: Run, camera: SimulatedCamera) -> None:
    assert run("camera", "mode", "video")[0] == 0
    assert run("camera", "video", "start")[0] == 0
    assert run("camera", "video", "stop")[0] == 0
    assert run("camera", "mode", "photo")[0] == 0
    assert run("camera", "zoom", "30")[0] == 0
    assert camera.zoom == pytest.approx(30)


def test_camera_streams_prints_addresses(run: Run) -> None:
    code, out, _ = run("camera", "streams")
    assert code == 0
    assert "rtsp://127.0.0.1:8554/main" in out


def test_camera_format_without_yes_formats_nothing(run: Run, camera: SimulatedCamera) -> None:
    run("camera", "photo")
    assert run("camera", "format") == (1, "not confirmed; nothing was formatted\n", "")
    assert camera.image_count > 0
    assert run("camera", "format", "--yes")[0] == 0
    assert camera.image_count == 0


def test_camera_info_of_missing_camera_times_out(run: Run) -> None:
    code, _, err = run("camera", "info", "--camera", "105", "--patience", "1")
    assert code == 4
    assert "105" in err


@pytest.mark.parametrize("wrong", [["photo", "--count", "0"], ["zoom", "101"], ["mode", "x"], ["video"]])
def test_camera_invalid_arguments_exit_with_code_2(run: Run, wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run("camera", *wrong)
    assert caught.value.code == 2


@pytest.mark.exhaustive
def test_gimbal_point_changes_attitude(run: Run, gimbal: SimulatedGimbal) -> None:
    assert run("gimbal", "point", "-45", "20")[0] == 0
    code, out, _ = run("gimbal", "info")
    assert code == 0
    assert "pitch -45" in out
    assert " to " in out


@pytest.mark.exhaustive
def test_gimbal_neutral_and_release_succeed(run: Run, gimbal: SimulatedGimbal) -> None:
    assert run("gimbal", "neutral")[0] == 0
    assert "pitch 0" in run("gimbal", "info")[1]
    assert run("gimbal", "release")[0] == 0
