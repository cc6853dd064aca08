"""Precision landing on both autopilots: on the target, without it, and with a target that disappears."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable
from typing import Any

import anyio
import pytest
from flight_harness import Flight, now, open_flight, open_px4

from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    ConnectionClosed,
    HeartbeatTimeout,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedRover
from aerokit.vehicle.external.values import TargetMeasurement

pytestmark = pytest.mark.anyio

NORTH_M, EAST_M = 3.0, -2.0
PLND = {"PLND_ENABLED": 1.0, "PLND_TYPE": 1.0}


def camera(motion: Any, *, blind: Callable[[], bool] = lambda: False) -> Callable[[], TargetMeasurement | None]:
    """Return a stabilised camera that sees a target at (NORTH_M, EAST_M)."""

    def see() -> TargetMeasurement | None:
        north, east = NORTH_M - motion.north, EAST_M - motion.east
        cos_yaw, sin_yaw = math.cos(motion.yaw), math.sin(motion.yaw)
        height = motion.ground_down - motion.down
        if blind() or height < 0.1:
            return None
        return TargetMeasurement(
            north * cos_yaw + east * sin_yaw, east * cos_yaw - north * sin_yaw, height, is_level=True
        )

    return see


def miss_m(motion: Any) -> float:
    return math.hypot(motion.north - NORTH_M, motion.east - EAST_M)


def copter(**parameters: float) -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameters={**PLND, **parameters}, heading_deg=40.0)


async def test_copter_lands_on_target() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off(10.0)
        report = await flight.vehicle.land_on(camera(simulated.motion))
        assert flight.vehicle.is_armed is False
        assert miss_m(simulated.motion) < 0.3
        assert report.used_target
        assert report.losses == ()
        assert report.unseen_s < 8.0
        flight.wire.clear()
        await anyio.sleep(2.0)
        assert not flight.wire.all(m.LandingTarget)


async def test_px4_lands_on_target() -> None:
    simulated = SimulatedPx4(boot_time_s=1.0)
    async with open_px4(simulated) as flight:
        await flight.take_off(10.0)
        report = await flight.vehicle.land_on(camera(simulated.motion))
        assert flight.vehicle.mode_name != "LAND"
        assert not flight.vehicle.is_armed
        assert miss_m(simulated.motion) < 0.4
        assert report.used_target


async def test_asynchronous_sources_are_read() -> None:
    simulated = copter()
    see = camera(simulated.motion)

    async def look() -> TargetMeasurement | None:
        await anyio.sleep(0.01)
        return see()

    async def frames() -> AsyncIterator[TargetMeasurement | None]:
        while True:
            yield see()
            await anyio.sleep(0.05)

    async with open_flight(simulated) as flight:
        for source in (look, frames()):
            await flight.take_off(6.0)
            await flight.vehicle.land_on(source)
            assert miss_m(simulated.motion) < 0.3
            await anyio.sleep(3.0)


async def test_lost_target_is_reported() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off(15.0)
        started = flight.vehicle.connection.now()
        see = camera(simulated.motion, blind=lambda: 6.0 < flight.vehicle.connection.now() - started < 9.0)
        report = await flight.vehicle.land_on(see)
        (loss,) = report.losses
        assert loss.seconds == pytest.approx(3.0, abs=0.2)
        assert loss.height_m is not None
        assert 2.0 < loss.height_m < 15.0
        assert miss_m(simulated.motion) < 0.3


@pytest.mark.exhaustive
async def test_px4_search_is_reported_as_climb() -> None:
    simulated = SimulatedPx4(boot_time_s=1.0, parameters={"PLD_BTOUT": 1.0, "PLD_SRCH_TOUT": 5.0, "PLD_MAX_SRCH": 1.0})
    async with open_px4(simulated) as flight:
        await flight.take_off(8.0)
        see = camera(simulated.motion, blind=lambda: simulated.altitude_m < 4.0)
        report = await flight.vehicle.land_on(see)
        assert report.climbed_m > 1.0
        assert report.unseen_s > 5.0


async def test_unseen_target_orders_no_landing() -> None:
    async with open_flight(copter()) as flight:
        await flight.take_off()
        with pytest.raises(OperationTimeout, match="not seen within 2 s; the landing was not ordered"):
            await flight.vehicle.land_on(lambda: None, acquire_timeout=2.0)
        assert flight.wire.mode_orders() == []
        assert flight.vehicle.mode_name == "GUIDED"


async def test_exception_of_source_is_raised() -> None:
    simulated = copter()

    def fail() -> TargetMeasurement | None:
        if simulated.motion.down > -8.0:
            raise ZeroDivisionError("camera")
        return camera(simulated.motion)()

    async with open_flight(simulated) as flight:
        await flight.take_off()
        with pytest.raises(ZeroDivisionError, match="camera"):
            await flight.vehicle.land_on(fail)
        assert flight.vehicle.mode_name == "LAND"
        with pytest.raises(InvalidArgument, match="target = 5"):
            await flight.vehicle.land_on(lambda: 5)  # type: ignore[arg-type,return-value]


async def test_source_with_invalid_target_is_closed() -> None:
    is_closed = False

    async def frames() -> AsyncIterator[TargetMeasurement | None]:
        nonlocal is_closed
        try:
            yield 5  # type: ignore[misc]
        finally:
            is_closed = True

    async with open_flight(copter()) as flight:
        await flight.take_off()
        with pytest.raises(InvalidArgument, match="target = 5") as raised:
            await flight.vehicle.land_on(frames())
        assert is_closed
        del raised  # Until here, its traceback has kept the generator alive.


async def test_source_is_not_read_after_failed_start(monkeypatch: pytest.MonkeyPatch) -> None:
    reads = 0

    def see() -> None:
        nonlocal reads
        reads += 1

    def fail(*_: object, **__: object) -> None:
        raise ConnectionClosed("the connection has ended")

    async with open_flight(copter()) as flight:
        await flight.take_off()
        with monkeypatch.context() as patch:
            patch.setattr(flight.vehicle._session, "streaming", fail)
            with pytest.raises(ConnectionClosed):
                await flight.vehicle.land_on(see)
        await anyio.sleep(1.0)
        assert reads == 0


async def test_disarming_in_the_air_is_no_precision_landing() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight, anyio.create_task_group() as group:
        await flight.take_off(60.0)

        async def disarm() -> None:
            await anyio.sleep(3.0)
            simulated.arming.disarm(force=True)

        group.start_soon(disarm)
        with pytest.raises(OperationRejected, match="land_on: the vehicle was disarmed in the air"):
            await flight.vehicle.land_on(camera(simulated.motion))


async def test_pilot_ends_precision_landing() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(take_over_after, flight, 3.0)
            with pytest.raises(OperationRejected, match="LOITER"):
                await flight.vehicle.land_on(camera(simulated.motion))
        flight.wire.clear()
        await anyio.sleep(3.0)
        assert not flight.wire.mode_orders()
        assert not flight.wire.all(m.LandingTarget)


async def test_pilot_before_first_sight_keeps_vehicle() -> None:
    """The landing is ordered when the target is seen, but not against a pilot who has taken over meanwhile."""
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off()
        see = camera(simulated.motion, blind=lambda: flight.vehicle.mode_name == "GUIDED")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(take_over_after, flight, 3.0)
            with pytest.raises(OperationRejected, match="from GUIDED to LOITER; the order was not sent"):
                await flight.vehicle.land_on(see)
        assert not flight.wire.mode_orders()


@pytest.mark.parametrize("after_s", [0.0, 5.0])
async def test_pilot_in_mode_of_abandoned_flight_keeps_vehicle(after_s: float) -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off()
        with anyio.move_on_after(2.0):
            await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=500))
        await anyio.sleep(after_s)
        begun = now()
        see = camera(simulated.motion, blind=lambda: now() < begun + 7.0)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(take_over_after, flight, 5.0, CopterMode.GUIDED)
            with pytest.raises(OperationRejected, match="to GUIDED; the order was not sent"):
                await flight.vehicle.land_on(see)
        assert CopterMode.LAND not in flight.wire.mode_orders()


async def take_over_after(flight: Flight, seconds: float, mode: int = CopterMode.LOITER) -> None:
    await anyio.sleep(seconds)
    flight.pilot_takes_over(mode)


async def test_cancelled_precision_landing_continues_without_targets() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off()
        with anyio.move_on_after(3.0):
            await flight.vehicle.land_on(camera(simulated.motion))
        flight.wire.clear()
        await anyio.sleep(3.0)
        assert flight.vehicle.mode_name == "LAND"
        assert not flight.wire.all(m.LandingTarget)


async def test_precision_landing_needs_parameters() -> None:
    async with open_flight(copter(PLND_TYPE=0.0)) as flight:
        await flight.take_off()
        with pytest.raises(OperationRejected, match="PLND_TYPE = 0"):
            await flight.vehicle.land_on(lambda: None)
        assert not flight.wire.mode_orders()


async def test_precision_landing_errors_are_raised() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.take_off()
        see = camera(simulated.motion)
        flight.copter.faults.refuse(MavCmd.DO_SET_MODE)
        with pytest.raises(CommandRejected):
            await flight.vehicle.land_on(see)
        flight.copter.faults.clear()
        with pytest.raises(OperationTimeout, match="the target was last seen"):
            await flight.vehicle.land_on(see, timeout=2.0)
        flight.copter.faults.silent = True
        with pytest.raises((HeartbeatTimeout, OperationTimeout)):
            await flight.vehicle.land_on(see, max_silence_s=3.0, acquire_timeout=3.0)


async def test_rover_has_no_precision_landing() -> None:
    async with open_flight(SimulatedRover(boot_time_s=0.0)) as flight:  # type: ignore[arg-type]
        with pytest.raises(NotSupported, match="land_on"):
            await flight.vehicle.land_on(lambda: None)
