"""``vehicle.location``: where the vehicle is, in three frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.dronekit.observers import HasObservers
from aerokit.dronekit.privates import LocationPrivates
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative, LocationLocal
from aerokit.mavlink.messages import GlobalPositionInt, LocalPositionNed
from aerokit.vehicle.decoding import place

if TYPE_CHECKING:
    from aerokit.dronekit.vehicle import Vehicle

__all__ = ["Locations"]

UNKNOWN = (None, None)


class Locations(HasObservers, LocationPrivates):
    """The vehicle's location in global, global relative and local frames; each of them can be listened to.

    Listeners get this object as their first argument. The three numbers of a location belong to one message.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        super().__init__(vehicle._dk_listener_thread)
        self._vehicle = vehicle
        self._has_altitude = False
        vehicle._dk_on(GlobalPositionInt, self._on_global_position)
        vehicle._dk_on(LocalPositionNed, self._on_local_position)

    @property
    def global_frame(self) -> LocationGlobal:
        """Latitude, longitude in degrees and altitude above mean sea level in metres (GLOBAL_POSITION_INT).

        A new object each time. Latitude and longitude are None without a fix, the altitude is None until one is known.
        """
        message = self._vehicle._dk_global_position
        if message is None:
            return LocationGlobal(None, None, None)
        altitude = message.alt / 1000.0
        return LocationGlobal(*_place_of(message), altitude if altitude or self._has_altitude else None)

    @property
    def global_relative_frame(self) -> LocationGlobalRelative:
        """Latitude, longitude in degrees and altitude above home in metres (GLOBAL_POSITION_INT)."""
        message = self._vehicle._dk_global_position
        if message is None:
            return LocationGlobalRelative(None, None, None)
        return LocationGlobalRelative(*_place_of(message), message.relative_alt / 1000.0)

    @property
    def local_frame(self) -> LocationLocal:
        """Metres north, east and down from the estimator's origin (LOCAL_POSITION_NED)."""
        message = self._vehicle._dk_local_position
        if message is None:
            return LocationLocal(None, None, None)
        return LocationLocal(message.x, message.y, message.z)

    # ------------------------------------------------------------------------------- inside

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


def _place_of(message: GlobalPositionInt) -> tuple[float | None, float | None]:
    return place(message.lat, message.lon) or UNKNOWN
