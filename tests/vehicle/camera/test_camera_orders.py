"""Orders to a camera: the newest one per subject wins, blocks end with the vehicle's, corrupt indices are ignored."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any

import anyio
import pytest
from camera_stage import commands_to, on_board
from flight_harness import open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    ConnectionClosed,
    NotSupported,
    OperationTimeout,
)
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


# ------------------------------------------------------------------------------ corrupt indices


async def test_corrupt_index_does_not_block_the_series() -> None:
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
async def test_corrupt_index_does_not_block_the_event_loop(when: int) -> None:
    """PX4's trigger cannot resend captures, so gaps are skipped in one step."""
    simulated = SimulatedPx4(boot_time_s=0.0)
    simulated.parameters["TRIG_MODE"] = 1.0
    async with open_px4(simulated) as flight:
        await flight.vehicle.wait_ready()
        camera = flight.vehicle.camera_at(1)
        given: list[int] = []

        def send_false_position() -> None:
            flight.wire.deliver(FrameEncoder(1, 1).encode(picture(FAR)))

        with anyio.fail_after(60):
            async with camera.photo_interval(1.0) as captures:
                if when == 0:
                    send_false_position()
                async for capture in captures:
                    given.append(capture.index)
                    if len(given) == when:
                        send_false_position()
                    if len(given) == 6:
                        break
        assert captures.missed == 0
        true = [order for order in given if order != FAR]
        assert len(true) >= 5
        assert true == list(range(true[0], true[0] + len(true)))


async def test_corrupt_low_index_does_not_rewind_the_series() -> None:
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


async def test_unavailable_gap_is_skipped_at_once() -> None:
    """After three captures that the camera does not send, the rest of the gap is skipped."""
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


# --------------------------------------------------------------------------- newest order wins


async def test_lost_video_start_does_not_undo_later_stop() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        commands = commands_to(camera, START_VIDEO, STOP_VIDEO)
        camera.faults.ignore(START_VIDEO, times=1)
        async with anyio.create_task_group() as tasks:

            async def start() -> None:
                with pytest.raises(CommandTimeout, match="not sent again: another order was given"):
                    await vehicle.camera.start_video()

            tasks.start_soon(start)
            await anyio.sleep(0.5)
            await vehicle.camera.stop_video()
        await anyio.sleep(5)
        assert [command[0] for command in commands] == [START_VIDEO, STOP_VIDEO]


async def test_replaced_order_says_that_it_was_not_sent() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        link = vehicle.camera._shutter.link
        older = link.begin_order("video")
        link.begin_order("video")
        with pytest.raises(CommandTimeout, match="was not sent: another order was given") as raised:
            await link.command(START_VIDEO, order=older)
        assert not raised.value.was_sent


async def test_series_end_does_not_stop_the_next_series() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        camera.faults.lose_ack(STOP, times=1)
        with pytest.raises(KeyError):
            async with vehicle.camera.photo_interval(1.0) as captures:
                await anext(captures)
                raise KeyError
        commands = commands_to(camera, START, STOP)
        async with vehicle.camera.photo_interval(1.0, count=8) as captures:
            assert len([capture async for capture in captures]) == 8
        assert [command[0] for command in commands] == [STOP, START]


async def test_video_block_end_does_not_stop_newer_recording() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        camera.faults.lose_ack(STOP_VIDEO, times=1)
        with pytest.raises(KeyError):
            async with vehicle.camera.video():
                raise KeyError
        await vehicle.camera.start_video()
        commands = commands_to(camera, STOP_VIDEO)
        await anyio.sleep(6)
        status = await vehicle.camera._shutter.request_status()
        assert status is not None
        assert status.is_recording
        assert commands == []


async def test_older_zoom_and_its_stop_are_not_resent() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, ZOOM)
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
        reported: list[Any] = [command[1:3] for command in commands]
        assert reported[0] == (2, 10)
        assert reported[-1] == (2, 70)
        assert reported.count((2, 10)) == 1
        assert (1, 0) not in reported


async def test_refused_newer_order_leaves_stop_to_older_one() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        commands = commands_to(camera, STOP_VIDEO)
        async with vehicle.camera.video():
            camera.faults.refuse(START_VIDEO, MavResult.TEMPORARILY_REJECTED)
            with pytest.raises(CommandRejected):
                await vehicle.camera.start_video()
            with pytest.raises(CommandRejected):
                async with vehicle.camera.video():
                    pass
            assert commands == []
        assert len(commands) == 1


async def test_accepted_recording_without_report_is_not_stopped_by_older_block() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        commands = commands_to(camera, STOP_VIDEO)
        async with vehicle.camera.video():
            camera.captures.stop_recording()
            camera.captures.record = lambda status_interval_s: None  # type: ignore[method-assign]
            with pytest.raises(OperationTimeout):
                await vehicle.camera.start_video(timeout=2.0)
        assert commands == []


async def test_refused_repetition_of_executed_order_is_no_refusal() -> None:
    async with on_board(SimulatedCamera()) as vehicle:
        await vehicle.camera.wait_found()
        link = vehicle.camera._link
        answers: list[AerokitError] = [CommandTimeout("lost"), CommandRejected("busy", command=START_VIDEO, result=1)]
        effects = [False, True]  # The camera needs a moment until it reports that it records.

        async def send() -> None:
            raise answers.pop(0)

        async def had_effect() -> bool:
            return effects.pop(0)

        await link.order_once(link.begin_order("video"), send, had_effect)
        assert answers == []
        assert effects == []


async def test_order_without_effect_is_not_sent_again_after_reboot() -> None:
    """The order ends by rule 3 of docs/reliability.md. After a lost link, the camera may be another vehicle's."""
    async with on_board(SimulatedCamera()) as vehicle:
        await vehicle.camera.wait_found()
        link = vehicle.camera._link
        sent: list[int] = []

        async def send() -> None:
            sent.append(START_VIDEO)
            vehicle._session.watch.reboots += 1
            raise CommandTimeout("lost")

        async def had_effect() -> bool:
            return False

        with pytest.raises(CommandTimeout, match="not sent again: the vehicle rebooted"):
            await link.order_once(link.begin_order("video"), send, had_effect)
        assert sent == [START_VIDEO]


async def test_two_objects_of_a_camera_share_orders() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        assert vehicle.camera_at(100)._link.topic("zoom") == vehicle.camera._link.topic("zoom")


# ----------------------------------------------------------------------------- ends of blocks


@pytest.mark.parametrize("kind", ["photo_interval", "video", "zooming", "focusing"])
async def test_vehicle_block_end_stops_camera_operations(kind: str) -> None:
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
            commands = commands_to(camera, stops[kind])
        await anyio.sleep(1)
        assert [command[0] for command in commands] == [stops[kind]]
        assert 0 in commands[0][2:3] or kind in ("photo_interval", "video")
        taken = camera.image_count
        await anyio.sleep(30)
        assert camera.image_count == taken
        assert len(commands) == 1


async def test_block_end_raises_if_vehicle_block_ends_before_the_answer() -> None:
    camera = SimulatedCamera()
    results: list[AerokitError] = []
    copter = SimulatedCopter(boot_time_s=0.0, components=(camera,))
    async with simulated_link(copter) as link, anyio.create_task_group() as tasks, aerokit.connect(link) as vehicle:
        await anyio.sleep(1.5)
        await vehicle.camera.set_mode("video")

        async def record() -> None:
            try:
                async with vehicle.camera.video():
                    camera.faults.ignore(STOP_VIDEO)
            except AerokitError as error:
                results.append(error)

        tasks.start_soon(record)
        await anyio.sleep(1.0)
    assert [type(error) for error in results] == [ConnectionClosed]


async def test_unconfirmed_stop_of_cancelled_block_logs_warning(caplog: pytest.LogCaptureFixture) -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        with pytest.raises(KeyError):
            async with vehicle.camera.video():
                camera.faults.ignore(STOP_VIDEO)
                raise KeyError
        await anyio.sleep(15)
        assert "camera 100 may not have stopped" in caplog.text


async def test_late_ack_of_start_does_not_confirm_lost_stop() -> None:
    """The start and the stop of zooming have the same MAV_CMD."""
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, ZOOM)
        camera.faults.delay_ack(ZOOM, 0.8, times=1)
        asyncio.get_running_loop().call_later(0.2, partial(camera.faults.ignore, ZOOM, times=1))
        with anyio.move_on_after(0.3):
            async with vehicle.camera.zooming():
                await anyio.sleep(10)
        await anyio.sleep(5)
        assert [command[1:3] for command in commands] == [(1, 1), (1, 0), (1, 0)]


async def test_finished_block_leaves_no_finish_callback() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        async with vehicle.camera.photo_interval(1.0, count=2) as captures:
            assert len([capture async for capture in captures]) == 2
        async with vehicle.camera.zooming():
            pass
        assert vehicle._context.finish_callbacks == []


async def test_unsent_operation_is_not_stopped() -> None:
    camera = SimulatedCamera(capabilities=CameraCapFlags.CAPTURE_IMAGE)
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera)
        for block in (vehicle.camera.video, vehicle.camera.zooming, vehicle.camera.focusing):
            with pytest.raises(NotSupported, match="nothing was sent"):
                async with block():
                    pass
        await anyio.sleep(5)
        assert commands == []


async def test_refused_block_does_not_stop_earlier_operation() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        await vehicle.camera.start_video()
        commands = commands_to(camera, STOP_VIDEO)
        camera.faults.refuse(START_VIDEO, MavResult.TEMPORARILY_REJECTED)
        with pytest.raises(CommandRejected):
            async with vehicle.camera.video():
                pass
        await anyio.sleep(5)
        assert commands == []


async def test_unacknowledged_operation_is_stopped() -> None:
    """Unacknowledged, and cancelled after sending."""
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        commands = commands_to(camera, ZOOM)
        camera.faults.lose_ack(ZOOM, times=4)
        with pytest.raises(CommandTimeout):
            async with vehicle.camera.zooming():
                pass
        await anyio.sleep(5)
        assert commands[-1][1:3] == (1, 0)
        commands.clear()
        camera.faults.lose_ack(ZOOM, times=1)
        with anyio.move_on_after(0.3):
            async with vehicle.camera.zooming():
                pass
        await anyio.sleep(5)
        # The first answer to the stop may be a late answer to the start, so the stop is repeated.
        assert [command[1:3] for command in commands] == [(1, 1), (1, 0), (1, 0)]


# ------------------------------------------------------------------------------------ silent cameras


async def test_stop_of_cancelled_series_is_repeated_after_silence() -> None:
    camera = SimulatedCamera()
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=(camera,))) as flight:
        await flight.vehicle.camera.wait_found()
        with anyio.move_on_after(5.0):
            async with flight.vehicle.camera.photo_interval(1.0):
                flight.copter.faults.silent = camera.faults.silent = True
                await anyio.sleep_forever()
        await anyio.sleep(8)
        assert camera.captures.is_busy
        flight.copter.faults.silent = camera.faults.silent = False
        await anyio.sleep(5)
        assert not camera.captures.is_busy


async def test_lost_stop_of_series_is_repeated_despite_flight_orders() -> None:
    camera = SimulatedCamera()
    copter = SimulatedCopter(boot_time_s=0.0, components=(camera,))
    async with open_flight(copter) as flight, anyio.create_task_group() as tasks:
        await flight.vehicle.wait_ready()
        await flight.vehicle.camera.wait_found()

        async def steer() -> None:
            for mode in ("LOITER", "ALT_HOLD", "LOITER"):
                await anyio.sleep(0.3)
                await flight.vehicle.set_mode(mode)

        async with flight.vehicle.camera.photo_interval(1.0):
            await anyio.sleep(2.0)
            camera.faults.ignore(STOP, times=1)
            tasks.start_soon(steer)
        await anyio.sleep(5.0)
        assert not camera.captures.is_busy


async def test_order_is_not_resent_to_silent_camera() -> None:
    """The autopilot's HEARTBEAT does not count for a camera with a component id of its own."""
    camera = SimulatedCamera()
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=(camera,))) as flight:
        await anyio.sleep(2)
        await flight.vehicle.camera.wait_found()

        def sent() -> int:
            orders = [message for _, message in flight.wire.sent if isinstance(message, m.CommandLong)]
            return len([order for order in orders if order.command == ZOOM])

        camera.faults.silent = True
        await anyio.sleep(10)
        with pytest.raises(CommandTimeout, match="no HEARTBEAT of component 100 received since"):
            await flight.vehicle.camera.zoom_to(50)
        assert sent() == 1
        camera.faults.silent = False
        camera.faults.ignore(ZOOM, times=1)
        await anyio.sleep(3)
        await flight.vehicle.camera.zoom_to(60)
        assert sent() == 3


# ------------------------------------------------------------------------------ a camera that is found late


@asynccontextmanager
async def guessed_camera(kind: Any = SimulatedCopter) -> AsyncIterator[tuple[Any, SimulatedCamera]]:
    """A vehicle, and a camera that is not found: ``vehicle.camera`` stands for a camera of the autopilot."""
    camera = SimulatedCamera()
    camera.faults.heartbeats_stopped = True
    open_any: Any = open_px4 if kind is SimulatedPx4 else open_flight
    async with open_any(kind(boot_time_s=0.0, components=[camera])) as flight:
        with pytest.raises(OperationTimeout, match="did not identify itself"):
            await flight.vehicle.camera.wait_found()
        yield flight, camera


async def test_late_camera_replaces_guessed_autopilot_camera() -> None:
    async with guessed_camera() as (flight, camera):
        first = flight.vehicle.camera
        with pytest.raises(CommandRejected):  # The autopilot has no camera.
            await first.zoom_to(50)
        assert first.number == 1
        camera.faults.heartbeats_stopped = False
        await anyio.sleep(2.0)
        assert (flight.vehicle.camera, first.number) == (first, 100)
        assert (await first.take_photo()).camera == 100
        await first.zoom_to(50)
        orders = [message for message in flight.wire.commands(ZOOM) if isinstance(message, m.CommandLong)]
        assert [order.target_component for order in orders] == [1, 100]


async def test_late_camera_does_not_have_storage_of_autopilot() -> None:
    """PX4 reports its own memory card."""
    async with guessed_camera(SimulatedPx4) as (flight, camera):
        storage = flight.vehicle.camera.storage
        autopilots = await storage.wait_until(lambda _: True)
        camera.faults.heartbeats_stopped = False
        await anyio.sleep(1.5)
        assert flight.vehicle.camera.number == 100
        assert storage.latest != autopilots


async def test_late_camera_is_found_while_guessed_camera_is_asked() -> None:
    camera = SimulatedCamera()
    camera.faults.heartbeats_stopped = True
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=[camera])) as flight:
        flight.copter.faults.ignore(MavCmd.REQUEST_MESSAGE)
        asyncio.get_running_loop().call_later(3.5, setattr, camera.faults, "heartbeats_stopped", False)
        information = await flight.vehicle.camera.wait_found()
        assert (information.model, flight.vehicle.camera.number) == ("Simulated camera", 100)


async def test_late_camera_does_not_disturb_photo_of_guessed_camera() -> None:
    """The picture that the late camera took earlier must not be returned."""
    async with guessed_camera() as (flight, camera):
        camera.faults.lose(m.CameraImageCaptured)
        flight.vehicle._session.commands.send_unconfirmed(START, 0, 0, 1, 1, component_id=100)
        await anyio.sleep(2.0)
        assert camera.image_count == 1
        first = flight.vehicle.camera
        flight.copter.faults.refuse(START, MavResult.ACCEPTED)

        def appear(message: m.CommandLong, *_: object) -> None:
            if message.command == START:
                camera.faults.heartbeats_stopped = False

        flight.copter.observe(m.CommandLong, appear)
        with pytest.raises(OperationTimeout, match="camera 1 accepted the order, but reported no picture"):
            await first.take_photo()
        assert first.number == 1


@pytest.mark.parametrize("sign", ["report", "status", "order", "format", "number"])
async def test_late_camera_does_not_replace_known_autopilot_camera(sign: str) -> None:
    async with guessed_camera() as (flight, camera):
        first = flight.vehicle.camera
        if sign == "report":
            flight.copter.send(m.CameraFeedback(0, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0))
        elif sign == "status":
            flight.copter.send(m.CameraCaptureStatus(0, 0, 0, 0, 0, 1000, 5))
        elif sign == "order":
            flight.copter.faults.refuse(ZOOM, MavResult.ACCEPTED)
            await first.zoom_to(50)
        elif sign == "format":
            flight.copter.faults.refuse(MavCmd.STORAGE_FORMAT, MavResult.ACCEPTED)
            await first.format_storage()
        else:
            assert flight.vehicle.camera_at(1) is first
        camera.faults.heartbeats_stopped = False
        await anyio.sleep(2.0)
        assert (first.number, flight.vehicle.cameras.value) == (1, (100, 1) if sign == "report" else (100,))


async def test_awaited_stop_ends_if_vehicle_block_is_left_at_once() -> None:
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.wait_found()
        link = vehicle.camera._shutter.link
        stop = asyncio.ensure_future(link.end_operation(link.begin_order("video"), STOP_VIDEO, is_awaited=True))
        await asyncio.sleep(0)  # The command is sent now, but the task that confirms it has not begun.
    with pytest.raises(ConnectionClosed, match="block of this vehicle was left"), anyio.fail_after(10):
        await stop


async def test_block_that_ends_before_proof_after_lost_link_sends_nothing() -> None:
    """The reopened link may lead to another vehicle. After the proof, the order to stop is sent."""
    camera = SimulatedCamera()
    async with on_board(camera) as vehicle:
        await vehicle.camera.set_mode("video")
        commands = commands_to(camera, STOP_VIDEO)
        video = vehicle.camera.video()
        await video.__aenter__()
        deliver_again = vehicle.connection.hold_back(vehicle.system_id, lambda _: None)
        await video.__aexit__(RuntimeError, RuntimeError("the program's own"), None)
        await anyio.sleep(0.5)
        assert commands == []
        deliver_again()
        await anyio.sleep(5)
        assert len(commands) == 1
