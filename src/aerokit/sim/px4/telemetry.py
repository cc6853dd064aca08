"""Builders of the streamed messages of a simulated PX4, and the table of all builders."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import EstimatorStatusFlags as Ekf
from aerokit.mavlink.enums import (
    GpsFixType,
    MavAutopilot,
    MavBatteryFunction,
    MavBatteryType,
    MavFrame,
    MavLandedState,
    MavModeFlag,
    MavModeProperty,
    MavState,
    MavSysStatusSensor,
)
from aerokit.mavlink.message import Message
from aerokit.sim.missions import INVALID_INDEX
from aerokit.sim.motion import centidegrees, quaternion_from_euler
from aerokit.sim.px4 import modes
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.telemetry_details import IDENTITY_BUILDERS, SENSOR_BUILDERS

# Sensor bits of SYS_STATUS.
_PRESENT, _ENABLED = 0x0300402F, 0x0301402F
_HEALTHY, _HEALTHY_DURING_BOOT = 0x1320C83F, 0x0320883F
_GPS_BIT, _RC_BIT = int(MavSysStatusSensor.GPS), int(MavSysStatusSensor.RC_RECEIVER)
_PREARM_BIT = int(MavSysStatusSensor.MAV_SYS_STATUS_PREARM_CHECK)
# The MAV_STANDARD_MODE of each mode that has one.
_STANDARD = {mode: number for number, mode in modes.STANDARD_MODES.items()}
# Modes in the order of AVAILABLE_MODES. After these modes, PX4 lists eight external modes.
_AVAILABLE_MODES = (
    modes.MANUAL, modes.ALTITUDE, modes.POSITION, modes.MISSION, modes.HOLD, modes.RTL, modes.POSITION_SLOW,
    modes.ALTITUDE_CRUISE, modes.ACRO, modes.TERMINATION, modes.OFFBOARD, modes.STABILIZED, modes.TAKEOFF,
    modes.LAND, modes.FOLLOW_TARGET, modes.PRECISION_LAND, modes.ORBIT, modes.VTOL_TAKEOFF,
)  # fmt: skip
_EXTERNAL_MODES = 8
_MODE_PROPERTIES: dict[modes.Px4Mode, int] = {
    modes.ALTITUDE: 0,
    modes.POSITION: 0,
    modes.TERMINATION: MavModeProperty.ADVANCED | MavModeProperty.NOT_USER_SELECTABLE,
}

_FLIGHT_FLAGS = (
    Ekf.ATTITUDE | Ekf.VELOCITY_HORIZ | Ekf.VELOCITY_VERT | Ekf.POS_HORIZ_REL | Ekf.POS_HORIZ_ABS | Ekf.POS_VERT_ABS
) | (Ekf.POS_VERT_AGL | Ekf.PRED_POS_HORIZ_REL | Ekf.PRED_POS_HORIZ_ABS)
_BOOT_FLAGS = Ekf.ATTITUDE | Ekf.VELOCITY_VERT | Ekf.POS_VERT_ABS | Ekf.POS_VERT_AGL | Ekf.CONST_POS_MODE
_POSITION_FLAGS = Ekf.VELOCITY_HORIZ | Ekf.POS_HORIZ_REL | Ekf.POS_HORIZ_ABS | Ekf.PRED_POS_HORIZ_ABS


def _heartbeat(px4: Px4Vehicle) -> m.Heartbeat:
    mode = modes.TERMINATION if px4.arming.is_terminated else px4.mode
    base_mode = modes.MODES[mode].base_mode
    if px4.is_armed:
        base_mode |= MavModeFlag.SAFETY_ARMED.value  # Combinations of `IntFlag` members are slow.
    if mode == modes.OFFBOARD and px4.offboard.is_fresh:
        base_mode |= MavModeFlag.STABILIZE_ENABLED.value
    custom_mode = modes.custom_mode(px4.mode)  # A termination does not change the custom mode.
    return m.Heartbeat(px4.VEHICLE_TYPE, MavAutopilot.PX4, base_mode, custom_mode, _state(px4), mavlink_version=3)


def _state(px4: Px4Vehicle) -> MavState:
    if px4.arming.is_terminated:
        return MavState.FLIGHT_TERMINATION
    if px4.is_in_failsafe:
        return MavState.CRITICAL
    if px4.is_armed:
        return MavState.ACTIVE
    if px4.calibration.is_running:
        return MavState.CALIBRATING
    # PX4 reports UNINIT while a check prevents arming.
    return MavState.STANDBY if px4.arming.is_possible else MavState.UNINIT


def _sys_status(px4: Px4Vehicle) -> m.SysStatus:
    health = _HEALTHY if px4.is_ready else _HEALTHY_DURING_BOOT
    if not px4.is_armed and not px4.arming.is_possible:
        health &= ~_PREARM_BIT
    if px4.faults.gps_lost:
        health &= ~_GPS_BIT
    if px4.sticks.are_fresh:
        health |= _RC_BIT
    return m.SysStatus(
        onboard_control_sensors_present=_PRESENT,
        onboard_control_sensors_enabled=_ENABLED,
        onboard_control_sensors_health=health,
        load=120,  # 12 %
        voltage_battery=round(px4.battery.voltage_v * 1000),
        current_battery=-100,  # In 0.01 A; PX4 sends -1 A for a current that is not measured.
        battery_remaining=int(px4.battery.percent),
        drop_rate_comm=0, errors_comm=0, errors_count1=0, errors_count2=0, errors_count3=0, errors_count4=0,
        onboard_control_sensors_present_extended=0,
        onboard_control_sensors_enabled_extended=0,
        onboard_control_sensors_health_extended=1,
    )  # fmt: skip


def _estimator_status(px4: Px4Vehicle) -> m.EstimatorStatus:
    flags = _FLIGHT_FLAGS
    if not px4.is_armed:
        flags |= Ekf.CONST_POS_MODE
    if not px4.has_position:
        flags &= ~_POSITION_FLAGS
        if px4.external.has_vision:
            flags |= Ekf.POS_HORIZ_REL
    if not px4.is_ready:
        flags = _BOOT_FLAGS
    ratio = 0.02 if px4.is_ready else math.nan  # The test ratio of velocity, position and magnetometer.
    return m.EstimatorStatus(
        px4.time_boot_us, flags, vel_ratio=ratio, pos_horiz_ratio=ratio, pos_vert_ratio=0.003, mag_ratio=ratio,
        hagl_ratio=0.002, tas_ratio=math.nan, pos_horiz_accuracy=0.3, pos_vert_accuracy=0.3,
    )  # fmt: skip


def _extended_sys_state(px4: Px4Vehicle) -> m.ExtendedSysState:
    state = MavLandedState.IN_AIR
    if px4.is_landed:
        state = MavLandedState.ON_GROUND
    elif px4.mode == modes.TAKEOFF:
        state = MavLandedState.TAKEOFF
    elif px4.mode == modes.LAND:
        state = MavLandedState.LANDING
    return m.ExtendedSysState(px4.vtol_state, state)


def _battery_status(px4: Px4Vehicle) -> m.BatteryStatus:
    battery = px4.battery
    voltages = (round(battery.voltage_v * 1000), *(0xFFFF,) * 9)  # 0xFFFF means that there is no such cell.
    return m.BatteryStatus(
        id=0,
        battery_function=MavBatteryFunction.ALL,
        type=MavBatteryType.LIPO,
        temperature=32767,  # unknown
        voltages=voltages,
        current_battery=-100,  # In 0.01 A; PX4 sends -1 A for a current that is not measured.
        current_consumed=0,
        energy_consumed=-1,
        battery_remaining=int(battery.percent),
        time_remaining=0,
        charge_state=px4.failsafes.battery_state,
    )


def _attitude_quaternion(px4: Px4Vehicle) -> m.AttitudeQuaternion:
    quaternion = quaternion_from_euler(*px4.motion.angles)
    return m.AttitudeQuaternion(px4.time_boot_ms, *quaternion, *px4.motion.angular_rates)


def _attitude_target(px4: Px4Vehicle) -> m.AttitudeTarget:
    return m.AttitudeTarget(
        px4.time_boot_ms, type_mask=0, q=quaternion_from_euler(*px4.motion.angles), body_roll_rate=0.0,
        body_pitch_rate=0.0, body_yaw_rate=px4.motion.yaw_rate, thrust=px4.throttle,
    )  # fmt: skip


def _global_position(px4: Px4Vehicle) -> m.GlobalPositionInt | None:
    # Without a position, PX4 does not send the message, whereas ArduPilot sends zeros. If the position is lost in
    # flight, PX4 continues with dead reckoning.
    if not px4.has_position and not px4.is_armed:
        return None
    motion = px4.motion
    place = px4.frame.to_global(*motion.place)
    north, east, down = (round(speed * 100) for speed in motion.velocity)
    return m.GlobalPositionInt(
        px4.time_boot_ms, lat=place.latitude_e7, lon=place.longitude_e7, alt=round(place.altitude_m * 1000),
        relative_alt=round(px4.altitude_m * 1000), vx=north, vy=east, vz=down, hdg=centidegrees(motion.yaw),
    )  # fmt: skip


def _altitude(px4: Px4Vehicle) -> m.Altitude:
    amsl = px4.frame.origin.altitude_m - px4.motion.down
    ground_down = px4.motion.ground_down
    return m.Altitude(
        px4.time_boot_us, altitude_monotonic=amsl, altitude_amsl=amsl, altitude_local=-px4.motion.down,
        altitude_relative=px4.altitude_m, altitude_terrain=-ground_down, bottom_clearance=ground_down - px4.motion.down,
    )  # fmt: skip


def _vfr_hud(px4: Px4Vehicle) -> m.VfrHud:
    motion = px4.motion
    heading = int(math.degrees(motion.yaw) % 360.0)
    amsl = px4.frame.origin.altitude_m - motion.down
    return m.VfrHud(
        airspeed=px4.airspeed_m_s, groundspeed=motion.ground_speed_m_s, heading=heading,
        throttle=round(px4.throttle * 100), alt=amsl, climb=-motion.velocity_down,
    )  # fmt: skip


def _gps_raw(px4: Px4Vehicle) -> m.GpsRawInt:
    motion = px4.motion
    if px4.faults.gps_lost:
        worst, unknown = 9999, 65535
        return m.GpsRawInt(
            time_usec=0, fix_type=GpsFixType.NO_FIX, lat=0, lon=0, alt=0, eph=worst, epv=worst, vel=unknown,
            cog=unknown, satellites_visible=0,
        )  # fmt: skip
    place = px4.frame.to_global(*motion.place)
    altitude = round(place.altitude_m * 1000)
    return m.GpsRawInt(
        px4.time_boot_us, GpsFixType.RTK_FIXED if px4.corrections.is_recent else GpsFixType.TYPE_3D_FIX,
        place.latitude_e7, place.longitude_e7, altitude, eph=70, epv=110, vel=round(motion.ground_speed_m_s * 100),
        cog=centidegrees(motion.course), satellites_visible=10, alt_ellipsoid=altitude, h_acc=900, v_acc=1780,
        vel_acc=400,
    )  # fmt: skip


def _home_position(px4: Px4Vehicle) -> m.HomePosition | None:
    if not px4.is_ready:
        return None
    place = px4.frame.to_global(*px4.home)
    altitude = round(place.altitude_m * 1000)
    # The yaw at a home that a client has set is unknown, so the quaternion is NaN.
    quaternion = (math.nan,) * 4 if px4.home_is_set_by_client else (1.0, 0.0, 0.0, 0.0)
    return m.HomePosition(
        place.latitude_e7, place.longitude_e7, altitude, *px4.home, quaternion,
        approach_x=0.0, approach_y=0.0, approach_z=0.0, time_usec=px4.time_boot_us,
    )  # fmt: skip


def global_origin(px4: Px4Vehicle) -> m.GpsGlobalOrigin | None:
    if not px4.has_origin:
        return None
    origin = px4.external.origin or px4.frame.origin
    altitude = round(origin.altitude_m * 1000)
    return m.GpsGlobalOrigin(origin.latitude_e7, origin.longitude_e7, altitude, px4.time_boot_us)


_IGNORE_POSITION_AND_VELOCITY = 0b111111


def _target_local(px4: Px4Vehicle) -> m.PositionTargetLocalNed:
    motion = px4.motion
    yaw = motion.yaw
    if not px4.is_armed:
        # The downward acceleration ensures that there is no thrust (MulticopterPositionControl.cpp).
        unknown = (math.nan, math.nan, math.nan)
        acceleration = (0.0, 0.0, 100.0)
        mask = _IGNORE_POSITION_AND_VELOCITY
        return m.PositionTargetLocalNed(
            px4.time_boot_ms, MavFrame.LOCAL_NED, mask, *unknown, *unknown, *acceleration, yaw=yaw, yaw_rate=0.0
        )
    # Apart from the position, the simulation sends the present values as the targets.
    vectors = (*px4.flight.target, *motion.velocity, *motion.acceleration)
    nothing_ignored = 0
    return m.PositionTargetLocalNed(
        px4.time_boot_ms, MavFrame.LOCAL_NED, nothing_ignored, *vectors, yaw=yaw, yaw_rate=motion.yaw_rate
    )


def _servo_output(px4: Px4Vehicle) -> m.ServoOutputRaw:
    pwm = 900 if not px4.is_armed else round(1000 + 1000 * px4.throttle)
    return m.ServoOutputRaw(px4.time_boot_us, 0, *(pwm,) * 4, *(900,) * 12)


def _mission_current(px4: Px4Vehicle) -> m.MissionCurrent:
    mission, store = px4.mission, px4.missions
    ids = (store.opaque_id(0), store.opaque_id(1), store.opaque_id(2))  # of mission, fence and rally points
    total = mission.count or INVALID_INDEX
    return m.MissionCurrent(mission.current, total, mission.state, mission.mode, *ids)


def _vibration(px4: Px4Vehicle) -> m.Vibration:
    vibration_z = 1.4 if px4.is_armed else 0.1
    return m.Vibration(px4.time_boot_us, 0.0, 0.1, vibration_z, clipping_0=0, clipping_1=0, clipping_2=0)


def available_modes(_: Px4Vehicle) -> list[m.AvailableModes]:
    count = len(_AVAILABLE_MODES) + _EXTERNAL_MODES
    messages = []
    for index, mode in enumerate(_AVAILABLE_MODES, start=1):
        standard_mode = _STANDARD.get(mode, 0)
        # PX4 sends no name for a standard mode (RETURN, LAND …).
        name = "" if standard_mode else modes.MODES[mode].name
        properties = _MODE_PROPERTIES.get(mode, MavModeProperty.ADVANCED)
        messages.append(m.AvailableModes(count, index, standard_mode, modes.custom_mode(mode), properties, name))
    # PX4 also lists modes for external programs, even if no program has registered a mode.
    for number in range(_EXTERNAL_MODES):
        main_mode, first_sub_mode = modes.EXTERNAL_1
        messages.append(
            m.AvailableModes(
                number_modes=count, mode_index=len(_AVAILABLE_MODES) + 1 + number, standard_mode=0,
                custom_mode=modes.custom_mode((main_mode, first_sub_mode + number)),
                properties=MavModeProperty.NOT_USER_SELECTABLE, mode_name="(Mode not available)",
            )
        )  # fmt: skip
    return messages


GIMBAL_MESSAGES = frozenset({m.GimbalDeviceAttitudeStatus.ID, m.GimbalManagerInformation.ID, m.GimbalManagerStatus.ID})
"""Ids of the messages that only a vehicle with a gimbal sends."""

BUILDERS: dict[int, Callable[[Px4Vehicle], Message | None]] = {
    m.Heartbeat.ID: _heartbeat,
    m.SysStatus.ID: _sys_status,
    m.EstimatorStatus.ID: _estimator_status,
    m.ExtendedSysState.ID: _extended_sys_state,
    m.BatteryStatus.ID: _battery_status,
    m.Attitude.ID: lambda px4: m.Attitude(px4.time_boot_ms, *px4.motion.angles, *px4.motion.angular_rates),
    m.AttitudeQuaternion.ID: _attitude_quaternion,
    m.AttitudeTarget.ID: _attitude_target,
    m.GlobalPositionInt.ID: _global_position,
    m.LocalPositionNed.ID: lambda px4: m.LocalPositionNed(px4.time_boot_ms, *px4.motion.place, *px4.motion.velocity),
    m.Altitude.ID: _altitude,
    m.VfrHud.ID: _vfr_hud,
    m.GpsRawInt.ID: _gps_raw,
    m.HomePosition.ID: _home_position,
    m.GpsGlobalOrigin.ID: global_origin,
    m.PositionTargetLocalNed.ID: _target_local,
    m.ServoOutputRaw.ID: _servo_output,
    m.MissionCurrent.ID: _mission_current,
    m.Vibration.ID: _vibration,
    m.SystemTime.ID: lambda px4: m.SystemTime(round(px4.unix_time * 1e6), px4.time_boot_ms),
    m.CurrentMode.ID: lambda px4: m.CurrentMode(
        _STANDARD.get(px4.mode, 0), modes.custom_mode(px4.mode), modes.custom_mode(px4.intended_mode)
    ),
    m.Ping.ID: lambda px4: m.Ping(px4.time_boot_us, next(px4.ping_numbers), target_system=0, target_component=0),
    m.CurrentEventSequence.ID: lambda px4: px4.events.current(),
    **SENSOR_BUILDERS,
    **IDENTITY_BUILDERS,
    m.GimbalDeviceAttitudeStatus.ID: lambda px4: px4.gimbal.attitude_status(),
    m.GimbalManagerInformation.ID: lambda px4: px4.gimbal.manager_information(),
    m.GimbalManagerStatus.ID: lambda px4: px4.gimbal.manager_status(),
}
"""Functions that build messages, by message id. A function returns None if there is nothing to send."""
