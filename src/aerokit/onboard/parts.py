"""Connects `CameraDriver` and `GimbalDriver` objects to the protocol servers of a component."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, ParamAck
from aerokit.onboard.camera import CameraAdapter, CameraDriver
from aerokit.onboard.commands import overrides
from aerokit.onboard.gimbal import STATUS_INTERVAL_S, GimbalAdapter, GimbalDriver
from aerokit.parameters import parse_definition
from aerokit.protocols.servers.camera import camera_builders
from aerokit.protocols.servers.camera_commands import camera_commands, legacy_requests
from aerokit.protocols.servers.definitions import DefinedParameterServer
from aerokit.protocols.servers.gimbal import gimbal_builders, gimbal_commands, listen_for_gimbal

if TYPE_CHECKING:
    from aerokit.onboard.host import ComponentHost
    from aerokit.onboard.services import ComponentServices
    from aerokit.parameters import CameraDefinition, SettingValue
    from aerokit.protocols.servers.camera import AsyncHandler
    from aerokit.protocols.servers.commands import ReceivedCommand

DEFINITION_PATH = "/camera_definition.xml"


class DefinedSettings(DefinedParameterServer):
    """Settings of a `CameraDriver` with a definition file."""

    def __init__(
        self, host: ComponentHost, definition: CameraDefinition, on_change: Callable[[str, SettingValue], Any]
    ):
        self._on_change = on_change
        super().__init__(host, definition)
        self._component = host

    def set(self, name: str, data: bytes, kind: int) -> int:
        old_value = self.values[name]
        try:
            return super().set(name, data, kind)
        except Exception as error:  # The program's function has refused the new value.
            self.values[name] = old_value
            self._component.report_error(name, error)
            return ParamAck.FAILED

    def on_set(self, name: str, value: SettingValue) -> None:
        self._on_change(name, value)


def add_camera(services: ComponentServices, camera: CameraDriver) -> CameraAdapter:
    host, streams = services.host, services.streams
    adapter = CameraAdapter(camera, host, services.tasks, services.commands.call)
    if m.CameraInformation.ID in streams.builders:
        raise InvalidArgument("this component already has a camera: open another component for the second one")
    if camera.definition is not None:
        definition = parse_definition(camera.definition)
        services.parameters._forbid_parameters()  # The camera's settings use the same messages.
        DefinedSettings(host, definition, camera.on_setting)
        services.memory.put(DEFINITION_PATH, camera.definition)
        adapter.definition_version = definition.version
        adapter.definition_uri = f"mftp://{DEFINITION_PATH}"
    streams.builders.update(camera_builders(adapter))
    for command, handler in camera_commands(adapter).items():
        if command == MavCmd.STORAGE_FORMAT and not overrides(camera, CameraDriver, "format_storage"):
            continue  # The command stays UNSUPPORTED.
        services.commands.add_raw(command, partial(_run_if_implemented, handler))
    services.commands.add_guarded(legacy_requests(streams))
    return adapter


async def _run_if_implemented(handler: AsyncHandler, command: ReceivedCommand) -> int:
    try:
        return await handler(command)
    except NotImplementedError:  # The program's class does not override the method.
        return MavResult.UNSUPPORTED


def add_gimbal(services: ComponentServices, gimbal: GimbalDriver) -> GimbalAdapter:
    streams = services.streams
    if m.GimbalManagerInformation.ID in streams.builders:
        raise InvalidArgument("this component already has a gimbal: open another component for the second one")
    adapter = GimbalAdapter(gimbal, services)
    streams.builders.update(gimbal_builders(adapter))
    services.commands.add_guarded(gimbal_commands(adapter))
    listen_for_gimbal(adapter)
    streams.stream(m.GimbalManagerStatus.ID, STATUS_INTERVAL_S)
    if gimbal.attitude_hz > 0:
        streams.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / gimbal.attitude_hz)
    return adapter
