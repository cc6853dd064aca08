"""``aerokit camera`` and ``aerokit gimbal``: cameras and gimbals on board."""

from __future__ import annotations

import argparse
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING
from urllib.parse import unquote

import anyio

from aerokit.apps.cli.arguments import add_number, directory, integer, number
from aerokit.apps.cli.connecting import add_action, command_action, connected
from aerokit.apps.cli.output import DONE, FAILED, emit
from aerokit.errors import AerokitError
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from aerokit.vehicle.camera.cameras import Camera
    from aerokit.vehicle.camera.capture import Capture
    from aerokit.vehicle.gimbal.device import GimbalInformation
    from aerokit.vehicle.gimbal.gimbal import Gimbal

_MAX_PICTURES = 32_767
_MAX_FILE_NAME = 200
_ATTITUDE_TIMEOUT_S = 2.0
_ID_HELP = "component id, or 1 to 6 for one attached to the autopilot (default: the first)"


def add_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    info = add_action(actions, "info", _info, "Show model, firmware, capabilities and storage.")
    photo = add_action(actions, "photo", _photo, "Take pictures, and show where each was taken.")
    photo.add_argument(
        "--count",
        type=integer(1, _MAX_PICTURES, "a number of pictures"),
        default=1,
        metavar="N",
        help="number of pictures (default: 1)",
    )
    add_number(photo, "--interval", 0.1, 3600, "S", "seconds between pictures", default=2.0)
    photo.add_argument(
        "--to",
        type=directory,
        metavar="DIRECTORY",
        help="download the pictures to this directory, which is created if needed",
    )
    record = command_action("camera video {what}", "video {what}: done", _record_video, _camera)
    video = add_action(actions, "video", record, "Start or stop video recording.")
    video.add_argument("what", choices=("start", "stop"), help="start or stop")
    set_mode = command_action(
        "camera mode", "mode {mode}", lambda camera, options: camera.set_mode(options.mode), _camera
    )
    mode = add_action(actions, "mode", set_mode, "Change the camera's mode.")
    mode.add_argument("mode", choices=("photo", "video", "survey"), help="camera mode")
    zoom_to = command_action(
        "camera zoom", "zoom {percent:g} %", lambda camera, options: camera.zoom_to(options.percent), _camera
    )
    zoom = add_action(actions, "zoom", zoom_to, "Zoom.")
    zoom.add_argument("percent", type=number(0, 100), metavar="PERCENT", help="of the zoom range, 0 to 100")
    streams = add_action(actions, "streams", _streams, "List the video streams with their addresses.")
    run_format = command_action(
        "camera format",
        "formatted",
        lambda camera, _: camera.format_storage(),
        _camera,
        question="format the camera's storage?",
    )
    format_storage = add_action(actions, "format", run_format, "Format the storage. All pictures are deleted.")
    format_storage.add_argument("--yes", action="store_true", help="do not ask")
    for action in (info, photo, video, mode, zoom, streams, format_storage):
        action.add_argument("--camera", type=int, metavar="ID", help=_ID_HELP)


@asynccontextmanager
async def _camera(options: argparse.Namespace, *, changes_vehicle: bool = True) -> AsyncIterator[Camera]:
    async with connected(options, changes_vehicle=changes_vehicle) as vehicle:
        camera = vehicle.camera if options.camera is None else vehicle.camera_at(options.camera)
        await camera.wait_found(timeout=options.patience)
        yield camera


async def _info(options: argparse.Namespace) -> None:
    async with _camera(options, changes_vehicle=False) as camera:
        information = camera.information.value
        name = _printable_text(f"{information.vendor} {information.model}")
        capabilities = ", ".join(sorted(information.capabilities)) or "none reported"
        text = f"{camera.number}  {name}, firmware {information.firmware or 'unknown'}\ncapabilities: {capabilities}"
        record = {**information.to_dict(), "capabilities": sorted(information.capabilities)}
        emit(options, "camera", record, text)
        for card in await camera.load_storage():
            free = "" if card.available_mib is None else f", {card.available_mib:.0f} MiB free"
            emit(options, "card", card.to_dict(), f"card {card.number}: {card.status}{free}")


async def _photo(options: argparse.Namespace) -> int:
    is_complete = True
    async with _camera(options) as camera:
        if options.to is not None:
            options.to.mkdir(parents=True, exist_ok=True)
        if options.count == 1:
            is_complete = await _print_and_download(options, camera, await camera.take_photo())
        else:
            async with camera.photo_interval(options.interval, options.count) as captures:
                async for capture in captures:
                    is_complete = await _print_and_download(options, camera, capture) and is_complete
    return DONE if is_complete else FAILED


async def _print_and_download(options: argparse.Namespace, camera: Camera, capture: Capture) -> bool:
    """Print a picture's data and, with ``--to``, download it.

    Returns False if taking or downloading it failed.
    """
    position = capture.place
    place_text = "position unknown"
    if position is not None:
        place_text = f"{position.latitude_deg:.7f} {position.longitude_deg:.7f}"
    text = f"{capture.index:>5}  {place_text}  {_printable_text(capture.file_url)}".rstrip()
    record = {name: value for name, value in capture.to_dict().items() if name != "received_at"}
    emit(options, "picture", record, text)
    if capture.success is False:  # None if the camera has not reported the result
        return False
    if options.to is None:
        return True
    name = _file_name(capture) if capture.file_url else None
    if name is None:
        reason = "unsafe file name in its address" if capture.file_url else "its address was not reported"
        not_fetched = {"index": capture.index, "file": None, "bytes": None}
        emit(options, "fetched_picture", not_fetched, f"       not downloaded: {reason}")
        return False
    content = await camera.read_picture(capture)
    target = _write_new(options.to, name, content)
    fetched = {"index": capture.index, "file": target, "bytes": len(content)}
    emit(options, "fetched_picture", fetched, f"       {target}")
    return True


def _printable_text(text: str) -> str:
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)


def _file_name(capture: Capture) -> str | None:
    """Return a file name such as ``00003-IMG_3.JPG``; None if the camera's name is not portable."""
    name = unquote(capture.file_url.rpartition("/")[2]) or "capture.jpg"
    is_portable = name.isprintable() and not set(name) & set('/\\:*?"<>|') and name.strip(" .") == name
    return f"{capture.index:05}-{name}" if is_portable and len(name) <= _MAX_FILE_NAME else None


def _write_new(folder: Path, name: str, content: bytes) -> Path:
    """Write a new file. A number is appended to the name if the file exists."""
    stem, dot, ending = name.rpartition(".")
    target = folder / name
    number = 1
    while True:
        with suppress(FileExistsError), target.open("xb") as file:
            file.write(content)
            return target
        number += 1
        target = folder / (f"{stem}-{number}.{ending}" if dot else f"{name}-{number}")


async def _record_video(camera: Camera, options: argparse.Namespace) -> None:
    await (camera.start_video() if options.what == "start" else camera.stop_video())


async def _streams(options: argparse.Namespace) -> None:
    async with _camera(options) as camera:
        for stream in await camera.load_streams():
            size = f"{stream.width_px}x{stream.height_px}"
            name = _printable_text(stream.name)
            text = f"{stream.number:>3}  {_printable_text(stream.uri)}  {size}  {stream.encoding}  {name}".rstrip()
            emit(options, "stream", stream.to_dict(), text)


def add_gimbal_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    info = add_action(actions, "info", _gimbal_info, "Show model, limits and attitude.")
    run_point = command_action("gimbal point", "pointing at pitch {pitch:g}°, yaw {yaw:g}°", _point, _gimbal)
    point = add_action(actions, "point", run_point, "Point the gimbal, and hold the direction.")
    add_number(point, "pitch", -360, 360, "PITCH", "degrees from the horizon: -90 is straight down")
    point.add_argument(
        "yaw", type=number(-360, 360), nargs="?", default=0.0, metavar="YAW", help="degrees to the right (default: 0)"
    )
    point.add_argument(
        "--frame",
        choices=("earth", "vehicle"),
        default="vehicle",
        help="yaw from north, or from the nose (default: vehicle)",
    )
    run_look = command_action("gimbal look", "looking at {latitude:g} {longitude:g} {altitude:g} m", _look_at, _gimbal)
    look = add_action(actions, "look", run_look, "Keep the gimbal pointed at a position.")
    look.add_argument("latitude", type=number(-90, 90), metavar="LATITUDE", help="degrees")
    look.add_argument("longitude", type=number(-180, 180), metavar="LONGITUDE", help="degrees")
    look.add_argument("altitude", type=number(-500, 10_000), metavar="ALTITUDE", help="metres above home")
    run_neutral = command_action(
        "gimbal neutral",
        "in neutral position",
        lambda gimbal, options: gimbal.neutral(timeout=options.patience),
        _gimbal,
    )
    neutral = add_action(actions, "neutral", run_neutral, "Turn the gimbal to its neutral position.")
    run_release = command_action(
        "gimbal release", "control returned to the pilot", lambda gimbal, _: gimbal.release(), _gimbal
    )
    release = add_action(actions, "release", run_release, "Return control of the gimbal to the pilot.")
    for action in (info, point, look, neutral, release):
        action.add_argument("--gimbal", type=int, metavar="ID", help=_ID_HELP)


@asynccontextmanager
async def _gimbal(options: argparse.Namespace, *, changes_vehicle: bool = True) -> AsyncIterator[Gimbal]:
    async with connected(options, changes_vehicle=changes_vehicle) as vehicle:
        await vehicle.gimbals.discover()  # before gimbals are found, commands go to the autopilot
        yield vehicle.gimbal if options.gimbal is None else vehicle.gimbals.get(options.gimbal)


async def _gimbal_info(options: argparse.Namespace) -> None:
    async with _gimbal(options, changes_vehicle=False) as gimbal:
        try:
            information = await gimbal.information()
        except AerokitError as error:
            emit(options, "gimbal_silent", {"reason": str(error)}, f"gimbal information unavailable: {error}")
        else:
            emit(options, "gimbal", information.to_dict(), "\n".join(_information_lines(information)))
        with anyio.move_on_after(_ATTITUDE_TIMEOUT_S):
            attitude = await gimbal.attitude.wait_until(lambda _: True)
            angles = {"pitch": attitude.pitch_deg, "roll": attitude.roll_deg, "yaw": attitude.yaw_deg}
            text = ", ".join(f"{name} {angle:.0f}" for name, angle in angles.items() if angle is not None)
            record = {f"{name}_deg": angle for name, angle in angles.items()}
            emit(options, "gimbal_attitude", record, f"attitude: {text}")


async def _point(gimbal: Gimbal, options: argparse.Namespace) -> None:
    await gimbal.point(options.pitch, options.yaw, frame=options.frame, timeout=options.patience)


async def _look_at(gimbal: Gimbal, options: argparse.Namespace) -> None:
    position = Position(options.latitude, options.longitude, altitude_relative_m=options.altitude)
    await gimbal.look_at(position, timeout=options.patience)


def _information_lines(information: GimbalInformation) -> list[str]:
    name = f"{information.vendor} {information.model}".strip() or "unnamed gimbal"
    lines = [f"{information.gimbal_device_id}  {name}, managed by component {information.manager_component_id}"]
    for axis in ("roll", "pitch", "yaw"):
        limits = getattr(information, f"{axis}_deg")
        if limits is not None:
            low, high = limits
            lines.append(f"{axis:>6}  {low:.0f} to {high:.0f} degrees")
    return lines
