"""RTCM corrections that a simulated vehicle receives by GPS_RTCM_DATA."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.messages import GpsRtcmData

if TYPE_CHECKING:
    from aerokit.sim.vehicle import SimulatedVehicle

_MAX_AGE_S = 5.0
_FRAGMENT_SIZE = 180


class ReceivedCorrections:
    """Assembles the fragments of RTCM messages as ArduPilot does (AP_GPS.cpp, handle_gps_rtcm_fragment).

    ``messages`` has the assembled messages; ``is_recent`` is True while they arrive.
    """

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self.messages: list[bytes] = []
        self._received_at = -math.inf
        self._sequence, self._pieces = -1, dict[int, bytes]()
        vehicle.on(GpsRtcmData, lambda message, _: self._on_fragment(message))

    @property
    def is_recent(self) -> bool:
        return self._vehicle.now - self._received_at < _MAX_AGE_S

    def _on_fragment(self, message: GpsRtcmData) -> None:
        data = bytes(message.data[: message.len])
        if not message.flags & 1:
            self._add(data)
            return
        number, sequence = message.flags >> 1 & 3, message.flags >> 3
        if sequence != self._sequence or number in self._pieces:
            self._pieces.clear()
        self._sequence, self._pieces[number] = sequence, data
        is_ended = any(len(piece) < _FRAGMENT_SIZE for piece in self._pieces.values()) or len(self._pieces) == 4
        if is_ended and len(self._pieces) == max(self._pieces) + 1:
            self._add(b"".join(self._pieces[index] for index in range(len(self._pieces))))
            self._pieces.clear()

    def _add(self, message: bytes) -> None:
        self.messages.append(message)
        del self.messages[:-1000]
        self._received_at = self._vehicle.now
