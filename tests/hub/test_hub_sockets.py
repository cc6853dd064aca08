"""A hub on real sockets of this machine, with several clients of one endpoint."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import anyio
import pytest
from hub_stage import COPTER, STATION, Program, until

import aerokit
from aerokit.hub import Endpoint, EndpointStatistics, Hub, HubEvent
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import CommandLong, Statustext
from aerokit.sim import SimulatedCopter, open_simulator
from aerokit.transport import create_link

pytestmark = pytest.mark.anyio

ORDER = CommandLong(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)


def of(hub: Hub, name: str) -> EndpointStatistics:
    return next(endpoint for endpoint in hub.endpoints if endpoint.name == name)


def to(statistics: EndpointStatistics, scheme: str) -> Any:
    return create_link(f"{scheme}:{statistics.address.partition(':')[2]}")


async def test_clients_of_a_server_are_routed_separately() -> None:
    async with Hub([Endpoint("tcpin:127.0.0.1:0", name="tcp")]) as hub:
        links = [to(of(hub, "tcp"), "tcp") for _ in range(3)]
        async with Program(1, 1, links[0]) as copter, Program(255, 190, links[1]) as station:
            async with Program(9, 9, links[2]) as silent:
                await until(lambda: of(hub, "tcp").peers == 3)
                copter.send(COPTER)
                await until(lambda: silent.received and station.received)
                station.send(STATION, ORDER)
                await until(lambda: len(copter.received) == 2)
                await until(lambda: len(silent.received) == 2)
                assert silent.received == ["HEARTBEAT", "HEARTBEAT"], "a silent client receives broadcasts"
                assert copter.received == ["HEARTBEAT", "COMMAND_LONG"]
            await until(lambda: of(hub, "tcp").peers == 2)
            assert of(hub, "tcp").systems == ((1, 1), (255, 190))
        await until(lambda: of(hub, "tcp").peers == 0)
        assert of(hub, "tcp").systems == ()
        assert of(hub, "tcp").frames_in == 3


async def test_connecting_and_disconnecting_clients_are_reported() -> None:
    async with Hub([Endpoint("tcpin:127.0.0.1:0", name="tcp"), Endpoint("udpin:127.0.0.1:0")]) as hub:
        events: list[HubEvent] = []
        hub.on_event(events.append)
        async with Program(1, 1, to(of(hub, "tcp"), "tcp")):
            await until(lambda: events)
            (joined,) = events
            assert (joined.endpoint, joined.kind) == ("tcp", "client_joined")
            assert joined.text.startswith("client 127.0.0.1:")
        await until(lambda: len(events) == 2)
        assert events[1].kind == "client_left"
        assert events[1].text == joined.text.replace("has connected", "has disconnected")
        async with Program(1, 1, to(hub.endpoints[1], "udpout")) as sender:
            sender.send(COPTER)
            await until(lambda: hub.endpoints[1].peers == 1)
    assert [event.kind for event in events] == ["client_joined", "client_left"]


async def test_udp_senders_are_separate_and_noise_is_ignored() -> None:
    async with Hub([Endpoint("udpin:127.0.0.1:0", name="udp")]) as hub:
        links = [to(of(hub, "udp"), "udpout") for _ in range(3)]
        async with (
            Program(1, 1, links[0]) as copter,
            Program(255, 190, links[1]) as station,
            Program(9, 9, links[2]) as noisy,
        ):
            station.send(STATION)
            noisy.link.write(b"GET / HTTP/1.0\r\n\r\n")
            await until(lambda: of(hub, "udp").peers == 1)
            copter.send(COPTER)
            await until(lambda: station.received)
            station.send(ORDER)
            await until(lambda: copter.received)
            assert of(hub, "udp").peers == 2
            assert copter.received == ["COMMAND_LONG"]
            assert noisy.frames == []
            assert of(hub, "udp").bad_bytes >= 18


async def test_only_allowed_peers_are_accepted() -> None:
    async with Hub([Endpoint("tcpin:127.0.0.1:0", name="tcp", peers=["10.9.9.9"])]) as hub:
        async with Program(1, 1, to(of(hub, "tcp"), "tcp")) as copter:
            await until(lambda: copter.is_lost)
        assert of(hub, "tcp").frames_in == 0


async def test_client_that_does_not_read_affects_no_other() -> None:
    async with Hub([Endpoint("tcpin:127.0.0.1:0", name="tcp"), Endpoint("udpin:127.0.0.1:0", name="udp")]) as hub:
        host, _, port = of(hub, "tcp").address.partition(":")[2].rpartition(":")
        with socket.socket() as stalled:
            stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stalled.connect((host, int(port)))
            async with (
                Program(255, 190, to(of(hub, "tcp"), "tcp")) as station,
                Program(1, 1, to(of(hub, "udp"), "udpout")) as copter,
            ):
                await until(lambda: of(hub, "tcp").peers == 2)
                for number in range(4_000):
                    copter.send(Statustext(6, f"{number:050}"))
                    if number % 50 == 0:
                        await until(lambda: len(station.frames) > number - 200)  # noqa: B023
                await until(lambda: len(station.frames) == 4_000)
                assert of(hub, "tcp").waiting <= 1024
                assert of(hub, "tcp").dropped["queue_full"] > 0
                assert stalled.recv(10)


async def test_two_hubs_in_a_circle_forward_frames_once() -> None:
    async with (
        Hub([Endpoint("udpin:127.0.0.1:0", name="one"), Endpoint("tcpin:127.0.0.1:0", name="two")]) as first,
        Hub([to(of(first, "one"), "udpout"), to(of(first, "two"), "tcp")]) as second,
    ):
        copter, station = Program(1, 1), Program(255, 190)
        async with copter, station:
            await first.add(copter.endpoint("copter"))
            await second.add(station.endpoint("station"))
            station.send(STATION)
            await until(lambda: copter.received)
            await until(lambda: of(first, "one").systems == ((255, 190),))
            copter.send(COPTER)
            await until(lambda: station.received)
            for _ in range(50):
                copter.send(Statustext(6, "hello"))
                station.send(ORDER)
                await asyncio.sleep(0.001)
            await until(lambda: len(station.frames) == 51)
            await until(lambda: len(copter.frames) == 51)
            await asyncio.sleep(0.1)
            assert len(station.frames) == len(copter.frames) == 51


async def test_program_shares_its_link_by_one_argument() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    async with (
        open_simulator(SimulatedCopter(boot_time_s=0.0), "tcpin:127.0.0.1:0") as server,
        aerokit.connect(f"tcp:{server.addresses[0].partition(':')[2]}", share=[f"tcpin:127.0.0.1:{port}"]) as program,
        aerokit.connect(f"tcp:127.0.0.1:{port}", source_system=250, rates={}) as station,
    ):
        assert len(await station.parameters.download()) == len(await program.parameters.download())


async def test_reader_gets_complete_frames() -> None:
    async with Hub([Endpoint("udpin:127.0.0.1:0", name="in"), Endpoint("tcpin:127.0.0.1:0", name="out")]) as hub:
        host, _, port = of(hub, "out").address.partition(":")[2].rpartition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        await until(lambda: of(hub, "out").peers == 1)
        encoder, framer, link = FrameEncoder(1, 1), Framer(), to(of(hub, "in"), "udpout")
        async with Program(1, 1, link):
            for number in range(1, 301):
                link.write(encoder.encode(COPTER))
                if number % 50 == 0:  # a socket of this machine keeps some hundred datagrams at most
                    await until(lambda: of(hub, "in").frames_in == number)  # noqa: B023
            frames = 0
            with anyio.fail_after(100):
                while frames < 300:
                    frames += len(framer.receive(await reader.read(100)))
        assert framer.statistics.bad_bytes == 0
        writer.close()
