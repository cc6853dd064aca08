"""``FlightRecording``: all that went over the links of simulated vehicles in a test, as a ``.tlog``."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

from aerokit.mavlink.framer import Framer
from aerokit.mavlink.tlog import TlogWriter

if TYPE_CHECKING:
    from aerokit.sim.server import SimulatorServer

__all__ = ["FlightRecording"]

_BEGAN_AT = 1_790_000_000.0
"""UTC of the simulated second 0: the same in every run."""


class FlightRecording:
    """Kept in memory, some kilobytes a simulated second, because most tests succeed."""

    def __init__(self) -> None:
        self._file = BytesIO()
        self._writer = TlogWriter(self._file)
        self._framers = Framer(), Framer()
        for framer in self._framers:
            framer.keep_unknown = True

    def follow(self, server: SimulatorServer) -> None:
        """Record what this server sends and hears from now on."""
        server.on_datagram = self._take

    def to_bytes(self) -> bytes:
        """The file."""
        return self._file.getvalue()

    def _take(self, time_s: float, data: bytes, is_sent: bool) -> None:
        for frame in self._framers[is_sent].receive(data, time_s):
            self._writer.write(frame.raw, _BEGAN_AT + time_s)
