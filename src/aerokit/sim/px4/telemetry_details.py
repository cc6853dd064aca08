"""Builders of identity and sensor messages of a simulated PX4."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    MagCalStatus,
    MavDistanceSensor,
    MavEstimatorType,
    MavFrame,
    MavOdidStatus,
    MavSensorOrientation,
    StorageStatus,
)
from aerokit.mavlink.message import Message
from aerokit.sim.commands import rotated
from aerokit.sim.motion import GRAVITY_M_S2, quaternion_from_euler
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.modes import ORBIT

_LIBRARY_HASH = b"\xa4C\x87s\xec\x08o="
_METADATA_URI, _METADATA_CRC = "mftp://etc/extras/component_general.json.xz", 2472443404
_CAPACITY_MIB, _USED_MIB = 258_019.6, 192_146.9


def _autopilot_version(px4: Px4Vehicle) -> m.AutopilotVersion:
    commit = b"\0\0\0\xfd\xaf\xd6\xde\x59"
    return m.AutopilotVersion(
        px4.capabilities, flight_sw_version=px4.version_number, middleware_sw_version=px4.version_number,
        os_sw_version=101854463, board_version=1, flight_custom_version=commit, middleware_custom_version=commit,
        os_custom_version=bytes(8), vendor_id=0, product_id=0, uid=5283920058631409231,
    )  # fmt: skip


def _flight_information(px4: Px4Vehicle) -> m.FlightInformation:
    armed_for = px4.now - px4.arming.armed_at
    armed_at_us = int((px4.unix_time - armed_for) * 1e6) if px4.is_armed else 0
    take_off_us = 0 if px4.is_landed else armed_at_us
    return m.FlightInformation(px4.time_boot_ms, armed_at_us, take_off_us, flight_uuid=0)


_REMOTE_ID_EPOCH = 1_546_300_800
_BROADCAST_ID = bytes(20)


def _remote_location(px4: Px4Vehicle) -> m.OpenDroneIdLocation | None:
    if not px4.has_position:
        return None
    motion = px4.motion
    place = px4.frame.to_global(*motion.place)
    course_deg = math.degrees(motion.course) % 360.0
    direction = 100 * (round(course_deg) % 360)  # Hundredths of a degree. Rounding may give 360 degrees, which is 0.
    unknown_time = 65535.0
    return m.OpenDroneIdLocation(
        target_system=0, target_component=0, id_or_mac=_BROADCAST_ID,
        status=MavOdidStatus.GROUND if px4.is_landed else MavOdidStatus.AIRBORNE, direction=direction,
        speed_horizontal=round(motion.ground_speed_m_s * 100), speed_vertical=round(-motion.velocity_down * 100),
        latitude=place.latitude_e7, longitude=place.longitude_e7, altitude_barometric=place.altitude_m,
        altitude_geodetic=place.altitude_m, height_reference=0, height=px4.altitude_m, horizontal_accuracy=12,
        vertical_accuracy=5, barometer_accuracy=0, speed_accuracy=3, timestamp=unknown_time, timestamp_accuracy=0,
    )  # fmt: skip


def _remote_system(px4: Px4Vehicle) -> m.OpenDroneIdSystem | None:
    if not px4.is_ready:
        return None
    home = px4.frame.to_global(*px4.home)
    seconds = max(0, int(px4.unix_time) - _REMOTE_ID_EPOCH)
    unknown_m = -1000.0
    return m.OpenDroneIdSystem(
        target_system=0, target_component=0, id_or_mac=_BROADCAST_ID, operator_location_type=0, classification_type=0,
        operator_latitude=home.latitude_e7, operator_longitude=home.longitude_e7, area_count=1, area_radius=0,
        area_ceiling=unknown_m, area_floor=unknown_m, category_eu=0, class_eu=0,
        operator_altitude_geo=home.altitude_m, timestamp=seconds,
    )  # fmt: skip


IDENTITY_BUILDERS: dict[int, Callable[[Px4Vehicle], Message | None]] = {
    m.OpenDroneIdLocation.ID: _remote_location,
    m.OpenDroneIdSystem.ID: _remote_system,
    m.AutopilotVersion.ID: _autopilot_version,
    m.MagCalReport.ID: lambda _: m.MagCalReport(
        compass_id=0, cal_mask=0, cal_status=MagCalStatus.SUCCESS, autosaved=0, fitness=0.0, ofs_x=0.0, ofs_y=0.0,
        ofs_z=0.0, diag_x=1.0, diag_y=1.0, diag_z=1.0, offdiag_x=0.0, offdiag_y=0.0, offdiag_z=0.0,
        orientation_confidence=1.0, old_orientation=0, new_orientation=0, scale_factor=1.0,
    ),
    m.StorageInformation.ID: lambda px4: m.StorageInformation(
        px4.time_boot_ms, storage_id=1, storage_count=1, status=StorageStatus.READY, total_capacity=_CAPACITY_MIB,
        used_capacity=_USED_MIB, available_capacity=_CAPACITY_MIB - _USED_MIB, read_speed=0.0, write_speed=0.0,
    ),
    m.FlightInformation.ID: _flight_information,
    m.ProtocolVersion.ID: lambda _: m.ProtocolVersion(
        version=200, min_version=100, max_version=203, spec_version_hash=bytes(8), library_version_hash=_LIBRARY_HASH
    ),
    m.ComponentMetadata.ID: lambda px4: m.ComponentMetadata(px4.time_boot_ms, _METADATA_CRC, _METADATA_URI),
}  # fmt: skip
"""Functions that build messages, by message id. A function returns None if there is nothing to send."""


_SEA_LEVEL_HPA, _SEA_LEVEL_C, _LAPSE_C_PER_M = 1013.25, 15.0, 0.0065
_RANGE_FINDER_CM = (0, 10_000)
_FIELD_GAUSS = (0.215, 0.0, 0.426)
_IMU_FIELDS = 7167
_COVARIANCE = tuple([math.nan] * 21)
_UNUSED_CHANNEL = 65535
_UNKNOWN_TIME = -1
_CLIMB_M_S, _DESCENT_M_S = 3.0, 0.7


def _height(px4: Px4Vehicle) -> float:
    return px4.frame.origin.altitude_m - px4.motion.down


def _pressure_hpa(px4: Px4Vehicle) -> float:
    return float(_SEA_LEVEL_HPA * (1.0 - 2.25577e-5 * _height(px4)) ** 5.25588)


def _scaled_pressure(px4: Px4Vehicle) -> m.ScaledPressure:
    temperature = round(100 * (_SEA_LEVEL_C - _LAPSE_C_PER_M * _height(px4)))
    return m.ScaledPressure(px4.time_boot_ms, _pressure_hpa(px4), press_diff=0.0, temperature=temperature)


def _distance_sensor(px4: Px4Vehicle) -> m.DistanceSensor:
    height = px4.motion.ground_down - px4.motion.down
    min_cm, max_cm = _RANGE_FINDER_CM
    return m.DistanceSensor(
        px4.time_boot_ms, min_distance=min_cm, max_distance=max_cm,
        current_distance=min(max_cm, max(0, round(height * 100))), type=MavDistanceSensor.LASER, id=0,
        orientation=MavSensorOrientation.PITCH_270, covariance=0,
    )  # fmt: skip


def _measured_acceleration(px4: Px4Vehicle) -> tuple[float, float, float]:
    """Return the measured acceleration in m/s² forward, right and down."""
    motion = px4.motion
    forward, right, down = rotated(motion.acceleration, -motion.yaw)
    down -= GRAVITY_M_S2  # At rest, accelerometers measure the force of the ground: 1 g upwards.
    # Terms with sin(roll) * sin(pitch) or the like are small, and are left out.
    return (
        forward * math.cos(motion.pitch) - down * math.sin(motion.pitch),
        right * math.cos(motion.roll) + down * math.sin(motion.roll),
        down * math.cos(motion.roll) * math.cos(motion.pitch),
    )


def _magnetic_field_gauss(px4: Px4Vehicle) -> tuple[float, float, float]:
    north, _, down = _FIELD_GAUSS
    return (north * math.cos(px4.motion.yaw), -north * math.sin(px4.motion.yaw), down)


def _highres_imu(px4: Px4Vehicle) -> m.HighresImu:
    sensors = (*_measured_acceleration(px4), *px4.motion.angular_rates, *_magnetic_field_gauss(px4))
    return m.HighresImu(
        px4.time_boot_us, *sensors, abs_pressure=_pressure_hpa(px4), diff_pressure=0.0, pressure_alt=_height(px4),
        temperature=_SEA_LEVEL_C, fields_updated=_IMU_FIELDS,
    )  # fmt: skip


def _scaled_imu(px4: Px4Vehicle) -> m.ScaledImu:
    # The fields of SCALED_IMU are in milli-g, mrad/s and milligauss.
    force_x, force_y, force_z = (round(axis / GRAVITY_M_S2 * 1000) for axis in _measured_acceleration(px4))
    rate_x, rate_y, rate_z = (round(rate * 1000) for rate in px4.motion.angular_rates)
    field_x, field_y, field_z = (round(axis * 1000) for axis in _magnetic_field_gauss(px4))
    time = px4.time_boot_ms
    return m.ScaledImu(
        time, force_x, force_y, force_z, rate_x, rate_y, rate_z, field_x, field_y, field_z, temperature=1500
    )


def _odometry(px4: Px4Vehicle) -> m.Odometry:
    motion = px4.motion
    pose = (*motion.place, quaternion_from_euler(*motion.angles))
    return m.Odometry(
        px4.time_boot_us, MavFrame.LOCAL_NED, MavFrame.LOCAL_NED, *pose, *motion.velocity, *motion.angular_rates,
        _COVARIANCE, _COVARIANCE, reset_counter=0, estimator_type=MavEstimatorType.AUTOPILOT, quality=0,
    )  # fmt: skip


def _rc_channels(px4: Px4Vehicle) -> m.RcChannels | None:
    if not px4.sticks.has_channels:
        return None
    # The vehicle has no RC receiver, so the channels are those of RC_CHANNELS_OVERRIDE.
    channels = px4.sticks.channels
    used_count = len(channels) if any(channels[8:]) else 8  # Many clients send only the first eight channels.
    used = {f"chan{number}_raw": pulse for number, pulse in enumerate(channels[:used_count], start=1)}
    unused = {f"chan{number}_raw": _UNUSED_CHANNEL for number in range(used_count + 1, len(channels) + 1)}
    return m.RcChannels(time_boot_ms=px4.time_boot_ms, chancount=used_count, rssi=100, **used, **unused)


def _manual_control(px4: Px4Vehicle) -> m.ManualControl:
    sticks = px4.sticks
    throttle = round((sticks.throttle + 1) * 500)
    pitch, roll, yaw = (round(axis * 1000) for axis in (sticks.pitch, sticks.roll, sticks.yaw))
    return m.ManualControl(px4.system_id, x=pitch, y=roll, z=throttle, r=yaw, buttons=0)


def _position_target_global(px4: Px4Vehicle) -> m.PositionTargetGlobalInt | None:
    if not px4.is_armed or not px4.has_position:
        return None
    place, motion = px4.frame.to_global(*px4.flight.target), px4.motion
    # The simulation has no target for the velocity and the yaw, so it sends the present values.
    yaw_and_rate = (motion.yaw, motion.yaw_rate)
    nothing_ignored, no_acceleration = 0, (0.0, 0.0, 0.0)
    return m.PositionTargetGlobalInt(
        px4.time_boot_ms, MavFrame.GLOBAL_INT, nothing_ignored, *place, *motion.velocity, *no_acceleration,
        *yaw_and_rate,
    )  # fmt: skip


def _time_estimate(px4: Px4Vehicle) -> m.TimeEstimateToTarget:
    return_s = _UNKNOWN_TIME
    if not px4.is_landed:
        height = max(px4.parameters["RTL_RETURN_ALT"], px4.altitude_m)
        distance = px4.motion.distance_to(px4.home)
        climb_s = (height - px4.altitude_m) / _CLIMB_M_S
        descent_s = height / _DESCENT_M_S
        return_s = round(climb_s + distance / px4.flight.cruise_speed_m_s + descent_s)
    return m.TimeEstimateToTarget(
        safe_return=return_s,
        land=_UNKNOWN_TIME,
        mission_next_item=_UNKNOWN_TIME,
        mission_end=_UNKNOWN_TIME,
        commanded_action=_UNKNOWN_TIME,
    )


SENSOR_BUILDERS: dict[int, Callable[[Px4Vehicle], Message | None]] = {
    m.LinkNodeStatus.ID: lambda px4: m.LinkNodeStatus(px4.time_boot_us, *(0,) * 10),
    m.ScaledImu.ID: _scaled_imu,
    m.ScaledPressure.ID: _scaled_pressure,
    m.RcChannels.ID: _rc_channels,
    m.ManualControl.ID: _manual_control,
    m.PositionTargetGlobalInt.ID: _position_target_global,
    m.HighresImu.ID: _highres_imu,
    m.Timesync.ID: lambda px4: m.Timesync(0, int(px4.uptime * 1e9)),
    m.DistanceSensor.ID: _distance_sensor,
    m.Odometry.ID: _odometry,
    m.TimeEstimateToTarget.ID: _time_estimate,
    m.OrbitExecutionStatus.ID: lambda px4: px4.flight.orbit.status() if px4.mode == ORBIT else None,
}
"""Functions that build messages, by message id. A function returns None if there is nothing to send."""
