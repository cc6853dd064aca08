"""Logs of flight controllers, written by hand: a ``.bin`` and a ``.ulg`` of the same short flight."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

LATITUDE, LONGITUDE, AMSL = 47.0, 8.0, 500.0
ARMED_S, FAILSAFE_S, DISARMED_S, END_S = 5.0, 20.0, 40.0, 45.0
GPS_WEEK, GPS_MS = 2300, 100_000_000
UNIX_AT_0 = 315964800 + GPS_WEEK * 7 * 86400 + GPS_MS / 1000 - 18
"""UTC when the controllers' clocks were 0."""


def height_m(at: float) -> float:
    """Climb to 30 m in ten seconds, and descend after the failsafe."""
    return max(0.0, min(30.0, 3 * (at - ARMED_S), 1.5 * (DISARMED_S - at)))


def north_m(at: float) -> float:
    """Fly north at 4 m/s, and back."""
    return max(0.0, min(4 * (at - 10), 2 * (DISARMED_S - at)))


def voltage_v(at: float) -> float:
    """Drop half a volt in ten seconds."""
    return 16.4 - 0.05 * at


def times(hz: float) -> list[float]:
    """Return times at this rate, starting one second after boot."""
    return [1 + i / hz for i in range(round((END_S - 1) * hz))]


# ------------------------------------------------------------------------------------------------ .bin

_SIZES = dict(zip("QBfcLeIHnNZMb", ["Q", "B", "f", "h", "i", "i", "I", "H", "4s", "16s", "64s", "B", "b"], strict=True))
TABLES = {
    "GPS": (0x82, "QBBIHBcLLe", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt"),
    "POS": (0x83, "QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt"),
    "ATT": (0x84, "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "MSG": (0x85, "QZ", "TimeUS,Message"),
    "MODE": (0x86, "QMBB", "TimeUS,Mode,ModeNum,Rsn"),
    "ARM": (0x87, "QB", "TimeUS,ArmState"),
    "BAT": (0x88, "QBfffB", "TimeUS,Inst,Volt,Curr,CurrTot,RemPct"),
    "PARM": (0x89, "QNf", "TimeUS,Name,Value"),
    "ERR": (0x8A, "QBB", "TimeUS,Subsys,ECode"),
    "VIBE": (0x8B, "QBfffI", "TimeUS,IMU,VibeX,VibeY,VibeZ,Clip"),
    "XKF4": (0x8C, "QBcccccb", "TimeUS,C,SV,SP,SH,SM,SVT,PI"),
    "XKF1": (0x8D, "QBfff", "TimeUS,C,VN,VE,VD"),
    "ORGN": (0x8E, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "CMD": (0x8F, "QHHHffffLLfB", "TimeUS,CTot,CNum,CId,Prm1,Prm2,Prm3,Prm4,Lat,Lng,Alt,Frame"),
    "PSCN": (0x90, "Qfff", "TimeUS,TPN,PN,TVN"),
    "PSCE": (0x91, "Qfff", "TimeUS,TPE,PE,TVE"),
    "CTUN": (0x92, "Qff", "TimeUS,DAlt,Alt"),
}


def write_bin(path: Path) -> None:
    """The flight as ArduPilot logs it."""
    head = b"\xa3\x95"
    data = bytearray(head + b"\x80" + _format_row(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,TimeSeries"))
    for name, (number, form, columns) in TABLES.items():
        size = 3 + struct.calcsize("<" + "".join(_SIZES[code] for code in form))
        data += head + b"\x80" + _format_row(number, size, name, form, columns)
    for at, name, values in sorted(_bin_rows(), key=lambda row: row[0]):
        number, form, _ = TABLES[name]
        packed = struct.pack("<" + "".join(_SIZES[code] for code in form), round(at * 1e6), *values)
        data += head + bytes((number,)) + packed
    path.write_bytes(data + b"\xa3\x95\x84cut off")


def _format_row(number: int, size: int, name: str, form: str, columns: str) -> bytes:
    return struct.pack("<BB4s16s64s", number, size, name.encode(), form.encode(), columns.encode())


def _bin_rows() -> Iterator[tuple[float, str, Sequence[Any]]]:
    latitude, longitude = round(LATITUDE * 1e7), round(LONGITUDE * 1e7)
    yield 1.0, "MSG", (b"ArduCopter V4.6.1 (1a2b3c4d)",)
    yield 1.0, "MODE", (0, 0, 26)
    yield 1.0, "PARM", (b"BATT_LOW_VOLT", 15.4)
    yield 1.0, "PARM", (b"WP_YAW_BEHAVIOR", 2.0)
    yield 1.0, "ORGN", (0, latitude, longitude, round(AMSL * 100))
    yield 1.0, "ORGN", (1, latitude, longitude, round(AMSL * 100))
    yield 1.0, "CMD", (2, 0, 16, 0, 0, 0, 0, latitude, longitude, 0.0, 0)
    yield 1.0, "CMD", (2, 1, 16, 0, 0, 0, 0, latitude + 5000, longitude, 30.0, 3)
    yield ARMED_S, "ARM", (1,)
    yield ARMED_S, "MODE", (3, 3, 2)
    yield 12.0, "PARM", (b"WP_YAW_BEHAVIOR", 0.0)
    yield FAILSAFE_S, "MSG", (b"Battery 1 is low 15.40V used 900 mAh",)
    yield FAILSAFE_S, "ERR", (6, 1)
    yield FAILSAFE_S + 0.02, "MODE", (6, 6, 4)
    yield DISARMED_S, "ARM", (0,)
    yield 42.0, "ORGN", (1, latitude + 10_000, longitude, round(AMSL * 100))
    for at in times(10):
        gps = (0, 3, GPS_MS + round(at * 1000), GPS_WEEK, 14, 80)
        yield at, "GPS", (*gps, latitude, longitude, 50_000)
        yield at, "POS", (*_e7(north_m(at)), AMSL + height_m(at), height_m(at))
        yield at, "ATT", (1.0, 2.0, -3.0, -4.0, 350.0, 355.0)
        yield at, "XKF1", (0, 4.0, 0.0, -3.0)
        yield at, "XKF1", (1, 99.0, 99.0, 99.0)
        yield at, "XKF4", (0, 10, 20, 30, 40, 5, 0)
        yield at, "XKF4", (1, 999, 999, 999, 999, 999, 0)
        yield at, "PSCN", (north_m(at) + 1, north_m(at), 4.5)
        yield at, "PSCE", (2.0, 0.0, 0.5)
        yield at, "CTUN", (height_m(at) + 0.5, height_m(at))
        yield at, "VIBE", (0, 1.0, 2.0, 12.0, 0)
        yield at, "VIBE", (1, 90.0, 90.0, 90.0, 7)
    for at in times(2):
        yield at, "BAT", (0, voltage_v(at), 12.5, 30 * at, round(100 - at))
        yield at, "BAT", (1, voltage_v(at), math.nan, math.nan, 255)  # has no sensor of current


def _e7(north: float) -> tuple[int, int]:
    return round((LATITUDE + north / 111_177) * 1e7), round(LONGITUDE * 1e7)


# ------------------------------------------------------------------------------------------------ .ulg

TOPICS = {
    "vehicle_status": "Q:timestamp B:arming_state B:nav_state B:nav_state_user_intention ?:failsafe",
    "failsafe_flags": "Q:timestamp ?:manual_control_signal_lost ?:gcs_connection_lost B:battery_warning",
    "vehicle_global_position": "Q:timestamp d:lat d:lon f:alt ?:lat_lon_valid",
    "vehicle_local_position": "Q:timestamp f:x f:y f:z f:vx f:vy f:vz d:ref_lat d:ref_lon f:ref_alt",
    "vehicle_local_position_setpoint": "Q:timestamp f:x f:y f:z f:vx f:vy f:vz",
    "vehicle_attitude": "Q:timestamp 4f:q",
    "vehicle_attitude_setpoint": "Q:timestamp 4f:q_d",
    "battery_status": "Q:timestamp f:voltage_v f:current_a f:discharged_mah f:remaining",
    "sensor_gps": "Q:timestamp Q:time_utc_usec B:fix_type B:satellites_used f:hdop f:eph",
    "estimator_status": "Q:timestamp f:vel_test_ratio f:pos_test_ratio f:hgt_test_ratio f:mag_test_ratio"
    " f:tas_test_ratio",
    "vehicle_imu_status": "Q:timestamp 3I:accel_clipping f:accel_vibration_metric",
    "home_position": "Q:timestamp d:lat d:lon f:alt",
    "sensor_combined": "Q:timestamp 3f:gyro_rad",
}
"""Fields with struct's codes."""
_TYPES = {"Q": "uint64_t", "B": "uint8_t", "?": "bool", "d": "double", "f": "float", "I": "uint32_t"}


def write_ulog(path: Path) -> None:
    """The flight as PX4 logs it."""
    data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000))
    data += _message("B", bytes(40))
    for name, fields in TOPICS.items():
        data += _message("F", f"{name}:{_told(fields)}".encode())
    data += _message("I", _keyed("uint32_t ver_sw_release", struct.pack("<I", 0x011000FF)))
    data += _message("P", _keyed("float BAT_LOW_THR", struct.pack("<f", 0.25)))
    data += _message("P", _keyed("int32_t COM_LOW_BAT_ACT", struct.pack("<i", 2)))
    for number, name in enumerate(TOPICS):
        data += _message("A", struct.pack("<BH", 0, number) + name.encode())
    names = list(TOPICS)
    for at, name, values in sorted(_ulog_rows(), key=lambda row: row[0]):
        if name == "text":
            level, text = values
            data += _message("L", struct.pack("<BQ", 48 + level, round(at * 1e6)) + text.encode())
        elif name == "parameter":
            data += _message("P", _keyed(f"float {values[0]}", struct.pack("<f", values[1])))
        else:
            packed = struct.pack("<" + _layout(TOPICS[name]), round(at * 1e6), *values)
            data += _message("D", struct.pack("<H", names.index(name)) + packed)
    path.write_bytes(data)


def _message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


def _keyed(key: str, value: bytes) -> bytes:
    return bytes((len(key),)) + key.encode() + value


def _told(fields: str) -> str:
    """Encode a value for the header of the log."""
    made = ""
    for field in fields.split():
        code, name = field.split(":")
        made += _TYPES[code[-1]] + (f"[{code[:-1]}]" if code[:-1] else "") + f" {name};"
    return made


def _layout(fields: str) -> str:
    return "".join(field.split(":")[0] for field in fields.split())


def _ulog_rows() -> Iterator[tuple[float, str, Sequence[Any]]]:
    yield 1.5, "text", (6, "logger started")
    yield FAILSAFE_S, "text", (4, "Failsafe activated\t")
    yield 42.0, "text", (6, "[commander] \x1b[32mReady for takeoff!\x1b[0m\t")
    yield FAILSAFE_S, "failsafe_flags", (False, False, 1)
    yield 12.0, "parameter", ("BAT_LOW_THR", 0.5)
    yield 1.2, "home_position", (LATITUDE, LONGITUDE, AMSL)
    for at in times(1):
        armed, failed = ARMED_S <= at < DISARMED_S, at >= FAILSAFE_S
        yield at, "vehicle_status", (2 if armed else 1, 5 if failed else 3, 3, failed and armed)
        if at < FAILSAFE_S:
            yield at, "failsafe_flags", (at < ARMED_S, False, 0)
    for at in times(10):
        place = LATITUDE + north_m(at) / 111_177, LONGITUDE
        yield at, "vehicle_global_position", (*place, AMSL + height_m(at), True)
        here = (north_m(at), 0.0, -height_m(at), 4.0, 0.0, -3.0)
        yield at, "vehicle_local_position", (*here, LATITUDE, LONGITUDE, AMSL)
        wanted = (north_m(at) + 1, 2.0, -height_m(at) - 0.5, 4.5, 0.5, math.nan)
        yield at, "vehicle_local_position_setpoint", wanted
        half = math.radians(2.0) / 2
        yield at, "vehicle_attitude", (math.cos(half), math.sin(half), 0.0, 0.0)
        yield at, "vehicle_attitude_setpoint", (1.0, 0.0, 0.0, 0.0)
        yield at, "estimator_status", (0.1, 0.2, 0.3, 0.4, 0.05)
        yield at, "vehicle_imu_status", (0, 0, 1, 12.0)
        yield at, "sensor_gps", (round((UNIX_AT_0 + at) * 1e6), 3, 14, 0.8, 0.9)
        yield at, "sensor_combined", (0.0, 0.0, 0.0)
    for at in times(2):
        yield at, "battery_status", (voltage_v(at), 12.5, 30 * at, 1 - at / 100)
