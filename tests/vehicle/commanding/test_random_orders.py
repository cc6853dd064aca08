"""Random orders of several tasks, overlapping and cancelled, on a link that delays and loses commands and answers."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable

import anyio
import pytest
from flight_harness import Flight, Px4Flight, now, open_flight, open_px4, speed_of
from plan_flights import short_mission

from aerokit import Position
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint

pytestmark = pytest.mark.anyio

NORTH = VelocitySetpoint(1.0)
COMMANDS = (
    MavCmd.DO_SET_MODE,
    MavCmd.DO_REPOSITION,
    MavCmd.MISSION_START,
    MavCmd.CONDITION_YAW,
    MavCmd.DO_ORBIT,
)
RC_THROTTLE = 2
Orders = dict[str, Callable[[], Awaitable[object]]]


def orders_of(flight: Flight | Px4Flight, there: Position) -> Orders:
    vehicle = flight.vehicle

    async def fly_by_velocity() -> None:
        async with vehicle.guided.velocity(NORTH) as stream:
            await stream.fly(NORTH, 4.0)

    async def follow(target: Position | None) -> None:
        async with vehicle.follow(lambda: target) as stream:
            await stream.fly(4.0)

    async def fly_mission() -> None:
        await vehicle.mission.start(1)
        await vehicle.mission.wait_finished(timeout=8)

    return {
        "go_to": lambda: vehicle.go_to(there, timeout=10),
        "set_mode": lambda: vehicle.set_mode("RTL"),
        "return_to_launch": lambda: vehicle.return_to_launch(timeout=3),
        "land": lambda: vehicle.land(timeout=2),
        "hold": vehicle.hold,
        "orbit": lambda: vehicle.orbit(there, radius_m=10, timeout=6),
        "set_heading": lambda: vehicle.set_heading(90, timeout=5),
        "loiter": lambda: vehicle.loiter(there, timeout=6),
        "velocity": fly_by_velocity,
        "follow": lambda: follow(there),
        "follow_nothing": lambda: follow(None),
        "mission": fly_mission,
        "pause": vehicle.mission.pause,
    }


def disturb(flight: Flight | Px4Flight, rng: random.Random) -> None:
    """Sometimes, lose or delay the next commands of one type, or their answers."""
    faults = flight.copter.faults if isinstance(flight, Flight) else flight.px4.faults
    command, chance, times = rng.choice(COMMANDS), rng.random(), rng.randint(1, 2)
    if chance < 0.15:
        faults.lose_ack(command, times=times)
    elif chance < 0.3:
        faults.ignore(command, times=times)
    elif chance < 0.35:
        faults.delay_ack(command, 0.8, times=1)


@pytest.mark.sampled(10)
@pytest.mark.parametrize("seed", range(60))
async def test_random_orders_are_no_takeovers_and_leave_vehicle_at_rest(seed: int) -> None:
    rng = random.Random(seed)
    opener = open_px4 if seed % 2 else open_flight
    async with opener(latency_s=rng.choice((0.0, 0.05, 0.2, 0.35))) as flight:
        vehicle = flight.vehicle
        if isinstance(flight, Flight):
            flight.copter.rc[RC_THROTTLE] = 1500
        await vehicle.wait_ready()
        await vehicle.mission.upload(short_mission(flight))
        await flight.take_off(20.0)
        orders = orders_of(flight, vehicle.position.value.offset(north_m=40))
        given: list[tuple[float, str, str]] = []

        async def give(name: str, seconds: float | None) -> None:
            started_at, end = now(), "done or cancelled"
            try:
                with anyio.move_on_after(seconds):
                    await orders[name]()
            except AerokitError as error:
                end = str(error)
            given.append((started_at, name, end))

        async with anyio.create_task_group() as tasks:
            for _ in range(rng.randint(2, 4)):
                disturb(flight, rng)
                tasks.start_soon(give, rng.choice(list(orders)), rng.choice((None, None, rng.uniform(0, 3))))
                await anyio.sleep(rng.choice((0.0, rng.uniform(0, 1.5))))
        # No pilot changes the mode here, so no order may be reported as ended by a mode change.
        assert not [row for row in given if "the mode changed to" in row[2] or "the vehicle left" in row[2]]
        await anyio.sleep(15)
        simulated = flight.copter if isinstance(flight, Flight) else flight.px4
        flies_on = {"RTL", "LAND"} | ({"AUTO", "MISSION"} if "mission" in {name for _, name, _ in given} else set())
        assert vehicle.mode_name in flies_on or speed_of(simulated) < 0.8, given
