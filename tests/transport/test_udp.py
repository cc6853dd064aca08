from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from link_harness import LOOPS, Recorder, each_loop, each_traffic, eventually, on_loops

from aerokit.errors import BusyError, ConnectionClosed, LinkOpenError
from aerokit.transport import (
    ReconnectingLink,
    TcpConnect,
    TcpListen,
    UdpBroadcast,
    UdpConnect,
    UdpListen,
    udp,
)

HOSTS = pytest.mark.parametrize("host", ["127.0.0.1", "::1"])


class LoopWithoutReaders(asyncio.SelectorEventLoop):
    """Like the Proactor loop of Windows: it has datagram transports, but no add_reader."""

    def add_reader(self, fd: Any, callback: Any, *args: Any) -> None:  # type: ignore[override]
        raise NotImplementedError

    def remove_reader(self, fd: Any) -> bool:
        raise NotImplementedError


WITHOUT_READERS = pytest.param(("asyncio", {"loop_factory": LoopWithoutReaders}), id="no add_reader")


each_loop_and_the_fallback = on_loops([*LOOPS, WITHOUT_READERS])


@contextlib.contextmanager
def plain_socket(host: str = "127.0.0.1") -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        sock.bind((host, 0))
        sock.settimeout(20.0)
        yield sock


@pytest.mark.sampled(5)
@each_loop_and_the_fallback
@each_traffic
@HOSTS
async def test_datagrams_pass_both_ways(host: str, pieces: list[bytes]) -> None:
    listener, caller = UdpListen(host, 0), UdpConnect(host, 0)
    recorder, answered = Recorder(), Recorder()
    await listener.open(recorder)
    caller = UdpConnect(host, listener.local_address[1])
    await caller.open(answered)
    for piece in pieces:
        caller.write(piece)
    await recorder.until_data(b"".join(pieces))
    assert [data for data, _ in recorder.pieces] == pieces
    assert recorder.peers == list(listener.peers)
    for piece in pieces:
        listener.write(piece, recorder.peers[0])
    await answered.until_data(b"".join(pieces))
    assert answered.peers == [None]
    for link in (listener, caller):
        link.close()
        await link.wait_closed()
    assert recorder.losses == answered.losses == []
    assert listener.dropped_writes == caller.dropped_writes == 0


@each_loop_and_the_fallback
async def test_listener_writes_to_all_senders() -> None:
    listener, recorder = UdpListen("127.0.0.1", 0), Recorder()
    await listener.open(recorder)
    listener.write(b"nobody is there yet")
    with plain_socket() as first, plain_socket() as second:
        for sock in (first, second, first):
            sock.sendto(b"hello", listener.local_address)
        await recorder.until_data(b"hello" * 3)
        assert listener.peers == (first.getsockname(), second.getsockname())
        listener.write(b"to both")
        listener.write(b"to the second", second.getsockname())
        assert first.recv(100) == b"to both"
        assert [second.recv(100), second.recv(100)] == [b"to both", b"to the second"]
    listener.close()
    await listener.wait_closed()
    assert listener.dropped_writes == 0


@each_loop
async def test_least_recent_peer_is_forgotten_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "MAX_PEERS", 2)
    listener, recorder = UdpListen("127.0.0.1", 0), Recorder()
    await listener.open(recorder)
    with plain_socket() as first, plain_socket() as second, plain_socket() as third:
        for sock in (first, second, first, third):
            sock.sendto(b"x", listener.local_address)
        await recorder.until_data(b"xxxx")
        assert listener.peers == (third.getsockname(), first.getsockname())
        listener.write(b"?", second.getsockname())
    assert listener.dropped_writes == 1
    listener.close()


@each_loop
async def test_burst_is_read_in_bounded_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "MAX_BURST_DATAGRAMS", 4)
    listener, recorder = UdpListen("127.0.0.1", 0), Recorder()
    await listener.open(recorder)
    loop = asyncio.get_running_loop()
    seen_between_turns: list[int] = []

    def count() -> None:
        seen_between_turns.append(len(recorder.pieces))
        if len(recorder.pieces) < 10:
            loop.call_soon(count)

    with plain_socket() as sock:
        for n in range(10):
            sock.sendto(bytes([n]), listener.local_address)
        loop.call_soon(count)
        await recorder.until_data(bytes(range(10)))
    assert 4 in seen_between_turns
    assert 8 in seen_between_turns
    listener.close()


@each_loop_and_the_fallback
async def test_closed_remote_port_does_not_lose_the_link() -> None:
    with plain_socket() as sock:
        port = sock.getsockname()[1]
    caller, answered = UdpConnect("127.0.0.1", port), Recorder()
    await caller.open(answered)
    for _ in range(5):
        caller.write(b"is anybody there?")
        await asyncio.sleep(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", port))
        vehicle.settimeout(20.0)
        caller.write(b"now")
        data, source = vehicle.recvfrom(100)
        assert data == b"now"
        vehicle.sendto(b"yes", source)
        await answered.until_data(b"yes")
    assert answered.losses == []
    caller.close()
    await caller.wait_closed()


@each_loop_and_the_fallback
async def test_udpout_receives_from_its_remote_only() -> None:
    with plain_socket() as vehicle, plain_socket() as stranger:
        caller, answered = UdpConnect("0.0.0.0", vehicle.getsockname()[1]), Recorder()
        await caller.open(answered)
        caller.write(b"hello")
        data, source = vehicle.recvfrom(100)
        assert data == b"hello"
        stranger.sendto(b"psst", source)
        vehicle.sendto(b"here", source)
        await answered.until_data(b"here")
    caller.close()
    await caller.wait_closed()


@each_loop
async def test_unsendable_data_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    with plain_socket() as remote:
        caller = UdpConnect(*remote.getsockname())
        await caller.open(Recorder())
        caller.write(b"x" * 70_000)
        assert caller.dropped_writes == 1
        assert caller._socket is not None
        real, caller._socket = caller._socket, FullSocket()  # type: ignore[assignment]
        caller.write(b"no room")
        caller._socket = real
        assert caller.dropped_writes == 2
        caller.write(b"room")
        assert remote.recv(100) == b"room"
    caller.close()


class FullSocket:
    def sendto(self, data: bytes, address: object) -> int:
        raise BlockingIOError(errno.EAGAIN, "no room")


@each_loop_and_the_fallback
async def test_broadcast_uses_only_the_peer_that_answers() -> None:
    broadcast, recorder = UdpBroadcast("127.255.255.255", 14550), Recorder()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle, plain_socket() as other:
        vehicle.bind(("0.0.0.0", 0))
        vehicle.settimeout(20.0)
        broadcast = UdpBroadcast("127.255.255.255", vehicle.getsockname()[1])
        await broadcast.open(recorder)
        broadcast.write(b"who is there?")
        data, source = vehicle.recvfrom(100)
        assert data == b"who is there?"
        vehicle.sendto(b"me", source)
        await recorder.until_data(b"me")
        other.sendto(b"me too", source)
        broadcast.write(b"hello you")
        assert vehicle.recvfrom(100) == (b"hello you", source)
        vehicle.sendto(b"!", source)
        await recorder.until_data(b"me!")
        assert recorder.peers == [None]
    broadcast.close()
    await broadcast.wait_closed()


@each_loop_and_the_fallback
async def test_udp_close_inside_callback_ends_all_callbacks() -> None:
    listener, recorder = UdpListen("127.0.0.1", 0), Recorder()
    await listener.open(recorder)
    address = listener.local_address
    recorder.at_each_piece = lambda data, peer: listener.close()
    with plain_socket() as sock:
        for piece in (b"first", b"second", b"third"):
            sock.sendto(piece, address)
        await recorder.until_data(b"first")
        await listener.wait_closed()
        for _ in range(3):
            await asyncio.sleep(0)
    assert recorder.data == b"first"
    listener.write(b"after the end")
    listener.close()
    assert recorder.losses == []


@each_loop_and_the_fallback
async def test_udp_port_in_use_has_hint_and_can_be_retried() -> None:
    with plain_socket() as sock:
        listener = UdpListen(*sock.getsockname())
        with pytest.raises(LinkOpenError, match=r"udpin:127\.0\.0\.1:\d+: .*another program uses this port") as caught:
            await listener.open(Recorder())
        assert caught.value.errno == errno.EADDRINUSE
        await listener.wait_closed()
    await listener.open(Recorder())
    with pytest.raises(BusyError):
        await listener.open(Recorder())
    listener.close()
    await listener.wait_closed()
    with pytest.raises(ConnectionClosed):
        await listener.open(Recorder())


@each_loop
@pytest.mark.parametrize(
    ("link", "hint"),
    [
        (UdpListen("192.0.2.1", 14550), "this machine does not have this address"),
        (UdpConnect("no-such-host.invalid", 14550), "unknown host name"),
        (UdpConnect("255.255.255.255", 14550), "udpbcast:"),
    ],
    ids=["foreign address", "unknown name", "broadcast"],
)
async def test_open_errors_have_hints(link: UdpListen | UdpConnect, hint: str) -> None:
    link = type(link)(link._host, link._port)
    with pytest.raises(LinkOpenError, match=hint):
        await link.open(Recorder())
    link.close()


@each_loop_and_the_fallback
async def test_cancelled_open_leaves_nothing_behind() -> None:
    for turns in range(12):
        listener = UdpListen("localhost", 0)
        task = asyncio.ensure_future(listener.open(Recorder()))
        for _ in range(turns):
            await asyncio.sleep(0)
        if task.cancel():
            with pytest.raises(asyncio.CancelledError):
                await task
            await listener.wait_closed()
            assert listener.local_address == ("", 0)
        listener.close()
        await listener.wait_closed()


@each_loop_and_the_fallback
async def test_closed_while_opening() -> None:
    listener = UdpListen("localhost", 0)
    task = asyncio.ensure_future(listener.open(Recorder()))
    await asyncio.sleep(0)
    listener.close()
    with pytest.raises(ConnectionClosed):
        await task
    await listener.wait_closed()
    assert listener.local_address == ("", 0)


def test_close_works_without_a_running_loop() -> None:
    loop = asyncio.new_event_loop()
    stopped, gone = UdpListen("127.0.0.1", 0), UdpListen("127.0.0.1", 0)
    loop.run_until_complete(stopped.open(Recorder()))
    loop.run_until_complete(gone.open(Recorder()))
    stopped.close()
    loop.close()
    gone.close()
    UdpListen("127.0.0.1", 0).close()


@pytest.mark.parametrize("kind", [UdpListen, UdpConnect, UdpBroadcast, TcpListen, TcpConnect])
def test_host_of_peer_ignores_its_port(kind: Any) -> None:
    link = kind("127.0.0.1", 14550)
    assert (link.host_of(("10.0.0.7", 14550)), link.host_of(None)) == ("10.0.0.7", None)


@each_loop
@pytest.mark.parametrize(
    ("error", "messages"),
    [
        (ConnectionRefusedError(errno.ECONNREFUSED, "refused"), []),
        (OSError(errno.ENETUNREACH, "no network"), []),
        (OSError(errno.EMSGSIZE, "too long"), []),
        (OSError(errno.ENODEV, "gone"), ["the socket failed: gone"]),
        (OSError("without a number"), ["the socket failed: without a number"]),
        (ValueError("a mistake of the loop's"), []),
    ],
    ids=str,
)
async def test_only_permanent_errors_end_a_udp_link(error: Exception, messages: list[str]) -> None:
    link, recorder = UdpListen("127.0.0.1", 0), Recorder()
    await link.open(recorder)
    udp._DatagramProtocol(link).error_received(error)
    await asyncio.sleep(0)
    assert [str(loss) for loss in recorder.losses] == [f"{link.address}: {event}" for event in messages]
    link.close()
    await link.wait_closed()


class BurstRecorder(Recorder):
    """Receiver that records the ends of bursts."""

    def __init__(self) -> None:
        super().__init__()
        self.bursts: list[int] = []

    def burst_ended(self) -> None:
        self.bursts.append(len(self.pieces))


@pytest.mark.parametrize("wrap", [lambda link: link, lambda link: ReconnectingLink(lambda: link)])
@pytest.mark.anyio
async def test_end_of_burst_is_reported(wrap: Callable[[Any], Any]) -> None:
    inner, gatherer = UdpListen("127.0.0.1", 0), BurstRecorder()
    link = wrap(inner)
    assert not link.reports_bursts
    await link.open(gatherer)
    sender = UdpConnect("127.0.0.1", inner.local_address[1])
    await sender.open(Recorder())
    for _ in range(3):
        sender.write(b"datagram")
    await eventually(lambda: len(gatherer.pieces) == 3)
    assert link.reports_bursts
    assert gatherer.bursts[-1] == 3
    assert len(gatherer.bursts) <= 3
    for endpoint in (link, sender):
        endpoint.close()
        await endpoint.wait_closed()
    assert not inner.reports_bursts
