"""Invalid camera messages: counts that restart, values that are not numbers, impossible times."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from camera_stage import commands_to, on_board
from flight_harness import Flight, Px4Flight, open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.apps.cli.devices import _file_name, _print_and_download
from aerokit.errors import AerokitError, NotSupported, OperationTimeout
from aerokit.events import ImageCaptured
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CameraCapFlags, MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCamera, SimulatedCopter
from aerokit.vehicle.camera.capture import Capture, captures_csv

pytestmark = pytest.mark.anyio

LATITUDE, LONGITUDE = 473977418, 85455939


def inject(flight: Flight | Px4Flight, message: Message, component_id: int = 1) -> None:
    """Inject a message from a component of the vehicle."""
    flight.wire.deliver(FrameEncoder(1, component_id).encode(message))


def feedback(index: int, *, roll: float = 0.0, cam_idx: int = 0, time_usec: int = 0) -> m.CameraFeedback:
    return m.CameraFeedback(time_usec, 1, cam_idx, index, LATITUDE, LONGITUDE, 0, 0, roll, 0, 0, 0, 0)


def image(index: int, *, boot_ms: int = 0, utc: int = 0, url: str = "") -> m.CameraImageCaptured:
    return m.CameraImageCaptured(boot_ms, utc, 1, LATITUDE, LONGITUDE, 0, 0, (1, 0, 0, 0), index, 1, url)


def status(count: int, *, boot_ms: int = 0) -> m.CameraCaptureStatus:
    return m.CameraCaptureStatus(boot_ms, 0, 0, 0, 0, 1000, count)


@asynccontextmanager
async def capture_flight() -> AsyncIterator[tuple[Flight, list[ImageCaptured]]]:
    """Flight of a copter without a camera, and its ImageCaptured events."""
    async with open_flight(SimulatedCopter(boot_time_s=0.0)) as flight:
        await flight.vehicle.wait_ready()
        reported: list[ImageCaptured] = []
        flight.vehicle.connection.bus.attach_event(ImageCaptured, reported.append)
        yield flight, reported


# ------------------------------------------------------------------------------ restarted counts


async def test_captures_after_log_reset_are_new() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        reported: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, reported.append)
        for _ in range(3):
            await vehicle.camera.take_photo()
        old = vehicle.camera.captures()
        camera.captures.images.clear()  # another station has formatted the card
        await anyio.sleep(100)
        for _ in range(2):
            await vehicle.camera.take_photo()
        assert [event.index for event in reported] == [0, 1, 2, 0, 1]
        assert [capture.index for capture in vehicle.camera.captures()] == [0, 1]
        camera.faults.lose(m.CameraImageCaptured, times=1)
        third = await vehicle.camera.take_photo()
        assert third.index == 2
        assert old[2].taken_at is not None
        assert third.taken_at == pytest.approx(old[2].taken_at + 100, abs=5)


async def test_log_reset_with_first_capture_lost() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        old = [await vehicle.camera.take_photo() for _ in range(2)]
        camera.captures.images.clear()
        await anyio.sleep(100)
        camera.faults.lose(m.CameraImageCaptured, times=1)
        first = await vehicle.camera.take_photo()
        assert first.index == 0
        assert first.taken_at != old[0].taken_at


async def test_repeated_capture_is_not_new() -> None:
    async with capture_flight() as (flight, reported):
        camera = flight.vehicle.camera_at(100)
        for report in (image(0, boot_ms=1000), image(1, boot_ms=2000), image(0, boot_ms=1000)):
            inject(flight, report, 100)
        assert [event.index for event in reported] == [0, 1]
        assert camera.capture.value.index == 1
        inject(flight, status(2, boot_ms=3000), 100)
        inject(flight, status(1, boot_ms=1500), 100)  # arrived out of order
        assert len(camera.captures()) == 2
        inject(flight, status(0, boot_ms=300_000), 100)
        assert camera.captures() == []


async def test_late_old_capture_makes_no_old_status_valid() -> None:
    async with capture_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        for report in (image(1, boot_ms=2000), image(2, boot_ms=9000), status(3, boot_ms=9500), image(0, boot_ms=1000)):
            inject(flight, report, 100)
        inject(flight, status(2, boot_ms=6000), 100)  # arrived out of order
        assert [capture.index for capture in camera.captures()] == [0, 1, 2]


async def test_capture_requested_twice_is_no_log_reset() -> None:
    async with capture_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        inject(flight, image(40_000, boot_ms=9000), 100)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(camera._log.fetch, 5)
            with anyio.move_on_after(0.5):
                await camera._log.fetch(5)
            inject(flight, image(5, boot_ms=1000), 100)
        assert [capture.index for capture in camera.captures()] == [5, 40_000]


@pytest.mark.parametrize("later", [{"boot_ms": 9000}, {"utc": 1_700_000_009_000_000}])
async def test_log_reset_is_detected_by_time(later: dict[str, Any]) -> None:
    before: dict[str, Any] = {key: value - 5000 for key, value in later.items()}
    async with capture_flight() as (flight, reported):
        camera = flight.vehicle.camera_at(100)
        inject(flight, image(5, **before), 100)
        inject(flight, image(2, **later), 100)
        assert [capture.index for capture in camera.captures()] == [2]
        assert [event.index for event in reported] == [5, 2]


async def test_single_corrupt_index_does_not_reset_the_log() -> None:
    async with capture_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        for index in (0, 1, 2_000_000_000, 2, 3):
            await anyio.sleep(1)
            inject(flight, image(index, boot_ms=round(anyio.current_time() * 1000)), 100)
        assert [capture.index for capture in camera.captures()] == [0, 1, 2, 3, 2_000_000_000]
        for index in (5000, 5001, 4):  # captures are missed before the count restarts
            await anyio.sleep(1)
            inject(flight, image(index, boot_ms=round(anyio.current_time() * 1000)), 100)
        assert [capture.index for capture in camera.captures()] == [4]


async def test_camera_feedback_index_wraps_at_16_bits() -> None:
    async with capture_flight() as (flight, reported):
        camera = flight.vehicle.camera_at(1)
        for index in (0, 65534, 65535, 0, 1, 2):  # ArduPilot sends zeros before the first picture
            inject(flight, feedback(index))
        assert [event.index for event in reported] == [65533, 65534, 65535, 0, 1]
        assert [capture.index for capture in camera.captures()] == [0, 1]


# --------------------------------------------------------------------------------- invalid numbers


@pytest.mark.parametrize("device", [7, 8, 99, 255])
async def test_autopilot_has_up_to_six_cameras(device: int) -> None:
    async with capture_flight() as (flight, _):
        vehicle = flight.vehicle
        assert vehicle.cameras.latest is None
        inject(flight, feedback(1, cam_idx=device - 1))
        await anyio.sleep(3.0)
        assert vehicle.cameras.latest is None
        assert vehicle.camera.number is None
        inject(flight, m.Heartbeat(30, 8, 0, 0, 4, 3), 100)
        assert vehicle.cameras.value == (100,)
        assert vehicle.camera.number == 100


@pytest.mark.parametrize("component_id", [0, 2])
async def test_invalid_component_id_is_ignored(component_id: int) -> None:
    async with capture_flight() as (flight, reported):
        inject(flight, image(0), component_id)
        inject(flight, m.Heartbeat(30, 8, 0, 0, 4, 3), component_id)
        await anyio.sleep(3.0)
        assert flight.vehicle.cameras.latest is None
        assert reported == []


# ------------------------------------------------------------------------------------ identity of cameras and pictures


async def test_camera_object_is_kept_after_discovery() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        named = vehicle.camera_at(100)
        camera.faults.silent = False
        await anyio.sleep(3.0)
        assert vehicle.camera_at(100) is named
        assert vehicle.camera is named
        reported: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, reported.append)
        await named.take_photo()
        await anyio.sleep(1.0)
        assert len(reported) == 1


async def test_first_and_numbered_camera_objects_are_both_kept() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        named, first = vehicle.camera_at(100), vehicle.camera
        camera.faults.silent = False
        await anyio.sleep(3.0)
        assert (vehicle.camera_at(100), vehicle.camera) == (named, first)


async def test_px4_trigger_and_image_messages_are_one_capture() -> None:
    async with open_px4() as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        camera = vehicle.camera_at(1)
        reported: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, reported.append)
        inject(flight, m.CameraTrigger(10, 5))
        await anyio.sleep(0.5)
        inject(flight, image(5))
        await anyio.sleep(0.5)
        assert [event.index for event in reported] == [5]
        (capture,) = camera.captures()
        assert capture.success is True  # the message with the result wins
        assert camera.capture.value == capture


# --------------------------------------------------------------------------------------- files and values


async def test_capture_urls_name_the_component() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        capture = await vehicle.camera.take_photo()
        content = await vehicle.camera.read_picture(capture)
        for url in (
            "mftp://[;comp=100]/DCIM/IMG_0001.JPG",
            "mftp://DCIM/IMG_0001.JPG",
            "MFTP:///DCIM/IMG_0001.JPG",
            "/DCIM/IMG_0001.JPG",
        ):
            assert await vehicle.camera.read_picture(capture.replace(file_url=url)) == content
        for url in (
            "http://[x",
            "http://10.0.0.1/a.jpg",
            "mftp://",
            "mftp:",
            "mftp://[;comp=999]/a",
            "[",
            "",
        ):
            with pytest.raises(NotSupported, match=r"nothing was sent|no file was requested"):
                await vehicle.camera.read_picture(capture.replace(file_url=url))


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, math.nan])
async def test_capture_nan_angles_are_none(wrong: float, caplog: pytest.LogCaptureFixture) -> None:
    async with capture_flight() as (flight, reported):
        camera = flight.vehicle.camera_at(1)
        inject(flight, feedback(1, roll=wrong))
        inject(flight, m.CameraFeedback(0, 1, 0, 2, LATITUDE, LONGITUDE, wrong, wrong, 0, wrong, wrong, 0, 0))
        first, second = camera.captures()
        assert (first.quaternion, first.roll_deg, first.pitch_deg, first.yaw_deg) == (None, None, 0.0, 0.0)
        assert (second.quaternion, second.pitch_deg, second.yaw_deg) == (None, None, None)
        assert second.place is not None
        assert (second.place.altitude_amsl_m, second.place.altitude_relative_m) == (None, None)
        assert len(reported) == 2
    assert "raised" not in caplog.text


@pytest.mark.parametrize("utc", [2**63, 2**64 - 1, 253_402_300_800_000_000])
async def test_capture_time_out_of_range_is_none(utc: int) -> None:
    async with capture_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        inject(flight, image(1, utc=utc), 100)
        (capture,) = camera.captures()
        assert capture.taken_at is None
    for taken_at in (math.inf, math.nan, 1e300, -1.0):
        assert captures_csv([capture.replace(taken_at=taken_at)]) == captures_csv([capture])


# ------------------------------------------------------------------------------------------- polling


async def test_temporary_refusal_is_polled_again() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(MavCmd.REQUEST_MESSAGE, MavResult.TEMPORARILY_REJECTED, times=1)
        await vehicle.camera.status.wait_until(lambda _: True, timeout=20)


@pytest.mark.parametrize("rebooted", ["camera", "vehicle"])
async def test_refusal_is_forgotten_after_reboot(rebooted: str) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(MavCmd.REQUEST_MESSAGE, MavResult.UNSUPPORTED, times=1)
        camera.faults.refuse(MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, MavResult.UNSUPPORTED, times=1)
        with pytest.raises(OperationTimeout):
            await vehicle.camera.status.wait_until(lambda _: True, timeout=20)
        if rebooted == "camera":
            camera.faults.silent = True
            await anyio.sleep(30)
            camera.faults.silent = False
        else:
            await vehicle.reboot()
        await vehicle.camera.status.wait_until(lambda _: True, timeout=60)


async def test_camera_after_silence_is_identified_again() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        assert (await vehicle.camera.wait_found()).model == "Simulated camera"
        commands = commands_to(camera, int(MavCmd.REQUEST_MESSAGE))
        await anyio.sleep(20)
        assert commands == []
        camera.capabilities, camera.model = int(CameraCapFlags.CAPTURE_VIDEO), "another camera"
        camera.faults.silent = True
        await anyio.sleep(30)
        camera.faults.silent = False
        await anyio.sleep(5)
        assert vehicle.camera.information.value.model == "another camera"
        assert (await vehicle.camera.wait_found()).model == "another camera"
        assert len(commands) == 1
        with pytest.raises(NotSupported):
            await vehicle.camera.take_photo()


# --------------------------------------------------------------------------------------------- bounded resources


@pytest.mark.exhaustive
async def test_unread_series_has_bounded_queue() -> None:
    camera = SimulatedCamera()
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=(camera,))) as flight:
        await anyio.sleep(1.5)
        async with flight.vehicle.camera.photo_interval(1.0) as series:
            await anext(series)
            for _ in range(100):
                inject(flight, image(5), 100)
            assert len(series._new_captures._queue) == 1
            for index in range(5, 20_200):
                inject(flight, image(index), 100)
            assert len(series._new_captures._queue) == 20_000


class _HugeCount(list[m.CameraImageCaptured]):
    """Report this number of pictures."""

    how_many = 0

    def __len__(self) -> int:
        return type(self).how_many


async def test_load_captures_is_bounded_for_huge_counts() -> None:
    camera = SimulatedCamera()
    _HugeCount.how_many = 2_000_000_000
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.captures.images = _HugeCount()
        commands = commands_to(camera, int(MavCmd.REQUEST_MESSAGE))
        began = anyio.current_time()
        assert await vehicle.camera.load_captures(timeout=5.0) == []  # stops after three missing captures
        assert anyio.current_time() - began < 6
        assert {command[2] for command in commands} <= {0, 2_000_000_000}  # the index as a float


# --------------------------------------------------------------------------------------- command line


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


async def test_definition_does_not_overwrite_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        capture = await vehicle.camera.take_photo()
        camera.files.put("/DCIM/101/IMG_0001.JPG", b"another")
        other = capture.replace(file_url="mftp:///DCIM/101/IMG_0001.JPG")
        options = Namespace(to=tmp_path, json=False)
        for photo in (capture, other, other.replace(index=1)):
            assert await _print_and_download(options, vehicle.camera, photo)
        assert names(tmp_path) == [
            "00000-IMG_0001-2.JPG",
            "00000-IMG_0001.JPG",
            "00001-IMG_0001.JPG",
        ]
        assert (tmp_path / "00000-IMG_0001-2.JPG").read_bytes() == b"another"
        assert (tmp_path / "00000-IMG_0001.JPG").read_bytes() != b"another"
        capsys.readouterr()
        unsafe = capture.replace(file_url="mftp:///a/..%2Fb\x1b[2J")
        assert not await _print_and_download(options, vehicle.camera, unsafe)
        assert "\x1b" not in capsys.readouterr().out
        assert len(names(tmp_path)) == 3


@pytest.mark.parametrize("base", ["..", ".", "a%2Fb", "a\\b", "C:a", "%00", "a%0A", "x" * 201])
async def test_invalid_names_are_refused(base: str) -> None:
    nothing = Capture(100, 3, True, 0.0, None, None, None, None, None, None, "")
    assert _file_name(nothing.replace(file_url=f"mftp:///DCIM/{base}")) is None
    assert _file_name(nothing) == "00003-capture.jpg"


async def test_model_name_is_stripped_of_control_characters() -> None:
    camera = SimulatedCamera(model="bad\x1b[2J\nmodel")
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        assert repr(vehicle.camera).isprintable()
        assert isinstance(vehicle, aerokit.Vehicle)
        with pytest.raises(AerokitError) as caught:
            await vehicle.camera.track_point(0.5, 0.5)
        assert str(caught.value).isprintable()
