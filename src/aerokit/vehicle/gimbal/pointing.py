"""``PointingMixin``: pointing a gimbal at angles, its neutral and its retracted position."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import HeartbeatTimeout, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import GimbalDeviceFlags, MavMountMode
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S, POLL_INTERVAL_S, POSITION_MAX_AGE_S, ChangeSignal
from aerokit.vehicle.gimbal.device import YawFrame, information_of
from aerokit.vehicle.gimbal.orders import LEVEL, LOCKED, NAN, GimbalMixin
from aerokit.vehicle.session.session import ACTION_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.position import Position
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.gimbal.device import GimbalDevice
    from aerokit.vehicle.gimbal.orders import GimbalOrders

# A gimbal that turns by less than this angle in this time stands still; attitudes arrive about five times a second.
STILL_S, STILL_DEG = 0.4, 0.5

# Pitch, roll, yaw from north, yaw from the nose; None: any.
Angles = tuple[float | None, float | None, float | None, float | None]


class AngleTarget:
    """Angles to reach within a tolerance. ``wanted`` returns them, or None while they are unknown."""

    def __init__(self, wanted: Callable[[], Angles | None], tolerance_deg: float, unknown: str = "") -> None:
        self._wanted, self._tolerance_deg, self._unknown = wanted, tolerance_deg, unknown

    def is_reached(self, device: GimbalDevice) -> bool:
        attitude = device.attitude.value
        wanted = self._wanted()
        actual = (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_deg, attitude.yaw_from_nose_deg)
        return wanted is not None and all(
            want is None or (have is not None and abs(math.remainder(have - want, 360)) <= self._tolerance_deg)
            for want, have in zip(wanted, actual, strict=True)
        )

    def describe(self) -> str:
        wanted = self._wanted()
        return f"expected {_angles(wanted)}" if wanted is not None else self._unknown


class RestTarget:
    """A position reported by a flag (retracted, neutral), or straight ahead, in which the gimbal must stand still."""

    def __init__(self, flag: int, *, or_ahead: bool) -> None:
        self._flag, self._or_ahead = flag, or_ahead
        self._still_from: tuple[float, tuple[float, ...]] | None = None

    def is_reached(self, device: GimbalDevice) -> bool:
        attitude = device.attitude.value
        at = device.attitude.updated_at
        angles = tuple(angle or 0.0 for angle in (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_from_nose_deg))
        before = self._still_from
        if before is None or any(
            abs(math.remainder(new - old, 360)) > STILL_DEG for new, old in zip(angles, before[1], strict=True)
        ):
            self._still_from = (at, angles)
            return False
        is_ahead = self._or_ahead and all(abs(angle) <= 2 * STILL_DEG for angle in (angles[0], angles[2]))
        return at - before[0] >= STILL_S and bool(device.flags & self._flag or is_ahead)

    def describe(self) -> str:
        return "it has not reported that it rests there"


@contextmanager
def attitude_stream(orders: GimbalOrders) -> Iterator[None]:
    """Stream the attitude from the autopilot; gimbals with their own component id send it by themselves."""
    if orders.device.component_id not in (0, orders.session.component_id):
        yield
        return
    release = orders.session.rates.request(GimbalDeviceAttitudeStatus, ACTION_HZ, is_optional=True)
    try:
        yield
    finally:
        release()


async def wait_until_there(
    orders: GimbalOrders,
    order: Order,
    what: str,
    target: AngleTarget | RestTarget,
    *,
    since: float,
    timeout: float,
) -> None:
    """Wait until an attitude newer than ``since`` shows that the target is reached; errors as for `Gimbal.point`."""
    session, seen = orders.session, since
    until, reboots = session.connection.now() + timeout, orders.public_device.reboots
    cells = (orders.public_device.attitude, orders.attitude_source.attitude, orders.device.controllers)
    with orders.device.in_use(), ChangeSignal(session, *cells, every_arrival=True) as changes:
        while True:
            source = orders.attitude_source
            session.connection.raise_if_ended()
            if not order.is_newest or orders.public_device.reboots != reboots:
                reason = SUPERSEDED if orders.public_device.reboots == reboots else "the vehicle rebooted"
                raise OperationRejected(f"{what}: {reason}")
            orders.raise_if_taken()
            if source.attitude.is_known and source.attitude.updated_at > seen:
                seen = source.attitude.updated_at
                if target.is_reached(source):
                    return
            if session.watch.silent_for_s > MAX_SILENCE_S:
                raise HeartbeatTimeout(f"{what}: {session.describe_link()}")
            left = until - session.connection.now()
            if left <= 0:
                raise OperationTimeout(
                    f"{what}: not reached within {timeout:g} s: {_position(orders, since)}, {target.describe()};"
                    f" {session.describe_link()}"
                )
            await changes.next(min(POLL_INTERVAL_S, left))


def _position(orders: GimbalOrders, since: float) -> str:
    source, device = orders.attitude_source, orders.device
    cell = source.attitude
    if not cell.is_known:
        return f"the gimbal does not report its attitude (no {cell.waits_for})"
    attitude = cell.value
    angles = (attitude.pitch_deg, attitude.roll_deg, attitude.yaw_deg, attitude.yaw_from_nose_deg)
    text = f"it points to {_angles(angles)}"
    if cell.updated_at <= since:
        text += f", reported {cell.age:.1f} s ago, before the order"
    if device.failures:
        text += f", it reports {device.describe_failures()}"
    if device.manager_information is not None:
        limits = information_of(device.device_id, orders.manager_id, device.manager_information, None)
        text += f", its limits are pitch {_range(limits.pitch_deg)}, yaw {_range(limits.yaw_deg)}"
    return text


def _angles(angles: Angles) -> str:
    names = ("pitch", "roll", "yaw from north", "yaw from the nose")
    known = [f"{name} {angle:.1f}" for name, angle in zip(names, angles, strict=True) if angle is not None]
    return ", ".join(known) or "unknown angles"


def _range(limits: tuple[float, float] | None) -> str:
    return "unknown" if limits is None else f"{limits[0]:g} to {limits[1]:g}"


# Closer to straight up or down than this, yaw and roll are the same rotation.
MAX_PITCH_FOR_YAW_DEG = 89.0

# For targets nearer than this along the ground, the bearing is meaningless.
MIN_BEARING_DISTANCE_M = 1.0


def ordered_angles(pitch: float, yaw: float, roll: float | None, *, from_nose: bool) -> Angles:
    """Return the angles of an order; None for the yaw when pointing straight down or up, where any yaw is right."""
    is_upright = abs(pitch) > MAX_PITCH_FOR_YAW_DEG
    turned = None if is_upright else yaw
    return (pitch, roll, None if from_nose else turned, turned if from_nose else None)


def direction_to(context: VehicleContext, target: Position) -> Angles | None:
    """Direction from the vehicle to a position; None while its own position or the height difference is unknown."""
    cell = context.session.telemetry.position
    here = cell.latest
    if here is None or cell.age > POSITION_MAX_AGE_S:
        return None
    pairs = (
        (target.altitude_relative_m, here.altitude_relative_m),
        (target.altitude_amsl_m, here.altitude_amsl_m),
    )
    up = next((theirs - own for theirs, own in pairs if theirs is not None and own is not None), None)
    if up is None:
        if target.altitude_relative_m is not None or target.altitude_amsl_m is not None:
            return None
        up = 0.0
    along = here.distance_to(target)
    pitch = math.degrees(math.atan2(up, along))
    return (
        pitch,
        None,
        here.bearing_to(target) if along > MIN_BEARING_DISTANCE_M and abs(pitch) <= MAX_PITCH_FOR_YAW_DEG else None,
        None,
    )


RETRACT, NEUTRAL = GimbalDeviceFlags.RETRACT, GimbalDeviceFlags.NEUTRAL


@checks_arguments
class PointingMixin(GimbalMixin):
    """Orders by angles. A newer order ends the previous one."""

    async def point(
        self,
        pitch_deg: float,
        yaw_deg: float,
        *,
        roll_deg: float = 0.0,
        frame: YawFrame = "earth",
        wait: bool = True,
        tolerance_deg: float = 3.0,
        timeout: float = 10.0,
    ) -> None:
        """Point the gimbal at angles; returns when it reports these angles.

        Args:
            pitch_deg: from the horizon, −360 to 360: 0 is level, −90 straight down.
            yaw_deg: −360 to 360, clockwise from north (``frame="earth"``) or from the nose (``"vehicle"``).
            roll_deg: from the horizon, −360 to 360. A roll other than 0 needs the mount command, whose yaw turns with
                the vehicle: a yaw from north is right only at the time of the order.
            frame: reference of the yaw, which the gimbal keeps afterwards.
            wait: False: return when the manager has accepted the order.
            tolerance_deg: accepted deviation in each axis, above 0 to 45.
            timeout: seconds to wait.

        Sends MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW. If it is denied, aerokit claims control until :meth:`release`. A
        vehicle without a gimbal manager gets MAV_CMD_DO_MOUNT_CONTROL, and one that does not support that either gets
        MOUNT_CONTROL, which is not acknowledged.

        Raises:
            InvalidArgument: an angle is out of range, or beyond the limits of the gimbal if :meth:`information` was
                called before. Nothing was sent.

        Otherwise raises as :meth:`neutral`.
        """
        for name, value in (("pitch_deg", pitch_deg), ("yaw_deg", yaw_deg), ("roll_deg", roll_deg)):
            check_range(name, value, -360, 360)
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        from_nose = frame == "vehicle"
        self._check_limits(pitch_deg, roll_deg, yaw_deg if from_nose else None)
        orders, order = self._orders, self._orders.begin_order()

        async def send() -> None:
            flags = LEVEL if from_nose else LOCKED
            # The gimbal manager's command has no roll.
            if roll_deg or not await orders.send_pitch_yaw(order, pitch_deg, yaw_deg, flags=flags):
                await orders.send_mount_angles(order, pitch_deg, roll_deg, yaw_deg, from_nose=from_nose)

        wanted = ordered_angles(pitch_deg, yaw_deg, roll_deg or None, from_nose=from_nose)
        if not wait:
            await send()
            return
        with attitude_stream(orders):
            since = self._now()
            await send()
            what = f"{orders.name}: point({pitch_deg:g}, {yaw_deg:g})"
            target = AngleTarget(lambda: wanted, tolerance_deg)
            await wait_until_there(orders, order, what, target, since=since, timeout=timeout)

    async def neutral(self, *, wait: bool = True, timeout: float = 10.0) -> None:
        """Turn the gimbal to its neutral position, usually level and straight ahead; returns when it rests there.

        Args:
            wait: False: return when the manager has accepted the order.
            timeout: seconds to wait.

        Raises:
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: your program had control and lost it.
            OperationRejected: another order was given meanwhile, or the vehicle rebooted.
            OperationTimeout: the gimbal did not reach the direction in time; the text has the last attitude.
            HeartbeatTimeout: the vehicle fell silent.
        """
        await self._rest("neutral", NEUTRAL, MavMountMode.NEUTRAL, wait=wait, timeout=timeout)

    async def retract(self, *, wait: bool = True, timeout: float = 10.0) -> None:
        """Retract the gimbal; returns when it rests in the retracted position.

        Args:
            wait: False: return when the manager has accepted the order.
            timeout: seconds to wait.

        Raises:
            NotSupported: the manager would accept the order but not execute it (PX4). Nothing was sent.

        Otherwise raises as :meth:`neutral`.
        """
        if not self._orders.rules.supports_retract:
            self._orders.raise_not_supported("cannot retract a gimbal")
        await self._rest("retract", RETRACT, MavMountMode.RETRACT, wait=wait, timeout=timeout)

    async def release(self) -> None:
        """Return the gimbal to the pilot's sticks, and release control that was claimed outside of a control block.

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
        """
        order = self._orders.begin_order()
        await self._orders.send_mount_mode(order, MavMountMode.RC_TARGETING)
        await self._orders.release_control(order)

    async def _rest(self, what: str, flag: int, mode: int, *, wait: bool, timeout: float) -> None:
        orders, order = self._orders, self._orders.begin_order()

        async def send() -> None:
            if not await orders.send_pitch_yaw(order, NAN, NAN, flags=flag):
                await orders.send_mount_mode(order, mode)

        if not wait:
            await send()
            return
        with attitude_stream(orders):
            since = self._now()
            await send()
            target = RestTarget(flag, or_ahead=flag == NEUTRAL)
            await wait_until_there(orders, order, f"{orders.name}: {what}", target, since=since, timeout=timeout)

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
