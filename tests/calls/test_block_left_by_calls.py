"""Every public call of a vehicle that outlives the vehicle's block ends soon, while the connection stays open."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import anyio
import call_stage
import pytest
from call_table import CALLS

import aerokit
from aerokit.testing import run_virtual

ENDS_S = 2.1
"""Seconds after the block in which a call ends. Some calls sleep for a second between two questions."""
NOT_OF_A_VEHICLE = ("connect", "open_connection", "vehicles_on", "fleet")
NAMES = [name for name, call in CALLS.items() if "ardupilot" in call.on and name not in NOT_OF_A_VEHICLE]


@pytest.mark.parametrize("name", NAMES)
def test_call_that_outlives_block_ends_soon(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = AsyncExitStack()
    connect = aerokit.connect

    async def seconds_until_end() -> float:
        async with AsyncExitStack() as connections:

            def connect_by_open_connection(link: Any) -> Any:
                return _Attached(link, connections, block, connect)

            monkeypatch.setattr(aerokit, "connect", connect_by_open_connection)
            async with call_stage.open_stage("ardupilot", tmp_path) as stage:
                monkeypatch.undo()
                call = CALLS[name]
                await call.place(stage)
                call.before(stage)
                task = asyncio.ensure_future(call.do(stage))
                await anyio.sleep(0.05)
                await block.aclose()
                left_at = anyio.current_time()
                await asyncio.wait((task,), timeout=60.0)
                ended_after_s = anyio.current_time() - left_at
                task.cancel()
                await asyncio.wait((task,))
                return ended_after_s

    assert run_virtual(seconds_until_end()) <= ENDS_S


class _Attached:
    """Like `aerokit.connect(link)`, but leaves the connection open, and the vehicle in ``block``."""

    def __init__(self, link: Any, connections: AsyncExitStack, block: AsyncExitStack, connect: Any) -> None:
        self._link, self._connections, self._block, self._connect = link, connections, block, connect

    async def __aenter__(self) -> aerokit.Vehicle:
        connection = await self._connections.enter_async_context(aerokit.open_connection(self._link))
        vehicle: aerokit.Vehicle = await self._block.enter_async_context(self._connect(connection))
        return vehicle

    async def __aexit__(self, *_: object) -> None:
        await self._block.aclose()
