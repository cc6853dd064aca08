"""What the bits of SYS_STATUS, EKF_STATUS_REPORT and ESTIMATOR_STATUS say, in words."""

from __future__ import annotations

from collections.abc import Mapping

from aerokit.mavlink.enums import MavSysStatusSensor

__all__ = [
    "ESTIMATES",
    "PREARM_CHECK",
    "SENSORS",
    "names_of",
]

PREARM_CHECK = MavSysStatusSensor.MAV_SYS_STATUS_PREARM_CHECK.value
"""MAV_SYS_STATUS_PREARM_CHECK: the summary of all checks, not a sensor."""

SENSORS: Mapping[int, str] = {
    0x0000_0001: "gyroscope",
    0x0000_0002: "accelerometer",
    0x0000_0004: "compass",
    0x0000_0008: "barometer",
    0x0000_0010: "airspeed sensor",
    0x0000_0020: "GPS",
    0x0000_0040: "optical flow",
    0x0000_0080: "vision position",
    0x0000_0100: "range finder",
    0x0000_0200: "external ground truth",
    0x0000_0400: "rate control",
    0x0000_0800: "attitude stabilisation",
    0x0000_1000: "yaw control",
    0x0000_2000: "altitude control",
    0x0000_4000: "horizontal position control",
    0x0000_8000: "motor outputs",
    0x0001_0000: "RC receiver",
    0x0002_0000: "second gyroscope",
    0x0004_0000: "second accelerometer",
    0x0008_0000: "second compass",
    0x0010_0000: "geofence",
    0x0020_0000: "attitude and heading estimate",
    0x0040_0000: "terrain data",
    0x0080_0000: "reversed motors",
    0x0100_0000: "logging",
    0x0200_0000: "battery",
    0x0400_0000: "proximity sensor",
    0x0800_0000: "satellite link",
    0x1000_0000: "pre-arm checks",
    0x2000_0000: "obstacle avoidance",
    0x4000_0000: "propulsion",
}
"""MAV_SYS_STATUS_SENSOR (https://mavlink.io/en/messages/common.html#MAV_SYS_STATUS_SENSOR) in words."""

ESTIMATES: Mapping[int, str] = {
    1: "attitude",
    2: "horizontal velocity",
    4: "vertical velocity",
    8: "relative horizontal position",
    16: "absolute horizontal position",
    32: "absolute altitude",
    64: "altitude above ground",
    128: "constant position mode",
    256: "predicted relative horizontal position",
    512: "predicted absolute horizontal position",
}
"""The bits that EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS have in common, in words."""


def names_of(bits: int, names: Mapping[int, str]) -> tuple[str, ...]:
    """The names of the bits that are set; a bit without a name is left out."""
    return tuple(name for bit, name in names.items() if bits & bit)
