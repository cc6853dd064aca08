"""Wire messages → values: SI units and degrees, and None where the standard marks a number as unknown."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING

from aerokit import geo
from aerokit.mavlink.enums import GpsFixType, MavBatteryChargeState, MissionState
from aerokit.vehicle.values import (
    Attitude,
    Battery,
    EstimatorHealth,
    GpsReceiver,
    Home,
    LocalPosition,
    MissionProgress,
    Position,
    RangeFinder,
    RcChannels,
    SensorHealth,
    SystemTime,
    Velocity,
    Vibration,
    Wind,
)

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.mavlink import messages

_CHANNELS = attrgetter(*(f"chan{number}_raw" for number in range(1, 19)))
_SERVOS = attrgetter(*(f"servo{number}_raw" for number in range(1, 17)))

U8, U16 = 0xFF, 0xFFFF
I16 = 0x7FFF
NORTH_CDEG = 36000
LOOKING_DOWN = 25
NOWHERE = 100_000
"""Within 0.01 degrees of 0°N 0°E nothing is believed."""
FULL_CELL = 0xFFFE
"""The most a cell can say; a pack of more than 65.5 V fills several "cells" with it."""
EARLIEST_UNIX_S = 1_000_000_000
INVALID_QUALITY = 1


def member(enum: type[int], value: int) -> int:
    """The enum's member, or the number itself when the enum does not know it."""
    return enum._value2member_map_.get(value, value)  # type: ignore[attr-defined,no-any-return]


# --------------------------------------------------------------------------- where and how it moves


def place(latitude: int, longitude: int) -> tuple[float, float] | None:
    """Degrees from 1e-7 degrees; None where there is no fix yet, and for what is no place on earth.

    Without a fix, autopilots say 0, 0, or a place near it: ArduPlane was seen to reckon its way from there.
    """
    if abs(latitude) < NOWHERE and abs(longitude) < NOWHERE:
        return None
    if abs(latitude) > 900_000_000 or abs(longitude) > 1_800_000_000:
        return None
    return latitude / 1e7, longitude / 1e7


def position(message: messages.GlobalPositionInt, *, relative_is_known: bool) -> Position | None:
    """The position, None before the first fix."""
    where = place(message.lat, message.lon)
    if where is None:
        return None
    relative = message.relative_alt / 1e3 if relative_is_known else None
    return Position(*where, message.alt / 1e3, relative)


def global_velocity(message: messages.GlobalPositionInt) -> Velocity:
    """Velocity over ground."""
    return Velocity(message.vx / 100, message.vy / 100, message.vz / 100)


def heading_deg(message: messages.GlobalPositionInt) -> float | None:
    """Where the nose points, 0 to below 360."""
    return None if message.hdg == U16 else message.hdg / 100 % 360


def local_position(message: messages.LocalPositionNed) -> LocalPosition:
    """Position and velocity in the local frame."""
    return LocalPosition(message.x, message.y, message.z, message.vx, message.vy, message.vz)


def attitude(message: messages.Attitude) -> Attitude:
    """Euler angles and rates."""
    degrees = math.degrees
    return Attitude(
        degrees(message.roll),
        degrees(message.pitch),
        degrees(message.yaw),
        degrees(message.rollspeed),
        degrees(message.pitchspeed),
        degrees(message.yawspeed),
    )


def attitude_of_quaternion(message: messages.AttitudeQuaternion) -> Attitude:
    """The same from a quaternion."""
    rates = (
        math.degrees(message.rollspeed),
        math.degrees(message.pitchspeed),
        math.degrees(message.yawspeed),
    )
    return Attitude.from_quaternion(message.q1, message.q2, message.q3, message.q4, rates)


def home(message: messages.HomePosition) -> Home | None:
    """Where it returns to."""
    where = place(message.latitude, message.longitude)
    if where is None:
        return None
    return Home(*where, message.altitude / 1e3, finite(message.x), finite(message.y), finite(message.z))


def origin(message: messages.GpsGlobalOrigin) -> Position | None:
    """Where the local frame has its zero."""
    where = place(message.latitude, message.longitude)
    return None if where is None else Position(*where, message.altitude / 1e3)


def wind(message: messages.Wind) -> Wind:
    """ArduPilot tells where the wind comes from."""
    return Wind(message.speed, geo.wrap_360(message.direction), finite(message.speed_z))


def wind_of_covariance(message: messages.WindCov) -> Wind | None:
    """PX4 tells the wind's own vector, which points where it goes."""
    if not (math.isfinite(message.wind_x) and math.isfinite(message.wind_y)):
        return None
    comes_from = math.degrees(math.atan2(-message.wind_y, -message.wind_x))
    return Wind(math.hypot(message.wind_x, message.wind_y), geo.wrap_360(comes_from), finite(message.wind_z))


def distance_sensor(message: messages.DistanceSensor) -> RangeFinder:
    """One of several distance sensors."""
    quality = message.signal_quality
    is_valid = quality != INVALID_QUALITY
    return RangeFinder(
        message.id,
        message.current_distance / 100 if is_valid else None,
        message.orientation,
        message.min_distance / 100,
        message.max_distance / 100,
        quality if quality > INVALID_QUALITY else None,
    )


def range_finder(message: messages.Rangefinder) -> RangeFinder:
    """ArduPilot's older message about the one that looks down."""
    return RangeFinder(0, finite(message.distance), LOOKING_DOWN)


# ------------------------------------------------------------------------------- what it runs on


def gps_receiver(message: messages.GpsRawInt | messages.Gps2Raw, index: int) -> GpsReceiver:
    """One receiver."""
    where = place(message.lat, message.lon) if message.fix_type >= GpsFixType.TYPE_2D_FIX else None
    latitude, longitude = where or (None, None)
    return GpsReceiver(
        index,
        member(GpsFixType, message.fix_type),
        unless(message.satellites_visible, U8),
        scaled(message.eph, U16, 100),
        scaled(message.epv, U16, 100),
        latitude,
        longitude,
        message.alt / 1e3 if where else None,
        scaled(message.vel, U16, 100),
        scaled(message.cog, U16, 100),
        scaled(message.h_acc, 0, 1000),
        scaled(message.v_acc, 0, 1000),
        scaled(message.vel_acc, 0, 1000),
        None if message.yaw in (0, U16) else message.yaw % NORTH_CDEG / 100,
    )


def battery(message: messages.BatteryStatus, autopilot: Autopilot) -> Battery:
    """One battery; cells 11 to 14 are 0 where there are none."""
    cells = [mv for mv in message.voltages if mv != U16]
    cells += [mv for mv in message.voltages_ext if mv not in (0, U16)]
    is_pack = len(cells) == 1 or FULL_CELL in cells
    return Battery(
        message.id,
        sum(cells) / 1e3 if cells else None,
        current(message.current_battery, autopilot),
        unless(message.battery_remaining, -1),
        () if is_pack else tuple(mv / 1e3 for mv in cells),
        scaled(message.temperature, I16, 100),
        message.current_consumed if message.current_consumed >= 0 else None,
        message.energy_consumed / 36 if message.energy_consumed >= 0 else None,
        unless(message.time_remaining, 0),
        member(MavBatteryChargeState, message.charge_state),
    )


def main_battery(message: messages.SysStatus, autopilot: Autopilot) -> Battery | None:
    """The little that SYS_STATUS says of the first battery; None when that is nothing."""
    voltage = None if message.voltage_battery in (0, U16) else message.voltage_battery / 1e3
    remaining = unless(message.battery_remaining, -1)
    if voltage is None and remaining is None:
        return None
    return Battery(0, voltage, current(message.current_battery, autopilot), remaining)


def current(centiampere: int, autopilot: Autopilot) -> float | None:
    """Amperes, None for what this autopilot sends when it does not know."""
    return None if centiampere in autopilot.unknown_currents_ca else centiampere / 100


def rc_channels(message: messages.RcChannels) -> RcChannels:
    """As many channels as the receiver has."""
    count = min(message.chancount, 18)
    channels = _CHANNELS(message)[:count]
    return RcChannels(tuple([None if us == U16 else us for us in channels]), unless(message.rssi, U8))


def servo_outputs(message: messages.ServoOutputRaw) -> tuple[int, ...]:
    """Sixteen outputs, or eight in MAVLink 1."""
    frame = message.received_frame
    count = 8 if frame is not None and frame.version == 1 else 16
    outputs: tuple[int, ...] = _SERVOS(message)[:count]
    return outputs


def vibration(message: messages.Vibration) -> Vibration:
    """Levels and clipping counters."""
    clippings = (message.clipping_0, message.clipping_1, message.clipping_2)
    return Vibration(message.vibration_x, message.vibration_y, message.vibration_z, clippings)


def system_time(message: messages.SystemTime) -> SystemTime:
    """UTC, unless it still lies in the last century, and time since boot."""
    unix_s = message.time_unix_usec / 1e6
    return SystemTime(unix_s if unix_s > EARLIEST_UNIX_S else None, message.time_boot_ms / 1e3)


# ---------------------------------------------------------------------------------- how it fares


def sensor_health(message: messages.SysStatus, autopilot: Autopilot) -> SensorHealth:
    """What works and what does not, in the autopilot's reading of the bits."""
    bits = (
        message.onboard_control_sensors_present,
        message.onboard_control_sensors_enabled,
        message.onboard_control_sensors_health,
    )
    return SensorHealth(
        *bits, autopilot.failing_sensors(*bits), autopilot.prearm_checks_pass(*bits), message.load / 10
    )


def ekf_health(message: messages.EkfStatusReport, autopilot: Autopilot) -> EstimatorHealth:
    """ArduPilot's estimator."""
    return EstimatorHealth(
        message.NAME,
        message.flags,
        autopilot.missing_estimates(message.flags),
        finite(message.velocity_variance),
        finite(message.pos_horiz_variance),
        finite(message.pos_vert_variance),
        finite(message.compass_variance),
        finite(message.terrain_alt_variance),
        finite(message.airspeed_variance),
    )


def estimator_health(message: messages.EstimatorStatus, autopilot: Autopilot) -> EstimatorHealth:
    """PX4's estimator."""
    return EstimatorHealth(
        message.NAME,
        message.flags,
        autopilot.missing_estimates(message.flags),
        finite(message.vel_ratio),
        finite(message.pos_horiz_ratio),
        finite(message.pos_vert_ratio),
        finite(message.mag_ratio),
        finite(message.hagl_ratio),
        finite(message.tas_ratio),
        finite(message.pos_horiz_accuracy),
        finite(message.pos_vert_accuracy),
    )


def mission_progress(message: messages.MissionCurrent) -> MissionProgress:
    """Without a mission ``total`` is UINT16_MAX; 0 means that the vehicle does not tell it."""
    state = member(MissionState, message.mission_state)
    if message.total == U16:
        return MissionProgress(None, None, state)
    return MissionProgress(unless(message.seq, U16), unless(message.total, 0), state)


# --------------------------------------------------------------------------------------- numbers


def finite(value: float) -> float | None:
    """The number, None for NaN and infinity."""
    return value if math.isfinite(value) else None


def unless(value: int, unknown: int) -> int | None:
    """The number, None when it is the one that stands for unknown."""
    return None if value == unknown else value


def scaled(value: int, unknown: int, divisor: int) -> float | None:
    """The number by ``divisor``, None when it is the one that stands for unknown."""
    return None if value == unknown else value / divisor
