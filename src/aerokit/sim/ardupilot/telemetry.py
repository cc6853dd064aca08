"""Builders of messages about the state of a simulated ArduPilot, and the table of all builders by firmware."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    AirspeedSensorFlags,
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
from aerokit.sim.ardupilot.host import RC_PITCH, RC_ROLL, RC_THROTTLE, RC_YAW, SUB_FORWARD, SUB_LATERAL, SUB_ROLL
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.plane_modes import PlaneHost
from aerokit.sim.ardupilot.requests import DISPLAY_VALUES
from aerokit.sim.ardupilot.rover_modes import RoverHost
from aerokit.sim.ardupilot.sub_modes import SubHost
from aerokit.sim.ardupilot.telemetry_motion import MOTION_BUILDERS
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

Builders = Mapping[int, Callable[[Any], "Message | None"]]

# These bits are plain integers, because operators of enum flags take ten times as long.
_FENCE, _PREARM = int(Sensor.MAV_SYS_STATUS_GEOFENCE), int(Sensor.MAV_SYS_STATUS_PREARM_CHECK)
_AHRS, _LOGGING = int(Sensor.MAV_SYS_STATUS_AHRS), int(Sensor.MAV_SYS_STATUS_LOGGING)
_RATE, _ATTITUDE = int(Sensor.ANGULAR_RATE_CONTROL), int(Sensor.ATTITUDE_STABILIZATION)
_YAW, _HEIGHT = int(Sensor.YAW_POSITION), int(Sensor.Z_ALTITUDE_CONTROL)
_PLACE, _TERRAIN = int(Sensor.XY_POSITION_CONTROL), int(Sensor.MAV_SYS_STATUS_TERRAIN)
_GPS, _LASER = int(Sensor.GPS), int(Sensor.LASER_POSITION)
_RADIO, _BATTERY, _PROPULSION = int(Sensor.RC_RECEIVER), int(Sensor.BATTERY), int(Sensor.PROPULSION)
_BODY = _RADIO | _BATTERY | int(
    Sensor.SENSOR_3D_GYRO | Sensor.SENSOR_3D_ACCEL | Sensor.SENSOR_3D_MAG | Sensor.ABSOLUTE_PRESSURE
    | Sensor.MOTOR_OUTPUTS
)  # fmt: skip
_ALL_CONTROL = _RATE | _ATTITUDE | _YAW | _HEIGHT | _PLACE
_LOG_AFTER_DISARMING_S = 15.0


@dataclass(frozen=True)
class _Sensors:
    """Sensor bits of a firmware in SYS_STATUS, except GPS."""

    working: int
    """Bits that are present, enabled and healthy from power-on."""
    control: int = _ALL_CONTROL
    """Bits of the controllers that the firmware has, such as MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL."""
    always: int = 0
    """Bits of the controllers that are enabled in every mode."""
    only_healthy: int = 0
    """Bits that are healthy, but neither present nor enabled."""
    unhealthy: int = 0
    """Bits that are present and enabled, but not healthy."""


_SENSORS: dict[Kind, _Sensors] = {
    "copter": _Sensors(
        _BODY | _TERRAIN | _PROPULSION, always=_RATE | _ATTITUDE | _YAW, only_healthy=int(Sensor.PROXIMITY)
    ),
    "plane": _Sensors(_BODY | int(Sensor.DIFFERENTIAL_PRESSURE), unhealthy=_TERRAIN),
    "rover": _Sensors(_BODY, _ALL_CONTROL & ~_HEIGHT, only_healthy=_LASER),
    "sub": _Sensors(_BODY | _LASER, always=_RATE | _ATTITUDE | _YAW),
}

# For each kind of vehicle, pairs of controller bits of SYS_STATUS and the modes in which these controllers are off.
_UNCONTROLLED: dict[Kind, tuple[tuple[int, tuple[int, ...]], ...]] = {
    "copter": (
        (_HEIGHT | _PLACE, (CopterMode.STABILIZE, CopterMode.ACRO)),
        (_PLACE, (CopterMode.ALT_HOLD,)),
    ),
    "plane": (
        (_ALL_CONTROL, (PlaneMode.MANUAL, PlaneMode.TRAINING)),
        (_ALL_CONTROL & ~_RATE, (PlaneMode.ACRO,)),
        (
            _YAW | _HEIGHT | _PLACE,
            (
                PlaneMode.STABILIZE, PlaneMode.FLY_BY_WIRE_A, PlaneMode.AUTOTUNE, PlaneMode.FLY_BY_WIRE_B,
                PlaneMode.CRUISE,
            ),
        ),
    ),
    "rover": (
        (_ALL_CONTROL, (RoverMode.MANUAL, RoverMode.HOLD)),
        (_YAW | _PLACE, (RoverMode.ACRO, RoverMode.STEERING, RoverMode.SIMPLE)),
    ),
    "sub": (
        (
            _HEIGHT | _PLACE,
            (SubMode.MANUAL, SubMode.STABILIZE, SubMode.ACRO, SubMode.MOTORDETECT, SubMode.SURFTRAK),
        ),
    ),
}  # fmt: skip


def _sensor_status(vehicle: ArduPilotVehicle) -> tuple[int, int, int]:
    """Return (present, enabled, healthy) of SYS_STATUS."""
    sensors, nav, kind = _SENSORS[vehicle.KIND], vehicle.navigation, vehicle.KIND
    # Bits of the controllers that are off in the present mode.
    uncontrolled = next((bits for bits, modes in _UNCONTROLLED[kind] if vehicle.mode.number in modes), 0)
    controls = sensors.always | (sensors.control & ~uncontrolled)
    present = sensors.working | sensors.control | sensors.unhealthy | _PREARM | _AHRS | _LOGGING
    enabled = sensors.working | sensors.unhealthy | _PREARM | controls
    health = sensors.working | sensors.only_healthy | _LOGGING | controls
    if nav.is_gps_detected:
        present |= _GPS
        enabled |= _GPS
        if not nav.gps_is_lost:
            health |= _GPS
    if nav.is_healthy:
        enabled |= _AHRS
        is_estimator_in_use = nav.has_position or not vehicle.timeline.uses_dcm_until_gps
        if is_estimator_in_use:
            health |= _AHRS
    # The firmware continues its log for `_LOG_AFTER_DISARMING_S` after disarming.
    if vehicle.motors.is_armed or vehicle.now - vehicle.motors.disarmed_at < _LOG_AFTER_DISARMING_S:
        enabled |= _LOGGING
    if vehicle.rangefinder_reach_m > 0.0:
        present |= _LASER
        enabled |= _LASER
        health |= _LASER
    has_fence, is_fence_enabled, is_fence_healthy = vehicle.fence.health
    if has_fence:
        present |= _FENCE
    if is_fence_enabled:
        enabled |= _FENCE
    if is_fence_healthy:
        health |= _FENCE
    if vehicle.arming.passes:
        health |= _PREARM
    if not vehicle.failsafes.is_radio_healthy:
        health &= ~_RADIO
    if vehicle.failsafes.battery_is_low:
        health &= ~_BATTERY
    if vehicle.faults.motor_failed:
        health &= ~_PROPULSION
    return present, enabled, health


_UNKNOWN_CELL = 0xFFFF
_UNKNOWN_TEMPERATURE = 32767
_UNKNOWN_RSSI = 255
_NOTHING_REACHED = 0xFFFF
_AIR_DENSITY = 1.225
# Output indices of the motors that have ESC telemetry, by firmware.
_MOTORS = {"copter": (0, 1, 2, 3), "plane": (2,)}
# Base mode and custom mode that Plane and Rover report until they are initialised. Copter and Sub report their real
# mode from the beginning.
_BOOT_MODE: dict[str, tuple[int, int]] = {
    "plane": (MavModeFlag.STABILIZE_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED, PlaneMode.INITIALIZING),
    "rover": (MavModeFlag.MANUAL_INPUT_ENABLED | MavModeFlag.CUSTOM_MODE_ENABLED, RoverMode.INITIALIZING),
}


def heartbeat(vehicle: ArduPilotVehicle) -> m.Heartbeat:
    base_mode, mode = vehicle.base_mode, vehicle.mode.number
    state = MavState.BOOT
    if not vehicle.is_initialised and vehicle.KIND in _BOOT_MODE:
        base_mode, mode = _BOOT_MODE[vehicle.KIND]
        state = MavState.CALIBRATING
    elif vehicle.has_left_boot:
        state = MavState.STANDBY if vehicle.is_landed else MavState.ACTIVE
        if vehicle.failsafes.is_any_active:
            state = MavState.CRITICAL
    return m.Heartbeat(vehicle.MAV_TYPE, MavAutopilot.ARDUPILOTMEGA, base_mode, mode, state, mavlink_version=3)


def _sys_status(vehicle: ArduPilotVehicle) -> m.SysStatus:
    battery = vehicle.battery
    present, enabled, health = _sensor_status(vehicle)
    return m.SysStatus(
        onboard_control_sensors_present=present, onboard_control_sensors_enabled=enabled,
        onboard_control_sensors_health=health, load=0, voltage_battery=round(battery.voltage_v * 1000),
        current_battery=round(battery.current_a * 100), battery_remaining=int(battery.percent), drop_rate_comm=0,
        errors_comm=0, errors_count1=0, errors_count2=0, errors_count3=0, errors_count4=0,
    )  # fmt: skip


def _extended_sys_state(vehicle: ArduPilotVehicle) -> m.ExtendedSysState:
    state = MavLandedState.IN_AIR
    if vehicle.is_landed:
        state = MavLandedState.ON_GROUND
    elif vehicle.mode.is_landing:
        state = MavLandedState.LANDING
    elif vehicle.mode.is_taking_off:
        state = MavLandedState.TAKEOFF
    # ArduPilot reports a copter as a VTOL in multicopter state.
    vtol_state = MavVtolState.MC if vehicle.KIND == "copter" else MavVtolState.UNDEFINED
    return m.ExtendedSysState(vtol_state, state)


def _battery_status(vehicle: ArduPilotVehicle) -> m.BatteryStatus:
    battery = vehicle.battery
    voltages = (round(battery.voltage_v * 1000), *(_UNKNOWN_CELL,) * 9)  # The first cell has the whole voltage.
    charge = MavBatteryChargeState.LOW if vehicle.failsafes.battery_is_low else MavBatteryChargeState.OK
    if vehicle.failsafes.battery_is_critical:
        charge = MavBatteryChargeState.CRITICAL
    return m.BatteryStatus(
        id=0,
        battery_function=0,
        type=0,
        temperature=_UNKNOWN_TEMPERATURE,
        voltages=voltages,
        current_battery=round(battery.current_a * 100),
        current_consumed=round(battery.consumed_mah),
        energy_consumed=round(battery.consumed_wh * 36),  # The field is in hectojoules: 1 Wh is 36 hJ.
        battery_remaining=int(battery.percent),
        time_remaining=0,
        charge_state=charge,
    )


def _system_time(vehicle: ArduPilotVehicle) -> m.SystemTime:
    unix = round(vehicle.unix_time * 1e6) if vehicle.navigation.fix_type >= GpsFixType.TYPE_3D_FIX else 0
    return m.SystemTime(unix, vehicle.time_boot_ms)


def _rc_channels(vehicle: ArduPilotVehicle) -> m.RcChannels:
    fields = [vehicle.time_boot_ms, len(vehicle.rc), *vehicle.rc.channels, _UNKNOWN_RSSI]
    return m.RcChannels(*fields)


def _rc_channels_raw(vehicle: ArduPilotVehicle) -> m.RcChannelsRaw:
    fields = [vehicle.time_boot_ms, 0, *vehicle.rc, _UNKNOWN_RSSI]
    return m.RcChannelsRaw(*fields)


def _vibration(vehicle: ArduPilotVehicle) -> m.Vibration:
    deviation = 0.003 + 0.3 * vehicle.motors.throttle
    x, y, z = (abs(vehicle.rng.gauss(0.0, deviation)) for _ in range(3))
    return m.Vibration(vehicle.time_boot_us, x, y, z, clipping_0=0, clipping_1=0, clipping_2=0)


_FULL_THROTTLE_RPM, _ESC_PACKETS_PER_S, _ESC_TEMPERATURE_C = 15000, 100, 32


def _esc_telemetry(vehicle: ArduPilotVehicle) -> m.EscTelemetry1To4:
    has_motor = [index in _MOTORS[vehicle.KIND] for index in range(4)]

    def per_motor(value: int) -> list[int]:
        return [value if fitted else 0 for fitted in has_motor]

    voltages = per_motor(round(vehicle.battery.voltage_v * 100))
    # The motors share the battery current equally, in units of 0.01 A.
    currents = per_motor(round(vehicle.battery.current_a / sum(has_motor) * 100))
    rpms = per_motor(round(vehicle.motors.throttle * _FULL_THROTTLE_RPM))
    # Number of received telemetry packets. The field has 16 bits.
    counts = per_motor(int(vehicle.uptime * _ESC_PACKETS_PER_S) & 0xFFFF)
    temperatures = bytes(per_motor(_ESC_TEMPERATURE_C))
    return m.EscTelemetry1To4(temperatures, voltages, currents, totalcurrent=(0,) * 4, rpm=rpms, count=counts)


def _autopilot_version(vehicle: ArduPilotVehicle) -> m.AutopilotVersion:
    return m.AutopilotVersion(
        capabilities=vehicle.capabilities, flight_sw_version=vehicle.version_number, middleware_sw_version=0,
        os_sw_version=0, board_version=0, flight_custom_version=vehicle.GIT_HASH, middleware_custom_version=bytes(8),
        os_custom_version=bytes(8), vendor_id=0, product_id=0, uid=0, uid2=vehicle.uid,
    )  # fmt: skip


def _angle_of_attack(plane: PlaneHost) -> m.AoaSsa:
    motion = plane.motion
    slope = math.atan2(-motion.velocity_down, max(motion.airspeed_m_s, 1.0))
    attack = 0.0 if plane.is_landed else math.degrees(motion.pitch - slope)
    return m.AoaSsa(plane.time_boot_us, attack, 0.0)


def _airspeed(plane: PlaneHost) -> m.Airspeed:
    speed = plane.motion.airspeed_m_s
    pressure_hpa = 0.5 * _AIR_DENSITY * speed * speed / 100.0
    flags = AirspeedSensorFlags.USING
    return m.Airspeed(id=0, airspeed=speed, temperature=_UNKNOWN_TEMPERATURE, raw_press=pressure_hpa, flags=flags)


def _display_value(sub: SubHost) -> m.NamedValueFloat:
    name = next(sub.display_names)
    return m.NamedValueFloat(sub.time_boot_ms, name, DISPLAY_VALUES[name])


_MIDDLE, _STICK_RANGE = 1500, 500
# The pulses of control surfaces and thrusters deviate by up to this many µs from the middle of 1500 µs.
_SURFACE_RANGE = 400
_ROVER_DEADZONE = 30
_OUTPUTS = 16
_FULL_ROLL_RATE, _FULL_PITCH_RATE = 1.5, 0.5


def _plane_outputs(plane: PlaneHost) -> m.ServoOutputRaw:
    wing, is_armed = plane.wing, plane.motors.is_armed
    throttle = 1000 + (round(1000 * plane.motors.throttle) if is_armed else 0)
    if plane.mode.number == PlaneMode.MANUAL:
        aileron, elevator, rudder = (_pulse(plane.stick(channel)) for channel in (RC_ROLL, RC_PITCH, RC_YAW))
        throttle = max(1000, min(2000, plane.rc[RC_THROTTLE])) if is_armed else 1000
    else:
        # The motion model has no surfaces. The deflections are derived from the rates of the plane.
        roll_share = wing.roll_rate / _FULL_ROLL_RATE
        aileron = _pulse(roll_share)
        rudder = _pulse(0.5 * roll_share)
        elevator = _pulse(wing.pitch_rate / _FULL_PITCH_RATE)  # As in MANUAL, a pulse above the middle raises the nose.
    return _servo_outputs(plane, aileron, elevator, throttle, rudder)


def _rover_outputs(rover: RoverHost) -> m.ServoOutputRaw:
    if rover.mode.has_manual_throttle:
        deflection = rover.rc[RC_ROLL] - _MIDDLE  # The roll stick steers.
        beyond_deadzone = max(0, abs(deflection) - _ROVER_DEADZONE)
        steering = min(_STICK_RANGE, int(beyond_deadzone * _STICK_RANGE / (_STICK_RANGE - _ROVER_DEADZONE)))
        if deflection < 0:
            steering = -steering
    else:
        steering = round(_STICK_RANGE * rover.motion.yaw_rate / rover.motion.wheels.turn_rate_rad_s)
    throttle = round(_STICK_RANGE * rover.motors.throttle)
    return _servo_outputs(rover, _MIDDLE + steering, 0, _MIDDLE + throttle)


def _sub_outputs(sub: SubHost) -> m.ServoOutputRaw:
    thrusters = [_MIDDLE] * 6
    if sub.motors.is_armed:
        yaw, forward, lateral, roll = (sub.stick(channel) for channel in (RC_YAW, SUB_FORWARD, SUB_LATERAL, SUB_ROLL))
        # The signs are the motor factors of the frame VECTORED (AP_Motors6DOF.cpp). The vertical thrusters have the
        # throttle factor -1: their pulses fall below the middle for a throttle above one half.
        vertical = -(2.0 * sub.motors.throttle - 1.0)
        thrusts = (
            yaw - forward + lateral, -yaw - forward - lateral, -yaw + forward + lateral, yaw + forward - lateral,
            vertical + roll, vertical - roll,
        )  # fmt: skip
        thrusters = [_pulse(thrust) for thrust in thrusts]
    # The outputs 8 and 10 are camera axes.
    return _servo_outputs(sub, *thrusters, 0, _MIDDLE, 0, _MIDDLE)


def _servo_outputs(vehicle: ArduPilotVehicle, *pulses: int) -> m.ServoOutputRaw:
    outputs = [*pulses, *(0,) * (_OUTPUTS - len(pulses))]
    for number, pulse in vehicle.devices.servos.items():
        if 1 <= number <= _OUTPUTS:
            outputs[number - 1] = pulse
    return m.ServoOutputRaw(vehicle.time_boot_us & 0xFFFFFFFF, 0, *outputs)


def _pulse(share: float) -> int:
    """Return a pulse in microseconds for a share from -1 to 1 of the full range."""
    return _MIDDLE + round(_SURFACE_RANGE * max(-1.0, min(1.0, share)))


_ALL: Builders = {
    **MOTION_BUILDERS,
    m.Heartbeat.ID: heartbeat,
    m.SysStatus.ID: _sys_status,
    m.ExtendedSysState.ID: _extended_sys_state,
    m.BatteryStatus.ID: _battery_status,
    m.PowerStatus.ID: lambda _: m.PowerStatus(Vcc=5000, Vservo=0, flags=0),
    m.Meminfo.ID: lambda _: m.Meminfo(brkval=0, freemem=65535, freemem32=524288),
    m.Hwstatus.ID: lambda _: m.Hwstatus(Vcc=5000, I2Cerr=0),
    m.SystemTime.ID: _system_time,
    m.MissionCurrent.ID: lambda vehicle: vehicle.mission.message(),
    m.MissionItemReached.ID: lambda _: m.MissionItemReached(_NOTHING_REACHED),
    m.RcChannels.ID: _rc_channels,
    m.RcChannelsRaw.ID: _rc_channels_raw,
    m.Vibration.ID: _vibration,
    m.EscTelemetry1To4.ID: _esc_telemetry,
    m.AutopilotVersion.ID: _autopilot_version,
    m.RelayStatus.ID: lambda vehicle: m.RelayStatus(
        vehicle.time_boot_ms, vehicle.devices.relays, (1 << vehicle.devices.relay_count) - 1
    ),
    m.FlightInformation.ID: lambda vehicle: m.FlightInformation(
        vehicle.time_boot_ms, arming_time_utc=0, takeoff_time_utc=0, flight_uuid=0
    ),
    m.GimbalDeviceAttitudeStatus.ID: lambda v: v.gimbal.attitude_status() if v.gimbal.is_fitted else None,
    m.GimbalManagerInformation.ID: lambda v: v.gimbal.manager_information() if v.gimbal.is_fitted else None,
    m.GimbalManagerStatus.ID: lambda v: v.gimbal.manager_status() if v.gimbal.is_fitted else None,
    m.CameraInformation.ID: lambda v: v.camera.information() if v.camera.is_fitted else None,
    m.CameraSettings.ID: lambda v: v.camera.settings() if v.camera.is_fitted else None,
    m.CameraCaptureStatus.ID: lambda v: v.camera.capture_status() if v.camera.is_fitted else None,
    m.CameraFeedback.ID: lambda v: v.camera.feedback if v.camera.is_fitted else None,
    m.FenceStatus.ID: lambda vehicle: vehicle.fence.status(),
    m.MagCalProgress.ID: lambda vehicle: vehicle.calibrations.compasses.progress(),
    m.MagCalReport.ID: lambda vehicle: vehicle.calibrations.compasses.report(),
}
_COPTER_TARGETS = (m.AttitudeTarget.ID, m.PositionTargetLocalNed.ID)


def _without(*message_ids: int) -> Builders:
    return {number: builder for number, builder in _ALL.items() if number not in message_ids}


BUILDERS_OF_KIND: dict[Kind, Builders] = {
    "copter": {
        **_without(),
        m.ServoOutputRaw.ID: lambda vehicle: _servo_outputs(vehicle, *(vehicle.motors.pwm,) * 4),
        m.WinchStatus.ID: lambda vehicle: vehicle.devices.winch_status(),
    },
    "plane": {
        **_without(*_COPTER_TARGETS),
        m.ServoOutputRaw.ID: _plane_outputs,
        m.Airspeed.ID: _airspeed,
        m.AoaSsa.ID: _angle_of_attack,
    },
    "rover": {
        **_without(m.Wind.ID, m.TerrainReport.ID, m.TerrainRequest.ID, m.EscTelemetry1To4.ID, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: _rover_outputs,
        m.RcChannelsScaled.ID: lambda rover: m.RcChannelsScaled(rover.time_boot_ms, *(0,) * 9, rssi=_UNKNOWN_RSSI),
        m.ExtendedSysState.ID: lambda _: m.ExtendedSysState(MavVtolState.UNDEFINED, MavLandedState.UNDEFINED),
    },
    "sub": {
        **_without(m.Wind.ID, m.TerrainRequest.ID, m.EscTelemetry1To4.ID, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: _sub_outputs,
        m.NamedValueFloat.ID: _display_value,
        # ArduSub uses SCALED_PRESSURE3 to report a thermometer, so the pressure is 0.
        m.ScaledPressure3.ID: lambda sub: m.ScaledPressure3(
            sub.time_boot_ms, press_abs=0.0, press_diff=0.0, temperature=3620, temperature_press_diff=0
        ),
        m.ExtendedSysState.ID: lambda _: m.ExtendedSysState(MavVtolState.UNDEFINED, MavLandedState.UNDEFINED),
    },
}
"""Functions that build messages, by firmware and message id. The firmware sends no other messages."""
