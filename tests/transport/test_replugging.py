"""Serial devices unplugged and plugged in again, servers that close and open again: with real ports and sockets."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from far_end import FarEnd, far_end
from link_harness import Recorder, each_loop, eventually

from aerokit.transport import ReconnectingLink, SerialLink, TcpConnect, TcpListen, UdpConnect, UdpListen

SOON = {"min_delay_s": 0.01, "max_delay_s": 0.05}


class Replugged(Recorder):
    """Counts how often the link was back."""

    def __init__(self) -> None:
        super().__init__()
        self.away, self.back = 0, 0

    def link_interrupted(self, error: OSError) -> None:
        self.away += 1
        self._changed.set()

    def link_restored(self, away_s: float) -> None:
        self.back += 1
        self._changed.set()


def plug_in(far: FarEnd, name: Path) -> None:
    """Link the device under a stable name, as udev does, independent of its current device file."""
    os.symlink(far.device, name)
    far.reads()


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@each_loop
async def test_serial_device_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    name, recorder = tmp_path / "ttyACM0", Replugged()
    link = ReconnectingLink(lambda: SerialLink(str(name), 115200), **SOON)
    with far_end() as first, far_end() as second:
        plug_in(first, name)
        await link.open(recorder)
        await first.sends(b"one ")
        await recorder.until_data(b"one ")
        first.unplug()
        name.unlink()
        await recorder.until(lambda: recorder.away == 1)
        link.write(b"into the void")
        plug_in(second, name)
        await eventually(lambda: link._is_up)  # a port that is opened forgets what came before
        await second.sends(b"two")
        await recorder.until_data(b"one two")
        link.write(b"hello")
        await second.recorder.until_data(b"hello")
        link.close()
        await link.wait_closed()
    assert (recorder.away, recorder.back, recorder.losses, link.dropped_writes) == (1, 1, [], 1)


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@each_loop
async def test_closed_while_the_device_is_unplugged(tmp_path: Path) -> None:
    name, recorder = tmp_path / "ttyACM0", Replugged()
    link = ReconnectingLink(lambda: SerialLink(str(name)), **SOON)
    with far_end() as far:
        plug_in(far, name)
        await link.open(recorder)
        far.unplug()
        await recorder.until(lambda: recorder.away == 1)
        link.close()
        await link.wait_closed()
    assert recorder.losses == []


@each_loop
@pytest.mark.parametrize("reset", [False, True], ids=["end of file", "reset"])
async def test_server_closes_and_opens_again(reset: bool) -> None:
    clients, recorder = Recorder(), Replugged()
    server = TcpListen("127.0.0.1", 0)
    await server.open(clients)
    port = server.local_address[1]
    link = ReconnectingLink(lambda: TcpConnect("127.0.0.1", port), **SOON)
    await link.open(recorder)
    await eventually(lambda: bool(server.peers))
    server.write(b"one ")
    await recorder.until_data(b"one ")
    if reset:
        for stream in server._streams:
            stream._transport.abort()  # type: ignore[union-attr]
    server.close()
    await server.wait_closed()
    await recorder.until(lambda: recorder.away == 1)
    again = TcpListen("127.0.0.1", port)
    await again.open(clients)
    await eventually(lambda: bool(again.peers))
    again.write(b"two")
    await recorder.until_data(b"one two")
    link.write(b"hello")
    await clients.until_data(b"hello")
    for endpoint in (link, again):
        endpoint.close()
        await endpoint.wait_closed()
    assert (recorder.away, recorder.back, recorder.losses) == (1, 1, [])


@each_loop
async def test_disconnected_client_is_no_peer() -> None:
    recorder, server = Recorder(), TcpListen("127.0.0.1", 0)
    await server.open(recorder)
    client = TcpConnect("127.0.0.1", server.local_address[1])
    await client.open(Recorder())
    client.write(b"x")
    await recorder.until_data(b"x")
    (peer,) = recorder.peers
    assert server.has_peer(peer)
    client.close()
    await eventually(lambda: not server.has_peer(peer))
    server.close()
    await server.wait_closed()


@each_loop
async def test_unknown_sender_is_no_peer() -> None:
    recorder, listening = Recorder(), UdpListen("127.0.0.1", 0)
    await listening.open(recorder)
    talking = UdpConnect("127.0.0.1", listening.local_address[1])
    await talking.open(Recorder())
    assert not listening.has_peer(talking.local_address)
    talking.write(b"x")
    await recorder.until_data(b"x")
    assert listening.has_peer(recorder.peers[0])
    for link in (talking, listening):
        link.close()
        await link.wait_closed()
