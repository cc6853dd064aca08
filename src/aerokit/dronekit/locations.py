"""``vehicle.location``: where the vehicle is, in three frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.dronekit.core import core_of
from aerokit.dronekit.observers import HasObservers
from aerokit.dronekit.privates import LocationPrivates
from aerokit.dronekit.values import LocationGlobal, LocationGlobalRelative, LocationLocal
from aerokit.mavlink.messages import GlobalPositionInt, LocalPositionNed
from aerokit.vehicle.state.movement import place

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore

__all__ = ["Locations"]


class Locations(HasObservers, LocationPrivates):
    """The vehicle's location in global, global relative and local frames; each of them can be listened to.

    Listeners get this object as their first argument. The three numbers of a location belong to one message.
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        self._core = core = core_of(vehicle)
        super().__init__(core.handler.listener_thread)
        self._has_altitude = False
        self._global = core.on(
            GlobalPositionInt,
            self._on_global_position,
            "location.global_relative_frame",
            "location.global_frame",
            "location",
            listeners=self._dk_listeners,
        )
        self._local = core.on(
            LocalPositionNed,
            self._on_local_position,
            "location.local_frame",
            "location",
            listeners=self._dk_listeners,
        )

    @property
    def global_frame(self) -> LocationGlobal:
        """Latitude, longitude in degrees and altitude above mean sea level in metres (GLOBAL_POSITION_INT).

        A new object each time. Latitude and longitude are None without a fix, the altitude is None until one is known.
        """
        message = self._global.message
        if message is None:
            return LocationGlobal(None, None, None)
        altitude = message.alt / 1000.0
        return LocationGlobal(*_place_of(message), altitude if altitude or self._has_altitude else None)

    @property
    def global_relative_frame(self) -> LocationGlobalRelative:
        """Latitude, longitude in degrees and altitude above home in metres (GLOBAL_POSITION_INT)."""
        message = self._global.message
        if message is None:
            return LocationGlobalRelative(None, None, None)
        return LocationGlobalRelative(*_place_of(message), message.relative_alt / 1000.0)

    @property
    def local_frame(self) -> LocationLocal:
        """Metres north, east and down from the estimator's origin (LOCAL_POSITION_NED)."""
        return LocationLocal(*self._local.values("x", "y", "z"))

    # ------------------------------------------------------------------------------- inside

    def _on_global_position(self, message: GlobalPositionInt) -> None:
        self._has_altitude = self._has_altitude or message.alt != 0
        self._announce("global_relative_frame")
        if self._has_altitude:
            self._announce("global_frame")
        self._core.listeners.announce("location")

    def _on_local_position(self, _: LocalPositionNed) -> None:
        self._announce("local_frame")
        self._core.listeners.announce("location")

    def _announce(self, frame: str) -> None:
        """To those who listen here, then to those who listen to the vehicle, which has another name for it."""
        self._dk_listeners.announce(frame)
        self._core.listeners.announce(f"location.{frame}")


def _place_of(message: GlobalPositionInt) -> tuple[float | None, float | None]:
    """Latitude and longitude in degrees, None without a fix."""
    return place(message.lat, message.lon) or (None, None)
