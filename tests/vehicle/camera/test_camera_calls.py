"""Camera calls except photos: video, status, storage, zoom and focus, tracking, streams, temperatures."""

from __future__ import annotations

import asyncio
from typing import Any

import anyio
import pytest
from camera_stage import commands_to, on_board

from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    FileError,
    InvalidArgument,
    NotSupported,
    OperationTimeout,
)
from aerokit.mavlink.enums import CameraCapFlags, MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal
from aerokit.sim.components.captures import GREY_JPEG
from aerokit.sim.faults import CommandFault
from aerokit.vehicle.camera.controls import AutoFocus

pytestmark = pytest.mark.anyio

ALL = SimulatedCamera.ALL_CAPABILITIES
URIS = ("rtsp://10.0.0.1/wide", "rtsp://10.0.0.1/tele", "rtsp://10.0.0.1/warm")
BOTH = CameraCapFlags.CAPTURE_IMAGE | CameraCapFlags.CAPTURE_VIDEO
REQUEST = int(MavCmd.REQUEST_MESSAGE)


def recording(camera: SimulatedCamera) -> bool:
    return camera.captures.is_recording


# ---------------------------------------------------------------------------------------------- video


async def test_video_recording_is_reported() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        assert vehicle.camera.mode.value == "video"
        await vehicle.camera.start_video()
        assert recording(camera)
        status = await vehicle.camera.status.wait_until(lambda reported: (reported.recording_s or 0) >= 3, timeout=5)
        assert status.is_recording
        assert status.available_mib == pytest.approx(8192.0)
        await vehicle.camera.stop_video()
        assert not recording(camera)
        assert not vehicle.camera.status.value.is_recording
        assert vehicle.camera.status.value.recording_s is None


async def test_video_block_cancelled_stops_recording() -> None:
    camera = SimulatedCamera(capabilities=BOTH)
    async with on_board(camera) as vehicle:
        async with vehicle.camera.video():
            await anyio.sleep(1.0)
            assert recording(camera)
        assert not recording(camera)

        async def film() -> None:
            async with vehicle.camera.video(status_hz=0):
                await anyio.sleep(60.0)

        task = asyncio.create_task(film())
        await anyio.sleep(1.0)
        assert recording(camera)
        camera.faults.ignore(int(MavCmd.VIDEO_STOP_CAPTURE), times=1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await anyio.sleep(3.0)
        assert not recording(camera)


async def test_video_block_refused_stops_no_other_recording() -> None:
    camera = SimulatedCamera(capabilities=BOTH)
    stop = int(MavCmd.VIDEO_STOP_CAPTURE)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.captures.record(0.0)
        commands = commands_to(camera, stop)
        with pytest.raises(CommandRejected):
            async with vehicle.camera.video():
                pass
        await anyio.sleep(3.0)
        assert commands == []
        assert recording(camera)


async def test_video_block_cancelled_before_discovery_leaves_nothing() -> None:
    camera = SimulatedCamera(capabilities=BOTH)
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.0) as vehicle:
        for block in (vehicle.camera.video, lambda: vehicle.camera.photo_interval(1.0)):
            with anyio.move_on_after(0.5) as scope:
                async with block():
                    pass
            assert scope.cancelled_caught
        camera.faults.silent = False
        assert (await vehicle.camera.wait_found()).number == 100
        assert not recording(camera)


async def test_start_video_is_not_sent_twice() -> None:
    camera = SimulatedCamera(capabilities=BOTH)
    start = int(MavCmd.VIDEO_START_CAPTURE)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, start)
        camera.faults.lose_ack(start)
        await vehicle.camera.start_video()
        assert len(commands) == 1
        await vehicle.camera.stop_video()
        camera.faults.ignore(start, times=1)
        await vehicle.camera.start_video()
        assert len(commands) == 3
        assert recording(camera)


async def test_start_video_without_capability_is_not_supported() -> None:
    camera = SimulatedCamera(capabilities=CameraCapFlags.CAPTURE_IMAGE)
    async with on_board(camera, SimulatedCamera(101)) as vehicle:
        for call in (vehicle.camera_at(100).start_video, vehicle.camera_at(100).stop_video):
            with pytest.raises(NotSupported, match="does not have CAPTURE_VIDEO"):
                await call()
        with pytest.raises(CommandRejected) as refused:
            await vehicle.camera_at(101).start_video()  # in photo mode
        assert refused.value.result == MavResult.DENIED
        for hz in (-0.1, 10.1):
            with pytest.raises(InvalidArgument, match="status_hz"):
                vehicle.camera.video(status_hz=hz)


async def test_start_video_accepted_without_recording_times_out() -> None:
    camera = SimulatedCamera(capabilities=BOTH)
    async with on_board(camera) as vehicle:
        camera.captures.record = lambda status_interval_s: None  # type: ignore[method-assign]
        with pytest.raises(OperationTimeout, match="accepted the order, but did not report within 2 s that it records"):
            await vehicle.camera.start_video(timeout=2.0)


# ------------------------------------------------------------------------------------- status and storage


async def test_cells_are_polled_while_in_use() -> None:
    camera = SimulatedCamera(streams=URIS)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, REQUEST)
        await anyio.sleep(20.0)
        assert commands == []
        assert not vehicle.camera.status.is_known  # reading starts the polling
        await anyio.sleep(9.0)
        assert vehicle.camera.status.value.image_count == 0
        await anyio.sleep(30.0)
        asked = len(commands)
        assert 5 <= asked <= 12
        assert {command[1] for command in commands} == {m.CameraCaptureStatus.ID}
        await anyio.sleep(20.0)
        assert len(commands) == asked
        await vehicle.camera.storage.wait_until(bool, timeout=5)
        assert commands[-1][1] == m.StorageInformation.ID


async def test_unsupported_message_is_not_polled_again() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, REQUEST)
        with pytest.raises(OperationTimeout):
            await vehicle.camera.thermal_range.wait_until(lambda _: True, timeout=20)
        assert len(commands) == 1


async def test_storage_is_reported_and_formatted() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.take_photo()
        (medium,) = await vehicle.camera.load_storage()
        assert (medium.number, medium.count, medium.kind, medium.status) == (1, 1, "microsd", "ready")
        assert (medium.total_mib, medium.used_mib, medium.available_mib) == (8192.0, 5.0, 8187.0)
        reported: list[int | None] = []
        await vehicle.camera.format_storage(on_progress=reported.append)
        assert reported == [None, 25, 50, 75]
        assert vehicle.camera.storage.value[0].used_mib == 0.0
        assert vehicle.camera.captures() == []
        assert (await vehicle.camera.take_photo()).index == 0
        for wrong in (0, 256):
            with pytest.raises(InvalidArgument, match="number"):
                await vehicle.camera.format_storage(wrong)
        with pytest.raises(CommandRejected):
            await vehicle.camera.format_storage(2)
        camera.card.is_inserted = False
        (medium,) = await vehicle.camera.load_storage()
        assert (medium.status, medium.total_mib, medium.available_mib) == ("empty", None, None)


async def test_load_storage_returns_all_media() -> None:
    camera = SimulatedCamera()

    def storage(number: int) -> list[m.StorageInformation]:
        """A camera that is slow to report its second medium unless that one is requested."""
        (card,) = SimulatedCamera.storage(camera, 1)
        fields: dict[str, Any] = card.to_dict() | {"storage_count": 2, "storage_id": number or 1}
        return [m.StorageInformation(**fields)]

    camera.storage = storage  # type: ignore[method-assign]
    async with on_board(camera) as vehicle:
        assert [medium.number for medium in await vehicle.camera.load_storage()] == [1, 2]


async def test_unanswered_legacy_request_does_not_replace_standard_request() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(REQUEST, MavResult.FAILED, times=1)
        camera.faults.ignore(int(MavCmd.REQUEST_STORAGE_INFORMATION))
        with pytest.raises(OperationTimeout, match="reported no storage"):
            await vehicle.camera.load_storage()
        assert len(await vehicle.camera.load_storage()) == 1


async def test_format_storage_is_sent_once() -> None:
    camera = SimulatedCamera()
    command = int(MavCmd.STORAGE_FORMAT)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, command)
        camera.faults.ignore(command)
        with pytest.raises(CommandTimeout):
            await vehicle.camera.format_storage()
        assert len(commands) == 1


async def test_format_storage_without_progress_waits_for_answer() -> None:
    camera = SimulatedCamera()
    command = int(MavCmd.STORAGE_FORMAT)
    async with on_board(camera) as vehicle:
        camera.faults.commands[command] = CommandFault(refuse_with=MavResult.ACCEPTED, delay_s=20.0)
        await vehicle.camera.format_storage()
        with pytest.raises(CommandTimeout):
            await vehicle.camera.format_storage(timeout=10.0)


async def test_reset_settings_restores_factory_values() -> None:
    camera = SimulatedCamera(capabilities=ALL)
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("survey")
        await vehicle.camera.zoom_to(40.0)
        assert vehicle.camera.zoom_percent.value == 40.0
        await vehicle.camera.reset_settings()
        assert (vehicle.camera.mode.value, vehicle.camera.zoom_percent.value) == ("photo", 0.0)


async def test_set_mode_without_report_times_out() -> None:
    camera = SimulatedCamera()
    async with on_board(camera, SimulatedCamera(101, capabilities=CameraCapFlags.CAPTURE_IMAGE)) as vehicle:
        with pytest.raises(NotSupported, match="does not have HAS_MODES"):
            await vehicle.camera_at(101).set_mode("video")
        with pytest.raises(CommandRejected):
            await vehicle.camera_at(100).set_mode("survey")
        camera.faults.ignore(REQUEST)
        camera.faults.lose(m.CameraSettings, times=100)
        await_mode = vehicle.camera_at(100).set_mode("video", timeout=3.0)
        with pytest.raises(OperationTimeout):
            await await_mode


async def test_read_picture_returns_the_file() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        capture = await vehicle.camera.take_photo()
        assert capture.file_url == "mftp:///DCIM/IMG_0001.JPG"
        assert await vehicle.camera.read_picture(capture) == GREY_JPEG
        with pytest.raises(FileError):
            await vehicle.camera.read_picture(capture.replace(file_url="mftp:///DCIM/IMG_0009.JPG"))
        for url in ("", "http://10.0.0.1/IMG_0001.JPG"):
            with pytest.raises(NotSupported, match=r"is not a MAVFTP URL|has no URL"):
                await vehicle.camera.read_picture(capture.replace(file_url=url))


# ----------------------------------------------------------------------------------------- zoom and focus


async def test_zoom_by_step_value_and_block() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.zoom_step(2)
        assert camera.zoom == 20.0
        await vehicle.camera.zoom_step(-1)
        assert camera.zoom == vehicle.camera.zoom_percent.value == 10.0
        await vehicle.camera.zoom_to_focal_length(45.0)
        assert camera.zoom == pytest.approx(100.0)
        async with vehicle.camera.zooming(-0.5):
            await anyio.sleep(3.0)
        stopped_at = camera.zoom
        assert stopped_at == pytest.approx(70.0, abs=1.0)
        await anyio.sleep(2.0)
        assert camera.zoom == stopped_at
        for percent in (-0.1, 100.1):
            with pytest.raises(InvalidArgument, match="percent"):
                await vehicle.camera.zoom_to(percent)
        with pytest.raises(InvalidArgument, match="millimetres"):
            await vehicle.camera.zoom_to_focal_length(0.0)
        with pytest.raises(CommandRejected):
            await vehicle.camera.zoom_to_focal_length(1000.0)
        with pytest.raises(InvalidArgument, match="speed"):
            vehicle.camera.zooming(1.1)


async def test_focus_by_step_value_auto_and_block() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.focus_step(3)
        assert camera.focus == vehicle.camera.focus_percent.value == 30.0
        await vehicle.camera.focus_to(80.0)
        assert camera.focus == 80.0
        await vehicle.camera.focus_at(10.0)
        assert camera.focus == 50.0
        async with vehicle.camera.focusing():
            await anyio.sleep(1.0)
        assert camera.focus == pytest.approx(70.0, abs=1.0)
        kinds: tuple[AutoFocus, ...] = ("auto", "single", "continuous")
        for kind in kinds:
            await vehicle.camera.focus_to(10.0)
            await vehicle.camera.auto_focus(kind)
            assert camera.focus == 50.0
        with pytest.raises(InvalidArgument, match="kind"):
            await vehicle.camera.auto_focus("never")  # type: ignore[arg-type]


async def test_zoom_step_is_sent_once() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.lose_ack(int(MavCmd.SET_CAMERA_ZOOM))
        with pytest.raises(CommandTimeout):
            await vehicle.camera.zoom_step(1)
        assert camera.zoom == 10.0
        camera.faults.lose_ack(int(MavCmd.SET_CAMERA_ZOOM))
        await vehicle.camera.zoom_to(60.0)
        assert camera.zoom == 60.0


async def test_lens_calls_without_capability_send_nothing() -> None:
    camera = SimulatedCamera(capabilities=CameraCapFlags.CAPTURE_IMAGE)
    async with on_board(camera) as vehicle:
        one = vehicle.camera
        await one.wait_found()
        commands = commands_to(camera)
        calls = (
            lambda: one.zoom_step(1),
            lambda: one.zoom_to(1),
            lambda: one.focus_step(1),
            lambda: one.focus_to(1),
            lambda: one.focus_at(1),
            one.auto_focus,
            lambda: one.track_point(0.5, 0.5),
            lambda: one.track_rectangle(0.1, 0.1, 0.2, 0.2),
            one.stop_tracking,
            one.start_streaming,
            one.stop_streaming,
            one.load_streams,
        )
        for call in calls:
            with pytest.raises(NotSupported):
                await call()
        with pytest.raises(NotSupported):
            async with one.zooming():
                pass
        assert commands == []


# ----------------------------------------------------------------------------------------------- tracking


async def test_track_point_reports_until_lost() -> None:
    camera = SimulatedCamera(capabilities=ALL)
    async with on_board(camera) as vehicle:
        one = vehicle.camera
        await one.track_point(0.25, 0.75, radius=0.1)
        status = await one.tracking.wait_until(lambda reported: reported.is_active, timeout=2)
        assert (status.mode, status.point, status.rectangle) == ("point", (0.25, 0.75), None)
        assert status.radius == pytest.approx(0.1)
        camera.tracking.lose()
        status = await one.tracking.wait_until(lambda reported: reported.has_failed, timeout=2)
        assert not status.is_active
        await one.track_rectangle(0.25, 0.25, 0.5, 0.75, status_hz=10)
        status = await one.tracking.wait_until(lambda reported: reported.mode == "rectangle", timeout=2)
        assert (status.rectangle, status.point, status.is_active) == ((0.25, 0.25, 0.5, 0.75), None, True)
        await one.stop_tracking()
        await anyio.sleep(1.0)
        updated_at = one.tracking.updated_at
        await anyio.sleep(3.0)
        assert one.tracking.updated_at == updated_at, "no more requests"


async def test_tracked_position_on_earth_is_reported() -> None:
    gimbal = SimulatedGimbal()
    camera = SimulatedCamera(capabilities=ALL, gimbal=gimbal)
    copter = SimulatedCopter(boot_time_s=0.0, components=[camera, gimbal])
    async with on_board(vehicle=copter) as vehicle:
        gimbal.point((0.0, -0.7854, 0.0), 0, locked=True)
        copter.motion.down = -50.0
        await vehicle.camera.track_point(0.5, 0.5)
        reported = await vehicle.camera.tracked_place.wait_until(
            lambda reported: reported.place is not None and (reported.distance_m or 0) < 80, timeout=5
        )
        assert reported.is_active
        assert reported.place is not None
        assert reported.horizontal_accuracy_m == 1.0
        assert reported.heading_deg is None


async def test_tracking_outside_the_image_is_refused() -> None:
    async with on_board(SimulatedCamera(capabilities=ALL)) as vehicle:
        one = vehicle.camera
        for x, y, radius in ((-0.1, 0.5, 0), (0.5, 1.1, 0), (0.5, 0.5, 2)):
            with pytest.raises(InvalidArgument, match="is not allowed: it must be 0 to 1"):
                await one.track_point(x, y, radius=radius)
        with pytest.raises(InvalidArgument, match="left must be less than right"):
            await one.track_rectangle(0.5, 0.1, 0.4, 0.2)
        with pytest.raises(InvalidArgument, match="left must be less than right"):
            await one.track_rectangle(0.1, 0.3, 0.4, 0.2)
        with pytest.raises(InvalidArgument, match="status_hz"):
            await one.track_point(0.5, 0.5, status_hz=0)


# ------------------------------------------------------------------------------------ streams, temperatures


async def test_streams_are_listed_and_selected() -> None:
    camera = SimulatedCamera(streams=URIS, thermal_celsius=(-5.0, 80.0))
    async with on_board(camera) as vehicle:
        streams = await vehicle.camera.load_streams()
        assert [(stream.number, stream.count, stream.uri) for stream in streams] == [
            (number, 3, uri) for number, uri in enumerate(URIS, start=1)
        ]
        first, _, warm = streams
        assert (first.kind, first.encoding, first.width_px, first.height_px) == ("rtsp", "h264", 1920, 1080)
        assert (first.frames_per_s, first.bitrate, first.is_running) == (30.0, 4_000_000, True)
        assert (first.is_thermal, warm.is_thermal, warm.has_thermal_range) == (False, True, True)
        await vehicle.camera.select_stream(2)
        assert camera.running_streams == {2}
        reported = await vehicle.camera.streams.wait_until(
            lambda reported: [event.is_running for event in reported] == [False, True, False], timeout=7
        )
        assert len(reported) == 3
        await vehicle.camera.stop_streaming()
        assert camera.running_streams == set()
        await vehicle.camera.start_streaming(3)
        assert camera.running_streams == {3}
        with pytest.raises(CommandRejected):
            await vehicle.camera.start_streaming(4)
        with pytest.raises(InvalidArgument, match="stream"):
            await vehicle.camera.start_streaming(256)
        with pytest.raises(InvalidArgument, match="stream"):
            await vehicle.camera.select_stream(0)


async def test_lost_stream_information_is_requested_by_number() -> None:
    camera = SimulatedCamera(streams=URIS)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.lose(m.VideoStreamInformation, times=2)
        assert len(await vehicle.camera.load_streams()) == 3


async def test_load_streams_requests_known_streams_again() -> None:
    camera = SimulatedCamera(streams=URIS)
    async with on_board(camera) as vehicle:
        await vehicle.camera.load_streams()
        camera.running_streams.discard(1)  # another station has stopped it
        camera.faults.lose(m.VideoStreamInformation, times=1)
        assert [stream.is_running for stream in await vehicle.camera.load_streams()] == [False, True, True]


async def test_select_missing_stream_stops_no_other() -> None:
    camera = SimulatedCamera(streams=URIS)
    async with on_board(camera) as vehicle:
        with pytest.raises(CommandRejected):
            await vehicle.camera.select_stream(4)
        assert camera.running_streams == {1, 2, 3}


async def test_thermal_range_is_reported_and_source_selected() -> None:
    camera = SimulatedCamera(streams=URIS, thermal_celsius=(-5.0, 80.0))
    async with on_board(camera, SimulatedCamera(101)) as vehicle:
        one = vehicle.camera_at(100)
        reported = await one.thermal_range.wait_until(lambda _: True, timeout=5)
        assert (reported.stream, reported.min_celsius, reported.max_celsius) == (3, -5.0, 80.0)
        assert (reported.min_at, reported.max_at) == ((0.0, 0.0), (1.0, 1.0))
        await one.select_source("ir")
        assert camera.source == 2
        with pytest.raises(CommandRejected):
            await vehicle.camera_at(101).select_source("ir")
        with pytest.raises(InvalidArgument, match="primary"):
            await one.select_source("x")  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------- legacy cameras


def legacy_camera(camera: SimulatedCamera) -> None:
    """Like MAVSDK's camera server, which supports REQUEST_MESSAGE for CAMERA_INFORMATION only."""
    known = camera.commands

    def answer(command: Any) -> int:
        if command.param1 == m.CameraInformation.ID:
            return camera.answer_with(m.CameraInformation.ID, command)
        return MavResult.UNSUPPORTED

    camera.commands = lambda: {**known(), MavCmd.REQUEST_MESSAGE: answer}  # type: ignore[method-assign]


async def test_legacy_camera_gets_legacy_requests() -> None:
    camera = SimulatedCamera(streams=URIS)
    legacy_camera(camera)
    async with on_board(camera) as vehicle:
        assert (await vehicle.camera.take_photo()).index == 0
        camera.faults.lose(m.CameraImageCaptured, times=1)
        assert (await vehicle.camera.take_photo()).index == 1
        await vehicle.camera.set_mode("video")
        async with vehicle.camera.video():
            assert recording(camera)
        assert not recording(camera)
        assert (await vehicle.camera.load_storage())[0].kind == "microsd"
        assert len(await vehicle.camera.load_streams()) == 3
        assert (await vehicle.camera.status.wait_until(lambda _: True, timeout=5)).image_count == 2
        commands = commands_to(camera, REQUEST)
        await vehicle.camera.load_storage()
        assert commands == [], "unknown messages are not requested again"


async def test_set_mode_without_settings_message_trusts_the_ack() -> None:
    camera = SimulatedCamera()
    builders = camera.builders
    camera.builders = lambda: {  # type: ignore[method-assign]
        message_id: builder for message_id, builder in builders().items() if message_id != m.CameraSettings.ID
    }
    async with on_board(camera) as vehicle:
        camera.faults.lose(m.CameraSettings, times=100)
        began = vehicle.connection.now()
        await vehicle.camera.set_mode("video")
        assert camera.mode == 1
        assert vehicle.connection.now() - began < 1.0
        assert not vehicle.camera.mode.is_known
