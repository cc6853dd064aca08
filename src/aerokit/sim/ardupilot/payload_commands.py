"""Commands to gimbal, camera and whatever else an ArduPilot drives besides its motors, most of which is not there.

The results are those of a vehicle as the simulation starts it: no gripper, no winch, no lifting rotors.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMountMode, MavResult, MavSeverity
from aerokit.sim.ardupilot.accessories import Accessories
from aerokit.sim.ardupilot.gimbal import Gimbal
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.motion import euler_from_quaternion

_JUST_A_MODE = frozenset(
    {MavMountMode.RETRACT, MavMountMode.NEUTRAL, MavMountMode.RC_TARGETING, MavMountMode.HOME_LOCATION}
)


class GimbalCommands:
    """DO_MOUNT_CONFIGURE, DO_MOUNT_CONTROL and the gimbal manager's commands and messages."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        vehicle.on(m.GimbalManagerSetAttitude, self._on_attitude)
        vehicle.on(m.GimbalManagerSetPitchyaw, self._on_pitch_and_yaw)

    @property
    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.DO_MOUNT_CONFIGURE: self._configure_mount,
            MavCmd.DO_MOUNT_CONTROL: self._control_mount,
            MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: self._manage,
            MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: self._configure_manager,
        }

    def _gimbal(self, device_id: float = 0) -> Gimbal | None:
        """The first one is number 1; 0 means it, too."""
        gimbal = self._vehicle.gimbal
        return gimbal if gimbal.is_fitted and whole(device_id) in (0, 1) else None

    def _configure_mount(self, command: Command) -> int:
        gimbal = self._gimbal()
        if gimbal is None:
            return MavResult.FAILED
        gimbal.set_mode(whole(command.param1))
        return MavResult.ACCEPTED

    def _control_mount(self, command: Command) -> int:
        gimbal, mode = self._gimbal(), whole(command.z)
        if gimbal is None:
            return MavResult.FAILED
        if mode in _JUST_A_MODE:
            gimbal.set_mode(mode)
            return MavResult.ACCEPTED
        if mode == MavMountMode.MAVLINK_TARGETING:
            return self._point_mount(gimbal, command.param1, command.param2, command.param3)
        if mode == MavMountMode.GPS_POINT and (command.x or command.y or not command.param1):
            place = (whole(command.x), whole(command.y), float(whole(command.param4)))
            gimbal.look_at(self._vehicle.point(*place, MavFrame.GLOBAL_RELATIVE_ALT))
            return MavResult.ACCEPTED
        return MavResult.FAILED

    def _point_mount(self, gimbal: Gimbal, pitch: float, roll: float, yaw: float) -> int:
        if abs(pitch) > 90.0 or abs(roll) > 180.0 or abs(yaw) > 360.0:
            gimbal.warn()
            return MavResult.FAILED
        gimbal.point(roll, pitch, yaw, from_north=False)
        return MavResult.ACCEPTED

    def _manage(self, command: Command) -> int:
        gimbal = self._gimbal(command.z)
        if gimbal is None:
            return MavResult.FAILED
        angles = (0.0, command.param1, command.param2)
        return gimbal.manage(whole(command.x), angles, (0.0, command.param3, command.param4))

    def _configure_manager(self, command: Command) -> int:
        gimbal = self._gimbal(command.z)
        ids = (whole(command.param1), whole(command.param2))
        done = gimbal is not None and gimbal.set_control(command.sender, *ids)
        return MavResult.ACCEPTED if done else MavResult.FAILED

    def _on_attitude(self, order: m.GimbalManagerSetAttitude, _: Channel) -> None:
        gimbal = self._gimbal(order.gimbal_device_id)
        rates = (order.angular_velocity_x, order.angular_velocity_y, order.angular_velocity_z)
        has_angles = not any(map(math.isnan, order.q))
        if gimbal is None or (has_angles and not any(map(math.isnan, rates))):
            return
        angles = euler_from_quaternion(*order.q) if has_angles else (math.nan,) * 3
        gimbal.manage(order.flags, _degrees(*angles), _degrees(*rates))

    def _on_pitch_and_yaw(self, order: m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        gimbal = self._gimbal(order.gimbal_device_id)
        four = (order.pitch, order.yaw, order.pitch_rate, order.yaw_rate)
        if gimbal is not None and any(map(math.isnan, four)):
            gimbal.manage(
                order.flags,
                _degrees(0.0, order.pitch, order.yaw),
                _degrees(0.0, order.pitch_rate, order.yaw_rate),
            )


def _degrees(roll: float, pitch: float, yaw: float) -> tuple[float, float, float]:
    return (math.degrees(roll), math.degrees(pitch), math.degrees(yaw))


class RegionOfInterest:
    """Accepted with or without a gimbal, which alone follows another vehicle (…_SYSID), as far as it is heard."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle

    @property
    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.DO_SET_ROI: self._look_at,
            MavCmd.DO_SET_ROI_LOCATION: self._look_at,
            MavCmd.DO_SET_ROI_NONE: self._look_ahead,
            MavCmd.DO_SET_ROI_SYSID: self._follow,
        }

    def _look_at(self, command: Command) -> int:
        """No latitude, no longitude and no altitude means nothing any more."""
        point = self._vehicle.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        nowhere = command.place() == (0, 0) and command.z == 0
        self._vehicle.look_at(None if nowhere else point)
        return MavResult.ACCEPTED

    def _follow(self, command: Command) -> int:
        self._vehicle.gimbal.follow(whole(command.param1))
        return MavResult.ACCEPTED

    def _look_ahead(self, _: Command) -> int:
        self._vehicle.look_at(None)
        return MavResult.ACCEPTED


_C, _R = MavCmd, MavResult
_ALL: tuple[Kind, ...] = ("copter", "plane", "rover", "sub")
_NOTICE, _WARNING = MavSeverity.NOTICE, MavSeverity.WARNING
_SOURCE_SETS = (1.0, 2.0, 3.0)

_ANSWERS: tuple[tuple[int, int, tuple[Kind, ...]], ...] = (
    (_C.DO_LAND_START, _R.FAILED, ("copter", "plane")),
    (_C.DO_SET_REVERSE, _R.ACCEPTED, ("rover",)),
    (_C.DO_PARACHUTE, _R.ACCEPTED, ("copter", "plane")),
    (_C.DO_MOTOR_TEST, _R.ACCEPTED, ("rover",)),
    (_C.DO_MOTOR_TEST, _R.FAILED, ("plane", "sub")),
    (_C.DO_GRIPPER, _R.FAILED, _ALL),
    (_C.DO_SPRAYER, _R.ACCEPTED, ("copter", "rover")),
    (_C.DO_SPRAYER, _R.FAILED, ("plane", "sub")),
    (_C.DO_ENGINE_CONTROL, _R.FAILED, ("plane",)),
    (_C.PREFLIGHT_STORAGE, _R.DENIED, _ALL),
    (_C.DO_SET_SAFETY_SWITCH_STATE, _R.ACCEPTED, _ALL),
    (_C.DO_JUMP_TAG, _R.FAILED, _ALL),
    (_C.DO_VTOL_TRANSITION, _R.FAILED, ("plane",)),
    (_C.DO_WINCH, _R.FAILED, ("copter",)),
)
"""Command, result, and by whom."""

_TEXTS: dict[tuple[int, Kind], tuple[tuple[int, str], ...]] = {
    (_C.DO_LAND_START, "plane"): ((_WARNING, "Unable to start landing sequence"),),
    (_C.DO_LAND_START, "copter"): (
        (_WARNING, "Unable to start landing sequence"),
        (_WARNING, "Mode change to AUTO RTL failed: No landing sequence found"),
    ),
    (_C.DO_VTOL_TRANSITION, "plane"): ((_NOTICE, "VTOL not available"),),
}
"""What is said besides."""


def equipment_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler; whoever simulates a command really replaces it."""
    kind, gear = vehicle.KIND, _Equipment(vehicle)
    handlers: dict[int, CommandHandler] = {
        command: gear.answers(result, _TEXTS.get((command, kind), ()))
        for command, result, kinds in _ANSWERS
        if kind in kinds
    }
    if kind != "sub":
        handlers[_C.DO_FOLLOW] = lambda c: _R.ACCEPTED if 0 < c.param1 <= 255 else _R.DENIED
    handlers |= {
        _C.DO_SET_SERVO: gear.accessory(Accessories.set_servo),
        _C.DO_REPEAT_SERVO: gear.accessory(Accessories.set_servo),
        _C.DO_SET_RELAY: gear.accessory(Accessories.set_relay),
        _C.DO_REPEAT_RELAY: gear.accessory(Accessories.repeat_relay),
        _C.DO_AUX_FUNCTION: gear.accessory(Accessories.switch),
        _C.BATTERY_RESET: gear.reset_battery,
        _C.CONTROL_HIGH_LATENCY: gear.high_latency,
        _C.SET_EKF_SOURCE_SET: lambda c: _R.ACCEPTED if c.param1 in _SOURCE_SETS else _R.DENIED,
    }
    return handlers


class _Equipment:
    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle

    def answers(self, result: int, texts: tuple[tuple[int, str], ...]) -> CommandHandler:
        def handle(_: Command) -> int:
            for severity, text in texts:
                self._vehicle.send_text(severity, text)
            return result

        return handle

    def accessory(self, do: Callable[[Accessories, Command], int]) -> CommandHandler:
        return lambda command: do(self._vehicle.accessories, command)

    def reset_battery(self, command: Command) -> int:
        """The first battery's charge in percent, when the mask in param 1 has it."""
        if whole(command.param1) & 1:
            self._vehicle.battery.percent = max(0.0, min(100.0, command.param2))
        return MavResult.ACCEPTED

    def high_latency(self, command: Command) -> int:
        """No port speaks it; to stop it is no error."""
        if command.param1:
            return MavResult.FAILED
        self._vehicle.send_text(MavSeverity.NOTICE, "High Latency disabled")
        return MavResult.ACCEPTED


def camera_commands(vehicle: ArduPilotVehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler. Such a camera takes no video and has one lens."""
    return {
        MavCmd.IMAGE_START_CAPTURE: lambda command: vehicle.camera.start_capture(command),
        MavCmd.IMAGE_STOP_CAPTURE: lambda command: vehicle.camera.stop_capture(command),
        MavCmd.DO_DIGICAM_CONTROL: lambda command: vehicle.camera.control(command),
        MavCmd.DO_DIGICAM_CONFIGURE: lambda _: MavResult.ACCEPTED,
        MavCmd.DO_SET_CAM_TRIGG_DIST: lambda command: vehicle.camera.set_trigger_distance(command),
        MavCmd.SET_CAMERA_ZOOM: lambda command: vehicle.camera.zoom(command),
        MavCmd.SET_CAMERA_FOCUS: lambda command: vehicle.camera.focus(command),
        MavCmd.SET_CAMERA_SOURCE: lambda _: MavResult.DENIED,
        MavCmd.VIDEO_START_CAPTURE: lambda _: MavResult.FAILED,
        MavCmd.VIDEO_STOP_CAPTURE: lambda _: MavResult.FAILED,
    }
