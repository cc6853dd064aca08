"""Parameters as PX4 serves them: whole numbers as their bytes, a hash before the list, errors that say why."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamError, MavParamType
from aerokit.mavlink.messages import ParamValue
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.parameters.px4_hash import HASH_NAME
from aerokit.sim.parameter_server import ParameterServer
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.mavlink.messages import ParamRequestList, ParamRequestRead, ParamSet
    from aerokit.sim.channel import Channel
    from aerokit.sim.parameters import Parameters
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["Px4ParameterServer", "parameter_hash"]

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
        parameters, type_ = self._parameters, self._parameters.type(name)
        return _BytewiseParamValue(name, _bits(parameters[name], type_), type_, len(parameters), index)

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        if request.target_system == 0:
            return
        if channel not in self._lists:
            self._send_hash(channel)
        self.start_list(channel)

    def _send_hash(self, channel: Channel) -> None:
        bits, count = parameter_hash(self._parameters).to_bytes(4, "little"), len(self._parameters)
        message = _BytewiseParamValue(HASH_NAME, bits, MavParamType.UINT32, count, UNKNOWN_INDEX)
        self._vehicle.send(message, channel)

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
        frame = request.received_frame
        bits = struct.pack("<f", request.param_value) if frame is None else frame.payload[:4].ljust(4, b"\0")
        (value,) = struct.unpack("<i" if request.param_type == MavParamType.INT32 else "<f", bits)
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


class _BytewiseParamValue(ParamValue):
    """A float on its way through Python loses a bit of a signalling NaN; these four bytes lose none."""

    def __init__(self, name: str, bits: bytes, type_: int, count: int, index: int) -> None:
        super().__init__(name, struct.unpack("<f", bits)[0], type_, count, index)
        object.__setattr__(self, "_bits", bits)

    def encode(self) -> bytes:
        bits: bytes = object.__getattribute__(self, "_bits")
        return bits + super().encode()[len(bits) :]


def parameter_hash(parameters: Parameters) -> int:
    """The _HASH_CHECK: over names and values in order, volatile ones left out."""
    crc = 0xFFFFFFFF
    for name in parameters.names:
        row = parameters.row(name)
        if not row.is_volatile:
            crc = zlib.crc32(_bits(row.value, row.type), zlib.crc32(name.encode(), crc))
    return crc ^ 0xFFFFFFFF


def _bits(value: float, type_: int) -> bytes:
    return struct.pack("<i", int(value)) if type_ == MavParamType.INT32 else struct.pack("<f", value)
