"""Attributes of a vehicle and of its location. Messages update the attributes, and notify their listeners."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.autopilots.modes import is_armed
from aerokit.autopilots.telemetry import PREARM_CHECK
from aerokit.connection.heartbeats import is_autopilot
from aerokit.dronekit.core import VehicleCore, core_of
from aerokit.dronekit.flight_orders import CurrentCommand, mode_name
from aerokit.dronekit.observers import HasObservers
from aerokit.dronekit.privates import LocationPrivates, OverridableProperty, attribute_path
from aerokit.dronekit.values import (
    Attitude,
    Battery,
    Capabilities,
    GPSInfo,
    LocationGlobal,
    LocationGlobalRelative,
    LocationLocal,
    Rangefinder,
    SystemStatus,
    VehicleMode,
    Version,
    Wind,
)
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import EkfStatusFlags as EkfFlags
from aerokit.mavlink.enums import MavProtocolCapability
from aerokit.vehicle.state.movement import valid_coordinates

if TYPE_CHECKING:
    from aerokit.dronekit.mavlink import MAVConnection

# Names of MAV_STATE by value.
STATES = ("UNINIT", "BOOT", "CALIBRATING", "STANDBY", "ACTIVE", "CRITICAL", "EMERGENCY", "POWEROFF")
FACING_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
NO_MODE = (None, "INITIALISING", "MAV")  # mode names while the vehicle boots and has no flight mode yet
GLOBAL_FRAMES = ("location.global_relative_frame", "location.global_frame")
LOCAL_FRAME = "location.local_frame"


class Locations(HasObservers, LocationPrivates):
    """The vehicle's location in global, global relative and local frames. Each frame can have listeners.

    Listeners get this object as their first argument. The three numbers of a location are from the same message.
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        self._core = core = core_of(vehicle)
        super().__init__(core.handler.listener_thread)
        self._has_altitude = False  # True after the first altitude other than 0
        own_listeners, on_global, on_local = self._dk_listeners, self._on_global_position, self._on_local_position
        self._global = core.on(m.GlobalPositionInt, on_global, "location", *GLOBAL_FRAMES, listeners=own_listeners)
        self._local = core.on(m.LocalPositionNed, on_local, "location", LOCAL_FRAME, listeners=own_listeners)

    @property
    def global_frame(self) -> LocationGlobal:
        """Latitude and longitude in degrees, altitude above mean sea level in metres (GLOBAL_POSITION_INT).

        Each access returns a new object. Latitude and longitude are None without a fix; the altitude is None until it
        is known.
        """
        message = self._global.message
        if message is None:
            return LocationGlobal(None, None, None)
        latitude, longitude = _position_of(message)
        if message.alt == 0 and not self._has_altitude:  # The vehicle may send 0 for an unknown altitude.
            return LocationGlobal(latitude, longitude, None)
        return LocationGlobal(latitude, longitude, message.alt / 1000.0)

    @property
    def global_relative_frame(self) -> LocationGlobalRelative:
        """Latitude, longitude in degrees and altitude above home in metres (GLOBAL_POSITION_INT)."""
        message = self._global.message
        if message is None:
            return LocationGlobalRelative(None, None, None)
        return LocationGlobalRelative(*_position_of(message), message.relative_alt / 1000.0)

    @property
    def local_frame(self) -> LocationLocal:
        """Metres north, east and down from the estimator's origin (LOCAL_POSITION_NED)."""
        return LocationLocal(*self._local.values("x", "y", "z"))

    def _on_global_position(self, message: m.GlobalPositionInt) -> None:
        self._has_altitude = self._has_altitude or message.alt != 0
        self._notify_frame("global_relative_frame")
        if self._has_altitude:
            self._notify_frame("global_frame")
        self._core.listeners.notify_attribute("location")

    def _on_local_position(self, _: m.LocalPositionNed) -> None:
        self._notify_frame("local_frame")
        self._core.listeners.notify_attribute("location")

    def _notify_frame(self, frame: str) -> None:
        self._dk_listeners.notify_attribute(frame)
        self._core.listeners.notify_attribute(f"location.{frame}")


def _position_of(message: m.GlobalPositionInt) -> tuple[float | None, float | None]:
    """Return latitude and longitude in degrees, or None without a fix."""
    return valid_coordinates(message.lat, message.lon) or (None, None)


class VehicleAttributes(VehicleCore):
    """DroneKit's attributes of a vehicle.

    Reading an attribute returns the latest value without waiting, on any thread. The numbers in one attribute, such as
    pitch, yaw and roll, are from the same message.
    """

    _dk_heartbeat: m.Heartbeat | None = None
    _autopilot_type, _vehicle_type = (
        attribute_path("_dk_heartbeat.autopilot"),
        attribute_path("_dk_heartbeat.type"),
    )
    _flightmode: str = "UNKNOWN"
    _dk_distance_down: float | None = None
    _dk_ekf_flags: int | None = None
    _dk_ekf_ok = False
    _home_location: LocationGlobal | None = None
    _dk_confirmed_home: LocationGlobal | None = None  # home as the vehicle has last confirmed it

    def __init__(self, handler: MAVConnection) -> None:
        super().__init__(handler)
        core = self._dk
        self._location = Locations(self)
        core.on(m.Heartbeat, self._dk_on_heartbeat)
        self._dk_position = core.notify_on(m.GlobalPositionInt, "velocity")
        self._dk_vfr_hud = core.notify_on(m.VfrHud, "heading", "airspeed", "groundspeed")
        self._dk_attitude = core.notify_on(m.Attitude, "attitude")
        self._dk_sys_status = core.notify_on(m.SysStatus, "battery")
        self._dk_gps = core.notify_on(m.GpsRawInt, "gps_0")
        self._dk_wind = core.notify_on(m.Wind, "wind")
        self._dk_rangefinder = core.notify_on(m.Rangefinder, "rangefinder")
        core.on(m.DistanceSensor, self._dk_on_distance_sensor)
        core.on(m.EkfStatusReport, self._dk_on_ekf_status)
        core.on(m.EstimatorStatus, self._dk_on_ekf_status)
        core.on(m.HomePosition, self._dk_on_home)
        self._dk_version = core.on(m.AutopilotVersion, self._dk_on_version)
        self._dk_current_command = CurrentCommand(core)

    # ------------------------------------------------------------------------------- reading

    @property
    def location(self) -> Locations:
        """The location: ``.global_frame``, ``.global_relative_frame``, ``.local_frame``."""
        return self._location

    @property
    def system_status(self) -> SystemStatus | Any:
        """HEARTBEAT.system_status by name (``'STANDBY'``, ``'ACTIVE'`` …).

        None before the first HEARTBEAT, or if the number has no name.
        """
        heartbeat = self._dk_heartbeat
        if heartbeat is None or heartbeat.system_status >= len(STATES):
            return None
        return SystemStatus(STATES[heartbeat.system_status])

    @property
    def attitude(self) -> Attitude:
        """Pitch, yaw and roll in radians (ATTITUDE)."""
        return Attitude(*self._dk_attitude.values("pitch", "yaw", "roll"))

    @property
    def velocity(self) -> list[float | Any]:
        """``[vx, vy, vz]`` in m/s: north, east, down (GLOBAL_POSITION_INT)."""
        speeds = self._dk_position.values("vx", "vy", "vz")
        return [None if speed is None else speed / 100.0 for speed in speeds]

    @property
    def heading(self) -> int | Any:
        """Heading in degrees, 0 to 360 clockwise from north (VFR_HUD)."""
        (heading,) = self._dk_vfr_hud.values("heading")
        return heading

    @property
    def gps_0(self) -> GPSInfo:
        """The first GPS receiver (GPS_RAW_INT)."""
        return GPSInfo(*self._dk_gps.values("eph", "epv", "fix_type", "satellites_visible"))

    @property
    def battery(self) -> Battery | Any:
        """Voltage, current and level of the main battery; None before the first SYS_STATUS."""
        message = self._dk_sys_status.message
        if message is None:
            return None
        return Battery(message.voltage_battery, message.current_battery, message.battery_remaining)

    @property
    def rangefinder(self) -> Rangefinder:
        """Distance in metres and voltage (RANGEFINDER, or a downward DISTANCE_SENSOR)."""
        if self._dk_rangefinder.message is None:
            return Rangefinder(self._dk_distance_down, None)
        return Rangefinder(*self._dk_rangefinder.values("distance", "voltage"))

    @OverridableProperty
    def wind(self) -> Wind:
        """Direction in degrees from which the wind blows, horizontal and vertical speed in m/s (ArduPilot's WIND)."""
        return Wind(*self._dk_wind.values("direction", "speed", "speed_z"))

    @property
    def ekf_ok(self) -> bool:
        """True if the estimator's position is good enough for flight.

        An armed vehicle needs an absolute position. For a disarmed vehicle, a predicted position is enough.
        """
        return self._dk_ekf_ok

    @property
    def is_armable(self) -> bool:
        """True if the vehicle has booted and seems ready to arm.

        ArduPilot needs a GPS fix and a predicted position; PX4 must report that its pre-arm checks pass. The vehicle
        may still refuse to arm. :meth:`Vehicle.arm` reports the reasons.
        """
        if self._flightmode in NO_MODE or self._dk_heartbeat is None:
            return False
        aio = self._dk.aio_or_none
        if aio is not None and aio.autopilot.prearm_depends_on_mode:
            # PX4 sends no EKF_STATUS_REPORT, but the result of its pre-arm checks in SYS_STATUS.
            status = self._dk_sys_status.message
            return status is not None and bool(status.onboard_control_sensors_health & PREARM_CHECK)
        # Like DroneKit, require any fix (2D or better) and a predicted position of the estimator.
        gps = self._dk_gps.message
        has_fix = gps is not None and gps.fix_type > 1
        return has_fix and bool((self._dk_ekf_flags or 0) & EkfFlags.PRED_POS_HORIZ_ABS)

    @property
    def version(self) -> Version:
        """Firmware version and type (AUTOPILOT_VERSION, HEARTBEAT)."""
        (raw_version,) = self._dk_version.values("flight_sw_version")
        return Version(raw_version, self._autopilot_type, self._vehicle_type)

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of the autopilot (AUTOPILOT_VERSION)."""
        return Capabilities(*self._dk_version.values("capabilities"))

    @property
    def last_heartbeat(self) -> float | Any:
        """Seconds since the autopilot's last HEARTBEAT; None before the first HEARTBEAT."""
        return None if self._dk.aio_or_none is None else self._dk.aio_or_none.heartbeat_age

    @property
    def _armed(self) -> bool:
        heartbeat = self._dk_heartbeat
        return heartbeat is not None and is_armed(heartbeat.base_mode)

    # ----------------------------------------------------------------------------- receiving

    def _dk_on_heartbeat(self, message: m.Heartbeat) -> None:
        if not is_autopilot(message):  # A ground station or companion may use the autopilot's ids.
            return
        self._handler.match_mavlink_version(message)
        self._dk_heartbeat = message
        self._flightmode = mode_name(self._dk.aio, message.custom_mode)
        self._dk.listeners.notify("armed", self._armed, cache=True)
        self._dk.listeners.notify("mode", VehicleMode(self._flightmode), cache=True)
        self._dk.listeners.notify("system_status", self.system_status, cache=True)
        self._dk.ready.mark("last_heartbeat")

    def _dk_on_distance_sensor(self, message: m.DistanceSensor) -> None:
        uses_rangefinder_message = self._dk_rangefinder.message is not None
        if message.orientation == FACING_DOWN and not uses_rangefinder_message:
            self._dk_distance_down = message.current_distance / 100.0
            self._dk.listeners.notify_attribute("rangefinder")

    def _dk_on_ekf_status(self, message: m.EkfStatusReport | m.EstimatorStatus) -> None:
        flags = self._dk_ekf_flags = message.flags  # ESTIMATOR_STATUS has the same flags as EKF_STATUS_REPORT.
        if self._armed:
            self._dk_ekf_ok = bool(flags & EkfFlags.POS_HORIZ_ABS) and not flags & EkfFlags.CONST_POS_MODE
        else:
            self._dk_ekf_ok = bool(flags & (EkfFlags.POS_HORIZ_ABS | EkfFlags.PRED_POS_HORIZ_ABS))
        self._dk.listeners.notify("ekf_ok", self._dk_ekf_ok, cache=True)

    def _dk_on_home(self, message: m.HomePosition) -> None:
        self._dk_set_home(message.latitude / 1.0e7, message.longitude / 1.0e7, message.altitude / 1000.0)
        self._dk.listeners.notify("home_location", self._home_location)

    def _dk_on_version(self, message: m.AutopilotVersion) -> None:
        self._handler.supports_mavlink_2 = bool(message.capabilities & MavProtocolCapability.MAVLINK2)
        self._dk.ready.mark("version")
        self._dk.ready.mark("capabilities")
        self._dk.listeners.notify("autopilot_version", message.flight_sw_version)

    def _dk_set_home(self, lat: float, lon: float, alt: float | None) -> None:
        home = LocationGlobal(lat, lon, alt)
        self._home_location = home
        self._dk_confirmed_home = home

    def _dk_on_reboot(self) -> None:
        self._home_location = None
        self._dk_confirmed_home = None
