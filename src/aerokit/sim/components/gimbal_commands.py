"""The commands and messages that a simulated gimbal takes, and from whom."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GimbalDeviceCapFlags,
    GimbalDeviceFlags,
    GimbalManagerCapFlags,
    MavCmd,
    MavFrame,
    MavResult,
)
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.sim.commands import whole
from aerokit.sim.components.component import pose_of
from aerokit.sim.local_frame import GlobalPoint
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.commands import Command, CommandHandler
    from aerokit.sim.components.component import Builder
    from aerokit.sim.components.gimbal import SimulatedGimbal

__all__ = ["gimbal_builders", "gimbal_commands", "gimbal_manager_status", "hear_gimbal_orders"]


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


_UNCHANGED, _ME, _RELEASE = -1, -2, -3
_DOWN_WHEN_RETRACTED = (0.0, 0.0, 0.0)
_ABSOLUTE = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})

Owner = tuple[int, int]
Angles = tuple[float, float, float]


def gimbal_commands(gimbal: SimulatedGimbal) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    orders = _Orders(gimbal)
    return {
        MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: orders.configure,
        MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: orders.pitch_and_yaw,
        MavCmd.DO_SET_ROI_LOCATION: orders.look_at,
        MavCmd.DO_SET_ROI_SYSID: orders.follow,
        MavCmd.DO_SET_ROI_NONE: orders.look_ahead,
    }


def hear_gimbal_orders(gimbal: SimulatedGimbal) -> None:
    """Messages in the place of commands; nobody answers them."""
    orders = _Orders(gimbal)
    gimbal.on(m.GimbalManagerSetAttitude, orders.on_attitude)
    gimbal.on(m.GimbalManagerSetPitchyaw, orders.on_pitch_and_yaw)
    gimbal.on(m.GimbalManagerSetManualControl, orders.on_manual_control)
    gimbal.on(m.GimbalDeviceSetAttitude, orders.on_device_attitude)
    gimbal.on(m.GlobalPositionInt, orders.on_place)


class _Orders:
    """Of one gimbal."""

    def __init__(self, gimbal: SimulatedGimbal) -> None:
        self._gimbal = gimbal

    def _is_mine(self, device_id: float) -> bool:
        return whole(device_id) in (0, self._gimbal.component_id)

    # ------------------------------------------------------------------------------------- commands

    def configure(self, command: Command) -> int:
        """Params 1 and 2 are who is in control, 3 and 4 who besides: ids, -1 unchanged, -2 who asks, -3 let go."""
        gimbal, sender = self._gimbal, command.sender
        numbers = [command.param1, command.param2, command.param3, command.param4]
        if not self._is_mine(command.z) or not all(_RELEASE <= number <= 255 for number in numbers):
            return MavResult.DENIED
        primary = _owner(gimbal.primary, (int(numbers[0]), int(numbers[1])), sender)
        secondary = _owner(gimbal.secondary, (int(numbers[2]), int(numbers[3])), sender)
        gimbal.set_control(primary, secondary)
        return MavResult.ACCEPTED

    def pitch_and_yaw(self, command: Command) -> int:
        """Degrees, and degrees per second; those that are not meant are NaN."""
        if not self._is_mine(command.z) or not self._gimbal.obeys(command.sender):
            return MavResult.DENIED
        pitch, yaw, pitch_rate, yaw_rate = map(
            math.radians, (command.param1, command.param2, command.param3, command.param4)
        )
        done = self.obey(whole(command.x), (0.0, pitch, yaw), (0.0, pitch_rate, yaw_rate))
        return MavResult.ACCEPTED if done else MavResult.DENIED

    def look_at(self, command: Command) -> int:
        """Of a COMMAND_LONG the altitude is above the sea."""
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        altitude = command.z
        if frame not in _ABSOLUTE:
            pose = pose_of(gimbal.vehicle)
            altitude += 0.0 if pose is None else pose.place.altitude_m - pose.height_m
        gimbal.look_at(GlobalPoint(*command.place(), altitude))
        return MavResult.ACCEPTED

    def follow(self, command: Command) -> int:
        """Param 1 is whom."""
        gimbal = self._gimbal
        if not self._is_mine(command.param2) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        gimbal.follow(whole(command.param1))
        return MavResult.ACCEPTED

    def on_place(self, told: m.GlobalPositionInt, _: Channel) -> None:
        """Of the vehicle that it looks at."""
        self._gimbal.note_place(sender_of(told)[0], GlobalPoint(told.lat, told.lon, told.alt * 1e-3))

    def look_ahead(self, command: Command) -> int:
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        gimbal.look_at(None)
        return MavResult.ACCEPTED

    def obey(self, flags: int, angles: Angles, rates: Angles) -> bool:
        """Angles count more than rates; False when neither are given."""
        gimbal = self._gimbal
        locked = bool(flags & (Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME))
        if flags & (Flags.RETRACT | Flags.NEUTRAL):
            gimbal.point(_DOWN_WHEN_RETRACTED, flags, locked=False)
        elif not any(map(math.isnan, angles)):
            gimbal.point(angles, flags, locked=locked)
        elif not any(map(math.isnan, rates)):
            gimbal.turn(rates, flags, locked=locked)
        else:
            return False
        return True

    # ------------------------------------------------------------------------------------- messages

    def on_attitude(self, order: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if self._is_mine(order.gimbal_device_id) and self._gimbal.obeys(sender_of(order)):
            self._attitude(order)

    def on_device_attitude(self, order: m.GimbalDeviceSetAttitude, _: Channel) -> None:
        """Of another manager, such as an autopilot: only while nobody else is in control."""
        if self._gimbal.primary in ((0, 0), sender_of(order)):
            self._attitude(order)

    def _attitude(self, order: m.GimbalManagerSetAttitude | m.GimbalDeviceSetAttitude) -> None:
        has_angles = not any(map(math.isnan, order.q))
        angles = euler_from_quaternion(*order.q) if has_angles else (math.nan,) * 3
        rates = (order.angular_velocity_x, order.angular_velocity_y, order.angular_velocity_z)
        self.obey(order.flags, (angles[0], angles[1], angles[2]), rates)

    def on_pitch_and_yaw(self, order: m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        if self._is_mine(order.gimbal_device_id) and self._gimbal.obeys(sender_of(order)):
            self.obey(order.flags, (0.0, order.pitch, order.yaw), (0.0, order.pitch_rate, order.yaw_rate))

    def on_manual_control(self, order: m.GimbalManagerSetManualControl, _: Channel) -> None:
        """Rates are shares, -1 to 1, of how fast it turns."""
        gimbal = self._gimbal
        if self._is_mine(order.gimbal_device_id) and gimbal.obeys(sender_of(order)):
            rates = (0.0, order.pitch_rate * gimbal.slew_rad_s, order.yaw_rate * gimbal.slew_rad_s)
            self.obey(order.flags, (0.0, order.pitch, order.yaw), rates)


def _owner(before: Owner, wanted: tuple[int, int], sender: Owner) -> Owner:
    """Whoever is in control after one pair of params."""
    if _ME in wanted:
        return sender
    if _RELEASE in wanted:
        return (0, 0) if before == sender else before
    if _UNCHANGED in wanted:
        return before
    return wanted
