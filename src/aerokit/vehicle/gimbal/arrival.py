"""Waiting until a gimbal points where it was told to, as it tells by itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.errors import HeartbeatTimeout, OperationRejected, OperationTimeout
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.gimbal.values import information_of
from aerokit.vehicle.orders.newest import OVERRULED
from aerokit.vehicle.orders.progress import LONGEST_SILENCE_S, TICK_S, Arrivals
from aerokit.vehicle.talk.talk import ACTION_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.vehicle.gimbal.device import Device
    from aerokit.vehicle.gimbal.orders import GimbalOrders
    from aerokit.vehicle.orders.newest import Turn

__all__ = ["Aim", "Rest", "arrive", "told_often"]

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
    orders: GimbalOrders, turn: Turn, what: str, is_there: Aim | Rest, *, since: float, timeout: float
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
