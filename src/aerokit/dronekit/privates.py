"""DroneKit's own private names that programs read, above all where it has no public one for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.core import core_of
from aerokit.dronekit.shadowable import Shadowable

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore

__all__ = ["GimbalPrivates", "LocationPrivates", "VehiclePrivates"]

SILENCE_S = 5.0
"""After so many seconds without a heartbeat DroneKit warns."""


def _of(owner: str, name: str, scale: float = 1) -> Shadowable[Any]:
    """A field of the message that an object keeps; None while there is none."""
    owner_of = attrgetter(owner)

    def read(instance: Any) -> Any:
        message = owner_of(instance)
        if message is None:
            return None
        value = getattr(message, name)
        return value if scale == 1 else value / scale

    return Shadowable(read)


def _read(function: Callable[[Any], Any]) -> Shadowable[Any]:
    return Shadowable(function)


def _heard_at(vehicle: Any) -> float:
    age = vehicle.last_heartbeat
    return 0.0 if age is None else time.monotonic() - age


def _is_ready(vehicle: VehicleCore, name: str) -> bool:
    return name in core_of(vehicle).ready.names


def _modes(vehicle: VehicleCore) -> dict[str, Any] | None:
    return core_of(vehicle).handler.master.mode_mapping()


class VehiclePrivates:
    """What DroneKit's vehicle keeps, to read. A program that assigns one has its own value from there on."""

    _pitch, _yaw, _roll = (_of("_dk_attitude", name) for name in ("pitch", "yaw", "roll"))
    _pitchspeed, _yawspeed, _rollspeed = (
        _of("_dk_attitude", name) for name in ("pitchspeed", "yawspeed", "rollspeed")
    )
    _vx, _vy, _vz = (_of("location.global_position", name, 100.0) for name in ("vx", "vy", "vz"))
    _heading, _airspeed, _groundspeed = (
        _of("_dk_vfr_hud", name) for name in ("heading", "airspeed", "groundspeed")
    )
    _eph, _epv, _fix_type, _satellites_visible = (
        _of("_dk_gps", name) for name in ("eph", "epv", "fix_type", "satellites_visible")
    )
    _voltage = _of("_dk_sys_status", "voltage_battery")
    _current = _of("_dk_sys_status", "current_battery")
    _level = _of("_dk_sys_status", "battery_remaining")
    _system_status = _of("_dk_heartbeat", "system_status")
    _raw_version = _of("_dk_version", "flight_sw_version")
    _capabilities = _of("_dk_version", "capabilities")
    _rngfnd_distance = _read(lambda vehicle: vehicle.rangefinder.distance)
    _rngfnd_voltage = _read(lambda vehicle: vehicle.rangefinder.voltage)
    _mount_pitch = _read(lambda vehicle: vehicle.mount_status[0])
    _mount_yaw = _read(lambda vehicle: vehicle.mount_status[1])
    _mount_roll = _read(lambda vehicle: vehicle.mount_status[2])

    _last_heartbeat = _read(lambda vehicle: vehicle.last_heartbeat)
    _heartbeat_started = _read(lambda vehicle: vehicle.last_heartbeat is not None)
    _heartbeat_system = _of("_handler", "target_system")
    _heartbeat_timeout = _read(lambda vehicle: (vehicle.last_heartbeat or 0.0) >= SILENCE_S)
    """Whether the link is silent: a flag, not a number of seconds."""

    _heartbeat_lastreceived = _read(_heard_at)
    _params_loaded = _read(lambda vehicle: _is_ready(vehicle, "parameters"))
    _params_count = _read(lambda vehicle: len(vehicle.parameters) if _is_ready(vehicle, "parameters") else -1)
    """How many there are, -1 while that is not known."""
    _current_waypoint = _read(lambda vehicle: vehicle.commands.next)
    _wp_loaded = _read(lambda vehicle: _is_ready(vehicle, "commands"))
    _wp_uploaded = None
    _wpts_dirty = False

    _mode_mapping = _read(lambda vehicle: _modes(vehicle))
    _mode_mapping_bynumber = _read(
        lambda vehicle: {number: name for name, number in (_modes(vehicle) or {}).items()}
    )


class LocationPrivates:
    """What DroneKit's locations keep, to read."""

    _lat = _read(lambda locations: locations.global_relative_frame.lat)
    _lon = _read(lambda locations: locations.global_relative_frame.lon)
    _alt = _read(lambda locations: locations.global_frame.alt)
    _relative_alt = _read(lambda locations: locations.global_relative_frame.alt)
    _north = _read(lambda locations: locations.local_frame.north)
    _east = _read(lambda locations: locations.local_frame.east)
    _down = _read(lambda locations: locations.local_frame.down)


class GimbalPrivates:
    """What DroneKit's gimbal keeps, to read."""

    _pitch = _read(lambda gimbal: gimbal.pitch)
    _roll = _read(lambda gimbal: gimbal.roll)
    _yaw = _read(lambda gimbal: gimbal.yaw)
