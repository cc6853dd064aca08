"""Simulated vehicles on links, on virtual time unless sockets are needed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import anyio
import pytest
from late_loop import since_the_beginning

from aerokit.errors import BusyError, InvalidArgument, LinkLost, LinkOpenError
from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavDataStream
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatorServer, simulated_link
from aerokit.transport import Link, Peer, TcpConnect, TcpListen, UdpConnect, UdpListen, memory_link_pair

pytestmark = pytest.mark.anyio


class DecodingReceiver:
    """Receiver that decodes messages."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.messages: list[Message] = []
        self.lost: LinkLost | None = None
        self._framer, self._encoder = Framer(), FrameEncoder(255, 190)
        self._heard = asyncio.Event()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.messages += [STANDARD.decode(frame) for frame in self._framer.receive(data)]
        self._heard.set()

    def link_lost(self, error: LinkLost) -> None:
        self.lost = error

    def send(self, message: Message) -> None:
        self.link.write(self._encoder.encode(message))

    def command(self, system_id: int, command: int, *params: float) -> None:
        self.send(m.CommandLong(system_id, 1, command, 0, *params, *(0.0,) * (7 - len(params))))

    async def wait_for(self, condition: Callable[[Message], bool]) -> Message:
        observed = 0
        while True:
            for message in self.messages[observed:]:
                if condition(message):
                    return message
            observed = len(self.messages)
            self._heard.clear()
            await self._heard.wait()


async def opened(link: Link) -> DecodingReceiver:
    ground = DecodingReceiver(link)
    await link.open(ground)
    return ground


async def test_flight_in_memory_runs_on_loop_time() -> None:
    copter = SimulatedCopter(boot_time_s=1.0)
    tasks = asyncio.all_tasks()
    async with simulated_link(copter) as link:
        ground = await opened(link)
        await asyncio.sleep(2.0)
        ground.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
        ground.command(1, MavCmd.DO_SET_MODE, 1, 4)
        ground.command(1, MavCmd.COMPONENT_ARM_DISARM, 1)
        ground.command(1, MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10)
        await ground.wait_for(lambda x: isinstance(x, m.GlobalPositionInt) and x.relative_alt > 9900)
        assert 11.0 < since_the_beginning() < 16.0
        assert sum(isinstance(x, m.Heartbeat) for x in ground.messages) >= since_the_beginning() - 2
        link.close()
    assert asyncio.all_tasks() == tasks


async def test_speedup_multiplies_simulated_time() -> None:
    copter = SimulatedCopter(boot_time_s=5.0)
    async with simulated_link(copter, speedup=10.0) as link:
        ground = await opened(link)
        await asyncio.sleep(2.0)
        assert copter.now == pytest.approx(20.0, abs=1.0)
        assert 18 <= sum(isinstance(x, m.Heartbeat) for x in ground.messages) <= 20
        link.close()


async def test_latency_delays_both_ways() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0), latency_s=0.3) as link:
        ground = await opened(link)
        await asyncio.sleep(1.0)
        sent_at = asyncio.get_running_loop().time()
        ground.command(1, MavCmd.DO_SEND_BANNER)
        await ground.wait_for(lambda x: isinstance(x, m.CommandAck))
        assert asyncio.get_running_loop().time() - sent_at == pytest.approx(0.6, abs=0.01)
        link.close()


async def test_several_vehicles_share_a_link() -> None:
    fleet = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2, 3)]
    async with simulated_link(fleet) as link:
        ground = await opened(link)
        await asyncio.sleep(2.5)
        ground.command(2, MavCmd.DO_SET_MODE, 1, 4)
        await ground.wait_for(lambda x: isinstance(x, m.CommandAck))
        senders = {f.system_id for x in ground.messages if isinstance(x, m.Heartbeat) and (f := x.received_frame)}
        assert senders == {1, 2, 3}
        assert [copter.mode.number for copter in fleet] == [0, 4, 0]
        link.close()


async def test_vehicle_on_two_links_has_separate_rates() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    (near, far), (other_near, other_far) = memory_link_pair(), memory_link_pair()
    async with SimulatorServer(copter, [far, other_far]):
        ground, other = await opened(near), await opened(other_near)
        await asyncio.sleep(1.0)
        ground.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 10, 1))
        await asyncio.sleep(2.0)
        assert sum(isinstance(x, m.Attitude) for x in ground.messages) >= 19
        assert {type(x) for x in other.messages} <= {
            m.Heartbeat,
            m.Statustext,
            m.HomePosition,
            m.GpsGlobalOrigin,
        }
        near.close()
        other_near.close()


async def test_vehicle_continues_without_client() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with simulated_link(copter) as link:
        await opened(link)
        link.close()
        await asyncio.sleep(5.0)
        assert copter.now == pytest.approx(5.0, abs=1.1)


async def test_exit_closes_the_link_and_is_cancellable() -> None:
    tasks = asyncio.all_tasks()
    near, far = memory_link_pair()
    async with SimulatorServer(SimulatedCopter(), far):
        ground = await opened(near)
        await asyncio.sleep(1.0)
    await asyncio.sleep(0.1)
    assert ground.lost is not None
    with anyio.move_on_after(3.0) as scope:
        async with simulated_link(SimulatedCopter()):
            await anyio.sleep_forever()
    assert scope.cancelled_caught
    assert asyncio.all_tasks() == tasks


async def test_misuse_is_explained() -> None:
    near, far = memory_link_pair()
    with pytest.raises(InvalidArgument, match="speedup"):
        SimulatorServer(SimulatedCopter(), far, speedup=0.0)
    server = SimulatorServer(SimulatedCopter(), far)
    async with server:
        with pytest.raises(BusyError):
            await server.__aenter__()
    near.close()


class TestOnSockets:
    @pytest.fixture
    def anyio_backend(self) -> tuple[str, dict[str, Any]]:
        return "asyncio", {}

    async def test_tcp_client_receives_the_boot_text(self) -> None:
        listener = TcpListen("127.0.0.1", 0)
        async with SimulatorServer(SimulatedCopter(boot_time_s=0.0), listener, speedup=20.0) as server:
            assert server.addresses == (listener.address,)
            ground = await opened(TcpConnect("127.0.0.1", listener.local_address[1]))
            await ground.wait_for(lambda x: isinstance(x, m.Heartbeat))
            ground.command(1, MavCmd.DO_SEND_BANNER)
            await ground.wait_for(lambda x: isinstance(x, m.CommandAck))
            ground.link.close()
            await ground.link.wait_closed()

    async def test_udp_works_in_both_directions(self) -> None:
        ground = await opened(UdpListen("127.0.0.1", 0))
        port = ground.link.local_address[1]  # type: ignore[attr-defined]
        async with SimulatorServer(SimulatedCopter(boot_time_s=0.0), UdpConnect("127.0.0.1", port), speedup=20.0):
            await ground.wait_for(lambda x: isinstance(x, m.Heartbeat))
            ground.command(1, MavCmd.DO_SEND_BANNER)
            await ground.wait_for(lambda x: isinstance(x, m.CommandAck))
        ground.link.close()
        await ground.link.wait_closed()

    async def test_many_vehicles_share_datagrams(self) -> None:
        ground = await opened(UdpListen("127.0.0.1", 0))
        port = ground.link.local_address[1]  # type: ignore[attr-defined]
        fleet = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in range(1, 13)]
        framer, sent = Framer(), list[bytes]()
        server = SimulatorServer(fleet, UdpConnect("127.0.0.1", port), speedup=5.0)
        server.on_datagram = lambda _now, data, is_sent: sent.append(data) if is_sent else None
        async with server:
            await ground.wait_for(lambda x: isinstance(x, m.Heartbeat))
            ground.command(7, MavCmd.DO_SET_MODE, 1, 4)
            await ground.wait_for(lambda x: isinstance(x, m.CommandAck))
        senders = [{frame.system_id for frame in framer.receive(data)} for data in sent]
        assert max(map(len, senders)) > 1
        assert set().union(*senders) == set(range(1, 13))
        assert max(map(len, sent)) <= 1200
        assert [copter.mode.number for copter in fleet] == [4 if number == 7 else 0 for number in range(1, 13)]
        ground.link.close()
        await ground.link.wait_closed()

    async def test_address_in_use_closes_other_links(self) -> None:
        first = TcpListen("127.0.0.1", 0)
        async with SimulatorServer(SimulatedCopter(), first):
            second = TcpListen("127.0.0.1", first.local_address[1])
            with pytest.raises(LinkOpenError):
                async with SimulatorServer(SimulatedCopter(), [TcpListen("127.0.0.1", 0), second]):
                    pass
