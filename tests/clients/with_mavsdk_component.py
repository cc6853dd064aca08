"""MAVSDK's client uses components of aerokit: param, ftp, mission_raw, action, component_metadata, camera, gimbal.

``python with_mavsdk_component.py``; prints a line for each step that is done and ends with 0 when all are.
"""

# pyright: reportMissingImports=false
# ruff: noqa: T201
from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import mavsdk.plugins.camera.camera as of_camera
import mavsdk.plugins.gimbal.gimbal as of_gimbal
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.camera import CameraAsync
from mavsdk.asyncio.plugins.component_metadata import ComponentMetadataAsync
from mavsdk.asyncio.plugins.ftp import FtpAsync
from mavsdk.asyncio.plugins.gimbal import GimbalAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.plugins.camera.camera import CameraError
from mavsdk.plugins.mission_raw import MissionItem

import aerokit
from aerokit.enums import MavAutopilot, MavCmd, MavType
from aerokit.onboard import CameraDriver, CommandRequest, GimbalDriver, GimbalTarget, OnboardComponent, Photo, Storage

CAMERA, GIMBAL = 100, 154
STEP_TIMEOUT_S = 20.0


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

    return await asyncio.wait_for(find(), STEP_TIMEOUT_S)


async def step(name: str, work: Awaitable[object]) -> bool:
    """Report the result of one step; the next steps run even if it fails."""
    try:
        result = await asyncio.wait_for(work, STEP_TIMEOUT_S)
    except Exception as error:  # of either library
        print(f"FAILED\t{name}\t{type(error).__name__}: {error}", flush=True)
        return False
    print(f"done\t{name}\t{'' if result is None else result}", flush=True)
    return True


# ------------------------------------------------------------------------------- the components


class Lens(CameraDriver):
    """A camera in a few lines."""

    def __init__(self) -> None:
        super().__init__(vendor="Acme", model="Eye", streams=["rtsp://127.0.0.1:8554/a"])
        self.zoom_percent = 0.0
        self.is_recording = False
        self.tracked: tuple[float, ...] = ()

    async def take_photo(self, index: int) -> Photo:
        await asyncio.sleep(0.05)
        return Photo(url=f"mftp:///DCIM/{index}.jpg")

    async def start_video(self) -> None:
        self.is_recording = True

    async def stop_video(self) -> None:
        self.is_recording = False

    async def zoom_to(self, percent: float) -> None:
        self.zoom_percent = percent

    async def track(self, place: tuple[float, ...]) -> None:
        self.tracked = place

    def storage(self) -> Storage:
        return Storage(1000.0, 10.0, 990.0)


class Head(GimbalDriver):
    """A gimbal that points at once."""

    def __init__(self) -> None:
        super().__init__(vendor="Acme", model="Head")
        self.angles = (0.0, 0.0, 0.0)

    def point(self, target: GimbalTarget) -> None:
        if target.angles is not None:
            self.angles = target.angles

    def attitude(self) -> tuple[float, float, float]:
        return self.angles


def set_up_autopilot(node: OnboardComponent, folder: Path, calls: list[str]) -> None:
    node.parameters.add("WINCH_SPEED", 1.5, minimum=0.1, maximum=3.0, unit="m/s")
    node.parameters.add("WINCH_MODE", -5_000_000)
    node.parameters.add("WINCH_NAME", "north")
    node.serve_files(folder, writable=True)
    _ = node.missions

    @node.command(MavCmd.COMPONENT_ARM_DISARM)
    async def arm(_: CommandRequest, is_armed: bool) -> None:
        calls.append("arm" if is_armed else "disarm")

    @node.command(MavCmd.NAV_TAKEOFF)
    async def take_off(_: CommandRequest) -> None:
        await asyncio.sleep(1.0)
        calls.append("take off")

    @node.command(MavCmd.NAV_LAND)
    async def land(_: CommandRequest) -> None:
        calls.append("land")


# ------------------------------------------------------------------------------------- the client


async def use_parameters(param: ParamAsync) -> str:
    found = await param.get_all_params()
    assert {each.name for each in found.int_params} == {"WINCH_MODE"}, found
    assert await param.get_param_int("WINCH_MODE") == -5_000_000
    await param.set_param_float("WINCH_SPEED", 2.5)
    assert await param.get_param_float("WINCH_SPEED") == 2.5
    with contextlib.suppress(Exception):
        await param.set_param_float("WINCH_SPEED", 99.0)
    assert await param.get_param_float("WINCH_SPEED") == 2.5
    return f"{len(found.int_params) + len(found.float_params)} parameters"


async def use_extended_parameters(param: ParamAsync) -> str:
    from mavsdk.plugins.param import ProtocolVersion
    from mavsdk.plugins.param.param import ParamError

    with contextlib.suppress(ParamError):  # MAVSDK 4.1 selects the component, but reports UNKNOWN.
        await param.select_component(1, ProtocolVersion.EXT)
    await param.set_param_custom("WINCH_NAME", "south")
    value = await param.get_param_custom("WINCH_NAME")
    assert value.rstrip(b"\0") == b"south", repr(value)
    found = await param.get_all_params()
    return f"{len(found.custom_params)} custom"


async def use_files(ftp: FtpAsync, folder: Path, local: Path) -> str:
    (folder / "log.bin").write_bytes(bytes(range(256)) * 400)
    async for _ in ftp.download("/log.bin", str(local), use_burst=True):
        pass
    assert (local / "log.bin").read_bytes() == bytes(range(256)) * 400
    (local / "up.bin").write_bytes(b"up" * 1000)
    await ftp.create_directory("/new")
    async for _ in ftp.upload(str(local / "up.bin"), "/new"):
        pass
    assert (folder / "new" / "up.bin").read_bytes() == b"up" * 1000
    assert await ftp.are_files_identical(str(local / "up.bin"), "/new/up.bin")
    await ftp.rename("/new/up.bin", "/new/moved.bin")
    listed = await ftp.list_directory("/new")
    assert [entry.name for entry in listed.entries] == ["moved.bin"], listed
    await ftp.remove_file("/new/moved.bin")
    await ftp.remove_directory("/new")
    return "downloaded, uploaded, compared, renamed, removed"


async def use_missions(raw: MissionRawAsync, node: OnboardComponent) -> str:
    items = [
        MissionItem(n, 6, 16, int(n == 0), 1, 0.0, 0.0, 0.0, 0.0, 473977420 + n, 85455940, 20.0, 0) for n in range(25)
    ]
    await raw.upload_mission(items)
    back = await raw.download_mission()
    assert [each.x for each in back] == [each.x for each in items]
    assert len(node.missions.items()) == 25
    await raw.clear_mission()
    assert node.missions.items() == ()
    return "25 items"


async def use_actions(action: ActionAsync, calls: list[str]) -> str:
    await action.arm()  # arm_force of MAVSDK 4.1 sends the command to disarm by force
    await action.takeoff()
    await action.land()
    await action.disarm()
    assert calls == ["arm", "take off", "land", "disarm"], calls
    return ", ".join(calls)


async def use_metadata(metadata: ComponentMetadataAsync) -> str:
    await metadata.request_component(1)
    update = await first(metadata.subscribe_metadata_available())
    assert "WINCH_SPEED" in update.json_metadata, update
    return f"{len(update.json_metadata)} characters"


async def until_available(read: Callable[[], Awaitable[Any]]) -> Any:
    """Repeat a read until MAVSDK has polled the camera, which takes some seconds."""
    while True:
        try:
            return await read()
        except CameraError as error:
            refusal = error
        await asyncio.sleep(0.5)
        if "UNAVAILABLE" not in str(refusal):
            raise refusal


async def use_camera(plugin: CameraAsync, lens: Lens) -> str:
    await first(plugin.subscribe_camera_list(), lambda found: bool(found.cameras))
    capture = asyncio.ensure_future(first(plugin.subscribe_capture_info()))
    await asyncio.sleep(0.2)
    await plugin.take_photo(CAMERA)
    assert (await capture).file_url == "mftp:///DCIM/0.jpg"
    await plugin.start_photo_interval(CAMERA, 0.2)
    await asyncio.sleep(1.0)
    await plugin.stop_photo_interval(CAMERA)
    await asyncio.sleep(0.5)
    photos = await plugin.list_photos(CAMERA, of_camera.PhotosRange.ALL)
    await plugin.start_video(CAMERA)
    assert lens.is_recording
    await plugin.stop_video(CAMERA)
    await plugin.zoom_range(CAMERA, 30.0)
    assert lens.zoom_percent == 30.0
    await plugin.track_point(CAMERA, 0.5, 0.5, 0.1)
    assert lens.tracked[:2] == (0.5, 0.5)
    await plugin.track_stop(CAMERA)
    storage = await until_available(lambda: plugin.get_storage(CAMERA))
    return f"{len(photos)} photos, {storage.total_storage_mib:.0f} MiB"


async def use_gimbal(plugin: GimbalAsync, head: Head) -> str:
    found = await first(plugin.subscribe_gimbal_list(), lambda listed: bool(listed.gimbals))
    gimbal = found.gimbals[0].gimbal_id
    await plugin.take_control(gimbal, of_gimbal.ControlMode.PRIMARY)
    await plugin.set_angles(gimbal, 0.0, -30.0, 45.0, of_gimbal.GimbalMode.YAW_FOLLOW, of_gimbal.SendMode.ONCE)
    assert [round(angle) for angle in head.angles] == [0, -30, 45], head.angles
    attitude = await first(plugin.subscribe_attitude(), lambda each: each.euler_angle_forward.pitch_deg < -20)
    await plugin.release_control(gimbal)
    return f"pitch {attitude.euler_angle_forward.pitch_deg:.1f}"


async def main() -> bool:
    port, calls, lens, head = free_port(), list[str](), Lens(), Head()
    kind, autopilot = MavType.QUADROTOR, MavAutopilot.GENERIC
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as local:
        async with (
            aerokit.component(f"udpout:127.0.0.1:{port}", component_id=1, type=kind, autopilot=autopilot) as node,
            aerokit.component(connection=node.connection, component_id=CAMERA, type=MavType.CAMERA) as camera,
            aerokit.component(connection=node.connection, component_id=GIMBAL, type=MavType.GIMBAL) as gimbal,
        ):
            set_up_autopilot(node, Path(folder), calls)
            camera.add_camera(lens)
            gimbal.add_gimbal(head)
            sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
            await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = await sdk.first_autopilot(timeout_s=30.0)
            assert system is not None
            done = [
                await step("param", use_parameters(ParamAsync(system))),
                await step("param_ext", use_extended_parameters(ParamAsync(system))),
                await step("ftp", use_files(FtpAsync(system), Path(folder), Path(local))),
                await step("mission_raw", use_missions(MissionRawAsync(system), node)),
                await step("action", use_actions(ActionAsync(system), calls)),
                await step("component_metadata", use_metadata(ComponentMetadataAsync(system))),
                await step("camera", use_camera(CameraAsync(system), lens)),
                await step("gimbal", use_gimbal(GimbalAsync(system), head)),
            ]
            sdk.destroy()
    return all(done)


if __name__ == "__main__":
    sys.exit(not asyncio.run(main()))
