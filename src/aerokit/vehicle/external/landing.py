"""Precision landing: a stream of target positions, the autopilot's landing mode, and a report of what was seen."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterable, Awaitable, Callable, Iterator
from inspect import isawaitable
from typing import TYPE_CHECKING, TypeAlias

import anyio

from aerokit._internal.arguments import check_kind, check_range
from aerokit._internal.values import Snapshot
from aerokit.errors import OperationTimeout, ValueUnknownError
from aerokit.mavlink.messages import Attitude, LocalPositionNed
from aerokit.vehicle.commanding.progress import await_progress
from aerokit.vehicle.commanding.streams import TakeoverCheck
from aerokit.vehicle.external.values import TargetMeasurement

if TYPE_CHECKING:
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.external.external import External
    from aerokit.vehicle.external.streams import MeasurementStream

__all__ = ["LandingReport", "TargetLoss", "TargetSource", "land_on"]

TargetSource: TypeAlias = (
    Callable[[], "TargetMeasurement | Awaitable[TargetMeasurement | None] | None"]
    | AsyncIterable["TargetMeasurement | None"]
)
"""Function that is called at the rate of the stream, or asynchronous iterable; None while the target is not visible."""

# A target that was not seen for this long counts as lost. ArduPilot's estimator keeps it for 2 s (AC_PrecLand.cpp).
LOST_AFTER_S = 1.0
POLL_INTERVAL_S = 0.2


class TargetLoss(Snapshot):
    """Time for which the target was not visible; ``height_m`` above home when it was last seen (None: unknown)."""

    seconds: float
    height_m: float | None


class LandingReport(Snapshot):
    """Course of a precision landing that has ended on the ground, disarmed.

    ``last_target`` is the last measurement, ``unseen_s`` its age at the end; a camera rarely sees the target from close
    by. ``losses`` are the times of more than a second without the target before that. ``climbed_m`` is how far the
    vehicle climbed in between: a retry of ArduPilot, a search of PX4. ``used_target`` is False if no measurement was
    sent during the descent, so that the vehicle landed wherever its firmware chose. ``texts`` are the vehicle's status
    texts.
    """

    last_target: TargetMeasurement | None
    unseen_s: float
    losses: tuple[TargetLoss, ...]
    climbed_m: float
    used_target: bool
    texts: tuple[str, ...]


class TargetTracker:
    """Reads the source of targets, gives each one to the stream and keeps what the report needs."""

    def __init__(self, context: VehicleContext, stream: MeasurementStream[TargetMeasurement], period_s: float) -> None:
        self._context, self._session, self._stream = context, context.session, stream
        self._period_s = period_s
        self.last: TargetMeasurement | None = None
        self.seen_at = -math.inf
        self._height_m: float | None = None
        self._lowest_m = math.inf
        self.climbed_m = 0.0
        self.losses: list[TargetLoss] = []
        self.error: Exception | None = None

    async def run(self, source: TargetSource) -> None:
        """Read the source until it ends or fails; `error` then has its exception."""
        try:
            if isinstance(source, AsyncIterable):
                async for target in source:
                    self._take(target)
                return
            while True:
                found = source()
                self._take(await found if isawaitable(found) else found)
                await anyio.sleep(self._period_s)
        except Exception as error:
            self.error = error

    @property
    def now(self) -> float:
        return self._session.connection.now()

    @property
    def height_m(self) -> float | None:
        """Height above home; None if unknown."""
        position = self._session.telemetry.position.latest
        return None if position is None else position.altitude_relative_m

    def watch_height(self) -> None:
        """Keep the largest climb above the lowest height so far."""
        height = self.height_m
        if height is not None:
            self._lowest_m = min(self._lowest_m, height)
            self.climbed_m = max(self.climbed_m, height - self._lowest_m)

    def _take(self, target: TargetMeasurement | None) -> None:
        if target is None:
            return
        check_kind("target", target, TargetMeasurement)
        with contextlib.suppress(ValueUnknownError):  # PX4's position was not received yet.
            self._stream.send(target)
            self._end_loss()
            self.last, self.seen_at, self._height_m = target, self.now, self.height_m

    def _end_loss(self) -> None:
        gap = self.now - self.seen_at
        if LOST_AFTER_S < gap < math.inf:
            self.losses.append(TargetLoss(gap, self._height_m))


async def land_on(
    context: VehicleContext,
    external: External,
    target: TargetSource,
    rate_hz: float,
    acquire_timeout: float,
    timeout: float | None,
    max_silence_s: float | None,
) -> LandingReport:
    """Land on a target; see :meth:`aerokit.Vehicle.land_on`."""
    check_range("acquire_timeout", acquire_timeout, 0, 3600, above=True)
    session = context.session
    mode = context.sender.mode_for("land_on", "precision_land")
    check = TakeoverCheck(context, mode)
    async with external.landing_target(rate_hz=rate_hz) as stream:
        tracker = TargetTracker(context, stream, 1 / rate_hz)
        reader = asyncio.get_running_loop().create_task(tracker.run(target))
        with _positions(context, rate_hz), session.streaming("position", "landed_state"):
            try:
                await _acquire(tracker, reader, acquire_timeout)
                check.raise_if_changed("land_on")
                sent_before = stream.sent
                order = context.arbiter.order(mode)
                await context.sender.change_mode(mode, order, reported_since=order.given_at)
                await _await_disarmed(context, tracker, order, timeout, max_silence_s)
            finally:
                await _stop(reader)
        unseen_s = tracker.now - tracker.seen_at
        return LandingReport(
            tracker.last,
            unseen_s,
            tuple(tracker.losses),
            tracker.climbed_m,
            stream.sent > sent_before,
            session.texts_since(order.given_at),
        )


async def _acquire(tracker: TargetTracker, reader: asyncio.Task[None], timeout: float) -> None:
    """Wait for the first sight of the target, before anything is ordered."""
    started = tracker.now
    while tracker.last is None:
        if tracker.error is not None:
            raise tracker.error
        if reader.done() or tracker.now - started >= timeout:
            waited = "" if reader.done() else f" within {timeout:g} s"
            raise OperationTimeout(f"land_on: the target was not seen{waited}; the landing was not ordered")
        await anyio.sleep(min(POLL_INTERVAL_S, timeout))


async def _await_disarmed(
    context: VehicleContext,
    tracker: TargetTracker,
    order: Order,
    timeout: float | None,
    max_silence_s: float | None,
) -> None:
    telemetry = context.session.telemetry
    stays = context.sender.stays_in(order, *order.modes)

    def is_down() -> bool:
        tracker.watch_height()
        if tracker.error is not None:
            raise tracker.error
        return telemetry.is_confirmed_disarmed and telemetry.armed.updated_at > order.given_at

    def trouble() -> str | None:
        if order.has_lost_mode and telemetry.armed.updated_at < order.mode_lost_at:
            return None  # The next HEARTBEAT may report that it has landed and disarmed.
        return stays()

    def describe() -> str:
        height = tracker.height_m
        where = "at an unknown height" if height is None else f"at {height:.1f} m"
        return f"it is {where}; the target was last seen {tracker.now - tracker.seen_at:.1f} s ago"

    await await_progress(
        context.session,
        "land_on",
        is_done=is_down,
        trouble=trouble,
        describe=describe,
        timeout=timeout,
        max_silence_s=max_silence_s,
    )


async def _stop(reader: asyncio.Task[None]) -> None:
    reader.cancel()
    with anyio.CancelScope(shield=True):
        await asyncio.wait([reader])


@contextlib.contextmanager
def _positions(context: VehicleContext, rate_hz: float) -> Iterator[None]:
    """Request attitude and local position at the rate of the targets, if the autopilot needs local targets."""
    session = context.session
    if not session.autopilot.external.target_is_local:
        yield
        return
    releases = [session.rates.request(kind, rate_hz, is_optional=True) for kind in (Attitude, LocalPositionNed)]
    try:
        yield
    finally:
        for release in releases:
            release()
