"""Provocations of what settings of components promise to raise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from call_stage import Stage
from camera_beside import camera_of, settings_of
from provoked import Do, Provocation, Table

from aerokit import messages as m
from aerokit.sim import SimulatedCamera
from aerokit.sim.components.camera import DEFINITION_PATH

__all__ = ["SETTINGS"]

PATIENCE: dict[str, Any] = {"idle_timeout_s": 1.0}


def _call(name: str, *args: Any, **options: Any) -> Do:
    return lambda stage: getattr(settings_of(stage), name)(*args, **options)


async def _load_damaged(stage: Stage) -> None:
    path = stage.local("damaged.xml")
    path.write_bytes(b"\0<no>")
    settings_of(stage).load(path)


async def _load_missing(stage: Stage) -> None:
    settings_of(stage).load(stage.local("missing.xml"))


def _camera(*troubles: Callable[[SimulatedCamera], object]) -> Callable[[Stage], None]:
    """Add a camera to the vehicle, then apply the troubles to it."""

    def before(stage: Stage) -> None:
        camera = camera_of(stage)
        settings_of(stage)._forget()
        for trouble in troubles:
            trouble(camera)

    return before


def _silent(camera: SimulatedCamera) -> None:
    camera.faults.silent = True


def _names(uri: str) -> Callable[[SimulatedCamera], None]:
    def name(camera: SimulatedCamera) -> None:
        camera.definition_uri = uri

    return name


def _lacks_information(camera: SimulatedCamera) -> None:
    camera._streams.builders.pop(m.CameraInformation.ID)
    camera.vehicle.call_later(5.0, lambda: camera._streams.builders.update(camera.builders()))


def _loses_files(camera: SimulatedCamera) -> None:
    camera.faults.no_ftp = True


def _shrinks(camera: SimulatedCamera) -> None:
    """Serve a file that is shorter each time it is opened than announced."""
    tree: Any = camera.files
    tree.size = lambda path: 100_000
    camera.vehicle.call_later(20.0, lambda: vars(tree).pop("size"))


def _damaged(camera: SimulatedCamera) -> None:
    camera.files.put(DEFINITION_PATH, b"<no>")


def P(do: Do, *troubles: Callable[[SimulatedCamera], object], **options: Any) -> Provocation:  # noqa: N802
    return Provocation(do, before=_camera(*troubles), **options)


HURRY: dict[str, Any] = {"timeout": 0.05}

SETTINGS: Table = {
    ("Settings.load", "FileFormatError"): P(_load_damaged),
    ("Settings.load", "OSError"): P(_load_missing),
    ("Settings.fetch_definition", "NotSupported"): P(_call("fetch_definition"), _names("")),
    ("Settings.fetch_definition", "CommandRejected"): P(_call("fetch_definition"), _lacks_information),
    ("Settings.fetch_definition", "OperationTimeout"): P(_call("fetch_definition", **HURRY), _silent),
    ("Settings.fetch_definition", "InvalidArgument"): P(_call("fetch_definition", "gopher://a")),
    ("Settings.fetch_definition", "FileFormatError"): P(_call("fetch_definition"), _damaged),
    ("Settings.fetch_definition", "FileError"): P(_call("fetch_definition", "mftp:///nowhere")),
    ("Settings.fetch_definition", "FileTimeout"): P(_call("fetch_definition", **PATIENCE), _loses_files),
    ("Settings.fetch_definition", "RemoteProtocolError"): P(_call("fetch_definition"), _shrinks),
    ("Settings.fetch_definition", "OperationRejected"): P(_call("fetch_definition", "http://127.0.0.1:1/camera.xml")),
    ("Settings.download", "ParameterTimeout"): P(_call("download", **PATIENCE), _silent),
    ("Settings.download", "OperationTimeout"): P(_call("download", **HURRY), _silent),
    **{
        (f"Settings.{name}", error): provocation
        for name in ("get", "read")
        for error, provocation in {
            "InvalidArgument": P(_call(name, "CAM MODE")),
            "ParameterRejected": P(_call(name, "CAM_NOPE")),
            "ParameterTimeout": P(_call(name, "CAM_EV", **PATIENCE), _silent),
            "OperationTimeout": P(_call(name, "CAM_EV", **HURRY), _silent),
        }.items()
    },
    ("Settings.set", "InvalidArgument"): P(_call("set", "CAM_WBMODE", -1)),
    ("Settings.set", "ParameterRejected"): P(_call("set", "CAM_WBMODE", 77)),
    ("Settings.set", "ParameterTimeout"): P(_call("set", "CAM_EV", 1.0, **PATIENCE), _silent),
    ("Settings.set", "OperationTimeout"): P(_call("set", "CAM_EV", 1.0, **HURRY), _silent),
}
