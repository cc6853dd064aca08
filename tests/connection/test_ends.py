"""End of a connection: the program's exceptions pass unchanged, waiters get an error, and nothing is left."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import anyio
import pytest

from aerokit import Vehicle, connect, events, open_connection
from aerokit.connection.connection import Connection
from aerokit.errors import (
    AerokitError,
    BusyError,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude, Heartbeat
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.transport import MemoryLink, memory_link_pair

pytestmark = pytest.mark.anyio

COPTER = Heartbeat(2, 3, 81, 0, 3)


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0)


@pytest.fixture
async def link(anyio_backend: object, copter: SimulatedCopter) -> AsyncIterator[MemoryLink]:
    async with simulated_link(copter) as near:
        yield near


@pytest.fixture
async def vehicle(link: MemoryLink) -> AsyncIterator[Vehicle]:
    async with connect(link) as vehicle:
        yield vehicle


# ---------------------------------------------------------------------- exceptions of the block


@pytest.mark.parametrize(
    "error",
    [
        StopAsyncIteration("mine"),
        StopIteration("mine"),
        GeneratorExit("mine"),
        asyncio.CancelledError("mine"),
        LinkLost("mine"),
        TimeoutError("mine"),
        BaseException("mine"),
    ],
    ids=lambda error: type(error).__name__,
)
async def test_block_exception_passes_unchanged(link: MemoryLink, error: BaseException) -> None:
    caught: BaseException | None = None
    try:
        async with connect(link):
            raise error
    except BaseException as its:
        caught = its
    assert caught is error


@pytest.mark.skipif(sys.version_info < (3, 11), reason="asyncio.TaskGroup is new in 3.11")
async def test_exception_group_of_program_passes_unchanged(link: MemoryLink) -> None:
    async def fail() -> None:
        raise ValueError("mine")

    with pytest.raises(BaseException) as caught:  # noqa: PT011 - the class is new in 3.11
        async with connect(link), asyncio.TaskGroup() as tasks:  # type: ignore[attr-defined, unused-ignore]
            tasks.create_task(fail())
    assert type(caught.value).__name__ == "ExceptionGroup"
    errors: Any = caught.value
    assert [repr(error) for error in errors.exceptions] == ["ValueError('mine')"]


async def test_async_generator_around_connection_can_be_closed(link: MemoryLink) -> None:
    connection: Connection | None = None

    async def altitudes() -> AsyncIterator[float]:
        nonlocal connection
        async with connect(link) as vehicle:
            connection = vehicle.connection
            async for position in vehicle.position.updates():
                yield position.altitude_amsl_m or 0.0

    generator: Any = altitudes()
    assert await generator.__anext__() > 0
    await generator.aclose()
    assert connection is not None
    assert not connection.is_open


@pytest.mark.skipif(sys.version_info < (3, 11), reason="asyncio.timeout and TaskGroup are new in 3.11")
async def test_connection_inside_task_groups_and_timeouts() -> None:
    runner: Any = asyncio

    async def session() -> None:
        async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER")

    async with runner.TaskGroup() as group:
        with pytest.raises(TimeoutError):
            async with runner.timeout(2):
                await session()
        with pytest.raises(TimeoutError):
            with anyio.fail_after(2):
                await session()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(session(), 2)
        other = group.create_task(session())
        await asyncio.sleep(2)
        other.cancel()
    assert other.cancelled()
    task: Any = asyncio.current_task()
    assert task.cancelling() == 0


async def test_connection_inside_anyio_group_beside_others() -> None:
    modes: list[str] = []

    async def session(system_id: int) -> None:
        copter = SimulatedCopter(boot_time_s=0, system_id=system_id)
        async with simulated_link(copter) as link, connect(link, system_id=system_id) as vehicle:
            await vehicle.set_mode("GUIDED")
            modes.append(vehicle.mode_name)

    async with anyio.create_task_group() as tasks:
        for system_id in (1, 2, 3):
            tasks.start_soon(session, system_id)
    assert modes == ["GUIDED"] * 3


async def test_heartbeat_continues_while_cancelled_program_lands(link: MemoryLink) -> None:
    """Without it, the vehicle's failsafe would act in the middle of the clean-up."""
    heartbeats: list[float] = []

    async def land(vehicle: Vehicle) -> None:
        write = link.write

        def noted(data: bytes, peer: object = None) -> None:
            heartbeats.extend(anyio.current_time() for frame in Framer().receive(data) if frame.message_id == 0)
            write(data, peer)

        link.write = noted  # type: ignore[method-assign]
        await vehicle.arm()
        await anyio.sleep(5.5)

    with anyio.move_on_after(2) as scope:
        async with connect(link) as vehicle:
            try:
                await anyio.sleep_forever()
            finally:
                with anyio.CancelScope(shield=True):
                    await land(vehicle)
    assert scope.cancelled_caught
    assert len(heartbeats) >= 5


# ---------------------------------------------------------------------------- mistakes inside


def broken(*_: object, **__: object) -> Any:
    raise ZeroDivisionError("ours")


def break_bus(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle.connection.bus, "deliver_all", broken)


def break_encoder(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle.connection, "_encoder", None)


def break_framer(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(vehicle.connection._receiver.framers, None, object())


def break_rates(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle._session.rates, "_check_stream", broken)


def break_link_watch(vehicle: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle._session.link_watch, "_report", broken)


@pytest.mark.parametrize(
    "breaks",
    [break_bus, break_encoder, break_framer, break_rates, break_link_watch],
    ids=lambda breaks: breaks.__name__,
)
async def test_internal_error_ends_connection_with_message(
    link: MemoryLink,
    breaks: Callable[[Vehicle, pytest.MonkeyPatch], None],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with connect(link) as vehicle:
        breaks(vehicle, monkeypatch)
        with caplog.at_level(logging.CRITICAL, "aerokit"), pytest.raises(ConnectionClosed) as caught:
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER", timeout=10)
        assert caught.value.__cause__ is not None
        await anyio.sleep(1)  # the block is not cancelled
        with pytest.raises(ConnectionClosed, match="internal error of aerokit"):
            vehicle.send(COPTER)


async def test_uncaught_aerokit_error_in_background_ends_connection(link: MemoryLink) -> None:
    """Only after the end may a background task raise such an error."""
    async with connect(link) as vehicle:
        vehicle.connection.fail(InvalidArgument("from a task"))
        with pytest.raises(ConnectionClosed, match="from a task"):
            vehicle.send(COPTER)


# ---------------------------------------------------------------------------- closing


async def test_block_continues_after_close(vehicle: Vehicle) -> None:
    started = anyio.current_time()
    vehicle.connection.close()
    vehicle.connection.close()
    await anyio.sleep(5)
    assert anyio.current_time() - started == pytest.approx(5)
    for use in (vehicle.arm, vehicle.wait_ready, lambda: vehicle.command(511), vehicle.hold, vehicle.land):
        with pytest.raises(ConnectionClosed, match="was closed"):
            await use()
    assert vehicle.mode_name == "STABILIZE"  # the last values can still be read


async def test_sink_may_close_during_delivery(link: MemoryLink) -> None:
    async with open_connection(link) as connection:
        received: list[Heartbeat] = []

        def close(heartbeat: Heartbeat) -> None:
            received.append(heartbeat)
            connection.close()

        connection.bus.attach(Heartbeat, close)
        connection.bytes_received(FrameEncoder(9, 1).encode(COPTER) * 3, None)
        assert len(received) == 1
        await anyio.sleep(3)
        assert len(received) == 1


@pytest.mark.parametrize("how", ["close", "lose"])
async def test_all_waiters_end_at_the_same_time(
    vehicle: Vehicle, link: MemoryLink, copter: SimulatedCopter, how: str
) -> None:
    copter.faults.silent = True
    waits: list[Callable[[], Awaitable[object]]] = [
        lambda: vehicle.command(31_000),
        lambda: vehicle.mode.wait_until(lambda _: False),
        lambda: read(vehicle),
        lambda: follow(vehicle),
        lambda: vehicle.set_mode("GUIDED"),
    ]
    ended: list[tuple[float, BaseException]] = []

    async def note(wait: Callable[[], Awaitable[object]]) -> None:
        try:
            await wait()
        except AerokitError as error:
            ended.append((anyio.current_time(), error))

    async with anyio.create_task_group() as tasks:
        for wait in waits:
            tasks.start_soon(note, wait)
        await anyio.sleep(0.01)
        assert not ended
        if how == "close":
            vehicle.connection.close()
        else:
            link._lose("unplugged")
    errors = [error for _, error in ended]
    expected = ConnectionClosed if how == "close" else LinkLost
    assert [type(error) for error in errors] == [expected] * len(waits)
    assert len(set(map(id, errors))) == len(waits)  # each waiting call gets an error and a traceback of its own
    assert {at for at, _ in ended} == {anyio.current_time()}


async def read(vehicle: Vehicle) -> None:
    with vehicle.subscribe(Attitude) as attitudes:
        while True:
            await attitudes.get()


async def follow(vehicle: Vehicle) -> None:
    async for _ in vehicle.landed_state.changes():
        pass


async def test_repeated_raises_do_not_collect_tracebacks(vehicle: Vehicle) -> None:
    vehicle.connection.close()
    lengths = []
    for _ in range(5):
        with pytest.raises(ConnectionClosed) as caught:
            vehicle.send(COPTER)
        lengths.append(len(caught.traceback))
        assert caught.value.__context__ is None
    assert len(set(lengths)) == 1


async def test_queued_items_are_read_before_the_loss(link: MemoryLink) -> None:
    async with connect(link, rates={Attitude: 10}) as vehicle:
        with vehicle.subscribe(Attitude, events.LinkClosed, capacity=100) as items:
            await anyio.sleep(1)
            link._lose("unplugged")
            observed = []
            with pytest.raises(LinkLost, match="unplugged"):
                async for item in items:
                    observed.append(type(item))
    assert len(observed) > 5
    assert observed[-1] is events.LinkClosed
    assert set(observed[:-1]) == {Attitude}


async def test_end_callback_exception_does_not_affect_others(
    link: MemoryLink, caplog: pytest.LogCaptureFixture
) -> None:
    async with open_connection(link) as connection:
        failures: list[Exception] = []
        connection.on_end(broken)
        connection.on_end(failures.append)
        with caplog.at_level(logging.CRITICAL, "aerokit"):
            connection.close()
        assert [type(error) for error in failures] == [ConnectionClosed]
        connection.on_end(failures.append)
        assert len(failures) == 2  # a late callback is called at once


async def test_link_is_used_once() -> None:
    near, far = memory_link_pair()
    async with open_connection(near):
        with pytest.raises(BusyError, match="opened only once"):
            async with open_connection(near):
                pytest.fail("it is open already")
    with pytest.raises(ConnectionClosed, match="make a new link"):
        async with open_connection(near):
            pytest.fail("it was closed")
    far.close()


async def test_vehicle_after_its_block_on_open_connection(link: MemoryLink) -> None:
    async with open_connection(link) as connection:
        async with connect(connection) as vehicle:
            waiting = asyncio.ensure_future(vehicle.mode.wait_until(lambda _: False))
            await anyio.sleep(0.1)
        with pytest.raises(ConnectionClosed, match="block of this vehicle"):
            await waiting
        with pytest.raises(ConnectionClosed):
            await vehicle.arm()
        with pytest.raises(OperationTimeout), connection.subscribe(events.VehicleSilent) as silence:
            await silence.get(timeout=10)


# ------------------------------------------------------------------------------ reentrancy


async def test_sink_may_subscribe_send_and_detach(link: MemoryLink) -> None:
    async with open_connection(link) as connection:
        received: list[str] = []

        def first(heartbeat: Heartbeat) -> None:
            received.append("first")
            detach()
            connection.bus.attach(Heartbeat, lambda _: received.append("new"))
            connection.send(COPTER)

        detach = connection.bus.attach(Heartbeat, first)
        connection.bytes_received(FrameEncoder(9, 1).encode(COPTER), None)
        assert received == ["first"]
        connection.bytes_received(FrameEncoder(9, 1).encode(COPTER), None)
        assert received == ["first", "new"]


async def test_subscription_can_be_entered_once(link: MemoryLink) -> None:
    async with open_connection(link) as connection:
        subscription = connection.subscribe(Heartbeat)
        with subscription, pytest.raises(BusyError, match="entered only once"):
            subscription.__enter__()
        with pytest.raises(BusyError, match="entered only once"):
            subscription.__enter__()


async def test_refused_subscription_attaches_nothing(vehicle: Vehicle) -> None:
    before = dict(vehicle.connection.bus.wanted)
    for rate_hz in (0, -1, 1001, float("nan")):
        with pytest.raises(InvalidArgument, match="rate_hz"):
            vehicle.subscribe(Attitude, rate_hz=rate_hz)
    assert vehicle.connection.bus.wanted == before


async def test_vehicle_with_mavlink_1(link: MemoryLink) -> None:
    async with connect(link, mavlink_version=1) as vehicle:
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await anyio.sleep(5)
        assert vehicle.connection.is_open
