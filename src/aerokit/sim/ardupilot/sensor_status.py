"""The three bit masks of SYS_STATUS as each ArduPilot fills them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CopterMode, PlaneMode, RoverMode, SubMode
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.parameter_tables import Kind
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["sensor_status"]

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
    """Present, enabled and healthy, as integers."""
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
