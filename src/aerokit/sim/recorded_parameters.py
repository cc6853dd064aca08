"""The parameters of a recorded vehicle: those that it told then."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavParamError
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.parameters.pack import HASH_NAME
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.recorded import RecordedVehicle

__all__ = ["RecordedParameters"]

_LIST_INTERVAL_S, _BURST = 0.005, 5


class RecordedParameters:
    """Answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET."""

    names: list[str]

    def __init__(self, vehicle: RecordedVehicle) -> None:
        self._vehicle = vehicle
        self._written: dict[str, float] = {}
        values = [value for _, value in vehicle.recording.parameters]
        counted = {
            value.param_id: value.param_index for value in values if value.param_index != UNKNOWN_INDEX
        }
        uncounted = [value.param_id for value in values if value.param_id not in counted]
        is_whole = bool(counted) and len(counted) == max(value.param_count for value in values)
        self.names = sorted(counted, key=lambda name: (counted[name], name))
        """In the order of the list."""
        self.names += [name for name in dict.fromkeys(uncounted) if name != HASH_NAME]
        self._hash = is_whole and HASH_NAME in uncounted
        """The hash is of all parameters: it says nothing when some were not recorded."""
        vehicle.on(m.ParamRequestList, self._on_list)
        vehicle.on(m.ParamRequestRead, self._on_read)
        vehicle.on(m.ParamSet, self._on_set)

    def _known(self, name: str) -> bool:
        return name in self.names or (name == HASH_NAME and self._hash)

    def value_message(self, name: str, index: int | None = None) -> m.ParamValue:
        """PARAM_VALUE as it was last told, or will be told first, or was written since."""
        position, told = self._vehicle.position_s, None
        for time, value in self._vehicle.recording.parameters:
            if value.param_id == name and (told is None or time <= position):
                told = value
        assert told is not None
        if index is None:
            index = UNKNOWN_INDEX if name == HASH_NAME else self.names.index(name)
        written = self._written.get(name, told.param_value)
        return m.ParamValue(name, written, told.param_type, len(self.names), index)

    def _on_list(self, request: m.ParamRequestList, channel: Channel) -> None:
        messages = [self.value_message(HASH_NAME)] if self._hash else []
        latest = self._latest()
        count = len(self.names)
        for index, name in enumerate(self.names):
            value = latest[name]
            written = self._written.get(name, value.param_value)
            messages.append(m.ParamValue(name, written, value.param_type, count, index))
        for number in range(0, len(messages), _BURST):
            some = messages[number : number + _BURST]
            delay = number / _BURST * _LIST_INTERVAL_S
            self._vehicle.call_later(delay, lambda some=some: self._send(some, channel))  # type: ignore[misc]

    def _latest(self) -> dict[str, m.ParamValue]:
        position, latest = self._vehicle.position_s, {}
        for time, value in self._vehicle.recording.parameters:
            if time <= position or value.param_id not in latest:
                latest[value.param_id] = value
        return latest

    def _send(self, messages: list[m.ParamValue], channel: Channel) -> None:
        for message in messages:
            self._vehicle.send(message, channel)

    def _on_read(self, request: m.ParamRequestRead, channel: Channel) -> None:
        index = request.param_index
        if index < 0 and self._known(request.param_id):
            self._vehicle.send(self.value_message(request.param_id), channel)
        elif 0 <= index < len(self.names):
            self._vehicle.send(self.value_message(self.names[index]), channel)
        else:
            self._refuse(request, request.param_id, index, channel)

    def _on_set(self, request: m.ParamSet, channel: Channel) -> None:
        name = request.param_id
        if name not in self.names:
            self._refuse(request, name, -1, channel)
            return
        if name in self._vehicle.recording.settable:
            self._written[name] = request.param_value
        self._vehicle.send(self.value_message(name))

    def _refuse(
        self, request: m.ParamRequestRead | m.ParamSet, name: str, index: int, channel: Channel
    ) -> None:
        if self._vehicle.recording.has_parameter_errors:
            error = m.ParamError(*sender_of(request), name, index, MavParamError.DOES_NOT_EXIST)
            self._vehicle.send(error, channel)
