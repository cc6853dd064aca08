"""Duplicate senders and full tables, on a link whose peers are named ``PORT@HOST``."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest
from flight_harness import block_loop, suspend_computer
from test_routes import ATTITUDE, COPTER, PeersLink, command

import aerokit
from aerokit import Signing, SigningKey, events, open_connection
from aerokit.connection.connection import Connection
from aerokit.connection.frame_receiver import MAX_UNVERIFIED_PEERS
from aerokit.connection.routes import MAX_OTHER_PEERS, Routes
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, CommandLong, Heartbeat, RadioStatus, SystemTime

MAX_PEERS = 256
MAX_ROUTES = 1024
MAX_SENDERS = 2048

pytestmark = pytest.mark.anyio

DISARMED = Heartbeat(2, 3, 81, 9, 3)
ARMED = Heartbeat(2, 3, 81 | 128, 4, 4)


class PeerKeepingLink(PeersLink):
    """Remembers the peers that the connection keeps, like UdpListen."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[object] = []

    def keep_peer(self, peer: object) -> None:
        self.kept.append(peer)

    def forget_peer(self, peer: object) -> None:
        self.kept.remove(peer)


class Copter:
    """A vehicle with one frame counter and one clock for all its addresses."""

    def __init__(self, link: PeerKeepingLink, first: int = 0, booted_at: float = -100.0) -> None:
        self._link, self._booted_at = link, booted_at
        self.encoder = FrameEncoder(1, 1)
        self.encoder.sequence = first

    def send(self, peer: str, *messages: Message) -> None:
        assert self._link.connection is not None
        for message in messages:
            self._link.connection.bytes_received(self.encoder.encode(message), peer)

    def send_attitude(self, peer: str) -> None:
        assert self._link.connection is not None
        boot_ms = int((self._link.connection.now() - self._booted_at) * 1000)
        self.send(peer, Attitude(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    async def live(self, peer: str, seconds: float, heartbeat: Message = ARMED) -> None:
        """Four attitudes and a heartbeat a second."""
        for count in range(round(seconds * 4)):
            if count % 4 == 0:
                self.send(peer, heartbeat)
            self.send_attitude(peer)
            await anyio.sleep(0.25)


@pytest.fixture
async def link() -> PeerKeepingLink:
    return PeerKeepingLink()


@asynccontextmanager
async def flown(link: PeerKeepingLink, **options: object) -> AsyncIterator[tuple[aerokit.Vehicle, Copter]]:
    """An armed vehicle that was received from "14550@copter" for some seconds."""
    async with open_connection(link, **options) as connection:  # type: ignore[arg-type]
        copter = Copter(link)
        copter.send("14550@copter", ARMED)
        async with aerokit.connect(connection, rates={}) as vehicle:
            await copter.live("14550@copter", 6)
            yield vehicle, copter


def is_armed(vehicle: aerokit.Vehicle) -> bool:
    return vehicle.armed.value


def signed_by(key: SigningKey) -> FrameEncoder:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(key)
    return encoder


def route_events(connection: Connection) -> list[events.Event]:
    received: list[events.Event] = []
    for kind in (events.DuplicateSender, events.RouteChanged, events.RouteChangeRefused, events.ArmedChanged):
        connection.bus.attach_event(kind, received.append)
    return received


def peer_of(vehicle: aerokit.Vehicle, link: PeerKeepingLink) -> object:
    link.sent.clear()
    vehicle.send(command(1, 1))
    (peer,) = link.peers_of(CommandLong)
    return peer


# -------------------------------------------------------------------------------------- room


async def test_noise_evicts_no_peer(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        connection = vehicle.connection
        for port in range(300):
            connection.bytes_received(b"\xfd", f"{port}@stranger")
        assert link.kept == ["14550@copter"]
        assert len(list(connection.statistics())) == 1 + MAX_UNVERIFIED_PEERS
        intruder = Copter(link, 77)
        intruder.send("666@stranger", DISARMED, DISARMED)
        assert is_armed(vehicle)
        copter.send("14550@copter", DISARMED)
        assert not is_armed(vehicle)
        assert peer_of(vehicle, link) == "14550@copter"


async def test_peer_with_live_route_is_never_evicted(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        connection = vehicle.connection
        await anyio.sleep(100)
        for port in range(2 * MAX_PEERS):
            connection.bytes_received(FrameEncoder(250, 1).encode(ATTITUDE), f"{port}@stranger")
        assert "14550@copter" in link.kept
        assert len(link.kept) == MAX_PEERS


async def test_new_sender_is_ignored_while_table_is_full(link: PeerKeepingLink) -> None:
    async with open_connection(link) as connection:
        for port in range(MAX_PEERS):
            link.receive(f"{port}@swarm", (1 + port % 250, 1 + port // 250), COPTER)
        received: list[Message] = []
        connection.bus.attach(Attitude, received.append)
        link.receive("late@comer", (251, 1), ATTITUDE)
        assert received == []
        await anyio.sleep(31)
        link.receive("late@comer", (251, 1), ATTITUDE)
        assert (len(received), len(link.kept)) == (1, MAX_PEERS)


async def test_ignored_sender_gets_no_counters(link: PeerKeepingLink) -> None:
    async with open_connection(link) as connection:
        for port in range(MAX_PEERS):
            link.receive(f"{port}@swarm", (1 + port % 250, 1 + port // 250), COPTER)
        for port in range(MAX_SENDERS):
            link.receive(f"{port}@late", (251, 1), ATTITUDE)
        for component_id in range(100, 200):
            link.receive("0@swarm", (1, component_id), COPTER)
        counted = [source for link in connection.statistics() for source in link.sources]
        assert len(counted) == MAX_PEERS + 100


async def test_evicted_peer_frees_its_counters(link: PeerKeepingLink) -> None:
    async with open_connection(link) as connection:
        for port in range(MAX_SENDERS // 8):
            for component_id in range(1, 9):
                link.receive(f"{port}@swarm", (1 + port % 250, component_id + 8 * (port // 250)), ATTITUDE)
        for port in range(100):
            link.receive(f"{port}@new", (251, 1), ATTITUDE)
        counted = sum(len(link.sources) for link in connection.statistics())
        assert counted == MAX_SENDERS - 100 * 8 + 99  # the first new one came when all places were taken


async def test_evicted_peer_leaves_nothing_behind(link: PeerKeepingLink) -> None:
    async with open_connection(link) as connection:
        for port in range(2 * MAX_UNVERIFIED_PEERS):
            connection.bytes_received(b"\xfd", f"{port}@stranger")
        assert len(connection._receiver._peers._limit._statistics) == MAX_UNVERIFIED_PEERS


async def test_split_frame_makes_a_peer(link: PeerKeepingLink) -> None:
    """A bridge between a serial line and UDP cuts frames anywhere."""
    async with open_connection(link) as connection:
        for place in range(0, 60, 7):
            data = FrameEncoder(1, 1).encode(COPTER) * 3
            connection.bytes_received(data[place : place + 7], "bridge")
        assert link.kept == ["bridge"]
        assert (1, 1) in connection.heartbeats


async def test_heartbeats_of_many_senders_fill_no_table(link: PeerKeepingLink) -> None:
    """65,000 senders behind one peer: the connected vehicle keeps its entry, its counters and its route."""
    async with flown(link) as (vehicle, copter):
        connection, encoder = vehicle.connection, FrameEncoder(1, 1)
        for system_id in range(2, 256):
            for component_id in range(0, 256, 5):
                encoder.system_id, encoder.component_id = system_id, component_id
                connection.bytes_received(encoder.encode(COPTER), f"{component_id}@stranger")
        assert len(connection.heartbeats) <= MAX_ROUTES
        assert len(connection._routes._routes) <= MAX_ROUTES
        assert sum(len(link.sources) for link in connection.statistics()) <= MAX_SENDERS
        await copter.live("14550@copter", 2)
        assert connection.counts(1)[1] == 0
        assert peer_of(vehicle, link) == "14550@copter"
        await anyio.sleep(40)
        link.receive("new@comer", (2, 3), COPTER)
        link.receive("new@comer", (2, 3), COPTER)
        assert (2, 3) in connection.heartbeats
        assert len(connection.heartbeats) < 50


async def test_other_peers_are_bounded(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        for port in range(MAX_OTHER_PEERS + 100):
            for component_id in (1, 2, 3):
                link.receive(f"{port % 200}@stranger", (1, component_id), COPTER)
        routes = vehicle.connection._routes
        assert isinstance(routes, Routes)
        assert len(routes._other_peers) <= MAX_OTHER_PEERS


# ------------------------------------------------------------------------- taking a route


async def test_foreign_host_cannot_take_route_after_silence(
    link: PeerKeepingLink, caplog: pytest.LogCaptureFixture
) -> None:
    async with flown(link) as (vehicle, copter):
        duplicates = route_events(vehicle.connection)
        await anyio.sleep(20)
        intruder = Copter(link, 5, booted_at=3)
        with caplog.at_level(logging.WARNING, "aerokit"):
            await intruder.live("666@stranger", 10, DISARMED)
        assert is_armed(vehicle)
        assert vehicle.is_silent
        kinds = [type(message) for message in duplicates]
        assert kinds == [events.DuplicateSender, events.RouteChangeRefused]
        assert duplicates[1] == events.RouteChangeRefused(duplicates[1].at, 1, 1, "666@stranger")
        assert "frames from 666@stranger under the same ids are refused" in caplog.text
        copter.send("14550@copter", ARMED)
        await copter.live("14550@copter", 1)
        assert not vehicle.is_silent


async def test_foreign_host_cannot_try_sequence_numbers(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        await anyio.sleep(5)
        for first in range(256):
            intruder = Copter(link, first, booted_at=3)
            intruder.send("666@stranger", DISARMED)
            intruder.send_attitude("666@stranger")
        assert is_armed(vehicle)


async def test_may_move_accepts_any_host_after_silence_only(link: PeerKeepingLink) -> None:
    async with flown(link, may_move=True) as (vehicle, _):
        duplicates = route_events(vehicle.connection)
        other = Copter(link, 5, booted_at=3)
        other.send("666@stranger", DISARMED)
        assert is_armed(vehicle)
        await anyio.sleep(5)
        other.send("666@stranger", DISARMED)
        assert not is_armed(vehicle)
        assert events.RouteChanged(vehicle.connection.now(), 1, 1, "14550@copter", "666@stranger") in duplicates


async def test_radio_status_moves_no_route(link: PeerKeepingLink) -> None:
    """It is accepted without a signature, so anyone can forge it."""
    async with flown(link, may_move=True) as (vehicle, _):
        await anyio.sleep(5)
        with vehicle.connection.subscribe(RadioStatus):
            Copter(link, 5).send("666@stranger", RadioStatus(1, 2, 3, 4, 5, 6, 7))
        assert peer_of(vehicle, link) == "14550@copter"


async def test_other_host_that_continues_stream_takes_route_after_silence(link: PeerKeepingLink) -> None:
    """The vehicle moves from Wi-Fi to the mobile network: same counter, same clock."""
    async with flown(link) as (vehicle, copter):
        duplicates = route_events(vehicle.connection)
        await copter.live("14550@mobile", 8)
        assert peer_of(vehicle, link) == "14550@mobile"
        assert not vehicle.is_silent
        assert [type(message) for message in duplicates] == [events.DuplicateSender, events.RouteChanged]


async def test_known_clock_must_continue(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        impostor = Copter(link, copter.encoder.sequence, booted_at=-90)
        await anyio.sleep(4)
        await impostor.live("14550@mobile", 4, DISARMED)
        assert is_armed(vehicle)


async def test_known_sequence_numbers_must_continue(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        impostor = Copter(link, copter.encoder.sequence + 100 & 0xFF)
        await anyio.sleep(4)
        await impostor.live("14550@mobile", 4, DISARMED)
        assert is_armed(vehicle)


async def test_other_port_that_continues_stream_takes_route_at_once(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        duplicates, begun = route_events(vehicle.connection), vehicle.connection.now()
        await copter.live("14999@copter", 1)
        assert peer_of(vehicle, link) == "14999@copter"
        assert [type(message) for message in duplicates] == [events.RouteChanged]
        assert duplicates[0].at - begun < 1


async def test_two_programs_on_one_host_do_not_alternate(link: PeerKeepingLink) -> None:
    """The sequence numbers of the second may fit by chance; the first one keeps the route all the same."""
    async with flown(link) as (vehicle, copter):
        duplicates = route_events(vehicle.connection)
        second = Copter(link, copter.encoder.sequence)
        for _ in range(40):
            copter.send("14550@copter", ARMED)
            second.send("14999@copter", DISARMED)
            await anyio.sleep(0.25)
        assert is_armed(vehicle)
        assert [type(message) for message in duplicates] == [events.DuplicateSender]


async def test_reboot_on_same_host_takes_route_after_silence(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        await anyio.sleep(1)
        rebooted = Copter(link, 0, booted_at=vehicle.connection.now())
        await rebooted.live("15000@copter", 6, DISARMED)
        assert peer_of(vehicle, link) == "15000@copter"
        assert not is_armed(vehicle)


async def both_live(copter: Copter, other: Copter, times: int, interval_s: float = 0.5) -> None:
    for _ in range(times):
        other.send("14551@copter", DISARMED)
        other.send_attitude("14551@copter")
        copter.send("14550@copter", ARMED)
        copter.send_attitude("14550@copter")
        await anyio.sleep(interval_s)


@pytest.mark.parametrize("slept_s", [0.0, 600.0])
@pytest.mark.parametrize("is_heard", [True, False])
async def test_duplicate_vehicle_takes_no_route_after_blocked_loop(
    link: PeerKeepingLink, is_heard: bool, slept_s: float
) -> None:
    """Frames of both waited, or were lost. Then the first frame is one of the other vehicle."""
    async with flown(link) as (vehicle, copter):
        other = Copter(link, first=100, booted_at=-5000.0)
        await both_live(copter, other, 8)
        received = route_events(vehicle.connection)
        block_loop(6.0)
        if slept_s:
            suspend_computer(vehicle, slept_s)
        await both_live(copter, other, 3 if is_heard else 0, 0.0)
        await anyio.sleep(0.3)
        other.send("14551@copter", DISARMED)
        other.send_attitude("14551@copter")
        await both_live(copter, other, 8)
        assert peer_of(vehicle, link) == "14550@copter"
        assert is_armed(vehicle)
        assert not [event for event in received if isinstance(event, (events.RouteChanged, events.ArmedChanged))]


async def test_reboot_during_blocked_loop_takes_route_after_silence(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        block_loop(6.0)
        rebooted = Copter(link, first=100, booted_at=vehicle.connection.now())
        await rebooted.live("14551@copter", 2)
        assert peer_of(vehicle, link) == "14550@copter"
        await rebooted.live("14551@copter", 3)
        assert peer_of(vehicle, link) == "14551@copter"


async def test_reboot_on_same_port_is_accepted_at_once(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        rebooted = Copter(link, 0, booted_at=vehicle.connection.now())
        await rebooted.live("14550@copter", 1.5, DISARMED)
        assert not is_armed(vehicle)


async def test_signature_is_sufficient_after_silence(link: PeerKeepingLink) -> None:
    key = SigningKey.from_passphrase("ours")
    async with open_connection(link, signing=Signing(key)) as connection:
        unix_time = connection.unix_time
        copter = signed_by(key)
        connection.bytes_received(copter.encode(ARMED, unix_time()), "14550@copter")
        async with aerokit.connect(connection, rates={}) as vehicle:
            await anyio.sleep(5)
            copter.sequence = 99
            connection.bytes_received(FrameEncoder(1, 1).encode(DISARMED), "666@stranger")
            assert is_armed(vehicle)
            connection.bytes_received(copter.encode(DISARMED, unix_time()), "14550@mobile")
            assert not is_armed(vehicle)


# ---------------------------------------------------------------- one peer, reordered frames


async def test_overtaken_heartbeat_is_dropped(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        late = [copter.encoder.encode(message) for message in (ARMED, ATTITUDE)]
        copter.send("14550@copter", ATTITUDE, DISARMED)
        assert not is_armed(vehicle)
        for frame in late:
            vehicle.connection.bytes_received(frame, "14550@copter")
        assert not is_armed(vehicle)


async def test_heartbeat_overtaken_by_other_messages_is_accepted(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        late = copter.encoder.encode(DISARMED)
        copter.send("14550@copter", ATTITUDE, ATTITUDE)
        vehicle.connection.bytes_received(late, "14550@copter")
        assert not is_armed(vehicle)


async def test_two_vehicles_behind_one_peer_do_not_flap(link: PeerKeepingLink) -> None:
    """Behind a router: the same ids, the same address."""
    async with flown(link) as (vehicle, copter):
        duplicates, begun = route_events(vehicle.connection), vehicle.connection.now()
        changes: list[float] = []
        vehicle.armed.observe(lambda *_: changes.append(vehicle.connection.now() - begun))
        other = Copter(link, copter.encoder.sequence + 100, booted_at=-900)
        async with anyio.create_task_group() as group:
            group.start_soon(copter.live, "14550@copter", 20, ARMED)
            group.start_soon(other.live, "14550@copter", 20, DISARMED)
        assert events.DuplicateSender in [type(message) for message in duplicates]
        assert len([message for message in duplicates if isinstance(message, events.DuplicateSender)]) == 1
        assert max(changes) <= 3
        assert len(changes) <= 3
        assert is_armed(vehicle)


async def test_second_vehicle_behind_one_peer_is_dropped(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, copter):
        other = Copter(link, copter.encoder.sequence + 100, booted_at=-900)
        times: list[SystemTime] = []
        vehicle.connection.bus.attach(SystemTime, times.append)
        async with anyio.create_task_group() as group:
            group.start_soon(copter.live, "14550@copter", 10, ARMED)
            group.start_soon(other.live, "14550@copter", 10, DISARMED)
        other.send("14550@copter", SystemTime(1, 2))
        assert times == []
        copter.send("14550@copter", SystemTime(3, 4))
        assert len(times) == 1


async def test_one_forged_frame_does_not_disable_signing(link: PeerKeepingLink) -> None:
    key = SigningKey.from_passphrase("ours")
    signing = Signing(key)
    async with open_connection(link, signing=signing) as connection:
        copter = signed_by(key)

        def signed() -> None:
            connection.bytes_received(copter.encode(DISARMED, connection.unix_time()), "14550@copter")

        signed()
        async with aerokit.connect(connection, rates={}) as vehicle:
            forged = FrameEncoder(1, 1)
            async with anyio.create_task_group() as group:

                async def forge() -> None:
                    while True:
                        signed()
                        connection.bytes_received(forged.encode(DISARMED), "666@stranger")
                        connection.bytes_received(forged.encode(DISARMED), "14550@copter")
                        await anyio.sleep(0.5)

                group.start_soon(forge)
                with pytest.raises(aerokit.errors.OperationTimeout):
                    await vehicle.setup_signing(None)
                group.cancel_scope.cancel()
            assert connection.signing is signing


async def test_frames_of_other_peers_never_disable_signing(link: PeerKeepingLink) -> None:
    key = SigningKey.from_passphrase("ours")
    signing = Signing(key)
    async with open_connection(link, signing=signing) as connection:
        copter = signed_by(key)
        connection.bytes_received(copter.encode(DISARMED, connection.unix_time()), "14550@copter")
        async with aerokit.connect(connection, rates={}) as vehicle:
            forged = FrameEncoder(1, 1)
            async with anyio.create_task_group() as group:

                async def forge() -> None:
                    while True:
                        connection.bytes_received(forged.encode(DISARMED), "666@stranger")
                        await anyio.sleep(0.1)

                group.start_soon(forge)
                with pytest.raises(aerokit.errors.OperationTimeout):
                    await vehicle.setup_signing(None)
                group.cancel_scope.cancel()
            assert connection.signing is signing


async def test_slow_sender_keeps_route_from_program_on_host(
    link: PeerKeepingLink,
) -> None:
    """It sends heartbeats only, without a clock: sequence numbers of a faster sender fit now and then."""
    async with open_connection(link) as connection:
        copter = Copter(link)
        copter.send("14550@copter", ARMED)
        async with aerokit.connect(connection, rates={}) as vehicle:
            for _ in range(60):
                copter.send("14550@copter", ARMED)
                second = Copter(link, copter.encoder.sequence)
                for _ in range(9):
                    second.send("14999@copter", DISARMED)
                    await anyio.sleep(0.1)
            assert is_armed(vehicle)


async def test_reopened_link_gets_its_peers(link: PeerKeepingLink) -> None:
    async with flown(link) as (vehicle, _):
        link.kept.clear()
        vehicle.connection.link_restored(1.0)
        assert link.kept == ["14550@copter"]


async def test_system_broadcast_skips_duplicate_vehicle(
    link: PeerKeepingLink,
) -> None:
    """Its autopilot is ignored, its camera has unique ids; both would execute a broadcast."""
    camera = Heartbeat(30, 8, 0, 0, 4)
    async with flown(link) as (vehicle, copter):
        other = Copter(link, first=99, booted_at=-9000.0)
        others_camera = FrameEncoder(1, 100)
        for _ in range(3):
            copter.send("14550@copter", ARMED)
            other.send("14550@other", DISARMED)
            vehicle.connection.bytes_received(others_camera.encode(camera), "14550@other")
            await anyio.sleep(1.0)
        link.sent.clear()
        vehicle.send(command(1, 0))
        assert link.peers_of(CommandLong) == ["14550@copter"]
        link.sent.clear()
        vehicle.send(command(1, 100))
        assert link.peers_of(CommandLong) == ["14550@other"]


@pytest.mark.parametrize("message", [RadioStatus(1, 1, 1, 1, 1, 1, 1), DISARMED])
async def test_unverified_signature_of_accepted_frame_moves_no_route(message: Message, link: PeerKeepingLink) -> None:
    """The link accepts RADIO_STATUS, and here heartbeats, with any signature, which then proves nothing."""
    key, stranger = SigningKey.from_passphrase("ours"), signed_by(SigningKey.from_passphrase("another"))
    signing = Signing(key, allow_unsigned=lambda frame: frame.message_id == Heartbeat.ID)
    async with open_connection(link, signing=signing) as connection:
        copter, unix_time = signed_by(key), connection.unix_time
        connection.bytes_received(copter.encode(ARMED, unix_time()), "14550@copter")
        async with aerokit.connect(connection, rates={}) as vehicle:
            await anyio.sleep(5)
            connection.bytes_received(stranger.encode(message, unix_time()), "666@stranger")
            assert is_armed(vehicle)
            assert peer_of(vehicle, link) == "14550@copter"
