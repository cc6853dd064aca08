"""`SimulatedGimbal`: a gimbal component that implements the MAVLink gimbal protocol v2.

https://mavlink.io/en/services/gimbal_v2.html
"""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GimbalDeviceCapFlags,
    GimbalDeviceFlags,
    GimbalManagerCapFlags,
    MavCmd,
    MavFrame,
    MavResult,
    MavType,
)
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, ReceivedCommand, whole
from aerokit.sim.components.component import Builder, SimulatedComponent, pose_of
from aerokit.sim.motion import GlobalPoint, euler_from_quaternion, quaternion_from_euler
from aerokit.sim.vehicle import sender_of

_Can = GimbalDeviceCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
    | _Can.SUPPORTS_YAW_IN_EARTH_FRAME
)  # fmt: skip
_FIRMWARE = 1 << 24


def gimbal_manager_status(gimbal: SimulatedGimbal) -> m.GimbalManagerStatus:
    device = gimbal.component_id
    return m.GimbalManagerStatus(gimbal.time_boot_ms, _flags(gimbal), device, *gimbal.primary, *gimbal.secondary)


def _flags(gimbal: SimulatedGimbal) -> int:
    """Return GIMBAL_MANAGER_FLAGS; roll and pitch are always relative to the horizon."""
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


_UNCHANGED, _SENDER, _RELEASE = -1, -2, -3
_RETRACTED_ANGLES = (0.0, 0.0, 0.0)
_ABSOLUTE = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})

Owner = tuple[int, int]
Angles = tuple[float, float, float]


class _GimbalControl:
    """Handles the commands and messages to one gimbal."""

    def __init__(self, gimbal: SimulatedGimbal) -> None:
        self._gimbal = gimbal

    def _is_mine(self, device_id: float) -> bool:
        return whole(device_id) in (0, self._gimbal.component_id)

    def configure(self, command: ReceivedCommand) -> int:
        """Set primary (params 1, 2) and secondary control (3, 4): an id, -1 unchanged, -2 the sender, -3 release."""
        gimbal, sender = self._gimbal, command.sender
        numbers = [command.param1, command.param2, command.param3, command.param4]
        if not self._is_mine(command.z) or not all(_RELEASE <= number <= 255 for number in numbers):
            return MavResult.DENIED
        primary = _owner(gimbal.primary, (int(numbers[0]), int(numbers[1])), sender)
        secondary = _owner(gimbal.secondary, (int(numbers[2]), int(numbers[3])), sender)
        gimbal.set_control(primary, secondary)
        return MavResult.ACCEPTED

    def pitch_and_yaw(self, command: ReceivedCommand) -> int:
        """Apply angles in degrees or rates in degrees per second; NaN means not given."""
        if not self._is_mine(command.z) or not self._gimbal.is_in_control(command.sender):
            return MavResult.DENIED
        pitch, yaw, pitch_rate, yaw_rate = map(
            math.radians, (command.param1, command.param2, command.param3, command.param4)
        )
        done = self.apply(whole(command.x), (0.0, pitch, yaw), (0.0, pitch_rate, yaw_rate))
        return MavResult.ACCEPTED if done else MavResult.DENIED

    def look_at(self, command: ReceivedCommand) -> int:
        """Point at a position; the altitude of a COMMAND_LONG is above mean sea level."""
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.is_in_control(command.sender):
            return MavResult.DENIED
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        altitude = command.z
        if frame not in _ABSOLUTE:
            pose = pose_of(gimbal.vehicle)
            altitude += 0.0 if pose is None else pose.place.altitude_m - pose.height_m
        gimbal.look_at(GlobalPoint(*command.place(), altitude))
        return MavResult.ACCEPTED

    def follow(self, command: ReceivedCommand) -> int:
        """Follow the vehicle whose system id is param 1."""
        gimbal = self._gimbal
        if not self._is_mine(command.param2) or not gimbal.is_in_control(command.sender):
            return MavResult.DENIED
        gimbal.follow(whole(command.param1))
        return MavResult.ACCEPTED

    def on_global_position(self, message: m.GlobalPositionInt, _: Channel) -> None:
        """Update the target if the message comes from the followed vehicle."""
        self._gimbal.update_followed(sender_of(message)[0], GlobalPoint(message.lat, message.lon, message.alt * 1e-3))

    def look_ahead(self, command: ReceivedCommand) -> int:
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.is_in_control(command.sender):
            return MavResult.DENIED
        gimbal.look_at(None)
        return MavResult.ACCEPTED

    def apply(self, flags: int, angles: Angles, rates: Angles) -> bool:
        """Apply the angles, or the rates if an angle is NaN; return False if both contain NaN."""
        gimbal = self._gimbal
        locked = bool(flags & (Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME))
        if flags & (Flags.RETRACT | Flags.NEUTRAL):
            gimbal.point(_RETRACTED_ANGLES, flags, locked=False)
        elif not any(map(math.isnan, angles)):
            gimbal.point(angles, flags, locked=locked)
        elif not any(map(math.isnan, rates)):
            gimbal.turn(rates, flags, locked=locked)
        else:
            return False
        return True

    def on_attitude(self, message: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if self._is_mine(message.gimbal_device_id) and self._gimbal.is_in_control(sender_of(message)):
            self._apply_attitude(message)

    def on_device_attitude(self, message: m.GimbalDeviceSetAttitude, _: Channel) -> None:
        """Apply the set-point of another manager, such as an autopilot, unless a third component is in control."""
        if self._gimbal.primary in ((0, 0), sender_of(message)):
            self._apply_attitude(message)

    def _apply_attitude(self, message: m.GimbalManagerSetAttitude | m.GimbalDeviceSetAttitude) -> None:
        has_angles = not any(map(math.isnan, message.q))
        angles = euler_from_quaternion(*message.q) if has_angles else (math.nan,) * 3
        rates = (message.angular_velocity_x, message.angular_velocity_y, message.angular_velocity_z)
        self.apply(message.flags, (angles[0], angles[1], angles[2]), rates)

    def on_pitch_and_yaw(self, message: m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        if self._is_mine(message.gimbal_device_id) and self._gimbal.is_in_control(sender_of(message)):
            self.apply(message.flags, (0.0, message.pitch, message.yaw), (0.0, message.pitch_rate, message.yaw_rate))

    def on_manual_control(self, message: m.GimbalManagerSetManualControl, _: Channel) -> None:
        """Apply angles, or rates from -1 to 1 as shares of the slew rate."""
        gimbal = self._gimbal
        if self._is_mine(message.gimbal_device_id) and gimbal.is_in_control(sender_of(message)):
            rates = (0.0, message.pitch_rate * gimbal.slew_rad_s, message.yaw_rate * gimbal.slew_rad_s)
            self.apply(message.flags, (0.0, message.pitch, message.yaw), rates)


def _owner(before: Owner, wanted: tuple[int, int], sender: Owner) -> Owner:
    """Return the component in control after one pair of params; (0, 0) is none."""
    if _SENDER in wanted:
        return sender
    if _RELEASE in wanted:
        return (0, 0) if before == sender else before
    if _UNCHANGED in wanted:
        return before
    return wanted


_STATUS_INTERVAL_S = 1.0
_STILL: Angles = (0.0, 0.0, 0.0)


class SimulatedGimbal(SimulatedComponent):
    """A gimbal device and its gimbal manager; it turns at a limited rate and can point at positions.

    Only the component in control can command the gimbal; initially no component is. Take control with
    MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE. Commands of other components are DENIED, their messages are ignored.

    - ``component_id``: MAVLink reserves 154 and 171 to 175 for gimbals; ``system_id``: None uses the vehicle's
    - ``roll_deg``, ``pitch_deg``, ``yaw_deg``: minimum and maximum angle; roll and pitch relative to the horizon
    - ``slew_deg_s``: turn rate
    - ``attitude_rate_hz``: rate of GIMBAL_DEVICE_ATTITUDE_STATUS

    Not simulated: compensation of the vehicle's attitude, motor failures, a second manager.
    """

    TYPE: ClassVar[int] = MavType.GIMBAL

    def __init__(
        self,
        component_id: int = 154,
        *,
        system_id: int | None = None,
        roll_deg: tuple[float, float] = (-30.0, 30.0),
        pitch_deg: tuple[float, float] = (-90.0, 25.0),
        yaw_deg: tuple[float, float] = (-180.0, 180.0),
        slew_deg_s: float = 60.0,
        attitude_rate_hz: float = 5.0,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.limits: tuple[tuple[float, float], ...] = tuple(
            (math.radians(low), math.radians(high)) for low, high in (roll_deg, pitch_deg, yaw_deg)
        )
        """Minimum and maximum of roll, pitch and yaw in radians."""
        self.slew_rad_s: float = math.radians(slew_deg_s)
        self._attitude_rate_hz = attitude_rate_hz
        self._reset()

    def _reset(self) -> None:
        self.primary: tuple[int, int] = (0, 0)
        self.secondary: tuple[int, int] = (0, 0)
        """System and component id of the component in secondary control; zeros if none."""
        self.flags: int = 0
        """GIMBAL_MANAGER_FLAGS of the latest command."""
        self.region: GlobalPoint | None = None
        """Position to point at; None without a region of interest."""
        self.followed: int = 0
        """System id of the followed vehicle; 0 if none."""
        self._from: Angles = _STILL
        self._since = 0.0
        self._target: Angles = _STILL
        self._rates: Angles = _STILL
        self._is_locked = False

    def start(self) -> None:
        """Called at power-on: reset control and direction, and start the streams."""
        self._reset()
        self._since = self.now
        self.stream(m.GimbalManagerStatus.ID, _STATUS_INTERVAL_S)
        if self._attitude_rate_hz > 0:
            self.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / self._attitude_rate_hz)

    def commands(self) -> dict[int, CommandHandler]:
        control = _GimbalControl(self)
        return {
            MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: control.configure,
            MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: control.pitch_and_yaw,
            MavCmd.DO_SET_ROI_LOCATION: control.look_at,
            MavCmd.DO_SET_ROI_SYSID: control.follow,
            MavCmd.DO_SET_ROI_NONE: control.look_ahead,
        }

    def builders(self) -> dict[int, Builder]:
        return {
            m.GimbalDeviceInformation.ID: lambda _: [_device_information(self)],
            m.GimbalDeviceAttitudeStatus.ID: lambda _: [_attitude_status(self)],
            m.GimbalManagerInformation.ID: lambda _: [_manager_information(self)],
            m.GimbalManagerStatus.ID: lambda _: [gimbal_manager_status(self)],
        }

    def listen(self) -> None:
        control = _GimbalControl(self)
        self.on(m.GimbalManagerSetAttitude, control.on_attitude)
        self.on(m.GimbalManagerSetPitchyaw, control.on_pitch_and_yaw)
        self.on(m.GimbalManagerSetManualControl, control.on_manual_control)
        self.on(m.GimbalDeviceSetAttitude, control.on_device_attitude)
        self.on(m.GlobalPositionInt, control.on_global_position)

    @property
    def is_yaw_locked(self) -> bool:
        """True if the yaw is fixed relative to north."""
        return self._is_locked or self.region is not None

    def angles(self) -> Angles:
        """Return roll and pitch (from the horizon) and yaw (from the vehicle's nose) in radians."""
        moved = [
            _towards(start, target, self.slew_rad_s * (self.now - self._since))
            for start, target in zip(self._from, self._wanted(), strict=True)
        ]
        return (moved[0], moved[1], moved[2])

    def angles_from_north(self) -> Angles:
        """Return roll, pitch and yaw from north in radians."""
        roll, pitch, yaw = self.angles()
        return (roll, pitch, math.remainder(yaw + self.heading(), math.tau))

    def heading(self) -> float:
        """Return the heading of the vehicle in radians; 0 if unknown."""
        pose = pose_of(self.vehicle)
        return 0.0 if pose is None else pose.yaw

    def _wanted(self) -> Angles:
        target = self._target if self.region is None else self._angles_to(self.region)
        seconds = self.now - self._since
        roll, pitch, yaw = (angle + rate * seconds for angle, rate in zip(target, self._rates, strict=True))
        if self.is_yaw_locked:
            yaw = math.remainder(yaw - self.heading(), math.tau)
        return (self._limited(0, roll), self._limited(1, pitch), self._limited(2, yaw))

    def _angles_to(self, region: GlobalPoint) -> Angles:
        """Return the angles to a position, yaw from north; the current target if the vehicle has no position."""
        pose = pose_of(self.vehicle)
        if pose is None:
            return self._target
        frame = self.vehicle.frame  # type: ignore[attr-defined]
        north, east = frame.to_local(region.latitude_e7, region.longitude_e7)
        current = frame.to_local(pose.place.latitude_e7, pose.place.longitude_e7)
        north, east = north - current[0], east - current[1]
        pitch = math.atan2(region.altitude_m - pose.place.altitude_m, math.hypot(north, east))
        return (0.0, pitch, math.atan2(east, north))

    def _limited(self, axis: int, angle: float) -> float:
        low, high = self.limits[axis]
        return max(low, min(high, angle))

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        """Turn to angles in radians; yaw is relative to north if ``locked``, otherwise to the nose."""
        self._begin(flags)
        self._target, self._is_locked = angles, locked

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        """Turn at these rates in radians per second, limited to the slew rate."""
        current = self.angles_from_north() if locked else self.angles()
        self._begin(flags)
        limit = self.slew_rad_s
        roll, pitch, yaw = (max(-limit, min(limit, rate)) for rate in rates)
        self._target, self._rates, self._is_locked = current, (roll, pitch, yaw), locked

    def look_at(self, place: GlobalPoint | None) -> None:
        """Point at a position; None points ahead again."""
        self._begin(0)
        self.region = place

    def follow(self, system_id: int) -> None:
        """Point at another vehicle once its position is received; keeps the direction until then."""
        current = self.angles_from_north()
        self.point(current, Flags.YAW_LOCK, locked=True)
        self.followed = system_id

    def update_followed(self, system_id: int, place: GlobalPoint) -> None:
        """Update the position of the followed vehicle."""
        if system_id == self.followed:
            self._from, self._since = self.angles(), self.now
            self.region = place

    def _begin(self, flags: int) -> None:
        self._from, self._since = self.angles(), self.now
        self._target = _STILL
        self._rates = _STILL
        self.region = None
        self.followed = 0
        self.flags = flags
        self._is_locked = False

    def set_control(self, primary: tuple[int, int], secondary: tuple[int, int]) -> None:
        """Set primary and secondary control; a change is announced at once."""
        if (primary, secondary) != (self.primary, self.secondary):
            self.primary = primary
            self.secondary = secondary
            self.send(gimbal_manager_status(self))

    def is_in_control(self, sender: tuple[int, int]) -> bool:
        """Return True if this sender is in control."""
        return sender in (self.primary, self.secondary) and sender != (0, 0)


def _towards(start: float, target: float, max_change: float) -> float:
    return start + max(-max_change, min(max_change, target - start))
