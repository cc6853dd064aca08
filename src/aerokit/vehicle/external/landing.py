"""Precision landing: streams target positions, changes to the landing mode, and reports how the landing went."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterable, Awaitable, Callable
from inspect import isawaitable
from typing import TYPE_CHECKING, TypeAlias

import anyio

from aerokit._internal.arguments import check_kind, check_range
from aerokit._internal.values import Snapshot
from aerokit.errors import OperationTimeout, ValueUnknownError
from aerokit.vehicle.commanding.ground import GroundCheck
from aerokit.vehicle.commanding.progress import await_progress
from aerokit.vehicle.commanding.streams import TakeoverCheck
from aerokit.vehicle.external.values import TargetMeasurement
from aerokit.vehicle.state.telemetry import altitude_amsl, height_above_home

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
"""A function that is called at the rate of the stream, or an asynchronous iterable.

Both supply a measurement, or None while no target is visible.
"""

# A target counts as lost after this time without a measurement. ArduPilot's estimator keeps a target for 2 s
# (AC_PrecLand.cpp).
LOST_AFTER_S = 1.0
POLL_INTERVAL_S = 0.2


class TargetLoss(Snapshot):
    """One period in which the target was not visible.

    ``height_m`` is the vehicle's height above home at the start of the period; None if unknown.
    """

    seconds: float
    height_m: float | None


class LandingReport(Snapshot):
    """Report of a precision landing, made when the vehicle is on the ground and disarmed.

    ``last_target`` is the last measurement. ``unseen_s`` is its age at the end, usually above 0, because a camera
    rarely sees the target from close by. ``losses`` are the periods of more than a second without the target, except
    the one before the end. ``climbed_m`` is how far the vehicle climbed during the landing, when it retried (ArduPilot)
    or searched for the target (PX4). ``used_target`` is False if no measurement was sent during the descent; the
    vehicle then landed where its firmware chose. ``texts`` are the vehicle's status texts since the order.
    """

    last_target: TargetMeasurement | None
    unseen_s: float
    losses: tuple[TargetLoss, ...]
    climbed_m: float
    used_target: bool
    texts: tuple[str, ...]


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
    session, mode = context.session, context.sender.mode_for("land_on", "precision_land")
    takeover_check = TakeoverCheck(context, mode)
    # PX4 requires targets in the local frame. These states are needed to convert them.
    local_states = ("attitude", "local_position") if session.autopilot.external.target_is_local else ()
    async with external.landing_target(rate_hz=rate_hz) as stream:
        landing = TargetLanding(context, stream)
        with session.streaming(*local_states, hz=rate_hz), session.streaming("position", "landed_state"):
            reader = asyncio.get_running_loop().create_task(landing.read(target, 1 / rate_hz))
            try:
                await landing.acquire(reader, acquire_timeout)
                takeover_check.raise_if_changed("land_on")
                sent_before = stream.sent
                order = context.arbiter.order(mode)
                await context.sender.change_mode(mode, order, reported_since=order.given_at)
                await landing.await_disarmed(order, timeout, max_silence_s)
            finally:
                reader.cancel()
                # The shield makes even a cancelled call wait until the program's source has ended.
                with anyio.CancelScope(shield=True):
                    await asyncio.wait([reader])
        return landing.report(was_target_sent=stream.sent > sent_before, texts=session.texts_since(order.given_at))


class TargetLanding:
    """Passes the targets from their source to the stream, and collects the data of the report."""

    def __init__(self, context: VehicleContext, stream: MeasurementStream[TargetMeasurement]) -> None:
        self._context = context
        self._session = context.session
        self._stream = stream
        # The last measurement that was passed to the stream.
        self._last: TargetMeasurement | None = None
        # When the target was last visible, and the vehicle's height at that time.
        self._seen_at = -math.inf
        self._seen_height_m: float | None = None
        self._lowest_m = math.inf
        self._climbed_m = 0.0
        self._losses: list[TargetLoss] = []
        # The exception that the program's source of measurements has raised.
        self._source_error: Exception | None = None

    async def read(self, source: TargetSource, period_s: float) -> None:
        """Read the source until it ends. If it raises, `acquire` or `await_disarmed` raises the exception."""
        try:
            if isinstance(source, AsyncIterable):
                async for target in source:
                    self._on_target(target)
                return
            while True:
                result = source()
                self._on_target(await result if isawaitable(result) else result)
                await anyio.sleep(period_s)
        except Exception as error:
            self._source_error = error
        finally:
            if isinstance(source, AsyncGenerator):  # The generator may have a camera open.
                await source.aclose()

    async def acquire(self, reader: asyncio.Task[None], timeout: float) -> None:
        """Wait until the target is visible for the first time."""
        started = self._now()
        while self._last is None:
            self._raise_if_source_failed()
            has_source_ended = reader.done()
            if has_source_ended or self._now() - started >= timeout:
                when = "before the source of targets ended" if has_source_ended else f"within {timeout:g} s"
                raise OperationTimeout(f"land_on: the target was not seen {when}; the landing was not ordered")
            await anyio.sleep(min(POLL_INTERVAL_S, timeout))

    async def await_disarmed(self, order: Order, timeout: float | None, max_silence_s: float | None) -> None:
        telemetry, ground = self._session.telemetry, GroundCheck(self._session)
        landing_failure = self._context.sender.landing_failure(order)

        def is_down() -> bool:
            altitude = altitude_amsl(self._session.telemetry)
            if altitude is not None:  # A climb shows that the vehicle retries the landing or searches for the target.
                self._lowest_m = min(self._lowest_m, altitude)
                self._climbed_m = max(self._climbed_m, altitude - self._lowest_m)
            self._raise_if_source_failed()
            return ground.confirms(telemetry.is_confirmed_disarmed and telemetry.armed.updated_at > order.given_at)

        def describe() -> str:
            height = height_above_home(self._session.telemetry)
            where = "at an unknown height" if height is None else f"at {height:.1f} m"
            return f"the vehicle is {where}; the target was last seen {self._now() - self._seen_at:.1f} s ago"

        await await_progress(
            self._session,
            "land_on",
            is_done=is_down,
            failure_reason=lambda: ground.failure_reason(landing_failure),
            describe=describe,
            timeout=timeout,
            max_silence_s=max_silence_s,
        )

    def report(self, *, was_target_sent: bool, texts: tuple[str, ...]) -> LandingReport:
        unseen_s = self._now() - self._seen_at
        return LandingReport(self._last, unseen_s, tuple(self._losses), self._climbed_m, was_target_sent, texts)

    def _now(self) -> float:
        return self._session.connection.now()

    def _raise_if_source_failed(self) -> None:
        if self._source_error is not None:
            raise self._source_error

    def _on_target(self, target: TargetMeasurement | None) -> None:
        if target is None:
            return
        check_kind("target", target, TargetMeasurement)
        try:
            self._stream.send(target)
        except ValueUnknownError:
            # Without PX4's attitude or local position, the target cannot be converted. It counts as not visible.
            return
        unseen_s = self._now() - self._seen_at  # infinite at the first measurement
        if LOST_AFTER_S < unseen_s < math.inf:
            self._losses.append(TargetLoss(unseen_s, self._seen_height_m))
        self._last = target
        self._seen_at = self._now()
        self._seen_height_m = height_above_home(self._session.telemetry)
