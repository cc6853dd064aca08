"""Parameters over messages: what the servers of all autopilots have in common.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.messages import ParamError, ParamRequestList, ParamRequestRead, ParamSet, ParamValue

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.parameters import Parameters
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["ParameterServer"]


class ParameterServer:
    """Answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; an autopilot's own class says how.

    A list goes out ``list_rate_hz`` parameters a second, ``burst`` at once, each port its own.
    """

    burst = 5

    def __init__(self, vehicle: SimulatedVehicle, parameters: Parameters, *, list_rate_hz: float) -> None:
        self.list_rate_hz = list_rate_hz
        self._vehicle = vehicle
        self._parameters = parameters
        self._lists: dict[Channel, int] = {}
        self._list_number = 0
        vehicle.on(ParamRequestList, self._on_list)
        vehicle.on(ParamRequestRead, self._on_read)
        vehicle.on(ParamSet, self._on_set)

    @property
    def running_lists(self) -> int:
        """On how many ports a list is on its way."""
        return len(self._lists)

    def restart(self) -> None:
        """Forget everything, as a reboot does."""
        self._lists.clear()

    # ------------------------------------------------------------------------------------------- list

    def start_list(self, channel: Channel) -> None:
        """Send all of them on a port; a list that runs there begins anew."""
        self._list_number += 1
        self._lists[channel] = number = self._list_number
        self._vehicle.call_later(self.burst / self.list_rate_hz, lambda: self._send_from(0, channel, number))

    def stop_list(self, channel: Channel) -> None:
        """Send no more of them."""
        self._lists.pop(channel, None)

    def _send_from(self, index: int, channel: Channel, number: int) -> None:
        if self._lists.get(channel) != number:
            return
        names, end = self._parameters.names, index + self.burst
        for position, name in enumerate(names[index:end], start=index):
            self.send(name, position, channel)
        if end >= len(names):
            self.stop_list(channel)
            return
        self._vehicle.call_later(
            self.burst / self.list_rate_hz, lambda: self._send_from(end, channel, number)
        )

    # ------------------------------------------------------------------------------------- what differs

    def _on_list(self, request: ParamRequestList, channel: Channel) -> None:
        raise NotImplementedError

    def _on_read(self, request: ParamRequestRead, channel: Channel) -> None:
        raise NotImplementedError

    def _on_set(self, request: ParamSet, channel: Channel) -> None:
        raise NotImplementedError

    def value_message(self, name: str, index: int) -> ParamValue:
        """The PARAM_VALUE of a parameter."""
        parameters = self._parameters
        return ParamValue(name, parameters[name], parameters.type(name), len(parameters), index)

    # ---------------------------------------------------------------------------------------- sending

    def send(self, name: str, index: int, channel: Channel | None) -> None:
        """Send a value on one port, or on all."""
        if name not in self._vehicle.faults.mute_parameters:
            self._vehicle.send(self.value_message(name, index), channel)

    def send_error(self, to: tuple[int, int], name: str, index: int, code: int, channel: Channel) -> None:
        """Send a PARAM_ERROR."""
        self._vehicle.send(ParamError(*to, name, index, code), channel)

    def clamped(self, name: str, value: float) -> float:
        """What remains of a value under the limits among the faults."""
        low, high = self._vehicle.faults.parameter_limits.get(name, (value, value))
        return max(low, min(high, value)) if value == value else value
