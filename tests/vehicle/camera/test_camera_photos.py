"""Photos: one order takes one picture, captures are not missed, and a series ends with its block."""

from __future__ import annotations

import asyncio
import contextlib

import anyio
import pytest
from camera_stage import commands_to, on_board, px4
from flight_harness import open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import ImageCaptured
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CameraCapFlags, MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

START, STOP = int(MavCmd.IMAGE_START_CAPTURE), int(MavCmd.IMAGE_STOP_CAPTURE)
STATUS = int(m.CameraCaptureStatus.ID)


async def test_take_photo_returns_time_position_and_attitude() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        with vehicle.subscribe(ImageCaptured, capacity=10) as events:
            capture = await vehicle.camera.take_photo()
            event = await events.get()
        assert (capture.camera, capture.index, capture.success) == (100, 0, True)
        assert capture.taken_at is not None
        assert capture.taken_at > 1.7e9
        copter = camera.vehicle
        assert isinstance(copter, SimulatedCopter)
        assert capture.place is not None
        assert capture.place.latitude_deg == pytest.approx(copter.frame.origin.latitude_e7 / 1e7, abs=1e-6)
        assert capture.roll_deg == pytest.approx(0, abs=1)
        assert capture.quaternion is not None
        assert (event.camera, event.index, event.success, event.component_id) == (100, 0, True, 100)
        assert event.place == capture.place
        assert vehicle.camera.capture.value == capture
        assert vehicle.camera.captures() == [capture]
        assert (await vehicle.camera.take_photo()).index == 1
        assert camera.image_count == 2


async def test_cameras_are_discovered_by_their_messages() -> None:
    async with on_board(SimulatedCamera(101), SimulatedCamera(model="Second")) as vehicle:
        assert vehicle.cameras.value == (100, 101)
        assert vehicle.camera.number in (100, 101)
        assert vehicle.camera is vehicle.camera_at(vehicle.camera.number)
        information = await vehicle.camera_at(100).wait_found()
        assert (information.number, information.model, information.vendor) == (100, "Second", "aerokit")
        assert information.firmware == "0.0.0.1"
        assert (information.width_px, information.height_px) == (4000, 3000)
        assert information.focal_length_mm == pytest.approx(4.5)
        assert information.capabilities == {
            "capture_image", "capture_video", "has_modes", "has_basic_zoom", "has_basic_focus",
        }  # fmt: skip
        assert vehicle.camera_at(100).information.value == information
        assert "100 (aerokit Second)" in repr(vehicle.camera_at(100))
        for wrong in (0, 256):
            with pytest.raises(InvalidArgument, match=f"number = {wrong} is not allowed"):
                vehicle.camera_at(wrong)


async def test_call_waits_for_camera_discovery() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        assert vehicle.camera.number is None
        assert vehicle.cameras.latest is None
        camera.call_later(1.0, lambda: setattr(camera.faults, "silent", False))
        assert (await vehicle.camera.take_photo()).camera == 100


async def test_unsupported_calls_are_refused_before_sending() -> None:
    camera = SimulatedCamera(capabilities=CameraCapFlags.CAPTURE_VIDEO)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera)
        with pytest.raises(NotSupported, match="does not have CAPTURE_IMAGE; nothing was sent"):
            await vehicle.camera.take_photo()
        with pytest.raises(NotSupported, match="photo_interval: camera 100"):
            async with vehicle.camera.photo_interval(1.0):
                pass
        assert commands == []
        for seconds, count in ((0.0, 1), (3601.0, 1), (1.0, -1), (1.0, 32768)):
            with pytest.raises(InvalidArgument):
                vehicle.camera.photo_interval(seconds, count)


@pytest.mark.parametrize("lost", [1, 2])
async def test_lost_photo_order_is_resent_on_evidence(lost: int) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, START)
        camera.faults.ignore(START, times=lost)
        capture = await vehicle.camera.take_photo()
        assert (capture.index, camera.image_count) == (0, 1)
        assert len(commands) == lost + 1
        assert len({command[4] for command in commands}) == 1, "the sequence number of the order is kept"


async def test_photo_order_with_lost_ack_is_not_resent() -> None:
    camera = SimulatedCamera(shutter_s=3.0)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, START)
        camera.faults.lose_ack(START)
        assert (await vehicle.camera.take_photo()).index == 0
        assert len(commands) == camera.image_count == 1


async def test_older_photo_order_with_lost_ack_returns_the_capture() -> None:
    camera = SimulatedCamera(shutter_s=3.0)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.refuse(START, MavResult.UNSUPPORTED)
        camera.faults.lose_ack(MavCmd.DO_DIGICAM_CONTROL)
        assert (await vehicle.camera.take_photo()).index == 0
        assert camera.image_count == 1


async def test_photo_timeout_before_acknowledgement_is_reported() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.ignore(START)
        with pytest.raises(CommandTimeout, match=r"did not acknowledge the order for a picture within 0\.2 s"):
            await vehicle.camera.take_photo(timeout=0.2)


async def test_photo_order_without_evidence_is_not_resent() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, START)
        camera.faults.ignore(START, times=10)
        camera.faults.ignore(int(MavCmd.REQUEST_MESSAGE), times=1000)
        with pytest.raises(CommandTimeout, match="IMAGE_START_CAPTURE"):
            await vehicle.camera.take_photo(timeout=8.0)
        assert len(commands) == 1


async def test_lost_capture_message_is_requested() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.take_photo()
        camera.faults.lose(m.CameraImageCaptured, times=1)
        capture = await vehicle.camera.take_photo()
        assert (capture.index, capture.success) == (1, True)
        assert camera.image_count == 2


async def test_failed_photo_raises_operation_rejected() -> None:
    camera = SimulatedCamera(capacity_mib=12.0)
    async with on_board(camera) as vehicle:
        for _ in range(2):
            await vehicle.camera.take_photo()
        with pytest.raises(CommandRejected) as refused:
            await vehicle.camera.take_photo()
        assert refused.value.result == MavResult.FAILED
        camera.card.used_mib = 6.0

        def fill() -> None:
            camera.card.used_mib = 12.0

        camera.call_later(0.1, fill)
        with pytest.raises(OperationRejected, match=r"camera 100 .* could not take the picture"):
            await vehicle.camera.take_photo()


async def test_concurrent_take_photo_takes_two_pictures() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        found = []

        async def take() -> None:
            found.append((await vehicle.camera.take_photo()).index)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(take)
            tasks.start_soon(take)
        assert sorted(found) == [0, 1]
        assert camera.image_count == 2


# ------------------------------------------------------------------------------------------ series


async def test_series_yields_captures_in_order_and_ends() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, START, STOP)
        async with vehicle.camera.photo_interval(1.0, count=4) as captures:
            found = [capture.index async for capture in captures]
        assert found == [0, 1, 2, 3]
        assert captures.missed == 0
        assert commands == [(START, 0.0, 1.0, 4.0, 0.0)]
        assert [capture.index for capture in vehicle.camera.captures()] == found


async def test_series_requests_missing_captures() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        async with vehicle.camera.photo_interval(1.0, count=8) as captures:
            found = []
            async for capture in captures:
                found.append(capture.index)
                if capture.index in (1, 5):
                    camera.faults.lose(m.CameraImageCaptured, times=2)
        assert found == list(range(8))
        assert captures.missed == 0


async def test_busy_camera_is_asked_again_for_a_capture() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.lose(m.CameraImageCaptured, times=1)
        await vehicle.component(100).command(START, 0, 0, 1, 1)
        await anyio.sleep(2)
        camera.faults.refuse(int(MavCmd.REQUEST_MESSAGE), MavResult.TEMPORARILY_REJECTED, times=2)
        capture = await vehicle.camera._log.fetch(0)
        assert capture is not None


async def test_series_with_corrupt_start_misses_nothing() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.lose(m.CameraCaptureStatus, times=1000)
        async with vehicle.camera.photo_interval(1.0) as captures:
            camera.send(m.CameraImageCaptured(0, 0, 1, 0, 0, 0, 0, (1, 0, 0, 0), 5000, 1, ""))
            await anyio.sleep(2.5)
            assert [(await anext(captures)).index for _ in range(6)] == list(range(6))
        assert captures.missed == 0


async def test_requested_capture_is_dropped_if_series_starts_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        async with vehicle.camera.photo_interval(60.0) as captures:
            first = await anext(captures)

            async def fetch(_: int) -> object:
                captures._next_index = 7  # as `_process_new_captures` does when the camera has restarted
                return first

            monkeypatch.setattr(captures._log, "fetch", fetch)
            await captures._fetch_next()
        assert captures._received == {}
        assert captures._next_index == 7


async def test_series_block_end_stops_the_series() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        async with vehicle.camera.photo_interval(0.5) as captures:
            async for capture in captures:
                if capture.index == 2:
                    break
        taken = camera.image_count
        await anyio.sleep(3.0)
        assert camera.image_count <= taken + 1 <= 5
        assert not camera.captures.is_busy


async def test_series_cancelled_with_lost_stop_still_ends() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()

        async def survey() -> None:
            async with vehicle.camera.photo_interval(0.5) as captures:
                async for _ in captures:
                    pass

        task = asyncio.create_task(survey())
        await anyio.sleep(2.0)
        commands = commands_to(camera, STOP)
        camera.faults.ignore(STOP, times=1)
        task.cancel()
        began = vehicle.connection.now()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert vehicle.connection.now() - began < 0.1
        await anyio.sleep(4.0)
        assert len(commands) == 2
        assert not camera.captures.is_busy


async def test_series_ended_by_camera_is_rejected() -> None:
    camera = SimulatedCamera(capacity_mib=12.0)
    async with on_board(camera) as vehicle:
        found = []
        with pytest.raises(OperationRejected, match="ended the series after 3 pictures"):
            async with vehicle.camera.photo_interval(0.5, count=6) as captures:
                async for capture in captures:
                    found.append(capture.success)
        assert found == [True, True, False]


async def test_silent_camera_ends_the_series_wait() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        with pytest.raises(OperationTimeout, match="reports no more pictures"):
            async with vehicle.camera.photo_interval(0.5) as captures:
                async for capture in captures:
                    camera.faults.silent = capture.index == 2


async def test_lost_series_order_is_resent() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        camera.faults.ignore(START, times=1)
        async with vehicle.camera.photo_interval(1.0, count=2) as captures:
            assert [capture.index async for capture in captures] == [0, 1]
        camera.faults.lose_ack(START)
        commands = commands_to(camera, START)
        async with vehicle.camera.photo_interval(2.0, count=2) as captures:
            assert [capture.index async for capture in captures] == [2, 3]
        assert len(commands) == 1


async def test_load_captures_requests_earlier_pictures() -> None:
    camera = SimulatedCamera()
    async with on_board(camera, settle_s=0.5) as vehicle:
        for _ in range(3):
            camera.captures.take()
            camera.faults.lose(m.CameraImageCaptured, times=1)
            await anyio.sleep(1.0)
        assert vehicle.camera.captures() == []
        assert [capture.index for capture in await vehicle.camera.load_captures()] == [0, 1, 2]


async def test_load_captures_survives_a_lost_status() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.take_photo()
        camera.faults.lose(m.CameraCaptureStatus, times=2)
        assert [capture.index for capture in await vehicle.camera.load_captures()] == [0]


async def test_load_captures_returns_those_that_camera_still_has() -> None:
    camera = SimulatedCamera()
    camera.max_images = 4
    async with on_board(camera, settle_s=0.5) as vehicle:
        camera.faults.lose(m.CameraImageCaptured, times=9)
        for _ in range(9):
            camera.captures.take()
            await anyio.sleep(1.0)
        assert [capture.index for capture in await vehicle.camera.load_captures()] == [5, 6, 7, 8]
        assert vehicle.camera.capture.value.index == 8


# ---------------------------------------------------------------------- cameras attached to the autopilot


async def test_ardupilot_camera_reports_by_camera_feedback() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["CAM1_TYPE"] = 1.0
    async with on_board(vehicle=copter) as vehicle:
        capture = await vehicle.camera.take_photo()
        assert (capture.camera, capture.index, capture.success) == (1, 0, True)
        assert vehicle.camera.number == 1
        assert capture.place is not None
        assert capture.place.altitude_relative_m == pytest.approx(0, abs=1)
        assert vehicle.cameras.value == (1,)
        await anyio.sleep(0.5)  # the shutter is busy
        copter.faults.lose(m.CameraFeedback, times=1)
        assert (await vehicle.camera.take_photo()).index == 1
        async with vehicle.camera.photo_interval(1.0, count=3) as captures:
            assert [capture.index async for capture in captures] == [2, 3, 4]
        async with vehicle.camera.photo_interval(0.5):
            await anyio.sleep(2.0)
        taken = copter.camera.image_count
        await anyio.sleep(2.0)
        assert copter.camera.image_count == taken


async def test_ardupilot_missed_captures_are_counted() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["CAM1_TYPE"] = 1.0
    async with on_board(vehicle=copter) as vehicle:
        async with vehicle.camera.photo_interval(1.0, count=6) as captures:
            found = []
            async for capture in captures:
                found.append(capture.index)
                if capture.index == 1:
                    copter.faults.lose(m.CameraFeedback, times=2)
        assert captures.missed == 6 - len(found) > 0
        assert found == sorted(found)


async def test_px4_trigger_takes_photos() -> None:
    simulated = px4()
    assert isinstance(simulated, SimulatedPx4)
    simulated.parameters["TRIG_MODE"] = 1.0
    async with on_board(vehicle=simulated) as vehicle:
        commands = commands_to(simulated, START, int(MavCmd.DO_DIGICAM_CONTROL))
        capture = await vehicle.camera.take_photo()
        assert (capture.camera, capture.index, capture.success) == (1, 0, True)
        assert capture.place is not None
        assert [command[0] for command in commands] == [MavCmd.DO_DIGICAM_CONTROL]
        async with vehicle.camera.photo_interval(1.0, count=3) as captures:
            found = [capture.index async for capture in captures]
        assert found == [capture.index + 1, capture.index + 2, capture.index + 3]
        with pytest.raises(NotSupported, match="is a trigger output, which only takes pictures; nothing was sent"):
            await vehicle.camera.zoom_to(10)
        with pytest.raises(OperationTimeout, match="did not identify itself;"):  # without waiting for the time-out
            await vehicle.camera.wait_found(timeout=4.0)
        assert not simulated.camera_trigger.is_running


async def test_camera_trigger_uses_the_vehicle_position() -> None:
    simulated = px4()
    simulated.parameters["TRIG_MODE"] = 1.0
    simulated.camera_trigger.sends_image_captured = False
    async with on_board(vehicle=simulated, settle_s=6.0) as vehicle:
        capture = await vehicle.camera.take_photo()
        assert (capture.index, capture.success, capture.taken_at) == (0, None, None)
        assert capture.place is not None
        assert capture.place.distance_to(vehicle.position.value) < 1
        assert capture.yaw_deg == pytest.approx(vehicle.attitude.value.yaw_deg % 360, abs=1)


async def test_camera_trigger_before_discovery_has_its_own_position() -> None:
    """The camera is known only 2.5 s after its first trigger, and the vehicle flies on meanwhile."""
    async with open_px4() as flight:
        await flight.vehicle.wait_ready()
        here, encoder = flight.vehicle.position.value, FrameEncoder(1, 1)
        triggered_at = anyio.current_time()
        flight.wire.deliver(encoder.encode(m.CameraTrigger(time_usec=1_700_000_000_000_000, seq=0)))
        flight.px4.faults.frozen = True
        latitude, longitude = round(here.latitude_deg * 1e7) + 10_000, round(here.longitude_deg * 1e7)
        for _ in range(30):
            await anyio.sleep(0.1)
            flight.wire.deliver(encoder.encode(m.GlobalPositionInt(0, latitude, longitude, 500_000, 9_000, 0, 0, 0, 0)))
        (capture,) = flight.vehicle.camera.captures()
        assert capture.place is not None
        assert capture.place.distance_to(here) < 1
        assert capture.received_at == triggered_at


async def test_camera_trigger_without_recent_position_has_no_place() -> None:
    simulated = px4()
    simulated.parameters["TRIG_MODE"] = 1.0
    simulated.camera_trigger.sends_image_captured = False
    async with on_board(vehicle=simulated, settle_s=6.0) as vehicle:
        for message_type in (m.GlobalPositionInt, m.Attitude, m.AttitudeQuaternion):
            simulated.faults.lost_messages[message_type.ID] = 10_000
        await anyio.sleep(3)
        capture = await vehicle.camera.take_photo()
        assert (capture.place, capture.yaw_deg) == (None, None)


async def test_vehicle_without_camera_rejects_take_photo() -> None:
    async with on_board() as vehicle:
        with pytest.raises(CommandRejected):
            await vehicle.camera.take_photo()
    async with on_board(vehicle=px4()) as vehicle:
        with pytest.raises(CommandTimeout, match="DO_DIGICAM_CONTROL"):
            await vehicle.camera.take_photo(timeout=3.0)


# ------------------------------------------------------------------------------------------ events


async def test_captures_are_published_without_using_a_camera() -> None:
    camera, other = SimulatedCamera(), SimulatedCamera(101)
    async with on_board(camera, other) as vehicle:
        with vehicle.subscribe(ImageCaptured, capacity=20) as events:
            for source in (camera, other, camera):
                source.captures.take()
                await anyio.sleep(1.0)
            reported = []
            while (event := events.get_nowait()) is not None:
                reported.append((event.camera, event.index, event.component_id))
        assert reported == [(100, 0, 100), (101, 0, 101), (100, 1, 100)]
        assert [capture.index for capture in vehicle.camera_at(101).captures()] == [0]


async def test_autopilot_camera_captures_are_published_once() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["CAM1_TYPE"] = 1.0
    async with on_board(vehicle=copter) as vehicle:
        with vehicle.subscribe(ImageCaptured, capacity=20) as events:
            for _ in range(3):
                copter.camera.take()
                await anyio.sleep(1.0)
            await anyio.sleep(2.0)
            assert vehicle.camera.number == 1
            copter.camera.take()
            await anyio.sleep(1.0)
            reported = []
            while (event := events.get_nowait()) is not None:
                reported.append((event.camera, event.index))
        assert reported == [(1, 0), (1, 1), (1, 2), (1, 3)]


async def test_camera_named_before_discovery_publishes_once() -> None:
    camera = SimulatedCamera()
    camera.faults.silent = True
    async with on_board(camera, settle_s=0.2) as vehicle:
        named, first = vehicle.camera_at(100), vehicle.camera
        camera.faults.silent = False
        await named.wait_found()
        await first.wait_found()
        with vehicle.subscribe(ImageCaptured, capacity=20) as events:
            await first.take_photo()
            assert (await events.get()).index == 0
            await anyio.sleep(1.0)
            assert events.get_nowait() is None
        assert named.captures() == first.captures()


# ------------------------------------------------------------------------------------------------ a bad radio


@pytest.mark.sampled(4)
@pytest.mark.parametrize("seed", range(8))
async def test_bad_radio_neither_repeats_nor_misses_photos(seed: int) -> None:
    camera = SimulatedCamera()
    copter = SimulatedCopter(boot_time_s=0.0, components=[camera], seed=seed)
    async with on_board(vehicle=copter) as vehicle:
        await vehicle.camera.take_photo()
        camera.faults.loss = camera.faults.loss_incoming = 0.3
        for number in range(1, 8):
            capture = await vehicle.camera.take_photo(timeout=60.0)
            assert (capture.index, camera.image_count) == (number, number + 1)
            await anyio.sleep(0.5)
        async with vehicle.camera.photo_interval(1.0, count=12) as captures:
            assert [capture.index async for capture in captures] == list(range(8, 20))
            assert captures.missed == 0
        assert camera.image_count == 20


@pytest.mark.parametrize("ended", ["connection", "vehicle"])
async def test_interval_ends_soon_after_connection_or_vehicle(ended: str) -> None:
    copter = SimulatedCopter(boot_time_s=0.0, components=[SimulatedCamera()])
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with contextlib.AsyncExitStack() as block:
            vehicle = await block.enter_async_context(aerokit.connect(connection))

            async def follow() -> None:
                async with vehicle.camera.photo_interval(60.0) as photos:
                    async for _ in photos:
                        pass

            following = asyncio.create_task(follow())
            await anyio.sleep(10.0)
            if ended == "connection":
                connection.close()
            else:
                await block.aclose()
            await asyncio.wait([following], timeout=0.1)
            assert following.done()
        with pytest.raises(ConnectionClosed):
            await following
