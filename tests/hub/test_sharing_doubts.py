"""A station with the ids of the program whose link it shares is reported, because answers cannot be separated."""

from __future__ import annotations

import anyio
import pytest
from hub_stage import Program

import aerokit
from aerokit import events
from aerokit.hub import shared
from aerokit.hub.running_endpoint import _min_queue_above_bytes
from aerokit.mavlink.messages import Heartbeat
from aerokit.sim import SimulatedCopter, SimulatorServer
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair


@pytest.mark.parametrize("component", [190, 191])
def test_station_with_our_ids_is_reported_once(component: int) -> None:
    near, far = memory_link_pair()

    async def run() -> None:
        async with (
            SimulatorServer(SimulatedCopter(boot_time_s=0.0), far),
            aerokit.open_connection(near) as connection,
            Program(255, component) as station,
            shared(connection, [station.endpoint("station")]),
        ):
            reported: list[events.Event] = []
            connection.bus.attach_event(events.DuplicateSender, reported.append)
            for _ in range(3):
                station.send(Heartbeat(6, 8, 1, 0, 4))
                await anyio.sleep(1)
            assert [(event.system_id, event.component_id) for event in reported] == (  # type: ignore[attr-defined]
                [(255, 190)] if component == 190 else []
            )

    run_virtual(run())


@pytest.mark.parametrize(
    ("address", "most"),
    [
        ("serial:/dev/ttyUSB0:57600", 2048),
        ("tcp:10.0.0.7:5760", 16384),
        ("shared:serial:/dev/ttyUSB0:57600", 2048),
        ("shared:udpin:0.0.0.0:14550 + serial:/dev/ttyUSB0:57600", 2048),
        ("shared:udpin:0.0.0.0:14550", 16384),
    ],
)
def test_shared_link_has_the_queue_limit_of_its_link(address: str, most: int) -> None:
    assert _min_queue_above_bytes(address) == most
