"""``connect(reconnect=True)``: the link fails and is restored, and the program continues."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from leak_check import run_and_do

from aerokit import LinkState, Signing, SigningKey, Vehicle, connect, events, open_connection
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.errors import (
    CommandTimeout,
    ConnectionClosed,
    InvalidArgument,
    LinkLost,
    OperationRejected,
    RecordingEnded,
    SetpointStreamStopped,
)
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.framer import Framer
from aerokit.missions import Mission
from aerokit.missions.navigation import waypoint
from aerokit.sim import SimulatedCopter, open_simulator, simulated_link
from aerokit.transport import Link, Peer, ReconnectingLink, TcpConnect, TcpListen
from aerokit.transport.link import BaseLink

pytestmark = pytest.mark.anyio

NEWS = (
    events.LinkInterrupted,
    events.LinkRestored,
    events.VehicleSilent,
    events.VehicleRecovered,
    events.VehicleRebooted,
    events.LinkClosed,
)


class CableEnd(BaseLink):
    """The program's end of the cable; open while the cable is plugged in."""

    def __init__(self, cable: Cable) -> None:
        super().__init__("cable")
        self._cable = cable

    async def _connect(self) -> None:
        if not self._cable.is_plugged:
            raise OSError(errno.ENODEV, "no such device")
        self._cable.end = self

    def _release(self) -> None:
        if self._cable.end is self:
            self._cable.end = None

    def write(self, data: bytes, peer: Peer = None) -> None:
        self._cable.write(data)

    def receive(self, data: bytes) -> None:
        self._deliver(data)

    def break_off(self) -> None:
        self._lose("unplugged")


class Cable:
    """Cable to a simulated vehicle, which can be unplugged and plugged in."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.is_plugged = True
        self.end: CableEnd | None = None
        self.sent: list[m.CommandLong] = []
        self._framer = Framer()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        if self.end is not None:
            self.end.receive(data)

    def link_lost(self, error: LinkLost) -> None:
        """The vehicle was switched off for good."""

    def write(self, data: bytes) -> None:
        for frame in self._framer.receive(data):
            message = STANDARD.decode(frame)
            if isinstance(message, m.CommandLong):
                self.sent.append(message)
        self.link.write(data)

    def pull(self) -> None:
        self.is_plugged = False
        assert self.end is not None
        self.end.break_off()

    def plug_in(self) -> None:
        self.is_plugged = True

    async def is_away(self, seconds: float) -> None:
        self.pull()
        await anyio.sleep(seconds)
        self.plug_in()

    def asked_for(self, kind: type[m.Attitude]) -> int:
        """Number of requests to the vehicle for this message."""
        return sum(
            message.command == MavCmd.SET_MESSAGE_INTERVAL and message.param1 == kind.ID for message in self.sent
        )


@asynccontextmanager
async def cabled(copter: SimulatedCopter | None = None, **options: Any) -> AsyncIterator[tuple[Cable, Vehicle]]:
    async with simulated_link(copter or SimulatedCopter(boot_time_s=0)) as link:
        cable = Cable(link)
        await link.open(cable)
        try:
            async with connect(ReconnectingLink(lambda: CableEnd(cable)), **options) as vehicle:
                yield cable, vehicle
        finally:
            link.close()


# ---------------------------------------------------------------------------- a program continues


async def test_interruption_events() -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        with vehicle.subscribe(*NEWS, capacity=9) as news:
            await cable.is_away(6)
            received = [await news.get(10) for _ in range(4)]
        assert [type(event).__name__ for event in received] == [
            "LinkInterrupted",
            "VehicleSilent",
            "LinkRestored",
            "VehicleRecovered",
        ]
        interrupted, _, restored, _ = received
        assert isinstance(interrupted, events.LinkInterrupted)
        assert str(interrupted.error) == "cable: unplugged"
        assert isinstance(restored, events.LinkRestored)
        assert restored.away_s == pytest.approx(restored.at - interrupted.at)
        assert vehicle.connection.is_open


async def test_rates_commands_and_parameters_continue_after_interruption() -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        asked = cable.asked_for(m.Attitude)
        with vehicle.subscribe(m.Attitude, capacity=100) as attitudes:
            await cable.is_away(3)
            await vehicle.position.wait_until(lambda _: vehicle.position.age < 0.5, timeout=10)
            await attitudes.get(5)
        await anyio.sleep(1)
        assert cable.asked_for(m.Attitude) > asked
        await vehicle.arm()
        assert len(await vehicle.parameters.download()) > 100


async def test_calls_during_interruption_only_time_out() -> None:
    async with cabled() as (cable, vehicle):
        cable.pull()
        vehicle.send(m.Ping(0, 0, 0, 0))
        with pytest.raises(CommandTimeout, match=r"last heartbeat \d"):
            await vehicle.command(MavCmd.DO_SEND_BANNER)
        assert vehicle.connection.link.dropped_writes >= 5
        cable.plug_in()
        await anyio.sleep(6)
        await vehicle.command(MavCmd.DO_SEND_BANNER)


@pytest.mark.parametrize(
    "order",
    [
        lambda vehicle: vehicle.arm(),
        lambda vehicle: vehicle.reboot(),
        lambda vehicle: vehicle.terminate(intent="terminate flight"),
    ],
    ids=["arm", "reboot", "terminate"],
)
async def test_order_without_link_says_that_it_was_not_sent(order: Callable[[Vehicle], Awaitable[None]]) -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        cable.pull()
        with pytest.raises(CommandTimeout, match="was not sent, because there was no usable link") as raised:
            await order(vehicle)
        assert not raised.value.was_sent
        assert not re.search("may|nevertheless|disarms it", str(raised.value))


async def test_replaced_order_without_link_says_that_it_was_not_sent() -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        cable.pull()
        replaced = asyncio.create_task(vehicle.set_mode("GUIDED"))
        await anyio.sleep(0.1)
        with pytest.raises(CommandTimeout, match="was not sent"):
            await vehicle.set_mode("LOITER")
        with pytest.raises(OperationRejected, match="MAV_CMD_DO_SET_MODE was not sent: another order was given"):
            await replaced


async def test_recording_has_only_messages_that_link_accepted(tmp_path: Path) -> None:
    """A report would otherwise attribute a change of mode to an order that was not sent."""
    orders = [m.CommandLong(1, 1, MavCmd.DO_SET_MODE, 0, 1, number, 0, 0, 0, 0, 0) for number in (3, 4)]
    async with cabled(record=tmp_path / "flight.tlog") as (cable, vehicle):
        vehicle.send(orders[0])
        cable.pull()
        vehicle.send(orders[1])
    recorded = (tmp_path / "flight.tlog").read_bytes()
    assert [order.encode().rstrip(b"\0") in recorded for order in orders] == [True, False]


async def test_pilot_who_arms_after_unsent_arming_keeps_vehicle() -> None:
    copter = SimulatedCopter(boot_time_s=0)
    async with cabled(copter) as (cable, vehicle):
        await vehicle.wait_ready()
        cable.pull()
        with pytest.raises(CommandTimeout, match="was not sent"):
            await vehicle.arm()
        assert copter.arming.arm()
        cable.plug_in()
        await vehicle.armed.wait_until(bool, timeout=10)
        assert not vehicle._arbiter.is_flown_by_program


async def test_order_is_sent_when_link_is_restored() -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        async with anyio.create_task_group() as tasks:
            cable.pull()
            tasks.start_soon(vehicle.set_mode, "GUIDED")
            await anyio.sleep(0.5)
            cable.plug_in()
        assert vehicle.mode_name == "GUIDED"


async def test_transfer_and_flight_survive_short_interruption() -> None:
    async with cabled() as (cable, vehicle):
        await vehicle.wait_ready()
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(vehicle.take_off, 10)
            await anyio.sleep(2)
            await cable.is_away(2)
        assert vehicle.position.value.altitude_relative_m == pytest.approx(10, abs=1)
        tables: list[Any] = []

        async def download() -> None:
            tables.append(await vehicle.parameters.download(method="list"))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(download)
            await anyio.sleep(0.5)
            await cable.is_away(2)
        assert len(tables[0]) > 100


async def test_vehicle_switched_off_with_its_cable() -> None:
    copter = SimulatedCopter(boot_time_s=3)
    async with cabled(copter) as (cable, vehicle):
        await vehicle.wait_ready()
        await anyio.sleep(20)
        with vehicle.subscribe(events.VehicleRebooted) as reboots:
            cable.pull()
            copter.reboot(1.0)
            await anyio.sleep(5)
            cable.plug_in()
            await reboots.get(20)
        await vehicle.wait_ready()


@asynccontextmanager
async def cabled_beside_other() -> AsyncIterator[tuple[Cable, Vehicle, SimulatedCopter, Callable[[], Awaitable[None]]]]:
    """Yield a cable to a vehicle, another vehicle with the same ids, and a function that plugs the cable into it."""
    other = SimulatedCopter(boot_time_s=0)
    async with simulated_link(other) as other_link:
        await anyio.sleep(60)
        async with cabled() as (cable, vehicle):

            async def exchange() -> None:
                cable.pull()
                cable.link.close()
                cable.link = other_link
                await other_link.open(cable)
                cable.plug_in()

            await vehicle.wait_ready()
            await anyio.sleep(8)
            yield cable, vehicle, other, exchange


async def test_other_vehicle_on_restored_link_is_not_taken_for_first() -> None:
    async with cabled_beside_other() as (_, vehicle, other, exchange):
        name = "FENCE_ALT_MAX"
        other.parameters[name] = 77.0
        await vehicle.parameters.download()
        with (
            vehicle.subscribe(events.LinkRestored) as restored,
            vehicle.subscribe(events.VehicleRebooted) as reboots,
        ):
            await exchange()
            await restored.get(10)
            writes = await vehicle.parameters.upload({name: 100.0})
            await reboots.get(5)
        assert (writes[name].outcome, other.parameters[name]) == ("set", 100.0)


async def test_order_is_not_repeated_to_other_vehicle_on_restored_link() -> None:
    async with cabled_beside_other() as (cable, vehicle, other, exchange):
        await exchange()
        with pytest.raises(OperationRejected, match="same boot of the same vehicle"):
            await vehicle.set_mode("GUIDED")
        assert other.mode.name == "STABILIZE"
        assert not any(message.command == MavCmd.DO_SET_MODE for message in cable.sent)


async def test_setpoints_are_not_sent_to_other_vehicle_on_restored_link() -> None:
    async with cabled_beside_other() as (_, vehicle, other, exchange):
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(10)
        received: list[m.SetPositionTargetLocalNed] = []
        other.observe(m.SetPositionTargetLocalNed, lambda message, _: received.append(message))
        with pytest.raises(SetpointStreamStopped, match="same boot of the same vehicle"):
            async with vehicle.guided.velocity(valid_for_s=60):
                await anyio.sleep(1)
                await exchange()
                await anyio.sleep(4)
        assert not received


async def test_restored_link_to_other_vehicle_gets_no_signing_key() -> None:
    async with cabled_beside_other() as (_, vehicle, other, exchange):
        received: list[object] = []
        other.observe(m.SetupSigning, lambda message, _: received.append(message))
        await exchange()
        with pytest.raises(OperationRejected, match="same boot of the same vehicle"):
            await vehicle.setup_signing(Signing(SigningKey(b"k" * 32)))
        assert not received


async def test_restored_link_to_other_vehicle_gets_no_rest_of_order() -> None:
    async with cabled_beside_other() as (_, vehicle, _, exchange):
        await exchange()
        with pytest.raises(OperationRejected, match="nothing was sent over this link"):
            await vehicle._session.wait_for_heartbeat()


async def test_logs_of_other_vehicle_on_restored_link_are_not_erased() -> None:
    async with cabled_beside_other() as (_, vehicle, other, exchange):
        entries = await vehicle.logs.list()
        received: list[object] = []
        other.observe(m.LogErase, lambda message, _: received.append(message))

        async def exchange_soon() -> None:
            await anyio.sleep(0.5)
            await exchange()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(exchange_soon)
            with pytest.raises(OperationRejected, match="same boot of the same vehicle"):
                await vehicle.logs.erase()
        assert not received
        assert await vehicle.logs.list() == entries


@pytest.mark.parametrize("transfer", ["parameters", "upload", "log"])
async def test_transfer_does_not_mix_vehicles_of_restored_link(transfer: str) -> None:
    async with cabled_beside_other() as (_, vehicle, other, exchange):
        mission = Mission([waypoint(vehicle.position.value.replace(altitude_relative_m=20.0))] * 200)
        (entry, *_) = await vehicle.logs.list()
        has_begun = anyio.Event()

        def on_progress(_: object) -> None:
            has_begun.set()

        calls: dict[str, Callable[[], Awaitable[object]]] = {
            "parameters": lambda: vehicle.parameters.download(method="list", on_progress=on_progress),
            "upload": lambda: vehicle.mission.upload(mission, method="items", on_progress=on_progress),
            "log": lambda: vehicle.logs.read(entry, method="log", on_progress=on_progress),
        }
        received: list[object] = []
        for kind in (m.MissionCount, m.MissionItemInt, m.MissionAck, m.LogRequestData, m.ParamRequestRead):
            other.observe(kind, lambda message, _: received.append(message))

        async def exchange_soon() -> None:
            await has_begun.wait()
            await exchange()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(exchange_soon)
            with pytest.raises(OperationRejected, match="transfer has ended: the vehicle's clock"):
                await calls[transfer]()
        assert not received


async def test_connect_finds_vehicle_on_restored_link() -> None:
    copter = SimulatedCopter(boot_time_s=0)
    copter.faults.silent = True

    async def lose_it(cable: Cable) -> None:
        await anyio.sleep(1)
        await cable.is_away(7)
        copter.faults.silent = False

    async with simulated_link(copter) as link:
        cable = Cable(link)
        await link.open(cable)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lose_it, cable)
            async with connect(ReconnectingLink(lambda: CableEnd(cable))) as vehicle:
                assert vehicle.heartbeat_age < 1
        link.close()


async def test_partial_frame_before_a_new_stream() -> None:
    link, encoder = OneEnd(), FrameEncoder(1, 1)
    received: list[int] = []
    async with open_connection(link) as connection:
        connection.attach([m.Attitude], lambda attitude: received.append(attitude.time_boot_ms))
        frames = [encoder.encode(m.Attitude(n, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)) for n in range(3)]
        link.receive(frames[0] + frames[1][:20])
        assert link.connection is not None
        link.connection.link_interrupted(LinkLost("unplugged"))
        link.connection.link_restored(1.0)
        link.receive(frames[1][20:] + frames[2])
        (statistics,) = connection.statistics()
        assert received == [0, 2]
        assert statistics.bad_crcs == 0


class OneEnd(BaseLink):
    """A link that is nothing but its receiver."""

    def __init__(self) -> None:
        super().__init__("one end")
        self.connection: Connection | None = None

    async def _connect(self) -> None:
        assert isinstance(self._receiver, Connection)
        self.connection = self._receiver

    def _release(self) -> None:
        pass

    def write(self, data: bytes, peer: Peer = None) -> None:
        pass

    def receive(self, data: bytes) -> None:
        self._deliver(data)


# ----------------------------------------------------------------------------------- arguments


async def test_link_object_can_be_opened_only_once() -> None:
    with pytest.raises(InvalidArgument, match="ReconnectingLink"):
        async with connect(OneEnd(), reconnect=True):
            pytest.fail("it could not be opened again")
    async with open_connection(OneEnd()) as connection:
        with pytest.raises(InvalidArgument, match="pass reconnect to open_connection"):
            async with connect(connection, reconnect=True):
                pytest.fail("the connection is open already")


async def test_recording_ends_despite_reconnect(tmp_path: Any) -> None:
    path = tmp_path / "flight.tlog"
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link, record=path) as vehicle:
        await vehicle.wait_ready()
    with pytest.raises(RecordingEnded, match="end of recording"):
        async with connect(f"replay:{path}?speed=max", rates={}, reconnect=True) as vehicle:
            await vehicle.mode.wait_until(lambda _: False)


# ----------------------------------------------------------------------------------------- leaks


class Interrupted:
    """A program whose cable is pulled out and plugged in again; it can be disturbed."""

    def __init__(self) -> None:
        self.vehicle: Vehicle | None = None

    async def run(self) -> None:
        try:
            async with cabled() as (cable, self.vehicle):
                await cable.is_away(1)
                with contextlib.suppress(ConnectionClosed, OperationRejected):
                    await self.vehicle.arm()
        finally:
            self.vehicle = None

    def close(self, _task: object) -> None:
        if self.vehicle is not None:
            self.vehicle.connection.close()


@pytest.mark.exhaustive
def test_cancelled_at_any_iteration_leaves_nothing_behind() -> None:
    for turns in range(0, 150, 3):
        run_and_do(Interrupted().run, turns, lambda task: task.cancel())


@pytest.mark.exhaustive
def test_closed_at_any_iteration_leaves_nothing_behind() -> None:
    for turns in range(0, 150, 3):
        program = Interrupted()
        run_and_do(program.run, turns, program.close)


# ---------------------------------------------------------------------------- with real sockets


class TestServers:
    """A vehicle behind a TCP server that ends and is started again."""

    @pytest.fixture
    def anyio_backend(self) -> tuple[str, dict[str, Any]]:
        return "asyncio", {}

    async def test_restarted_server(self) -> None:
        copter = SimulatedCopter(boot_time_s=0)
        async with open_simulator(copter, "tcpin:127.0.0.1:0", speedup=20) as simulator:
            address = simulator.addresses[0]
            exit_stack = connect(address.replace("tcpin", "tcp"), reconnect=True)
            vehicle = await exit_stack.__aenter__()
            await vehicle.wait_ready()
        try:
            with vehicle.subscribe(events.LinkRestored) as restored:
                async with open_simulator(copter, address, speedup=20):
                    await restored.get(20)
                    # A simulation of this speed may count as another vehicle first, which ends orders in progress.
                    await vehicle.link_state.wait_until(lambda state: state is LinkState.CONNECTED, timeout=20)
                    await vehicle.position.wait_until(lambda _: vehicle.position.age < 1, timeout=20)
                    await vehicle.arm()
                    assert len(await vehicle.parameters.download()) > 100
        finally:
            await exit_stack.__aexit__(None, None, None)

    async def test_client_from_other_port_is_accepted_at_once(self) -> None:
        """A ``tcpin:`` link is never lost, and the vehicle's new connection is not a second vehicle."""
        doubles: list[events.DuplicateSender] = []
        encoder = FrameEncoder(1, 1)
        async with open_connection("tcpin:127.0.0.1:0") as connection:
            connection.bus.attach_event(events.DuplicateSender, doubles.append)
            port = int(connection.link.address.rpartition(":")[2])
            with connection.subscribe(m.Heartbeat, capacity=9) as heartbeats:
                for _ in range(2):
                    link = TcpConnect("127.0.0.1", port)
                    await link.open(IgnoringReceiver())
                    link.write(encoder.encode(m.Heartbeat(2, 3, 81, 0, 3)))
                    await heartbeats.get(20)
                    link.close()
                    await link.wait_closed()
                    await eventually_closed(connection.link)
        assert doubles == []


async def eventually_closed(link: Link) -> None:
    """Wait until the server has noticed that its client disconnected; only hung tests take 20 s."""
    assert isinstance(link, TcpListen)
    with anyio.fail_after(20):
        while link.peers:  # noqa: ASYNC110
            await asyncio.sleep(0)


class IgnoringReceiver:
    """A receiver that ignores all data."""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Ignore it."""

    def link_lost(self, error: LinkLost) -> None:
        """Ignore it."""


async def test_reopened_link_is_lost_and_then_connected() -> None:
    link = OneEnd()
    async with open_connection(link) as connection:
        with connection.subscribe(events.LinkStateChanged, capacity=20) as changes:
            assert link.connection is not None
            link.connection.link_interrupted(LinkLost("unplugged"))
            lost = await changes.get(timeout=1)
            assert (lost.before.name, lost.after.name) == ("CONNECTED", "LOST")
            link.connection.link_restored(1.0)
            back = await changes.get(timeout=1)
            assert (back.before.name, back.after.name) == ("LOST", "CONNECTED")
