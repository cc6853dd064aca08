"""Every state of a vehicle, declared once.

A new one is a value and its decoder (``movement.py``, ``equipment.py``, ``condition.py``) and a declaration here, with
its documentation below it. Its cell, the attribute on both vehicles, what is asked for, decoding on demand and the
table in docs/states.md follow from that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.autopilots.modes import Mode
from aerokit.autopilots.telemetry import AutopilotVersion
from aerokit.position import Position
from aerokit.vehicle.state import condition, equipment, movement
from aerokit.vehicle.state.condition import (
    EstimatorHealth,
    MissionProgress,
    SensorHealth,
    StatusText,
    SystemTime,
)
from aerokit.vehicle.state.equipment import (
    Battery,
    GpsReceiver,
    Power,
    RangeFinder,
    RcChannels,
    ServoOutputs,
    Vibration,
)
from aerokit.vehicle.state.field import By, Told
from aerokit.vehicle.state.movement import Attitude, Home, LocalPosition, Velocity, Wind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.cells import StateCell


class States:
    """Every cell gives ``.value`` (ValueUnknownError before the first), ``.latest`` (None before), ``.age`` in seconds,
    ``.source`` (who said it), ``.fresh(within=s)``, ``await .wait_until(predicate, held_for=s)``, ``.changes()``.
    """

    mode: Told[Mode] = Told(
        By("Heartbeat", condition.mode, knowing=True),
        By("CurrentMode", condition.current_mode, knowing=True, hz=1.0),
        at_once=True,
    )
    """Flight mode by HEARTBEAT; ``vehicle.mode.value.name`` is its name."""

    system_status: Told[int] = Told(By("Heartbeat", condition.system_status), at_once=True)
    """MAV_STATE by HEARTBEAT: 3 standby, 4 active, 5 critical, 6 emergency."""

    # After mode and system_status: whoever observes it has the whole HEARTBEAT.
    armed: Told[bool] = Told(By("Heartbeat", condition.armed), at_once=True)
    """Whether the motors are armed, by HEARTBEAT."""

    vtol_state: Told[int] = Told(By("ExtendedSysState", condition.vtol_state, hz=5.0), at_once=True)
    """MAV_VTOL_STATE: 1 to fixed wing, 2 to multicopter, 3 multicopter, 4 fixed wing (EXTENDED_SYS_STATE)."""

    landed_state: Told[int] = Told(
        By("ExtendedSysState", condition.landed_state, hz=5.0),
        By("Heartbeat", condition.landed_state_of_heartbeat, knowing=True, second_best=True),
        at_once=True,
    )
    """MAV_LANDED_STATE: 1 on the ground, 2 in the air, 3 taking off, 4 landing (EXTENDED_SYS_STATE)."""

    attitude: Told[Attitude] = Told(
        By("Attitude", movement.attitude, hz=10.0),
        By("AttitudeQuaternion", movement.attitude_of_quaternion),
    )
    """Roll, pitch, yaw in degrees, turn rates, quaternion (ATTITUDE, ATTITUDE_QUATERNION)."""

    heading_deg: Told[float] = Told(
        By("GlobalPositionInt", movement.heading_deg, hz=10.0),
        By("VfrHud", movement.heading_of_hud, second_best=True),
        waits_for="GLOBAL_POSITION_INT or VFR_HUD",
    )
    """Where the nose points, 0 to 360 degrees clockwise from north (GLOBAL_POSITION_INT, VFR_HUD)."""

    position: Told[Position] = Told(
        By("GlobalPositionInt", movement.position, knowing=True, hz=10.0),
        waits_for="GLOBAL_POSITION_INT with a fix",
    )
    """Latitude, longitude in degrees, altitude above sea and above home in metres (GLOBAL_POSITION_INT)."""

    velocity: Told[Velocity] = Told(
        By("GlobalPositionInt", movement.global_velocity, hz=10.0),
        By("LocalPositionNed", movement.local_velocity, second_best=True),
        waits_for="GLOBAL_POSITION_INT with a fix",
    )
    """Velocity over ground in m/s, north, east, down (GLOBAL_POSITION_INT)."""

    local_position: Told[LocalPosition] = Told(By("LocalPositionNed", movement.local_position, hz=10.0))
    """Metres and m/s north, east, down of the estimator's origin (LOCAL_POSITION_NED)."""

    ground_speed_m_s: Told[float] = Told(By("VfrHud", movement.ground_speed_m_s, hz=5.0))
    """Ground speed in m/s (VFR_HUD)."""

    air_speed_m_s: Told[float] = Told(
        By("VfrHud", movement.air_speed_m_s, hz=5.0), waits_for="VFR_HUD with an air speed"
    )
    """Air speed in m/s (VFR_HUD)."""

    climb_m_s: Told[float] = Told(By("VfrHud", movement.climb_m_s, hz=5.0))
    """Climb rate in m/s, up is positive (VFR_HUD)."""

    throttle_percent: Told[float] = Told(By("VfrHud", movement.throttle_percent, hz=5.0))
    """Throttle, 0 to 100 (VFR_HUD)."""

    gps: Told[tuple[GpsReceiver, ...]] = Told(
        By("GpsRawInt", equipment.first_gps, knowing=True, hz=2.0),
        By("Gps2Raw", equipment.second_gps, knowing=True),
    )
    """Every satellite receiver, the first one first (GPS_RAW_INT, GPS2_RAW)."""

    batteries: Told[tuple[Battery, ...]] = Told(
        By("BatteryStatus", equipment.batteries, knowing=True, hz=1.0, one_of="id"),
        By("SysStatus", equipment.main_battery, knowing=True, second_best=True),
        waits_for="BATTERY_STATUS or SYS_STATUS",
    )
    """Every battery (BATTERY_STATUS, else SYS_STATUS)."""

    power: Told[Power] = Told(By("PowerStatus", equipment.power, hz=1.0))
    """Supply of the board and of its servos in volts (POWER_STATUS)."""

    sensors: Told[SensorHealth] = Told(By("SysStatus", condition.sensor_health, knowing=True, hz=2.0))
    """Health of the sensors and the pre-arm checks (SYS_STATUS)."""

    estimator: Told[EstimatorHealth] = Told(
        By("EkfStatusReport", condition.ekf_health, knowing=True, hz=2.0),
        By("EstimatorStatus", condition.estimator_health, knowing=True, hz=2.0, instead=True),
    )
    """Health of the state estimator (EKF_STATUS_REPORT, ESTIMATOR_STATUS)."""

    home: Told[Home] = Told(By("HomePosition", movement.home), at_once=True)
    """Where it returns to (HOME_POSITION)."""

    origin: Told[Position] = Told(By("GpsGlobalOrigin", movement.origin), at_once=True)
    """Origin of the estimator's local frame (GPS_GLOBAL_ORIGIN)."""

    rc_channels: Told[RcChannels] = Told(By("RcChannels", equipment.rc_channels, hz=2.0))
    """Remote control, pulse widths in µs (RC_CHANNELS)."""

    servo_outputs: Told[ServoOutputs] = Told(
        By("ServoOutputRaw", equipment.servo_outputs, knowing=True, hz=2.0, one_of="port")
    )
    """Outputs to motors and servos, pulse widths in µs (SERVO_OUTPUT_RAW)."""

    wind: Told[Wind] = Told(
        By("Wind", movement.wind, hz=1.0), By("WindCov", movement.wind_of_covariance, hz=1.0, instead=True)
    )
    """Wind speed in m/s and where it comes from in degrees (WIND, WIND_COV)."""

    range_finders: Told[tuple[RangeFinder, ...]] = Told(
        By("DistanceSensor", equipment.distance_sensors, knowing=True, hz=5.0, one_of="id"),
        By("Rangefinder", equipment.range_finder, knowing=True, second_best=True),
    )
    """Every distance sensor (DISTANCE_SENSOR, RANGEFINDER)."""

    vibration: Told[Vibration] = Told(By("Vibration", equipment.vibration, hz=1.0))
    """Vibration levels in m/s² (VIBRATION)."""

    system_time: Told[SystemTime] = Told(By("SystemTime", condition.system_time, hz=1.0))
    """The vehicle's clock (SYSTEM_TIME)."""

    version: Told[AutopilotVersion] = Told(
        By("AutopilotVersion", condition.version, knowing=True), at_once=True
    )
    """Firmware and hardware (AUTOPILOT_VERSION)."""

    capabilities: Told[int] = Told(By("AutopilotVersion", condition.capabilities), at_once=True)
    """MAV_PROTOCOL_CAPABILITY bits (AUTOPILOT_VERSION)."""

    mission_current: Told[MissionProgress] = Told(By("MissionCurrent", condition.mission_progress, hz=1.0))
    """Current mission item (MISSION_CURRENT)."""

    mission_reached: Told[int] = Told(By("MissionItemReached", condition.mission_reached), at_once=True)
    """The mission item that was reached last (MISSION_ITEM_REACHED)."""

    status_text: Told[StatusText] = Told(By("Statustext", None), at_once=True)
    """The last thing it said (STATUSTEXT, chunks joined)."""

    def _cell_of(self, name: str) -> StateCell[Any]:
        raise NotImplementedError


STATES: Mapping[str, Told[Any]] = {
    name: value for name, value in vars(States).items() if isinstance(value, Told)
}
"""Name → declaration."""


def _by_message() -> dict[str, list[tuple[Told[Any], By[Any]]]]:
    found: dict[str, list[tuple[Told[Any], By[Any]]]] = {}
    for told in STATES.values():
        for source in told.sources:
            found.setdefault(source.message, []).append((told, source))
    return found


SOURCES: Mapping[str, list[tuple[Told[Any], By[Any]]]] = _by_message()
"""Name of a message class → the states that it tells, and how."""

LAZY = tuple(name for name, rows in SOURCES.items() if not any(told.at_once for told, _ in rows))
"""Messages that are worked out when somebody looks at one of their states."""

DEFAULT_RATES_HZ: Mapping[str, float] = {
    name: max(source.hz for _, source in rows if source.hz is not None)
    for name, rows in SOURCES.items()
    if any(source.hz is not None for _, source in rows)
}
"""Name of a message class → how fast it should come when nobody asks for another rate."""
