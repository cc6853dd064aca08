"""What old programs use beside DroneKit's public names: its private ones, and what mappings had in Python 2."""

from __future__ import annotations

import time
from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import Self

T = TypeVar("T")

SILENCE_S = 5.0
"""After so many seconds without a heartbeat DroneKit warns."""


class Shadowable(Generic[T]):
    """Read as a property is, until an object gets an attribute of this name.

    For names that DroneKit 2.9 does not have: subclasses of its Vehicle may use them for their own things.
    """

    def __init__(self, getter: Callable[[Any], T]) -> None:
        self._getter = getter
        self.__doc__ = getter.__doc__

    @overload
    def __get__(self, instance: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type[Any]) -> T: ...
    def __get__(self, instance: object | None, owner: type[Any]) -> T | Self:
        return self if instance is None else self._getter(instance)


def read_of(path: str) -> Shadowable[Any]:
    """What is found there (``gimbal.pitch``); None where something is None on the way."""
    names = path.split(".")

    def read(instance: Any) -> Any:
        value = instance
        for name in names:
            value = None if value is None else getattr(value, name)
        return value

    return Shadowable(read)


def _velocity(index: int) -> Shadowable[Any]:
    return Shadowable(lambda vehicle: vehicle.velocity[index])


def _message_of(latest: str, *fields: str) -> tuple[Shadowable[Any], ...]:
    """Fields of the message that the vehicle has there."""
    return tuple(read_of(f"{latest}.message.{field}") for field in fields)


def _heard_at(vehicle: Any) -> float:
    age = vehicle.last_heartbeat
    return 0.0 if age is None else time.monotonic() - age


class VehiclePrivates:
    """What DroneKit's vehicle keeps, to read. A program that assigns one has its own value from there on."""

    _pitch, _yaw, _roll, _pitchspeed, _yawspeed, _rollspeed = _message_of(
        "_dk_attitude", "pitch", "yaw", "roll", "pitchspeed", "yawspeed", "rollspeed"
    )
    _vx, _vy, _vz = map(_velocity, range(3))
    _heading, _airspeed, _groundspeed = _message_of("_dk_vfr_hud", "heading", "airspeed", "groundspeed")
    _eph, _epv, _fix_type, _satellites_visible = _message_of(
        "_dk_gps", "eph", "epv", "fix_type", "satellites_visible"
    )
    _voltage, _current, _level = _message_of(
        "_dk_sys_status", "voltage_battery", "current_battery", "battery_remaining"
    )
    _system_status = read_of("_dk_heartbeat.system_status")
    _raw_version, _capabilities = _message_of("_dk_version", "flight_sw_version", "capabilities")
    _rngfnd_distance, _rngfnd_voltage = read_of("rangefinder.distance"), read_of("rangefinder.voltage")
    _mount_pitch, _mount_yaw, _mount_roll = (
        read_of("gimbal.pitch"),
        read_of("gimbal.yaw"),
        read_of("gimbal.roll"),
    )

    _last_heartbeat = read_of("last_heartbeat")
    _heartbeat_started = Shadowable(lambda vehicle: vehicle.last_heartbeat is not None)
    _heartbeat_system = read_of("_handler.target_system")
    _heartbeat_timeout = Shadowable(lambda vehicle: (vehicle.last_heartbeat or 0.0) >= SILENCE_S)
    """Whether the link is silent: a flag, not a number of seconds."""

    _heartbeat_lastreceived = Shadowable(_heard_at)
    _params_loaded = Shadowable(lambda vehicle: "parameters" in vehicle._ready_attrs)
    _params_count = Shadowable(
        lambda vehicle: len(vehicle.parameters) if "parameters" in vehicle._ready_attrs else -1
    )
    """How many there are, -1 while that is not known."""
    _current_waypoint = read_of("commands.next")
    _wp_loaded = Shadowable(lambda vehicle: "commands" in vehicle._ready_attrs)
    _wp_uploaded = None
    _wpts_dirty = False

    _mode_mapping = Shadowable(lambda vehicle: vehicle._master.mode_mapping())
    _mode_mapping_bynumber = Shadowable(
        lambda vehicle: {number: name for name, number in (vehicle._master.mode_mapping() or {}).items()}
    )


class LocationPrivates:
    """What DroneKit's locations keep, to read."""

    _lat, _lon = read_of("global_relative_frame.lat"), read_of("global_relative_frame.lon")
    _alt, _relative_alt = read_of("global_frame.alt"), read_of("global_relative_frame.alt")
    _north, _east, _down = (
        read_of("local_frame.north"),
        read_of("local_frame.east"),
        read_of("local_frame.down"),
    )


class GimbalPrivates:
    """What DroneKit's gimbal keeps, to read."""

    _pitch, _roll, _yaw = read_of("pitch"), read_of("roll"), read_of("yaw")


class Python2Mapping(Mapping[str, T]):
    """Adds those methods to what a mapping has in Python 3."""

    def has_key(self, name: object) -> bool:
        """As ``name in mapping``."""
        return name in self

    def iteritems(self) -> Iterator[tuple[str, T]]:
        """As ``iter(items())``."""
        return iter(self.items())

    def iterkeys(self) -> Iterator[str]:
        """As ``iter(keys())``."""
        return iter(self.keys())

    def itervalues(self) -> Iterator[T]:
        """As ``iter(values())``."""
        return iter(self.values())

    def viewitems(self) -> ItemsView[str, T]:
        """As ``items()``."""
        return self.items()

    def viewkeys(self) -> KeysView[str]:
        """As ``keys()``."""
        return self.keys()

    def viewvalues(self) -> ValuesView[T]:
        """As ``values()``."""
        return self.values()
