"""Messages of ``dronekit_vehicle.py``, in the proportions of ArduCopter's streams.

If all streams are requested at one rate, ArduCopter 4.7 sends each of these messages at that rate, in this order. It
also sends a HEARTBEAT each second, which is every fourth round at the usual 4 Hz. (A recorded flight at 10 Hz has 1,206
messages of each of the 24 kinds, and 127 heartbeats.) Fields are not zero, so that MAVLink 2 does not truncate them.
Every round has a number, which attribute listeners can read from attitude, position, GPS and battery.
"""

from __future__ import annotations

import math
from typing import Any

from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega as dialect

__all__ = ["ROUNDS", "Numbering", "heartbeat", "packed", "round_number_of", "rounds"]

# After this many rounds, the round number starts again at 0.
ROUNDS = 1024
HEARTBEAT_EVERY = 4
KINDS = (
    "SYS_STATUS", "POWER_STATUS", "MEMINFO", "MISSION_CURRENT", "GPS_RAW_INT", "NAV_CONTROLLER_OUTPUT",
    "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "SERVO_OUTPUT_RAW", "RC_CHANNELS", "RAW_IMU", "SCALED_IMU2",
    "SCALED_IMU3", "SCALED_PRESSURE", "ATTITUDE", "AHRS2", "VFR_HUD", "AHRS", "SYSTEM_TIME", "WIND", "TERRAIN_REPORT",
    "BATTERY_STATUS", "EKF_STATUS_REPORT", "VIBRATION",
)  # fmt: skip
ONLY_IN_VERSION = {1: ("RC_CHANNELS_RAW",), 2: ("ESC_TELEMETRY_1_TO_4",)}
ARMED_IN_GUIDED = {
    "type": 2, "autopilot": 3, "base_mode": 217, "custom_mode": 4, "system_status": 4, "mavlink_version": 3,
}  # fmt: skip
# Units of 1e-7 degrees.
LATITUDE = -353632610
LONGITUDE = 1491652299
# Step of the roll angle per round; exact in 32-bit floats.
ANGLE_STEP = 2.0**-12
BATTERY_MV = 10000
BATTERY_CURRENT_CA = 1500
BATTERY_PERCENT = 87

Frame = tuple[bytes, str, int]
"""A frame without sequence number, the name of its message, and the number of its round."""


def rounds(version: int) -> list[Frame]:
    """Return the frames of all rounds, in version 1 or 2 of MAVLink."""
    kinds = KINDS + ONLY_IN_VERSION[version]
    frames: list[Frame] = []
    for number in range(ROUNDS):
        if number % HEARTBEAT_EVERY == 0:
            frames.append((heartbeat(version), "HEARTBEAT", number))
        frames += [(packed(kind, version, **_values(kind, number)), kind, number) for kind in kinds]
    return frames


def round_number_of(name: str, value: Any) -> int | None:
    """Return the round number encoded in an attribute's value; None if it has none."""
    number: float
    if name == "attitude":
        number = value.roll / ANGLE_STEP
    elif name == "location.global_relative_frame":
        number = value.lat * 1e7 - LATITUDE
    elif name == "gps_0":
        number = value.eph
    elif name == "battery":
        number = value.voltage * 1000 - BATTERY_MV
    else:
        return None
    return round(number)


def heartbeat(version: int) -> bytes:
    """Create the HEARTBEAT of an armed quadrotor of ArduPilot in GUIDED."""
    return packed("HEARTBEAT", version, **ARMED_IN_GUIDED)


def packed(kind: str, version: int, **values: Any) -> bytes:
    """Create a frame of system 1, component 1. Fields that are not given get an arbitrary number."""
    untyped_dialect: Any = dialect
    message_class = getattr(untyped_dialect, f"MAVLink_{kind.lower()}_message")
    array_lengths = dict(zip(message_class.ordered_fieldnames, message_class.array_lengths, strict=True))
    fields = {}
    for name, field_type in zip(message_class.fieldnames, message_class.fieldtypes, strict=True):
        fields[name] = values.get(name, _arbitrary_value(field_type, array_lengths[name]))
    mav: Any = untyped_dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    return bytes(message_class(**fields).pack(mav, force_mavlink1=version == 1))


class Numbering:
    """Adds the sequence numbers and checksums to frames when they are sent."""

    def __init__(self) -> None:
        self._next = 0

    def numbered(self, frame: bytes) -> bytes:
        """Return the frame with the next sequence number."""
        raw = bytearray(frame)
        is_v2 = raw[0] == 0xFD
        sequence_offset = 4 if is_v2 else 2
        raw[sequence_offset] = self._next
        self._next = (self._next + 1) & 0xFF
        message_id = int.from_bytes(raw[7:10], "little") if is_v2 else raw[5]
        checksum = crc16.mcrf4xx(bytes(raw[1:-2]) + _extra(message_id))
        raw[-2:] = checksum.to_bytes(2, "little")
        return bytes(raw)


_extras: dict[int, bytes] = {}


def _extra(message_id: int) -> bytes:
    if message_id not in _extras:
        _extras[message_id] = bytes([dialect.mavlink_map[message_id].crc_extra])
    return _extras[message_id]


def _arbitrary_value(field_type: str, array_length: int) -> Any:
    """Return a value for a field. The array length is 0 for a field that is not an array."""
    if field_type == "char":
        return b"text"
    number: float = 1.25 if field_type in ("float", "double") else 101
    return [number] * array_length if array_length else number


def _values(kind: str, number: int) -> dict[str, Any]:
    """Return the values of a round: a flight in a circle, and the round number where listeners read it."""
    turn = math.tau * number / ROUNDS
    values: dict[str, dict[str, Any]] = {
        "ATTITUDE": {"roll": number * ANGLE_STEP, "pitch": math.sin(turn) / 4, "yaw": turn - math.pi},
        "GLOBAL_POSITION_INT": {
            "lat": LATITUDE + number, "lon": LONGITUDE + number, "alt": 604_000 + number,
            "relative_alt": 20_000 + number,
            "vx": number, "vy": -number, "vz": 3, "hdg": 35 * number % 36_000,
        },
        "VFR_HUD": {"heading": number % 360, "groundspeed": number / 100, "airspeed": number / 90, "alt": 20.0},
        "GPS_RAW_INT": {"fix_type": 6, "eph": number, "satellites_visible": 10, "lat": LATITUDE, "lon": LONGITUDE},
        "SYS_STATUS": {
            "voltage_battery": BATTERY_MV + number, "current_battery": BATTERY_CURRENT_CA,
            "battery_remaining": BATTERY_PERCENT, "load": number,
        },
        "EKF_STATUS_REPORT": {"flags": 831},
        "BATTERY_STATUS": {
            "voltages": [BATTERY_MV + number, *[65535] * 9], "battery_remaining": BATTERY_PERCENT, "id": 0,
        },
        "RC_CHANNELS": {"chancount": 16, "chan1_raw": 1500 + number % 100},
        "RC_CHANNELS_RAW": {"port": 0, "chan1_raw": 1500 + number % 100},
        "SERVO_OUTPUT_RAW": {"port": 0, "servo1_raw": 1500 + number % 100},
        "MISSION_CURRENT": {"seq": 0},
    }  # fmt: skip
    return values.get(kind, {})
