"""A copter with two links: one is cut in flight, the other one later, when the first is back.

See `test_any_vehicle` for the vehicles.
"""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from any_vehicle import Choice, served_on_two

from aerokit import connect, events
from aerokit.events import LinkState
from aerokit.missions import Mission, waypoint
from aerokit.testing import VIRTUAL_BACKEND, FaultModel, FaultyLink

pytestmark = pytest.mark.anyio

DEAD, GOOD = FaultModel(loss=1.0), FaultModel()


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


@pytest.fixture(autouse=True)
def _is_a_copter(choice: Choice) -> None:
    if choice.kind.name not in ("copter", "px4"):
        pytest.skip("it is flown by copters of both autopilots")


@pytest.mark.sampled(2)
async def test_one_of_two_links_is_cut_in_flight(choice: Choice) -> None:
    async with served_on_two(choice) as links:
        radios = [FaultyLink(link) for link in links]

        def become(radio: FaultyLink, model: FaultModel) -> None:
            radio.incoming.model = radio.outgoing.model = model

        async with connect(radios, timeout=30) as vehicle:
            chosen: list[events.LinkSelected] = []
            silent: list[events.Event] = []
            bus, status = vehicle.connection.bus, vehicle.connection.links
            assert status is not None
            bus.attach_event(events.LinkSelected, chosen.append)
            bus.attach_event(events.VehicleSilent, silent.append)
            await vehicle.wait_ready(timeout=choice.seconds(120))
            await status.wait_until(lambda links: all(vehicle.system_id in link.systems for link in links), timeout=30)
            await anyio.sleep(3)  # the second one has to show that it leads to the same vehicle
            if choice.kind.guided is not None:
                await vehicle.set_mode(choice.kind.guided)
            await vehicle.arm(timeout=choice.seconds(10))
            await vehicle.take_off(choice.kind.altitude_m, timeout=choice.seconds(120))
            start = vehicle.position.value

            first, second = radios if status.value[0].used_for else reversed(radios)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(vehicle.go_to, start.offset(north_m=60 * choice.speedup))
                await anyio.sleep(2)
                become(first, DEAD)
                with anyio.fail_after(2 if choice.is_virtual else 5):  # a busy machine takes longer
                    while not chosen or vehicle.position.age > 1.0:  # noqa: ASYNC110 - ages have no event
                        await anyio.sleep(0.1)
                assert [(event.link, event.reason) for event in chosen] == [(second.address, "silent")]
                assert vehicle.link_state.value is LinkState.CONNECTED
            items = [
                waypoint(start.latitude_deg + n * 1e-5, start.longitude_deg, altitude_relative_m=20.0)
                for n in range(40)
            ]
            become(first, GOOD)
            await anyio.sleep(4)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(vehicle.mission.upload, Mission(items))
                await anyio.sleep(0.02)
                become(second, DEAD)
            assert len((await vehicle.mission.download()).items) == 40
            assert [(event.link, event.reason) for event in chosen[1:]] == [(first.address, "silent")]
            await vehicle.land(timeout=choice.seconds(240))
            assert not silent
