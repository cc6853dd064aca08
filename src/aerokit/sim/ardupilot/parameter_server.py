"""Parameters as ArduPilot serves them: numbers as floats, whatever their type."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamError, MavParamType, MavSeverity
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.sim.parameter_server import ParameterServer
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.mavlink.messages import ParamRequestList, ParamRequestRead, ParamSet
    from aerokit.sim.channel import Channel
    from aerokit.sim.parameters import Parameters
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["ArduPilotParameterServer", "rounded"]

_QUEUE_DEPTH = 20
_READ_PERIOD_S = 0.001
_BOTH_WAYS = 0.01


class ArduPilotParameterServer(ParameterServer):
    """The development version of 4.7 says nothing to an unknown name or a value that is no number; with ``errors``
    it sends PARAM_ERROR, as the released one does, and confirms to who has asked besides telling everybody.

    Reads wait in a queue of twenty, one is done each millisecond; what does not fit is lost. A list begins with
    the banner.
    """

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        parameters: Parameters,
        *,
        list_rate_hz: float = 2000.0,
        errors: bool = False,
        send_banner: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(vehicle, parameters, list_rate_hz=list_rate_hz)
        self.errors = errors
        self._send_banner = send_banner
        self._reads: deque[tuple[ParamRequestRead, Channel]] = deque()
        self._is_reading = False

    def restart(self) -> None:
        """Forget everything, as a reboot does."""
        super().restart()
        self._reads.clear()
        self._is_reading = False

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        self._send_banner()
        self.start_list(channel)

    def _on_read(self, request: ParamRequestRead, channel: Channel) -> None:
        if len(self._reads) >= _QUEUE_DEPTH:
            return
        self._reads.append((request, channel))
        if not self._is_reading:
            self._is_reading = True
            self._vehicle.call_later(0.0, self._read_next)

    def _read_next(self) -> None:
        self._is_reading = bool(self._reads)
        if not self._reads:
            return
        self._vehicle.call_later(_READ_PERIOD_S, self._read_next)
        request, channel = self._reads.popleft()
        names, index = self._parameters.names, request.param_index
        name = request.param_id if index == -1 else names[index] if 0 <= index < len(names) else ""
        if name in self._parameters:
            self.send(name, index & 0xFFFF, channel)
        elif self.errors:
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
            if self.errors:
                self.send(name, UNKNOWN_INDEX, channel)
            self._vehicle.call_later(0.0, lambda: self.send(name, UNKNOWN_INDEX, None))

    def _refuse(self, request: ParamSet, code: int, channel: Channel) -> None:
        if self.errors:
            self.send_error(sender_of(request), request.param_id, -1, code, channel)


def rounded(value: float, type_: int) -> float:
    """What ArduPilot makes of a float for a whole number: a hundredth is added away from zero, the rest cut off."""
    if type_ == MavParamType.REAL32:
        return value
    shifted = value + math.copysign(_BOTH_WAYS, value)
    return float(math.trunc(struct.unpack("<f", struct.pack("<f", shifted))[0]))
