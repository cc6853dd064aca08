"""The values that attributes of a vehicle have, with the names and texts that DroneKit programs know.

They are plain objects whose attributes may be set. What is not known is None: numbers of what a vehicle may not have
said yet are therefore typed ``float | Any``, so that type checkers offer a number's methods without asking for a check.
"""

from __future__ import annotations

import math
from typing import Any

__all__ = [
    "Attitude",
    "Battery",
    "GPSInfo",
    "LocationGlobal",
    "LocationGlobalRelative",
    "LocationLocal",
    "Rangefinder",
    "SystemStatus",
    "VehicleMode",
    "Wind",
]


class _Value:
    """Shown in a debugger or a list as it is printed."""

    _text: str
    """With the names of its attributes."""

    def __str__(self) -> str:
        return self._text.format(self)

    def __repr__(self) -> str:
        return str(self)


class Attitude(_Value):
    """How the vehicle is turned: ``pitch``, ``yaw`` and ``roll`` in radians."""

    _text = "Attitude:pitch={0.pitch},yaw={0.yaw},roll={0.roll}"

    def __init__(self, pitch: float | Any, yaw: float | Any, roll: float | Any) -> None:
        self.pitch = pitch
        self.yaw = yaw
        self.roll = roll


class _Place(_Value):
    """Two of them are equal only if they are the same object."""

    local_frame: Any = None
    global_frame: Any = None

    def __init__(self, lat: float | Any, lon: float | Any, alt: float | Any = None) -> None:
        self.lat = lat
        self.lon = lon
        self.alt = alt


class LocationGlobal(_Place):
    """A place on earth: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above mean sea level.

    Two of them are equal only if they are the same object.
    """

    _text = "LocationGlobal:lat={0.lat},lon={0.lon},alt={0.alt}"


class LocationGlobalRelative(_Place):
    """A place on earth: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above home.

    Two of them are equal only if they are the same object.
    """

    _text = "LocationGlobalRelative:lat={0.lat},lon={0.lon},alt={0.alt}"


class LocationLocal(_Value):
    """A place near the origin of the vehicle's estimator: metres ``north``, ``east`` and ``down`` of it."""

    _text = "LocationLocal:north={0.north},east={0.east},down={0.down}"

    def __init__(self, north: float | Any, east: float | Any, down: float | Any) -> None:
        self.north = north
        self.east = east
        self.down = down

    def distance_home(self) -> float | None:
        """Metres to the origin, along the ground if ``down`` is None; None if ``north`` or ``east`` is.

        The origin is the estimator's: home only while nobody has moved either of them.
        """
        if self.north is None or self.east is None:
            return None
        if self.down is None:
            return math.hypot(self.north, self.east)
        return math.hypot(self.north, self.east, self.down)


class GPSInfo(_Value):
    """A satellite receiver: fields of GPS_RAW_INT as they are.

    ``eph`` and ``epv`` are dilutions of precision times 100 (65535: unknown), ``fix_type`` is 0 or 1 without a fix,
    2 for 2D, 3 for 3D and more for better ones, ``satellites_visible`` a number (255: unknown).
    """

    _text = "GPSInfo:fix={0.fix_type},num_sat={0.satellites_visible}"

    def __init__(
        self, eph: int | Any, epv: int | Any, fix_type: int | Any, satellites_visible: int | Any
    ) -> None:
        self.eph = eph
        self.epv = epv
        self.fix_type = fix_type
        self.satellites_visible = satellites_visible


class Battery(_Value):
    """The main battery: ``voltage`` in volts, ``current`` in amperes or None, ``level`` in percent or None.

    The constructor takes what SYS_STATUS has: millivolts (65535: unknown, and stays 65.535 V here), hundredths of an
    ampere and percent, both -1 when unknown.
    """

    _text = "Battery:voltage={0.voltage},current={0.current},level={0.level}"

    voltage: float
    current: float | Any
    level: int | Any

    def __init__(self, voltage: float, current: float, level: int) -> None:
        self.voltage = voltage / 1000.0
        self.current = None if current == -1 else current / 100.0
        self.level = None if level == -1 else level


class Rangefinder(_Value):
    """``distance`` in metres and ``voltage`` in volts, None when it has not been told."""

    _text = "Rangefinder: distance={0.distance}, voltage={0.voltage}"

    def __init__(self, distance: float | Any, voltage: float | Any) -> None:
        self.distance = distance
        self.voltage = voltage


class Wind(_Value):
    """``wind_direction`` in degrees that it comes from, ``wind_speed`` and, upwards, ``wind_speed_z`` in m/s."""

    _text = (
        "Wind: wind direction: {0.wind_direction}, wind speed: {0.wind_speed}, wind speed z: {0.wind_speed_z}"
    )

    def __init__(
        self, wind_direction: float | Any, wind_speed: float | Any, wind_speed_z: float | Any
    ) -> None:
        self.wind_direction = wind_direction
        self.wind_speed = wind_speed
        self.wind_speed_z = wind_speed_z


class _Named(_Value):
    """One that equals its name, and can be a key of a dict."""

    _named_by: str

    def __eq__(self, other: object) -> bool:
        name = getattr(self, self._named_by)
        return bool(name == (getattr(other, self._named_by) if isinstance(other, type(self)) else other))

    def __hash__(self) -> int:
        return hash(getattr(self, self._named_by))


class VehicleMode(_Named):
    """A flight mode by its ``name``: ``VehicleMode("GUIDED")``. It equals its name and can be a key of a dict."""

    _text, _named_by = "VehicleMode:{0.name}", "name"

    def __init__(self, name: str) -> None:
        self.name = name


class SystemStatus(_Named):
    """What the vehicle is at: ``state`` is UNINIT, BOOT, CALIBRATING, STANDBY, ACTIVE, CRITICAL, EMERGENCY, POWEROFF.

    It equals its state as a text, and can be a key of a dict.
    """

    _text, _named_by = "SystemStatus:{0.state}", "state"

    def __init__(self, state: str) -> None:
        self.state = state
