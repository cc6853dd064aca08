"""Cameras with MAVSDK: its client drives our simulated camera, our client drives its ``camera_server``.

``python with_mavsdk_camera.py``; prints a line for each step that is done and ends with 0 when all are.
"""

# pyright: reportMissingImports=false
# ruff: noqa: T201
from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import mavsdk.plugins.camera.camera as of_client
import mavsdk.plugins.camera_server.camera_server as of_server
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.camera import CameraAsync
from mavsdk.asyncio.plugins.camera_server import CameraServerAsync

import aerokit
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.sim import SimulatedCamera, SimulatedCopter, open_simulator

SYSTEM, CAMERA = 1, 100
MAX_DURATION_S = 60.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def first(values: AsyncIterator[Any], condition: Callable[[Any], bool] = lambda _: True) -> Any:
    async def find() -> Any:
        async for value in values:
            if condition(value):
                return value
        raise EOFError

    return await asyncio.wait_for(find(), 20.0)


async def step(name: str, work: Awaitable[object]) -> bool:
    """Report the result of one step; the next ones run in any case."""
    try:
        result = await asyncio.wait_for(work, 20.0)
    except Exception as error:  # of either library
        print(f"FAILED\t{name}\t{type(error).__name__}: {error}", flush=True)
        return False
    print(f"done\t{name}\t{'' if result is None else result}", flush=True)
    return True


# --------------------------------------------------------------------------- their client, our camera


async def their_client() -> list[bool]:
    port = free_port()
    camera = SimulatedCamera(
        capabilities=SimulatedCamera.ALL_CAPABILITIES, streams=["rtsp://127.0.0.1:8554/a"], shutter_s=0.1
    )
    async with open_simulator(SimulatedCopter(components=[camera]), f"udpout:127.0.0.1:{port}"):
        sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=30.0)
        plugin = CameraAsync(system)
        await first(plugin.subscribe_camera_list(), lambda found: bool(found.cameras))

        async def photo() -> str:
            captures = plugin.subscribe_capture_info()
            received = asyncio.ensure_future(first(captures))
            await asyncio.sleep(0.2)
            await plugin.take_photo(CAMERA)
            capture = await received
            assert capture.is_success
            assert capture.file_url == "mftp:///DCIM/IMG_0001.JPG", capture.file_url
            return f"index {capture.index}"

        async def interval() -> str:
            await plugin.start_photo_interval(CAMERA, 0.5)
            await asyncio.sleep(2.0)
            await plugin.stop_photo_interval(CAMERA)
            assert camera.image_count >= 3, camera.image_count
            await asyncio.sleep(1.0)
            return f"{len(await plugin.list_photos(CAMERA, of_client.PhotosRange.ALL))} photos"

        async def video() -> None:
            await plugin.set_mode(CAMERA, of_client.Mode.VIDEO)
            await plugin.start_video(CAMERA)
            await asyncio.sleep(0.5)
            assert camera.captures.is_recording
            await plugin.stop_video(CAMERA)

        async def lens() -> None:
            await plugin.zoom_range(CAMERA, 30.0)
            await plugin.zoom_in_start(CAMERA)
            await asyncio.sleep(0.5)
            await plugin.zoom_stop(CAMERA)
            assert camera.zoom > 30.0, camera.zoom
            await plugin.focus_range(CAMERA, 70.0)
            await plugin.focus_in_step(CAMERA)
            await plugin.focus_auto(CAMERA)
            assert camera.focus == 50.0, camera.focus

        async def tracking() -> None:
            await plugin.track_point(CAMERA, 0.5, 0.5, 0.1)
            assert camera.tracking.place[:2] == (0.5, 0.5)
            await plugin.track_rectangle(CAMERA, 0.1, 0.1, 0.4, 0.4)
            await plugin.track_stop(CAMERA)

        async def storage() -> str:
            """Without format_storage: MAVSDK 4.1 takes IN_PROGRESS for a refusal, and aborts the program at the
            result.
            """
            reported = await plugin.get_storage(CAMERA)
            await plugin.reset_settings(CAMERA)
            return f"{reported.total_storage_mib:.0f} MiB"

        async def streaming() -> str:
            await plugin.stop_video_streaming(CAMERA, 1)
            await plugin.start_video_streaming(CAMERA, 1)
            return str((await plugin.get_video_stream_info(CAMERA)).settings.uri)

        steps = (photo, interval, video, lens, tracking, storage, streaming)
        done = [
            await step(f"their client: {coroutine_function.__name__}", coroutine_function())
            for coroutine_function in steps
        ]
        sdk.destroy()
        return done


# --------------------------------------------------------------------------- our client, their camera


class TheirCamera:
    """MAVSDK's camera server, which answers all requests."""

    def __init__(self, plugin: CameraServerAsync) -> None:
        self.plugin = plugin
        self.count = 0
        self.is_recording = False
        self.received: list[tuple[str, Any]] = []
        self._ok = of_server.CameraFeedback.OK

    def records(self) -> bool:
        return self.is_recording

    async def set_up(self) -> None:
        flags = {"image_in_video_mode_supported": True, "video_in_image_mode_supported": True}
        await self.plugin.set_information(
            of_server.Information("MAVSDK", "Server", "1.2.3", 3.0, 3.7, 2.8, 640, 480, 0, 0, "", *flags.values())
        )
        await self.plugin.set_video_streaming(of_server.VideoStreaming(True, "rtsp://127.0.0.1:8554/b"))
        await self.plugin.set_in_progress(False)

    async def run(self) -> None:
        names = (
            "start_video", "stop_video", "set_mode", "format_storage", "reset_settings", "zoom_in_start", "zoom_stop",
            "zoom_range", "focus_auto", "focus_range", "start_video_streaming", "stop_video_streaming",
        )  # fmt: skip
        await asyncio.gather(
            self._photos(),
            self._status(),
            self._storage(),
            self._tracking(),
            *(self._obey(name) for name in names),
        )

    async def _obey(self, name: str) -> None:
        async for value in getattr(self.plugin, f"subscribe_{name}")():
            self.received.append((name, value))
            if name in ("start_video", "stop_video"):
                self.is_recording = name == "start_video"
            await getattr(self.plugin, f"respond_{name}")(self._ok)

    async def _tracking(self) -> None:
        async for value in self.plugin.subscribe_tracking_point_command():
            self.received.append(("track_point", value))
            await self.plugin.respond_tracking_point_command(self._ok)

    async def _photos(self) -> None:
        async for _ in self.plugin.subscribe_take_photo():
            position = of_server.Position(47.4, 8.5, 500.0, 50.0)
            quaternion = of_server.Quaternion(1.0, 0.0, 0.0, 0.0)
            index, self.count = self.count, self.count + 1
            capture = of_server.CaptureInfo(
                position, quaternion, 1_790_000_000_000_000, True, index, f"http://127.0.0.1/{index}.jpg"
            )
            await self.plugin.respond_take_photo(self._ok, capture)

    async def _status(self) -> None:
        status = of_server.CaptureStatus
        async for _ in self.plugin.subscribe_capture_status():
            video = status.VideoStatus.CAPTURE_IN_PROGRESS if self.is_recording else status.VideoStatus.IDLE
            reported = status(0.0, 1.0, 900.0, status.ImageStatus.IDLE, video, self.count)
            await self.plugin.respond_capture_status(self._ok, reported)

    async def _storage(self) -> None:
        kind = of_server.StorageInformation
        async for _ in self.plugin.subscribe_storage_information():
            reported = kind(100.0, 900.0, 1000.0, kind.StorageStatus.FORMATTED, 1, kind.StorageType.SD, 10.0, 5.0)
            await self.plugin.respond_storage_information(self._ok, reported)


@asynccontextmanager
async def their_camera(port: int) -> AsyncIterator[TheirCamera]:
    sdk = Mavsdk(Configuration.create_manual(SYSTEM, CAMERA, True))
    await sdk.add_any_connection(f"udpout://127.0.0.1:{port}")
    component = sdk.server_component_by_type(ComponentType.CAMERA, 0)
    if asyncio.iscoroutine(component):
        component = await component
    camera = TheirCamera(CameraServerAsync(component))
    await camera.set_up()
    running = asyncio.ensure_future(camera.run())
    try:
        yield camera
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError, AerokitError):
            await running
        sdk.destroy()


async def our_client() -> list[bool]:
    port = free_port()
    async with (
        aerokit.open_connection(f"udpin:127.0.0.1:{port}") as connection,
        open_simulator(SimulatedCopter(), f"udpout:127.0.0.1:{port}"),
        their_camera(port) as theirs,
        aerokit.connect(connection) as vehicle,
    ):
        camera = vehicle.camera

        async def information() -> str:
            reported = await camera.wait_found()
            assert (reported.vendor, reported.model, camera.number) == ("MAVSDK", "Server", CAMERA), reported
            return " ".join(sorted(reported.capabilities))

        async def photo() -> str:
            for index in (0, 1):
                capture = await camera.take_photo()
                assert (capture.index, capture.success) == (index, True), capture
            assert capture.place is not None
            assert abs(capture.place.latitude_deg - 47.4) < 1e-6
            assert theirs.count == 2
            return str(capture.file_url)

        async def interval() -> str:
            async with camera.photo_interval(0.5, count=3) as captures:
                return f"{[capture.index async for capture in captures]}"

        async def video() -> str:
            async with camera.video():
                await asyncio.sleep(0.5)
                assert theirs.records()
            await asyncio.sleep(0.3)
            assert not theirs.records()
            return f"{camera.status.value.available_mib} MiB"

        async def mode() -> str:
            """MAVSDK's server accepts the mode, passes it to its program, and keeps reporting "photo"."""
            try:
                await camera.set_mode("video", timeout=2.0)
            except OperationTimeout as error:
                assert ("set_mode", of_server.Mode.VIDEO) in theirs.received, theirs.received
                return str(error)
            raise AssertionError("MAVSDK reports its mode now: expect it here")

        async def lens() -> None:
            await camera.zoom_to(40.0)
            async with camera.zooming():
                await asyncio.sleep(0.3)
            await camera.focus_to(20.0)
            await camera.auto_focus()
            names = [name for name, _ in theirs.received]
            assert {"zoom_range", "zoom_in_start", "zoom_stop", "focus_range", "focus_auto"} <= set(names), names

        async def tracking() -> None:
            await camera.track_point(0.25, 0.5, radius=0.1)
            assert any(name == "track_point" for name, _ in theirs.received)

        async def storage() -> str:
            (medium,) = await camera.load_storage()
            await camera.format_storage()
            await camera.reset_settings()
            return f"{medium.kind} {medium.status} {medium.total_mib}"

        async def streaming() -> str:
            (stream,) = await camera.load_streams()
            await camera.start_streaming(1)
            await camera.stop_streaming(1)
            return stream.uri

        steps = (information, photo, interval, video, mode, lens, tracking, storage, streaming)
        return [
            await step(f"our client: {coroutine_function.__name__}", coroutine_function())
            for coroutine_function in steps
        ]


async def main() -> int:
    done = [*await their_client(), *await our_client()]
    print(f"{sum(done)} done, {len(done) - sum(done)} failed")
    return int(not all(done))


if __name__ == "__main__":
    raise SystemExit(asyncio.run(main()))
