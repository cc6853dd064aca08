"""What a simulated ArduCopter says of its state: heartbeat, health, battery, channels, version."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GpsFixType,
    MavAutopilot,
    MavBatteryChargeState,
    MavLandedState,
    MavModeFlag,
    MavState,
    MavType,
)
from aerokit.sim.ardupilot.sensor_status import sensor_status

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.copter import SimulatedCopter

__all__ = ["STATE_BUILDERS", "heartbeat", "mission_current"]

_UNKNOWN_CELL = 0xFFFF
_GUIDED_MODES = frozenset(
    {"GUIDED", "LOITER", "POSHOLD", "CIRCLE", "BRAKE", "RTL", "SMARTRTL", "LAND", "AUTO"}
)


def heartbeat(copter: SimulatedCopter) -> m.Heartbeat:
    """HEARTBEAT; BOOT until half a second after the vehicle is initialised."""
    base = MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED
    if not copter.has_left_boot:
        return m.Heartbeat(
            MavType.QUADROTOR,
            MavAutopilot.ARDUPILOTMEGA,
            base | MavModeFlag.GUIDED_ENABLED,
            copter.mode.number,
            MavState.BOOT,
            3,
        )
    if copter.mode.name in _GUIDED_MODES and (copter.motors.is_armed or copter.mode.name == "GUIDED"):
        base |= MavModeFlag.GUIDED_ENABLED
    if copter.motors.is_armed:
        base |= MavModeFlag.SAFETY_ARMED
    return m.Heartbeat(
        MavType.QUADROTOR, MavAutopilot.ARDUPILOTMEGA, base, copter.mode.number, _state(copter), 3
    )


def _state(copter: SimulatedCopter) -> int:
    if copter.failsafes.is_any_active:
        return MavState.CRITICAL
    return MavState.STANDBY if copter.is_landed else MavState.ACTIVE


def _sys_status(copter: SimulatedCopter) -> m.SysStatus:
    present, enabled, health = sensor_status(copter)
    battery = copter.battery
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


def _extended_sys_state(copter: SimulatedCopter) -> m.ExtendedSysState:
    state = MavLandedState.IN_AIR
    if copter.is_landed:
        state = MavLandedState.ON_GROUND
    elif copter.mode.is_landing:
        state = MavLandedState.LANDING
    elif copter.mode.is_taking_off:
        state = MavLandedState.TAKEOFF
    return m.ExtendedSysState(0, state)


def _battery_status(copter: SimulatedCopter) -> m.BatteryStatus:
    battery = copter.battery
    voltages = (round(battery.voltage_v * 1000), *(_UNKNOWN_CELL,) * 9)
    low = copter.failsafes.battery_is_low
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
        MavBatteryChargeState.LOW if low else MavBatteryChargeState.OK,
    )


def _power_status(copter: SimulatedCopter) -> m.PowerStatus:
    return m.PowerStatus(5000, 0, 0)


def _meminfo(copter: SimulatedCopter) -> m.Meminfo:
    return m.Meminfo(0, 65535, 524288)


def _system_time(copter: SimulatedCopter) -> m.SystemTime:
    unix = round(copter.unix_time * 1e6) if copter.navigation.fix_type >= GpsFixType.TYPE_3D_FIX else 0
    return m.SystemTime(unix, copter.time_boot_ms)


def mission_current(copter: SimulatedCopter, seq: int | None = None) -> m.MissionCurrent:
    """MISSION_CURRENT; ``seq`` says another number than that of the command that is flown."""
    run = copter.mission
    seq = run.nav_index if seq is None else seq
    return m.MissionCurrent(seq, run.count, run.state, int(copter.mode.needs_mission))


def _rc_channels(copter: SimulatedCopter) -> m.RcChannels:
    channels = _by_name(copter.rc.channels)
    return m.RcChannels(time_boot_ms=copter.time_boot_ms, chancount=len(copter.rc), rssi=255, **channels)


def _rc_channels_raw(copter: SimulatedCopter) -> m.RcChannelsRaw:
    return m.RcChannelsRaw(time_boot_ms=copter.time_boot_ms, port=0, rssi=255, **_by_name(copter.rc))


def _by_name(values: Iterable[int]) -> dict[str, int]:
    return {f"chan{number}_raw": value for number, value in enumerate(values, start=1)}


def _servo_output(copter: SimulatedCopter) -> m.ServoOutputRaw:
    pwm = copter.motors.pwm
    return m.ServoOutputRaw(copter.time_boot_us, 0, pwm, pwm, pwm, pwm, 0, 0, 0, 0)


def _vibration(copter: SimulatedCopter) -> m.Vibration:
    size = 0.003 + 0.3 * copter.motors.throttle
    x, y, z = (abs(copter.rng.gauss(0.0, size)) for _ in range(3))
    return m.Vibration(copter.time_boot_us, x, y, z, 0, 0, 0)


def _esc_telemetry(copter: SimulatedCopter) -> m.EscTelemetry1To4:
    current = round(copter.battery.current_a * 25)
    rpm = round(copter.motors.throttle * 15000)
    count = int(copter.uptime * 100) & 0xFFFF
    voltage = round(copter.battery.voltage_v * 100)
    return m.EscTelemetry1To4(
        bytes([32] * 4), (voltage,) * 4, (current,) * 4, (0,) * 4, (rpm,) * 4, (count,) * 4
    )


def _autopilot_version(copter: SimulatedCopter) -> m.AutopilotVersion:
    return m.AutopilotVersion(
        copter.capabilities,
        copter.version_number,
        0,
        0,
        0,
        copter.GIT_HASH,
        bytes(8),
        bytes(8),
        0,
        0,
        0,
        copter.uid,
    )


STATE_BUILDERS: dict[int, Callable[[SimulatedCopter], Message | None]] = {
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
    m.ServoOutputRaw.ID: _servo_output,
    m.Vibration.ID: _vibration,
    m.EscTelemetry1To4.ID: _esc_telemetry,
    m.AutopilotVersion.ID: _autopilot_version,
}
"""Message id → what to send now, or None."""
