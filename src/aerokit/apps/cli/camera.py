"""``aerokit camera``: the cameras on board."""

from __future__ import annotations

import argparse
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING
from urllib.parse import unquote

from aerokit.apps.cli.arguments import directory, number
from aerokit.apps.cli.output import DONE, FAILED, tell, tell_done
from aerokit.apps.cli.vehicle_command import add_action, agreed, connected

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from aerokit.vehicle.camera.cameras import Camera
    from aerokit.vehicle.camera.capture import Capture

MOST = 32_767
LONGEST_NAME = 200


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    info = add_action(actions, "info", _info, "Say what the camera is and can do.")
    photo = add_action(actions, "photo", _photo, "Take pictures, and say where each was taken.")
    photo.add_argument("--count", type=_count, default=1, metavar="N", help="so many (1)")
    photo.add_argument(
        "--interval", type=number(0.1, 3600), default=2.0, metavar="S", help="from one to the next (2)"
    )
    photo.add_argument("--to", type=directory, metavar="DIRECTORY", help="fetch the files into it")
    video = add_action(actions, "video", _video, "Start or stop a video.")
    video.add_argument("what", choices=("start", "stop"), help="start or stop")
    mode = add_action(actions, "mode", _mode, "Change the camera's mode.")
    mode.add_argument("mode", choices=("photo", "video", "survey"), help="the mode")
    zoom = add_action(actions, "zoom", _zoom, "Zoom.")
    zoom.add_argument("percent", type=number(0, 100), metavar="PERCENT", help="of its range, 0 to 100")
    streams = add_action(actions, "streams", _streams, "List the video streams, with their addresses.")
    erase = add_action(actions, "format", _format, "Format the card: all pictures on it are gone.")
    erase.add_argument("--yes", action="store_true", help="do not ask")
    for action in (info, photo, video, mode, zoom, streams, erase):
        action.add_argument(
            "--camera",
            type=int,
            metavar="ID",
            help="component id, or 1 to 6 behind the autopilot (the first)",
        )


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= MOST):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of pictures: 1 to {MOST}")
    return int(text)


@asynccontextmanager
async def _camera(options: argparse.Namespace, *, changes: bool = True) -> AsyncIterator[Camera]:
    async with connected(options, changes=changes) as vehicle:
        camera = vehicle.camera if options.camera is None else vehicle.camera_at(options.camera)
        await camera.wait_found(timeout=options.patience)
        yield camera


async def _info(options: argparse.Namespace) -> int:
    async with _camera(options, changes=False) as camera:
        about = camera.information.value
        name = _plain(f"{about.vendor} {about.model}")
        can = ", ".join(sorted(about.capabilities)) or "nothing that it tells"
        text = f"{camera.number}  {name}, firmware {about.firmware or 'unknown'}\ncan: {can}"
        record = {**about.to_dict(), "capabilities": sorted(about.capabilities)}
        tell(options, "camera", record, text)
        for each in await camera.load_storage():
            free = "" if each.available_mib is None else f", {each.available_mib:.0f} MiB free"
            tell(options, "card", each.to_dict(), f"card {each.number}: {each.status}{free}")
    return DONE


async def _photo(options: argparse.Namespace) -> int:
    is_whole = True
    async with _camera(options) as camera:
        if options.count == 1:
            is_whole = await _show(options, camera, await camera.take_photo())
        else:
            async with camera.photo_interval(options.interval, options.count) as captures:
                async for capture in captures:
                    is_whole = await _show(options, camera, capture) and is_whole
    return DONE if is_whole else FAILED


async def _show(options: argparse.Namespace, camera: Camera, capture: Capture) -> bool:
    """Whether it was taken, and fetched if that is wanted."""
    place, to = capture.place, options.to
    where = "nobody knows where" if place is None else f"{place.latitude_deg:.7f} {place.longitude_deg:.7f}"
    text = f"{capture.index:>5}  {where}  {_plain(capture.file_url)}".rstrip()
    record = {name: value for name, value in capture.to_dict().items() if name != "heard_at"}
    tell(options, "picture", record, text)
    if to is None or not capture.success:
        return capture.success is not False
    name = _file_name(capture)
    if name is None:
        not_fetched = {"index": capture.index, "file": None, "bytes": None}
        tell(options, "fetched_picture", not_fetched, "       not fetched: this is no name for a file")
        return False
    content = await camera.read_picture(capture)
    target = _write_new(to, name, content)
    fetched = {"index": capture.index, "file": target, "bytes": len(content)}
    tell(options, "fetched_picture", fetched, f"       {target}")
    return True


def _plain(text: str) -> str:
    """What a camera says, without characters that a terminal obeys."""
    return "".join(each if each.isprintable() else "\N{REPLACEMENT CHARACTER}" for each in text)


def _file_name(capture: Capture) -> str | None:
    """By index and the last part of its address; None when that would be a place, or no name on some computer."""
    base = unquote(capture.file_url.rpartition("/")[2]) or "capture.jpg"
    is_name = base.isprintable() and not set(base) & set('/\\:*?"<>|') and base.strip(" .") == base
    return f"{capture.index:05}-{base}" if is_name and len(base) <= LONGEST_NAME else None


def _write_new(to: Path, name: str, content: bytes) -> Path:
    """Beside what is there already: nothing is overwritten."""
    stem, dot, ending = name.rpartition(".")
    at, target = 1, to / name
    while True:
        with suppress(FileExistsError), target.open("xb") as file:
            file.write(content)
            return target
        at += 1
        target = to / (f"{stem}-{at}.{ending}" if dot else f"{name}-{at}")


async def _video(options: argparse.Namespace) -> int:
    async with _camera(options) as camera:
        await (camera.start_video() if options.what == "start" else camera.stop_video())
    tell_done(options, f"camera video {options.what}")
    return DONE


async def _mode(options: argparse.Namespace) -> int:
    async with _camera(options) as camera:
        await camera.set_mode(options.mode)
    tell_done(options, "camera mode")
    return DONE


async def _zoom(options: argparse.Namespace) -> int:
    async with _camera(options) as camera:
        await camera.zoom_to(options.percent)
    tell_done(options, "camera zoom")
    return DONE


async def _streams(options: argparse.Namespace) -> int:
    async with _camera(options) as camera:
        for each in await camera.load_streams():
            size = f"{each.width_px}x{each.height_px}"
            name = _plain(each.name)
            text = f"{each.number:>3}  {_plain(each.uri)}  {size}  {each.encoding}  {name}".rstrip()
            tell(options, "stream", each.to_dict(), text)
    return DONE


async def _format(options: argparse.Namespace) -> int:
    if not options.yes and not agreed("format the camera's card?"):
        tell(options, "declined", {"action": "camera format"}, "nothing was formatted")
        return FAILED
    async with _camera(options) as camera:
        await camera.format_storage()
    tell_done(options, "camera format", "formatted")
    return DONE
