"""All states of a vehicle, each declared once.

To add a state, write its value class and its decoder (``movement.py``, ``equipment.py``, ``condition.py``,
``measurements.py``), declare the state here, and document it below the declaration. Its cell, the attribute of both
vehicle classes, its requested rate and its row in docs/states.md follow from the declaration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.autopilots.modes import Mode
from aerokit.autopilots.telemetry import AutopilotVersion
from aerokit.position import Position
from aerokit.vehicle.state import condition, equipment, measurements, movement
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
from aerokit.vehicle.state.field import MessageSource, StateField
from aerokit.vehicle.state.measurements import (
    ActuatorControls,
    Aircraft,
    AirPressure,
    Altitude,
    Imu,
    Odometry,
    RawImu,
    WinchStatus,
)
from aerokit.vehicle.state.movement import Attitude, Home, LocalPosition, Velocity, Wind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.cells import StateCell


class States:
    """The states of a vehicle, each of which is a cell.

    A cell has ``.value`` (raises ValueUnknownError before the first value), ``.latest`` (None before the first value),
    ``.age`` in seconds, ``.source``, ``.fresh(within=s)``, ``await .wait_until(predicate, held_for=s)`` and
    ``.changes()``.
    """

    mode: StateField[Mode] = StateField(
        MessageSource("Heartbeat", condition.mode, needs_context=True),
        MessageSource("CurrentMode", condition.current_mode, needs_context=True, hz=1.0),
        eager=True,
    )
    """Flight mode (HEARTBEAT); ``vehicle.mode.value.name`` is its name."""

    system_status: StateField[int] = StateField(MessageSource("Heartbeat", condition.system_status), eager=True)
    """MAV_STATE: 3 standby, 4 active, 5 critical, 6 emergency (HEARTBEAT)."""

    # `armed` is declared after `mode` and `system_status`, so that these are up to date when observers of `armed` are
    # called.
    armed: StateField[bool] = StateField(MessageSource("Heartbeat", condition.armed), eager=True)
    """True if the motors are armed (HEARTBEAT)."""

    vtol_state: StateField[int] = StateField(
        MessageSource("ExtendedSysState", condition.vtol_state, hz=5.0), eager=True
    )
    """MAV_VTOL_STATE: 1 going to fixed wing, 2 to multicopter, 3 multicopter, 4 fixed wing (EXTENDED_SYS_STATE)."""

    landed_state: StateField[int] = StateField(
        MessageSource("ExtendedSysState", condition.landed_state, hz=5.0),
        MessageSource("Heartbeat", condition.landed_state_of_heartbeat, needs_context=True, fallback=True),
        eager=True,
    )
    """MAV_LANDED_STATE: 1 on the ground, 2 in the air, 3 taking off, 4 landing (EXTENDED_SYS_STATE)."""

    attitude: StateField[Attitude] = StateField(
        MessageSource("Attitude", movement.attitude, hz=10.0),
        MessageSource("AttitudeQuaternion", movement.attitude_of_quaternion),
    )
    """Roll, pitch, yaw in degrees, turn rates, quaternion (ATTITUDE, ATTITUDE_QUATERNION)."""

    heading_deg: StateField[float] = StateField(
        MessageSource("GlobalPositionInt", movement.heading_deg, hz=10.0),
        MessageSource("VfrHud", movement.heading_of_hud, fallback=True),
        waits_for="GLOBAL_POSITION_INT or VFR_HUD",
    )
    """Heading, 0 to 360 degrees clockwise from north (GLOBAL_POSITION_INT, VFR_HUD)."""

    position: StateField[Position] = StateField(
        MessageSource("GlobalPositionInt", movement.position, needs_context=True, hz=10.0),
        waits_for="GLOBAL_POSITION_INT with a fix",
    )
    """Latitude and longitude in degrees, altitude above sea and above home in metres (GLOBAL_POSITION_INT)."""

    velocity: StateField[Velocity] = StateField(
        MessageSource("GlobalPositionInt", movement.global_velocity, hz=10.0),
        MessageSource("LocalPositionNed", movement.local_velocity, fallback=True),
        waits_for="GLOBAL_POSITION_INT with a fix",
    )
    """Velocity over ground in m/s: north, east, down (GLOBAL_POSITION_INT)."""

    local_position: StateField[LocalPosition] = StateField(
        MessageSource("LocalPositionNed", movement.local_position, hz=10.0)
    )
    """Position in metres from the local origin, and velocity in m/s: north, east, down (LOCAL_POSITION_NED)."""

    ground_speed_m_s: StateField[float] = StateField(MessageSource("VfrHud", movement.ground_speed_m_s, hz=5.0))
    """Ground speed in m/s (VFR_HUD)."""

    air_speed_m_s: StateField[float] = StateField(
        MessageSource("VfrHud", movement.air_speed_m_s, hz=5.0), waits_for="VFR_HUD with an air speed"
    )
    """Air speed in m/s (VFR_HUD)."""

    climb_m_s: StateField[float] = StateField(MessageSource("VfrHud", movement.climb_m_s, hz=5.0))
    """Climb rate in m/s, up is positive (VFR_HUD)."""

    throttle_percent: StateField[float] = StateField(MessageSource("VfrHud", movement.throttle_percent, hz=5.0))
    """Throttle in percent (VFR_HUD)."""

    gps: StateField[tuple[GpsReceiver, ...]] = StateField(
        MessageSource("GpsRawInt", equipment.first_gps, needs_context=True, hz=2.0),
        MessageSource("Gps2Raw", equipment.second_gps, needs_context=True),
    )
    """All satellite receivers, in the order of their numbers (GPS_RAW_INT, GPS2_RAW)."""

    batteries: StateField[tuple[Battery, ...]] = StateField(
        MessageSource("BatteryStatus", equipment.batteries, needs_context=True, hz=1.0, instance_field="id"),
        MessageSource("SysStatus", equipment.main_battery, needs_context=True, fallback=True),
        waits_for="BATTERY_STATUS or SYS_STATUS",
    )
    """All batteries (BATTERY_STATUS, or SYS_STATUS if that is missing)."""

    power: StateField[Power] = StateField(MessageSource("PowerStatus", equipment.power, hz=1.0))
    """Supply voltages of the board and of its servos (POWER_STATUS)."""

    sensors: StateField[SensorHealth] = StateField(
        MessageSource("SysStatus", condition.sensor_health, needs_context=True, hz=2.0)
    )
    """Health of the sensors and the pre-arm checks (SYS_STATUS)."""

    estimator: StateField[EstimatorHealth] = StateField(
        MessageSource("EkfStatusReport", condition.ekf_health, needs_context=True, hz=2.0),
        MessageSource("EstimatorStatus", condition.estimator_health, needs_context=True, hz=2.0, alternative=True),
    )
    """Health of the state estimator (EKF_STATUS_REPORT, ESTIMATOR_STATUS)."""

    # ArduPilot sends HOME_POSITION by itself only when home moves, and that message may be lost.
    home: StateField[Home] = StateField(MessageSource("HomePosition", movement.home, hz=0.5), eager=True)
    """Home position: the place to return to (HOME_POSITION)."""

    origin: StateField[Position] = StateField(MessageSource("GpsGlobalOrigin", movement.origin), eager=True)
    """Origin of the estimator's local frame (GPS_GLOBAL_ORIGIN)."""

    rc_channels: StateField[RcChannels] = StateField(MessageSource("RcChannels", equipment.rc_channels, hz=2.0))
    """Pulse widths of the remote control channels in µs (RC_CHANNELS)."""

    servo_outputs: StateField[ServoOutputs] = StateField(
        MessageSource("ServoOutputRaw", equipment.servo_outputs, needs_context=True, hz=2.0, instance_field="port")
    )
    """Pulse widths of the outputs to motors and servos in µs (SERVO_OUTPUT_RAW)."""

    wind: StateField[Wind] = StateField(
        MessageSource("Wind", movement.wind, hz=1.0),
        MessageSource("WindCov", movement.wind_of_covariance, hz=1.0, alternative=True),
    )
    """Wind speed in m/s and the direction it comes from in degrees (WIND, WIND_COV)."""

    range_finders: StateField[tuple[RangeFinder, ...]] = StateField(
        MessageSource("DistanceSensor", equipment.distance_sensors, needs_context=True, hz=5.0, instance_field="id"),
        MessageSource("Rangefinder", equipment.range_finder, needs_context=True, fallback=True),
    )
    """All distance sensors (DISTANCE_SENSOR, RANGEFINDER)."""

    vibration: StateField[Vibration] = StateField(MessageSource("Vibration", equipment.vibration, hz=1.0))
    """Vibration levels in m/s² (VIBRATION)."""

    system_time: StateField[SystemTime] = StateField(MessageSource("SystemTime", condition.system_time, hz=1.0))
    """The vehicle's clock (SYSTEM_TIME)."""

    version: StateField[AutopilotVersion] = StateField(
        MessageSource("AutopilotVersion", condition.version, needs_context=True), eager=True
    )
    """Firmware and hardware (AUTOPILOT_VERSION)."""

    capabilities: StateField[int] = StateField(MessageSource("AutopilotVersion", condition.capabilities), eager=True)
    """MAV_PROTOCOL_CAPABILITY bits (AUTOPILOT_VERSION)."""

    mission_current: StateField[MissionProgress] = StateField(
        MessageSource("MissionCurrent", condition.mission_progress, hz=1.0)
    )
    """Current mission item (MISSION_CURRENT)."""

    mission_reached: StateField[int] = StateField(
        MessageSource("MissionItemReached", condition.mission_reached), eager=True
    )
    """The last mission item reached (MISSION_ITEM_REACHED)."""

    status_text: StateField[StatusText] = StateField(MessageSource("Statustext", None), eager=True)
    """The last status text (STATUSTEXT); the chunks of a long text are joined."""

    imu: StateField[Imu] = StateField(
        MessageSource("HighresImu", measurements.highres_imu, needs_context=True, watched_hz=10.0)
    )
    """Accelerations, turn rates, magnetic field, pressures and temperature in SI units (HIGHRES_IMU)."""

    scaled_imu: StateField[Imu] = StateField(MessageSource("ScaledImu", measurements.scaled_imu, watched_hz=10.0))
    """Accelerations, turn rates and magnetic field of the first sensor (SCALED_IMU)."""

    raw_imu: StateField[RawImu] = StateField(MessageSource("RawImu", measurements.raw_imu, watched_hz=10.0))
    """Readings of the first inertial sensor, without units (RAW_IMU)."""

    odometry: StateField[Odometry] = StateField(MessageSource("Odometry", measurements.odometry, watched_hz=10.0))
    """Pose and velocity with covariances, as the estimator reports them (ODOMETRY)."""

    scaled_pressure: StateField[AirPressure] = StateField(
        MessageSource("ScaledPressure", measurements.air_pressure, watched_hz=5.0)
    )
    """Absolute and differential pressure and temperature (SCALED_PRESSURE)."""

    ground_truth: StateField[Position] = StateField(
        MessageSource("HilStateQuaternion", measurements.ground_truth, watched_hz=5.0),
        MessageSource("SimState", measurements.simulation_state, watched_hz=5.0, alternative=True),
    )
    """True position in a simulation (HIL_STATE_QUATERNION, SIM_STATE)."""

    altitude: StateField[Altitude] = StateField(MessageSource("Altitude", measurements.altitude, watched_hz=5.0))
    """Altitudes above sea, home, terrain and ground (ALTITUDE)."""

    actuator_control_target: StateField[ActuatorControls] = StateField(
        MessageSource("ActuatorControlTarget", measurements.actuator_controls, watched_hz=5.0)
    )
    """Control outputs before mixing, of PX4 before 1.14 (ACTUATOR_CONTROL_TARGET)."""

    transponder: StateField[tuple[Aircraft, ...]] = StateField(
        MessageSource("AdsbVehicle", measurements.aircraft, needs_context=True, watched_hz=10.0), eager=True
    )
    """Other aircraft that an ADS-B receiver on board has reported, the latest last (ADSB_VEHICLE)."""

    winch_status: StateField[WinchStatus] = StateField(MessageSource("WinchStatus", measurements.winch, watched_hz=2.0))
    """Line length and speed, tension and state of a winch (WINCH_STATUS)."""

    def _cell_of(self, name: str) -> StateCell[Any]:
        raise NotImplementedError


STATES: Mapping[str, StateField[Any]] = {
    name: value for name, value in vars(States).items() if isinstance(value, StateField)
}
"""Maps the name of each state to its declaration."""


def _sources_by_message() -> dict[str, list[tuple[StateField[Any], MessageSource[Any]]]]:
    by_message: dict[str, list[tuple[StateField[Any], MessageSource[Any]]]] = {}
    for field in STATES.values():
        for source in field.sources:
            by_message.setdefault(source.message, []).append((field, source))
    return by_message


SOURCES: Mapping[str, list[tuple[StateField[Any], MessageSource[Any]]]] = _sources_by_message()
"""Maps the name of a message class to the states that the message reports, each with its `MessageSource`."""

LAZY = tuple(name for name, sources in SOURCES.items() if not any(field.eager for field, _ in sources))
"""Names of the message classes that are decoded only when one of their states is accessed."""

DEFAULT_RATES_HZ: Mapping[str, float] = {
    name: max(source.hz for _, source in sources if source.hz is not None)
    for name, sources in SOURCES.items()
    if any(source.hz is not None for _, source in sources)
}
"""Maps the name of a message class to its default rate in Hz."""
