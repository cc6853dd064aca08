"""Flights of every kind of vehicle: by orders, by velocities, by a mission. See `test_any_vehicle`."""

from __future__ import annotations

from typing import Any

import pytest
from any_vehicle import Choice, ready

from aerokit import Position, Vehicle, VelocitySetpoint
from aerokit import messages as m
from aerokit.errors import CommandRejected, NotSupported
from aerokit.missions import Mission, land, take_off, waypoint
from aerokit.testing import VIRTUAL_BACKEND

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


async def up(vehicle: Vehicle, choice: Choice) -> None:
    kind = choice.kind
    if kind.guided is not None:
        await vehicle.set_mode(kind.guided)
    await vehicle.arm(timeout=choice.seconds(10))
    if kind.takes_off:
        await vehicle.take_off(kind.altitude_m, timeout=choice.seconds(120))
    else:
        with pytest.raises(NotSupported):
            await vehicle.take_off(10)


async def down(vehicle: Vehicle, choice: Choice) -> None:
    """Land the vehicle, or disarm it, and wait until its motors are off."""
    if choice.kind.lands and vehicle.is_armed:
        await vehicle.land(timeout=choice.seconds(400))
    if not choice.kind.takes_off:
        await vehicle.disarm(timeout=choice.seconds(10))
    await vehicle.armed.wait_until(lambda is_armed: not is_armed, timeout=choice.seconds(60))


async def test_flight_by_orders(choice: Choice) -> None:
    """It flies to a place at a speed, refuses to disarm in the air, turns, holds, returns and lands."""
    kind = choice.kind
    async with ready(choice) as vehicle:
        here = vehicle.position.value
        await up(vehicle, choice)
        if kind.takes_off:
            with pytest.raises(CommandRejected):
                await vehicle.disarm()
        assert vehicle.is_armed
        there = Position(*place(here, kind.travel_m, 0.0), altitude_relative_m=kind.altitude_m)
        await vehicle.go_to(there, speed_m_s=kind.speed_m_s, tolerance_m=kind.near_m, timeout=choice.seconds(240))
        assert vehicle.distance_to(Position(*place(here, kind.travel_m, 0.0))) < kind.near_m
        if kind.turns:
            await vehicle.set_heading(90, timeout=choice.seconds(60))
            assert vehicle.heading_deg.value == pytest.approx(90, abs=10)
        await vehicle.hold()
        if kind.returns:
            await vehicle.return_to_launch(timeout=choice.seconds(400))
            assert here.distance_to(vehicle.position.fresh(within=5)) < kind.near_m
        if not (kind.returns and vehicle.autopilot.lands_after_return):
            await down(vehicle, choice)
        await vehicle.armed.wait_until(lambda is_armed: not is_armed, timeout=choice.seconds(60))


async def test_flight_by_velocities(choice: Choice) -> None:
    """The distance is speed times time, then it stops; planes do not accept velocities."""
    async with ready(choice) as vehicle:
        if choice.kind.takes_velocities:
            await up(vehicle, choice)
            await fly_north(vehicle, choice)
            await down(vehicle, choice)
        elif choice.kind.is_ardupilot:
            with pytest.raises(NotSupported):
                vehicle.guided.velocity()


async def fly_north(vehicle: Vehicle, choice: Choice) -> None:
    """Ten seconds of the vehicle's clock, which may be slower than requested."""
    speed, milliseconds = choice.kind.speed_m_s, 10_000
    here = vehicle.position.fresh(within=5)
    stream = vehicle.guided.velocity(rate_hz=min(100, 10 * choice.speedup), valid_for_s=10, max_lag_s=10)
    with vehicle.subscribe(m.Attitude, rate_hz=10) as attitudes:
        async with stream:
            began = (await attitudes.get(timeout=10)).time_boot_ms
            while (await attitudes.get(timeout=10)).time_boot_ms - began < milliseconds:
                stream.set(VelocitySetpoint(north_m_s=speed))
    flown = here.distance_to(vehicle.position.fresh(within=5))
    assert 0.4 * speed < flown / (milliseconds / 1000) < 2.0 * speed
    assert vehicle.mode.value.custom_mode == vehicle.autopilot.mode_for("hold").custom_mode  # type: ignore[union-attr]


async def test_flight_by_mission(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        here = vehicle.position.value
        await vehicle.mission.upload(around(here, choice))
        await up(vehicle, choice)
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=choice.seconds(400))
        await down(vehicle, choice)


def around(here: Position, choice: Choice) -> Mission:
    kind = choice.kind
    corners = [place(here, kind.travel_m, 0.0), place(here, kind.travel_m, kind.travel_m)]
    items = [waypoint(*corner, altitude_relative_m=kind.altitude_m) for corner in corners]
    if kind.takes_off:
        items.insert(0, take_off(*place(here, 0.0, 0.0), altitude_relative_m=kind.altitude_m))
    if kind.mission_lands:
        items.append(land(*place(here, 0.0, 0.0), altitude_relative_m=0.0))
    return Mission(items)


def place(here: Position, north_m: float, east_m: float) -> tuple[float, float]:
    there = here.offset(north_m=north_m, east_m=east_m)
    return there.latitude_deg, there.longitude_deg
