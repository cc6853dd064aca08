"""``vehicle.location``: where the vehicle is, in three frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.dronekit.attributes import VehicleAttributes
from aerokit.dronekit.observers import HasObservers
from aerokit.dronekit.privates import LocationPrivates
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative, LocationLocal
from aerokit.mavlink.messages import GlobalPositionInt, LocalPositionNed
from aerokit.vehicle.state.movement import place

if TYPE_CHECKING:
    from aerokit.dronekit.vehicle import Vehicle

__all__ = ["Locations"]

UNKNOWN = (None, None)
HELD = VehicleAttributes._dk_global_position.key
"""Where a vehicle keeps the frame or message of its global position."""

_Numbers = tuple[object, "float | None", "float | None", "float | None", "float | None"]
"""What they were worked out of, latitude and longitude in degrees, metres above the sea and above home."""


class Locations(HasObservers, LocationPrivates):
    """The vehicle's location in global, global relative and local frames; each of them can be listened to.

    Listeners get this object as their first argument. The three numbers of a location belong to one message.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        super().__init__(vehicle._dk_listener_thread)
        self._vehicle = vehicle
        self._has_altitude = False
        self._dk_numbers: _Numbers = (None, None, None, None, None)
        vehicle._dk_on(GlobalPositionInt, self._on_global_position)
        vehicle._dk_on(LocalPositionNed, self._on_local_position)

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
        message = self._vehicle._dk_local_position
        if message is None:
            return LocationLocal(None, None, None)
        return LocationLocal(message.x, message.y, message.z)

    # ------------------------------------------------------------------------------- inside

    def _dk_global_numbers(self) -> _Numbers:
        """Of the latest GLOBAL_POSITION_INT, worked out when it is read first; all from one message."""
        held = self._vehicle.__dict__.get(HELD)
        numbers = self._dk_numbers
        if numbers[0] is not held:
            message = self._vehicle._dk_global_position  # may be a later one by now
            assert message is not None
            lat, lon = place(message.lat, message.lon) or UNKNOWN
            numbers = held, lat, lon, message.alt / 1000.0, message.relative_alt / 1000.0
            self._dk_numbers = numbers
        return numbers

    def _on_global_position(self, message: GlobalPositionInt) -> None:
        self._vehicle._dk_global_position = message
        self._has_altitude = self._has_altitude or message.alt != 0
        self._dk_announce("global_relative_frame", "location.global_relative_frame")
        if self._has_altitude:
            self._dk_announce("global_frame", "location.global_frame")
        self._vehicle._dk_announce("location")

    def _on_local_position(self, message: LocalPositionNed) -> None:
        self._dk_announce("local_frame", "location.local_frame")
        self._vehicle._dk_announce("location")

    def _dk_announce(self, frame: str, name: str) -> None:
        """Tell those who listen here, then those who listen to the vehicle, which has another name for it."""
        vehicle = self._vehicle
        listened = vehicle._attribute_listeners
        if self._attribute_listeners or name in listened or "*" in listened:
            value = getattr(self, frame)
            self._dk_tell(frame, value)
            vehicle._dk_tell(name, value)
        else:
            vehicle._dk_note(name)

    def _dk_review(self) -> None:
        self._vehicle._dk_review()
