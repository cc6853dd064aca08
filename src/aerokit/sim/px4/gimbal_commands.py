"""The commands (MAV_CMD) that order the gimbal of a simulated PX4 about."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.mavlink.enums import MavCmd, MavMountMode, MavResult
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.gimbal import Gimbal

_ITSELF, _RELEASE = -2, -3


def gimbal_commands(px4: Px4Vehicle) -> dict[int, CommandHandler]:
    """MAV_CMD → handler; without a gimbal nobody answers those for it."""

    def if_fitted(handler: Callable[[Gimbal, Command], int]) -> CommandHandler:
        return lambda command: handler(px4.gimbal, command) if px4.gimbal.is_fitted else None

    return {
        MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: if_fitted(_configure),
        MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: if_fitted(_pitch_and_yaw),
        MavCmd.DO_MOUNT_CONTROL: if_fitted(_control_mount),
        MavCmd.DO_MOUNT_CONFIGURE: if_fitted(lambda *_: MavResult.ACCEPTED),
        MavCmd.DO_SET_ROI_LOCATION: lambda command: _look(px4.gimbal, command),
        MavCmd.DO_SET_ROI_NONE: lambda _: _look(px4.gimbal, None),
    }


def _configure(gimbal: Gimbal, command: Command) -> int:
    """Ids; −2 is PX4 itself, not who asks. Secondary control is not known."""
    own = gimbal.own_ids
    now = []
    for number, before, mine, sender in zip(
        (command.param1, command.param2), gimbal.in_control, own, command.sender, strict=True
    ):
        wanted = whole(number)
        if wanted == _ITSELF:
            now.append(mine)
        elif wanted == _RELEASE:
            now.append(0 if before == sender else before)
        else:
            now.append(wanted if 0 <= wanted <= 255 else before)
    gimbal.in_control = (now[0], now[1])
    return MavResult.ACCEPTED


def _pitch_and_yaw(gimbal: Gimbal, command: Command) -> int:
    if command.sender != gimbal.in_control:
        return MavResult.DENIED
    angles = (0.0, math.radians(command.param1), math.radians(command.param2))
    rates = (math.nan, math.radians(command.param3), math.radians(command.param4))
    gimbal.obey(whole(command.x), angles, rates)
    return MavResult.ACCEPTED


def _control_mount(gimbal: Gimbal, command: Command) -> int:
    """Modes that it does not know are accepted as well."""
    mode = whole(command.z)
    if mode in (MavMountMode.RETRACT, MavMountMode.NEUTRAL):
        gimbal.rest()
    elif mode == MavMountMode.MAVLINK_TARGETING:
        pitch, roll, yaw = (math.radians(each) for each in (command.param1, command.param2, command.param3))
        angles = (roll, pitch, math.remainder(yaw, math.tau))
        gimbal.obey(Flags.ROLL_LOCK | Flags.PITCH_LOCK, angles, (0.0, 0.0, 0.0))
    return MavResult.ACCEPTED


def _look(gimbal: Gimbal, command: Command | None) -> int:
    """The altitude is taken for one above the sea, whatever the frame."""
    if command is None:
        gimbal.rest()
    elif math.isfinite(command.z):
        gimbal.look_at(*command.place(), command.z)
    return MavResult.ACCEPTED
