"""Calls to components other than the autopilot: successful, blocking, and failing ones."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable
from contextlib import aclosing, suppress
from typing import Any

from call_stage import Stage
from camera_beside import camera_of
from provoked import Do, Provocation, Table

from aerokit import messages as m
from aerokit._internal.files import MAX_FILE_SIZE
from aerokit.errors import OperationRejected
from aerokit.mavlink.enums import MavCmd
from aerokit.parameters import parse_definition
from aerokit.sim import SimulatedCamera
from aerokit.sim.components.camera import DEFINITION_PATH, own_definition
from aerokit.vehicle.components.component import Component

__all__ = ["COMPONENTS", "COMPONENTS_AWAITED", "COMPONENTS_BLOCKING"]

ADDRESS = f"mftp://{DEFINITION_PATH}"
GENERAL = "/etc/extras/component_general.json.xz"
NOWHERE = 203


def component_of(stage: Any) -> Component:
    found: Component = stage.vehicle.component(100)
    return found


async def _vehicles(stage: Stage) -> None:
    async with aclosing(stage.vehicle.connection.vehicles()) as found:
        async for _ in found:
            break


async def _subscribed(stage: Stage) -> None:
    with component_of(stage).subscribe(m.CameraSettings, rate_hz=5.0) as settings:
        await settings.get(timeout=5)


async def _refused(call: Awaitable[object]) -> None:
    """Await a call that the simulated camera refuses."""
    with suppress(OperationRejected):
        await call


COMPONENTS_AWAITED: dict[str, Callable[[Stage], Awaitable[object]]] = {
    "Component.command": lambda s: component_of(s).command(MavCmd.SET_CAMERA_ZOOM, 2, 30),
    "Component.request": lambda s: component_of(s).request(m.CameraInformation),
    "Component.information": lambda s: _refused(component_of(s).information()),
    "Component.metadata": lambda s: _refused(component_of(s).metadata()),
    "Component.fetch": lambda s: component_of(s).fetch(ADDRESS),
    "Component.subscribe": _subscribed,
    "Connection.vehicles": _vehicles,
}


def _twin(stage: Any) -> Any:
    return stage.vehicle.component(100)


def _subscribe(stage: Any) -> None:
    with _twin(stage).subscribe(m.CameraSettings, rate_hz=5.0) as settings:
        settings.get(timeout=5)


def _rate(stage: Any) -> None:
    with _twin(stage).rate(m.CameraSettings, 5.0):
        pass


def _search(stage: Any) -> None:
    with contextlib.closing(stage.vehicle.connection.vehicles()) as found:
        next(found)


COMPONENTS_BLOCKING: dict[str, Callable[[Any], object]] = {
    "Vehicle.component": _twin,
    "Component.subscribe": _subscribe,
    "Component.rate": _rate,
    "Component.message": lambda s: _twin(s).message(m.CameraSettings),
    "Connection.vehicles": _search,
    "Settings.load": lambda s: s.vehicle.component(100).settings.load(parse_definition(own_definition())),
    "Settings.options": lambda s: s.vehicle.component(100).settings.options("CAM_EV"),
    "Settings.excluded_by": lambda s: s.vehicle.component(100).settings.excluded_by("CAM_EV"),
}


# ---------------------------------------------------------------------------------------- refusals


def _with(*troubles: Callable[[SimulatedCamera], object]) -> Callable[[Stage], None]:
    def before(stage: Stage) -> None:
        camera = camera_of(stage)
        for trouble in troubles:
            trouble(camera)

    return before


def _silent(camera: SimulatedCamera) -> None:
    camera.faults.silent = True


def _ignores_file_requests(camera: SimulatedCamera) -> None:
    camera.faults.no_ftp = True


def _too_large(camera: SimulatedCamera) -> None:
    camera.files.put(DEFINITION_PATH, bytes(MAX_FILE_SIZE + 1))


def _call(name: str, *args: Any, **options: Any) -> Do:
    return lambda stage: getattr(component_of(stage), name)(*args, **options)


def _metadata(stage: Stage) -> Awaitable[object]:
    return stage.vehicle.component(1).metadata()


def _px4(content: bytes | None, *, is_deaf: bool = False) -> dict[str, Any]:
    def before(stage: Stage) -> None:
        simulated: Any = stage.simulated
        simulated.faults.no_ftp = is_deaf
        if content is not None:
            simulated.files.put(GENERAL, content)
        elif GENERAL in simulated.files:
            simulated.files.remove_file(GENERAL)

    return {"before": before, "on": "px4", "alone": True}


async def _no_id(stage: Stage) -> None:
    stage.vehicle.component(0)


P = Provocation

COMPONENTS: Table = {
    ("Vehicle.component", "InvalidArgument"): P(_no_id),
    ("Component.information", "CommandRejected"): P(_call("information"), before=_with()),
    ("Component.information", "OperationTimeout"): P(_call("information"), before=_with(_silent)),
    ("Component.request", "CommandRejected"): P(_call("request", m.FlightInformation), before=_with()),
    ("Component.request", "OperationTimeout"): P(_call("request", m.CameraInformation), before=_with(_silent)),
    ("Component.metadata", "NotSupported"): P(_call("metadata"), before=_with()),
    ("Component.metadata", "FileFormatError"): P(_metadata, **_px4(b"no JSON")),
    ("Component.metadata", "FileError"): P(_metadata, **_px4(None)),
    ("Component.metadata", "FileTimeout"): P(_metadata, **_px4(b"{}", is_deaf=True)),
    ("Component.fetch", "InvalidArgument"): P(_call("fetch", "gopher://a"), before=_with()),
    ("Component.fetch", "FileFormatError"): P(_call("fetch", ADDRESS), before=_with(_too_large)),
    ("Component.fetch", "FileError"): P(_call("fetch", "mftp:///nowhere"), before=_with()),
    ("Component.fetch", "FileTimeout"): P(
        _call("fetch", ADDRESS, idle_timeout_s=1.0), before=_with(_ignores_file_requests)
    ),
    ("Component.fetch", "OperationRejected"): P(_call("fetch", "http://127.0.0.1:1/a.xml"), before=_with()),
}
