"""The commands and messages that order the gimbal of a simulated ArduPilot about."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMountMode, MavResult
from aerokit.sim.commands import whole
from aerokit.sim.rotations import euler_from_quaternion

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.gimbal import Gimbal
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.channel import Channel
    from aerokit.sim.commands import Command, CommandHandler

__all__ = ["GimbalCommands"]

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
        """MAV_CMD → handler."""
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
