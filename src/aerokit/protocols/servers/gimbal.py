"""Gimbal protocol v2: a gimbal device and its gimbal manager (https://mavlink.io/en/services/gimbal_v2.html)."""

from __future__ import annotations

import math
from typing import NamedTuple

from aerokit._internal.rotations import euler_from_quaternion, quaternion_from_euler
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
from aerokit.protocols.servers.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.protocols.servers.host import Channel, ComponentIds, ServerHost, sender_of
from aerokit.protocols.servers.intervals import Builder

_Can = GimbalDeviceCapFlags
ALL_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
    | _Can.SUPPORTS_YAW_IN_EARTH_FRAME
)  # fmt: skip
_VERSION = 1 << 24


Angles = tuple[float, float, float]
_NO_COMPONENT = ComponentIds()


class Place(NamedTuple):
    """A position: latitude and longitude in degrees times 1e7, altitude above mean sea level in metres."""

    latitude_e7: int
    longitude_e7: int
    altitude_m: float


class GimbalMount:
    """Base class of a gimbal device with its gimbal manager: its state, and the methods that the protocol calls.

    Angles are in radians: roll and pitch from the horizon, yaw from the vehicle's nose or, if locked, from north.
    """

    host: ServerHost
    """The component that serves the gimbal."""
    device_id: int
    """Component id of the gimbal, which commands use to select it."""
    vendor: str = "aerokit"
    model: str = "gimbal"
    capabilities: int = ALL_CAPABILITIES
    """Capabilities of the gimbal (GIMBAL_DEVICE_CAP_FLAGS)."""
    can_point_at_positions: bool = True
    limits: tuple[tuple[float, float], ...]
    """Minimum and maximum of roll, pitch and yaw in radians."""
    slew_rad_s: float
    primary: ComponentIds = _NO_COMPONENT
    """The component in control; zeros if none."""
    secondary: ComponentIds = _NO_COMPONENT
    """The component in secondary control; zeros if none."""
    flags: int = 0
    """GIMBAL_MANAGER_FLAGS of the latest command."""

    @property
    def is_yaw_locked(self) -> bool:
        """True if the yaw is fixed relative to north."""
        raise NotImplementedError

    def angles(self) -> Angles:
        """Return roll and pitch (from the horizon) and yaw (from the vehicle's nose)."""
        raise NotImplementedError

    def angles_from_north(self) -> Angles:
        """Return roll, pitch and yaw from north."""
        roll, pitch, yaw = self.angles()
        return (roll, pitch, math.remainder(yaw + self.heading(), math.tau))

    def heading(self) -> float:
        """Return the heading of the vehicle; 0 if unknown."""
        return 0.0

    def home_altitude_m(self) -> float:
        """Return the altitude of home above mean sea level; 0 if unknown."""
        return 0.0

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        """Turn to angles; yaw is relative to north if ``locked``, otherwise to the nose."""
        raise NotImplementedError

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        """Turn at these rates in radians per second."""
        raise NotImplementedError

    def look_at(self, place: Place | None) -> None:
        """Point at a position, or ahead again if it is None."""
        raise NotImplementedError

    def follow(self, system_id: int) -> None:
        """Keep pointing at another vehicle. This begins when its first position is received."""
        raise NotImplementedError

    def update_followed(self, system_id: int, place: Place) -> None:
        """Update the position of the followed vehicle."""

    def set_control(self, primary: ComponentIds, secondary: ComponentIds) -> None:
        """Set primary and secondary control; a change is announced at once."""
        if (primary, secondary) != (self.primary, self.secondary):
            self.primary = primary
            self.secondary = secondary
            self.host.send(gimbal_manager_status(self))

    def is_in_control(self, sender: ComponentIds) -> bool:
        """Return True if this sender is in control."""
        return sender in (self.primary, self.secondary) and sender != _NO_COMPONENT


def gimbal_manager_status(gimbal: GimbalMount) -> m.GimbalManagerStatus:
    primary, secondary = gimbal.primary, gimbal.secondary
    return m.GimbalManagerStatus(
        time_boot_ms=gimbal.host.time_boot_ms, flags=_flags(gimbal), gimbal_device_id=gimbal.device_id,
        primary_control_sysid=primary.system, primary_control_compid=primary.component,
        secondary_control_sysid=secondary.system, secondary_control_compid=secondary.component,
    )  # fmt: skip


def _flags(gimbal: GimbalMount) -> int:
    # Roll and pitch are always relative to the horizon.
    flags = gimbal.flags & (Flags.RETRACT | Flags.NEUTRAL) | Flags.ROLL_LOCK | Flags.PITCH_LOCK
    if gimbal.is_yaw_locked:
        return flags | Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME
    return flags | Flags.YAW_IN_VEHICLE_FRAME


def _attitude_status(gimbal: GimbalMount) -> m.GimbalDeviceAttitudeStatus:
    is_from_north = gimbal.is_yaw_locked
    angles = gimbal.angles_from_north() if is_from_north else gimbal.angles()
    return m.GimbalDeviceAttitudeStatus(
        target_system=0, target_component=0, time_boot_ms=gimbal.host.time_boot_ms,
        flags=_flags(gimbal) | GimbalDeviceFlags.ACCEPTS_YAW_IN_EARTH_FRAME, q=quaternion_from_euler(*angles),
        angular_velocity_x=math.nan, angular_velocity_y=math.nan, angular_velocity_z=math.nan, failure_flags=0,
        delta_yaw=gimbal.heading(), delta_yaw_velocity=math.nan, gimbal_device_id=0,
    )  # fmt: skip


def _device_information(gimbal: GimbalMount) -> m.GimbalDeviceInformation:
    (roll_min, roll_max), (pitch_min, pitch_max), (yaw_min, yaw_max) = gimbal.limits
    return m.GimbalDeviceInformation(
        time_boot_ms=gimbal.host.time_boot_ms, vendor_name=gimbal.vendor, model_name=gimbal.model, custom_name="",
        firmware_version=_VERSION, hardware_version=_VERSION, uid=gimbal.device_id, cap_flags=gimbal.capabilities,
        custom_cap_flags=0, roll_min=roll_min, roll_max=roll_max, pitch_min=pitch_min, pitch_max=pitch_max,
        yaw_min=yaw_min, yaw_max=yaw_max,
    )  # fmt: skip


def _manager_information(gimbal: GimbalMount) -> m.GimbalManagerInformation:
    capabilities = int(gimbal.capabilities)
    if gimbal.can_point_at_positions:
        capabilities |= GimbalManagerCapFlags.CAN_POINT_LOCATION_GLOBAL
    (roll_min, roll_max), (pitch_min, pitch_max), (yaw_min, yaw_max) = gimbal.limits
    return m.GimbalManagerInformation(
        time_boot_ms=gimbal.host.time_boot_ms, cap_flags=capabilities, gimbal_device_id=gimbal.device_id,
        roll_min=roll_min, roll_max=roll_max, pitch_min=pitch_min, pitch_max=pitch_max, yaw_min=yaw_min,
        yaw_max=yaw_max,
    )  # fmt: skip


SetAttitude = m.GimbalManagerSetAttitude | m.GimbalDeviceSetAttitude


def angles_and_rates(message: SetAttitude) -> tuple[Angles, Angles]:
    """Return the angles and the rates in a message. Those that it does not give are NaN."""
    has_angles = not any(map(math.isnan, message.q))
    roll, pitch, yaw = euler_from_quaternion(*message.q) if has_angles else (math.nan,) * 3
    return (roll, pitch, yaw), (message.angular_velocity_x, message.angular_velocity_y, message.angular_velocity_z)


_UNCHANGED, _SENDER, _RELEASE = -1, -2, -3
_REST_ANGLES = (0.0, 0.0, 0.0)
_ABSOLUTE_FRAMES = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})


class GimbalRequests:
    """Handles the commands and messages to one gimbal."""

    def __init__(self, gimbal: GimbalMount) -> None:
        self._gimbal = gimbal

    def _selects_gimbal(self, device_id: float) -> bool:
        return to_int(device_id) in (0, self._gimbal.device_id)  # 0 selects all gimbals.

    def _may_control(self, sender: ComponentIds, device_id: float) -> bool:
        return self._selects_gimbal(device_id) and self._gimbal.is_in_control(sender)

    def configure(self, command: ReceivedCommand) -> int:
        gimbal, sender = self._gimbal, command.sender
        ids = (command.param1, command.param2, command.param3, command.param4)
        if not self._selects_gimbal(command.z) or not all(_RELEASE <= number <= 255 for number in ids):
            return MavResult.DENIED
        primary_system, primary_component, secondary_system, secondary_component = map(int, ids)
        gimbal.set_control(
            primary=_new_controller(gimbal.primary, ComponentIds(primary_system, primary_component), sender),
            secondary=_new_controller(gimbal.secondary, ComponentIds(secondary_system, secondary_component), sender),
        )
        return MavResult.ACCEPTED

    def pitch_and_yaw(self, command: ReceivedCommand) -> int:
        if not self._may_control(command.sender, command.z):
            return MavResult.DENIED
        pitch, yaw, pitch_rate, yaw_rate = map(
            math.radians, (command.param1, command.param2, command.param3, command.param4)
        )
        flags = to_int(command.x)
        is_applied = self.apply(flags, angles=(0.0, pitch, yaw), rates=(0.0, pitch_rate, yaw_rate))
        return MavResult.ACCEPTED if is_applied else MavResult.DENIED

    def _refusal(self, device_id: float, command: ReceivedCommand) -> int | None:
        """Return the MAV_RESULT that refuses the command, or None."""
        if not self._gimbal.can_point_at_positions:
            return MavResult.UNSUPPORTED
        return None if self._may_control(command.sender, device_id) else MavResult.DENIED

    def look_at(self, command: ReceivedCommand) -> int:
        gimbal = self._gimbal
        if (refusal := self._refusal(command.param1, command)) is not None:
            return refusal
        scale = 1.0 if command.is_long else 1e-7
        # `not <=` also refuses a NaN for the latitude or the longitude.
        if not (abs(command.x * scale) <= 90.0 and abs(command.y * scale) <= 180.0):
            return MavResult.DENIED
        # DO_SET_ROI_LOCATION as COMMAND_LONG has no frame. Its altitude is above mean sea level.
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        altitude = command.z
        if frame not in _ABSOLUTE_FRAMES:
            altitude += gimbal.home_altitude_m()
        gimbal.look_at(Place(*command.place(), altitude))
        return MavResult.ACCEPTED

    def follow(self, command: ReceivedCommand) -> int:
        if (refusal := self._refusal(command.param2, command)) is not None:
            return refusal
        system_id = to_int(command.param1)
        if not 1 <= system_id <= 255:
            return MavResult.DENIED
        self._gimbal.follow(system_id)
        return MavResult.ACCEPTED

    def on_global_position(self, message: m.GlobalPositionInt, _: Channel) -> None:
        place = Place(message.lat, message.lon, message.alt * 1e-3)
        self._gimbal.update_followed(sender_of(message).system, place)

    def look_ahead(self, command: ReceivedCommand) -> int:
        if (refusal := self._refusal(command.param1, command)) is not None:
            return refusal
        self._gimbal.look_at(None)
        return MavResult.ACCEPTED

    def apply(self, flags: int, angles: Angles, rates: Angles) -> bool:
        """Apply the flags, the angles or the rates. Return False if none of them can be applied."""
        gimbal = self._gimbal
        locked = bool(flags & (Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME))
        if flags & (Flags.RETRACT | Flags.NEUTRAL):
            gimbal.point(_REST_ANGLES, flags, locked=False)
        elif all(map(math.isfinite, angles)):  # NaN means that an angle or a rate was not given.
            gimbal.point(angles, flags, locked=locked)
        elif all(map(math.isfinite, rates)):
            gimbal.turn(rates, flags, locked=locked)
        else:
            return False
        return True

    def on_attitude(self, message: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if self._may_control(sender_of(message), message.gimbal_device_id):
            self._apply_attitude(message)

    def on_device_attitude(self, message: m.GimbalDeviceSetAttitude, _: Channel) -> None:
        # The sender is another manager, such as an autopilot. It may set the attitude if it is in control, or if no
        # component is.
        if self._gimbal.primary in (_NO_COMPONENT, sender_of(message)):
            self._apply_attitude(message)

    def _apply_attitude(self, message: SetAttitude) -> None:
        angles, rates = angles_and_rates(message)
        self.apply(message.flags, angles, rates)

    def on_pitch_and_yaw(self, message: m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        if self._may_control(sender_of(message), message.gimbal_device_id):
            self.apply(message.flags, (0.0, message.pitch, message.yaw), (0.0, message.pitch_rate, message.yaw_rate))

    def on_manual_control(self, message: m.GimbalManagerSetManualControl, _: Channel) -> None:
        if self._may_control(sender_of(message), message.gimbal_device_id):
            # All values are from -1 to 1: fractions of the limits and of the slew rate. PX4 takes the angles as radians
            # (input_mavlink.cpp, _process_set_manual_control), against the specification.
            _, pitch_limits, yaw_limits = self._gimbal.limits
            angles = (0.0, _scaled(message.pitch, pitch_limits), _scaled(message.yaw, yaw_limits))
            slew_rad_s = self._gimbal.slew_rad_s
            rates = (0.0, message.pitch_rate * slew_rad_s, message.yaw_rate * slew_rad_s)
            self.apply(message.flags, angles, rates)


def _scaled(deflection: float, limits: tuple[float, float]) -> float:
    minimum, maximum = limits
    return deflection * (maximum if deflection > 0 else -minimum)


def _new_controller(current: ComponentIds, requested: ComponentIds, sender: ComponentIds) -> ComponentIds:
    """Return the component that has control after a request for these ids."""
    if _SENDER in requested:
        return sender
    if _RELEASE in requested:  # Only the component that has control can release it.
        return _NO_COMPONENT if current == sender else current
    if _UNCHANGED in requested:
        return current
    return requested


def gimbal_commands(gimbal: GimbalMount) -> dict[int, CommandHandler]:
    control = GimbalRequests(gimbal)
    return {
        MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: control.configure,
        MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: control.pitch_and_yaw,
        MavCmd.DO_SET_ROI_LOCATION: control.look_at,
        MavCmd.DO_SET_ROI_SYSID: control.follow,
        MavCmd.DO_SET_ROI_NONE: control.look_ahead,
    }


def gimbal_builders(gimbal: GimbalMount) -> dict[int, Builder]:
    return {
        m.GimbalDeviceInformation.ID: lambda _: [_device_information(gimbal)],
        m.GimbalDeviceAttitudeStatus.ID: lambda _: [_attitude_status(gimbal)],
        m.GimbalManagerInformation.ID: lambda _: [_manager_information(gimbal)],
        m.GimbalManagerStatus.ID: lambda _: [gimbal_manager_status(gimbal)],
    }


def listen_for_gimbal(gimbal: GimbalMount) -> None:
    host, control = gimbal.host, GimbalRequests(gimbal)
    host.on(m.GimbalManagerSetAttitude, control.on_attitude)
    host.on(m.GimbalManagerSetPitchyaw, control.on_pitch_and_yaw)
    host.on(m.GimbalManagerSetManualControl, control.on_manual_control)
    host.on(m.GimbalDeviceSetAttitude, control.on_device_attitude)
    host.on(m.GlobalPositionInt, control.on_global_position)
