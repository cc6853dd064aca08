"""What a simulated ArduPilot says of its state: heartbeat, health, battery, channels, version."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GpsFixType,
    MavAutopilot,
    MavBatteryChargeState,
    MavLandedState,
    MavModeFlag,
    MavState,
    MavVtolState,
    PlaneMode,
    RoverMode,
)
from aerokit.sim.ardupilot.sensor_status import sensor_status

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["STATE_BUILDERS", "heartbeat", "mission_current"]

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


def mission_current(vehicle: ArduPilotVehicle, seq: int | None = None) -> m.MissionCurrent:
    """MISSION_CURRENT; ``seq`` says another number than that of the command that is flown."""
    run = vehicle.mission
    seq = run.nav_index if seq is None else seq
    return m.MissionCurrent(seq, run.count, run.state, int(vehicle.mode.needs_mission))


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
    m.MissionCurrent.ID: mission_current,
    m.RcChannels.ID: _rc_channels,
    m.RcChannelsRaw.ID: _rc_channels_raw,
    m.Vibration.ID: _vibration,
    m.EscTelemetry1To4.ID: _esc_telemetry,
    m.AutopilotVersion.ID: _autopilot_version,
}
"""Message id → what to send now, or None."""
