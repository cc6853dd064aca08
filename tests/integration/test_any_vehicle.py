"""One flight for every vehicle: simulated (the default), at an address, or of a binary that the user has.

``pytest -n 0 tests/integration/test_any_vehicle.py --vehicle path/to/arducopter`` starts it and flies it. All that
is asserted here is what the simulated and the real vehicle have in common.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from any_vehicle import Choice, served

from aerokit import Vehicle, connect
from aerokit.errors import CommandRejected, OperationRejected
from aerokit.missions import Mission, take_off, waypoint

pytestmark = pytest.mark.anyio

DO_SET_MODE, REQUEST_MESSAGE = 176, 512
UNKNOWN_COMMAND, UNKNOWN_MESSAGE = 31999, 65000


@pytest.fixture
def choice(request: pytest.FixtureRequest) -> Choice:
    return Choice.from_options(request.config)


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@asynccontextmanager
async def ready(choice: Choice) -> AsyncIterator[Vehicle]:
    async with served(choice) as address, connect(address, timeout=30) as vehicle:
        await vehicle.wait_ready(timeout=choice.seconds(90))
        yield vehicle


async def up(vehicle: Vehicle, choice: Choice) -> None:
    if choice.kind == "copter":
        await vehicle.set_mode("GUIDED")
    await vehicle.arm(timeout=choice.seconds(10))
    await vehicle.take_off(10, timeout=choice.seconds(60))


async def down(vehicle: Vehicle, choice: Choice) -> None:
    await vehicle.land(timeout=choice.seconds(120))
    await vehicle.armed.wait_until(lambda is_armed: not is_armed, timeout=choice.seconds(30))


async def test_parameters_and_missions_on_the_ground(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        assert len(await vehicle.parameters.download()) > 850
        name, value = ("BATT_CAPACITY", 4200.0) if choice.kind == "copter" else ("MPC_XY_CRUISE", 6.0)
        before = await vehicle.parameters.get(name)
        await vehicle.parameters.set(name, value)
        assert await vehicle.parameters.get(name) == pytest.approx(value)
        await vehicle.parameters.set(name, float(before))
        mission = around(vehicle)
        await vehicle.mission.upload(mission)
        assert [item.command for item in await vehicle.mission.download()] == [
            item.command for item in mission
        ]
        with pytest.raises(OperationRejected):
            await vehicle.command(UNKNOWN_COMMAND)


async def test_guided_flight(choice: Choice) -> None:
    """It goes there; it does not disarm in the air; it lands."""
    async with ready(choice) as vehicle:
        here = vehicle.position.value
        await up(vehicle, choice)
        with pytest.raises(CommandRejected):
            await vehicle.disarm()
        assert vehicle.is_armed
        there = here.offset(north_m=10).replace(altitude_amsl_m=None)
        await vehicle.go_to(there, timeout=choice.seconds(60))
        await down(vehicle, choice)
        assert here.distance_to(vehicle.position.fresh(within=5)) > 8


async def test_a_mission_is_flown(choice: Choice) -> None:
    async with ready(choice) as vehicle:
        await vehicle.mission.upload(around(vehicle))
        await up(vehicle, choice)
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=choice.seconds(180))
        await down(vehicle, choice)


async def test_commands_are_refused_on_the_ground(choice: Choice) -> None:
    """An unknown message by both; of ArduPilot also a take-off while it is disarmed, and a mode that it has not."""
    async with ready(choice) as vehicle:
        with pytest.raises(OperationRejected):
            await vehicle.command(REQUEST_MESSAGE, UNKNOWN_MESSAGE)
        if choice.kind == "copter":
            with pytest.raises(OperationRejected):
                await vehicle.take_off(10, timeout=choice.seconds(5))
            with pytest.raises(OperationRejected):
                await vehicle.command(DO_SET_MODE, 1, 200, 0)
        assert not vehicle.is_armed


def around(vehicle: Vehicle) -> Mission:
    here = vehicle.position.value
    corners = [here.offset(north_m=15), here.offset(north_m=15, east_m=15)]
    return Mission(
        [
            take_off(here.latitude_deg, here.longitude_deg, altitude_relative_m=10),
            *(waypoint(each.latitude_deg, each.longitude_deg, altitude_relative_m=10) for each in corners),
        ]
    )
