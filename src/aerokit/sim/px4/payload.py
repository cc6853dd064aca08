"""Payload of a simulated PX4: gimbal and camera trigger.

MNT_MODE_IN 0 or 4 enables a gimbal on the AUX outputs (MNT_MODE_OUT 0) and its gimbal manager.

Servos have no feedback, so telemetry reports the set-point. Only the component in control can command the gimbal, but
every component can set a region of interest. There is no secondary control and no retracted position, and
GIMBAL_MANAGER_SET_PITCHYAW is ignored. When a return starts, PX4 briefly takes control and centers the gimbal.
"""

from __future__ import annotations

import math
from functools import partial

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GimbalDeviceFlags, GimbalManagerCapFlags, MavCmd, MavMountMode, MavResult
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.protocols.servers.gimbal import Angles, angles_and_rates
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.sim.components.captures import captured_image
from aerokit.sim.motion import Ned, quaternion_from_euler
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.modes import RTL
from aerokit.sim.vehicle import sender_of

# Values of MNT_MODE_IN that enable the gimbal. With 0, radio and MAVLink control the gimbal, with 4 MAVLink only.
_ENABLING_MODES = frozenset({0, 4})
_DEVICE_ID = 1
_LIMITS = ((-45.0, 45.0), (-45.0, 45.0), (-180.0, 180.0))
_TAU_S, _STEP_S = 0.3, 0.0187
# PX4 integrates the commanded rate to an angle, and filters this angle. The gimbal therefore turns at this share of the
# commanded rate.
_RATE_FACTOR = _STEP_S / (_TAU_S + _STEP_S)
_RATE_TIMEOUT_S = 2.0
_POLL_INTERVAL_S = 0.25
_Can = GimbalManagerCapFlags
_CAPABILITIES = (
    _Can.HAS_NEUTRAL | _Can.HAS_ROLL_LOCK | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_LOCK | _Can.CAN_POINT_LOCATION_GLOBAL
)  # fmt: skip
_NEUTRAL: Angles = (0.0, 0.0, 0.0)


class Px4Gimbal:
    """The gimbal: its set-point, and which component is in control."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        # System id and component id of the component in control; zeros if there is none.
        self.in_control: tuple[int, int] = (0, 0)
        # At the time `_target_at`, the set-point was `_target`. From then on, it turns at `_rates`.
        self._target = self._rates = _NEUTRAL
        self._target_at = 0.0
        self._flags = 0  # GIMBAL_MANAGER_FLAGS
        self._place: Ned | None = None  # region of interest; None to follow the set-point
        self._was_returning = False  # True if the vehicle was returning at the last check
        self.is_fitted: bool = False  # True if MNT_MODE_IN enabled the gimbal at power-on.
        px4.on(m.GimbalManagerSetAttitude, self._on_attitude)

    def start(self) -> None:
        parameters = self._px4.parameters
        self.is_fitted = "MNT_MODE_IN" in parameters and parameters["MNT_MODE_IN"] in _ENABLING_MODES
        self.rest()
        self.in_control = (0, 0)
        if self.is_fitted:
            self._px4.every(_POLL_INTERVAL_S, self._poll_return)

    @property
    def is_from_north(self) -> bool:
        return self._place is not None or bool(self._flags & Flags.YAW_LOCK)

    @property
    def flags(self) -> int:
        """GIMBAL_DEVICE_FLAGS."""
        locks = self._flags & (Flags.ROLL_LOCK | Flags.PITCH_LOCK)
        yaw_flag = GimbalDeviceFlags.YAW_LOCK if self.is_from_north else GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME
        return locks | yaw_flag

    def angles(self) -> Angles:
        """Return the present set-point: roll, pitch and yaw in radians."""
        if self._place is not None:
            return self._angles_to(self._place)
        # The gimbal turns at only `_RATE_FACTOR` of the commanded rates, for at most `_RATE_TIMEOUT_S`.
        seconds = min(self._px4.now - self._target_at, _RATE_TIMEOUT_S) * _RATE_FACTOR
        angles = [angle + rate * seconds for angle, rate in zip(self._target, self._rates, strict=True)]
        roll, pitch, yaw = (
            max(math.radians(low), min(math.radians(high), angle))
            for angle, (low, high) in zip(angles, _LIMITS, strict=True)
        )
        return (roll, pitch, yaw)

    def _angles_to(self, place: Ned) -> Angles:
        """Return the angles that point at a place, with yaw from north."""
        motion = self._px4.motion
        _, (min_pitch_deg, max_pitch_deg), _ = _LIMITS
        pitch = max(math.radians(min_pitch_deg), min(math.radians(max_pitch_deg), motion.elevation_of(place)))
        return (0.0, pitch, motion.bearing_to(place))

    def apply(self, flags: int, angles: Angles, rates: Angles) -> None:
        """Set the angles, and the rates at which they change. If any angle is NaN, all angles stay."""
        if flags & Flags.RETRACT:  # The gimbal has no retracted position.
            return
        current = self.angles()
        if flags & Flags.NEUTRAL:
            self.rest()
            return
        self._place = None
        self._flags = flags
        self._target_at = self._px4.now
        self._target = current if any(map(math.isnan, angles)) else angles
        roll, pitch, yaw = (0.0 if math.isnan(rate) else rate for rate in rates)
        self._rates = (roll, pitch, yaw)

    def rest(self) -> None:
        self._place = None
        self._flags = 0
        self._target = self._rates = _NEUTRAL

    def look_at(self, latitude_e7: int, longitude_e7: int, altitude_m: float) -> None:
        """Point at a position. The altitude is AMSL."""
        frame = self._px4.frame
        self._place = (*frame.to_local(latitude_e7, longitude_e7), frame.origin.altitude_m - altitude_m)

    def configure(self, command: ReceivedCommand) -> int:
        system, component = self.in_control
        sender_system, sender_component = command.sender
        self.in_control = (
            _id_in_control(to_int(command.param1), system, self._px4.system_id, sender_system),
            _id_in_control(to_int(command.param2), component, self._px4.component_id, sender_component),
        )
        return MavResult.ACCEPTED

    def _poll_return(self) -> None:
        is_going_home = self._px4.mode == RTL
        if is_going_home and not self._was_returning:
            self.rest()
            self.in_control = (0, 0)  # PX4 takes control and releases it at once, so no component keeps control.
        self._was_returning = is_going_home

    def _on_attitude(self, message: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if not self.is_fitted or sender_of(message) != self.in_control:
            return
        angles, rates = angles_and_rates(message)
        self.apply(message.flags, angles, rates)

    def attitude_status(self) -> m.GimbalDeviceAttitudeStatus:
        quaternion = quaternion_from_euler(*self.angles())
        return m.GimbalDeviceAttitudeStatus(
            target_system=0, target_component=0, time_boot_ms=self._px4.time_boot_ms, flags=self.flags, q=quaternion,
            angular_velocity_x=0.0, angular_velocity_y=0.0, angular_velocity_z=0.0, failure_flags=0, delta_yaw=0.0,
            delta_yaw_velocity=0.0, gimbal_device_id=_DEVICE_ID,
        )  # fmt: skip

    def manager_information(self) -> m.GimbalManagerInformation:
        limits = [math.radians(limit) for low_and_high in _LIMITS for limit in low_and_high]
        return m.GimbalManagerInformation(self._px4.time_boot_ms, _CAPABILITIES, _DEVICE_ID, *limits)

    def manager_status(self) -> m.GimbalManagerStatus:
        no_secondary = (0, 0)
        return m.GimbalManagerStatus(self._px4.time_boot_ms, self.flags, _DEVICE_ID, *self.in_control, *no_secondary)


# In PX4, unlike in the standard, -2 gives control to the autopilot instead of the sender.
_SELF, _RELEASE = -2, -3


def _if_fitted(device: Px4Gimbal | Px4CameraTrigger, handler: CommandHandler) -> CommandHandler:
    """Return a handler that does not answer a command while the device is not fitted."""
    return lambda command: handler(command) if device.is_fitted else None


def gimbal_commands(gimbal: Px4Gimbal) -> dict[int, CommandHandler]:
    return {
        MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: _if_fitted(gimbal, gimbal.configure),
        MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: _if_fitted(gimbal, partial(_pitch_and_yaw, gimbal)),
        MavCmd.DO_MOUNT_CONTROL: _if_fitted(gimbal, partial(_control_mount, gimbal)),
        MavCmd.DO_MOUNT_CONFIGURE: _if_fitted(gimbal, lambda _: MavResult.ACCEPTED),
        MavCmd.DO_SET_ROI_LOCATION: lambda command: _set_roi(gimbal, command),
        MavCmd.DO_SET_ROI_NONE: lambda _: _set_roi(gimbal, None),
    }


def _id_in_control(requested: int, present: int, own: int, sender: int) -> int:
    if requested == _SELF:
        return own
    if requested == _RELEASE:
        return 0 if present == sender else present
    return requested if 0 <= requested <= 255 else present


def _pitch_and_yaw(gimbal: Px4Gimbal, command: ReceivedCommand) -> int:
    if command.sender != gimbal.in_control:
        return MavResult.DENIED
    angles = (0.0, math.radians(command.param1), math.radians(command.param2))
    rates = (math.nan, math.radians(command.param3), math.radians(command.param4))
    gimbal.apply(to_int(command.x), angles, rates)
    return MavResult.ACCEPTED


def _control_mount(gimbal: Px4Gimbal, command: ReceivedCommand) -> int:
    # Modes other than these three are accepted, but have no effect.
    mode = to_int(command.z)
    if mode in (MavMountMode.RETRACT, MavMountMode.NEUTRAL):
        gimbal.rest()
    elif mode == MavMountMode.MAVLINK_TARGETING:
        pitch, roll, yaw = (math.radians(angle) for angle in (command.param1, command.param2, command.param3))
        angles = (roll, pitch, math.remainder(yaw, math.tau))
        gimbal.apply(Flags.ROLL_LOCK | Flags.PITCH_LOCK, angles, (0.0, 0.0, 0.0))
    return MavResult.ACCEPTED


def _set_roi(gimbal: Px4Gimbal, command: ReceivedCommand | None) -> int:
    # The altitude of the command counts as AMSL in every frame.
    if command is None:
        gimbal.rest()
    elif math.isfinite(command.z):
        gimbal.look_at(*command.place(), command.z)
    return MavResult.ACCEPTED


_DEFAULT_CAMERA_ID = 1
_MIN_INTERVAL_S = 0.04
_GEOTAG_DELAY_S = 0.02


class Px4CameraTrigger:
    """Camera trigger. Sends CAMERA_TRIGGER for each image, and CAMERA_IMAGE_CAPTURED if ``sends_image_captured``.

    As on the real vehicle, commands are not answered if no trigger is fitted.
    """

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.sequence: int = 0  # Sequence number of the next image.
        self.interval_s: float = 1.0  # Seconds between two images of a series.
        self.sends_image_captured = True  # False simulates a PX4 without the geotag module.
        self._is_enabled = False
        self._is_paused = False
        self._series_number = 0  # number of this series; timers of earlier series do nothing
        self._last_at = -math.inf  # time of the last image

    @property
    def is_fitted(self) -> bool:
        return int(self._px4.parameters.get("TRIG_MODE", 0)) != 0

    @property
    def is_running(self) -> bool:
        return self._is_enabled and not self._is_paused

    def restart(self) -> None:
        self.sequence = 0
        self._is_enabled = self._is_paused = False
        self._series_number += 1

    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.DO_DIGICAM_CONTROL: _if_fitted(self, self._digicam_control),
            MavCmd.DO_TRIGGER_CONTROL: _if_fitted(self, self._enable_or_pause),
            MavCmd.DO_SET_CAM_TRIGG_INTERVAL: _if_fitted(self, self._set_interval),
        }

    def _digicam_control(self, command: ReceivedCommand) -> int:
        if self._px4.now - self._last_at < _MIN_INTERVAL_S:  # The camera is not ready for another image.
            return MavResult.TEMPORARILY_REJECTED
        takes_image = command.x == 1  # Param 5 of DO_DIGICAM_CONTROL.
        if takes_image:
            self.shoot()
        return MavResult.ACCEPTED

    def _enable_or_pause(self, command: ReceivedCommand) -> int:
        was_running = self.is_running
        # A param of -1 changes nothing.
        enable, reset, pause = to_int(command.param1), to_int(command.param2), to_int(command.param3)
        if pause in (0, 1):
            self._is_paused = pause == 1
        if reset == 1:
            self.sequence = 0
        if enable in (0, 1):
            self._is_enabled = enable == 1
        if self.is_running and not was_running:
            self._series_number += 1
            self._take_next(self._series_number)
        return MavResult.ACCEPTED

    def _set_interval(self, command: ReceivedCommand) -> int:
        if command.param1 > 0.0:
            self.interval_s = command.param1 / 1000.0
        return MavResult.ACCEPTED

    def _take_next(self, series: int) -> None:
        if series == self._series_number and self.is_running:
            self.shoot()
            self._px4.call_later(self.interval_s, lambda: self._take_next(series))

    def shoot(self) -> None:
        px4, number = self._px4, self.sequence
        self.sequence += 1
        self._last_at = px4.now
        px4.send(m.CameraTrigger(round(px4.now * 1e6), number))
        if self.sends_image_captured:
            px4.call_later(_GEOTAG_DELAY_S, lambda: self._send_captured(number))

    def _send_captured(self, number: int) -> None:
        px4, successful = self._px4, 1
        image = captured_image(
            px4, px4.time_boot_ms, px4.motion.angles, camera_id=_DEFAULT_CAMERA_ID, index=number, result=successful
        )
        px4.send(image)
