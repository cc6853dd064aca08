"""Servers for PARAM_* and PARAM_EXT_*, of typed parameters and of the settings in a camera definition file.

https://mavlink.io/en/services/parameter.html, https://mavlink.io/en/services/parameter_ext.html,
https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavParamError, MavParamExtType, ParamAck
from aerokit.parameters import CameraDefinition, Parameter, ParameterType, SettingValue
from aerokit.parameters.encoding import UNKNOWN_INDEX, value_message, value_of
from aerokit.parameters.parameter import setting_bytes, setting_value, settings_equal
from aerokit.protocols.servers.host import Channel, ComponentIds, ServerHost, sender_of

MAX_LISTS = 8
"""Maximum number of lists that a component sends at once; it ignores further requests."""


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


class ParameterRefusal(NamedTuple):
    """Reason why a value is not stored: a MAV_PARAM_ERROR, and the PARAM_ACK for the extended protocol."""

    error: MavParamError
    ack: ParamAck


class TypedStore(NamedList, Protocol):
    """Typed parameters of a component."""

    @property
    def param_names(self) -> Sequence[str]:
        """Names of the parameters whose values fit into PARAM_VALUE.

        This must be fast, because every PARAM_VALUE needs it.
        """
        ...

    def __contains__(self, name: object) -> bool: ...

    def __getitem__(self, name: str) -> SettingValue: ...

    def type(self, name: str) -> MavParamExtType: ...

    def refusal(self, name: str, value: SettingValue, type: int) -> ParameterRefusal | None:  # noqa: A002
        """Return the reason if the value must not be stored, otherwise None."""
        ...

    def store(self, name: str, value: SettingValue) -> None: ...


class TypedParameterServer(ParameterProtocolServer):
    """PARAM server for typed parameters. It encodes values bytewise or casts them to float.

    A refused PARAM_SET is answered with PARAM_ERROR, and with PARAM_VALUE (the unchanged value) for clients that do not
    know PARAM_ERROR. Texts and 64-bit numbers do not fit into PARAM_VALUE, and are left out.
    """

    def __init__(self, host: ServerHost, store: TypedStore, *, bytewise: bool = True, list_rate_hz: float) -> None:
        self.bytewise = bytewise
        self._store = store
        super().__init__(host, self, list_rate_hz=list_rate_hz)

    @property
    def names(self) -> Sequence[str]:
        return self._store.param_names

    def value_message(self, name: str, index: int) -> m.ParamValue:
        value, type_ = self._store[name], ParameterType(self._store.type(name))
        assert isinstance(value, (int, float))
        parameter = Parameter(name, value, type_, index=None if index == UNKNOWN_INDEX else index)
        return value_message(parameter, len(self.names), bytewise=self.bytewise)

    def publish(self, name: str) -> None:
        """Send a value to all programs. Does nothing if its type does not fit into PARAM_VALUE."""
        if fits_param_value(self._store.type(name)):
            self.send(name, self.names.index(name), None)

    def _on_list(self, request: m.ParamRequestList, channel: Channel) -> None:
        if channel in self._lists or len(self._lists) < MAX_LISTS:
            self.start_list(channel)

    def _on_read(self, request: m.ParamRequestRead, channel: Channel) -> None:
        name, index = request.param_id, request.param_index
        if not self.send_requested(name, index, channel):
            unknown_name = name if index < 0 else ""
            self.send_error(sender_of(request), unknown_name, index, MavParamError.DOES_NOT_EXIST, channel)

    def _on_set(self, request: m.ParamSet, channel: Channel) -> None:
        name, names, store = request.param_id, self.names, self._store
        if name not in names:
            self.send_error(sender_of(request), name, -1, MavParamError.DOES_NOT_EXIST, channel)
            return
        value = value_of(request, bytewise=self.bytewise)
        # If values are cast to float, the received type is ignored: ArduPilot's clients send all values as REAL32.
        refusal = store.refusal(name, value, request.param_type if self.bytewise else store.type(name))
        if refusal is not None:
            self.send_error(sender_of(request), name, names.index(name), refusal.error, channel)
            self.send(name, names.index(name), channel)
            return
        old_value = store[name]
        store.store(name, value)
        is_unchanged = settings_equal(old_value, store[name])
        # A changed value is sent to all programs.
        self.send(name, names.index(name), channel if is_unchanged else None)


def fits_param_value(type_: MavParamExtType) -> bool:
    """Return True if the four bytes of PARAM_VALUE can hold values of this type."""
    return type_ <= MavParamExtType.INT32 or type_ == MavParamExtType.REAL32


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


class TypedExtendedServer(ExtendedParameterServer):
    """PARAM_EXT server for typed parameters, including texts."""

    def __init__(self, host: ServerHost, store: TypedStore) -> None:
        super().__init__(host, store)
        self._store = store

    def value(self, name: str) -> tuple[SettingValue, int]:
        return self._store[name], self._store.type(name)

    def __contains__(self, name: object) -> bool:
        return name in self._store

    def set(self, name: str, data: bytes, kind: int) -> int:
        store, value = self._store, setting_value(data, kind)
        if isinstance(store[name], str) and value == b"":  # An empty text and empty bytes are the same on the wire.
            value = ""
        refusal = store.refusal(name, value, kind)
        if refusal is not None:
            return refusal.ack
        store.store(name, value)
        return ParamAck.ACCEPTED


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
