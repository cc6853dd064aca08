"""Servers for PARAM_* and PARAM_EXT_*, and the server of the settings in a camera definition file.

https://mavlink.io/en/services/parameter.html, https://mavlink.io/en/services/parameter_ext.html,
https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavParamExtType, ParamAck
from aerokit.parameters import CameraDefinition, SettingValue
from aerokit.parameters.parameter import setting_bytes, setting_value, settings_equal
from aerokit.protocols.servers.host import Channel, ComponentIds, ServerHost


class NamedList(Protocol):
    """Names of the parameters to list; the position of a name is its index."""

    @property
    def names(self) -> Sequence[str]: ...


class ParameterLists:
    """Sends all parameters on a channel when a client requests the list.

    It sends ``burst`` parameters at a time, ``list_rate_hz`` parameters per second. A new request restarts the list.
    """

    burst: int = 5
    starts_at_once: bool = False
    """True to send the first group at once, False to send it after the interval between groups."""

    def __init__(self, host: ServerHost, parameters: NamedList, *, list_rate_hz: float) -> None:
        self.list_rate_hz = list_rate_hz
        self._host = host
        self._listed = parameters
        self._lists: dict[Channel, int] = {}  # channel → number of the list that is being sent on it
        self._list_number = 0  # number of the latest list

    @property
    def running_lists(self) -> int:
        return len(self._lists)

    def restart(self) -> None:
        """Drop the lists that are being sent, as a reboot does."""
        self._lists.clear()

    def start_list(self, channel: Channel) -> None:
        """Send all parameters on a channel. A list that is being sent there starts again."""
        self._list_number += 1
        number = self._list_number
        self._lists[channel] = number
        if self.starts_at_once:
            self._send_group(0, channel, number)
        else:
            self._host.call_later(self._group_interval_s, lambda: self._send_group(0, channel, number))

    def stop_list(self, channel: Channel) -> None:
        self._lists.pop(channel, None)

    @property
    def _group_interval_s(self) -> float:
        return self.burst / self.list_rate_hz

    def _send_group(self, start: int, channel: Channel, number: int) -> None:
        if self._lists.get(channel) != number:  # The list was stopped, or restarted with another number.
            return
        names, end = self._listed.names, start + self.burst
        for index, name in enumerate(names[start:end], start=start):
            self.send(name, index, channel)
        if end >= len(names):
            self.stop_list(channel)
            return
        self._host.call_later(self._group_interval_s, lambda: self._send_group(end, channel, number))

    def send_requested(self, name: str, index: int, channel: Channel) -> bool:
        """Send the parameter with this index or, if it is negative, with this name. Return False if there is none."""
        names = self._listed.names
        if index < 0 and name in names:
            index = names.index(name)
        if not 0 <= index < len(names):
            return False
        self.send(names[index], index, channel)
        return True

    def send(self, name: str, index: int, channel: Channel) -> None:
        """Send a value on one channel, or on all channels (None)."""
        raise NotImplementedError


class ParameterProtocolServer(ParameterLists):
    """Receives PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; subclasses answer them."""

    def __init__(self, host: ServerHost, parameters: NamedList, *, list_rate_hz: float) -> None:
        super().__init__(host, parameters, list_rate_hz=list_rate_hz)
        host.on(m.ParamRequestList, self._on_list)
        host.on(m.ParamRequestRead, self._on_read)
        host.on(m.ParamSet, self._on_set)

    def _on_list(self, request: m.ParamRequestList, channel: Channel) -> None:
        raise NotImplementedError

    def _on_read(self, request: m.ParamRequestRead, channel: Channel) -> None:
        raise NotImplementedError

    def _on_set(self, request: m.ParamSet, channel: Channel) -> None:
        raise NotImplementedError

    def value_message(self, name: str, index: int) -> m.ParamValue:
        raise NotImplementedError

    def send(self, name: str, index: int, channel: Channel) -> None:
        self._host.send(self.value_message(name, index), channel)

    def send_error(self, to: ComponentIds, name: str, index: int, code: int, channel: Channel) -> None:
        self._host.send(m.ParamError(*to, name, index, code), channel)


class ExtendedParameterServer(ParameterLists):
    """Receives PARAM_EXT_REQUEST_LIST, PARAM_EXT_REQUEST_READ and PARAM_EXT_SET; subclasses store the values.

    One list is sent at a time, with a hundred parameters a second.
    """

    burst: int = 1
    starts_at_once: bool = True

    def __init__(self, host: ServerHost, parameters: NamedList, *, list_rate_hz: float = 100.0) -> None:
        super().__init__(host, parameters, list_rate_hz=list_rate_hz)
        host.on(m.ParamExtRequestList, self._on_list)
        host.on(m.ParamExtRequestRead, self._on_read)
        host.on(m.ParamExtSet, self._on_set)

    def value(self, name: str) -> tuple[SettingValue, int]:
        """Return value and MAV_PARAM_EXT_TYPE."""
        raise NotImplementedError

    def __contains__(self, name: object) -> bool:
        raise NotImplementedError

    def set(self, name: str, data: bytes, kind: int) -> int:
        """Set a known parameter, and return the PARAM_ACK."""
        raise NotImplementedError

    def _on_list(self, _: m.ParamExtRequestList, channel: Channel) -> None:
        self._lists.clear()
        self.start_list(channel)

    def _on_read(self, request: m.ParamExtRequestRead, channel: Channel) -> None:
        self.send_requested(request.param_id, request.param_index, channel)

    def send(self, name: str, index: int, channel: Channel) -> None:
        value, kind = self.value(name)
        names = self._listed.names
        self._host.send(m.ParamExtValue(name, setting_bytes(value, kind), kind, len(names), index), channel)

    def _on_set(self, request: m.ParamExtSet, _: Channel) -> None:
        name, data, kind = request.param_id, request.param_value, request.param_type
        if name in self:
            self.acknowledge(name, self.set(name, data, kind))
        else:
            known_type = kind if kind in MavParamExtType.__members__.values() else int(MavParamExtType.CUSTOM)
            self._host.send(m.ParamExtAck(name, data, known_type, ParamAck.VALUE_UNSUPPORTED))

    def acknowledge(self, name: str, result: int) -> None:
        """Send the result of a change, with the present value."""
        value, kind = self.value(name)
        # All channels get the acknowledgement, because other clients read changes from it.
        self._host.send(m.ParamExtAck(name, setting_bytes(value, kind), kind, result))


_ZEROS: dict[str, SettingValue] = {"bool": False, "float": 0.0, "double": 0.0, "string": "", "custom": ""}


class DefinedParameterServer(ExtendedParameterServer):
    """Settings that a camera definition defines.

    Write-only settings are not listed. The answer to a value that the definition does not allow is VALUE_UNSUPPORTED.
    The answer is FAILED for a setting that is read-only, or that the present value of another setting excludes.
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
