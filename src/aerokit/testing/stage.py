"""Runs beside the simulated vehicles of a test: scheduled actions, tracks, journals and the recording of the link."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

from aerokit.mavlink.framer import Framer
from aerokit.mavlink.tlog import TlogWriter
from aerokit.sim.vehicle import SimulatedVehicle
from aerokit.testing.journal import Journal
from aerokit.testing.track import record_track, true_point

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.server import SimulatorServer
    from aerokit.testing.track import Track

# Simulated seconds between two checks of a condition.
_POLL_INTERVAL_S = 0.1


class FlightScheduler(SimulatedVehicle):
    """Runs scheduled actions. The server treats the scheduler as one more vehicle, which sends nothing.

    The actions survive a reboot of a vehicle, and are not delayed while a vehicle is frozen. Pass the scheduler to the
    server before the vehicles, because the scheduler advances the vehicles to the time of each action.
    """

    def __init__(self, vehicles: Sequence[Any]) -> None:
        super().__init__(system_id=0, component_id=0, seed=0, components=())
        self._vehicles = vehicles
        self.tracks: list[Track] = [record_track(vehicle) for vehicle in vehicles]
        """Tracks in the order of the vehicles."""
        self.journals: list[Journal] = [Journal() for _ in vehicles]
        """Journals in the order of the vehicles."""
        for vehicle, journal in zip(vehicles, self.journals, strict=True):
            vehicle.journal = journal

    def step(self, now: float) -> None:
        """Advance all vehicles to the time of each due action, then run the action."""
        while (due := self.next_due) <= now:
            for vehicle in self._vehicles:
                vehicle.step(max(due, vehicle.now))
            super().step(due)
        super().step(now)

    def receive(self, data: bytes, now: float, peer: Hashable = None, channel: Channel | None = None) -> None:
        self.step(now)

    def do(self, action: Callable[[], None], *, after_s: float) -> None:
        """Run an action after ``after_s`` simulated seconds. 0 means at once."""
        if after_s:
            self.call_later(after_s, action)
        else:
            action()

    def do_when(self, condition: Callable[[], bool], action: Callable[[], None]) -> None:
        """Run an action once, as soon as a condition is true.

        The condition is checked ten times per simulated second.
        """
        if condition():
            action()
        else:
            self.call_later(_POLL_INTERVAL_S, lambda: self.do_when(condition, action))

    def record(self) -> None:
        """Append the current points to the tracks."""
        for vehicle, track in zip(self._vehicles, self.tracks, strict=True):
            track.append(true_point(vehicle))

    def refresh_with(self, refresh: Callable[[], None] | None) -> None:
        for track in self.tracks:
            track.refresh_with(refresh)


# UTC at simulated second 0, which is the same in every run.
_UTC_AT_START = 1_790_000_000.0


class FlightRecording:
    """Records the traffic of a server in memory, as a .tlog that grows by some kilobytes per simulated second."""

    def __init__(self) -> None:
        self._file = BytesIO()
        self._writer = TlogWriter(self._file)
        self._sent_framer = Framer()
        self._received_framer = Framer()
        self._sent_framer.keep_unknown = True
        self._received_framer.keep_unknown = True

    def attach(self, server: SimulatorServer) -> None:
        server.on_datagram = self._write

    def to_bytes(self) -> bytes:
        return self._file.getvalue()

    def _write(self, time_s: float, data: bytes, is_sent: bool) -> None:
        framer = self._sent_framer if is_sent else self._received_framer
        for frame in framer.receive(data, time_s):
            self._writer.write(frame.raw, _UTC_AT_START + time_s)
