"""Twelve seconds without a word: by default a call ends with an error, on request it waits on."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import anyio
import pytest
from flight_harness import Flight, in_the_air, open_flight

from aerokit.errors import HeartbeatTimeout

pytestmark = pytest.mark.anyio

Call = Callable[[Flight, "float | None"], Awaitable[None]]


CALLS: dict[str, Call] = {
    "take_off": lambda f, s: f.vehicle.take_off(40.0, max_silence_s=s),
    "go_to": lambda f, s: f.vehicle.go_to(f.vehicle.position.value.offset(north_m=100.0), max_silence_s=s),
    "land": lambda f, s: f.vehicle.land(max_silence_s=s),
    "return_to_launch": lambda f, s: f.vehicle.return_to_launch(max_silence_s=s),
    "set_heading": lambda f, s: f.vehicle.set_heading(170.0, relative=True, rate_deg_s=10.0, max_silence_s=s),
}


async def fly(name: str, max_silence_s: float | None) -> None:
    opened = open_flight() if name == "take_off" else in_the_air(20.0)
    async with opened as flight, anyio.create_task_group() as tasks:
        if name == "take_off":
            await flight.vehicle.wait_ready()
            await flight.vehicle.set_mode("GUIDED")
            await flight.vehicle.arm()

        async def radio_is_out() -> None:
            await anyio.sleep(2.0)
            flight.copter.faults.silent = True
            await anyio.sleep(12.0)
            flight.copter.faults.silent = False

        tasks.start_soon(radio_is_out)
        await CALLS[name](flight, max_silence_s)
        assert not flight.copter.faults.silent


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", CALLS)
async def test_call_without_silence_limit_survives_silence(name: str) -> None:
    await fly(name, None)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CALLS)
async def test_call_silence_exceeds_limit_raises_heartbeat_timeout(name: str) -> None:
    with pytest.raises(BaseException) as caught:  # noqa: PT011 - a group on anyio's task group
        await fly(name, 5.0)
    assert caught.group_contains(HeartbeatTimeout)
