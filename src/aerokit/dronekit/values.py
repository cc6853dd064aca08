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

    def __repr__(self) -> str:
        return str(self)


class Attitude(_Value):
    """How the vehicle is turned: ``pitch``, ``yaw`` and ``roll`` in radians."""

    def __init__(self, pitch: float | Any, yaw: float | Any, roll: float | Any) -> None:
        self.pitch = pitch
        self.yaw = yaw
        self.roll = roll

    def __str__(self) -> str:
        return f"Attitude:pitch={self.pitch},yaw={self.yaw},roll={self.roll}"


class _Place(_Value):
    """Two of them are equal only if they are the same object."""

    local_frame: Any = None
    global_frame: Any = None
    _kind: str

    def __init__(self, lat: float | Any, lon: float | Any, alt: float | Any = None) -> None:
        self.lat = lat
        self.lon = lon
        self.alt = alt

    def __str__(self) -> str:
        return f"{self._kind}:lat={self.lat},lon={self.lon},alt={self.alt}"


class LocationGlobal(_Place):
    """A place on earth: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above mean sea level.

    Two of them are equal only if they are the same object.
    """

    _kind = "LocationGlobal"


class LocationGlobalRelative(_Place):
    """A place on earth: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above home.

    Two of them are equal only if they are the same object.
    """

    _kind = "LocationGlobalRelative"


class LocationLocal(_Value):
    """A place near the origin of the vehicle's estimator: metres ``north``, ``east`` and ``down`` of it."""

    def __init__(self, north: float | Any, east: float | Any, down: float | Any) -> None:
        self.north = north
        self.east = east
        self.down = down

    def __str__(self) -> str:
        return f"LocationLocal:north={self.north},east={self.east},down={self.down}"

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

    def __init__(
        self, eph: int | Any, epv: int | Any, fix_type: int | Any, satellites_visible: int | Any
    ) -> None:
        self.eph = eph
        self.epv = epv
        self.fix_type = fix_type
        self.satellites_visible = satellites_visible

    def __str__(self) -> str:
        return f"GPSInfo:fix={self.fix_type},num_sat={self.satellites_visible}"


class Battery(_Value):
    """The main battery: ``voltage`` in volts, ``current`` in amperes or None, ``level`` in percent or None.

    The constructor takes what SYS_STATUS has: millivolts (65535: unknown, and stays 65.535 V here), hundredths of an
    ampere and percent, both -1 when unknown.
    """

    voltage: float
    current: float | Any
    level: int | Any

    def __init__(self, voltage: float, current: float, level: int) -> None:
        self.voltage = voltage / 1000.0
        self.current = None if current == -1 else current / 100.0
        self.level = None if level == -1 else level

    def __str__(self) -> str:
        return f"Battery:voltage={self.voltage},current={self.current},level={self.level}"


class Rangefinder(_Value):
    """``distance`` in metres and ``voltage`` in volts, None when it has not been told."""

    def __init__(self, distance: float | Any, voltage: float | Any) -> None:
        self.distance = distance
        self.voltage = voltage

    def __str__(self) -> str:
        return f"Rangefinder: distance={self.distance}, voltage={self.voltage}"


class Wind(_Value):
    """``wind_direction`` in degrees that it comes from, ``wind_speed`` and, upwards, ``wind_speed_z`` in m/s."""

    def __init__(
        self, wind_direction: float | Any, wind_speed: float | Any, wind_speed_z: float | Any
    ) -> None:
        self.wind_direction = wind_direction
        self.wind_speed = wind_speed
        self.wind_speed_z = wind_speed_z

    def __str__(self) -> str:
        return (
            f"Wind: wind direction: {self.wind_direction}, wind speed: {self.wind_speed},"
            f" wind speed z: {self.wind_speed_z}"
        )


class VehicleMode(_Value):
    """A flight mode by its ``name``: ``VehicleMode("GUIDED")``. It equals its name and can be a key of a dict."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __str__(self) -> str:
        return f"VehicleMode:{self.name}"

    def __eq__(self, other: object) -> bool:
        return self.name == (other.name if isinstance(other, VehicleMode) else other)

    def __hash__(self) -> int:
        return hash(self.name)


class SystemStatus(_Value):
    """What the vehicle is at: ``state`` is UNINIT, BOOT, CALIBRATING, STANDBY, ACTIVE, CRITICAL, EMERGENCY, POWEROFF.

    It equals its state as a text, and can be a key of a dict.
    """

    def __init__(self, state: str) -> None:
        self.state = state

    def __str__(self) -> str:
        return f"SystemStatus:{self.state}"

    def __eq__(self, other: object) -> bool:
        return self.state == (other.state if isinstance(other, SystemStatus) else other)

    def __hash__(self) -> int:
        return hash(self.state)
