"""Random calls to parameters on a bad link: what a call reports is true of the simulated vehicle."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import anyio
import pytest

import aerokit
from aerokit.errors import OperationTimeout, RollbackFailed
from aerokit.parameters import ParameterType
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink
from aerokit.vehicle.parameters.writing import ParameterWrite

pytestmark = pytest.mark.anyio

MAX_CALL_S = 400.0
# Values of these groups influence each other, or change by themselves.
EXCLUDED = ("CAL_", "COMPASS", "INS_", "STAT_", "SIM_", "BARO", "LND_FLIGHT", "SYS", "MAV", "COM", "NAV", "ASPD")


class CheckedParameters:
    """Calls of one task, which alone writes the parameters ``names``. Each call checks what it reports."""

    def __init__(
        self, vehicle: aerokit.Vehicle, simulated: SimulatedCopter | SimulatedPx4, names: list[str], rng: random.Random
    ) -> None:
        self._vehicle, self._simulated, self._rng = vehicle, simulated, rng
        self.names = names
        self.confirmed: set[str] = set()  # names whose last write was confirmed

    def calls(self) -> Sequence[Callable[[], Coroutine[Any, Any, None]]]:
        return [self.set, self.set, self.set_many, self.get, self.upload, self.temporarily, self.transaction]

    async def set(self) -> None:
        (name,), values = self._random_values(1)
        result = await self._vehicle.parameters.set(name, values[name])
        assert result.value == pytest.approx(values[name])
        self._check(values)

    async def set_many(self) -> None:
        _, values = self._random_values(3)
        results = await self._vehicle.parameters.set_many(values)
        self._check_results(results, values)

    async def upload(self) -> None:
        names, values = self._random_values(4)
        known = self._vehicle.parameters.known(names[0])
        if known is not None:  # The vehicle may have another value, if an earlier write was not confirmed.
            values[names[0]] = known.value
        results = await self._vehicle.parameters.upload(values, method=self._rng.choice(("auto", "set")))
        self._check_results(results, values)

    async def get(self) -> None:
        name = self._rng.choice(self.names)
        value = await self._vehicle.parameters.get(name)
        assert name not in self.confirmed or value == pytest.approx(self._simulated.parameters[name])

    async def temporarily(self) -> None:
        (name,), values = self._random_values(1)
        before = await self._vehicle.parameters.get(name)
        async with self._vehicle.parameters.temporarily(values):
            self._check(values)
            await anyio.sleep(self._rng.uniform(0, 6))
        self._check({name: before})

    async def transaction(self) -> None:
        names, values = self._random_values(2)
        before = {name: await self._vehicle.parameters.get(name) for name in names}
        is_failing = self._rng.random() < 0.4
        try:
            async with self._vehicle.parameters.transaction() as transaction:
                await transaction.set_many(values)
                if is_failing:
                    raise InterruptedError
        except InterruptedError:
            self._check(before)
        else:
            self._check(values)

    def _random_values(self, count: int) -> tuple[list[str], dict[str, float]]:
        names = self._rng.sample(self.names, count)
        self.confirmed.difference_update(names)
        return names, {name: round(self._rng.uniform(1, 50), 3) for name in names}

    def _check(self, values: dict[str, float]) -> None:
        assert {name: self._simulated.parameters[name] for name in values} == pytest.approx(values)
        self.confirmed.update(values)

    def _check_results(self, results: dict[str, ParameterWrite], values: dict[str, float]) -> None:
        for name, result in results.items():
            if result.error is None:
                assert result.outcome in ("set", "unchanged")
                self._check({name: values[name]})
            else:
                assert isinstance(result.error, OperationTimeout)


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(120))
async def test_reported_parameters_are_true_on_bad_links(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    simulated = (SimulatedPx4 if seed % 2 else SimulatedCopter)(boot_time_s=0.0)
    parameters = simulated.parameters
    reals = [name for name in parameters.names if parameters.type(name) == ParameterType.REAL32]
    names = rng.sample([name for name in reals if not name.startswith(EXCLUDED)], 10)
    model = FaultModel(
        loss=rng.choice((0.0, 0.02, 0.1, 0.25)),
        duplication=rng.choice((0.0, 0.1)),
        delay_s=rng.choice((0.0, 0.05, 0.3)),
        jitter_s=rng.choice((0.0, 0.1)),
    )
    async with simulated_link(simulated) as link:
        faulty = FaultyLink(link, model, seed=seed)
        async with aerokit.connect(faulty, system_id=simulated.system_id) as vehicle:
            await vehicle.wait_ready(timeout=120)
            tasks_calls = [CheckedParameters(vehicle, simulated, part, rng) for part in (names[:5], names[5:])]

            async def download() -> None:
                is_refreshed = rng.random() < 0.6
                table = await vehicle.parameters.download(refresh=is_refreshed, cache=rng.choice((False, tmp_path)))
                assert len(table) >= len(parameters)

            async def interrupt_link() -> None:
                faulty.incoming.model = FaultModel(loss=1.0)
                faulty.outgoing.model = rng.choice((faulty.incoming.model, model))
                await anyio.sleep(rng.uniform(0.5, 12))
                faulty.incoming.model = faulty.outgoing.model = model

            async def reboot() -> None:
                simulated.reboot(rng.uniform(0.5, 6))

            async def call_randomly(choices: Sequence[Callable[[], Coroutine[Any, Any, None]]], count: int) -> None:
                for _ in range(count):
                    with anyio.fail_after(MAX_CALL_S), anyio.CancelScope() as scope:
                        if rng.random() < 0.15:
                            scope.deadline = anyio.current_time() + rng.uniform(0, 3)
                        # On this bad link, these are the only errors that may be reported.
                        with contextlib.suppress(OperationTimeout, RollbackFailed):
                            await rng.choice(choices)()
                    await anyio.sleep(rng.choice((0.0, 0.0, rng.uniform(0, 8))))

            async with anyio.create_task_group() as tasks:
                for checked in tasks_calls:
                    tasks.start_soon(call_randomly, [*checked.calls(), download], rng.randint(3, 10))
                tasks.start_soon(
                    call_randomly, [interrupt_link, interrupt_link, interrupt_link, reboot], rng.randint(0, 4)
                )
            faulty.incoming.model = faulty.outgoing.model = FaultModel()
            await anyio.sleep(15)
            table = vehicle.parameters.table
            for name in {*tasks_calls[0].confirmed, *tasks_calls[1].confirmed} & table.keys():
                assert table[name].value == pytest.approx(parameters[name])
