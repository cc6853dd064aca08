"""Turning a gimbal to angles, to its neutral position, and away."""

from __future__ import annotations

from aerokit.arguments import checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import GimbalDeviceFlags, MavMountMode
from aerokit.vehicle.checks import check_range
from aerokit.vehicle.gimbal.arrival import Aim, Rest, arrive, told_often
from aerokit.vehicle.gimbal.directions import straight
from aerokit.vehicle.gimbal.orders import LEVEL, LOCKED, NAN
from aerokit.vehicle.gimbal.part import GimbalPart
from aerokit.vehicle.gimbal.values import Frame, information_of

__all__ = ["PointActions"]

RETRACT, NEUTRAL = GimbalDeviceFlags.RETRACT, GimbalDeviceFlags.NEUTRAL


@checks_arguments
class PointActions(GimbalPart):
    """Orders by angles: of two the newer one counts."""

    async def point(
        self,
        pitch_deg: float,
        yaw_deg: float,
        *,
        roll_deg: float = 0.0,
        frame: Frame = "earth",
        wait: bool = True,
        tolerance_deg: float = 3.0,
        timeout: float = 10.0,
    ) -> None:
        """Turn it, and return when it tells that it points there.

        Args:
            pitch_deg: from the horizon, −360 to 360: 0 is level, −90 straight down.
            yaw_deg: −360 to 360, clockwise from north (``frame="earth"``) or from the vehicle's nose (``"vehicle"``).
            roll_deg: from the horizon, −360 to 360. If it is not 0, only the mount's command can do it, which turns the
                camera with the vehicle: a yaw from north is right at the moment of the order.
            frame: what the yaw counts from, and keeps to.
            wait: False: return when it was accepted.
            tolerance_deg: how near in each axis is there, above 0 to 45.
            timeout: seconds until it has to be there.

        Sends MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW; control is claimed when that is denied, until :meth:`release`.
        MAV_CMD_DO_MOUNT_CONTROL to a vehicle without a gimbal manager, and MOUNT_CONTROL, which has no answer, to one
        that does not know that either.

        Raises:
            InvalidArgument: an angle is out of range, or beyond the limits of the gimbal if :meth:`information` was
                asked for. Nothing was sent.
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: it was not there in time; the text says where it points.
            HeartbeatTimeout: the vehicle fell silent.
        """
        for name, value in (("pitch_deg", pitch_deg), ("yaw_deg", yaw_deg), ("roll_deg", roll_deg)):
            check_range(name, value, -360, 360)
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        from_nose = frame == "vehicle"
        self._check_limits(pitch_deg, roll_deg, yaw_deg if from_nose else None)
        orders, turn = self._orders, self._orders.begin()

        async def send() -> None:
            flags = LEVEL if from_nose else LOCKED
            # the gimbal manager's command has no roll
            if roll_deg or not await orders.manage(turn, pitch_deg, yaw_deg, flags=flags):
                await orders.mount_to(turn, pitch_deg, roll_deg, yaw_deg, from_nose=from_nose)

        wanted = straight(pitch_deg, yaw_deg, roll_deg or None, from_nose=from_nose)
        if not wait:
            await send()
            return
        with told_often(orders):
            since = self._now()
            await send()
            what = f"{orders.name}: point({pitch_deg:g}, {yaw_deg:g})"
            await arrive(orders, turn, what, Aim(lambda: wanted, tolerance_deg), since=since, timeout=timeout)

    async def neutral(self, *, wait: bool = True, timeout: float = 10.0) -> None:
        """Turn it to its neutral position, mostly level and straight ahead, and return when it rests there.

        Args:
            wait: False: return when it was accepted.
            timeout: seconds until it has to be there.

        Raises:
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: it was not there in time; the text says where it points.
            HeartbeatTimeout: the vehicle fell silent.
        """
        await self._rest("neutral", NEUTRAL, MavMountMode.NEUTRAL, wait=wait, timeout=timeout)

    async def retract(self, *, wait: bool = True, timeout: float = 10.0) -> None:
        """Put it away, and return when it rests there.

        Args:
            wait: False: return when it was accepted.
            timeout: seconds until it has to be there.

        Raises:
            NotSupported: its manager takes the order and does nothing (PX4). Nothing was sent.
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: control was lost in the block that has it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: it was not there in time; the text says where it points.
            HeartbeatTimeout: the vehicle fell silent.
        """
        if not self._orders.rules.retracts:
            self._orders.not_supported("retracts no gimbal")
        await self._rest("retract", RETRACT, MavMountMode.RETRACT, wait=wait, timeout=timeout)

    async def release(self) -> None:
        """Give it back to the pilot's sticks, and the control that was claimed without a block to whoever wants it.

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
        """
        turn = self._orders.begin()
        await self._orders.mount(turn, MavMountMode.RC_TARGETING)
        await self._orders.let_go(turn)

    async def _rest(self, what: str, flag: int, mode: int, *, wait: bool, timeout: float) -> None:
        orders, turn = self._orders, self._orders.begin()

        async def send() -> None:
            if not await orders.manage(turn, NAN, NAN, flags=flag):
                await orders.mount(turn, mode)

        if not wait:
            await send()
            return
        with told_often(orders):
            since = self._now()
            await send()
            there = Rest(flag, or_ahead=flag == NEUTRAL)
            await arrive(orders, turn, f"{orders.name}: {what}", there, since=since, timeout=timeout)

    def _check_limits(self, pitch: float, roll: float, yaw: float | None) -> None:
        device = self._orders.device
        if device.manager_information is None or not device.checks_limits:
            return
        limits = information_of(device.device_id, self._orders.manager_id, device.manager_information, None)
        checks = (("pitch_deg", pitch, limits.pitch_deg), ("yaw_deg", yaw, limits.yaw_deg))
        for name, angle, allowed in (*checks, ("roll_deg", roll or None, limits.roll_deg)):
            if angle is None or allowed is None or allowed[1] - allowed[0] >= 360:
                continue
            turns = (-360, 0, 360) if name == "yaw_deg" else (0,)
            if not any(allowed[0] <= angle + turn <= allowed[1] for turn in turns):
                text = f"{self._orders.name} turns from {allowed[0]:g} to {allowed[1]:g}"
                raise InvalidArgument(f"{name} = {angle:g} is not allowed: {text}")
