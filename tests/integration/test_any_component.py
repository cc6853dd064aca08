"""A ground station and a companion share one link to the vehicle through a hub, with transfers both ways at once.

See `test_any_vehicle` for the vehicles.
"""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import anyio
import pytest
from any_vehicle import Choice, served

import aerokit
from aerokit.hub import Endpoint, Hub
from aerokit.mavlink.enums import MavCmd
from aerokit.onboard import CommandRequest
from aerokit.testing import VIRTUAL_BACKEND
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio

CONTENT = bytes(range(256)) * 200


@pytest.fixture
def anyio_backend(choice: Choice) -> Any:
    return VIRTUAL_BACKEND if choice.is_virtual else "asyncio"


async def test_station_and_companion_share_the_link(choice: Choice, tmp_path: Path) -> None:
    (tmp_path / "log.bin").write_bytes(CONTENT)
    results: dict[str, Any] = {}
    (station, near), (companion, far) = memory_link_pair(), memory_link_pair()

    async def keep(name: str, work: Any) -> None:
        results[name] = await work

    async with AsyncExitStack() as stack:
        link = await stack.enter_async_context(served(choice))
        endpoints = (Endpoint(link, name="vehicle"), Endpoint(near, name="station"), Endpoint(far, name="companion"))
        await stack.enter_async_context(Hub(endpoints))
        vehicle = await stack.enter_async_context(aerokit.connect(station, timeout=60))
        system_id = vehicle.system_id
        async with aerokit.component(companion, system_id=system_id, component_id=191) as payload:
            payload.parameters.add("LINE_SPEED", 1.5)
            payload.serve_files(tmp_path)

            @payload.command(MavCmd.USER_1)
            async def work(_: CommandRequest) -> None:
                await anyio.sleep(1.0)

            await vehicle.components.wait_until(lambda found: any(one.component_id == 191 for one in found), timeout=10)
            other = vehicle.component(191)
            async with (
                aerokit.connect(payload.connection, system_id=system_id, rates={}, timeout=30) as own,
                anyio.create_task_group() as tasks,
            ):
                tasks.start_soon(keep, "station", vehicle.parameters.download())
                tasks.start_soon(keep, "companion", own.parameters.download())
                tasks.start_soon(keep, "payload", other.parameters.download())
                tasks.start_soon(keep, "file", other.files.read("/log.bin"))
                tasks.start_soon(keep, "command", other.command(MavCmd.USER_1))
    assert len(results["station"]) == len(results["companion"]) > 100
    assert [(name, results["payload"][name].value) for name in results["payload"]] == [("LINE_SPEED", 1.5)]
    assert results["file"] == CONTENT
