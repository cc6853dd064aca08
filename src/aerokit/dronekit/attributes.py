"""The attributes of a vehicle: what each message does to them, and who is told in which order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.autopilots.health import PREARM_CHECK
from aerokit.autopilots.modes import is_armed
from aerokit.dronekit.core import VehicleCore
from aerokit.dronekit.modes import mode_name
from aerokit.dronekit.reception import Latest, Stream
from aerokit.dronekit.shadowable import Shadowable
from aerokit.dronekit.values import (
    Attitude,
    Battery,
    GPSInfo,
    LocationGlobal,
    Rangefinder,
    SystemStatus,
    VehicleMode,
    Wind,
)
from aerokit.dronekit.version import Capabilities, Version
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import EkfStatusFlags

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.current_command import CurrentCommand
    from aerokit.dronekit.locations import Locations
    from aerokit.mavlink.message import Message

__all__ = ["VehicleAttributes"]

STATES = ("UNINIT", "BOOT", "CALIBRATING", "STANDBY", "ACTIVE", "CRITICAL", "EMERGENCY", "POWEROFF")
POS_HORIZ_ABS, CONST_POS_MODE, PRED_POS_HORIZ_ABS = (
    EkfStatusFlags.POS_HORIZ_ABS.value,
    EkfStatusFlags.CONST_POS_MODE.value,
    EkfStatusFlags.PRED_POS_HORIZ_ABS.value,
)
"""Flags of EKF_STATUS_REPORT and of ESTIMATOR_STATUS, which agree in these."""
LOOKING_DOWN = 25
NO_MODE = (None, "INITIALISING", "MAV")


class VehicleAttributes(VehicleCore):
    """State as DroneKit's attributes. Reading takes what came last, on the caller's thread, and never waits.

    A message is kept by one assignment, so what is read together belongs to one message.
    """

    _location: Locations
    _dk_current_command: CurrentCommand
    _dk_heartbeat: m.Heartbeat | None = None
    _flightmode: str = "UNKNOWN"
    _dk_attitude = Latest(m.Attitude)
    _dk_vfr_hud = Latest(m.VfrHud)
    _dk_gps = Latest(m.GpsRawInt)
    _dk_sys_status = Latest(m.SysStatus)
    _dk_rangefinder: tuple[float | None, float | None] = (None, None)
    _dk_has_rangefinder_message = False
    _dk_ekf_flags: int | None = None
    _dk_ekf_ok = False
    _dk_wind = Latest(m.Wind)
    _dk_version: m.AutopilotVersion | None = None
    _home_location: LocationGlobal | None = None
    _dk_told_home: LocationGlobal | None = None

    _dk_told_by: tuple[tuple[Latest[Any], tuple[str, ...]], ...] = (
        (_dk_attitude, ("attitude",)),
        (_dk_vfr_hud, ("heading", "airspeed", "groundspeed")),
        (_dk_gps, ("gps_0",)),
        (_dk_sys_status, ("battery",)),
        (_dk_wind, ("wind",)),
    )
    """The messages that come in streams, and what they tell of."""

    def _dk_make_streams(self) -> None:
        for kind, names in self._dk_told_by:
            self._dk.streams[kind.message_type] = Stream(self, kind, names)

    def _dk_attach_attributes(self) -> None:
        for message_type, handler in self._dk_handlers().items():
            self._dk.on(message_type, handler)

    def _dk_handlers(self) -> dict[type[Message], Callable[[Any], None]]:
        return {
            m.Heartbeat: self._dk_on_heartbeat,
            m.GlobalPositionInt: lambda _: self._dk.listeners.announce("velocity"),
            m.VfrHud: self._dk_on_vfr_hud,
            m.Attitude: lambda _: self._dk.listeners.announce("attitude"),
            m.SysStatus: lambda _: self._dk.listeners.announce("battery"),
            m.GpsRawInt: lambda _: self._dk.listeners.announce("gps_0"),
            m.Rangefinder: self._dk_on_rangefinder,
            m.DistanceSensor: self._dk_on_distance_sensor,
            m.EkfStatusReport: self._dk_on_ekf_status,
            m.EstimatorStatus: self._dk_on_ekf_status,
            m.Wind: lambda _: self._dk.listeners.announce("wind"),
            m.HomePosition: self._dk_on_home,
            m.AutopilotVersion: self._dk_on_version,
        }

    # ------------------------------------------------------------------------------- reading

    @property
    def system_status(self) -> SystemStatus | Any:
        """HEARTBEAT.system_status by name (``'STANDBY'``, ``'ACTIVE'`` …); None before the first, and if unknown."""
        heartbeat = self._dk_heartbeat
        if heartbeat is None or heartbeat.system_status >= len(STATES):
            return None
        return SystemStatus(STATES[heartbeat.system_status])

    @property
    def attitude(self) -> Attitude:
        """Pitch, yaw and roll in radians (ATTITUDE)."""
        message = self._dk_attitude
        if message is None:
            return Attitude(None, None, None)
        return Attitude(message.pitch, message.yaw, message.roll)

    @property
    def velocity(self) -> list[float | Any]:
        """``[vx, vy, vz]`` in m/s: north, east, down (GLOBAL_POSITION_INT)."""
        message = self._location.global_position
        if message is None:
            return [None, None, None]
        return [message.vx / 100.0, message.vy / 100.0, message.vz / 100.0]

    @property
    def heading(self) -> int | Any:
        """Where the nose points, 0 to 360 degrees clockwise from north (VFR_HUD)."""
        message = self._dk_vfr_hud
        return None if message is None else message.heading

    @property
    def gps_0(self) -> GPSInfo:
        """The first GPS receiver (GPS_RAW_INT)."""
        message = self._dk_gps
        if message is None:
            return GPSInfo(None, None, None, None)
        return GPSInfo(message.eph, message.epv, message.fix_type, message.satellites_visible)

    @property
    def battery(self) -> Battery | Any:
        """Voltage, current and level of the main battery (SYS_STATUS); None before the first."""
        message = self._dk_sys_status
        if message is None:
            return None
        return Battery(message.voltage_battery, message.current_battery, message.battery_remaining)

    @property
    def rangefinder(self) -> Rangefinder:
        """Distance in metres and voltage (RANGEFINDER; of others DISTANCE_SENSOR that looks down)."""
        return Rangefinder(*self._dk_rangefinder)

    @Shadowable
    def wind(self) -> Wind:
        """Direction it comes from in degrees and speed in m/s (WIND of ArduPilot)."""
        message = self._dk_wind
        if message is None:
            return Wind(None, None, None)
        return Wind(message.direction, message.speed, message.speed_z)

    @property
    def ekf_ok(self) -> bool:
        """Whether the estimator can fly: armed, it has an absolute position; disarmed, it has or will have one."""
        return self._dk_ekf_ok

    @property
    def is_armable(self) -> bool:
        """Whether it has booted, has a GPS fix, and its estimator will have a position; on PX4: its checks pass.

        The vehicle's own arming checks may still refuse: :meth:`Vehicle.arm` tells why.
        """
        if self._flightmode in NO_MODE or self._dk_heartbeat is None:
            return False
        if self._dk.is_connected and self._dk.aio.autopilot.judges_by_mode:
            status = self._dk_sys_status
            return status is not None and bool(status.onboard_control_sensors_health & PREARM_CHECK)
        gps = self._dk_gps
        return gps is not None and gps.fix_type > 1 and bool((self._dk_ekf_flags or 0) & PRED_POS_HORIZ_ABS)

    @property
    def version(self) -> Version:
        """The firmware: version and type (AUTOPILOT_VERSION, HEARTBEAT)."""
        version = self._dk_version
        raw = None if version is None else version.flight_sw_version
        return Version(raw, self._autopilot_type, self._vehicle_type)

    @property
    def capabilities(self) -> Capabilities:
        """What the autopilot understands (AUTOPILOT_VERSION)."""
        version = self._dk_version
        return Capabilities(None if version is None else version.capabilities)

    @property
    def last_heartbeat(self) -> float | Any:
        """Seconds since the autopilot's last HEARTBEAT; None before the first."""
        return self._dk.aio.heartbeat_age if self._dk.is_connected else None

    @Shadowable
    def _autopilot_type(self) -> int | None:
        return None if self._dk_heartbeat is None else self._dk_heartbeat.autopilot

    @Shadowable
    def _vehicle_type(self) -> int | None:
        return None if self._dk_heartbeat is None else self._dk_heartbeat.type

    @property
    def _armed(self) -> bool:
        heartbeat = self._dk_heartbeat
        return heartbeat is not None and is_armed(heartbeat.base_mode)

    # ----------------------------------------------------------------------------- receiving

    def _dk_on_heartbeat(self, message: m.Heartbeat) -> None:
        before, self._dk_heartbeat = self._dk_heartbeat, message
        if before is None or (before.custom_mode, before.base_mode) != (
            message.custom_mode,
            message.base_mode,
        ):
            self._flightmode = mode_name(self._dk.aio, message.custom_mode)
        self._dk.listeners.tell("armed", self._armed, cache=True)
        self._dk.listeners.tell("mode", VehicleMode(self._flightmode), cache=True)
        self._dk.listeners.tell("system_status", self.system_status, cache=True)
        self._dk.ready.note("last_heartbeat")

    def _dk_on_vfr_hud(self, message: m.VfrHud) -> None:
        self._dk.listeners.announce("heading")
        self._dk.listeners.announce("airspeed")
        self._dk.listeners.announce("groundspeed")

    def _dk_on_rangefinder(self, message: m.Rangefinder) -> None:
        self._dk_has_rangefinder_message = True
        self._dk_rangefinder = (message.distance, message.voltage)
        self._dk.listeners.announce("rangefinder")

    def _dk_on_distance_sensor(self, message: m.DistanceSensor) -> None:
        if message.orientation == LOOKING_DOWN and not self._dk_has_rangefinder_message:
            self._dk_rangefinder = (message.current_distance / 100.0, None)
            self._dk.listeners.announce("rangefinder")

    def _dk_on_ekf_status(self, message: m.EkfStatusReport | m.EstimatorStatus) -> None:
        flags = self._dk_ekf_flags = message.flags
        if self._armed:
            self._dk_ekf_ok = bool(flags & POS_HORIZ_ABS) and not flags & CONST_POS_MODE
        else:
            self._dk_ekf_ok = bool(flags & (POS_HORIZ_ABS | PRED_POS_HORIZ_ABS))
        self._dk.listeners.tell("ekf_ok", self._dk_ekf_ok, cache=True)

    def _dk_on_home(self, message: m.HomePosition) -> None:
        self._dk_set_home(message.latitude / 1.0e7, message.longitude / 1.0e7, message.altitude / 1000.0)
        self._dk.listeners.tell("home_location", self._home_location)

    def _dk_on_version(self, message: m.AutopilotVersion) -> None:
        self._dk_version = message
        self._dk.ready.note("version")
        self._dk.ready.note("capabilities")
        self._dk.listeners.tell("autopilot_version", message.flight_sw_version)

    def _dk_set_home(self, lat: float, lon: float, alt: float | None) -> None:
        """Where home is as the vehicle told it, in degrees and metres above the sea; from any thread."""
        self._home_location = self._dk_told_home = LocationGlobal(lat, lon, alt)
