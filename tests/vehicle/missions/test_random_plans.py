"""Random transfers of missions, fences and rally points on a bad link: what a call reports is true of the vehicle."""

from __future__ import annotations

import random
from typing import Any

import anyio
import pytest
from flight_harness import attached_sinks
from plan_flights import HOME

import aerokit
from aerokit.errors import OperationTimeout
from aerokit.missions import Fence, FencePolygon, Mission, MissionItem, RallyPoints
from aerokit.missions.navigation import rally_point, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink

pytestmark = pytest.mark.anyio

MAX_CALL_S = 400.0
PLANS = ("mission", "fence", "rally")
"""Attributes of the vehicle. Their indices are the MAV_MISSION_TYPEs."""


class CheckedPlans:
    """Calls of one program, which alone changes the plans. Each call checks what it reports."""

    def __init__(self, vehicle: aerokit.Vehicle, simulated: SimulatedCopter | SimulatedPx4, rng: random.Random) -> None:
        self._vehicle, self._simulated, self._rng = vehicle, simulated, rng
        self._uploaded: dict[str, Any] = {}

    async def call(self) -> None:
        name, rng = self._rng.choice(PLANS), self._rng
        plans, before = getattr(self._vehicle, name), self._on_vehicle(name)
        choice = rng.choice(("upload", "upload", "change", "download", "clear"))
        try:
            if choice == "clear":
                await plans.clear()
                assert self._on_vehicle(name) == []
            elif choice == "download":
                assert self._numbers((await plans.download()).to_items()) == self._on_vehicle(name)
            else:
                plan = self._changed_plan(name) if choice == "change" else self._random_plan(name)
                method = rng.choice(("auto", "items"))
                await plans.upload(plan, method=method, verify=rng.random() < 0.8, only_changes=rng.random() < 0.8)
                assert self._numbers(plan.to_items()) == self._on_vehicle(name)
                self._uploaded[name] = plan
        except OperationTimeout as error:  # On this bad link, a time-out is the only error that may be reported.
            self._check_error(error, name, before)

    def _check_error(self, error: OperationTimeout, name: str, before: list[tuple[float, ...]]) -> None:
        assert "still has its previous items" not in str(error) or self._on_vehicle(name) == before

    def _changed_plan(self, name: str) -> Any:
        plan = self._uploaded.get(name)
        if name != "mission" or not plan:
            return plan or self._random_plan(name)
        items = list(plan.to_items())
        number = self._rng.randrange(len(items))
        return Mission([*items[:number], items[number].replace(z=self._rng.randint(31, 60)), *items[number + 1 :]])

    def _random_plan(self, name: str) -> Mission | Fence | RallyPoints:
        places = [self._random_place() for _ in range(self._rng.choice((1, 2, 3, 8)))]
        if name == "mission":
            return Mission([waypoint(place, altitude_relative_m=20) for place in places * 2])
        if name == "rally":
            return RallyPoints([rally_point(place, altitude_relative_m=20) for place in places])
        corners = ((-300, -300), (300, -300), (300, 300), (-300, 300))
        return Fence(
            [
                FencePolygon([place.offset(north_m=north, east_m=east) for north, east in corners])
                for place in places[:3]
            ]
        )

    def _random_place(self) -> aerokit.Position:
        return HOME.offset(north_m=self._rng.uniform(-60, 60), east_m=self._rng.uniform(-60, 60))

    def _on_vehicle(self, name: str) -> list[tuple[float, ...]]:
        items = self._simulated.missions.items(PLANS.index(name))
        has_home = name == "mission" and isinstance(self._simulated, SimulatedCopter)
        return self._numbers(items[int(has_home) :])

    @staticmethod
    def _numbers(items: Any) -> list[tuple[float, ...]]:
        numbered: list[MissionItem] = list(items)
        return [(item.command, item.x, item.y, item.z, item.param1) for item in numbered]


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(120))
async def test_reported_plans_are_true_on_bad_links(seed: int) -> None:
    rng = random.Random(seed)
    simulated = (SimulatedPx4 if seed % 2 else SimulatedCopter)(boot_time_s=0.0)
    model = FaultModel(
        loss=rng.choice((0.0, 0.02, 0.1, 0.25)),
        duplication=rng.choice((0.0, 0.1)),
        delay_s=rng.choice((0.02, 0.05, 0.3)),
        jitter_s=rng.choice((0.0, 0.1)),
    )
    async with simulated_link(simulated) as link:
        faulty = FaultyLink(link, model, seed=seed)
        async with aerokit.connect(faulty, system_id=simulated.system_id) as vehicle:
            await vehicle.wait_ready(timeout=120)
            plans = CheckedPlans(vehicle, simulated, rng)
            _ = vehicle.mission, vehicle.fence, vehicle.rally
            before = attached_sinks(vehicle.connection)

            async def disturb() -> None:
                for _ in range(rng.randint(0, 4)):
                    await anyio.sleep(rng.uniform(0, 15))
                    if rng.random() < 0.3:
                        simulated.reboot(rng.uniform(0.5, 6))
                    else:
                        silent = FaultModel(loss=1.0)
                        faulty.incoming.model, faulty.outgoing.model = rng.choice(
                            ((silent, silent), (silent, model), (model, silent))
                        )
                        await anyio.sleep(rng.uniform(0.5, 12))
                        faulty.incoming.model = faulty.outgoing.model = model

            async def transfer() -> None:
                for _ in range(8):
                    with anyio.fail_after(MAX_CALL_S), anyio.CancelScope() as scope:
                        if rng.random() < 0.15:
                            scope.deadline = anyio.current_time() + rng.uniform(0, 3)
                        await plans.call()
                    await anyio.sleep(rng.choice((0.0, 0.0, rng.uniform(0, 8))))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(transfer)
                tasks.start_soon(disturb)
            await anyio.sleep(15)
            assert attached_sinks(vehicle.connection) <= before
