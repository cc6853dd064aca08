"""Parameters as PX4 serves them: whole numbers as their bytes, a hash before the list, errors that say why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamError, MavParamType
from aerokit.mavlink.messages import ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import value_message, value_of
from aerokit.parameters.pack import HASH_NAME, px4_hash
from aerokit.sim.parameter_server import ParameterServer
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.mavlink.messages import ParamRequestList, ParamRequestRead, ParamSet
    from aerokit.sim.channel import Channel
    from aerokit.sim.parameters import Parameters
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["Px4ParameterServer"]

_SECOND_ECHO_S = 0.02
_GARBAGE = 24400
"""What was seen in the field of a PARAM_ERROR that is not used."""


class Px4ParameterServer(ParameterServer):
    """With ``errors`` as main sends them (PARAM_ERROR); without, as v1.16, which says nothing.

    No value is checked: whatever the four bytes are is stored. Each PARAM_SET is confirmed to who has asked, and a
    change is told to everybody a moment later. Setting _HASH_CHECK stops a list; a request for one that runs begins
    it anew without the hash.
    """

    burst = 10

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        parameters: Parameters,
        *,
        list_rate_hz: float = 1000.0,
        errors: bool = True,
    ) -> None:
        super().__init__(vehicle, parameters, list_rate_hz=list_rate_hz)
        self.errors = errors

    def value_message(self, name: str, index: int) -> ParamValue:
        """The PARAM_VALUE of a parameter: the four bytes of its value, whatever they would be as a float."""
        parameter = self._parameters.row(name).as_parameter(index)
        return value_message(parameter, len(self._parameters), bytewise=True)

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        if request.target_system == 0:
            return
        if channel not in self._lists:
            self._send_hash(channel)
        self.start_list(channel)

    def _send_hash(self, channel: Channel) -> None:
        rows = [self._parameters.row(name) for name in self._parameters.names]
        volatile = {row.name for row in rows if row.is_volatile}
        number = px4_hash(ParameterTable(row.as_parameter() for row in rows), volatile)
        parameter = Parameter(HASH_NAME, number, ParameterType.UINT32)
        self._vehicle.send(value_message(parameter, len(rows), bytewise=True), channel)

    def _on_read(self, request: ParamRequestRead, channel: Channel) -> None:
        names, index, sender = self._parameters.names, request.param_index, sender_of(request)
        if index >= 0:
            if index < len(names):
                self.send(names[index], index, channel)
            else:
                self._refuse(sender, "", index, MavParamError.DOES_NOT_EXIST, channel)
        elif request.param_id == HASH_NAME:
            self._send_hash(channel)
        elif request.param_id in self._parameters:
            self.send(request.param_id, self._parameters.index(request.param_id), channel)
        else:
            self._refuse(sender, request.param_id, _GARBAGE, MavParamError.DOES_NOT_EXIST, channel)

    def _on_set(self, request: ParamSet, channel: Channel) -> None:
        name, parameters = request.param_id, self._parameters
        if name == HASH_NAME:
            self.stop_list(channel)
        code = self._objection(name, request.param_type)
        if code is not None:
            self._refuse(sender_of(request), name, _GARBAGE, code, channel)
            return
        value = value_of(request, bytewise=True)
        before = parameters[name]
        if name not in self._vehicle.faults.read_only_parameters:
            parameters[name] = self.clamped(name, value)
        self.send(name, parameters.index(name), channel)
        if parameters[name] != before and value == value:
            self._vehicle.call_later(_SECOND_ECHO_S, lambda: self.send(name, parameters.index(name), None))

    def _objection(self, name: str, type_: int) -> int | None:
        if name == HASH_NAME:
            return MavParamError.READ_ONLY
        if name not in self._parameters:
            return MavParamError.DOES_NOT_EXIST
        if type_ not in (MavParamType.INT32, MavParamType.REAL32):
            return MavParamError.TYPE_UNSUPPORTED
        return None if type_ == self._parameters.type(name) else MavParamError.TYPE_MISMATCH

    def _refuse(self, to: tuple[int, int], name: str, index: int, code: int, channel: Channel) -> None:
        if self.errors:
            self.send_error(to, name, index, code, channel)
