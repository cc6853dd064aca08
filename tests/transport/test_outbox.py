"""Data that a transport does not accept: bounded in bytes and seconds, reported, and discarded on request."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import sys
from collections.abc import AsyncIterator, Iterator

import anyio
import pytest
from far_end import far_end
from link_harness import Recorder, each_loop, eventually

from aerokit import events, messages, open_connection
from aerokit.connection.connection import Connection
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.testing import FaultyLink
from aerokit.transport import Link, ReconnectingLink, SerialLink, TcpConnect, memory_link_pair, outbox, tcp
from aerokit.transport.outbox import WRITE_TIMEOUT_S, Outbox

pytestmark = pytest.mark.anyio

COMMAND = messages.CommandLong(1, 1, 400, 0, *(0.0,) * 7)
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports unsent bytes")


class ManualTransport:
    """A transport that takes ``room`` bytes and sends none of them until ``flow`` is called."""

    def __init__(self, room: int, limit: int = 100) -> None:
        self.sent: list[bytes] = []
        self.pending, self.room, self.dropped = 0, room, 0
        self.events: list[bool] = []
        self.outbox = Outbox(
            self._take, lambda: self.pending, limit=limit, on_dropped=self._drop, on_stalled=self.events.append
        )

    def _take(self, data: bytes) -> None:
        self.sent.append(data)
        self.pending += len(data)
        if self.pending >= self.room:
            self.outbox.pause()

    def _drop(self, writes: int) -> None:
        self.dropped += writes

    def flow(self) -> None:
        self.pending = 0
        self.outbox.resume()


async def test_accepted_data_passes_at_once_without_timer() -> None:
    line = ManualTransport(room=1000)
    line.outbox.write(b"one")
    line.outbox.write(b"two")
    assert line.sent == [b"one", b"two"]
    assert line.outbox.unsent_bytes == 6
    line.flow()
    await anyio.sleep(0.5)
    assert line.outbox._timer is None
    await anyio.sleep(100)
    assert line.events == []


async def test_kept_data_leaves_whole_in_order_and_joined() -> None:
    line = ManualTransport(room=1)
    for word in (b"a", b"bb", b"ccc"):
        line.outbox.write(word)
    assert (line.sent, line.outbox.unsent_bytes) == ([b"a"], 6)
    line.flow()
    assert (line.sent, line.dropped) == ([b"a", b"bbccc"], 0)


async def test_kept_data_is_limited() -> None:
    line = ManualTransport(room=1, limit=100)
    for _ in range(1000):
        line.outbox.write(bytes(30))
    assert line.outbox.unsent_bytes == 30 + 90
    assert line.dropped == 1000 - 4


async def test_data_older_than_a_second_is_not_written() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    line.outbox.write(b"too late")
    await anyio.sleep(WRITE_TIMEOUT_S - 0.1)
    line.outbox.write(b"in time")
    await anyio.sleep(0.11)
    line.flow()
    assert (line.sent, line.dropped) == ([b"taken", b"in time"], 1)


async def test_limit_of_a_second_is_exact() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    line.outbox.write(b"too late")
    until = asyncio.get_running_loop().time() + WRITE_TIMEOUT_S
    await anyio.sleep(WRITE_TIMEOUT_S)
    assert asyncio.get_running_loop().time() == until
    line.flow()
    assert (line.sent, line.dropped) == ([b"taken"], 1)


async def test_late_writes_are_dropped_without_another_write() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    line.outbox.write(b"too late")
    await anyio.sleep(2)
    assert (line.dropped, line.outbox.unsent_bytes) == (1, 5)


async def test_stall_is_reported_once_and_stops_forwarding() -> None:
    """The operating system would accept more, but accepted data cannot be recalled, so the link sends no more."""
    line = ManualTransport(room=1000)
    for _ in range(5):
        line.outbox.write(b"heartbeat")
        await anyio.sleep(0.9)
    assert line.events == [True]
    assert len(line.sent) == 2
    line.flow()
    await anyio.sleep(0.3)
    assert line.events == [True, False]
    await anyio.sleep(0.1)
    line.outbox.write(b"again")
    assert line.sent[-1] == b"again"


async def test_data_written_during_stall_leaves_afterwards() -> None:
    line = ManualTransport(room=1000)
    line.outbox.write(b"taken")
    await anyio.sleep(1.4)
    line.outbox.write(b"in time")
    assert (line.events, line.sent) == ([True], [b"taken"])
    line.pending = 0  # it was never full, so no resume callback comes
    await anyio.sleep(0.3)
    assert (line.events, line.sent) == ([True, False], [b"taken", b"in time"])


async def test_slow_link_is_not_stalled() -> None:
    line = ManualTransport(room=10_000)
    for _ in range(200):
        line.outbox.write(bytes(10))
        line.pending -= min(line.pending, 6)
        await anyio.sleep(0.1)
    assert line.events == []


async def test_discarded_data_never_leaves() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    line.outbox.write(b"order")
    line.outbox.discard()
    assert (line.outbox.unsent_bytes, line.dropped) == (5, 1)
    line.flow()
    assert line.sent == [b"taken"]


async def test_discarding_is_no_progress() -> None:
    line = ManualTransport(room=1000)
    for _ in range(8):
        line.outbox.write(b"x" * 10)
        await anyio.sleep(0.2)
        line.pending -= 5
        line.outbox.record_discarded(5)
    assert line.events == [True]


async def test_closed_stalled_outbox_forwards_nothing() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    await anyio.sleep(1.5)
    line.outbox.write(b"order")
    line.outbox.close()
    line.outbox.write(b"more")
    assert (line.sent, line.dropped) == ([b"taken"], 2)


async def test_closed_outbox_forwards_data_in_time() -> None:
    line = ManualTransport(room=1)
    line.outbox.write(b"taken")
    line.outbox.write(b"in time")
    line.outbox.close()
    assert line.sent == [b"taken", b"in time"]


# --------------------------------------------------------------------- a connection, on virtual time


@pytest.fixture
async def radio() -> FaultyLink:
    near, far = memory_link_pair()
    await far.open(Recorder())
    near.far_end = far  # type: ignore[attr-defined]
    return FaultyLink(near)


def recorder_of(radio: FaultyLink) -> Recorder:
    recorder = radio.link.far_end._receiver  # type: ignore[attr-defined]
    assert isinstance(recorder, Recorder)
    return recorder


@pytest.fixture
async def connection(radio: FaultyLink) -> AsyncIterator[Connection]:
    async with open_connection(radio) as connection:
        await anyio.sleep(0.5)
        yield connection


async def test_connection_reports_stall_and_drain(radio: FaultyLink, connection: Connection) -> None:
    changes: list[events.Event] = []
    connection.bus.attach_event(events.LinkStalled, changes.append)
    connection.bus.attach_event(events.LinkDrained, changes.append)
    radio.stall()
    connection.send(COMMAND)
    assert connection.unsent_bytes == radio.unsent_bytes > 0
    await anyio.sleep(4)
    assert [type(event) for event in changes] == [events.LinkStalled]
    radio.drain()
    await anyio.sleep(1)
    assert isinstance(changes[-1], events.LinkDrained)
    assert changes[-1].stalled_s == pytest.approx(3, abs=0.6)
    assert connection.unsent_bytes == 0


async def test_order_during_stall_does_not_arrive_later(radio: FaultyLink, connection: Connection) -> None:
    before = recorder_of(radio).data
    radio.stall()
    connection.send(COMMAND)
    await anyio.sleep(1.5)
    assert radio.dropped_writes >= 1
    radio.drain()
    await anyio.sleep(0.01)
    assert COMMAND.encode()[:20] not in recorder_of(radio).data[len(before) :]


async def test_discarded_order_does_not_arrive(radio: FaultyLink, connection: Connection) -> None:
    before = recorder_of(radio).data
    radio.stall()
    connection.send(COMMAND)
    connection.discard_unsent()
    assert connection.unsent_bytes == 0
    radio.drain()
    await anyio.sleep(0.1)
    assert recorder_of(radio).data == before


async def test_kernel_data_is_reported_and_arrives_late(radio: FaultyLink, connection: Connection) -> None:
    before = recorder_of(radio).data
    radio.stall(system_bytes=40)
    connection.send(COMMAND)
    connection.discard_unsent()
    await anyio.sleep(7)
    assert connection.unsent_bytes >= 40
    radio.drain()
    await anyio.sleep(0.1)
    assert len(recorder_of(radio).data) > len(before)
    await anyio.sleep(0.2)
    assert connection.unsent_bytes == 0


async def test_kernel_buffer_size_limits_undiscardable_data(radio: FaultyLink, connection: Connection) -> None:
    size = len(FrameEncoder(255, 190).encode(COMMAND))
    radio.stall(system_bytes=size)
    for _ in range(2):
        connection.send(COMMAND)
    assert connection.unsent_bytes == 2 * size
    connection.discard_unsent()
    assert connection.unsent_bytes == size


async def test_reconnecting_link_forwards_outbox_calls(radio: FaultyLink) -> None:
    async with open_connection(ReconnectingLink(lambda: radio)) as connection:
        changes: list[events.Event] = []
        connection.bus.attach_event(events.LinkStalled, changes.append)
        connection.bus.attach_event(events.LinkDrained, changes.append)
        radio.stall()
        await anyio.sleep(2.9)
        assert connection.unsent_bytes > 0
        connection.discard_unsent()
        assert connection.unsent_bytes == 0
        radio.drain()
        await anyio.sleep(0.5)
        assert [type(event) for event in changes] == [events.LinkStalled, events.LinkDrained]


async def test_links_without_outbox_have_nothing_unsent() -> None:
    near, _ = memory_link_pair()
    assert Link.unsent_bytes.fget(near) == 0  # type: ignore[attr-defined]
    assert Link.dropped_writes == 0
    near.discard_unsent()


# ----------------------------------------------------------------------------- TCP and serial


@pytest.fixture
def deaf() -> Iterator[socket.socket]:
    """A server whose connections have a small buffer."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server


class Listener(Recorder):
    def __init__(self) -> None:
        super().__init__()
        self.events: list[bool] = []

    def link_stalled(self, unsent_bytes: int) -> None:
        assert unsent_bytes > 0
        self.events.append(True)

    def link_drained(self, stalled_s: float) -> None:
        self.events.append(False)


async def read_until(connection: socket.socket, mark: bytes) -> bytes:
    data = b""
    while not data.endswith(mark):
        data += await asyncio.get_running_loop().sock_recv(connection, 65536)
    return data


async def fill(link: TcpConnect | SerialLink, frame: bytes) -> int:
    """Write until data waits in the outbox; return the number of frames accepted before."""
    for count in range(1000):
        link.write(frame)
        stream = next(iter(link._streams)) if isinstance(link, TcpConnect) else link
        if stream._outbox is not None and stream._outbox._waiting:
            return count
        await asyncio.sleep(0)
    raise AssertionError("it takes whatever is written")


@on_linux
@each_loop
async def test_stalled_tcp_connection_has_little_undiscardable_data(deaf: socket.socket) -> None:
    client = TcpConnect(*deaf.getsockname())
    await client.open(Recorder())
    connection, _ = deaf.accept()
    with connection:
        connection.setblocking(False)
        taken = await fill(client, b"\xfd" * 280)
        assert taken * 280 <= 64 * 1024
        assert client.unsent_bytes > 280
        client.write(b"an order")
        dropped = client.dropped_writes
        client.discard_unsent()
        assert client.dropped_writes == dropped + 2
        drained = asyncio.ensure_future(read_until(connection, b"after"))
        await eventually(lambda: not client.unsent_bytes)
        client.write(b"after")
        data = await drained
        assert data == b"\xfd" * (280 * taken) + b"after"
        client.close()
        await client.wait_closed()


@on_linux
@each_loop
async def test_tcp_stall_is_reported_until_it_drains(deaf: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "STALLED_AFTER_S", 0.0)
    monkeypatch.setattr(outbox, "_POLL_INTERVAL_S", 0.001)
    client, listener = TcpConnect(*deaf.getsockname()), Listener()
    await client.open(listener)
    connection, _ = deaf.accept()
    with connection:
        connection.setblocking(False)
        await fill(client, bytes(280))
        await eventually(lambda: listener.events[:1] == [True])
        reading = asyncio.ensure_future(read_until(connection, b"never"))
        await eventually(lambda: listener.events[-1:] == [False] and not client.unsent_bytes)
        reading.cancel()
        client.close()
        await client.wait_closed()


@on_linux
@each_loop
async def test_closing_a_stalled_tcp_connection_discards_its_bytes(
    deaf: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox, "STALLED_AFTER_S", 0.0)
    monkeypatch.setattr(outbox, "_POLL_INTERVAL_S", 0.001)
    client, listener = TcpConnect(*deaf.getsockname()), Listener()
    await client.open(listener)
    connection, _ = deaf.accept()
    with connection:
        await fill(client, bytes(280))
        await eventually(lambda: listener.events[-1:] == [True])
        client.close()
        await client.wait_closed()
        with pytest.raises(ConnectionResetError):
            while connection.recv(65536):
                pass


@on_linux
@each_loop
async def test_tcp_link_is_lost_if_closed_server_reads_nothing(
    deaf: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that closes its direction of the connection without reading must not leave a dead link open."""
    monkeypatch.setattr(tcp, "LINGER_S", 0.0)
    client, recorder = TcpConnect(*deaf.getsockname()), Recorder()
    await client.open(recorder)
    connection, _ = deaf.accept()
    with connection:
        client.write(bytes(1_000_000))  # more than both buffers of the system take
        connection.shutdown(socket.SHUT_WR)
        await recorder.until_lost()
        await client.wait_closed()


@on_linux
@each_loop
async def test_connection_that_fails_while_it_resumes_is_lost_once(
    deaf: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """asyncio ends a connection twice, with an AttributeError, if a write fails inside ``resume_writing``."""
    errors: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: errors.append(context))
    client, recorder = TcpConnect(*deaf.getsockname()), Recorder()
    await client.open(recorder)
    connection, _ = deaf.accept()
    connection.setblocking(False)
    resume = Outbox.resume

    def resume_after_reset(waiting: Outbox) -> None:
        connection.close()  # with unread data, so that the system resets the connection
        resume(waiting)

    monkeypatch.setattr(Outbox, "resume", resume_after_reset)
    await fill(client, bytes(280))
    client.write(bytes(280))
    while connection.fileno() >= 0:
        with contextlib.suppress(BlockingIOError):
            connection.recv(2048)
        await asyncio.sleep(0)
    await recorder.until_lost()
    await client.wait_closed()
    await asyncio.sleep(0)  # asyncio would end the connection again in this iteration
    assert errors == []


@on_linux
@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@each_loop
async def test_data_waiting_for_serial_line_can_be_discarded() -> None:
    with far_end() as far:
        link = SerialLink(far.device, 57600)
        await link.open(Recorder())
        await fill(link, bytes(280))
        link.write(b"an order")
        assert link.unsent_bytes > 280
        link.discard_unsent()
        assert link._outbox is not None
        assert not link._outbox._waiting
        assert link._transport.get_write_buffer_size() == 0
        far.reads()
        await eventually(lambda: not link.unsent_bytes)
        link.write(b"after")
        await far.recorder.until(lambda: far.recorder.data.endswith(b"after"))
        assert b"an order" not in far.recorder.data
        link.close()
        await link.wait_closed()
