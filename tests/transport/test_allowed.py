"""``peers=``: accepted senders of links that receive from any host."""

from __future__ import annotations

import ipaddress
import socket
from typing import Any

import pytest
from link_harness import Recorder, each_loop, eventually

import aerokit
import aerokit.sync
from aerokit.errors import InvalidArgument
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.testing import FaultyLink
from aerokit.transport import (
    Link,
    ReconnectingLink,
    TcpConnect,
    TcpListen,
    UdpBroadcast,
    UdpConnect,
    UdpListen,
    create_link,
    tcp,
    udp,
)
from aerokit.transport.sockets import AllowedPeers


@pytest.mark.parametrize(
    ("peers", "inside", "outside"),
    [
        ("10.0.0.7", ["10.0.0.7", "::ffff:10.0.0.7"], ["10.0.0.8", "::1"]),
        ("10.0.0.0/24", ["10.0.0.1", "10.0.0.255"], ["10.0.1.1"]),
        (["10.0.0.7", "fd00::/8"], ["10.0.0.7", "fd00::5"], ["10.0.0.6", "fe80::1%eth0"]),
        (ipaddress.ip_address("10.0.0.7"), ["10.0.0.7"], ["10.0.0.8"]),
        (ipaddress.ip_network("10.0.0.0/30"), ["10.0.0.3"], ["10.0.0.4"]),
        ({ipaddress.ip_network("fe80::/64"), "127.0.0.1"}, ["fe80::1%eth0", "127.0.0.1"], ["127.0.0.2"]),
        (None, ["1.2.3.4", "::1"], []),
    ],
)
def test_addresses_and_networks(peers: Any, inside: list[str], outside: list[str]) -> None:
    allowed = AllowedPeers(peers)
    assert [host for host in (*inside, *outside) if allowed.allows(host)] == inside


@pytest.mark.parametrize("peers", ["", "10.0.0", "10.0.0.1/24", "copter", [], 7, [7], b"abcd", [None], 1.5])
def test_invalid_peers_are_refused(peers: Any) -> None:
    with pytest.raises(InvalidArgument, match="peers"):
        AllowedPeers(peers)


@pytest.mark.parametrize("address", ["udpin:127.0.0.1:0", "tcpin:127.0.0.1:0", "udpbcast:127.255.255.255:1"])
def test_open_links_accept_peers(address: str) -> None:
    link = create_link(address, peers="10.0.0.7")
    assert isinstance(link, (UdpListen, TcpListen, UdpBroadcast))
    assert not link._allowed.allows("10.0.0.8")


@pytest.mark.parametrize("address", ["udpout:127.0.0.1:1", "tcp:127.0.0.1:1", "/dev/ttyACM0", "a.tlog", "pty"])
def test_other_links_refuse_peers(address: str) -> None:
    with pytest.raises(InvalidArgument, match=r"peers = … is not allowed with .*only udpin, udpbcast and tcpin"):
        create_link(address, peers="10.0.0.7")


@pytest.mark.anyio
async def test_link_object_has_its_own_peers() -> None:
    with pytest.raises(InvalidArgument, match="pass them to UdpListen"):
        async with aerokit.open_connection(UdpListen("127.0.0.1", 0), peers="10.0.0.7"):
            pytest.fail("not allowed")
    with pytest.raises(InvalidArgument, match=r"peers: 'copter' is not an IP address"):
        async with aerokit.connect("udpin:127.0.0.1:0", peers="copter"):
            pytest.fail("no address")
    with pytest.raises(InvalidArgument, match=r"peers: 'copter' is not an IP address"):
        aerokit.sync.connect("udpin:127.0.0.1:0", peers="copter")


@pytest.mark.anyio
async def test_open_connection_has_its_own_peers() -> None:
    async with aerokit.open_connection("udpin:127.0.0.1:0") as connection:
        wrong: list[dict[str, Any]] = [{"peers": "10.0.0.7"}, {"may_move": True}]
        for options in wrong:
            with pytest.raises(InvalidArgument, match="pass them to open_connection"):
                async with aerokit.connect(connection, **options):
                    pytest.fail("not allowed")


@each_loop
async def test_udp_accepts_only_allowed_peers() -> None:
    link, recorder = UdpListen("127.0.0.1", 0, peers="127.0.0.2"), Recorder()
    await link.open(recorder)
    with socket.socket(type=socket.SOCK_DGRAM) as stranger, socket.socket(type=socket.SOCK_DGRAM) as vehicle:
        stranger.bind(("127.0.0.1", 0))
        vehicle.bind(("127.0.0.2", 0))
        for sender, data in ((stranger, b"no"), (vehicle, b"yes"), (stranger, b"no"), (vehicle, b"!")):
            sender.sendto(data, link.local_address)
        await recorder.until_data(b"yes!")
        assert link.peers == (vehicle.getsockname(),)
    link.close()
    await link.wait_closed()


@each_loop
async def test_tcp_accepts_only_allowed_peers() -> None:
    link, recorder = TcpListen("127.0.0.1", 0, peers=["10.0.0.7", "fd00::/8"]), Recorder()
    await link.open(recorder)
    client, answered = TcpConnect(*link.local_address), Recorder()
    await client.open(answered)
    assert "closed the connection" in str(await answered.until_lost()) or answered.losses
    assert link.peers == ()
    for endpoint in (client, link):
        endpoint.close()
        await endpoint.wait_closed()


# ------------------------------------------------------------ a receiver that decides about peers


class PeerKeeper(Recorder):
    keeps_peers = True


@pytest.mark.parametrize("wrap", [lambda link: link, FaultyLink, lambda link: ReconnectingLink(lambda: link)])
@each_loop
async def test_only_kept_peers_are_written_to(wrap: Any) -> None:
    inner = UdpListen("127.0.0.1", 0)
    link: Link = wrap(inner)
    keeper = PeerKeeper()
    await link.open(keeper)
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as two:
        for sender in (one, two):
            sender.bind(("127.0.0.1", 0))
            sender.setblocking(False)
            sender.sendto(b"x", inner.local_address)
        await keeper.until(lambda: len(keeper.pieces) == 2)
        assert inner.peers == ()
        link.keep_peer(one.getsockname())
        assert link.host_of(one.getsockname()) == "127.0.0.1"
        link.write(b"to all")
        link.write(b"to two", two.getsockname())
        assert link.dropped_writes == 1
        link.forget_peer(one.getsockname())
        link.write(b"to nobody")
        await eventually(lambda: one.recv(100) == b"to all")
        with pytest.raises(BlockingIOError):
            two.recv(100)
    link.close()
    await link.wait_closed()


@each_loop
async def test_noise_evicts_no_vehicle_from_udp_port() -> None:
    """300 one-byte datagrams from 300 ports, as the review sent them."""
    async with aerokit.open_connection("udpin:127.0.0.1:0") as connection:
        link = connection.link
        assert isinstance(link, UdpListen)
        with socket.socket(type=socket.SOCK_DGRAM) as vehicle:
            vehicle.bind(("127.0.0.1", 0))
            frame = FrameEncoder(1, 1).encode(aerokit.messages.Heartbeat(2, 3, 81, 0, 3))
            vehicle.sendto(frame, link.local_address)
            await eventually(lambda: (1, 1) in connection.heartbeats)
            for _ in range(300):
                with socket.socket(type=socket.SOCK_DGRAM) as stranger:
                    stranger.sendto(b"\xfd", link.local_address)
            vehicle.sendto(frame, link.local_address)
            await eventually(lambda: connection.counts(1)[0] == 2)
            assert link.peers == (vehicle.getsockname(),)


@each_loop
async def test_silent_client_makes_room_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "MAX_CLIENTS", 1)
    link, keeper = TcpListen("127.0.0.1", 0), PeerKeeper()
    await link.open(keeper)
    mute, mute_recorder = TcpConnect(*link.local_address), Recorder()
    await mute.open(mute_recorder)
    await eventually(lambda: len(link.peers) == 1)
    vehicle, vehicle_recorder = TcpConnect(*link.local_address), Recorder()
    await vehicle.open(vehicle_recorder)
    await mute_recorder.until_lost()
    vehicle.write(b"frame")
    await keeper.until_data(b"frame")
    link.keep_peer(link.peers[0])
    third, third_recorder = TcpConnect(*link.local_address), Recorder()
    await third.open(third_recorder)
    await third_recorder.until_lost()
    assert vehicle_recorder.losses == []
    link.forget_peer(link.peers[0])
    fourth = TcpConnect(*link.local_address)
    await fourth.open(Recorder())
    await vehicle_recorder.until_lost()
    for endpoint in (mute, vehicle, third, fourth, link):
        endpoint.close()
        await endpoint.wait_closed()


# ------------------------------------------------------------------------------------ udpbcast


@each_loop
async def test_broadcast_resumes_after_silence_and_accepts_other_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as everybody, socket.socket(type=socket.SOCK_DGRAM) as first:
        for sock in (everybody, first):
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
        link, recorder = UdpBroadcast(*everybody.getsockname()), Recorder()
        await link.open(recorder)
        port = link.local_address[1]
        first.sendto(b"1", ("127.0.0.1", port))
        await recorder.until_data(b"1")
        link.write(b"to first")
        await eventually(lambda: received(first) == b"to first")
        with socket.socket(type=socket.SOCK_DGRAM) as again:
            again.bind(("127.0.0.1", 0))
            again.setblocking(False)
            again.sendto(b"no", ("127.0.0.1", port))
            monkeypatch.setattr(udp, "REMOTE_TIMEOUT_S", -1.0)
            link.write(b"anybody?")
            await eventually(lambda: received(everybody) == b"anybody?")
            again.sendto(b"2", ("127.0.0.1", port))
            await recorder.until(lambda: recorder.data.endswith(b"2"))
            monkeypatch.setattr(udp, "REMOTE_TIMEOUT_S", 3600.0)
            link.write(b"to again")
            await eventually(lambda: received(again) == b"to again")
        link.close()
        await link.wait_closed()


def test_silent_vehicle_is_searched_by_broadcast() -> None:
    assert udp.REMOTE_TIMEOUT_S == SILENT_AFTER_S


@each_loop
async def test_vehicle_on_broadcast_link_may_change_port() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as everybody:
        everybody.bind(("127.0.0.1", 0))
        link, keeper = UdpBroadcast(*everybody.getsockname()), PeerKeeper()
        await link.open(keeper)
        with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as two:
            for sock in (one, two):
                sock.bind(("127.0.0.1", 0))
                sock.setblocking(False)
            one.sendto(b"1", ("127.0.0.1", link.local_address[1]))
            await keeper.until_data(b"1")
            link.keep_peer(one.getsockname())
            two.sendto(b"2", ("127.0.0.1", link.local_address[1]))
            await keeper.until_data(b"12")
            assert keeper.peers == [one.getsockname(), two.getsockname()]
            link.keep_peer(two.getsockname())
            link.write(b"found")
            await eventually(lambda: received(two) == b"found")
            assert received(one) == b""
        link.close()
        await link.wait_closed()


@each_loop
async def test_message_for_silent_vehicle_is_not_broadcast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Others of the same system id would obey."""
    with socket.socket(type=socket.SOCK_DGRAM) as everybody, socket.socket(type=socket.SOCK_DGRAM) as one:
        for sock in (everybody, one):
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
        link = UdpBroadcast(*everybody.getsockname())
        await link.open(PeerKeeper())
        link.keep_peer(one.getsockname())
        monkeypatch.setattr(udp, "REMOTE_TIMEOUT_S", -1.0)
        link.write(b"an order", one.getsockname())
        link.write(b"heartbeat")
        await eventually(lambda: received(one) == b"an order")
        await eventually(lambda: received(everybody) == b"heartbeat")
        assert received(everybody) == b""
        link.close()
        await link.wait_closed()


def received(sock: socket.socket) -> bytes:
    try:
        return sock.recv(1000)
    except BlockingIOError:
        return b""


def test_udpout_accepts_one_address() -> None:
    assert isinstance(create_link("udpout:127.0.0.1:1"), UdpConnect)
