"""What a simulated ArduPilot says of its state: heartbeat, health, battery, channels, version."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CopterMode,
    GpsFixType,
    MavAutopilot,
    MavBatteryChargeState,
    MavLandedState,
    MavModeFlag,
    MavState,
    MavVtolState,
    PlaneMode,
    RoverMode,
    SubMode,
)
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.mavlink.message import Message
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

_FENCE = int(Sensor.MAV_SYS_STATUS_GEOFENCE)  # integers: arithmetic on flags takes ten times as long
_PREARM = int(Sensor.MAV_SYS_STATUS_PREARM_CHECK)
_AHRS = int(Sensor.MAV_SYS_STATUS_AHRS)
_LOGGING = int(Sensor.MAV_SYS_STATUS_LOGGING)
_TERRAIN = int(Sensor.MAV_SYS_STATUS_TERRAIN)
_RATE, _ATTITUDE = int(Sensor.ANGULAR_RATE_CONTROL), int(Sensor.ATTITUDE_STABILIZATION)
_YAW, _HEIGHT = int(Sensor.YAW_POSITION), int(Sensor.Z_ALTITUDE_CONTROL)
_PLACE = int(Sensor.XY_POSITION_CONTROL)
_GPS, _LASER = int(Sensor.GPS), int(Sensor.LASER_POSITION)
_RADIO, _BATTERY, _PROPULSION = int(Sensor.RC_RECEIVER), int(Sensor.BATTERY), int(Sensor.PROPULSION)
_BODY = int(
    Sensor.SENSOR_3D_GYRO
    | Sensor.SENSOR_3D_ACCEL
    | Sensor.SENSOR_3D_MAG
    | Sensor.ABSOLUTE_PRESSURE
    | Sensor.MOTOR_OUTPUTS
    | Sensor.RC_RECEIVER
    | Sensor.BATTERY
)
_KEEPS_LOGGING_S = 15.0
"""The log goes on for so long after disarming."""


@dataclass(frozen=True)
class _Suite:
    """What a kind has beside the GPS, and how it reports it."""

    working: int
    """Present, enabled and healthy from the start."""
    control: int
    """Kinds of control that it has."""
    always: int = 0
    """Of those the ones that are enabled in every mode."""
    quietly_healthy: int = 0
    """Healthy, though neither present nor enabled."""
    unhealthy: int = 0
    """Present and enabled, and not healthy."""


_SUITES: dict[Kind, _Suite] = {
    "copter": _Suite(
        _BODY | _TERRAIN | _PROPULSION,
        _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        always=_RATE | _ATTITUDE | _YAW,
        quietly_healthy=int(Sensor.PROXIMITY),
    ),
    "plane": _Suite(
        _BODY | int(Sensor.DIFFERENTIAL_PRESSURE),
        _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        unhealthy=_TERRAIN,
    ),
    "rover": _Suite(_BODY, _RATE | _ATTITUDE | _YAW | _PLACE, quietly_healthy=_LASER),
    "sub": _Suite(
        _BODY | _LASER,
        _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        always=_RATE | _ATTITUDE | _YAW,
    ),
}

_LESS_CONTROL: dict[Kind, dict[int, int]] = {
    "copter": {
        CopterMode.STABILIZE: _HEIGHT | _PLACE,
        CopterMode.ACRO: _HEIGHT | _PLACE,
        CopterMode.ALT_HOLD: _PLACE,
    },
    "plane": {
        PlaneMode.MANUAL: _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        PlaneMode.ACRO: _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        PlaneMode.STABILIZE: _YAW | _HEIGHT | _PLACE,
        PlaneMode.TRAINING: _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE,
        PlaneMode.FLY_BY_WIRE_A: _YAW | _HEIGHT | _PLACE,
        PlaneMode.AUTOTUNE: _YAW | _HEIGHT | _PLACE,
        PlaneMode.FLY_BY_WIRE_B: _YAW | _HEIGHT | _PLACE,
        PlaneMode.CRUISE: _YAW | _HEIGHT | _PLACE,
    },
    "rover": {
        RoverMode.MANUAL: _RATE | _ATTITUDE | _YAW | _PLACE,
        RoverMode.HOLD: _RATE | _ATTITUDE | _YAW | _PLACE,
        RoverMode.ACRO: _YAW | _PLACE,
        RoverMode.STEERING: _YAW | _PLACE,
        RoverMode.SIMPLE: _YAW | _PLACE,
    },
    "sub": {
        SubMode.MANUAL: _HEIGHT | _PLACE,
        SubMode.STABILIZE: _HEIGHT | _PLACE,
        SubMode.ACRO: _HEIGHT | _PLACE,
        SubMode.MOTORDETECT: _HEIGHT | _PLACE,
        SubMode.SURFTRAK: _HEIGHT | _PLACE,
    },
}
"""Mode → what it does not control of what the kind can."""


def sensor_status(vehicle: ArduPilotVehicle) -> tuple[int, int, int]:
    suite, nav = _SUITES[vehicle.KIND], vehicle.navigation
    present = suite.working | suite.control | suite.unhealthy | _PREARM | _AHRS | _LOGGING
    enabled = suite.working | suite.unhealthy | _PREARM
    health = suite.working | suite.quietly_healthy | _LOGGING
    controls = suite.always | suite.control & ~_LESS_CONTROL[vehicle.KIND].get(vehicle.mode.number, 0)
    enabled, health = enabled | controls, health | controls
    if nav.is_gps_detected:
        present, enabled = present | _GPS, enabled | _GPS
        health |= 0 if nav.gps_is_lost else _GPS
    if nav.is_healthy:
        enabled |= _AHRS
        health |= _AHRS if vehicle.timeline.estimator_leads_early or nav.has_position else 0
    if vehicle.motors.is_armed or vehicle.now - vehicle.motors.disarmed_at < _KEEPS_LOGGING_S:
        enabled |= _LOGGING
    if vehicle.rangefinder_reach_m > 0.0:
        present, enabled, health = present | _LASER, enabled | _LASER, health | _LASER
    present, enabled, health = _with_fence(vehicle, present, enabled, health)
    return present, enabled, _without_failures(vehicle, health)


def _with_fence(vehicle: ArduPilotVehicle, present: int, enabled: int, health: int) -> tuple[int, int, int]:
    is_present, is_enforced, is_kept = vehicle.fence.health
    present |= _FENCE if is_present else 0
    enabled |= _FENCE if is_enforced else 0
    return present, enabled, health | (_FENCE if is_kept else 0)


def _without_failures(vehicle: ArduPilotVehicle, health: int) -> int:
    health |= _PREARM if vehicle.arming.passes else 0
    if not vehicle.failsafes.hears_radio:
        health &= ~_RADIO
    if vehicle.failsafes.battery_is_low:
        health &= ~_BATTERY
    if vehicle.faults.motor_failed:
        health &= ~_PROPULSION
    return health


_UNKNOWN_CELL = 0xFFFF
_RSSI = 255
_MOTORS = {"copter": (0, 1, 2, 3), "plane": (2,)}
"""Outputs, from 0 on, of the motors that tell how they are."""
_BOOT_MODE: dict[str, tuple[int, int]] = {
    "plane": (MavModeFlag.STABILIZE_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED, PlaneMode.INITIALIZING),
    "rover": (MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED, RoverMode.INITIALIZING),
}
"""Flags and mode before it is initialised."""


def heartbeat(vehicle: ArduPilotVehicle) -> m.Heartbeat:
    """HEARTBEAT; BOOT until half a second after the vehicle is initialised.

    Plane and Rover boot in a mode of its own, CALIBRATING.
    """
    if not vehicle.is_initialised and vehicle.KIND in _BOOT_MODE:
        base_mode, mode = _BOOT_MODE[vehicle.KIND]
        return m.Heartbeat(
            vehicle.MAV_TYPE, MavAutopilot.ARDUPILOTMEGA, base_mode, mode, MavState.CALIBRATING, 3
        )
    state = _state(vehicle) if vehicle.has_left_boot else MavState.BOOT
    return m.Heartbeat(
        vehicle.MAV_TYPE, MavAutopilot.ARDUPILOTMEGA, vehicle.base_mode, vehicle.mode.number, state, 3
    )


def _state(vehicle: ArduPilotVehicle) -> int:
    if vehicle.failsafes.is_any_active:
        return MavState.CRITICAL
    return MavState.STANDBY if vehicle.is_landed else MavState.ACTIVE


def _sys_status(vehicle: ArduPilotVehicle) -> m.SysStatus:
    present, enabled, health = sensor_status(vehicle)
    battery = vehicle.battery
    return m.SysStatus(
        present,
        enabled,
        health,
        0,
        round(battery.voltage_v * 1000),
        round(battery.current_a * 100),
        int(battery.percent),
        0,
        0,
        0,
        0,
        0,
        0,
    )


def _extended_sys_state(vehicle: ArduPilotVehicle) -> m.ExtendedSysState:
    state = MavLandedState.IN_AIR
    if vehicle.is_landed:
        state = MavLandedState.ON_GROUND
    elif vehicle.mode.is_landing:
        state = MavLandedState.LANDING
    elif vehicle.mode.is_taking_off:
        state = MavLandedState.TAKEOFF
    lifts = MavVtolState.MC if vehicle.KIND == "copter" else MavVtolState.UNDEFINED
    return m.ExtendedSysState(lifts, state)


def _battery_status(vehicle: ArduPilotVehicle) -> m.BatteryStatus:
    battery = vehicle.battery
    voltages = (round(battery.voltage_v * 1000), *(_UNKNOWN_CELL,) * 9)
    charge = MavBatteryChargeState.LOW if vehicle.failsafes.battery_is_low else MavBatteryChargeState.OK
    if vehicle.failsafes.battery_is_critical:
        charge = MavBatteryChargeState.CRITICAL
    return m.BatteryStatus(
        0,
        0,
        0,
        32767,
        voltages,
        round(battery.current_a * 100),
        round(battery.consumed_mah),
        round(battery.consumed_wh * 36),
        int(battery.percent),
        0,
        charge,
    )


def _power_status(vehicle: ArduPilotVehicle) -> m.PowerStatus:
    return m.PowerStatus(5000, 0, 0)


def _meminfo(vehicle: ArduPilotVehicle) -> m.Meminfo:
    return m.Meminfo(0, 65535, 524288)


def _system_time(vehicle: ArduPilotVehicle) -> m.SystemTime:
    unix = round(vehicle.unix_time * 1e6) if vehicle.navigation.fix_type >= GpsFixType.TYPE_3D_FIX else 0
    return m.SystemTime(unix, vehicle.time_boot_ms)


def _rc_channels(vehicle: ArduPilotVehicle) -> m.RcChannels:
    fields = [vehicle.time_boot_ms, len(vehicle.rc), *vehicle.rc.channels, _RSSI]
    return m.RcChannels(*fields)


def _rc_channels_raw(vehicle: ArduPilotVehicle) -> m.RcChannelsRaw:
    fields = [vehicle.time_boot_ms, 0, *vehicle.rc, _RSSI]
    return m.RcChannelsRaw(*fields)


def _vibration(vehicle: ArduPilotVehicle) -> m.Vibration:
    size = 0.003 + 0.3 * vehicle.motors.throttle
    x, y, z = (abs(vehicle.rng.gauss(0.0, size)) for _ in range(3))
    return m.Vibration(vehicle.time_boot_us, x, y, z, 0, 0, 0)


def _esc_telemetry(vehicle: ArduPilotVehicle) -> m.EscTelemetry1To4:
    current = round(vehicle.battery.current_a * 25)
    rpm = round(vehicle.motors.throttle * 15000)
    count = int(vehicle.uptime * 100) & 0xFFFF
    voltage = round(vehicle.battery.voltage_v * 100)
    there = [int(index in _MOTORS[vehicle.KIND]) for index in range(4)]
    voltages, currents, rpms, counts = (
        [value * each for each in there] for value in (voltage, current, rpm, count)
    )
    return m.EscTelemetry1To4(bytes(32 * each for each in there), voltages, currents, (0,) * 4, rpms, counts)


def _autopilot_version(vehicle: ArduPilotVehicle) -> m.AutopilotVersion:
    return m.AutopilotVersion(
        vehicle.capabilities,
        vehicle.version_number,
        0,
        0,
        0,
        vehicle.GIT_HASH,
        bytes(8),
        bytes(8),
        0,
        0,
        0,
        vehicle.uid,
    )


STATE_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.Heartbeat.ID: heartbeat,
    m.SysStatus.ID: _sys_status,
    m.ExtendedSysState.ID: _extended_sys_state,
    m.BatteryStatus.ID: _battery_status,
    m.PowerStatus.ID: _power_status,
    m.Meminfo.ID: _meminfo,
    m.SystemTime.ID: _system_time,
    m.MissionCurrent.ID: lambda vehicle: vehicle.mission.message(),
    m.RcChannels.ID: _rc_channels,
    m.RcChannelsRaw.ID: _rc_channels_raw,
    m.Vibration.ID: _vibration,
    m.EscTelemetry1To4.ID: _esc_telemetry,
    m.AutopilotVersion.ID: _autopilot_version,
}
"""Message id → what to send now, or None."""
