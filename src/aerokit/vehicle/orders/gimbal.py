"""``vehicle.gimbal``: where the first gimbal points, and orders to it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected
from aerokit.mavlink.enums import GimbalManagerFlags, MavCmd, MavMountMode, MavResult
from aerokit.mavlink.messages import (
    GimbalDeviceAttitudeStatus,
    MountConfigure,
    MountControl,
    MountOrientation,
    MountStatus,
)
from aerokit.runtime.cells import Source, StateCell
from aerokit.vehicle.checks import check_range
from aerokit.vehicle.state.gimbal import GimbalAttitude, from_device, from_orientation, from_status

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.orders.bridge import Bridge

__all__ = ["Gimbal"]

PITCHYAW, CONFIGURE = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.DO_GIMBAL_MANAGER_CONFIGURE
LOCKED = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK | GimbalManagerFlags.YAW_LOCK
"""Roll and pitch from the horizon, yaw from north."""
RELEASE = -3


@checks_arguments
class Gimbal:
    """The gimbal that the autopilot manages, or its mount; of several the first.

    Places are looked at by :meth:`aerokit.Vehicle.look_at`.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._talk, self._orders = bridge.talk, bridge.orders
        self._first: tuple[int, int] | None = None
        self._has_claimed = False
        self.attitude: StateCell[GimbalAttitude] = StateCell(
            "gimbal.attitude",
            bridge.talk.connection.now,
            "GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION",
        )
        """Where it points, as it tells by itself: nothing is asked for (GIMBAL_DEVICE_ATTITUDE_STATUS of any component
        of the vehicle, MOUNT_ORIENTATION, MOUNT_STATUS)."""
        bridge.talk.keep(self.attitude)
        bridge.talk.on_reboot.append(self._forget)
        self._listen(GimbalDeviceAttitudeStatus, self._on_device)
        self._listen(MountStatus, lambda message: self._tell(message, from_status(message)))
        self._listen(MountOrientation, self._on_orientation)

    # -------------------------------------------------------------------------------- orders

    async def point(self, pitch_deg: float, yaw_deg: float, *, roll_deg: float = 0.0) -> None:
        """Turn it and keep it there, however the vehicle moves; returns when that was accepted, not when it is there.

        Args:
            pitch_deg: from the horizon, −360 to 360: 0 is level, −90 straight down.
            yaw_deg: clockwise from north, −360 to 360.
            roll_deg: from the horizon, −360 to 360. If it is not 0, only the mount's command can do it, which turns the
                camera with the vehicle: ``yaw_deg`` is right at the moment of the order.

        Sends MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW (https://mavlink.io/en/services/gimbal_v2.html); control is claimed
        when that is denied, until :meth:`release`. MAV_CMD_DO_MOUNT_CONTROL to a vehicle without a gimbal manager, and
        MOUNT_CONTROL, which has no answer, to one that does not know that either.

        Raises:
            LocalProtocolError: an angle is out of range. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
        """
        for name, value in (("pitch_deg", pitch_deg), ("yaw_deg", yaw_deg), ("roll_deg", roll_deg)):
            check_range(name, value, -360, 360)
        if roll_deg or self._talk.commands.is_unknown(PITCHYAW):  # the gimbal manager's command has no roll
            await self._control_mount(pitch_deg, roll_deg, yaw_deg)
            return
        self._claim_if_denied()
        params = (pitch_deg, yaw_deg, math.nan, math.nan, LOCKED)
        try:
            await self._orders.command_aside(PITCHYAW, *params)
        except CommandRejected as error:
            if error.result == MavResult.UNSUPPORTED:
                await self._control_mount(pitch_deg, roll_deg, yaw_deg)
            elif self._claim_if_denied():
                await self._orders.command_aside(PITCHYAW, *params)
            else:
                raise

    async def release(self) -> None:
        """Give it back to the pilot's sticks, and the control that was claimed to whoever wants it.

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
        """
        await self._command_mount(0, 0, 0, 0, 0, 0, MavMountMode.RC_TARGETING)
        if self._has_claimed:
            self._has_claimed = False
            await self._orders.command_aside(CONFIGURE, RELEASE, RELEASE)

    def _claim_if_denied(self) -> bool:
        """Say that we are in control, if the last answer denied us something, whoever waited for it."""
        commands, connection = self._talk.commands, self._talk.connection
        if commands.last_result(PITCHYAW) != MavResult.DENIED:
            return False
        commands.forget_result(PITCHYAW)
        commands.send_unconfirmed(CONFIGURE, connection.source_system, connection.source_component)
        self._has_claimed = True
        return True

    async def _control_mount(self, pitch: float, roll: float, yaw: float) -> None:
        relative = math.remainder(yaw - (self._heading() or 0.0), 360.0)
        if not await self._command_mount(pitch, roll, relative, 0, 0, 0, MavMountMode.MAVLINK_TARGETING):
            a, b, c = (round(each * 100) for each in (pitch, roll, yaw))
            self._talk.send(MountControl(self._talk.system_id, self._talk.component_id, a, b, c, 0))

    async def _command_mount(self, *params: float) -> bool:
        """DO_MOUNT_CONTROL; False for firmware that is older, and was told the mode by a message without an answer."""
        if not self._talk.commands.is_unknown(MavCmd.DO_MOUNT_CONTROL):
            try:
                await self._orders.command_aside(MavCmd.DO_MOUNT_CONTROL, *params)
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
            else:
                return True
        mode = int(params[-1])
        self._talk.send(MountConfigure(self._talk.system_id, self._talk.component_id, mode, 1, 1, 1))
        return False

    # ----------------------------------------------------------------------------- receiving

    def _listen(self, message_type: type[Message], take: Callable[[Any], None]) -> None:
        bus = self._talk.connection.bus
        if bus.dialect.get(message_type.ID) is not None:
            self._talk.at_close(bus.attach(message_type, take, system_id=self._talk.system_id))

    def _on_device(self, message: GimbalDeviceAttitudeStatus) -> None:
        frame = message.received_frame
        number = (0 if frame is None else frame.component_id, message.gimbal_device_id)
        if self._first is None or number <= self._first:
            self._first = number
            self._tell(message, from_device(message, self._heading()))

    def _on_orientation(self, message: MountOrientation) -> None:
        if self._first is None:
            self._tell(message, from_orientation(message, self._heading()))

    def _tell(self, message: Message, attitude: GimbalAttitude) -> None:
        frame = message.received_frame
        component_id = self._talk.component_id if frame is None else frame.component_id
        self.attitude.set(attitude, Source(self._talk.system_id, component_id, message.NAME))

    def _heading(self) -> float | None:
        """Degrees clockwise from north in which the vehicle's nose points."""
        attitude = self._talk.telemetry.attitude.latest
        return None if attitude is None else attitude.yaw_deg

    def _forget(self) -> None:
        self._first = None
