"""Values of vehicle attributes, with DroneKit's names and texts.

Values are plain objects with writable attributes. Unknown numbers are None. Attributes are typed ``float | Any``, so
that type checkers do not require a check for None. Locations compare by identity.
"""

from __future__ import annotations

import math
from typing import Any

# The byte FIRMWARE_VERSION_TYPE is 255 for a release. Otherwise it is 64 times the index in RELEASE_TYPES, plus the
# number of the pre-release (2 for rc2).
STABLE = 255
RELEASE_TYPES = ("dev", "alpha", "beta", "rc")
# DroneKit's names for values of MAV_AUTOPILOT and MAV_TYPE. Other values have no name.
AUTOPILOTS = {3: "APM:", 12: "PX4"}
VEHICLES = {1: "Plane", 2: "Copter", 10: "Rover"}


class _Value:
    """Base class of values with the same ``str()`` as in DroneKit."""

    _text: str  # format string, which gets the object as its argument

    def __str__(self) -> str:
        return self._text.format(self)

    def __repr__(self) -> str:
        return str(self)


class Attitude(_Value):
    """Attitude: ``pitch``, ``yaw`` and ``roll`` in radians."""

    _text = "Attitude:pitch={0.pitch},yaw={0.yaw},roll={0.roll}"

    def __init__(self, pitch: float | Any, yaw: float | Any, roll: float | Any) -> None:
        self.pitch = pitch
        self.yaw = yaw
        self.roll = roll


class _Place(_Value):
    """Base class of the two kinds of locations with latitude and longitude."""

    # These attributes are always None. Old programs may read them, because DroneKit's locations have them.
    local_frame: Any = None
    global_frame: Any = None

    def __init__(self, lat: float | Any, lon: float | Any, alt: float | Any = None) -> None:
        self.lat = lat
        self.lon = lon
        self.alt = alt


class LocationGlobal(_Place):
    """Global location: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above mean sea level."""

    _text = "LocationGlobal:lat={0.lat},lon={0.lon},alt={0.alt}"


class LocationGlobalRelative(_Place):
    """Global location: ``lat`` and ``lon`` in degrees (WGS 84), ``alt`` in metres above home."""

    _text = "LocationGlobalRelative:lat={0.lat},lon={0.lon},alt={0.alt}"


class LocationLocal(_Value):
    """Location relative to the origin of the estimator: metres ``north``, ``east`` and ``down``."""

    _text = "LocationLocal:north={0.north},east={0.east},down={0.down}"

    def __init__(self, north: float | Any, east: float | Any, down: float | Any) -> None:
        self.north = north
        self.east = east
        self.down = down

    def distance_home(self) -> float | None:
        """Distance to the origin in metres; None if ``north`` or ``east`` is None.

        If ``down`` is None, the distance is horizontal. The origin is at home, unless the origin or home was moved.
        """
        if self.north is None or self.east is None:
            return None
        if self.down is None:
            return math.hypot(self.north, self.east)
        return math.hypot(self.north, self.east, self.down)


class GPSInfo(_Value):
    """GPS receiver: fields of GPS_RAW_INT.

    ``eph`` and ``epv`` are dilutions of precision times 100 (65535: unknown). ``fix_type`` is 0 or 1 without a fix, 2
    for 2D, 3 for 3D and higher for better fixes. ``satellites_visible`` is a count (255: unknown).
    """

    _text = "GPSInfo:fix={0.fix_type},num_sat={0.satellites_visible}"

    def __init__(self, eph: int | Any, epv: int | Any, fix_type: int | Any, satellites_visible: int | Any) -> None:
        self.eph = eph
        self.epv = epv
        self.fix_type = fix_type
        self.satellites_visible = satellites_visible


class Battery(_Value):
    """The main battery: ``voltage`` in volts, ``current`` in amperes, ``level`` in percent.

    An unknown current or level is None.

    The constructor takes the fields of SYS_STATUS: millivolts, hundredths of an ampere, and percent. A voltage of
    65535, which means unknown, becomes 65.535 V. A current or percentage of -1 is unknown.
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
    """Rangefinder: ``distance`` in metres and ``voltage`` in volts; None if unknown."""

    _text = "Rangefinder: distance={0.distance}, voltage={0.voltage}"

    def __init__(self, distance: float | Any, voltage: float | Any) -> None:
        self.distance = distance
        self.voltage = voltage


class Wind(_Value):
    """Wind: ``wind_direction`` is where it comes from, in degrees; the speeds are in m/s.

    ``wind_speed_z`` is vertical; ArduPilot reports it positive downwards, and includes it in ``wind_speed``.
    """

    _text = "Wind: wind direction: {0.wind_direction}, wind speed: {0.wind_speed}, wind speed z: {0.wind_speed_z}"

    def __init__(self, wind_direction: float | Any, wind_speed: float | Any, wind_speed_z: float | Any) -> None:
        self.wind_direction = wind_direction
        self.wind_speed = wind_speed
        self.wind_speed_z = wind_speed_z


class _Named(_Value):
    """Base class of values with a name. They are equal to the string of this name, and have the same hash."""

    _name_attribute: str

    def __eq__(self, other: object) -> bool:
        if isinstance(other, type(self)):
            other = getattr(other, self._name_attribute)
        return bool(getattr(self, self._name_attribute) == other)

    def __hash__(self) -> int:
        return hash(getattr(self, self._name_attribute))


class VehicleMode(_Named):
    """A flight mode, given by its ``name``: ``VehicleMode("GUIDED")``. Equals this string, and can be a dict key."""

    _text, _name_attribute = "VehicleMode:{0.name}", "name"

    def __init__(self, name: str) -> None:
        self.name = name


class SystemStatus(_Named):
    """State of the vehicle. Equals the string ``state``, and can be a dict key.

    ``state`` is the name of the MAV_STATE: UNINIT, BOOT, CALIBRATING, STANDBY, ACTIVE, CRITICAL, EMERGENCY or POWEROFF.
    """

    _text, _name_attribute = "SystemStatus:{0.state}", "state"

    def __init__(self, state: str) -> None:
        self.state = state


class Version(_Value):
    """Firmware version; its text is for example ``APM:Copter-4.6.1`` or ``PX4Copter-1.15.0-beta2``.

    Args:
        raw_version: flight_sw_version of AUTOPILOT_VERSION, with one byte each for ``major``, ``minor``, ``patch`` and
            ``release``. If it is None (unknown), these four are None.
        autopilot_type: MAV_AUTOPILOT of the heartbeat, or None.
        vehicle_type: MAV_TYPE of the heartbeat, or None.
    """

    major: int | Any
    minor: int | Any
    patch: int | Any
    release: int | Any

    def __init__(self, raw_version: int | None, autopilot_type: int | None, vehicle_type: int | None) -> None:
        self.raw_version = raw_version
        self.autopilot_type = autopilot_type
        self.vehicle_type = vehicle_type
        self.major = self.minor = self.patch = self.release = None
        if raw_version is not None:
            self.major, self.minor, self.patch, self.release = (raw_version & 0xFFFFFFFF).to_bytes(4, "big")

    def is_stable(self) -> bool:
        """True for a release, False for a development, alpha, beta or candidate version."""
        return bool(self.release == STABLE)

    def release_version(self) -> int | None:
        """Return the number of the pre-release (23 for rc23); 0 for a release, None if the version is unknown."""
        if self.release is None:
            return None
        return 0 if self.is_stable() else int(self.release % 64)

    def release_type(self) -> str | None:
        """Return ``'dev'``, ``'alpha'``, ``'beta'`` or ``'rc'``; None if the version is unknown.

        As in DroneKit, a release is of the type ``'rc'``.
        """
        return None if self.release is None else RELEASE_TYPES[self.release >> 6]

    def __str__(self) -> str:
        autopilot = AUTOPILOTS.get(self.autopilot_type or 0, "UnknownAutoPilot")
        vehicle = VEHICLES.get(self.vehicle_type or 0, f"UnknownVehicleType{self.vehicle_type}")
        return f"{autopilot}{vehicle}-{self.major}.{self.minor}.{self.patch}{self._suffix()}"

    def _suffix(self) -> str:
        if self.release is None:
            return "UnknownReleaseType"
        return "" if self.is_stable() else f"-{self.release_type()}{self.release_version()}"


class Capabilities:
    """Capabilities of the autopilot as bools (MAV_PROTOCOL_CAPABILITY); all False while unknown."""

    def __init__(self, capabilities: int | None) -> None:
        bits = capabilities or 0
        self.mission_float: bool = bool(bits & 1)
        self.param_float: bool = bool(bits & 1 << 1)
        self.mission_int: bool = bool(bits & 1 << 2)
        self.command_int: bool = bool(bits & 1 << 3)
        self.param_union: bool = bool(bits & 1 << 4)
        self.ftp: bool = bool(bits & 1 << 5)
        self.set_attitude_target: bool = bool(bits & 1 << 6)
        # The next two names are DroneKit's, for SET_POSITION_TARGET_LOCAL_NED and SET_POSITION_TARGET_GLOBAL_INT.
        self.set_attitude_target_local_ned: bool = bool(bits & 1 << 7)
        self.set_altitude_target_global_int: bool = bool(bits & 1 << 8)
        self.terrain: bool = bool(bits & 1 << 9)
        self.set_actuator_target: bool = bool(bits & 1 << 10)
        self.flight_termination: bool = bool(bits & 1 << 11)
        self.compass_calibration: bool = bool(bits & 1 << 12)

    def __repr__(self) -> str:
        supported = [name for name, is_supported in vars(self).items() if is_supported]
        return f"Capabilities({', '.join(supported)})"
