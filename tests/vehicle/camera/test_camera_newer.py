"""Orders to a camera: the newest of its subject counts, blocks end with the vehicle's, lies do not hold a series up."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import anyio
import pytest
from camera_stage import commands_to, on_board
from flight_harness import open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout, NotSupported
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CameraCapFlags, MavCmd, MavResult
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio

FAR = 300_000
START, STOP = int(MavCmd.IMAGE_START_CAPTURE), int(MavCmd.IMAGE_STOP_CAPTURE)
START_VIDEO, STOP_VIDEO = int(MavCmd.VIDEO_START_CAPTURE), int(MavCmd.VIDEO_STOP_CAPTURE)
ZOOM, FOCUS = int(MavCmd.SET_CAMERA_ZOOM), int(MavCmd.SET_CAMERA_FOCUS)


def picture(index: int) -> m.CameraImageCaptured:
    return m.CameraImageCaptured(0, 0, 1, 0, 0, 0, 0, (1, 0, 0, 0), index, 1, "")


# ------------------------------------------------------------------------------ indices that are lies


async def test_a_lie_of_an_index_holds_no_series_up() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        given: list[int] = []
        with anyio.fail_after(30):
            async with vehicle.camera.photo_interval(1.0) as captures:
                async for capture in captures:
                    given.append(capture.index)
                    if len(given) == 3:
                        camera.send(picture(FAR))
                    if len(given) == 10:
                        break
        assert given == list(range(10))
        assert captures.missed == 0


@pytest.mark.parametrize("when", [0, 2])
async def test_a_lie_of_an_index_does_not_freeze_the_loop(when: int) -> None:
    """PX4's trigger, which cannot be asked for a picture: holes are given up in one step."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    simulated.parameters["TRIG_MODE"] = 1.0
    async with open_px4(simulated) as flight:
        await flight.vehicle.wait_ready()
        camera = flight.vehicle.camera_at(1)
        given: list[int] = []

        def lie() -> None:
            flight.wire.deliver(FrameEncoder(1, 1).encode(picture(FAR)))

        with anyio.fail_after(60):
            async with camera.photo_interval(1.0) as captures:
                if when == 0:
                    lie()
                async for capture in captures:
                    given.append(capture.index)
                    if len(given) == when:
                        lie()
                    if len(given) == 6:
                        break
        assert captures.missed == 0
        true = [each for each in given if each != FAR]
        assert len(true) >= 5
        assert true == list(range(true[0], true[0] + len(true)))


async def test_a_lie_of_an_index_far_below_does_not_move_the_series_back() -> None:
    simulated = SimulatedPx4(boot_time_s=0.0)
    simulated.parameters["TRIG_MODE"] = 1.0
    async with open_px4(simulated) as flight:
        await flight.vehicle.wait_ready()
        given: list[int] = []
        with anyio.fail_after(60):
            async with flight.vehicle.camera_at(1).photo_interval(0.5) as captures:
                async for capture in captures:
                    given.append(capture.index)
                    if len(given) == 25:
                        flight.wire.deliver(FrameEncoder(1, 1).encode(picture(given[0])))
                    if len(given) == 30:
                        break
        assert given == list(range(given[0], given[0] + 30))


async def test_holes_are_given_up_in_one_step() -> None:
    """After three pictures that the camera does not tell of, it is not asked for each of the others before the next."""
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        async with vehicle.camera.photo_interval(100.0) as captures:
            first = await anext(captures)
            camera.faults.ignore(MavCmd.REQUEST_MESSAGE, times=None)
            camera.send(picture(first.index + 9))
            began = anyio.current_time()
            assert (await anext(captures)).index == first.index + 9
            assert anyio.current_time() - began < 60
            assert captures.missed == 8


# --------------------------------------------------------------------------- the newest order counts


async def test_a_lost_start_of_a_video_does_not_undo_the_stop_after_it() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        heard = commands_to(camera, START_VIDEO, STOP_VIDEO)
        camera.faults.ignore(START_VIDEO, times=1)
        async with anyio.create_task_group() as tasks:

            async def start() -> None:
                with pytest.raises(CommandTimeout, match="not sent again: another order was given"):
                    await vehicle.camera.start_video()

            tasks.start_soon(start)
            await anyio.sleep(0.5)
            await vehicle.camera.stop_video()
        await anyio.sleep(5)
        assert [each[0] for each in heard] == [START_VIDEO, STOP_VIDEO]


async def test_the_end_of_a_series_does_not_end_the_next_one() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        camera.faults.lose_ack(STOP, times=1)
        with pytest.raises(KeyError):
            async with vehicle.camera.photo_interval(1.0) as captures:
                await anext(captures)
                raise KeyError
        heard = commands_to(camera, START, STOP)
        async with vehicle.camera.photo_interval(1.0, count=8) as captures:
            assert len([each async for each in captures]) == 8
        assert [each[0] for each in heard] == [STOP, START]


async def test_the_end_of_a_block_of_video_does_not_end_the_next_recording() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        camera.faults.lose_ack(STOP_VIDEO, times=1)
        with pytest.raises(KeyError):
            async with vehicle.camera.video():
                raise KeyError
        await vehicle.camera.start_video()
        heard = commands_to(camera, STOP_VIDEO)
        await anyio.sleep(6)
        status = await vehicle.camera._shutter.status()
        assert status is not None
        assert status.is_recording
        assert heard == []


async def test_an_older_zoom_is_not_sent_again_nor_the_end_of_zooming() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        heard = commands_to(camera, ZOOM)
        camera.faults.ignore(ZOOM, times=1)

        async def older() -> None:
            with pytest.raises(CommandTimeout, match="another order was given"):
                await vehicle.camera.zoom_to(10)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(older)
            await anyio.sleep(0.3)
            async with vehicle.camera.zooming():
                await vehicle.camera.zoom_to(70)
        await anyio.sleep(5)
        told: list[Any] = [each[1:3] for each in heard]
        assert told[0] == (2, 10)
        assert told[-1] == (2, 70)
        assert told.count((2, 10)) == 1
        assert (1, 0) not in told


async def test_a_newer_order_that_is_refused_leaves_the_end_to_the_older_one() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        heard = commands_to(camera, STOP_VIDEO)
        async with vehicle.camera.video():
            camera.faults.refuse(START_VIDEO, MavResult.TEMPORARILY_REJECTED)
            with pytest.raises(CommandRejected):
                await vehicle.camera.start_video()
            with pytest.raises(CommandRejected):
                async with vehicle.camera.video():
                    pass
            assert heard == []
        assert len(heard) == 1


async def test_two_objects_of_one_camera_know_of_each_others_orders() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        assert vehicle.camera_at(100)._line.topic("zoom") == vehicle.camera._line.topic("zoom")


# ----------------------------------------------------------------------------- blocks and their ends


@pytest.mark.parametrize("kind", ["photo_interval", "video", "zooming", "focusing"])
async def test_what_was_begun_ends_with_the_vehicles_block(kind: str) -> None:
    camera = SimulatedCamera()
    stops = {"photo_interval": STOP, "video": STOP_VIDEO, "zooming": ZOOM, "focusing": FOCUS}
    copter = SimulatedCopter(boot_time_s=0.0, components=(camera,))
    async with simulated_link(copter) as link, anyio.create_task_group() as tasks:
        async with aerokit.connect(link) as vehicle:
            await anyio.sleep(1.5)
            if kind == "video":
                await vehicle.camera.set_mode("video")
            block = vehicle.camera.photo_interval(1.0) if kind == "photo_interval" else None

            async def stay() -> None:
                with suppress(AerokitError):
                    async with block or getattr(vehicle.camera, kind)():
                        await anyio.sleep(20)

            tasks.start_soon(stay)
            await anyio.sleep(3)
            heard = commands_to(camera, stops[kind])
        await anyio.sleep(1)
        assert [each[0] for each in heard] == [stops[kind]]
        assert 0 in heard[0][2:3] or kind in ("photo_interval", "video")
        taken = camera.image_count
        await anyio.sleep(30)
        assert camera.image_count == taken
        assert len(heard) == 1


async def test_a_block_that_was_left_leaves_nothing_to_the_vehicles_end() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        async with vehicle.camera.photo_interval(1.0, count=2) as captures:
            assert len([each async for each in captures]) == 2
        async with vehicle.camera.zooming():
            pass
        assert vehicle.camera._line.on_finish == []


async def test_nothing_is_told_to_stop_that_was_not_sent() -> None:
    camera = SimulatedCamera(capabilities=CameraCapFlags.CAPTURE_IMAGE)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        heard = commands_to(camera)
        for block in (vehicle.camera.video, vehicle.camera.zooming, vehicle.camera.focusing):
            with pytest.raises(NotSupported, match="nothing was sent"):
                async with block():
                    pass
        await anyio.sleep(5)
        assert heard == []


async def test_a_refused_block_does_not_end_what_was_running_before() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        await vehicle.camera.start_video()
        heard = commands_to(camera, STOP_VIDEO)
        camera.faults.refuse(START_VIDEO, MavResult.TEMPORARILY_REJECTED)
        with pytest.raises(CommandRejected):
            async with vehicle.camera.video():
                pass
        await anyio.sleep(5)
        assert heard == []


async def test_what_may_have_begun_is_told_to_stop() -> None:
    """Without an answer, and cancelled after the order has left."""
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        heard = commands_to(camera, ZOOM)
        camera.faults.lose_ack(ZOOM, times=4)
        with pytest.raises(CommandTimeout):
            async with vehicle.camera.zooming():
                pass
        await anyio.sleep(5)
        assert heard[-1][1:3] == (1, 0)
        heard.clear()
        camera.faults.lose_ack(ZOOM, times=1)
        with anyio.move_on_after(0.3):
            async with vehicle.camera.zooming():
                pass
        await anyio.sleep(5)
        assert [each[1:3] for each in heard] == [(1, 1), (1, 0)]


# ------------------------------------------------------------------------------------ silent cameras


async def test_an_order_is_not_sent_again_to_a_camera_that_is_silent() -> None:
    """The autopilot's HEARTBEAT does not count for a camera with a component id of its own."""
    camera = SimulatedCamera()
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=(camera,))) as flight:
        await anyio.sleep(2)
        await flight.vehicle.camera.wait_found()

        def sent() -> int:
            orders = [each for _, each in flight.wire.sent if isinstance(each, m.CommandLong)]
            return len([each for each in orders if each.command == ZOOM])

        camera.faults.silent = True
        await anyio.sleep(10)
        with pytest.raises(CommandTimeout, match="has not told since what it does"):
            await flight.vehicle.camera.zoom_to(50)
        assert sent() == 1
        camera.faults.silent = False
        camera.faults.ignore(ZOOM, times=1)
        await anyio.sleep(3)
        await flight.vehicle.camera.zoom_to(60)
        assert sent() == 3
