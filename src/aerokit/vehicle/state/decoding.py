"""Wire messages → values: SI units and degrees, and None where the standard marks a number as unknown."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from aerokit import geo
from aerokit.autopilots import is_armed
from aerokit.mavlink.enums import (
    GpsFixType,
    MavBatteryChargeState,
    MavLandedState,
    MavProtocolCapability,
    MavState,
    MavVtolState,
    MissionState,
)
from aerokit.vehicle.state.values import (
    Attitude,
    AutopilotVersion,
    Battery,
    EstimatorHealth,
    GpsReceiver,
    Home,
    LocalPosition,
    MissionProgress,
    Mode,
    Position,
    RangeFinder,
    RcChannels,
    SensorHealth,
    ServoOutputs,
    SystemTime,
    Velocity,
    Vibration,
    Wind,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

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
OUTPUTS_PER_PORT = 16
SAME_ALTITUDE_MM = 100


class Context:
    """What a decoder may know beside the message; ``before`` is the latest value of the state that it decodes."""

    __slots__ = ("autopilot", "base_mode", "before", "home_is_known", "mode_names")

    def __init__(
        self, autopilot: Autopilot, mode_names: Mapping[int, str], home_is_known: Callable[[], bool]
    ) -> None:
        self.autopilot, self.mode_names, self.home_is_known = autopilot, mode_names, home_is_known
        self.base_mode = 0
        self.before: Any = None


def member(enum: type[int], value: int) -> int:
    """The enum's member, or the number itself when the enum does not know it."""
    return enum._value2member_map_.get(value, value)  # type: ignore[attr-defined,no-any-return]


# ----------------------------------------------------------------------------------- mode and state


def mode(message: messages.Heartbeat, context: Context) -> Mode:
    """The flight mode."""
    return context.autopilot.mode_of(message, context.mode_names)


def current_mode(message: messages.CurrentMode, context: Context) -> Mode | None:
    """The same sooner; it lacks what HEARTBEAT says beside the number."""
    if not message.custom_mode or context.before is None:
        return None
    return context.autopilot.mode(message.custom_mode, context.base_mode, context.mode_names)


def armed(message: messages.Heartbeat) -> bool:
    """Whether the motors are armed."""
    return is_armed(message.base_mode)


def system_status(message: messages.Heartbeat) -> int:
    """MAV_STATE."""
    return member(MavState, message.system_status)


def vtol_state(message: messages.ExtendedSysState) -> int:
    """MAV_VTOL_STATE."""
    return member(MavVtolState, message.vtol_state)


def landed_state(message: messages.ExtendedSysState) -> int | None:
    """MAV_LANDED_STATE."""
    if message.landed_state == MavLandedState.UNDEFINED:
        return None
    return member(MavLandedState, message.landed_state)


def landed_state_of_heartbeat(message: messages.Heartbeat, context: Context) -> int | None:
    """What some autopilots' HEARTBEAT says of it."""
    told = context.autopilot.landed_state_of(message)
    return None if told is None else MavLandedState(told)


def version(message: messages.AutopilotVersion, context: Context) -> AutopilotVersion:
    """Firmware and hardware."""
    return context.autopilot.version_of(message)


def capabilities(message: messages.AutopilotVersion) -> int:
    """MAV_PROTOCOL_CAPABILITY."""
    return MavProtocolCapability(message.capabilities)


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


def position(message: messages.GlobalPositionInt, context: Context) -> Position | None:
    """The position, None before the first fix.

    Until home is set, ``relative_alt`` is no more than the altitude above the sea once again.
    """
    where = place(message.lat, message.lon)
    if where is None:
        return None
    is_known = context.home_is_known() or abs(message.relative_alt - message.alt) > SAME_ALTITUDE_MM
    return Position(*where, message.alt / 1e3, message.relative_alt / 1e3 if is_known else None)


def global_velocity(message: messages.GlobalPositionInt) -> Velocity | None:
    """Velocity over ground, None before the first fix."""
    if place(message.lat, message.lon) is None:
        return None
    return Velocity(message.vx / 100, message.vy / 100, message.vz / 100)


def heading_deg(message: messages.GlobalPositionInt) -> float | None:
    """Where the nose points, 0 to below 360."""
    return None if message.hdg == U16 else message.hdg / 100 % 360


def local_position(message: messages.LocalPositionNed) -> LocalPosition:
    """Position and velocity in the local frame."""
    return LocalPosition(message.x, message.y, message.z, message.vx, message.vy, message.vz)


def local_velocity(message: messages.LocalPositionNed) -> Velocity:
    """The velocity alone."""
    return Velocity(message.vx, message.vy, message.vz)


def heading_of_hud(message: messages.VfrHud) -> float:
    """The same in whole degrees."""
    return float(message.heading % 360)


def ground_speed_m_s(message: messages.VfrHud) -> float:
    """Ground speed."""
    return message.groundspeed


def air_speed_m_s(message: messages.VfrHud) -> float | None:
    """Air speed; PX4 without a sensor says NaN."""
    return finite(message.airspeed)


def climb_m_s(message: messages.VfrHud) -> float:
    """Climb rate."""
    return message.climb


def throttle_percent(message: messages.VfrHud) -> float:
    """Throttle."""
    return float(message.throttle)


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


def distance_sensors(message: messages.DistanceSensor, context: Context) -> tuple[RangeFinder, ...]:
    """Those known before, with this one in its place."""
    quality = message.signal_quality
    is_valid = quality != INVALID_QUALITY
    sensor = RangeFinder(
        message.id,
        message.current_distance / 100 if is_valid else None,
        message.orientation,
        message.min_distance / 100,
        message.max_distance / 100,
        quality if quality > INVALID_QUALITY else None,
    )
    return _with(context.before, sensor, _id_of)


def range_finder(message: messages.Rangefinder, context: Context) -> tuple[RangeFinder, ...]:
    """ArduPilot's older message about the one that looks down."""
    return _with(context.before, RangeFinder(0, finite(message.distance), LOOKING_DOWN), _id_of)


# ------------------------------------------------------------------------------- what it runs on


def first_gps(message: messages.GpsRawInt, context: Context) -> tuple[GpsReceiver, ...]:
    """The receivers known before, with the first in its place."""
    return _with(context.before, _gps_receiver(message, 0), _index_of)


def second_gps(message: messages.Gps2Raw, context: Context) -> tuple[GpsReceiver, ...]:
    """The receivers known before, with the second in its place."""
    return _with(context.before, _gps_receiver(message, 1), _index_of)


def _gps_receiver(message: messages.GpsRawInt | messages.Gps2Raw, index: int) -> GpsReceiver:
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


def batteries(message: messages.BatteryStatus, context: Context) -> tuple[Battery, ...]:
    """Those known before, with this one in its place; cells 11 to 14 are 0 where there are none."""
    cells = [mv for mv in message.voltages if mv != U16]
    cells += [mv for mv in message.voltages_ext if mv not in (0, U16)]
    is_pack = len(cells) == 1 or FULL_CELL in cells
    battery = Battery(
        message.id,
        sum(cells) / 1e3 if cells else None,
        current(message.current_battery, context.autopilot),
        unless(message.battery_remaining, -1),
        () if is_pack else tuple(mv / 1e3 for mv in cells),
        scaled(message.temperature, I16, 100),
        message.current_consumed if message.current_consumed >= 0 else None,
        message.energy_consumed / 36 if message.energy_consumed >= 0 else None,
        unless(message.time_remaining, 0),
        member(MavBatteryChargeState, message.charge_state),
    )
    return _with(context.before, battery, _id_of)


def main_battery(message: messages.SysStatus, context: Context) -> tuple[Battery, ...] | None:
    """The little that SYS_STATUS says of the first battery; None when that is nothing."""
    voltage = None if message.voltage_battery in (0, U16) else message.voltage_battery / 1e3
    remaining = unless(message.battery_remaining, -1)
    if voltage is None and remaining is None:
        return None
    battery = Battery(0, voltage, current(message.current_battery, context.autopilot), remaining)
    return _with(context.before, battery, _id_of)


def current(centiampere: int, autopilot: Autopilot) -> float | None:
    """Amperes, None for what this autopilot sends when it does not know."""
    return None if centiampere in autopilot.unknown_currents_ca else centiampere / 100


def rc_channels(message: messages.RcChannels) -> RcChannels:
    """As many channels as the receiver has."""
    count = min(message.chancount, 18)
    channels = _CHANNELS(message)[:count]
    return RcChannels(tuple([None if us == U16 else us for us in channels]), unless(message.rssi, U8))


def servo_outputs(message: messages.ServoOutputRaw, context: Context) -> ServoOutputs:
    """Those known before, with the sixteen of this port in their place, or eight in MAVLink 1."""
    frame = message.received_frame
    outputs: tuple[int, ...] = _SERVOS(message)[: 8 if frame is not None and frame.version == 1 else 16]
    before: tuple[int, ...] = () if context.before is None else context.before.outputs_us
    begin = message.port * OUTPUTS_PER_PORT
    head = (*before[:begin], *(0,) * (begin - len(before)))
    return ServoOutputs((*head, *outputs, *before[begin + len(outputs) :]))


def vibration(message: messages.Vibration) -> Vibration:
    """Levels and clipping counters."""
    clippings = (message.clipping_0, message.clipping_1, message.clipping_2)
    return Vibration(message.vibration_x, message.vibration_y, message.vibration_z, clippings)


def system_time(message: messages.SystemTime) -> SystemTime:
    """UTC, unless it still lies in the last century, and time since boot."""
    unix_s = message.time_unix_usec / 1e6
    return SystemTime(unix_s if unix_s > EARLIEST_UNIX_S else None, message.time_boot_ms / 1e3)


# ---------------------------------------------------------------------------------- how it fares


def sensor_health(message: messages.SysStatus, context: Context) -> SensorHealth:
    """What works and what does not, in the autopilot's reading of the bits."""
    bits = (
        message.onboard_control_sensors_present,
        message.onboard_control_sensors_enabled,
        message.onboard_control_sensors_health,
    )
    return SensorHealth(
        *bits,
        context.autopilot.failing_sensors(*bits),
        context.autopilot.prearm_checks_pass(*bits),
        message.load / 10,
    )


def ekf_health(message: messages.EkfStatusReport, context: Context) -> EstimatorHealth:
    """ArduPilot's estimator."""
    return EstimatorHealth(
        message.NAME,
        message.flags,
        context.autopilot.missing_estimates(message.flags),
        finite(message.velocity_variance),
        finite(message.pos_horiz_variance),
        finite(message.pos_vert_variance),
        finite(message.compass_variance),
        finite(message.terrain_alt_variance),
        finite(message.airspeed_variance),
    )


def estimator_health(message: messages.EstimatorStatus, context: Context) -> EstimatorHealth:
    """PX4's estimator."""
    return EstimatorHealth(
        message.NAME,
        message.flags,
        context.autopilot.missing_estimates(message.flags),
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


def mission_reached(message: messages.MissionItemReached) -> int:
    """The number of the item."""
    return message.seq


# ----------------------------------------------------------------------------------- several of a kind


def _with(items: tuple[Any, ...] | None, item: Any, key: Callable[[Any], int]) -> tuple[Any, ...]:
    """The items in the order of their numbers, with this one in the place of the former of its number."""
    number = key(item)
    return tuple(sorted((item, *(each for each in items or () if key(each) != number)), key=key))


def _id_of(item: Battery | RangeFinder) -> int:
    return item.id


def _index_of(receiver: GpsReceiver) -> int:
    return receiver.index


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
