"""Parameters of a simulated vehicle and the protocol that reads and sets them.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamType
from aerokit.mavlink.messages import ParamRequestList, ParamRequestRead, ParamSet, ParamValue

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["ParameterServer", "Parameters"]

_UNCOUNTED = 0xFFFF
_HASH_NAME = "_HASH_CHECK"
_NO_NAN = 0xFEFFFFFF
_LIST_BURST = 10
_LIST_PERIOD_S = 0.005

_FORMATS = {
    MavParamType.UINT8: "<B",
    MavParamType.INT8: "<b",
    MavParamType.UINT16: "<H",
    MavParamType.INT16: "<h",
    MavParamType.UINT32: "<I",
    MavParamType.INT32: "<i",
}


class Parameters:
    """Names, values and MAV_PARAM_TYPEs, in the vehicle's order. They survive a reboot."""

    def __init__(self, table: Iterable[tuple[str, float, int]]) -> None:
        self._values: dict[str, float] = {}
        self._types: dict[str, int] = {}
        for name, value, type_ in table:
            self._values[name], self._types[name] = value, type_
        self.names = tuple(self._values)

    @classmethod
    def from_text(cls, text: str) -> Parameters:
        """One ``name,value,type`` a line."""
        rows = (line.split(",") for line in text.split())
        return cls((name, float(value), int(type_)) for name, value, type_ in rows)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __setitem__(self, name: str, value: float) -> None:
        if name not in self._values:
            raise KeyError(name)
        self._values[name] = self._rounded(name, value)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def type(self, name: str) -> int:
        """The MAV_PARAM_TYPE."""
        return self._types[name]

    def _rounded(self, name: str, value: float) -> float:
        """What the vehicle can store: 32-bit floats and whole numbers within the type's range."""
        format_ = _FORMATS.get(MavParamType(self._types[name]))
        if format_ is None:
            return float(struct.unpack("<f", struct.pack("<f", value))[0])
        bits = struct.calcsize(format_) * 8
        low, high = (0, (1 << bits) - 1) if format_[1].isupper() else (-(1 << bits - 1), (1 << bits - 1) - 1)
        return float(max(low, min(high, int(value))))


class ParameterServer:
    """Answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET.

    With ``bytewise`` integers travel as their bytes (PX4), otherwise as numbers (ArduPilot). With ``hash_check`` a
    list begins with PX4's uncounted _HASH_CHECK, and setting that ends a running list. ``echoes`` PARAM_VALUEs
    follow a PARAM_SET. An unknown name is met with silence (but PX4 "main" sends PARAM_ERROR).
    """

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        parameters: Parameters,
        *,
        bytewise: bool = False,
        hash_check: bool = False,
        echoes: int = 1,
    ) -> None:
        self._vehicle = vehicle
        self._parameters = parameters
        self._bytewise = bytewise
        self._hash_check = hash_check
        self._echoes = echoes
        self._list_number = 0
        vehicle.on(ParamRequestList, self._on_list)
        vehicle.on(ParamRequestRead, self._on_read)
        vehicle.on(ParamSet, self._on_set)

    def _on_list(self, _: ParamRequestList, channel: Channel) -> None:
        self._list_number += 1
        if self._hash_check:
            self._send_hash(channel)
        self._send_from(0, channel, self._list_number)

    def _send_from(self, index: int, channel: Channel, list_number: int) -> None:
        names = self._parameters.names
        if list_number != self._list_number:
            return
        for position in range(index, min(index + _LIST_BURST, len(names))):
            self._send(names[position], position, channel)
        if index + _LIST_BURST < len(names):
            self._vehicle.call_later(
                _LIST_PERIOD_S, lambda: self._send_from(index + _LIST_BURST, channel, list_number)
            )

    def _on_read(self, request: ParamRequestRead, channel: Channel) -> None:
        names = self._parameters.names
        if request.param_index >= 0:
            if request.param_index < len(names):
                self._send(names[request.param_index], request.param_index, channel)
        elif request.param_id == _HASH_NAME and self._hash_check:
            self._send_hash(channel)
        elif request.param_id in self._parameters:
            self._send(request.param_id, names.index(request.param_id), channel)

    def _on_set(self, request: ParamSet, channel: Channel) -> None:
        name = request.param_id
        if name == _HASH_NAME and self._hash_check:
            self._list_number += 1
        if name not in self._parameters:
            return
        value = self._from_wire(request.param_value, self._parameters.type(name))
        if not math.isfinite(value):
            return
        self._parameters[name] = value
        for _ in range(self._echoes):
            self._send(name, _UNCOUNTED, None)

    def _send_hash(self, channel: Channel) -> None:
        """A checksum over names and values, so that a client can keep its list when nothing has changed."""
        parameters = self._parameters
        crc = 0
        for name in parameters.names:
            crc = zlib.crc32(name.encode() + struct.pack("<f", parameters[name]), crc)
        value = float(struct.unpack("<f", struct.pack("<I", crc & _NO_NAN))[0])
        count = len(parameters)
        self._vehicle.send(ParamValue(_HASH_NAME, value, MavParamType.UINT32, count, _UNCOUNTED), channel)

    def _send(self, name: str, index: int, channel: Channel | None) -> None:
        type_ = self._parameters.type(name)
        value = self._to_wire(self._parameters[name], type_)
        self._vehicle.send(ParamValue(name, value, type_, len(self._parameters), index), channel)

    def _to_wire(self, value: float, type_: int) -> float:
        format_ = _FORMATS.get(MavParamType(type_)) if self._bytewise else None
        if format_ is None:
            return value
        return float(struct.unpack("<f", struct.pack(format_, int(value)).ljust(4, b"\0"))[0])

    def _from_wire(self, value: float, type_: int) -> float:
        format_ = _FORMATS.get(MavParamType(type_)) if self._bytewise else None
        if format_ is None:
            return value
        return float(struct.unpack_from(format_, struct.pack("<f", value))[0])
