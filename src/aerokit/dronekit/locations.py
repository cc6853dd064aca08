"""``vehicle.location``: where the vehicle is, in three frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.dronekit.core import core_of
from aerokit.dronekit.observers import HasObservers, Listeners
from aerokit.dronekit.privates import LocationPrivates
from aerokit.dronekit.reception import Latest, Stream
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative, LocationLocal
from aerokit.mavlink.messages import GlobalPositionInt, LocalPositionNed
from aerokit.vehicle.state.movement import place

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore

__all__ = ["Locations"]

UNKNOWN = (None, None)

_Numbers = tuple[object, "float | None", "float | None", "float | None", "float | None"]
"""What they were worked out of, latitude and longitude in degrees, metres above the sea and above home."""


class Locations(HasObservers, LocationPrivates):
    """The vehicle's location in global, global relative and local frames; each of them can be listened to.

    Listeners get this object as their first argument. The three numbers of a location belong to one message.
    """

    global_position: Latest[GlobalPositionInt] = Latest(GlobalPositionInt)
    """The latest message, of ``aerokit.messages``; None before the first."""
    local_position: Latest[LocalPositionNed] = Latest(LocalPositionNed)
    """The latest message; None before the first."""

    def __init__(self, vehicle: VehicleCore) -> None:
        self._core = core = core_of(vehicle)
        listeners = Listeners(self, core.handler.listener_thread, on_change=core.review)
        self._dk_observe(listeners)
        self._has_altitude = False
        self._dk_numbers: _Numbers = (None, None, None, None, None)
        told = ("location.global_relative_frame", "location.global_frame", "location", "velocity")
        core.streams[GlobalPositionInt] = Stream(self, Locations.global_position, told)
        core.streams[LocalPositionNed] = Stream(
            self, Locations.local_position, ("location.local_frame", "location")
        )
        for message_type in (GlobalPositionInt, LocalPositionNed):
            core.streams[message_type].heed_also(listeners.by_name)
        core.on(GlobalPositionInt, self._on_global_position)
        core.on(LocalPositionNed, self._on_local_position)

    @property
    def global_frame(self) -> LocationGlobal:
        """Latitude, longitude in degrees and altitude above mean sea level in metres (GLOBAL_POSITION_INT).

        A new object each time. Latitude and longitude are None without a fix, the altitude is None until one is known.
        """
        _, lat, lon, altitude, _ = self._dk_global_numbers()
        return LocationGlobal(lat, lon, altitude if altitude or self._has_altitude else None)

    @property
    def global_relative_frame(self) -> LocationGlobalRelative:
        """Latitude, longitude in degrees and altitude above home in metres (GLOBAL_POSITION_INT)."""
        _, lat, lon, _, relative = self._dk_global_numbers()
        return LocationGlobalRelative(lat, lon, relative)

    @property
    def local_frame(self) -> LocationLocal:
        """Metres north, east and down from the estimator's origin (LOCAL_POSITION_NED)."""
        message = self.local_position
        if message is None:
            return LocationLocal(None, None, None)
        return LocationLocal(message.x, message.y, message.z)

    # ------------------------------------------------------------------------------- inside

    def _dk_global_numbers(self) -> _Numbers:
        """Of the latest GLOBAL_POSITION_INT, worked out when it is read first; all from one message."""
        held = self.__dict__.get(Locations.global_position.key)
        numbers = self._dk_numbers
        if numbers[0] is not held:
            message = self.global_position  # may be a later one by now
            assert message is not None
            lat, lon = place(message.lat, message.lon) or UNKNOWN
            numbers = held, lat, lon, message.alt / 1000.0, message.relative_alt / 1000.0
            self._dk_numbers = numbers
        return numbers

    def _on_global_position(self, message: GlobalPositionInt) -> None:
        self.global_position = message
        self._has_altitude = self._has_altitude or message.alt != 0
        self._tell_both("global_relative_frame", "location.global_relative_frame")
        if self._has_altitude:
            self._tell_both("global_frame", "location.global_frame")
        self._core.listeners.announce("location")

    def _on_local_position(self, message: LocalPositionNed) -> None:
        self._tell_both("local_frame", "location.local_frame")
        self._core.listeners.announce("location")

    def _tell_both(self, frame: str, name: str) -> None:
        """Tell those who listen here, then those who listen to the vehicle, which has another name for it."""
        listeners = self._core.listeners
        if self._attribute_listeners or listeners.heed(name):
            value = getattr(self, frame)
            self._dk_listeners.tell(frame, value)
            listeners.tell(name, value)
        else:
            self._core.ready.note(name)
