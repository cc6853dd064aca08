"""Calls of cameras, and provocations of their errors."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from call_stage import Stage
from provoked import Provocation, Table, Trouble

from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.vehicle.camera.capture import Capture

__all__ = ["AWAITED", "BLOCKING", "BLOCKS", "CAMERA", "camera_block"]

Cmd, P = MavCmd, Provocation
UNABLE, NOWHERE = 101, 103
"""Ids of a camera that refuses all commands, and of one that does not exist."""
PICTURE = Capture(100, 0, True, 0.0, None, None, None, None, None, None, "mftp:///DCIM/GIVEN.JPG")

ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "wait_found": (),
    "take_photo": (),
    "load_captures": (),
    "read_picture": (PICTURE,),
    "start_video": (),
    "stop_video": (),
    "load_streams": (),
    "start_streaming": (1,),
    "stop_streaming": (1,),
    "select_stream": (1,),
    "select_source": ("rgb",),
    "zoom_step": (1,),
    "zoom_to": (50.0,),
    "zoom_to_focal_length": (9.0,),
    "focus_step": (1,),
    "focus_to": (50.0,),
    "focus_at": (10.0,),
    "auto_focus": (),
    "track_point": (0.5, 0.5),
    "track_rectangle": (0.1, 0.1, 0.5, 0.5),
    "stop_tracking": (),
    "set_mode": ("photo",),
    "load_storage": (),
    "format_storage": (),
    "reset_settings": (),
}
"""Arguments of each call."""
BLOCKS: dict[str, tuple[Any, ...]] = {
    "photo_interval": (0.5, 2),
    "video": (),
    "zooming": (),
    "focusing": (),
}
COMMANDS: dict[str, int] = {
    "wait_found": Cmd.REQUEST_MESSAGE,
    "take_photo": Cmd.IMAGE_START_CAPTURE,
    "start_video": Cmd.VIDEO_START_CAPTURE,
    "stop_video": Cmd.VIDEO_STOP_CAPTURE,
    "start_streaming": Cmd.VIDEO_START_STREAMING,
    "stop_streaming": Cmd.VIDEO_STOP_STREAMING,
    "select_stream": Cmd.VIDEO_START_STREAMING,
    "select_source": Cmd.SET_CAMERA_SOURCE,
    **dict.fromkeys(("zoom_step", "zoom_to", "zoom_to_focal_length"), Cmd.SET_CAMERA_ZOOM),
    **dict.fromkeys(("focus_step", "focus_to", "focus_at", "auto_focus"), Cmd.SET_CAMERA_FOCUS),
    "track_point": Cmd.CAMERA_TRACK_POINT,
    "track_rectangle": Cmd.CAMERA_TRACK_RECTANGLE,
    "stop_tracking": Cmd.CAMERA_STOP_TRACKING,
    "set_mode": Cmd.SET_CAMERA_MODE,
    "format_storage": Cmd.STORAGE_FORMAT,
    "reset_settings": Cmd.RESET_CAMERA_SETTINGS,
}
"""For each call, the command that the camera refuses or does not answer."""
BLOCK_COMMANDS: dict[str, int] = {
    "video": Cmd.VIDEO_START_CAPTURE,
    "zooming": Cmd.SET_CAMERA_ZOOM,
    "focusing": Cmd.SET_CAMERA_FOCUS,
}
"""For each block, the command of its entry that the camera refuses or does not answer."""
IMPOSSIBLE: dict[str, tuple[Any, ...]] = {
    "start_streaming": (999,),
    "stop_streaming": (999,),
    "select_stream": (0,),
    "zoom_step": (999,),
    "zoom_to": (999.0,),
    "zoom_to_focal_length": (-1.0,),
    "focus_step": (999,),
    "focus_to": (999.0,),
    "focus_at": (-1.0,),
    "track_point": (2.0, 0.5),
    "track_rectangle": (0.5, 0.5, 0.1, 0.1),
    "format_storage": (999,),
    "photo_interval": (0.0,),
    "zooming": (9.0,),
    "focusing": (9.0,),
}


def call(name: str, *args: Any, number: int = 100, **options: Any) -> Callable[[Any], Any]:
    """Call a method of the asynchronous camera or of its twin."""
    return lambda stage: getattr(stage.vehicle.camera_at(number), name)(*(args or ARGUMENTS.get(name, ())), **options)


def camera_block(name: str, number: int = 100) -> Callable[[Any], Awaitable[None]]:
    """Enter and leave an ``async with`` block of a camera."""

    async def do(stage: Any) -> None:
        async with getattr(stage.vehicle.camera_at(number), name)(*BLOCKS[name]) as inside:
            if name == "photo_interval":
                async for _ in inside:
                    pass

    return do


def _blocking_block(name: str) -> Callable[[Any], None]:
    def do(stage: Any) -> None:
        with getattr(stage.vehicle.camera_at(100), name)(*BLOCKS[name]) as inside:
            if name == "photo_interval":
                next(inside)

    return do


def _track_blocking(name: str) -> Callable[[Any], None]:
    """Track a target, then stop tracking."""

    def do(stage: Any) -> None:
        try:
            call(name)(stage)
        finally:
            stage.vehicle.camera_at(100).stop_tracking()

    return do


AWAITED: dict[str, Callable[[Stage], Awaitable[object]]] = {
    **{f"Camera.{name}": call(name) for name in ARGUMENTS},
    **{f"Camera.{name}": camera_block(name) for name in BLOCKS},
}
BLOCKING: dict[str, Callable[[Any], object]] = {
    **{f"Camera.{name}": call(name) for name in ARGUMENTS},
    **{f"Camera.{name}": _blocking_block(name) for name in BLOCKS},
    **{f"Camera.{name}": _track_blocking(name) for name in ("track_point", "track_rectangle")},
    "Camera.captures": call("captures"),
    "Vehicle.camera_at": lambda stage: stage.vehicle.camera_at(101),
}


# ------------------------------------------------------------------------------------------ provocations


def _refuses(command: int) -> Trouble:
    return lambda stage: stage.camera.faults.refuse(command, MavResult.DENIED)


def _ignores(command: int) -> Trouble:
    return lambda stage: stage.camera.faults.ignore(command)


def _is_unknown(stage: Stage) -> None:
    stage.vehicle.camera_at(100).information.forget()
    for command in (Cmd.REQUEST_MESSAGE, Cmd.REQUEST_CAMERA_INFORMATION):
        stage.camera.faults.refuse(command)


def _never_answers(stage: Stage) -> None:
    for command in (Cmd.IMAGE_START_CAPTURE, Cmd.REQUEST_MESSAGE):
        stage.camera.faults.ignore(command)


async def _photo_without_card(stage: Stage) -> None:
    asyncio.get_running_loop().call_later(0.1, lambda: setattr(stage.camera.card, "is_inserted", False))
    await stage.vehicle.camera_at(100).take_photo()


async def _at_once(function: Callable[[Stage], object], stage: Stage) -> object:
    return function(stage)


def _now(function: Callable[[Stage], object]) -> Callable[[Stage], Awaitable[object]]:
    return lambda stage: _at_once(function, stage)


def _unable(name: str) -> Callable[[Stage], Awaitable[object]]:
    return call(name, number=UNABLE)


CAMERA: Table = {
    **{
        (f"Camera.{name}", "InvalidArgument"): P(
            _now(call(name, *args)) if name in BLOCKS else call(name, *args)
        )
        for name, args in IMPOSSIBLE.items()
    },
    ("Camera.start_video", "InvalidArgument"): P(call("start_video", status_hz=99.0)),
    ("Camera.video", "InvalidArgument"): P(_now(call("video", status_hz=99.0))),
    ("Vehicle.camera_at", "InvalidArgument"): P(_now(lambda stage: stage.vehicle.camera_at(0))),
    **{
        (f"Camera.{name}", "CommandRejected"): P(call(name), before=_refuses(command))
        for name, command in COMMANDS.items()
    },
    **{
        (f"Camera.{name}", "CommandTimeout"): P(call(name), before=_ignores(command))
        for name, command in COMMANDS.items()
    },
    **{
        (f"Camera.{name}", "NotSupported"): P(_unable(name))
        for name in ARGUMENTS
        if name not in ("wait_found", "read_picture", "load_storage", "load_captures")
    },
    **{
        (f"Camera.{name}", "OperationTimeout"): P(call(name, number=NOWHERE))
        for name in ARGUMENTS
    },
    **{
        (f"Camera.{name}", error): P(camera_block(name), before=trouble(command))
        for name, command in BLOCK_COMMANDS.items()
        for error, trouble in (("CommandRejected", _refuses), ("CommandTimeout", _ignores))
    },
    **{
        (f"Camera.{name}", error): P(camera_block(name, number))
        for name in BLOCK_COMMANDS
        for error, number in (("NotSupported", UNABLE), ("OperationTimeout", NOWHERE))
    },
    ("Camera.wait_found", "CommandRejected"): P(call("wait_found"), before=_is_unknown, alone=True),
    ("Camera.take_photo", "OperationRejected"): P(_photo_without_card, alone=True),
    ("Camera.take_photo", "CommandTimeout"): P(
        call("take_photo"),
        before=_never_answers,
    ),
    ("Camera.read_picture", "NotSupported"): P(call("read_picture", PICTURE.replace(file_url=""))),
    ("Camera.read_picture", "FileError"): P(
        call("read_picture", PICTURE.replace(file_url="mftp:///DCIM/NONE.JPG"))
    ),
}  # fmt: skip
"""Provocations of the documented errors of cameras."""
