"""Servo gimbal (MNT1_TYPE 1) of a simulated ArduPilot.

Servos have no feedback, so telemetry reports the set-point. Pitch and roll are relative to the horizon, yaw to the
vehicle's nose or to north. With MNT1_TYPE 0 there is no gimbal, and gimbal commands fail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GimbalDeviceFlags,
    GimbalManagerCapFlags,
    GimbalManagerFlags,
    MavFrame,
    MavMountMode,
    MavResult,
    MavSeverity,
)
from aerokit.protocols.servers.gimbal import Angles, angles_and_rates
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.channel import Channel
from aerokit.sim.commands import ReceivedCommand, to_int
from aerokit.sim.motion import Ned, quaternion_from_euler
from aerokit.sim.vehicle import sender_of

_DEVICE_ID = 1
# Values of the system id in DO_GIMBAL_MANAGER_CONFIGURE with a special meaning.
_KEEP_CONTROL, _TAKE_CONTROL, _RELEASE_CONTROL = -1, -2, -3
_MIN_ID = _RELEASE_CONTROL
_Can = GimbalManagerCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL | _Can.HAS_RC_INPUTS
    | _Can.CAN_POINT_LOCATION_LOCAL | _Can.CAN_POINT_LOCATION_GLOBAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_FOLLOW | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_FOLLOW | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
)  # fmt: skip
_FROM_NORTH = frozenset({MavMountMode.GPS_POINT, MavMountMode.SYSID_TARGET, MavMountMode.HOME_LOCATION})
_PLAIN_MOUNT_MODES = frozenset(
    {MavMountMode.RETRACT, MavMountMode.NEUTRAL, MavMountMode.RC_TARGETING, MavMountMode.HOME_LOCATION}
)
_FIXED_ANGLE_MODES = frozenset({MavMountMode.RETRACT, MavMountMode.NEUTRAL})


@dataclass(frozen=True)
class MountTarget:
    """Target angles in degrees at the time ``set_at``. From then on, ``rates`` (degrees per second) change them."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    is_from_north: bool = False
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    set_at: float = 0.0


class ArduPilotGimbal:
    """The gimbal: its mode, its target and the component in control. :attr:`angles` is the direction of the gimbal."""

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle, self._parameters = vehicle, vehicle.parameters
        self.mode: int = int(self._parameters["MNT1_DEFLT_MODE"])  # A MAV_MOUNT_MODE.
        self.is_yaw_locked: bool = False  # True if the pilot's stick controls yaw relative to north.
        self.in_control: tuple[int, int] = (0, 0)  # System id and component id that control the gimbal.
        self._target = MountTarget()
        self._region: Ned | None = None  # region of interest; None if there is none
        self._followed_id = 0  # system id of the followed vehicle
        self._followed_place: Ned | None = None  # None until its position is received
        vehicle.on(m.GimbalManagerSetAttitude, self._on_manager_message)
        vehicle.on(m.GimbalManagerSetPitchyaw, self._on_manager_message)

    @property
    def is_fitted(self) -> bool:
        return self._parameters["MNT1_TYPE"] != 0

    @property
    def angles(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw of the servos in degrees. Yaw is relative to the nose."""
        if self.mode in _FIXED_ANGLE_MODES:
            return (self.target.roll, self.target.pitch, self.target.yaw)
        target, motion = self.target, self._vehicle.motion
        yaw = self._limited("YAW", self._from_nose(target))
        # The servos compensate the roll and pitch of the vehicle, rotated into the direction of the gimbal's yaw.
        lean_roll, lean_pitch = math.degrees(motion.roll), math.degrees(motion.pitch)
        cos, sin = math.cos(math.radians(-yaw)), math.sin(math.radians(-yaw))
        roll = target.roll - (lean_roll * cos - lean_pitch * sin)
        pitch = target.pitch - (lean_roll * sin + lean_pitch * cos)
        return self._limited("ROLL", roll), self._limited("PITCH", pitch), yaw

    @property
    def target(self) -> MountTarget:
        if self.mode == MavMountMode.RC_TARGETING:  # The gimbal's sticks always rest in the middle.
            return MountTarget(self._middle("ROLL"), self._middle("PITCH"), 0.0, self.is_yaw_locked)
        if self.mode in _FIXED_ANGLE_MODES:
            mode_name = MavMountMode(self.mode).name
            roll, pitch, yaw = (self._parameters[f"MNT1_{mode_name}_{axis}"] for axis in "XYZ")
            return MountTarget(roll, pitch, yaw)
        if self.mode == MavMountMode.GPS_POINT:
            return self._update_target_for(self._region)
        if self.mode == MavMountMode.SYSID_TARGET:
            return self._update_target_for(self._followed_place)
        if self.mode == MavMountMode.HOME_LOCATION:
            return self._update_target_for(self._vehicle.navigation.home)
        return self._moved_by_rates(self._target)

    def _moved_by_rates(self, target: MountTarget) -> MountTarget:
        if not any(target.rates):
            return target
        seconds = self._vehicle.now - target.set_at
        roll_rate, pitch_rate, yaw_rate = target.rates
        roll = self._limited("ROLL", target.roll + roll_rate * seconds)
        pitch = self._limited("PITCH", target.pitch + pitch_rate * seconds)
        yaw = target.yaw + yaw_rate * seconds
        yaw = math.remainder(yaw, 360.0) if target.is_from_north else self._limited("YAW", yaw)
        return replace(target, roll=roll, pitch=pitch, yaw=yaw)

    def _update_target_for(self, place: Ned | None) -> MountTarget:
        """Aim at a place, if the place and the vehicle's position are known."""
        motion = self._vehicle.motion
        if place is not None and self._vehicle.navigation.has_position:
            pitch, yaw = math.degrees(motion.elevation_of(place)), math.degrees(motion.bearing_to(place))
            self._target = MountTarget(0.0, pitch, yaw, is_from_north=True)
        return self._target

    def _from_nose(self, target: MountTarget) -> float:
        if not target.is_from_north:
            return target.yaw
        return math.remainder(target.yaw - math.degrees(self._vehicle.motion.yaw), 360.0)

    def _limited(self, axis: str, angle: float) -> float:
        return max(self._parameters[f"MNT1_{axis}_MIN"], min(self._parameters[f"MNT1_{axis}_MAX"], angle))

    def _middle(self, axis: str) -> float:
        return (self._parameters[f"MNT1_{axis}_MIN"] + self._parameters[f"MNT1_{axis}_MAX"]) / 2.0

    def set_mode(self, mode: int) -> None:
        """Set a MAV_MOUNT_MODE. Unknown values are ignored."""
        if mode in list(MavMountMode):
            self._target = self.target
            self.mode = mode

    def point(self, roll: float, pitch: float, yaw: float, *, from_north: bool) -> None:
        """Turn to these angles in degrees."""
        if not from_north:  # `angles` limits a yaw that is relative to north.
            yaw = self._limited("YAW", yaw - 360.0 if yaw > 180.0 else yaw)
        self._target = MountTarget(self._limited("ROLL", roll), self._limited("PITCH", pitch), yaw, from_north)
        self.mode = MavMountMode.MAVLINK_TARGETING

    def turn(self, roll: float, pitch: float, yaw: float, *, from_north: bool) -> None:
        """Turn at rates in degrees per second. With ``from_north``, yaw is relative to north, otherwise to the nose."""
        current = self.target
        current_yaw = self._from_nose(current)
        if from_north:
            current_yaw = current.yaw if current.is_from_north else current.yaw + math.degrees(self._vehicle.motion.yaw)
        rates = (roll, pitch, yaw)
        self._target = MountTarget(current.roll, current.pitch, current_yaw, from_north, rates, self._vehicle.now)
        self.mode = MavMountMode.MAVLINK_TARGETING

    def look_at(self, place: Ned | None) -> None:
        """Point at a place. None returns to the default mode."""
        self._region = place
        if place is not None:
            self.set_mode(MavMountMode.GPS_POINT)
        elif self.mode == MavMountMode.GPS_POINT:
            self.set_mode(int(self._parameters["MNT1_DEFLT_MODE"]))

    def follow(self, system_id: int) -> None:
        """Point at another vehicle once its position is received."""
        self._followed_id = system_id
        self._followed_place = None
        self.set_mode(MavMountMode.SYSID_TARGET)

    def on_global_position(self, message: m.GlobalPositionInt, _: Channel) -> None:
        sender_system, _component = sender_of(message)
        if sender_system != self._followed_id:
            return
        place = self._vehicle.world_point(message.lat, message.lon, message.alt * 1e-3, MavFrame.GLOBAL)
        if place is not None:
            self._followed_place = place

    def _is_selected(self, device_id: float) -> bool:
        """Return True if there is a gimbal, and ``device_id`` selects it. 0 selects all gimbals."""
        return self.is_fitted and to_int(device_id) in (0, _DEVICE_ID)

    def configure_mount(self, command: ReceivedCommand) -> int:
        if not self.is_fitted:
            return MavResult.FAILED
        self.set_mode(to_int(command.param1))
        return MavResult.ACCEPTED

    def control_mount(self, command: ReceivedCommand) -> int:
        mode = to_int(command.z)
        if not self.is_fitted:
            return MavResult.FAILED
        if mode in _PLAIN_MOUNT_MODES:
            self.set_mode(mode)
            return MavResult.ACCEPTED
        if mode == MavMountMode.MAVLINK_TARGETING:
            pitch, roll, yaw = command.param1, command.param2, command.param3
            if abs(pitch) > 90.0 or abs(roll) > 180.0 or abs(yaw) > 360.0:
                self._vehicle.send_text(MavSeverity.WARNING, "Mount: invalid angle targets")
                return MavResult.FAILED
            self.point(roll, pitch, yaw, from_north=False)
            return MavResult.ACCEPTED
        # Before AP 4.2, params 1 and 2 contained the position. Newer firmware refuses such a command
        # (AP_Mount_Backend.cpp).
        has_place_in_params = command.param1 and command.param2 and not command.x and not command.y
        if mode == MavMountMode.GPS_POINT and not has_place_in_params:
            altitude = float(to_int(command.param4))  # The firmware uses whole metres (AP_Mount_Backend.cpp).
            frame = MavFrame.GLOBAL_RELATIVE_ALT
            # The firmware does not check the place. In the simulation, an invalid place makes the gimbal stop looking
            # at its present target.
            self.look_at(self._vehicle.world_point(to_int(command.x), to_int(command.y), altitude, frame))
            return MavResult.ACCEPTED
        return MavResult.FAILED

    def configure_manager(self, command: ReceivedCommand) -> int:
        system, component = to_int(command.param1), to_int(command.param2)
        are_ids_valid = all(_MIN_ID <= number <= 255 for number in (system, component))
        if not self._is_selected(command.z) or not are_ids_valid:
            return MavResult.FAILED
        previous = self.in_control
        if system == _TAKE_CONTROL:
            self.in_control = command.sender
        elif system == _RELEASE_CONTROL:
            self.in_control = (0, 0) if previous == command.sender else previous
        elif system != _KEEP_CONTROL:
            self.in_control = (system, component)
        if self.in_control != previous:
            # The status follows the acknowledgement.
            self._vehicle.call_later(0.0, lambda: self._vehicle.send_built(m.GimbalManagerStatus.ID))
        return MavResult.ACCEPTED

    def point_or_turn(self, command: ReceivedCommand) -> int:
        if not self._is_selected(command.z):
            return MavResult.FAILED
        angles, rates = (0.0, command.param1, command.param2), (0.0, command.param3, command.param4)
        return self._manage(to_int(command.x), angles, rates)

    def _on_manager_message(self, message: m.GimbalManagerSetAttitude | m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        if isinstance(message, m.GimbalManagerSetAttitude):
            angles, rates = angles_and_rates(message)
        else:
            angles, rates = (0.0, message.pitch, message.yaw), (0.0, message.pitch_rate, message.yaw_rate)
        has_both = not any(map(math.isnan, (*angles, *rates)))
        if self._is_selected(message.gimbal_device_id) and not has_both:  # The firmware ignores angles with rates.
            roll, pitch, yaw, roll_rate, pitch_rate, yaw_rate = map(math.degrees, (*angles, *rates))
            self._manage(message.flags, (roll, pitch, yaw), (roll_rate, pitch_rate, yaw_rate))

    def _manage(self, flags: int, angles: Angles, rates: Angles) -> int:
        """Apply GIMBAL_MANAGER_FLAGS with angles or rates. Values that are not given are NaN."""
        from_north = bool(flags & GimbalManagerFlags.YAW_LOCK)
        (_, pitch, yaw), (_, pitch_rate, yaw_rate) = angles, rates
        if flags & GimbalManagerFlags.RETRACT:
            self.set_mode(MavMountMode.RETRACT)
        elif flags & GimbalManagerFlags.NEUTRAL:
            self.set_mode(MavMountMode.NEUTRAL)
        elif not any(map(math.isnan, angles)):
            self.point(*angles, from_north=from_north)
        elif not any(map(math.isnan, rates)):
            self.turn(*rates, from_north=from_north)
        elif all(map(math.isnan, (pitch, yaw, pitch_rate, yaw_rate))):  # Only the yaw lock changes.
            self.is_yaw_locked = from_north
        else:
            return MavResult.FAILED
        return MavResult.ACCEPTED

    def attitude_status(self) -> m.GimbalDeviceAttitudeStatus:
        # The reported yaw is relative to the nose, even with YAW_LOCK.
        flags = GimbalDeviceFlags.ROLL_LOCK | GimbalDeviceFlags.PITCH_LOCK | GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME
        if self.mode == MavMountMode.RETRACT:
            flags |= GimbalDeviceFlags.RETRACT
        elif self.mode == MavMountMode.NEUTRAL:
            flags |= GimbalDeviceFlags.NEUTRAL
        elif self.mode in _FROM_NORTH or self.target.is_from_north:
            flags |= GimbalDeviceFlags.YAW_LOCK
        roll, pitch, yaw = map(math.radians, self.angles)
        unknown = math.nan
        return m.GimbalDeviceAttitudeStatus(
            target_system=0, target_component=0, time_boot_ms=self._vehicle.time_boot_ms, flags=flags,
            q=quaternion_from_euler(roll, pitch, yaw), angular_velocity_x=unknown, angular_velocity_y=unknown,
            angular_velocity_z=unknown, failure_flags=0, delta_yaw=unknown, delta_yaw_velocity=unknown,
            gimbal_device_id=_DEVICE_ID,
        )  # fmt: skip

    def manager_information(self) -> m.GimbalManagerInformation:
        limits = (
            math.radians(self._parameters[f"MNT1_{axis}_{end}"])
            for axis in ("ROLL", "PITCH", "YAW")
            for end in ("MIN", "MAX")
        )
        return m.GimbalManagerInformation(self._vehicle.time_boot_ms, _CAPABILITIES, _DEVICE_ID, *limits)

    def manager_status(self) -> m.GimbalManagerStatus:
        flags = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK
        if self.is_yaw_locked:
            flags |= GimbalManagerFlags.YAW_LOCK
        system, component = self.in_control
        return m.GimbalManagerStatus(
            time_boot_ms=self._vehicle.time_boot_ms, flags=flags, gimbal_device_id=_DEVICE_ID,
            primary_control_sysid=system, primary_control_compid=component, secondary_control_sysid=0,
            secondary_control_compid=0,
        )  # fmt: skip
