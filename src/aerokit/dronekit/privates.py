"""Private names of DroneKit that programs use, and mapping methods of Python 2."""

from __future__ import annotations

import time
from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import Self

T = TypeVar("T")

HEARTBEAT_TIMEOUT_S = 5.0  # DroneKit reports a link time-out after this many seconds without a heartbeat


class OverridableProperty(Generic[T]):
    """A property that an instance attribute of the same name overrides.

    Used for the private names of DroneKit 2.9, and for names that DroneKit does not have. Programs may assign their own
    attributes to these names in a subclass of Vehicle.
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


def attribute_path(path: str) -> OverridableProperty[Any]:
    """Return a property that reads a path such as ``gimbal.pitch``. Its value is None if any part is None."""
    names = path.split(".")

    def read(instance: Any) -> Any:
        value = instance
        for name in names:
            value = None if value is None else getattr(value, name)
        return value

    return OverridableProperty(read)


def _velocity(index: int) -> OverridableProperty[Any]:
    return OverridableProperty(lambda vehicle: vehicle.velocity[index])


def _message_fields(latest_message: str, *fields: str) -> tuple[OverridableProperty[Any], ...]:
    """Return properties for message fields. ``latest_message`` names an attribute that is a `LatestMessage`."""
    return tuple(attribute_path(f"{latest_message}.message.{field}") for field in fields)


def _last_heartbeat_time(vehicle: Any) -> float:
    age = vehicle.last_heartbeat
    return 0.0 if age is None else time.monotonic() - age


class VehiclePrivates:
    """DroneKit's private attributes of a Vehicle, for programs that read them. A program may override each."""

    _pitch, _yaw, _roll, _pitchspeed, _yawspeed, _rollspeed = _message_fields(
        "_dk_attitude", "pitch", "yaw", "roll", "pitchspeed", "yawspeed", "rollspeed"
    )
    _vx, _vy, _vz = map(_velocity, range(3))
    _heading, _airspeed, _groundspeed = _message_fields("_dk_vfr_hud", "heading", "airspeed", "groundspeed")
    _eph, _epv, _fix_type, _satellites_visible = _message_fields(
        "_dk_gps", "eph", "epv", "fix_type", "satellites_visible"
    )
    _voltage, _current, _level = _message_fields(
        "_dk_sys_status", "voltage_battery", "current_battery", "battery_remaining"
    )
    _system_status = attribute_path("_dk_heartbeat.system_status")
    _raw_version, _capabilities = _message_fields("_dk_version", "flight_sw_version", "capabilities")
    _rngfnd_distance, _rngfnd_voltage = (
        attribute_path("rangefinder.distance"),
        attribute_path("rangefinder.voltage"),
    )
    _mount_pitch, _mount_yaw, _mount_roll = (
        attribute_path("gimbal.pitch"),
        attribute_path("gimbal.yaw"),
        attribute_path("gimbal.roll"),
    )

    _last_heartbeat = attribute_path("last_heartbeat")
    _heartbeat_started = OverridableProperty(lambda vehicle: vehicle.last_heartbeat is not None)
    _heartbeat_system = attribute_path("_handler.target_system")
    # Despite its name, the attribute is a flag: true while the link is silent.
    _heartbeat_timeout = OverridableProperty(lambda vehicle: (vehicle.last_heartbeat or 0.0) >= HEARTBEAT_TIMEOUT_S)
    _heartbeat_lastreceived = OverridableProperty(_last_heartbeat_time)
    _params_loaded = OverridableProperty(lambda vehicle: "parameters" in vehicle._ready_attrs)
    _params_count = OverridableProperty(
        lambda vehicle: len(vehicle.parameters) if "parameters" in vehicle._ready_attrs else -1
    )
    _current_waypoint = attribute_path("commands.next")
    _wp_loaded = OverridableProperty(lambda vehicle: "commands" in vehicle._ready_attrs)
    _wp_uploaded = None
    _wpts_dirty = False

    _mode_mapping = OverridableProperty(lambda vehicle: vehicle._master.mode_mapping())
    _mode_mapping_bynumber = OverridableProperty(
        lambda vehicle: {number: name for name, number in (vehicle._master.mode_mapping() or {}).items()}
    )


class LocationPrivates:
    """DroneKit's private attributes of Locations, for programs that read them."""

    _lat, _lon = attribute_path("global_relative_frame.lat"), attribute_path("global_relative_frame.lon")
    _alt, _relative_alt = attribute_path("global_frame.alt"), attribute_path("global_relative_frame.alt")
    _north, _east, _down = (
        attribute_path("local_frame.north"),
        attribute_path("local_frame.east"),
        attribute_path("local_frame.down"),
    )


class GimbalPrivates:
    """DroneKit's private attributes of a Gimbal, for programs that read them."""

    _pitch, _roll, _yaw = attribute_path("pitch"), attribute_path("roll"), attribute_path("yaw")


class Python2Mapping(Mapping[str, T]):
    """A mapping with Python 2's methods, such as ``has_key`` and ``iteritems``."""

    def has_key(self, name: object) -> bool:
        return name in self

    def iteritems(self) -> Iterator[tuple[str, T]]:
        return iter(self.items())

    def iterkeys(self) -> Iterator[str]:
        return iter(self.keys())

    def itervalues(self) -> Iterator[T]:
        return iter(self.values())

    def viewitems(self) -> ItemsView[str, T]:
        return self.items()

    def viewkeys(self) -> KeysView[str]:
        return self.keys()

    def viewvalues(self) -> ValuesView[T]:
        return self.values()
