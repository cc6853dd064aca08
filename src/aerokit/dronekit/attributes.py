"""The attributes of a vehicle: what each message does to them, and who is told in which order."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from aerokit.autopilots.px4 import Px4
from aerokit.dronekit.modes import mode_name
from aerokit.dronekit.observers import HasObservers
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

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.exceptions import APIException
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["VehicleAttributes"]

ARMED = 128
STATES = ("UNINIT", "BOOT", "CALIBRATING", "STANDBY", "ACTIVE", "CRITICAL", "EMERGENCY", "POWEROFF")
POS_HORIZ_ABS, CONST_POS_MODE, PRED_POS_HORIZ_ABS = 16, 128, 512
"""Flags of EKF_STATUS_REPORT and of ESTIMATOR_STATUS, which agree in these."""
PREARM_CHECK = 1 << 28
LOOKING_DOWN = 25
NO_MODE = (None, "INITIALISING", "MAV")


class VehicleAttributes(HasObservers):
    """State as DroneKit's attributes. Reading takes what came last, on the caller's thread, and never waits.

    A message is kept by one assignment, so what is read together belongs to one message.
    """

    _aio: AsyncVehicle | None
    _heartbeat: m.Heartbeat | None = None
    _flightmode: str = "UNKNOWN"
    _attitude: m.Attitude | None = None
    _global_position: m.GlobalPositionInt | None = None
    _vfr_hud: m.VfrHud | None = None
    _gps: m.GpsRawInt | None = None
    _sys_status: m.SysStatus | None = None
    _rangefinder: tuple[float | None, float | None] = (None, None)
    _has_rangefinder_message = False
    _ekf_flags: int | None = None
    _ekf_ok = False
    _wind: m.Wind | None = None
    _version: m.AutopilotVersion | None = None
    _home_location: LocationGlobal | None = None

    def _attach_attributes(self) -> None:
        self._ready_attrs: set[str] = set()
        self._failures: dict[str, APIException] = {}
        self._became_ready = threading.Condition()
        self._seekers: dict[str, Callable[[], None]] = {}
        for message_type, handler in self._handlers().items():
            self._on(message_type, handler)

    def _on(self, message_type: type[Message], handler: Callable[[Any], None]) -> None:
        raise NotImplementedError

    def _handlers(self) -> dict[type[Message], Callable[[Any], None]]:
        return {
            m.Heartbeat: self._on_heartbeat,
            m.GlobalPositionInt: self._on_velocity,
            m.VfrHud: self._on_vfr_hud,
            m.Attitude: self._on_attitude,
            m.SysStatus: self._on_sys_status,
            m.GpsRawInt: self._on_gps,
            m.Rangefinder: self._on_rangefinder,
            m.DistanceSensor: self._on_distance_sensor,
            m.EkfStatusReport: self._on_ekf_status,
            m.EstimatorStatus: self._on_ekf_status,
            m.Wind: self._on_wind,
            m.HomePosition: self._on_home,
            m.AutopilotVersion: self._on_version,
        }

    # ------------------------------------------------------------------------------- reading

    @property
    def system_status(self) -> SystemStatus | Any:
        """HEARTBEAT.system_status by name (``'STANDBY'``, ``'ACTIVE'`` …); None before the first, and if unknown."""
        heartbeat = self._heartbeat
        if heartbeat is None or heartbeat.system_status >= len(STATES):
            return None
        return SystemStatus(STATES[heartbeat.system_status])

    @property
    def attitude(self) -> Attitude:
        """Pitch, yaw and roll in radians (ATTITUDE)."""
        message = self._attitude
        if message is None:
            return Attitude(None, None, None)
        return Attitude(message.pitch, message.yaw, message.roll)

    @property
    def velocity(self) -> list[float | Any]:
        """``[vx, vy, vz]`` in m/s: north, east, down (GLOBAL_POSITION_INT)."""
        message = self._global_position
        if message is None:
            return [None, None, None]
        return [message.vx / 100.0, message.vy / 100.0, message.vz / 100.0]

    @property
    def heading(self) -> int | Any:
        """Where the nose points, 0 to 360 degrees clockwise from north (VFR_HUD)."""
        message = self._vfr_hud
        return None if message is None else message.heading

    @property
    def gps_0(self) -> GPSInfo:
        """The first GPS receiver (GPS_RAW_INT)."""
        message = self._gps
        if message is None:
            return GPSInfo(None, None, None, None)
        return GPSInfo(message.eph, message.epv, message.fix_type, message.satellites_visible)

    @property
    def battery(self) -> Battery | Any:
        """Voltage, current and level of the main battery (SYS_STATUS); None before the first."""
        message = self._sys_status
        if message is None:
            return None
        return Battery(message.voltage_battery, message.current_battery, message.battery_remaining)

    @property
    def rangefinder(self) -> Rangefinder:
        """Distance in metres and voltage (RANGEFINDER; of others DISTANCE_SENSOR that looks down)."""
        return Rangefinder(*self._rangefinder)

    @property
    def wind(self) -> Wind:
        """Direction it comes from in degrees and speed in m/s (WIND of ArduPilot)."""
        message = self._wind
        if message is None:
            return Wind(None, None, None)
        return Wind(message.direction, message.speed, message.speed_z)

    @property
    def ekf_ok(self) -> bool:
        """Whether the estimator can fly: armed, it has an absolute position; disarmed, it has or will have one."""
        return self._ekf_ok

    @property
    def is_armable(self) -> bool:
        """Whether it has booted, has a GPS fix, and its estimator will have a position; on PX4: its checks pass.

        The vehicle's own arming checks may still refuse: :meth:`Vehicle.arm` tells why.
        """
        if self._flightmode in NO_MODE or self._heartbeat is None:
            return False
        if isinstance(getattr(self._aio, "autopilot", None), Px4):
            status = self._sys_status
            return status is not None and bool(status.onboard_control_sensors_health & PREARM_CHECK)
        fix = self.gps_0.fix_type
        return fix is not None and fix > 1 and bool((self._ekf_flags or 0) & PRED_POS_HORIZ_ABS)

    @property
    def version(self) -> Version:
        """The firmware: version and type (AUTOPILOT_VERSION, HEARTBEAT)."""
        version = self._version
        raw = None if version is None else version.flight_sw_version
        return Version(raw, self._autopilot_type, self._vehicle_type)

    @property
    def capabilities(self) -> Capabilities:
        """What the autopilot understands (AUTOPILOT_VERSION)."""
        version = self._version
        return Capabilities(None if version is None else version.capabilities)

    @property
    def last_heartbeat(self) -> float | Any:
        """Seconds since the autopilot's last HEARTBEAT; None before the first."""
        return None if self._aio is None else self._aio.heartbeat_age

    @property
    def _autopilot_type(self) -> int | None:
        return None if self._heartbeat is None else self._heartbeat.autopilot

    @property
    def _vehicle_type(self) -> int | None:
        return None if self._heartbeat is None else self._heartbeat.type

    @property
    def _armed(self) -> bool:
        heartbeat = self._heartbeat
        return heartbeat is not None and bool(heartbeat.base_mode & ARMED)

    # ----------------------------------------------------------------------------- receiving

    def _on_heartbeat(self, message: m.Heartbeat) -> None:
        before, self._heartbeat = self._heartbeat, message
        if before is None or (before.custom_mode, before.base_mode) != (
            message.custom_mode,
            message.base_mode,
        ):
            assert self._aio is not None
            self._flightmode = mode_name(self._aio, message.base_mode, message.custom_mode)
        self._tell("armed", self._armed, cache=True)
        self._tell("mode", VehicleMode(self._flightmode), cache=True)
        self._tell("system_status", self.system_status, cache=True)
        self._note("last_heartbeat")

    def _on_velocity(self, message: m.GlobalPositionInt) -> None:
        self._global_position = message
        self._announce("velocity")

    def _on_vfr_hud(self, message: m.VfrHud) -> None:
        self._vfr_hud = message
        self._announce("heading")
        self._announce("airspeed")
        self._announce("groundspeed")

    def _on_attitude(self, message: m.Attitude) -> None:
        self._attitude = message
        self._announce("attitude")

    def _on_sys_status(self, message: m.SysStatus) -> None:
        self._sys_status = message
        self._announce("battery")

    def _on_gps(self, message: m.GpsRawInt) -> None:
        self._gps = message
        self._announce("gps_0")

    def _on_rangefinder(self, message: m.Rangefinder) -> None:
        self._has_rangefinder_message = True
        self._rangefinder = (message.distance, message.voltage)
        self._announce("rangefinder")

    def _on_distance_sensor(self, message: m.DistanceSensor) -> None:
        if message.orientation == LOOKING_DOWN and not self._has_rangefinder_message:
            self._rangefinder = (message.current_distance / 100.0, None)
            self._announce("rangefinder")

    def _on_ekf_status(self, message: m.EkfStatusReport | m.EstimatorStatus) -> None:
        flags = self._ekf_flags = message.flags
        if self._armed:
            self._ekf_ok = bool(flags & POS_HORIZ_ABS) and not flags & CONST_POS_MODE
        else:
            self._ekf_ok = bool(flags & (POS_HORIZ_ABS | PRED_POS_HORIZ_ABS))
        self._tell("ekf_ok", self._ekf_ok, cache=True)

    def _on_wind(self, message: m.Wind) -> None:
        self._wind = message
        self._announce("wind")

    def _on_home(self, message: m.HomePosition) -> None:
        self._set_home(message.latitude / 1.0e7, message.longitude / 1.0e7, message.altitude / 1000.0)
        self._tell("home_location", self._home_location)

    def _on_version(self, message: m.AutopilotVersion) -> None:
        self._version = message
        self._note("version")
        self._note("capabilities")
        self._tell("autopilot_version", message.flight_sw_version)

    def _set_home(self, lat: float, lon: float, alt: float | None) -> None:
        """Where home is, in degrees and metres above the sea; from any thread."""
        self._home_location = LocationGlobal(lat, lon, alt)

    # ------------------------------------------------------------------------------- telling

    def _announce(self, name: str) -> None:
        """Tell an attribute's value, which is made only when somebody listens."""
        listeners = self._attribute_listeners
        if listeners and (name in listeners or "*" in listeners):
            self._tell(name, getattr(self, name))
        else:
            self._note(name)

    def _note(self, attr_name: str) -> None:
        if attr_name not in self._ready_attrs:
            self._mark_ready(attr_name)

    def _mark_ready(self, name: str) -> None:
        """The attribute has a value: whoever waits for it goes on."""
        with self._became_ready:
            self._failures.pop(name, None)
            self._ready_attrs.add(name)
            self._became_ready.notify_all()

    def _unready(self, name: str) -> None:
        """The attribute will get a new value, and is to be waited for."""
        with self._became_ready:
            self._failures.pop(name, None)
            self._ready_attrs.discard(name)

    def _fail(self, name: str, error: APIException) -> None:
        """The attribute will get no value: whoever waits for it is told why."""
        with self._became_ready:
            self._failures[name] = error
            self._became_ready.notify_all()
