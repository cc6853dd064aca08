"""PARAM_EXT server for the settings in a camera definition file.

https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import ParamAck
from aerokit.parameters import CameraDefinition, SettingValue
from aerokit.parameters.parameter import setting_value, settings_equal
from aerokit.protocols.servers.host import Channel, ServerHost
from aerokit.protocols.servers.parameters import ExtendedParameterServer

_ZEROS: dict[str, SettingValue] = {"bool": False, "float": 0.0, "double": 0.0, "string": "", "custom": ""}


class DefinedParameterServer(ExtendedParameterServer):
    """Settings that a camera definition defines.

    Write-only settings are not listed. The answer to a value that the definition does not allow is VALUE_UNSUPPORTED.
    The answer to a change of a read-only or excluded setting is FAILED.
    """

    def __init__(self, host: ServerHost, definition: CameraDefinition) -> None:
        self.definition = definition
        self.names: list[str] = [name for name, setting in definition.settings.items() if not setting.write_only]
        """Names of the settings that PARAM_EXT_REQUEST_LIST lists, in the order of their indices."""
        self.values: dict[str, SettingValue] = {}
        """Current values; assign them at any time."""
        self.slow: dict[str, float] = {}
        """Maps the name of a slow setting to the seconds that a change of it takes.

        While it is being changed, requests to set it are answered with IN_PROGRESS.
        """
        self._pending: set[str] = set()  # names of slow settings that are being changed
        super().__init__(host, parameters=self)
        self.reset()

    def reset(self) -> None:
        for name, setting in self.definition.settings.items():
            self.values[name] = _ZEROS.get(setting.type, 0) if setting.default is None else setting.default

    def refresh(self) -> None:
        """Called before a value is sent or set. Updates values that the device changes by itself."""

    def can_set(self, name: str) -> bool:
        """Return False to answer a request for this setting with FAILED."""
        return True

    def on_set(self, name: str, value: SettingValue) -> None: ...

    def limited(self, name: str, value: SettingValue) -> SettingValue:
        """Return the value to check and store instead of the received value, e.g. a clamped one."""
        return value

    def restart(self) -> None:
        super().restart()
        self._pending.clear()

    def send(self, name: str, index: int, channel: Channel) -> None:
        self.refresh()
        super().send(name, index, channel)

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def value(self, name: str) -> tuple[SettingValue, int]:
        return self.values[name], self.definition.settings[name].wire_type

    def set(self, name: str, data: bytes, kind: int) -> int:
        """Set a value, or begin to set it if it is in `slow`. Return the PARAM_ACK."""
        result, value = self._check(name, setting_value(data, kind), kind)
        if result == ParamAck.ACCEPTED and name in self.slow and name not in self._pending:
            self._pending.add(name)
            self._host.call_later(self.slow[name], lambda: self._finish_slow(name, value))
        if name in self._pending:
            return ParamAck.IN_PROGRESS
        if result == ParamAck.ACCEPTED:
            self._store(name, value)
        return result

    def _check(self, name: str, value: SettingValue, kind: int) -> tuple[ParamAck, SettingValue]:
        """Return PARAM_ACK for the answer, and the value to store."""
        self.refresh()
        setting, definition = self.definition.settings[name], self.definition
        if setting.read_only or not self.can_set(name) or definition.excluded_by(name, self.values):
            return ParamAck.FAILED, value
        if kind != setting.wire_type:
            return ParamAck.VALUE_UNSUPPORTED, value
        value = self.limited(name, value)
        try:
            return ParamAck.ACCEPTED, definition.checked(name, value, self.values)
        except InvalidArgument:
            return ParamAck.VALUE_UNSUPPORTED, value

    def _store(self, name: str, value: SettingValue) -> None:
        has_changed = not settings_equal(self.values[name], value)
        self.values[name] = value
        if has_changed:
            self.on_set(name, value)

    def _finish_slow(self, name: str, value: SettingValue) -> None:
        self._pending.discard(name)
        self._store(name, value)
        self.acknowledge(name, ParamAck.ACCEPTED)
