from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import anyio
import pytest
from link_harness import Recorder, each_loop, each_traffic, eventually

from aerokit.errors import BusyError, ConnectionClosed, LinkOpenError
from aerokit.testing import FaultyLink
from aerokit.transport import Peer, ReconnectingLink, TcpConnect, TcpListen, tcp
from aerokit.transport.sockets import SocketAddress

HOSTS = pytest.mark.parametrize("host", ["127.0.0.1", "::1"])


@contextlib.asynccontextmanager
async def listening(host: str = "127.0.0.1") -> AsyncIterator[tuple[TcpListen, Recorder]]:
    listener, recorder = TcpListen(host, 0), Recorder()
    await listener.open(recorder)
    try:
        yield listener, recorder
    finally:
        listener.close()
        await listener.wait_closed()


@contextlib.asynccontextmanager
async def connected(listener: TcpListen) -> AsyncIterator[tuple[TcpConnect, Recorder]]:
    client, answered = TcpConnect(*listener.local_address), Recorder()
    await client.open(answered)
    try:
        yield client, answered
    finally:
        client.close()
        await client.wait_closed()


@each_loop
@each_traffic
@HOSTS
async def test_tcp_bytes_pass_both_ways(host: str, pieces: list[bytes]) -> None:
    async with listening(host) as (listener, recorder), connected(listener) as (client, answered):
        for piece in pieces:
            client.write(piece)
        await recorder.until_data(b"".join(pieces))
        assert recorder.peers == list(listener.peers) != [None]
        for piece in pieces:
            listener.write(piece, recorder.peers[0])
        await answered.until_data(b"".join(pieces))
        assert answered.peers == [None]
        assert client.local_address[0] == host
    assert recorder.losses == answered.losses == []
    assert listener.dropped_writes == client.dropped_writes == 0


@each_loop
async def test_small_writes_are_sent_at_once() -> None:
    async with listening() as (listener, recorder), connected(listener) as (client, _):
        client.write(b"x")
        await recorder.until_data(b"x")
        for link_stream in (*client._streams, *listener._streams):
            assert link_stream._transport is not None
            sock = link_stream._transport.get_extra_info("socket")
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@each_loop
async def test_losing_one_client_does_not_lose_the_link() -> None:
    async with listening() as (listener, recorder):
        async with connected(listener) as (staying, staying_recorder):
            staying.write(b"a")
            await recorder.until_data(b"a")
            async with connected(listener) as (leaving, leaving_recorder):
                leaving.write(b"b")
                await recorder.until_data(b"ab")
                stays, leaves = recorder.peers
                listener.write(b"to both")
                listener.write(b", and you", leaves)
                await leaving_recorder.until_data(b"to both, and you")
                await staying_recorder.until_data(b"to both")
            await eventually(lambda: len(listener.peers) == 1)
            listener.write(b"gone", leaves)
            assert listener.dropped_writes == 1
            listener.write(b"!")
            await staying_recorder.until_data(b"to both!")
            assert listener.peers == (stays,)
        assert recorder.losses == []


@each_loop
async def test_clients_beyond_the_limit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "MAX_CLIENTS", 1)
    async with listening() as (listener, recorder), connected(listener) as (client, _):
        client.write(b"x")
        await recorder.until_data(b"x")
        async with connected(listener) as (_, turned_away):
            assert "closed the connection" in str(await turned_away.until_lost())


@each_loop
async def test_server_end_of_stream_loses_the_link_once() -> None:
    async with listening() as (listener, recorder), connected(listener) as (client, answered):
        client.write(b"x")
        await recorder.until_data(b"x")
        listener.write(b"goodbye")
        listener.close()
        error = await answered.until_lost()
        assert str(error) == f"{client.address}: the other end closed the connection"
        assert answered.data == b"goodbye"
        client.write(b"into the void")
        await client.wait_closed()
        with pytest.raises(BusyError, match="is lost"):
            await client.open(Recorder())
    assert len(answered.losses) == 1
    assert recorder.losses == []


@each_loop
async def test_reset_is_a_lost_link_with_reason() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        client, answered = TcpConnect(*server.getsockname()), Recorder()
        await client.open(answered)
        connection, _ = server.accept()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
        error = await answered.until_lost()
        assert "reset" in str(error)
        assert isinstance(error.__cause__, ConnectionResetError)
        await client.wait_closed()


@each_loop
async def test_error_without_number_has_its_text() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        client, answered = TcpConnect(*server.getsockname()), Recorder()
        await client.open(answered)
        for stream in tuple(client._streams):
            stream.connection_lost(ConnectionError("an odd end"))
        assert "an odd end" in str(await answered.until_lost())
        await client.wait_closed()


@each_loop
async def test_peer_that_does_not_read_costs_bounded_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "LINGER_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as server:
        client = TcpConnect(*server.getsockname())
        await client.open(Recorder())
        connection, _ = server.accept()
        with connection:
            block = bytes(64 * 1024)
            written = 0
            while not client.dropped_writes:
                client.write(block)
                written += 1
                assert written < 1000
            (stream,) = client._streams
            assert stream._transport is not None
            assert stream._transport.get_write_buffer_size() <= tcp.MAX_PENDING_BYTES + len(block)
            client.close()
            with anyio.fail_after(100):
                await client.wait_closed()
            assert not client._streams


@each_loop
async def test_write_to_closing_connection_is_counted_as_dropped() -> None:
    async with listening() as (listener, recorder), connected(listener) as (client, _):
        client.write(b"x")
        await recorder.until_data(b"x")
        for end in (client, listener):
            (stream,) = end._streams
            assert stream._transport is not None
            stream._transport.close()
            end.write(b"too late")
            assert end.dropped_writes == 1


@each_loop
async def test_data_written_before_close_arrives() -> None:
    data = bytes(range(256)) * 4096
    async with listening() as (listener, recorder), connected(listener) as (client, _):
        client.write(data)
        client.close()
        client.write(b"too late")
        await client.wait_closed()
        await recorder.until_data(data)


@each_loop
async def test_tcp_close_inside_callback_ends_all_callbacks() -> None:
    async with listening() as (listener, recorder), connected(listener) as (client, answered):
        recorder.at_each_piece = lambda data, peer: listener.close()
        client.write(b"first")
        await answered.until_lost()
        await listener.wait_closed()
        assert recorder.data == b"first"
        assert recorder.losses == []
        assert listener.peers == ()


@each_loop
async def test_refused_connection_has_hint_and_can_be_retried() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
    client, answered = TcpConnect(*address), Recorder()
    with pytest.raises(LinkOpenError, match=r"cannot open tcp:.*nothing listens there") as caught:
        await client.open(answered)
    assert caught.value.errno == errno.ECONNREFUSED
    await client.wait_closed()
    listener, recorder = TcpListen(*address), Recorder()
    await listener.open(recorder)
    await client.open(answered)
    client.write(b"hello")
    await recorder.until_data(b"hello")
    for link in (client, listener):
        link.close()
        await link.wait_closed()
        with pytest.raises(ConnectionClosed):
            await link.open(Recorder())


@each_loop
async def test_every_address_of_a_name_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        unused = SocketAddress(socket.AF_INET, server.getsockname())
    async with listening("::1") as (listener, recorder):
        other = SocketAddress(socket.AF_INET6, listener.local_address)

        async def resolve(host: str, port: int, kind: socket.SocketKind) -> list[SocketAddress]:
            return [unused, other]

        monkeypatch.setattr(tcp, "resolve", resolve)
        client = TcpConnect("vehicle.example", listener.local_address[1])
        await client.open(Recorder())
        client.write(b"x")
        await recorder.until_data(b"x")
        client.close()
        await client.wait_closed()


@contextlib.contextmanager
def deaf_server() -> Iterator[tuple[str, int]]:
    """A server with a full accept queue: a connection attempt neither succeeds nor fails."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        for _ in range(4):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(server.getsockname())
        yield server.getsockname()


@each_loop
async def test_connecting_has_a_timeout() -> None:
    with deaf_server() as address:
        client = TcpConnect(*address, connect_timeout_s=0.05)
        with pytest.raises(LinkOpenError, match=r"no answer within 0\.05 s") as caught:
            await client.open(Recorder())
        assert caught.value.errno == errno.ETIMEDOUT
        client.close()
        await client.wait_closed()


@each_loop
async def test_cancelled_connect_leaves_nothing_behind() -> None:
    with deaf_server() as address:
        client = TcpConnect(*address)
        with anyio.move_on_after(0.01):
            await client.open(Recorder())
        await client.wait_closed()
        assert client.local_address == ("", 0)


@each_loop
async def test_cancelled_at_any_iteration_leaves_nothing_behind() -> None:
    async with listening() as (listener, _):
        for turns in range(10):
            for link in (TcpConnect(*listener.local_address), TcpListen("127.0.0.1", 0)):
                recorder = Recorder()
                task = asyncio.ensure_future(link.open(recorder))
                for _ in range(turns):
                    await asyncio.sleep(0)
                if task.cancel():
                    with pytest.raises(asyncio.CancelledError):
                        await task
                assert recorder.losses == []
                link.close()
                with anyio.fail_after(100):
                    await link.wait_closed()
                assert not link._streams


@each_loop
async def test_client_connecting_while_closing_is_closed() -> None:
    """The system had accepted it already."""
    async with listening() as (listener, recorder):
        pass
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    with theirs:
        loop = asyncio.get_running_loop()
        await loop.connect_accepted_socket(lambda: tcp._Stream(listener), ours)
        with anyio.fail_after(100):
            assert await loop.sock_recv(theirs, 1) == b""
            await listener.wait_closed()
    assert (listener.peers, recorder.losses) == ((), [])


@each_loop
@pytest.mark.parametrize("turns", [0, 1, 3, 4, 5, 6])  # at 2 asyncio drops the connection itself, and logs it
async def test_just_accepted_client_is_closed_with_the_link(turns: int) -> None:
    link = TcpListen("127.0.0.1", 0)
    await link.open(Recorder())
    before = len(asyncio.all_tasks())
    with socket.create_connection(link.local_address) as client:
        for _ in range(turns):
            await asyncio.sleep(0)
        link.close()
        await link.wait_closed()
        client.setblocking(False)
        with contextlib.suppress(ConnectionResetError):  # the server has not accepted it yet
            assert client.recv(1) == b""
        assert len(asyncio.all_tasks()) == before


@each_loop
async def test_tcp_port_in_use_has_a_hint() -> None:
    async with listening() as (listener, _):
        second = TcpListen(*listener.local_address)
        with pytest.raises(LinkOpenError, match="another program uses this port") as caught:
            await second.open(Recorder())
        assert caught.value.errno == errno.EADDRINUSE
        second.close()
        await second.wait_closed()


def test_tcp_close_without_running_loop() -> None:
    loop = asyncio.new_event_loop()
    listener, client = TcpListen("127.0.0.1", 0), TcpConnect("127.0.0.1", 0)
    loop.run_until_complete(listener.open(Recorder()))
    client = TcpConnect(*listener.local_address)
    loop.run_until_complete(client.open(Recorder()))
    client.close()
    listener.close()
    loop.run_until_complete(client.wait_closed())
    loop.run_until_complete(listener.wait_closed())
    loop.close()
    listener.close()
    TcpListen("127.0.0.1", 0).close()


class Listener(Recorder):
    """Receiver that records connecting and disconnecting clients."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[tuple[str, Peer]] = []

    def peer_joined(self, peer: Peer) -> None:
        self.events.append(("joined", peer))

    def peer_left(self, peer: Peer) -> None:
        self.events.append(("left", peer))


@pytest.mark.parametrize("wrap", [lambda link: link, lambda link: ReconnectingLink(lambda: link), FaultyLink])
@pytest.mark.anyio
async def test_clients_are_reported_before_they_send(wrap: Callable[[Any], Any]) -> None:
    inner = TcpListen("127.0.0.1", 0)
    listener, server = Listener(), wrap(inner)
    await server.open(listener)
    _, first = await asyncio.open_connection(*inner.local_address)
    await eventually(lambda: len(listener.events) == 1)
    _, second = await asyncio.open_connection(*inner.local_address)
    await eventually(lambda: len(listener.events) == 2)
    one, other = (peer for _, peer in listener.events)
    assert one == first.get_extra_info("sockname")
    first.close()
    await eventually(lambda: len(listener.events) == 3)
    assert listener.events == [("joined", one), ("joined", other), ("left", one)]
    second.close()
    server.close()
    await server.wait_closed()


@pytest.mark.anyio
async def test_unread_data_of_one_client_affects_no_other() -> None:
    listener, server = Listener(), TcpListen("127.0.0.1", 0)
    await server.open(listener)
    with socket.socket() as stalled:
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(server.local_address)
        await eventually(lambda: len(listener.events) == 1)
        reader, writer = await asyncio.open_connection(*server.local_address)
        await eventually(lambda: len(listener.events) == 2)
        slow, quick = (peer for _, peer in listener.events)
        server.write(bytes(100_000), slow)
        server.write(b"x" * 100, quick)
        assert await reader.readexactly(100) == b"x" * 100
        await eventually(lambda: server.unsent_bytes_to(quick) == 0)
        assert 0 < server.unsent_bytes_to(slow) == server.unsent_bytes
        assert server.unsent_bytes_to("nobody") == 0
        writer.close()
        server.close()
        await server.wait_closed()
