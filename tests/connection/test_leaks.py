"""Cancelled, closed or cut off at any turn of the event loop: it ends as it should and leaves nothing behind."""

from __future__ import annotations

import asyncio
import gc
import os
import subprocess
import sys
import weakref
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from exhaustive import exhaustive
from leak_check import CountingLoop, run_and_do

from aerokit import Vehicle, VelocitySetpoint, connect, open_connection
from aerokit.connection.connection import Connection
from aerokit.errors import ConnectionClosed, LinkLost, SetpointStreamStopped
from aerokit.events import Event
from aerokit.mavlink.messages import Attitude
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing.clock import run_virtual
from aerokit.transport import MemoryLink

Use = Callable[[Vehicle], Awaitable[object]]


async def nothing(vehicle: Vehicle) -> None:
    """Connecting and leaving is all."""


async def read(vehicle: Vehicle) -> None:
    with vehicle.subscribe(Attitude, Event, rate_hz=20) as items:
        for _ in range(3):
            await items.get(timeout=5)
    async for _ in vehicle.mode.changes():
        return


async def arm(vehicle: Vehicle) -> None:
    await vehicle.arm()


async def fly(vehicle: Vehicle) -> None:
    await vehicle.wait_ready()
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await vehicle.take_off(3)
    async with vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=1), 1)
    await vehicle.land()


each_use = pytest.mark.parametrize("use", [arm, *map(exhaustive, (nothing, read, fly))], ids=lambda use: use.__name__)


class Session:
    """A program on a simulated copter, which can be disturbed from outside."""

    def __init__(self, use: Use) -> None:
        self.use = use
        self.link: MemoryLink | None = None
        self.vehicle: Vehicle | None = None

    async def run(self) -> None:
        try:
            async with (
                simulated_link(SimulatedCopter(boot_time_s=0)) as self.link,
                connect(self.link) as self.vehicle,
            ):
                await self.use(self.vehicle)
        finally:
            self.link = self.vehicle = None

    def lose_link(self) -> None:
        if self.link is not None:
            self.link._lose("unplugged")

    def close(self) -> None:
        if self.vehicle is not None:
            self.vehicle.connection.close()


def turns_of(use: Use) -> int:
    """Number of loop iterations of an undisturbed run."""
    turns: list[int] = []

    async def measured() -> None:
        loop: Any = asyncio.get_running_loop()
        start = loop.turns
        await Session(use).run()
        turns.append(loop.turns - start)

    run_and_do(measured, 10**9, lambda _: None)
    return turns[0]


def some_of(turns: int, most: int) -> list[int]:
    """Return all of the first iterations, then a sample."""
    first = min(turns, most // 2)
    rest = range(first, turns, max(1, (turns - first) // (most - first) + 1))
    return [*range(first), *rest]


@each_use
def test_cancelled_at_any_iteration(use: Use) -> None:
    for turns in some_of(turns_of(use), 40):
        cancelled: list[bool] = []
        task = run_and_do(
            Session(use).run,
            turns,
            lambda task, cancelled=cancelled: cancelled.append(task.cancel("stop it")),  # type: ignore[misc]
        )
        assert task.cancelled() is cancelled[0], turns


@pytest.mark.parametrize("use", [nothing, exhaustive(fly)], ids=lambda use: use.__name__)
def test_cancelled_by_scope_at_any_iteration(use: Use) -> None:
    """Cancelled as by asyncio.timeout and anyio.fail_after: the program continues, with nothing pending."""
    scopes: list[anyio.CancelScope] = []

    async def scoped() -> tuple[bool, bool]:
        finished = False
        with anyio.CancelScope() as scope:
            scopes.append(scope)
            await Session(use).run()
            finished = True
        await asyncio.sleep(0)
        return scope.cancelled_caught, finished

    for turns in some_of(turns_of(use), 30):
        task = run_and_do(scoped, turns, lambda _: scopes[-1].cancel() if scopes else None)
        assert task.result() in ((True, False), (False, True)), turns


@pytest.mark.exhaustive
@each_use
def test_link_lost_at_any_iteration(use: Use) -> None:
    for turns in some_of(turns_of(use), 30):
        session = Session(use)
        task = run_and_do(session.run, turns, lambda _, session=session: session.lose_link())  # type: ignore[misc]
        assert type(task.exception()) in (type(None), LinkLost, SetpointStreamStopped), turns


@pytest.mark.exhaustive
@each_use
def test_connection_closed_at_any_iteration(use: Use) -> None:
    for turns in some_of(turns_of(use), 30):
        session = Session(use)
        task = run_and_do(session.run, turns, lambda _, session=session: session.close())  # type: ignore[misc]
        assert type(task.exception()) in (type(None), ConnectionClosed, SetpointStreamStopped), turns


def test_ended_connection_is_garbage() -> None:
    async def program() -> list[weakref.ref[object]]:
        async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
            await arm(vehicle)
            return [weakref.ref(vehicle), weakref.ref(vehicle.connection)]

    references = run_virtual(program())
    gc.collect()
    assert [reference() for reference in references] == [None, None]


def test_block_exception_keeps_no_reference_cycle() -> None:
    """They are freed with the exception, without the garbage collector."""

    class Resource:
        """Something that the program holds: a camera, a file."""

    async def body(connection: Connection, references: list[weakref.ref[object]]) -> None:
        precious = Resource()
        references.append(weakref.ref(precious))
        connection.raise_if_ended()
        raise ValueError("mine")

    async def program() -> None:
        references: list[weakref.ref[object]] = []
        async with simulated_link(SimulatedCopter(boot_time_s=0)) as link:
            try:
                async with open_connection(link) as connection:
                    await body(connection, references)
            except ValueError:
                pass
        assert references[0]() is None

    gc.collect()
    gc.disable()
    try:
        run_virtual(program())
    finally:
        gc.enable()


@pytest.mark.exhaustive
def test_hundred_connections_leave_no_more_than_one() -> None:
    async def program() -> None:
        async with (
            simulated_link(SimulatedCopter(boot_time_s=0)) as link,
            open_connection(link) as connection,
        ):
            async with connect(connection) as vehicle:
                await arm(vehicle)
            before = _attachments(connection)
            for _ in range(100):
                async with connect(connection) as vehicle:
                    await vehicle.mode.wait_until(lambda _: True, timeout=5)
            assert _attachments(connection) == before
            assert not connection.attached

    run_and_do(program, 10**9, lambda _: None, CountingLoop)


def _attachments(connection: Connection) -> tuple[int, int, int, int]:
    bus = connection.bus
    sinks = sum(len(sinks) for sinks in bus._sinks.values())
    events = sum(len(sinks) for sinks in bus._event_sinks.values())
    return sinks, events, len(connection._end_signal._callbacks), len(connection._background)


PROGRAM = """
import asyncio
import aerokit
from aerokit.sim import SimulatedCopter, simulated_link

async def main():
    copter = SimulatedCopter(boot_time_s=0)
    async with simulated_link(copter, speedup=20.0) as link, aerokit.connect(link) as vehicle:
        copter.faults.silent = True
        pending = asyncio.ensure_future(vehicle.command(512, 1))
        try:
            await asyncio.wait_for(vehicle.arm(), 0.2)
        except asyncio.TimeoutError:
            print("timed out", flush=True)
        {ending}

asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("ending", "code"),
    [
        exhaustive(pytest.param("return", 0)),
        exhaustive(pytest.param("raise SystemExit(7)", 7)),
        ("import os, signal; os.kill(os.getpid(), signal.SIGINT)", 1),
    ],
    ids=["return", "exit", "interrupt"],
)
def test_program_with_unanswered_call_exits(tmp_path: Path, ending: str, code: int) -> None:
    """Run in a separate process, which would hang if a thread or shield remained."""
    file = tmp_path / "program.py"
    file.write_text(PROGRAM.format(ending=ending))
    source = Path(__file__).parents[2] / "src"
    environment = {**os.environ, "PYTHONPATH": str(source)}
    done = subprocess.run(
        [sys.executable, "-X", "dev", str(file)],
        capture_output=True,
        text=True,
        timeout=200,
        env=environment,
        check=False,
    )
    assert "timed out" in done.stdout
    assert done.returncode == code or (code == 1 and done.returncode == -2), done.stderr
    for word in ("never awaited", "was destroyed", "ResourceWarning", "Group"):
        assert word not in done.stderr
