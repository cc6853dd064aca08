"""What a simulated ArduPilot says of its gimbal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalDeviceFlags, GimbalManagerCapFlags, GimbalManagerFlags, MavMountMode
from aerokit.sim.rotations import quaternion_from_euler

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.ardupilot.gimbal import Gimbal
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["GIMBAL_BUILDERS", "gimbal_manager_status"]

_DEVICE_ID = 1
_Can = GimbalManagerCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL | _Can.HAS_RC_INPUTS
    | _Can.CAN_POINT_LOCATION_LOCAL | _Can.CAN_POINT_LOCATION_GLOBAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_FOLLOW | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_FOLLOW | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
)  # fmt: skip
_FROM_NORTH = frozenset({MavMountMode.GPS_POINT, MavMountMode.SYSID_TARGET, MavMountMode.HOME_LOCATION})


def _attitude_status(vehicle: ArduPilotVehicle) -> m.GimbalDeviceAttitudeStatus | None:
    gimbal = vehicle.gimbal
    if not gimbal.is_fitted:
        return None
    roll, pitch, yaw = map(math.radians, gimbal.angles)
    return m.GimbalDeviceAttitudeStatus(
        0,
        0,
        vehicle.time_boot_ms,
        _device_flags(gimbal),
        quaternion_from_euler(roll, pitch, yaw),
        math.nan,
        math.nan,
        math.nan,
        0,
        math.nan,
        math.nan,
        _DEVICE_ID,
    )


def _device_flags(gimbal: Gimbal) -> int:
    """Yaw is told from the nose whatever it is locked to."""
    flags = (
        GimbalDeviceFlags.ROLL_LOCK | GimbalDeviceFlags.PITCH_LOCK | GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME
    )
    if gimbal.mode == MavMountMode.RETRACT:
        flags |= GimbalDeviceFlags.RETRACT
    elif gimbal.mode == MavMountMode.NEUTRAL:
        flags |= GimbalDeviceFlags.NEUTRAL
    elif gimbal.mode in _FROM_NORTH or gimbal.target.is_from_north:
        flags |= GimbalDeviceFlags.YAW_LOCK
    return flags


def _manager_information(vehicle: ArduPilotVehicle) -> m.GimbalManagerInformation | None:
    gimbal = vehicle.gimbal
    if not gimbal.is_fitted:
        return None
    limits = (
        math.radians(gimbal.setting(f"MNT1_{axis}_{end}"))
        for axis in ("ROLL", "PITCH", "YAW")
        for end in ("MIN", "MAX")
    )
    return m.GimbalManagerInformation(vehicle.time_boot_ms, _CAPABILITIES, _DEVICE_ID, *limits)


def gimbal_manager_status(vehicle: ArduPilotVehicle) -> m.GimbalManagerStatus | None:
    """GIMBAL_MANAGER_STATUS: who is in control."""
    gimbal = vehicle.gimbal
    if not gimbal.is_fitted:
        return None
    flags = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK
    if gimbal.is_yaw_locked:
        flags |= GimbalManagerFlags.YAW_LOCK
    system, component = gimbal.in_control
    return m.GimbalManagerStatus(vehicle.time_boot_ms, flags, _DEVICE_ID, system, component, 0, 0)


GIMBAL_BUILDERS: dict[int, Callable[[ArduPilotVehicle], Message | None]] = {
    m.GimbalDeviceAttitudeStatus.ID: _attitude_status,
    m.GimbalManagerInformation.ID: _manager_information,
    m.GimbalManagerStatus.ID: gimbal_manager_status,
}
"""Message id → what to send now, or None."""
