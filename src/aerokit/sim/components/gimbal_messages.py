"""What a simulated gimbal says of itself, as a device and as its manager."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalDeviceCapFlags, GimbalDeviceFlags, GimbalManagerCapFlags
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.sim.rotations import quaternion_from_euler

if TYPE_CHECKING:
    from aerokit.sim.components.component import Builder
    from aerokit.sim.components.gimbal import SimulatedGimbal

__all__ = ["gimbal_builders", "gimbal_manager_status"]

_Can = GimbalDeviceCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
    | _Can.SUPPORTS_YAW_IN_EARTH_FRAME
)  # fmt: skip
_FIRMWARE = 1 << 24


def gimbal_builders(gimbal: SimulatedGimbal) -> dict[int, Builder]:
    """Message id → what to send."""
    return {
        m.GimbalDeviceInformation.ID: lambda _: [_device_information(gimbal)],
        m.GimbalDeviceAttitudeStatus.ID: lambda _: [_attitude_status(gimbal)],
        m.GimbalManagerInformation.ID: lambda _: [_manager_information(gimbal)],
        m.GimbalManagerStatus.ID: lambda _: [gimbal_manager_status(gimbal)],
    }


def gimbal_manager_status(gimbal: SimulatedGimbal) -> m.GimbalManagerStatus:
    """GIMBAL_MANAGER_STATUS: who is in control."""
    device = gimbal.component_id
    return m.GimbalManagerStatus(
        gimbal.time_boot_ms, _flags(gimbal), device, *gimbal.primary, *gimbal.secondary
    )


def _flags(gimbal: SimulatedGimbal) -> int:
    """Roll and pitch are always from the horizon."""
    flags = gimbal.flags & (Flags.RETRACT | Flags.NEUTRAL) | Flags.ROLL_LOCK | Flags.PITCH_LOCK
    if gimbal.is_yaw_locked:
        return flags | Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME
    return flags | Flags.YAW_IN_VEHICLE_FRAME


def _attitude_status(gimbal: SimulatedGimbal) -> m.GimbalDeviceAttitudeStatus:
    is_from_north = gimbal.is_yaw_locked
    angles = gimbal.angles_from_north() if is_from_north else gimbal.angles()
    return m.GimbalDeviceAttitudeStatus(
        target_system=0,
        target_component=0,
        time_boot_ms=gimbal.time_boot_ms,
        flags=_flags(gimbal) | GimbalDeviceFlags.ACCEPTS_YAW_IN_EARTH_FRAME,
        q=quaternion_from_euler(*angles),
        angular_velocity_x=math.nan,
        angular_velocity_y=math.nan,
        angular_velocity_z=math.nan,
        failure_flags=0,
        delta_yaw=gimbal.heading(),
        delta_yaw_velocity=math.nan,
        gimbal_device_id=0,
    )


def _device_information(gimbal: SimulatedGimbal) -> m.GimbalDeviceInformation:
    (roll_min, roll_max), (pitch_min, pitch_max), (yaw_min, yaw_max) = gimbal.limits
    return m.GimbalDeviceInformation(
        time_boot_ms=gimbal.time_boot_ms,
        vendor_name="aerokit",
        model_name="Simulated gimbal",
        custom_name="",
        firmware_version=_FIRMWARE,
        hardware_version=_FIRMWARE,
        uid=gimbal.component_id,
        cap_flags=_CAPABILITIES,
        custom_cap_flags=0,
        roll_min=roll_min,
        roll_max=roll_max,
        pitch_min=pitch_min,
        pitch_max=pitch_max,
        yaw_min=yaw_min,
        yaw_max=yaw_max,
    )


def _manager_information(gimbal: SimulatedGimbal) -> m.GimbalManagerInformation:
    capabilities = int(_CAPABILITIES) | GimbalManagerCapFlags.CAN_POINT_LOCATION_GLOBAL
    limits = (end for axis in gimbal.limits for end in axis)
    return m.GimbalManagerInformation(gimbal.time_boot_ms, capabilities, gimbal.component_id, *limits)
