"""What cameras say that no camera should: counts that start again, numbers that are none, times that never were."""

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
from aerokit.apps.cli.camera import _file_name, _show
from aerokit.errors import AerokitError, NotSupported, OperationTimeout
from aerokit.events import ImageCaptured
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CameraCapFlags, MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCamera, SimulatedCopter
from aerokit.vehicle.camera.capture import Capture, captures_csv

pytestmark = pytest.mark.anyio

LATITUDE, LONGITUDE = 473977418, 85455939


def say(flight: Flight | Px4Flight, message: Message, component_id: int = 1) -> None:
    """A component of the vehicle says so."""
    flight.wire.deliver(FrameEncoder(1, component_id).encode(message))


def feedback(index: int, *, roll: float = 0.0, cam_idx: int = 0, time_usec: int = 0) -> m.CameraFeedback:
    return m.CameraFeedback(time_usec, 1, cam_idx, index, LATITUDE, LONGITUDE, 0, 0, roll, 0, 0, 0, 0)


def image(index: int, *, boot_ms: int = 0, utc: int = 0, url: str = "") -> m.CameraImageCaptured:
    return m.CameraImageCaptured(boot_ms, utc, 1, LATITUDE, LONGITUDE, 0, 0, (1, 0, 0, 0), index, 1, url)


def status(count: int, *, boot_ms: int = 0) -> m.CameraCaptureStatus:
    return m.CameraCaptureStatus(boot_ms, 0, 0, 0, 0, 1000, count)


@asynccontextmanager
async def a_flight() -> AsyncIterator[tuple[Flight, list[ImageCaptured]]]:
    """A copter without a camera, and the pictures that are told of."""
    async with open_flight(SimulatedCopter(boot_time_s=0.0)) as flight:
        await flight.vehicle.wait_ready()
        told: list[ImageCaptured] = []
        flight.vehicle.connection.bus.attach_event(ImageCaptured, told.append)
        yield flight, told


# ------------------------------------------------------------------------------ a count that starts again


async def test_pictures_of_a_new_log_are_new() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        told: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, told.append)
        for _ in range(3):
            await vehicle.camera.take_photo()
        old = vehicle.camera.captures()
        camera.captures.images.clear()  # another station has formatted the card
        await anyio.sleep(100)
        for _ in range(2):
            await vehicle.camera.take_photo()
        assert [each.index for each in told] == [0, 1, 2, 0, 1]
        assert [each.index for each in vehicle.camera.captures()] == [0, 1]
        camera.faults.lose(m.CameraImageCaptured, times=1)
        third = await vehicle.camera.take_photo()
        assert third.index == 2
        assert old[2].taken_at is not None
        assert third.taken_at == pytest.approx(old[2].taken_at + 100, abs=5)


async def test_the_first_of_a_new_log_may_be_the_one_that_is_lost() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        old = [await vehicle.camera.take_photo() for _ in range(2)]
        camera.captures.images.clear()
        await anyio.sleep(100)
        camera.faults.lose(m.CameraImageCaptured, times=1)
        first = await vehicle.camera.take_photo()
        assert first.index == 0
        assert first.taken_at != old[0].taken_at


async def test_what_is_told_once_more_is_not_new() -> None:
    async with a_flight() as (flight, told):
        camera = flight.vehicle.camera_at(100)
        for each in (image(0, boot_ms=1000), image(1, boot_ms=2000), image(0, boot_ms=1000)):
            say(flight, each, 100)
        assert [each.index for each in told] == [0, 1]
        assert camera.capture.value.index == 1
        say(flight, status(2, boot_ms=3000), 100)
        say(flight, status(1, boot_ms=1500), 100)  # was overtaken
        assert len(camera.captures()) == 2
        say(flight, status(0, boot_ms=300_000), 100)
        assert camera.captures() == []


@pytest.mark.parametrize("later", [{"boot_ms": 9000}, {"utc": 1_700_000_009_000_000}])
async def test_an_index_that_was_not_known_shows_it_by_its_time(later: dict[str, Any]) -> None:
    before: dict[str, Any] = {key: value - 5000 for key, value in later.items()}
    async with a_flight() as (flight, told):
        camera = flight.vehicle.camera_at(100)
        say(flight, image(5, **before), 100)
        say(flight, image(2, **later), 100)
        assert [each.index for each in camera.captures()] == [2]
        assert [each.index for each in told] == [5, 2]


async def test_one_lie_of_an_index_does_not_begin_the_album_anew() -> None:
    async with a_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        for index in (0, 1, 2_000_000_000, 2, 3):
            await anyio.sleep(1)
            say(flight, image(index, boot_ms=round(anyio.current_time() * 1000)), 100)
        assert [each.index for each in camera.captures()] == [0, 1, 2, 3, 2_000_000_000]
        for index in (5000, 5001, 4):  # these were missed, and then it counts from 0 again
            await anyio.sleep(1)
            say(flight, image(index, boot_ms=round(anyio.current_time() * 1000)), 100)
        assert [each.index for each in camera.captures()] == [4]


async def test_sixteen_bits_of_camera_feedback_wrap() -> None:
    async with a_flight() as (flight, told):
        camera = flight.vehicle.camera_at(1)
        for index in (0, 65534, 65535, 0, 1, 2):  # all zeros before the first
            say(flight, feedback(index))
        assert [each.index for each in told] == [65533, 65534, 65535, 0, 1]
        assert [each.index for each in camera.captures()] == [0, 1]


# --------------------------------------------------------------------------------- numbers that are none


@pytest.mark.parametrize("device", [7, 8, 99, 255])
async def test_an_autopilot_speaks_for_six_cameras(device: int) -> None:
    async with a_flight() as (flight, _):
        vehicle = flight.vehicle
        assert vehicle.cameras.latest is None
        say(flight, feedback(1, cam_idx=device - 1))
        await anyio.sleep(3.0)
        assert vehicle.cameras.latest is None
        assert vehicle.camera.number is None
        say(flight, m.Heartbeat(30, 8, 0, 0, 4, 3), 100)
        assert vehicle.cameras.value == (100,)
        assert vehicle.camera.number == 100


@pytest.mark.parametrize("component_id", [0, 2])
async def test_a_component_that_cannot_be_named_is_not_taken_for_another(component_id: int) -> None:
    async with a_flight() as (flight, told):
        say(flight, image(0), component_id)
        say(flight, m.Heartbeat(30, 8, 0, 0, 4, 3), component_id)
        await anyio.sleep(3.0)
        assert flight.vehicle.cameras.latest is None
        assert told == []


# ------------------------------------------------------------------------------------ one camera, one picture


async def test_a_camera_is_the_same_object_before_and_after_it_is_heard() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        named = vehicle.camera_at(100)
        camera.faults.silent = False
        await anyio.sleep(3.0)
        assert vehicle.camera_at(100) is named
        assert vehicle.camera is named
        told: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, told.append)
        await named.take_photo()
        await anyio.sleep(1.0)
        assert len(told) == 1


async def test_both_are_kept_if_somebody_has_the_first_already() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        named, first = vehicle.camera_at(100), vehicle.camera
        camera.faults.silent = False
        await anyio.sleep(3.0)
        assert (vehicle.camera_at(100), vehicle.camera) == (named, first)


async def test_a_picture_that_px4_tells_of_twice_is_one() -> None:
    async with open_px4() as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        camera = vehicle.camera_at(1)
        told: list[ImageCaptured] = []
        vehicle.connection.bus.attach_event(ImageCaptured, told.append)
        say(flight, m.CameraTrigger(10, 5))
        await anyio.sleep(0.5)
        say(flight, image(5))
        await anyio.sleep(0.5)
        assert [each.index for each in told] == [5]
        (capture,) = camera.captures()
        assert capture.success is True  # the better of both
        assert camera.capture.value == capture


# --------------------------------------------------------------------------------------- files and values


async def test_addresses_of_pictures_are_those_of_components() -> None:
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
            with pytest.raises(NotSupported, match="nothing was sent"):
                await vehicle.camera.read_picture(capture.replace(file_url=url))


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, math.nan])
async def test_angles_that_are_no_numbers_are_not_told(
    wrong: float, caplog: pytest.LogCaptureFixture
) -> None:
    async with a_flight() as (flight, told):
        camera = flight.vehicle.camera_at(1)
        say(flight, feedback(1, roll=wrong))
        say(flight, m.CameraFeedback(0, 1, 0, 2, LATITUDE, LONGITUDE, wrong, wrong, 0, wrong, wrong, 0, 0))
        first, second = camera.captures()
        assert (first.quaternion, first.roll_deg, first.pitch_deg, first.yaw_deg) == (None, None, 0.0, 0.0)
        assert (second.quaternion, second.pitch_deg, second.yaw_deg) == (None, None, None)
        assert second.place is not None
        assert (second.place.altitude_amsl_m, second.place.altitude_relative_m) == (None, None)
        assert len(told) == 2
    assert "raised" not in caplog.text


@pytest.mark.parametrize("utc", [2**63, 2**64 - 1, 253_402_300_800_000_000])
async def test_a_time_that_no_calendar_holds_is_none(utc: int) -> None:
    async with a_flight() as (flight, _):
        camera = flight.vehicle.camera_at(100)
        say(flight, image(1, utc=utc), 100)
        (capture,) = camera.captures()
        assert capture.taken_at is None
    for taken_at in (math.inf, math.nan, 1e300, -1.0):
        assert captures_csv([capture.replace(taken_at=taken_at)]) == captures_csv([capture])


# ------------------------------------------------------------------------------------------- questions


async def test_not_now_is_not_never() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(MavCmd.REQUEST_MESSAGE, MavResult.TEMPORARILY_REJECTED, times=1)
        await vehicle.camera.status.wait_until(lambda _: True, timeout=20)


@pytest.mark.parametrize("who", ["camera", "vehicle"])
async def test_never_ends_with_a_reboot(who: str) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(MavCmd.REQUEST_MESSAGE, MavResult.UNSUPPORTED, times=1)
        camera.faults.refuse(MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, MavResult.UNSUPPORTED, times=1)
        with pytest.raises(OperationTimeout):
            await vehicle.camera.status.wait_until(lambda _: True, timeout=20)
        if who == "camera":
            camera.faults.silent = True
            await anyio.sleep(30)
            camera.faults.silent = False
        else:
            await vehicle.reboot()
        await vehicle.camera.status.wait_until(lambda _: True, timeout=60)


async def test_a_camera_that_was_silent_is_asked_anew_what_it_is() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        assert (await vehicle.camera.wait_found()).model == "Simulated camera"
        heard = commands_to(camera, int(MavCmd.REQUEST_MESSAGE))
        await anyio.sleep(20)
        assert heard == []
        camera.capabilities, camera.model = int(CameraCapFlags.CAPTURE_VIDEO), "another camera"
        camera.faults.silent = True
        await anyio.sleep(30)
        camera.faults.silent = False
        await anyio.sleep(5)
        assert vehicle.camera.information.value.model == "another camera"
        assert (await vehicle.camera.wait_found()).model == "another camera"
        assert len(heard) == 1
        with pytest.raises(NotSupported):
            await vehicle.camera.take_photo()


# --------------------------------------------------------------------------------------------- without end


async def test_a_series_that_is_not_read_keeps_little() -> None:
    camera = SimulatedCamera()
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=(camera,))) as flight:
        await anyio.sleep(1.5)
        async with flight.vehicle.camera.photo_interval(1.0) as series:
            await anext(series)
            for _ in range(100):
                say(flight, image(5), 100)
            assert len(series._arrivals._came) == 1
            for index in range(5, 20_200):
                say(flight, image(index), 100)
            assert len(series._arrivals._came) == 20_000


class _Many(list[m.CameraImageCaptured]):
    """As if so many had been taken."""

    how_many = 0

    def __len__(self) -> int:
        return type(self).how_many


async def test_a_count_without_end_is_not_loaded_without_end() -> None:
    camera = SimulatedCamera()
    _Many.how_many = 2_000_000_000
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.captures.images = _Many()
        heard = commands_to(camera, int(MavCmd.REQUEST_MESSAGE))
        began = anyio.current_time()
        assert await vehicle.camera.load_captures(timeout=5.0) == []  # three on end that it does not have
        assert anyio.current_time() - began < 6
        assert {each[2] for each in heard} <= {0, *range(1_999_980_000, 2_000_000_000)}


# --------------------------------------------------------------------------------------- on the command line


def names(directory: Path) -> list[str]:
    return sorted(each.name for each in directory.iterdir())


async def test_files_are_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        capture = await vehicle.camera.take_photo()
        camera.files.put("/DCIM/101/IMG_0001.JPG", b"another")
        other = capture.replace(file_url="mftp:///DCIM/101/IMG_0001.JPG")
        options = Namespace(to=tmp_path, json=False)
        for each in (capture, other, other.replace(index=1)):
            assert await _show(options, vehicle.camera, each)
        assert names(tmp_path) == [
            "00000-IMG_0001-2.JPG",
            "00000-IMG_0001.JPG",
            "00001-IMG_0001.JPG",
        ]
        assert (tmp_path / "00000-IMG_0001-2.JPG").read_bytes() == b"another"
        assert (tmp_path / "00000-IMG_0001.JPG").read_bytes() != b"another"
        capsys.readouterr()
        assert not await _show(options, vehicle.camera, capture.replace(file_url="mftp:///a/..%2Fb\x1b[2J"))
        assert "\x1b" not in capsys.readouterr().out
        assert len(names(tmp_path)) == 3


@pytest.mark.parametrize("base", ["..", ".", "a%2Fb", "a\\b", "C:a", "%00", "a%0A", "x" * 201])
async def test_what_is_no_name_is_refused(base: str) -> None:
    nothing = Capture(100, 3, True, 0.0, None, None, None, None, None, None, "")
    assert _file_name(nothing.replace(file_url=f"mftp:///DCIM/{base}")) is None
    assert _file_name(nothing) == "00003-capture.jpg"


async def test_a_model_cannot_write_to_the_terminal() -> None:
    camera = SimulatedCamera(model="bad\x1b[2J\nmodel")
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        assert repr(vehicle.camera).isprintable()
        assert isinstance(vehicle, aerokit.Vehicle)
        with pytest.raises(AerokitError) as caught:
            await vehicle.camera.track_point(0.5, 0.5)
        assert str(caught.value).isprintable()
