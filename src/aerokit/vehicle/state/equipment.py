"""State values and decoders: satellite receivers, batteries, range finders, outputs, gimbals."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.mavlink.enums import GimbalDeviceFlags, GpsFixType, MavBatteryChargeState, MavPowerStatus
from aerokit.vehicle.state.field import I16, U8, U16, Context, divided, enum_member, finite, known
from aerokit.vehicle.state.movement import valid_coordinates

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Autopilot
    from aerokit.mavlink import messages
    from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus, MountOrientation, MountStatus

__all__ = [
    "Battery",
    "GimbalAttitude",
    "GpsReceiver",
    "Power",
    "RangeFinder",
    "RcChannels",
    "ServoOutputs",
    "Vibration",
    "batteries",
    "current",
    "distance_sensors",
    "first_gps",
    "from_device",
    "from_orientation",
    "from_status",
    "main_battery",
    "power",
    "range_finder",
    "rc_channels",
    "second_gps",
    "servo_outputs",
    "vibration",
]

_CHANNELS = attrgetter(*(f"chan{number}_raw" for number in range(1, 19)))

_SERVOS = attrgetter(*(f"servo{number}_raw" for number in range(1, 17)))

# GPS_RAW_INT.yaw has this value for north, because 0 means that the yaw is unknown.
NORTH_CDEG = 36000

# The MAV_SENSOR_ORIENTATION of a sensor that looks straight down (MAV_SENSOR_ROTATION_PITCH_270).
LOOKING_DOWN = 25

# The fix types from a 3D fix to PPP, the best one (GPS_FIX_TYPE).
GPS_FIX_TYPE_3D, GPS_FIX_TYPE_PPP = 3, 8

# Largest cell voltage in BATTERY_STATUS, in mV. The total voltage of a pack above 65.5 V is split into several "cells",
# of which all except the last have this value.
FULL_CELL = 0xFFFE

# DISTANCE_SENSOR.signal_quality is 1 if the reading is invalid, and 0 if the quality is unknown.
INVALID_QUALITY = 1

OUTPUTS_PER_PORT = 16


class RangeFinder(Snapshot):
    """One distance sensor. ``distance_m`` is None if the reading is invalid.

    ``orientation`` is a MAV_SENSOR_ORIENTATION, for example 25: down. ``quality_percent`` is None if not reported.
    """

    id: int
    distance_m: float | None
    orientation: int
    min_distance_m: float | None = None
    max_distance_m: float | None = None
    quality_percent: int | None = None


class GpsReceiver(Snapshot):
    """One satellite receiver. ``index`` is 0 for the receiver in GPS_RAW_INT, 1 for the one in GPS2_RAW.

    ``fix_type`` is a GPS_FIX_TYPE (0 no receiver, 1 no fix, 2 2D, 3 3D, 4 DGPS, 5 RTK float, 6 RTK fixed). The
    position is None before a fix. Accuracies are one standard deviation.
    """

    index: int
    fix_type: int
    satellites: int | None = None
    hdop: float | None = None
    vdop: float | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_amsl_m: float | None = None
    ground_speed_m_s: float | None = None
    course_deg: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None
    speed_accuracy_m_s: float | None = None
    yaw_deg: float | None = None

    @property
    def has_3d_fix(self) -> bool:
        """True for a 3D fix or better."""
        return GPS_FIX_TYPE_3D <= self.fix_type <= GPS_FIX_TYPE_PPP


class Battery(Snapshot):
    """One battery. ``cell_voltages_v`` is empty if cells are not measured individually.

    ``charge_state`` is a MAV_BATTERY_CHARGE_STATE (1 OK, 2 low, 3 critical …), 0 if not reported.
    """

    id: int
    voltage_v: float | None = None
    current_a: float | None = None
    remaining_percent: int | None = None
    cell_voltages_v: tuple[float, ...] = ()
    temperature_c: float | None = None
    consumed_mah: int | None = None
    consumed_wh: float | None = None
    time_remaining_s: int | None = None
    charge_state: int = 0


class Power(Snapshot):
    """Supply voltages of the board and of the servos (None: not measured), and MAV_POWER_STATUS bits."""

    board_v: float | None
    servos_v: float | None
    flags: int


class RcChannels(Snapshot):
    """Pulse widths of the remote control in µs (None: unused channel); ``rssi`` is 0 to 254 (None: unknown)."""

    channels_us: tuple[int | None, ...]
    rssi: int | None = None


class ServoOutputs(Snapshot):
    """Pulse widths to motors and servos in µs. ``outputs_us[0]`` is output 1; a value of 0 means no pulses."""

    outputs_us: tuple[int, ...]


class Vibration(Snapshot):
    """Vibration levels in m/s², and how often each of three accelerometers has clipped since boot."""

    x_m_s2: float
    y_m_s2: float
    z_m_s2: float
    clippings: tuple[int, int, int]


def distance_sensors(message: messages.DistanceSensor, context: Context) -> tuple[RangeFinder, ...]:
    """Return all sensors reported so far, with the new reading of this message's sensor."""
    quality = message.signal_quality
    is_valid = quality != INVALID_QUALITY
    sensor = RangeFinder(
        id=message.id,
        distance_m=message.current_distance / 100 if is_valid else None,
        orientation=message.orientation,
        min_distance_m=message.min_distance / 100,
        max_distance_m=message.max_distance / 100,
        quality_percent=quality if quality > INVALID_QUALITY else None,  # 0 means "unknown", 1 "invalid"
    )
    return _updated_entries(context.previous_value, sensor, key=_id_of)


def range_finder(message: messages.Rangefinder, context: Context) -> tuple[RangeFinder, ...]:
    """Return all sensors reported so far. Older ArduPilot sends RANGEFINDER, which becomes sensor 0."""
    return _updated_entries(
        context.previous_value,
        RangeFinder(id=0, distance_m=finite(message.distance), orientation=LOOKING_DOWN),
        key=_id_of,
    )


def first_gps(message: messages.GpsRawInt, context: Context) -> tuple[GpsReceiver, ...]:
    """Return all receivers reported so far, the first one with the new values of this message."""
    return _updated_entries(context.previous_value, _gps_receiver(message, index=0), key=_index_of)


def second_gps(message: messages.Gps2Raw, context: Context) -> tuple[GpsReceiver, ...]:
    """Return all receivers reported so far, the second one with the new values of this message."""
    return _updated_entries(context.previous_value, _gps_receiver(message, index=1), key=_index_of)


def _gps_receiver(message: messages.GpsRawInt | messages.Gps2Raw, index: int) -> GpsReceiver:
    has_fix = message.fix_type >= GpsFixType.TYPE_2D_FIX
    coordinates = valid_coordinates(message.lat, message.lon) if has_fix else None
    latitude, longitude = coordinates or (None, None)
    # A yaw of 0 means that the receiver cannot measure the yaw. U16 means that the receiver can, but has no yaw at
    # present.
    yaw_deg = None if message.yaw in (0, U16) else message.yaw % NORTH_CDEG / 100
    return GpsReceiver(
        index=index,
        fix_type=enum_member(GpsFixType, message.fix_type),
        satellites=known(message.satellites_visible, unknown=U8),
        hdop=divided(message.eph, 100, unknown=U16),
        vdop=divided(message.epv, 100, unknown=U16),
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_amsl_m=message.alt / 1e3 if coordinates else None,
        ground_speed_m_s=divided(message.vel, 100, unknown=U16),
        course_deg=divided(message.cog, 100, unknown=U16),
        horizontal_accuracy_m=divided(message.h_acc, 1000, unknown=0),
        vertical_accuracy_m=divided(message.v_acc, 1000, unknown=0),
        speed_accuracy_m_s=divided(message.vel_acc, 1000, unknown=0),
        yaw_deg=yaw_deg,
    )


def cell_voltages_mv(message: messages.BatteryStatus) -> list[int]:
    """Return the reported voltages, or an empty list if none is measured."""
    # These are the voltages of the single cells, or only the total voltage.
    cells_mv = [millivolts for millivolts in message.voltages if millivolts != U16]
    # Cells 11 to 14 are an extension of the message, in which an absent cell may be 0 instead of U16.
    cells_mv += [millivolts for millivolts in message.voltages_ext if millivolts not in (0, U16)]
    # If a battery on CAN does not measure its voltage, PX4 reports 0 mV.
    return cells_mv if any(cells_mv) else []


def batteries(message: messages.BatteryStatus, context: Context) -> tuple[Battery, ...]:
    """Return all batteries reported so far, with the new values of this message's battery."""
    cells_mv = cell_voltages_mv(message)
    # If the cells are not measured one by one, the message has the total voltage, in one or several "cells" (see
    # FULL_CELL).
    is_only_total = len(cells_mv) == 1 or FULL_CELL in cells_mv
    battery = Battery(
        id=message.id,
        voltage_v=sum(cells_mv) / 1e3 if cells_mv else None,
        current_a=current(message.current_battery, context.autopilot),
        remaining_percent=known(message.battery_remaining, unknown=-1),
        cell_voltages_v=() if is_only_total else tuple(millivolts / 1e3 for millivolts in cells_mv),
        temperature_c=divided(message.temperature, 100, unknown=I16),
        consumed_mah=message.current_consumed if message.current_consumed >= 0 else None,
        consumed_wh=message.energy_consumed / 36 if message.energy_consumed >= 0 else None,  # from hectojoules
        time_remaining_s=known(message.time_remaining, unknown=0),
        charge_state=enum_member(MavBatteryChargeState, message.charge_state),
    )
    return _updated_entries(context.previous_value, battery, key=_id_of)


def main_battery(message: messages.SysStatus, context: Context) -> tuple[Battery, ...] | None:
    """Return all batteries, battery 0 with the values of SYS_STATUS; None if it has neither voltage nor charge."""
    voltage = None if message.voltage_battery in (0, U16) else message.voltage_battery / 1e3
    remaining = known(message.battery_remaining, unknown=-1)
    if voltage is None and remaining is None:
        return None
    battery = Battery(0, voltage, current(message.current_battery, context.autopilot), remaining)
    return _updated_entries(context.previous_value, battery, key=_id_of)


def current(centiampere: int, autopilot: Autopilot) -> float | None:
    """Return the current in amperes; None if it is unknown."""
    return None if centiampere in autopilot.unknown_currents_ca else centiampere / 100


def power(message: messages.PowerStatus) -> Power:
    """Return the supply voltages. A voltage that is not measured (0 in the message) is None."""
    return Power(
        divided(message.Vcc, 1000, unknown=0),
        divided(message.Vservo, 1000, unknown=0),
        enum_member(MavPowerStatus, message.flags),
    )


def rc_channels(message: messages.RcChannels) -> RcChannels:
    """Return the pulse widths of the channels that the RC receiver has."""
    count = min(message.chancount, 18)
    channels = _CHANNELS(message)[:count]
    return RcChannels(tuple([None if us == U16 else us for us in channels]), known(message.rssi, unknown=U8))


def servo_outputs(message: messages.ServoOutputRaw, context: Context) -> ServoOutputs:
    """Return all outputs reported so far, updated by this message, which has the 16 outputs of one port."""
    frame = message.received_frame
    # MAVLink 1 has no extension fields, so the message has only the first eight outputs of the port.
    count = 8 if frame is not None and frame.version == 1 else OUTPUTS_PER_PORT
    first_index = message.port * OUTPUTS_PER_PORT
    outputs: list[int] = [] if context.previous_value is None else list(context.previous_value.outputs_us)
    outputs += [0] * (first_index - len(outputs))  # the outputs of earlier ports that were not reported yet
    outputs[first_index : first_index + count] = _SERVOS(message)[:count]
    return ServoOutputs(tuple(outputs))


def vibration(message: messages.Vibration) -> Vibration:
    """Return vibration levels and clipping counts."""
    clippings = (message.clipping_0, message.clipping_1, message.clipping_2)
    return Vibration(message.vibration_x, message.vibration_y, message.vibration_z, clippings)


def _updated_entries(items: tuple[Any, ...] | None, item: Any, key: Callable[[Any], int]) -> tuple[Any, ...]:
    """Return ``items`` with ``item`` in place of the one with the same key, sorted by key."""
    other_items = (existing for existing in items or () if key(existing) != key(item))
    return tuple(sorted((item, *other_items), key=key))


def _id_of(item: Battery | RangeFinder) -> int:
    return item.id


def _index_of(receiver: GpsReceiver) -> int:
    return receiver.index


YAW_LOCK = GimbalDeviceFlags.YAW_LOCK.value

YAW_IN_VEHICLE_FRAME = GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME.value

YAW_IN_EARTH_FRAME = GimbalDeviceFlags.YAW_IN_EARTH_FRAME.value

# If the sine of the pitch exceeds this, the camera points straight up or down.
MIN_SINE_STRAIGHT = 0.99999


class GimbalAttitude(Snapshot):
    """Attitude of a gimbal in degrees. An angle that is not reported is None.

    ``pitch_deg`` (0 level, −90 straight down) and ``roll_deg`` are from the horizon. ``yaw_deg`` is 0 to 360 clockwise
    from north, ``yaw_from_nose_deg`` −180 to 180 clockwise from the vehicle's nose. While the vehicle's heading is
    unknown, one of the two may be None. ArduPilot before 4.3 reports MOUNT_STATUS, whose yaw may be relative to north
    or to the nose; ``yaw_deg`` is then this yaw, unchanged.
    """

    pitch_deg: float | None
    roll_deg: float | None
    yaw_deg: float | None
    yaw_from_nose_deg: float | None = None


def from_status(message: MountStatus) -> GimbalAttitude:
    """Return the attitude of MOUNT_STATUS. Its yaw, from north or from the nose, is not converted."""
    return GimbalAttitude(message.pointing_a / 100.0, message.pointing_b / 100.0, message.pointing_c / 100.0)


def from_orientation(message: MountOrientation, heading: float | None) -> GimbalAttitude:
    """Return the attitude of MOUNT_ORIENTATION. ``heading`` is the vehicle's heading in degrees, None if unknown."""
    # ``yaw_absolute`` (from north) is an extension field: 0 may mean that it was not sent.
    if message.yaw_absolute and math.isfinite(message.yaw_absolute):
        yaw = _rounded_to_360(message.yaw_absolute)
    else:
        yaw = None if heading is None else _rounded_to_360(message.yaw + heading)
    return GimbalAttitude(_rounded(message.pitch), _rounded(message.roll), yaw, _rounded_to_180(message.yaw))


def from_device(message: GimbalDeviceAttitudeStatus, heading: float | None) -> GimbalAttitude:
    """Return the attitude of GIMBAL_DEVICE_ATTITUDE_STATUS.

    The message has the yaw from the nose or the yaw from north. The other one is computed with the message's
    ``delta_yaw`` or, if that is unknown, with the vehicle's ``heading`` in degrees. It is None if both are unknown.
    """
    pitch, roll, yaw = _euler(message.q)
    # Older gimbals send neither these flags nor ``delta_yaw``, which is an extension of the message.
    sends_delta_yaw = bool(message.flags & (YAW_IN_VEHICLE_FRAME | YAW_IN_EARTH_FRAME))
    # PX4 also sends a ``delta_yaw`` of 0 while the heading is unknown.
    knows_delta_yaw = sends_delta_yaw and math.isfinite(message.delta_yaw) and message.delta_yaw != 0
    nose_heading = math.degrees(message.delta_yaw) if knows_delta_yaw else heading
    pitch_and_roll = (_rounded(pitch), _rounded(roll))
    if _is_from_nose(message.flags):
        yaw_from_north = None if nose_heading is None else _rounded_to_360(yaw + nose_heading)
        return GimbalAttitude(*pitch_and_roll, yaw_from_north, _rounded_to_180(yaw))
    yaw_from_nose = None if nose_heading is None else _rounded_to_180(yaw - nose_heading)
    return GimbalAttitude(*pitch_and_roll, _rounded_to_360(yaw), yaw_from_nose)


def _is_from_nose(flags: int) -> bool:
    """Return True if the yaw is relative to the vehicle's nose, False if relative to north."""
    if flags & (YAW_IN_VEHICLE_FRAME | YAW_IN_EARTH_FRAME):
        return not flags & YAW_IN_EARTH_FRAME
    # Older gimbals set neither of the two flags. Their YAW_LOCK flag means "relative to north".
    return not flags & YAW_LOCK


def _euler(quaternion: tuple[float, ...]) -> tuple[float, float, float]:
    """Return pitch, roll and yaw in degrees, or NaN for an invalid quaternion."""
    length = math.sqrt(sum(component * component for component in quaternion))
    if not length > 0:
        return math.nan, math.nan, math.nan
    w, x, y, z = (component / length for component in quaternion)
    sine_of_pitch = max(-1.0, min(1.0, 2 * (w * y - z * x)))  # Without the limits, rounding may exceed 1.
    pitch = math.degrees(math.asin(sine_of_pitch))
    # If the camera points straight up or down, roll and yaw have the same axis.
    if abs(sine_of_pitch) > MIN_SINE_STRAIGHT:
        return pitch, 0.0, math.degrees(-2 * math.copysign(1, sine_of_pitch) * math.atan2(x, w))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return pitch, math.degrees(roll), math.degrees(yaw)


def _rounded(degrees: float) -> float | None:
    """Round to hundredths of a degree. Return None for NaN."""
    # Hundredths of a degree are the resolution of MOUNT_STATUS.
    return round(degrees, 2) + 0.0 if math.isfinite(degrees) else None  # + 0.0 turns -0.0 into 0.0


def _rounded_to_180(degrees: float) -> float | None:
    """Normalise an angle to -180 to 180, and round it."""
    return round(math.remainder(degrees, 360.0), 2) + 0.0 if math.isfinite(degrees) else None


def _rounded_to_360(degrees: float) -> float | None:
    """Normalise an angle to at least 0 and below 360, and round it."""
    # Rounding may turn 359.999 into 360, so the result is normalised again.
    return round(degrees % 360.0, 2) % 360.0 if math.isfinite(degrees) else None
