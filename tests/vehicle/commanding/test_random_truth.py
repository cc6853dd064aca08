"""Random calls on a bad link: what a call reports as done is true of the simulated vehicle."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable

import anyio
import pytest
from flight_harness import now

import aerokit
from aerokit import Position
from aerokit.errors import AerokitError
from aerokit.missions import Mission, return_to_launch, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sim.motion import true_place
from aerokit.testing import FaultModel, FaultyLink

pytestmark = pytest.mark.anyio

MAX_CALL_S = 400.0


class CheckedCalls:
    """Calls of one vehicle. Each checks, when it returns without an error, that the vehicle did what it reports."""

    def __init__(self, vehicle: aerokit.Vehicle, simulated: SimulatedCopter | SimulatedPx4, rng: random.Random) -> None:
        self._vehicle, self._simulated, self._rng = vehicle, simulated, rng
        self._parameter = "FENCE_ALT_MAX" if isinstance(simulated, SimulatedCopter) else "MPC_XY_CRUISE"

    def flight_calls(self) -> list[Callable[[], Awaitable[None]]]:
        # Calls that are listed twice are called more often, so that many flights leave the ground.
        return [self.arm, self.arm, self.take_off, self.take_off, self.go_to, self.go_to, self.land, self.disarm]

    def other_calls(self) -> list[Callable[[], Awaitable[None]]]:
        return [self.upload, self.set_parameter]

    async def arm(self) -> None:
        started_at = now()
        await self._vehicle.arm()
        # PX4 disarms by itself after 10 s on the ground, and HEARTBEAT reports it up to a second later.
        assert self._simulated.is_armed or now() - started_at < 2.5

    async def disarm(self) -> None:
        await self._vehicle.disarm()
        assert not self._simulated.is_armed

    async def take_off(self) -> None:
        altitude_m = self._rng.uniform(5, 20)
        await self._vehicle.take_off(altitude_m)
        assert self._height_m() > altitude_m - 1.5

    async def land(self) -> None:
        await self._rng.choice((self._vehicle.land, self._vehicle.return_to_launch))()
        assert self._height_m() < 0.3

    async def go_to(self) -> None:
        target = self._random_place()
        await self._vehicle.go_to(target, timeout=60)
        place = true_place(self._simulated)
        assert Position(place.latitude_e7 * 1e-7, place.longitude_e7 * 1e-7).distance_to(target) < 4

    async def upload(self) -> None:
        places = [self._random_place() for _ in range(self._rng.randint(1, 30))]
        items = [waypoint(place, altitude_relative_m=15) for place in places]
        await self._vehicle.mission.upload(Mission([*items, return_to_launch()]))
        assert len(await self._vehicle.mission.download()) == len(items) + 1

    async def set_parameter(self) -> None:
        value = self._rng.uniform(10, 12)
        await self._vehicle.parameters.set(self._parameter, value)
        assert self._simulated.parameters[self._parameter] == pytest.approx(value)

    def _height_m(self) -> float:
        motion = self._simulated.motion
        return motion.ground_down - motion.down

    def _random_place(self) -> Position:
        here = self._vehicle.position.value
        place = Position(here.latitude_deg, here.longitude_deg)
        return place.offset(north_m=self._rng.uniform(-30, 30), east_m=self._rng.uniform(-30, 30))


def random_model(rng: random.Random) -> FaultModel:
    return FaultModel(
        loss=rng.choice((0.0, 0.02, 0.1, 0.25)),
        duplication=rng.choice((0.0, 0.1)),
        reordering=rng.choice((0.0, 0.0, 0.1)),
        delay_s=rng.choice((0.0, 0.05, 0.3)),
        jitter_s=rng.choice((0.0, 0.1)),
    )


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(120))
async def test_reported_success_is_true_on_bad_links(seed: int) -> None:
    rng = random.Random(seed)
    simulated = (SimulatedPx4 if seed % 2 else SimulatedCopter)(boot_time_s=0.0)
    model = random_model(rng)
    async with simulated_link(simulated) as link:
        faulty = FaultyLink(link, model, seed=seed)
        async with aerokit.connect(faulty, system_id=simulated.system_id) as vehicle:
            await vehicle.wait_ready(timeout=120)
            calls = CheckedCalls(vehicle, simulated, rng)

            async def interrupt_link() -> None:
                faulty.incoming.model = FaultModel(loss=1.0)
                faulty.outgoing.model = rng.choice((faulty.incoming.model, model))
                await anyio.sleep(rng.uniform(0.5, 10))
                faulty.incoming.model = faulty.outgoing.model = model

            async def call_randomly(choices: list[Callable[[], Awaitable[None]]], count: int) -> None:
                for _ in range(count):
                    try:
                        with anyio.fail_after(MAX_CALL_S):  # Every call ends, whatever happens to the link.
                            await rng.choice(choices)()
                    except AerokitError:
                        pass  # An error claims no success.
                    await anyio.sleep(rng.choice((0.0, 0.0, rng.uniform(0, 8))))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(call_randomly, calls.flight_calls(), 12)
                tasks.start_soon(call_randomly, [*calls.other_calls(), interrupt_link], rng.randint(0, 5))
