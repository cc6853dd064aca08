"""Parameter protocol of the simulated vehicles, for ArduPilot and PX4."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable

from aerokit.mavlink.enums import MavParamError, MavParamType, MavSeverity
from aerokit.mavlink.messages import ParamRequestList, ParamRequestRead, ParamSet, ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import UNKNOWN_INDEX, value_message, value_of
from aerokit.parameters.pack import HASH_NAME, px4_hash
from aerokit.protocols.servers import parameters as servers
from aerokit.protocols.servers.host import ComponentIds
from aerokit.sim.channel import Channel
from aerokit.sim.parameters import SimParameters
from aerokit.sim.vehicle import SimulatedVehicle, sender_of


class ParameterServer(servers.ParameterProtocolServer):
    """Base of the parameter servers, which answer parameter requests. The `Faults` of the vehicle apply."""

    LIST_RATE_HZ = 1000.0

    def __init__(self, vehicle: SimulatedVehicle, parameters: SimParameters, *, sends_errors: bool) -> None:
        super().__init__(vehicle, parameters, list_rate_hz=self.LIST_RATE_HZ)
        self.sends_errors = sends_errors
        self._vehicle = vehicle
        self._parameters = parameters

    def value_message(self, name: str, index: int) -> ParamValue:
        parameters = self._parameters
        return ParamValue(name, parameters[name], parameters.type(name), len(parameters), index)

    def send(self, name: str, index: int, channel: Channel | None) -> None:
        if name not in self._vehicle.faults.mute_parameters:
            super().send(name, index, channel)

    def send_error(self, to: ComponentIds, name: str, index: int, code: int, channel: Channel) -> None:
        if self.sends_errors:
            super().send_error(to, name, index, code, channel)

    def clamped(self, name: str, value: float) -> float:
        """Apply `Faults.parameter_limits` to a value."""
        low, high = self._vehicle.faults.parameter_limits.get(name, (value, value))
        return value if math.isnan(value) else max(low, min(high, value))


_QUEUE_DEPTH = 20
_READ_PERIOD_S = 0.001
_ROUNDING_OFFSET = 0.01


class ArduPilotParameterServer(ParameterServer):
    """Parameter protocol of ArduPilot.

    - Without ``sends_errors`` (the development version of 4.7), an invalid request is not answered. A change is
      broadcast.
    - With ``sends_errors`` (the released version of 4.7), an invalid request is answered by PARAM_ERROR. A change is
      confirmed on the sender's port and then broadcast.

    One read request is served each millisecond. Up to 20 requests wait in a queue, and further requests are lost.
    The banner texts are sent before a list.
    """

    LIST_RATE_HZ = 2000.0

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        parameters: SimParameters,
        *,
        sends_errors: bool,
        send_banner: Callable[[], None],
    ) -> None:
        super().__init__(vehicle, parameters, sends_errors=sends_errors)
        self._send_banner = send_banner
        self._reads: deque[tuple[ParamRequestRead, Channel]] = deque()  # read requests that wait for their answer
        self._is_reading = False  # True while a call of `_read_next` is pending

    def restart(self) -> None:
        super().restart()
        self._reads.clear()
        self._is_reading = False

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        self._send_banner()
        self.start_list(channel)

    def _on_read(self, request: ParamRequestRead, channel: Channel) -> None:
        if len(self._reads) >= _QUEUE_DEPTH:  # The queue is full, so the request is lost.
            return
        self._reads.append((request, channel))
        if not self._is_reading:
            self._is_reading = True
            self._vehicle.call_later(0.0, self._read_next)

    def _read_next(self) -> None:
        """Answer the oldest request, and call this method again a moment later if there was one."""
        self._is_reading = bool(self._reads)
        if not self._reads:
            return
        self._vehicle.call_later(_READ_PERIOD_S, self._read_next)
        request, channel = self._reads.popleft()
        name, index = request.param_id, request.param_index
        if index != -1:
            names = self._parameters.names
            name = names[index] if 0 <= index < len(names) else ""
        if name in self._parameters:
            self.send(name, index & 0xFFFF, channel)  # In a read by name, the index is -1, which becomes 65535.
        else:
            self.send_error(sender_of(request), name, index, MavParamError.DOES_NOT_EXIST, channel)

    def _on_set(self, request: ParamSet, channel: Channel) -> None:
        name, faults = request.param_id, self._vehicle.faults
        if name not in self._parameters:
            self._refuse(request, MavParamError.DOES_NOT_EXIST, channel)
        elif not math.isfinite(request.param_value):
            self._refuse(request, MavParamError.VALUE_OUT_OF_RANGE, channel)
        elif name in faults.read_only_parameters:
            self._vehicle.send_text(MavSeverity.WARNING, f"Param write denied ({name})")
            self._refuse(request, MavParamError.PERMISSION_DENIED, channel)
            self.send(name, UNKNOWN_INDEX, channel)
        else:
            value = self.clamped(name, request.param_value)
            self._parameters[name] = rounded(value, self._parameters.type(name))
            if self.sends_errors:  # Firmware that sends PARAM_ERROR also confirms the value on the sender's port.
                self.send(name, UNKNOWN_INDEX, channel)
            self._vehicle.call_later(0.0, lambda: self.send(name, UNKNOWN_INDEX, None))

    def _refuse(self, request: ParamSet, code: int, channel: Channel) -> None:
        self.send_error(sender_of(request), request.param_id, -1, code, channel)


def rounded(value: float, type_: int) -> float:
    """Round like ArduPilot: move the value of an integer parameter 0.01 away from zero, then truncate."""
    if type_ == MavParamType.REAL32:
        return value
    shifted = value + math.copysign(_ROUNDING_OFFSET, value)
    return float(math.trunc(struct.unpack("<f", struct.pack("<f", shifted))[0]))


_BROADCAST_DELAY_S = 0.02
# PX4 does not set the index field of PARAM_ERROR. The field was observed to contain this value.
_UNUSED_INDEX = 24400


class Px4ParameterServer(ParameterServer):
    """Parameter protocol of PX4. With ``sends_errors``, it sends PARAM_ERROR, as PX4 does after version 1.16.

    Values are stored without a check. PARAM_SET is confirmed on the sender's port, and a change is broadcast shortly
    after. A list begins with _HASH_CHECK. A request during a list restarts the list without _HASH_CHECK. A PARAM_SET
    of _HASH_CHECK stops the list.
    """

    burst = 10

    def value_message(self, name: str, index: int) -> ParamValue:
        parameter = self._parameters.row(name).as_parameter(index)
        return value_message(parameter, len(self._parameters), bytewise=True)

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        if request.target_system == 0:  # PX4 ignores a request to all systems.
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
                self.send_error(sender, "", index, MavParamError.DOES_NOT_EXIST, channel)
        elif request.param_id == HASH_NAME:
            self._send_hash(channel)
        elif request.param_id in self._parameters:
            self.send(request.param_id, self._parameters.index(request.param_id), channel)
        else:
            self.send_error(sender, request.param_id, _UNUSED_INDEX, MavParamError.DOES_NOT_EXIST, channel)

    def _on_set(self, request: ParamSet, channel: Channel) -> None:
        name, parameters = request.param_id, self._parameters
        if name == HASH_NAME:  # A client that has cached the parameters sets _HASH_CHECK to stop the list.
            self.stop_list(channel)
        code = self._error_for(name, request.param_type)
        if code is not None:
            self.send_error(sender_of(request), name, _UNUSED_INDEX, code, channel)
            return
        value = value_of(request, bytewise=True)
        previous = parameters[name]
        if name not in self._vehicle.faults.read_only_parameters:
            parameters[name] = self.clamped(name, value)
        self.send(name, parameters.index(name), channel)
        is_changed = parameters[name] != previous and not math.isnan(value)  # NaN differs even from itself.
        if is_changed:
            # PX4 also broadcasts every changed parameter (mavlink_parameters.cpp).
            self._vehicle.call_later(_BROADCAST_DELAY_S, lambda: self.send(name, parameters.index(name), None))

    def _error_for(self, name: str, type_: int) -> int | None:
        """Return the MAV_PARAM_ERROR of an invalid PARAM_SET."""
        if name == HASH_NAME:
            return MavParamError.READ_ONLY
        if name not in self._parameters:
            return MavParamError.DOES_NOT_EXIST
        if type_ not in (MavParamType.INT32, MavParamType.REAL32):
            return MavParamError.TYPE_UNSUPPORTED
        return None if type_ == self._parameters.type(name) else MavParamError.TYPE_MISMATCH
