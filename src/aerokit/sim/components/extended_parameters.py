"""The settings of a simulated device by PARAM_EXT, as a definition file describes them.

https://mavlink.io/en/services/parameter_ext.html
"""

from __future__ import annotations

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavParamExtType, ParamAck
from aerokit.parameters import CameraDefinition, SettingValue
from aerokit.parameters.setting import setting_bytes, setting_value, settings_equal
from aerokit.sim.channel import Channel
from aerokit.sim.components.component import SimulatedComponent

_LIST_S = 0.01
_ZEROS: dict[str, SettingValue] = {"bool": False, "float": 0.0, "double": 0.0, "string": "", "custom": ""}


class ExtendedParameters:
    """Answers PARAM_EXT_REQUEST_LIST, PARAM_EXT_REQUEST_READ and PARAM_EXT_SET of a component; call it in ``listen()``.

    A list goes out a hundred parameters a second. What the definition does not allow is VALUE_UNSUPPORTED, what can
    only be read, or is excluded by other values, FAILED. What can only be written is neither listed nor told. Values
    stay over a reboot. Of the component's faults ``mute_parameters`` and ``parameter_limits`` act on these, too.
    """

    def __init__(self, component: SimulatedComponent, definition: CameraDefinition) -> None:
        self.definition = definition
        self.values: dict[str, SettingValue] = {}
        """What each is now; change it at any time."""
        self.slow: dict[str, float] = {}
        """Name → seconds that setting it takes: IN_PROGRESS, and later the result."""
        self._component = component
        self._under_way: set[str] = set()
        self._list_number = 0
        self.reset()
        component.on(m.ParamExtRequestList, self._on_list)
        component.on(m.ParamExtRequestRead, self._on_read)
        component.on(m.ParamExtSet, self._on_set)

    def reset(self) -> None:
        """All as they were from the factory."""
        for name, each in self.definition.settings.items():
            self.values[name] = _ZEROS.get(each.type, 0) if each.default is None else each.default

    def refresh(self) -> None:
        """Called before a value is told or set: for what changes by itself."""

    def can_set(self, name: str) -> bool:
        """Whether a setting can be set now; FAILED is the answer when not."""
        return True

    def has_set(self, name: str, value: SettingValue) -> None:
        """Called when a setting has got another value."""

    def restart(self) -> None:
        """Forget what is under way, as a reboot does."""
        self._under_way.clear()
        self._list_number += 1

    @property
    def _names(self) -> list[str]:
        return [name for name, each in self.definition.settings.items() if not each.write_only]

    def _on_list(self, _: m.ParamExtRequestList, channel: Channel) -> None:
        self._list_number += 1
        self._send_from(0, self._list_number, channel)

    def _send_from(self, index: int, number: int, channel: Channel) -> None:
        if number == self._list_number and index < len(self._names):
            self._tell(self._names[index], channel)
            self._component.call_later(_LIST_S, lambda: self._send_from(index + 1, number, channel))

    def _on_read(self, request: m.ParamExtRequestRead, channel: Channel) -> None:
        names = self._names
        if 0 <= request.param_index < len(names):
            self._tell(names[request.param_index], channel)
        elif request.param_index < 0 and request.param_id in names:
            self._tell(request.param_id, channel)

    def _tell(self, name: str, channel: Channel | None) -> None:
        if name in self._component.faults.mute_parameters:
            return
        self.refresh()
        kind, names = self.definition.settings[name].wire_type, self._names
        data = setting_bytes(self.values[name], kind)
        self._component.send(m.ParamExtValue(name, data, kind, len(names), names.index(name)), channel)

    def _on_set(self, request: m.ParamExtSet, _: Channel) -> None:
        name, kind = request.param_id, request.param_type
        own = self.definition.settings.get(name)
        if own is None:
            self._acknowledge(name, request.param_value, kind, ParamAck.VALUE_UNSUPPORTED)
            return
        result, value = self._verdict(name, setting_value(request.param_value, kind), kind)
        if result == ParamAck.ACCEPTED and name in self.slow and name not in self._under_way:
            self._under_way.add(name)
            self._component.call_later(self.slow[name], lambda: self._finish(name, value))
        if name in self._under_way:
            self._told(name, ParamAck.IN_PROGRESS)
        elif result == ParamAck.ACCEPTED:
            self._finish(name, value)
        else:
            self._told(name, result)

    def _verdict(self, name: str, value: SettingValue, kind: int) -> tuple[ParamAck, SettingValue]:
        self.refresh()
        own, definition = self.definition.settings[name], self.definition
        if own.read_only or not self.can_set(name) or definition.excluded_by(name, self.values):
            return ParamAck.FAILED, value
        if kind != own.wire_type:
            return ParamAck.VALUE_UNSUPPORTED, value
        low, high = self._component.faults.parameter_limits.get(name, (None, None))
        if low is not None and high is not None and isinstance(value, (int, float)):
            value = type(value)(max(low, min(high, value)))
        try:
            return ParamAck.ACCEPTED, definition.checked(name, value, self.values)
        except InvalidArgument:
            return ParamAck.VALUE_UNSUPPORTED, value

    def _finish(self, name: str, value: SettingValue) -> None:
        self._under_way.discard(name)
        is_new = not settings_equal(self.values[name], value)
        self.values[name] = value
        if is_new:
            self.has_set(name, value)
        self._told(name, ParamAck.ACCEPTED)

    def _told(self, name: str, result: int) -> None:
        kind = self.definition.settings[name].wire_type
        self._acknowledge(name, setting_bytes(self.values[name], kind), kind, result)

    def _acknowledge(self, name: str, data: bytes, kind: int, result: int) -> None:
        known = kind if kind in MavParamExtType.__members__.values() else int(MavParamExtType.CUSTOM)
        self._component.send(m.ParamExtAck(name, data, known, result))
