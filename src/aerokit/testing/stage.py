"""What stands beside simulated vehicles in a test: an agenda in simulated time, their tracks and journals."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

from aerokit.mavlink.framer import Framer
from aerokit.mavlink.tlog import TlogWriter
from aerokit.sim.journal import Journal
from aerokit.sim.track import record_track, true_point
from aerokit.sim.vehicle import SimulatedVehicle

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.server import SimulatorServer
    from aerokit.sim.track import Track

_LOOK_S = 0.1
"""How often conditions are looked at, in simulated seconds."""


class Stagehand(SimulatedVehicle):
    """On the links with the vehicles, but dumb: it does what is planned at its simulated second.

    A timer of a vehicle is forgotten when the vehicle reboots and late when it hangs; one of these is not. Give it
    to the server before the vehicles: it steps them to the instant of what it does.
    """

    def __init__(self, vehicles: Sequence[Any]) -> None:
        super().__init__(system_id=0, component_id=0, seed=0, components=())
        self._vehicles = vehicles
        self.tracks: list[Track] = [record_track(vehicle) for vehicle in vehicles]
        """Of each vehicle, in their order."""
        self.journals: list[Journal] = [Journal() for _ in vehicles]
        """The same."""
        for vehicle, journal in zip(vehicles, self.journals, strict=True):
            vehicle.journal = journal

    def step(self, now: float) -> None:
        """See `SimulatedVehicle`."""
        while (due := self.next_due) <= now:
            for vehicle in self._vehicles:
                vehicle.step(max(due, vehicle.now))
            super().step(due)
        super().step(now)

    def receive(self, data: bytes, now: float, peer: Hashable = None, channel: Channel | None = None) -> None:
        """It has no ears."""
        self.step(now)

    def boot(self) -> None:
        """It is there at once."""

    def start_channel(self, channel: Channel) -> None:
        """It sends nothing."""

    def do(self, action: Callable[[], None], *, after_s: float) -> None:
        """Do it now, or so many simulated seconds later."""
        if after_s:
            self.call_later(after_s, action)
        else:
            action()

    def do_when(self, condition: Callable[[], bool], action: Callable[[], None]) -> None:
        """Do it as soon as the condition holds, looked at ten times a simulated second; once."""
        if condition():
            action()
        else:
            self.call_later(_LOOK_S, lambda: self.do_when(condition, action))

    def record(self) -> None:
        """Write down where everybody is now, besides what the tracks note by themselves."""
        for vehicle, track in zip(self._vehicles, self.tracks, strict=True):
            track.append(true_point(vehicle))

    def follow(self, catch_up: Callable[[], None] | None) -> None:
        """See `Track.follow`."""
        for track in self.tracks:
            track.follow(catch_up)


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
