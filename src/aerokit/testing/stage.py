"""What stands beside simulated vehicles in a test: an agenda in simulated time, and the recorder of true tracks."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any

from aerokit.position import Position
from aerokit.sim.px4.modes import KNOWN
from aerokit.sim.vehicle import SimulatedVehicle
from aerokit.testing.track import Track, TrackPoint

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel

__all__ = ["Stagehand", "new_track", "true_point"]

_INTERVAL_S = 0.1


class Stagehand(SimulatedVehicle):
    """On the links with the vehicles, but dumb: it does what is planned at its simulated second and records tracks.

    A timer of a vehicle is forgotten when the vehicle reboots and late when it hangs; one of these is not. Give it
    to the server before the vehicles: it steps them to the instant of what it does.
    """

    def __init__(self, vehicles: Sequence[Any]) -> None:
        super().__init__(system_id=0, component_id=0, seed=0, components=())
        self._vehicles = vehicles
        self.tracks = [new_track(vehicle) for vehicle in vehicles]
        """Of each vehicle, in their order."""

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

    def record(self) -> None:
        """Write down where everybody is now."""
        for vehicle, track in zip(self._vehicles, self.tracks, strict=True):
            track.append(true_point(vehicle))

    def follow(self, catch_up: Callable[[], None] | None) -> None:
        """See `Track.follow`."""
        for track in self.tracks:
            track.follow(catch_up)

    def boot(self) -> None:
        """Begin to record."""
        self.every(_INTERVAL_S, self.record, first=0.0)

    def start_channel(self, channel: Channel) -> None:
        """It sends nothing."""

    def do(self, action: Callable[[], None], *, after_s: float) -> None:
        """Do it now, or so many simulated seconds later."""
        if after_s:
            self.call_later(after_s, action)
        else:
            action()


def new_track(vehicle: Any) -> Track:
    """An empty track of a vehicle that stands where it was switched on."""
    origin = vehicle.frame.origin
    home = Position(origin.latitude_e7 * 1e-7, origin.longitude_e7 * 1e-7, origin.altitude_m)
    return Track(home)


def true_point(vehicle: Any) -> TrackPoint:
    """Where a simulated vehicle truly is."""
    frame, motion = vehicle.frame, vehicle.motion
    place = frame.to_global(motion.north, motion.east, motion.down)
    above = place.altitude_m - frame.origin.altitude_m
    armed, mode = vehicle.is_armed, _mode_name(vehicle.mode)
    return TrackPoint(vehicle.now, place.latitude_e7 * 1e-7, place.longitude_e7 * 1e-7, above, armed, mode)


def _mode_name(mode: Any) -> str:
    name = KNOWN.get(mode) if isinstance(mode, tuple) else getattr(mode, "name", None)
    return str(mode) if name is None else name
