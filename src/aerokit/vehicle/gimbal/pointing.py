"""Turning a gimbal to angles, to its neutral position, and away."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import HeartbeatTimeout, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import GimbalDeviceFlags, MavMountMode
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.commanding.order import OVERRULED
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, OLD_POSITION_S, TICK_S, Arrivals
from aerokit.vehicle.gimbal.device import Frame, information_of
from aerokit.vehicle.gimbal.orders import LEVEL, LOCKED, NAN, GimbalPart
from aerokit.vehicle.session.session import ACTION_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.position import Position
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.gimbal.device import Device
    from aerokit.vehicle.gimbal.orders import GimbalOrders

STILL_S, STILL_DEG = 0.4, 0.5
"""What turns by less in so long is taken to stand still: attitudes come five times a second or so."""

Wanted = tuple[float | None, float | None, float | None, float | None]
"""Pitch, roll, yaw from north, yaw from the nose; None: any."""


class Aim:
    """Whether it points somewhere, within a tolerance; ``where`` is asked each time, None: that is not known."""

    def __init__(self, where: Callable[[], Wanted | None], tolerance_deg: float, unknown: str = "") -> None:
        self._where, self._tolerance_deg, self._unknown = where, tolerance_deg, unknown

    def __call__(self, device: Device) -> bool:
        """Whether it is there."""
        attitude = device.attitude.value
        wanted = self._where()
        told = (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_deg, attitude.yaw_from_nose_deg)
        return wanted is not None and all(
            want is None
            or (have is not None and abs(math.remainder(have - want, 360)) <= self._tolerance_deg)
            for want, have in zip(wanted, told, strict=True)
        )

    def describe(self) -> str:
        """What was wanted."""
        wanted = self._where()
        return f"wanted was {_angles(wanted)}" if wanted is not None else self._unknown


class Rest:
    """Whether it does what a flag says (retracted, neutral), or looks straight ahead if that will do, and stands."""

    def __init__(self, flag: int, *, or_ahead: bool) -> None:
        self._flag, self._or_ahead = flag, or_ahead
        self._still_from: tuple[float, tuple[float, ...]] | None = None

    def __call__(self, device: Device) -> bool:
        """Whether it is there."""
        attitude = device.attitude.value
        at = device.attitude.updated_at
        angles = tuple(
            each or 0.0 for each in (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_from_nose_deg)
        )
        before = self._still_from
        if before is None or any(
            abs(math.remainder(one - other, 360)) > STILL_DEG
            for one, other in zip(angles, before[1], strict=True)
        ):
            self._still_from = (at, angles)
            return False
        is_ahead = self._or_ahead and all(abs(each) <= 2 * STILL_DEG for each in (angles[0], angles[2]))
        return at - before[0] >= STILL_S and bool(device.flags & self._flag or is_ahead)

    def describe(self) -> str:
        """What was wanted."""
        return "and has not told that it rests there"


@contextmanager
def told_often(orders: GimbalOrders) -> Iterator[None]:
    """Have the autopilot tell where its gimbals point; one with an id of its own does so by itself."""
    if orders.device.component_id not in (0, orders.talk.component_id):
        yield
        return
    release = orders.talk.rates.want(GimbalDeviceAttitudeStatus, ACTION_HZ, is_optional=True)
    try:
        yield
    finally:
        release()


async def arrive(
    orders: GimbalOrders, turn: Order, what: str, is_there: Aim | Rest, *, since: float, timeout: float
) -> None:
    """Return when it is there, told by an attitude that came after ``since``.

    Raises:
        OperationRejected: another order was given, or the vehicle has rebooted.
        GimbalTaken: control was lost in the block that has it.
        HeartbeatTimeout: the vehicle is silent.
        OperationTimeout: it was not there in time; the text says where it points.
    """
    talk, seen = orders.talk, since
    until, boots = talk.connection.now() + timeout, orders.shown.boots
    cells = (orders.shown.attitude, orders.told.attitude, orders.device.controllers)
    with orders.device.in_use(), Arrivals(talk, *cells, every_arrival=True) as news:
        while True:
            told = orders.told
            talk.connection.raise_if_ended()
            if not turn.is_newest or orders.shown.boots != boots:
                reason = OVERRULED if orders.shown.boots == boots else "the vehicle rebooted"
                raise OperationRejected(f"{what}: {reason}")
            orders.raise_if_taken()
            if told.attitude.is_known and told.attitude.updated_at > seen:
                seen = told.attitude.updated_at
                if is_there(told):
                    return
            if talk.watch.silent_for_s > LONGEST_SILENCE_S:
                raise HeartbeatTimeout(f"{what}: {talk.describe_link()}")
            left = until - talk.connection.now()
            if left <= 0:
                raise OperationTimeout(
                    f"{what}: not there within {timeout:g} s: {_where(orders, since)}, {is_there.describe()};"
                    f" {talk.describe_link()}"
                )
            await news.next(min(TICK_S, left))


def _where(orders: GimbalOrders, since: float) -> str:
    """Where it points, what it can do, what fails."""
    told, device = orders.told, orders.device
    if not told.attitude.is_known:
        return f"it does not tell where it points (no {told.attitude.waits_for})"
    cell = told.attitude
    attitude = cell.value
    angles = (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_deg, attitude.yaw_from_nose_deg)
    text = f"it points to {_angles(angles)}"
    if cell.updated_at <= since:
        text += f", told {cell.age:.1f} s ago and not since the order"
    if device.failures:
        text += f", it says: {device.describe_failures()}"
    if device.manager_information is not None:
        limits = information_of(device.device_id, orders.manager_id, device.manager_information, None)
        text += f", its limits are pitch {_range(limits.pitch_deg)}, yaw {_range(limits.yaw_deg)}"
    return text


def _angles(angles: Wanted) -> str:
    names = ("pitch", "roll", "yaw from north", "yaw from the nose")
    told = [f"{name} {each:.1f}" for name, each in zip(names, angles, strict=True) if each is not None]
    return ", ".join(told) or "nowhere that it knows"


def _range(limits: tuple[float, float] | None) -> str:
    return "unknown" if limits is None else f"{limits[0]:g} to {limits[1]:g}"


UPRIGHT_DEG = 89.0
"""Of a camera that looks straighter up or down, all turning is yaw."""

NEAR_M = 1.0
"""Nearer than this along the ground, any yaw will do."""


def straight(pitch: float, yaw: float, roll: float | None, *, from_nose: bool) -> Wanted:
    """Angles as they were ordered; of a camera that looks straight down or up, the yaw is anybody's."""
    is_upright = abs(pitch) > UPRIGHT_DEG
    turned = None if is_upright else yaw
    return (pitch, roll, None if from_nose else turned, turned if from_nose else None)


def direction_to(bridge: Bridge, target: Position) -> Wanted | None:
    """From where the vehicle is now; None while that is not known, or which of the two is higher."""
    cell = bridge.talk.telemetry.position
    here = cell.latest
    if here is None or cell.age > OLD_POSITION_S:
        return None
    pairs = (
        (target.altitude_relative_m, here.altitude_relative_m),
        (target.altitude_amsl_m, here.altitude_amsl_m),
    )
    up = next((its - own for its, own in pairs if its is not None and own is not None), None)
    if up is None:
        if target.altitude_relative_m is not None or target.altitude_amsl_m is not None:
            return None
        up = 0.0
    along = here.distance_to(target)
    pitch = math.degrees(math.atan2(up, along))
    return (
        pitch,
        None,
        here.bearing_to(target) if along > NEAR_M and abs(pitch) <= UPRIGHT_DEG else None,
        None,
    )


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
