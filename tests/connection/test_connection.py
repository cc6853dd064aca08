"""The connection as an async context manager: its exceptions, its end, and leaks."""

from __future__ import annotations

import asyncio
import gc
import inspect
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import anyio
import anyio.lowlevel
import pytest
from late_loop import BEGINS_AT

from aerokit import Vehicle, VelocitySetpoint, connect, open_connection
from aerokit.connection.connection import Connection
from aerokit.errors import (
    BusyError,
    ConnectFailed,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    LinkOpenError,
)
from aerokit.events import DuplicateSender, LinkClosed
from aerokit.mavlink import STANDARD, Dialect
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude, CommandLong, Heartbeat
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.transport import MemoryLink, Peer, memory_link_pair

pytestmark = pytest.mark.anyio

COPTER = Heartbeat(2, 3, 81, 0, 3)


class ByteRecorder:
    """The far end of a link, which records received bytes."""

    def __init__(self) -> None:
        self.data = b""
        self.times: list[float] = []

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.data += data
        self.times.append(anyio.current_time())

    def link_lost(self, error: LinkLost) -> None:
        """Ignore it."""


@asynccontextmanager
async def far_end() -> AsyncIterator[tuple[MemoryLink, MemoryLink, ByteRecorder]]:
    near, far = memory_link_pair()
    ear = ByteRecorder()
    await far.open(ear)
    yield near, far, ear
    far.close()


# ------------------------------------------------------------------------------------------ sending


async def test_own_heartbeat_is_sent_at_1_hz_from_start() -> None:
    async with far_end() as (near, _, ear), open_connection(near, source_system=254, source_component=191):
        await anyio.sleep(5.5)
        frames = Framer().receive(ear.data)
        assert {(frame.system_id, frame.component_id, frame.message_id) for frame in frames} == {(254, 191, 0)}
        assert len(frames) == 6
        gaps = [later - earlier for earlier, later in zip(ear.times, ear.times[1:], strict=False)]
        assert gaps == pytest.approx([1.0] * 5)
        assert ear.times[0] < BEGINS_AT + 0.1


async def test_own_heartbeat_is_of_a_ground_station() -> None:
    async with far_end() as (near, _, ear), open_connection(near):
        await anyio.sleep(0.5)
        (frame,) = Framer().receive(ear.data)
        assert (frame.version, frame.system_id, frame.component_id) == (2, 255, 190)
        assert STANDARD.decode(frame) == Heartbeat(6, 8, 0, 0, 4, 3)


async def test_own_ids_are_plain_integers() -> None:
    """Python 3.10 writes members of enums by their names: ``MavComponent.MISSIONPLANNER``."""
    link, _ = memory_link_pair()
    connection = Connection(link)
    assert (type(connection.source_system), type(connection.source_component)) == (int, int)
    for opening in (connect, open_connection):
        assert type(inspect.signature(opening).parameters["source_component"].default) is int


@pytest.mark.parametrize(("system_id", "component_id"), [(1, 0), (255, 255)])
async def test_own_ids_accept_the_full_range(system_id: int, component_id: int) -> None:
    async with far_end() as (near, _, ear):
        async with open_connection(near, source_system=system_id, source_component=component_id):
            await anyio.sleep(0.5)
        (frame,) = Framer().receive(ear.data)
        assert (frame.system_id, frame.component_id) == (system_id, component_id)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"source_system": 0}, "source_system = 0 is not allowed: it must be 1 to 255"),
        ({"source_system": 256}, "source_system = 256 is not allowed: it must be 1 to 255"),
        ({"source_component": -1}, "source_component = -1 is not allowed: it must be 0 to 255"),
        ({"source_component": 256}, "source_component = 256 is not allowed: it must be 0 to 255"),
    ],
)
async def test_own_ids_out_of_range_are_refused(wrong: dict[str, int], text: str) -> None:
    link, _ = memory_link_pair()
    with pytest.raises(InvalidArgument, match=f"^{text}$"):
        Connection(link, **wrong)  # type: ignore[arg-type]


class OtherHeartbeat(Heartbeat):
    """A class of another dialect with the same message id."""


async def test_subscribe_refuses_types_outside_the_dialect() -> None:
    few = Dialect("heartbeats", [Heartbeat])
    async with far_end() as (near, _, _), open_connection(near, dialect=few) as connection:
        connection.check_types((Heartbeat, LinkClosed))
        for types, text in (
            ((Attitude,), "ATTITUDE is not in this connection's dialect"),
            ((OtherHeartbeat,), "HEARTBEAT is not in this connection's dialect"),
            ((str,), "neither a message class nor an event class"),
            ((), "at least one"),
        ):
            with pytest.raises(InvalidArgument, match=text):
                connection.check_types(types)


async def test_message_with_field_out_of_range_is_not_sent() -> None:
    async with far_end() as (near, _, ear), open_connection(near) as connection:
        await anyio.sleep(0.1)
        before = ear.data
        with pytest.raises(ValueError, match="target_system"):
            connection.send(CommandLong(300, 1, 400, 0, *(0.0,) * 7))
        await anyio.sleep(0.1)
        assert ear.data == before


# ------------------------------------------------------------------------------- exceptions of the block


class Mine(BaseException):
    """An exception of the program's own, and no Exception."""


@pytest.mark.parametrize(
    "error",
    [ValueError("mine"), KeyboardInterrupt(), SystemExit(3), Mine()],
    ids=lambda error: type(error).__name__,
)
async def test_exceptions_of_the_block_pass_unchanged(error: BaseException) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link:
        with pytest.raises(type(error)) as caught:
            async with connect(link):
                raise error
        assert caught.value is error


async def test_cancellation_of_the_block_is_no_error() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link:
        with anyio.move_on_after(2) as scope:
            async with connect(link):
                await anyio.sleep_forever()
        assert scope.cancelled_caught


async def test_return_from_the_block() -> None:
    async def mode() -> str:
        async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
            return vehicle.mode_name

    assert await mode() == "STABILIZE"


async def test_internal_error_ends_connection_without_exception_group(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:

        def broken(*_: object) -> None:
            raise ZeroDivisionError("ours")

        monkeypatch.setattr(vehicle.telemetry, "expire", broken)
        with pytest.raises(ConnectionClosed, match="ZeroDivisionError"):
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER", timeout=10)
        assert not vehicle.connection.is_open


# ---------------------------------------------------------------------------------------- ending


async def test_close_is_idempotent_and_ends_waiters() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:

        async def close() -> None:
            await anyio.sleep(1)
            vehicle.connection.close()
            vehicle.connection.close()

        closing = asyncio.ensure_future(close())
        with pytest.raises(ConnectionClosed, match="was closed"):
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER", timeout=10)
        await closing
        for send in (vehicle.connection.send, vehicle.send):
            with pytest.raises(ConnectionClosed):
                send(COPTER)


async def test_lost_link_ends_all_waiters() -> None:
    closed: list[LinkClosed] = []
    errors: list[type[BaseException]] = []
    async with far_end() as (near, far, _):
        encoder = FrameEncoder(1, 1)
        far.write(encoder.encode(COPTER))

        async def note(wait: Callable[[], Awaitable[object]]) -> None:
            try:
                await wait()
            except LinkLost as error:
                errors.append(type(error))

        async with open_connection(near) as connection:
            far.write(encoder.encode(COPTER))
            async with connect(connection, rates={}) as vehicle:
                connection.bus.attach_event(LinkClosed, closed.append)

                async def read() -> None:
                    with vehicle.subscribe(Attitude) as attitudes:
                        await attitudes.get()

                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(note, read)
                    tasks.start_soon(note, vehicle.arm)
                    tasks.start_soon(note, vehicle.wait_ready)
                    tasks.start_soon(note, lambda: vehicle.position.wait_until(lambda _: True))
                    await anyio.sleep(0.5)
                    far.close()
    assert len(closed) == 1
    assert errors == [LinkLost] * 4


async def test_close_is_bounded_when_the_link_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link:

        async def idle_for() -> None:
            await anyio.sleep_forever()

        monkeypatch.setattr(link, "wait_closed", idle_for)
        async with open_connection(link):
            await anyio.sleep(1)
            started = anyio.current_time()
        assert anyio.current_time() - started <= 3


async def test_failed_open_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    near, _ = memory_link_pair()

    async def refuse(receiver: object) -> None:
        raise LinkOpenError("no")

    monkeypatch.setattr(near, "open", refuse)
    with pytest.raises(LinkOpenError, match="no"):
        async with open_connection(near):
            pytest.fail("not open")


# ------------------------------------------------------------------------------- several vehicles, one link


async def test_vehicle_has_one_object_per_connection() -> None:
    copter = SimulatedCopter(boot_time_s=0)
    async with simulated_link(copter) as link, open_connection(link) as connection:
        async with connect(connection) as vehicle:
            with pytest.raises(BusyError, match="system 1"):
                async with connect(connection):
                    pytest.fail("there is one already")
        assert vehicle.connection.is_open
        async with connect(connection) as again:
            assert again.is_armed is False


async def test_targeted_message_goes_only_to_its_peer() -> None:
    """Three peers on one listening link; a command to system 2 reaches its peer alone, heartbeats reach all."""
    link = SeveralPeers()
    async with open_connection(link) as connection:
        for system_id, peer in ((1, "one"), (2, "two"), (3, "three")):
            link.receive(FrameEncoder(system_id, 1).encode(COPTER), peer)
        connection.send(CommandLong(2, 1, 400, 0, *(0.0,) * 7))
        assert link.sent_to(76) == ["two"]
        received: list[DuplicateSender] = []
        connection.bus.attach_event(DuplicateSender, received.append)
        link.receive(FrameEncoder(2, 1).encode(COPTER), "elsewhere")  # a second vehicle with the same ids?
        connection.send(CommandLong(2, 1, 400, 0, *(0.0,) * 7))
        assert link.sent_to(76) == ["two", "two"]
        assert [(event.system_id, event.component_id) for event in received] == [(2, 1)]
        await anyio.sleep(4)
        link.receive(FrameEncoder(2, 1).encode(COPTER), "elsewhere")  # the vehicle's port has changed
        connection.send(CommandLong(2, 1, 400, 0, *(0.0,) * 7))
        assert link.sent_to(76) == ["two", "two", "elsewhere"]
        connection.send(Heartbeat(6, 8, 0, 0, 4))
        assert link.sent_to(0)[-1] is None


class SeveralPeers(MemoryLink):
    """A link with peers by name."""

    def __init__(self) -> None:
        super().__init__("memory:several")
        self.sent: list[tuple[int, Peer]] = []
        self.connection: Connection | None = None

    async def open(self, receiver: object) -> None:
        assert isinstance(receiver, Connection)
        self.connection = receiver

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.sent += [(frame.message_id, peer) for frame in Framer().receive(data)]

    def receive(self, data: bytes, peer: Peer) -> None:
        assert self.connection is not None
        self.connection.bytes_received(data, peer)

    def sent_to(self, message_id: int) -> list[Peer]:
        return [peer for sent_id, peer in self.sent if sent_id == message_id]


# ------------------------------------------------------------------------------------------- leaks


def scheduled_timers() -> list[asyncio.TimerHandle]:
    loop = asyncio.get_running_loop()
    timers: list[asyncio.TimerHandle] = loop._scheduled  # type: ignore[attr-defined]
    return [timer for timer in timers if not timer.cancelled()]


async def use(vehicle: Vehicle) -> None:
    """A program that uses most features and never ends by itself."""
    await vehicle.wait_ready()
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await vehicle.take_off(5)
    with vehicle.subscribe(Attitude, rate_hz=20) as attitudes:
        await attitudes.get()
    async with vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(1, 0, 0), 3)
    await anyio.sleep_forever()


@pytest.mark.parametrize("seconds", [0.0, 0.0005, 0.3, 1.0, 1.06, 1.2, 2.0, 3.3, 5.0, 8.0, 12.0])
async def test_cancelled_connect_leaves_nothing_behind(seconds: float) -> None:
    tasks_before, threads_before = asyncio.all_tasks(), threading.active_count()
    connection: Connection | None = None
    async with simulated_link(SimulatedCopter(boot_time_s=1)) as link:
        with anyio.move_on_after(seconds):
            async with connect(link) as vehicle:
                connection = vehicle.connection
                await use(vehicle)
    await anyio.lowlevel.checkpoint()
    assert asyncio.all_tasks() == tasks_before
    assert threading.active_count() == threads_before
    gc.collect()
    assert not [t for t in scheduled_timers() if "aerokit" in repr(t)]
    if connection is not None:
        assert set(connection.bus.wanted) == {Heartbeat.ID}
        assert not connection.bus._event_sinks
        assert connection._end_signal._callbacks == []


async def test_vehicle_search_leaves_no_subscriber_behind() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, open_connection(link) as connection:
        before = dict(connection.bus.wanted), list(connection._end_signal._callbacks)
        async with connect(connection):
            pass
        assert (connection.bus.wanted, connection._end_signal._callbacks) == before
        with pytest.raises(ConnectFailed):
            async with connect(connection, system_id=9, timeout=2):
                pytest.fail("no system has this id")
        assert (connection.bus.wanted, connection._end_signal._callbacks) == before


async def test_failed_connect_leaves_nothing_behind() -> None:
    tasks_before = asyncio.all_tasks()
    async with far_end() as (near, _, _ear):
        with pytest.raises(ConnectFailed):
            async with connect(near, timeout=2):
                pytest.fail("there is no vehicle")
        assert asyncio.all_tasks() == tasks_before
        assert not scheduled_timers()


# --------------------------------------------------------------------------------------- vehicles()


async def test_known_vehicle_is_yielded_with_time_of_its_heartbeat() -> None:
    async with far_end() as (near, far, _), open_connection(near) as connection:
        far.write(FrameEncoder(1, 1).encode(COPTER))
        await anyio.sleep(0.1)
        received_at = connection.last_heartbeat_at(1, 1)
        await anyio.sleep(60)
        assert (await anext(connection.vehicles())).at == received_at


async def test_forgotten_vehicle_is_yielded_once() -> None:
    """When the table of routes is full, a component without a route is forgotten, and then found again."""
    async with far_end() as (near, far, _), open_connection(near) as connection:
        vehicles, found = connection.vehicles(), list[int]()
        first, second = FrameEncoder(1, 1), FrameEncoder(2, 1)
        far.write(first.encode(COPTER))
        await anyio.sleep(0.1)
        found.append((await anext(vehicles)).system_id)
        connection.heartbeats.clear()
        far.write(first.encode(COPTER) + second.encode(COPTER))
        found.append((await anext(vehicles)).system_id)
        assert found == [1, 2]
