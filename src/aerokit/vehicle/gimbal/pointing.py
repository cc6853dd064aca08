"""``PointingMixin``: pointing a gimbal at angles, its neutral and its retracted position."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import GimbalDeviceErrorFlags, GimbalDeviceFlags, MavMountMode
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.commanding.order import REBOOTED, SUPERSEDED
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
    from aerokit.vehicle.state.equipment import GimbalAttitude

# A gimbal that turns by less than this angle (degrees) in this time (seconds) stands still. Attitudes arrive about five
# times a second.
STILL_S, STILL_DEG = 0.4, 0.5


class Angles(NamedTuple):
    """Angles in degrees. In an attitude, None is an unknown angle. In a target, None accepts any angle."""

    pitch: float | None
    roll: float | None
    yaw_from_north: float | None
    yaw_from_nose: float | None


class AngleTarget:
    """Target of an order: angles to reach within a tolerance.

    ``target_angles`` returns the angles, or None while they are unknown; ``why_unknown`` is the text for this case.
    """

    def __init__(self, target_angles: Callable[[], Angles | None], tolerance_deg: float, why_unknown: str = "") -> None:
        self._target_angles, self._tolerance_deg, self._why_unknown = target_angles, tolerance_deg, why_unknown

    def is_reached(self, device: GimbalDevice) -> bool:
        targets = self._target_angles()
        if targets is None:
            return False
        angles = _angles_of(device.attitude.value)
        return all(self._is_near(angle, target) for angle, target in zip(angles, targets, strict=True))

    def _is_near(self, angle: float | None, target: float | None) -> bool:
        if target is None:  # Any angle is accepted.
            return True
        return angle is not None and abs(math.remainder(angle - target, 360)) <= self._tolerance_deg

    def describe(self) -> str:
        targets = self._target_angles()
        return f"expected {_format_angles(targets)}" if targets is not None else self._why_unknown


class RestTarget:
    """Target of an order: the gimbal stands still in its retracted or neutral position.

    ``flag`` is the GIMBAL_DEVICE_FLAGS bit that reports this position. Some gimbals do not report it. With
    ``accepts_ahead``, a gimbal that is level and points straight ahead counts as being in this position.
    """

    def __init__(self, flag: int, *, accepts_ahead: bool) -> None:
        self._flag = flag
        self._accepts_ahead = accepts_ahead
        # Angles (pitch, roll, yaw from the nose) at the last movement, and its time.
        self._last_angles: tuple[float, float, float] | None = None
        self._moved_at = 0.0

    def is_reached(self, device: GimbalDevice) -> bool:
        """Return True if the gimbal has stood still for STILL_S in its rest position."""
        attitude, updated_at = device.attitude.value, device.attitude.updated_at
        pitch, roll, yaw = attitude.pitch_deg or 0.0, attitude.roll_deg or 0.0, attitude.yaw_from_nose_deg or 0.0
        if self._has_moved((pitch, roll, yaw)):
            self._last_angles = (pitch, roll, yaw)
            self._moved_at = updated_at
            return False
        is_ahead = self._is_direction_known(device) and abs(pitch) <= 2 * STILL_DEG and abs(yaw) <= 2 * STILL_DEG
        is_at_rest = bool(device.flags & self._flag) or (self._accepts_ahead and is_ahead)
        return updated_at - self._moved_at >= STILL_S and is_at_rest

    def _is_direction_known(self, device: GimbalDevice) -> bool:
        attitude, source = device.attitude.value, device.attitude.source
        # MOUNT_STATUS has no yaw from the nose, so its pitch is sufficient.
        has_no_yaw = source is not None and source.message == "MOUNT_STATUS"
        return attitude.pitch_deg is not None and (attitude.yaw_from_nose_deg is not None or has_no_yaw)

    def _has_moved(self, angles: tuple[float, float, float]) -> bool:
        if self._last_angles is None:
            return True
        turns = [math.remainder(new - old, 360) for new, old in zip(angles, self._last_angles, strict=True)]
        return any(abs(turn) > STILL_DEG for turn in turns)

    def describe(self) -> str:
        return "and has not reported that it rests in this position"


@contextmanager
def attitude_stream(orders: GimbalOrders) -> Iterator[None]:
    session = orders.session
    with ExitStack() as requests:
        # The vehicle's attitude is needed to convert yaw angles.
        requests.enter_context(session.streaming("attitude"))
        # Gimbals with their own component id send their attitude without a request.
        if orders.device.component_id in (0, session.component_id):
            requests.callback(session.rates.request(GimbalDeviceAttitudeStatus, ACTION_HZ, is_optional=True))
        yield


async def wait_until_reached(
    orders: GimbalOrders,
    order: Order,
    description: str,
    target: AngleTarget | RestTarget,
    *,
    since: float,
    timeout: float,
) -> None:
    """Wait until an attitude newer than ``since`` shows that the target is reached.

    Raises the errors of `Gimbal.point`.
    """
    session = orders.session
    accepted_at = session.connection.now()
    deadline = accepted_at + timeout
    checked_at = since  # time of the last attitude that was checked
    # Compare the reboots of `public_device`, because `attitude_source` and `device` may become other gimbals.
    reboots_before = orders.public_device.reboots
    watched = (orders.public_device.attitude, orders.attitude_source.attitude, orders.device.controllers)
    with orders.device.in_use(), ChangeSignal(session, *watched, every_arrival=True) as changes:
        while True:
            source = orders.attitude_source
            session.end.raise_if_ended()
            has_rebooted = orders.public_device.reboots != reboots_before
            if not order.is_newest or has_rebooted:
                reason = REBOOTED if has_rebooted else SUPERSEDED
                raise OperationRejected(f"{description}: {reason}")
            orders.raise_if_taken()
            orders.raise_if_refused(description, accepted_at)
            if source.attitude.is_known and source.attitude.updated_at > checked_at:
                checked_at = source.attitude.updated_at
                if target.is_reached(source):
                    return
            if session.watch.silent_for_s > MAX_SILENCE_S:
                raise HeartbeatTimeout(f"{description}: {session.describe_link()}")
            remaining_s = deadline - session.connection.now()
            if remaining_s <= 0:
                raise OperationTimeout(
                    f"{description}: the target was not reached within {timeout:g} s: {_describe_state(orders, since)},"
                    f" {target.describe()}; {session.describe_link()}"
                )
            await changes.next(min(POLL_INTERVAL_S, remaining_s))


def _describe_state(orders: GimbalOrders, since: float) -> str:
    source, device = orders.attitude_source, orders.device
    attitude = source.attitude
    if not attitude.is_known:
        return f"the gimbal does not report its attitude (no {attitude.waits_for})"
    text = f"the gimbal points to {_format_angles(_angles_of(attitude.value))}"
    if attitude.updated_at <= since:
        text += f", reported {attitude.age:.1f} s ago, before the order"
    if device.failures:
        text += f", its failures are {GimbalDeviceErrorFlags(device.failures).name or device.failures}"
    if device.manager_information is not None:
        limits = information_of(device.device_id, orders.manager_id, device.manager_information, device=None)
        text += f", its limits are pitch {_format_limits(limits.pitch_deg)}, yaw {_format_limits(limits.yaw_deg)}"
    return text


def _angles_of(attitude: GimbalAttitude) -> Angles:
    return Angles(attitude.pitch_deg, attitude.roll_deg, attitude.yaw_deg, attitude.yaw_from_nose_deg)


def _format_angles(angles: Angles) -> str:
    names = ("pitch", "roll", "yaw from north", "yaw from the nose")
    known = [f"{name} {angle:.1f}" for name, angle in zip(names, angles, strict=True) if angle is not None]
    return ", ".join(known) or "unknown angles"


def _format_limits(limits: tuple[float, float] | None) -> str:
    if limits is None:
        return "unknown"
    lowest, highest = limits
    return f"{lowest:g} to {highest:g}"


# Beyond this pitch up or down, yaw and roll are the same rotation.
MAX_PITCH_FOR_YAW_DEG = 89.0

# The bearing to a target that is nearer than this along the ground is meaningless.
MIN_BEARING_DISTANCE_M = 1.0


def ordered_angles(pitch: float, yaw: float, roll: float | None, *, from_nose: bool) -> Angles:
    """Return the angles of an order. None stands for any angle."""
    is_vertical = abs(pitch) > MAX_PITCH_FOR_YAW_DEG
    # If the gimbal points straight down or up, any yaw is accepted.
    from_north_deg = None if from_nose or is_vertical else yaw
    from_nose_deg = yaw if from_nose and not is_vertical else None
    return Angles(pitch, roll, from_north_deg, from_nose_deg)


def direction_to(context: VehicleContext, target: Position) -> Angles | None:
    """Return the direction from the vehicle to a position, or None while it is unknown."""
    position = context.session.telemetry.position
    here = position.latest
    if here is None or position.age > POSITION_MAX_AGE_S:
        return None
    height_m = _height_above(here, target)
    if height_m is None:
        return None
    distance_m = here.distance_to(target)
    pitch = math.degrees(math.atan2(height_m, distance_m))
    has_bearing = distance_m > MIN_BEARING_DISTANCE_M and abs(pitch) <= MAX_PITCH_FOR_YAW_DEG
    yaw_from_north = here.bearing_to(target) if has_bearing else None
    # Any roll is accepted, and the yaw is checked from north only.
    return Angles(pitch, roll=None, yaw_from_north=yaw_from_north, yaw_from_nose=None)


def _height_above(here: Position, target: Position) -> float | None:
    if target.altitude_relative_m is None and target.altitude_amsl_m is None:
        # A target without an altitude counts as being at the height of the vehicle.
        return 0.0
    if target.altitude_relative_m is not None and here.altitude_relative_m is not None:
        return target.altitude_relative_m - here.altitude_relative_m
    if target.altitude_amsl_m is not None and here.altitude_amsl_m is not None:
        return target.altitude_amsl_m - here.altitude_amsl_m
    return None


RETRACT, NEUTRAL = GimbalDeviceFlags.RETRACT, GimbalDeviceFlags.NEUTRAL


@checks_arguments
class PointingMixin(GimbalMixin):
    """Orders that point the gimbal at angles. A newer order ends the previous one."""

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
            roll_deg: from the horizon, −360 to 360. A roll other than 0 is sent by the older mount command. The gimbal
                then turns with the vehicle, so a yaw from north is correct only at the time of the order.
            frame: reference of the yaw. Afterwards the gimbal keeps its yaw from north (``"earth"``), or it turns with
                the vehicle (``"vehicle"``). After a mount command (see below), it always turns with the vehicle.
            wait: False: return when the manager has accepted the order.
            tolerance_deg: accepted deviation in each axis, above 0 and at most 45.
            timeout: seconds to wait.

        Sends MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW. If the manager denies it, aerokit claims control until
        :meth:`release`. A vehicle without a gimbal manager gets MAV_CMD_DO_MOUNT_CONTROL. If the vehicle does not
        support that command either, it gets MOUNT_CONTROL, which is not acknowledged.

        Raises:
            InvalidArgument: an angle or the tolerance is out of range, or an angle is beyond the limits of the gimbal
                if :meth:`information` was called before. Nothing was sent.

        Otherwise raises as :meth:`neutral`.
        """
        for name, value in (("pitch_deg", pitch_deg), ("yaw_deg", yaw_deg), ("roll_deg", roll_deg)):
            check_range(name, value, -360, 360)
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        from_nose = frame == "vehicle"
        self._check_limits(pitch_deg, roll_deg, yaw_deg if from_nose else None)
        orders = self._orders
        order = orders.begin_order()

        async def send() -> None:
            flags = LEVEL if from_nose else LOCKED
            # The gimbal manager's command has no roll, so an order with roll uses the mount command.
            if roll_deg == 0 and await orders.send_pitch_yaw(order, pitch_deg, yaw_deg, flags=flags):
                return
            await orders.send_mount_angles(order, pitch_deg, roll_deg, yaw_deg, from_nose=from_nose)

        if not wait:
            await send()
            return
        # Without an ordered roll, any roll is accepted.
        angles = ordered_angles(pitch_deg, yaw_deg, roll_deg or None, from_nose=from_nose)
        with attitude_stream(orders):
            since = self._now()
            await send()
            description = f"{orders.name}: point({pitch_deg:g}, {yaw_deg:g})"
            target = AngleTarget(lambda: angles, tolerance_deg)
            await wait_until_reached(orders, order, description, target, since=since, timeout=timeout)

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
            raise self._orders.not_supported("cannot retract a gimbal")
        await self._rest("retract", RETRACT, MavMountMode.RETRACT, wait=wait, timeout=timeout)

    async def release(self) -> None:
        """Return the gimbal to the pilot's sticks, and release control that was claimed outside of a control block.

        Raises:
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no answer.
            GimbalTaken: your program had control and lost it. Nothing was sent.
            OperationRejected: another order was given meanwhile.
        """
        order = self._orders.begin_order()
        try:
            await self._orders.send_mount_mode(order, MavMountMode.RC_TARGETING)
        except (CommandRejected, CommandTimeout):
            await self._orders.release_control(order)
            raise
        await self._orders.release_control(order)

    async def _rest(self, action: str, flag: int, mode: int, *, wait: bool, timeout: float) -> None:
        """Turn the gimbal to a rest position. An older mount gets ``mode`` instead of ``flag``."""
        orders = self._orders
        order = orders.begin_order()

        async def send() -> None:
            is_supported = await orders.send_pitch_yaw(order, NAN, NAN, flags=flag)
            if not is_supported:
                await orders.send_mount_mode(order, mode)

        if not wait:
            await send()
            return
        with attitude_stream(orders):
            since = self._now()
            await send()
            target = RestTarget(flag, accepts_ahead=flag == NEUTRAL)  # The neutral position is usually straight ahead.
            await wait_until_reached(orders, order, f"{orders.name}: {action}", target, since=since, timeout=timeout)

    def _check_limits(self, pitch: float, roll: float, yaw: float | None) -> None:
        """Raise InvalidArgument for an angle beyond the limits. ``yaw`` is from the nose; None is not checked."""
        device = self._orders.device
        if device.manager_information is None or not device.checks_limits:
            return  # The program has not requested the limits by `information()`.
        limits = information_of(device.device_id, self._orders.manager_id, device.manager_information, device=None)
        checks = (
            ("pitch_deg", pitch, limits.pitch_deg),
            ("yaw_deg", yaw, limits.yaw_deg),
            ("roll_deg", roll or None, limits.roll_deg),  # A roll of 0 is always allowed.
        )
        for name, angle, allowed in checks:
            if angle is None or allowed is None:
                continue
            lowest, highest = allowed
            # The same yaw may be written as −90 or 270.
            turns = (-360, 0, 360) if name == "yaw_deg" else (0,)
            is_allowed = any(lowest <= angle + turn <= highest for turn in turns)
            if not is_allowed and highest - lowest < 360:  # A gimbal that turns all the way round reaches every angle.
                text = f"{self._orders.name} turns from {lowest:g} to {highest:g}"
                raise InvalidArgument(f"{name} = {angle:g} is not allowed: {text}")
