"""Several links to one vehicle under faults: nothing is delivered twice or late, or to another vehicle."""

from __future__ import annotations

import socket
from functools import partial

import anyio
import pytest
from several_harness import GOOD, EventLog, Radios, ReceivedMessages, over

import aerokit
from aerokit import events
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.connection.multilink.link_choice import MAX_SWITCH_DELAY_S, MIN_COPIES, Candidate, LinkChoice
from aerokit.connection.multilink.link_probes import UNATTACHED_RATE_HZ
from aerokit.connection.multilink.vehicle_clock import ClockSample
from aerokit.connection.opening import open_connection
from aerokit.errors import BusyError, LinkLost, LinkOpenError
from aerokit.events import LinkState
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame, x25
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import Signing, SigningKey
from aerokit.sim import SimulatedCopter
from aerokit.testing import VIRTUAL_BACKEND, FaultModel
from aerokit.transport import Link, MemoryLink, MultiLink, Peer, memory_link_pair

STEADY_S = 3.0

pytestmark = pytest.mark.anyio

AUTOPILOT = m.Heartbeat(2, 3, 81, 0, 4)
STATION = m.Heartbeat(6, 8, 0, 0, 4)


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


class IgnoringReceiver:
    """A receiver that ignores all data."""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        pass

    def link_lost(self, error: LinkLost) -> None:
        pass


def of_system_0(message: m.Heartbeat) -> bytes:
    """Return a frame of system 0, which our encoder refuses to make."""
    frame = Frame.parse(FrameEncoder(1, 1).encode(message))
    body = frame.body[:4] + b"\0" + frame.body[5:]
    return b"\xfd" + body + x25(body + STANDARD.extras[frame.message_id]).to_bytes(2, "little")


def orders(received: ReceivedMessages) -> list[int]:
    """Return the radio that carried each order."""
    return [index for index, _ in received.of(m.CommandLong)]


def an_order_to_all() -> m.CommandLong:
    return m.CommandLong(0, 0, 400, 0, 1.0, 0, 0, 0, 0, 0, 0)


def version(uid2: bytes) -> m.AutopilotVersion:
    return m.AutopilotVersion(0, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0, uid2)


async def opened(radios: Radios) -> None:
    for far in radios.far:
        await far.open(IgnoringReceiver())


async def test_broadcast_commands_ignore_system_0() -> None:
    radios = Radios(2)
    received = ReceivedMessages(radios)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        radios.far[0].write(FrameEncoder(1, 1).encode(AUTOPILOT))
        radios.far[0].write(of_system_0(AUTOPILOT))
        await anyio.sleep(0.5)
        connection.send(an_order_to_all())
        assert sorted(orders(received)) == [0, 1]


async def test_broadcast_command_reaches_each_system_once() -> None:
    """A ground station was received over the other radio first, and then over the vehicle's as well."""
    radios = Radios(2)
    received = ReceivedMessages(radios)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        radios.far[1].write(FrameEncoder(250, 190).encode(STATION))
        await anyio.sleep(0.1)
        for far in radios.far:
            far.write(FrameEncoder(250, 190).encode(STATION))
        radios.far[0].write(FrameEncoder(1, 1).encode(AUTOPILOT))
        await anyio.sleep(0.1)
        connection.send(an_order_to_all())
        assert len(orders(received)) == 1


def test_other_vehicle_is_refused_after_long_silence_of_ours() -> None:
    """Two vehicles were switched on ten seconds apart; ours is switched off."""
    choice, now = LinkChoice(has_autopilot=True), 0.0
    while now < 30.0:
        for link in (0, 1):
            choice.record_heartbeat(link, now, is_costly=False)
        choice.choose(now)
        choice.record_answer(0, ClockSample(now, 100.0 + now, 0.02), now)
        choice.record_answer(1, ClockSample(now, 90.0 + now, 0.02), now)
        now += 0.5
    assert choice.candidates[1].is_same_vehicle is False
    while now < 3000.0:
        choice.record_heartbeat(1, now, is_costly=False)
        choice.record_answer(1, ClockSample(now, 90.0 + now, 0.02), now)
        choice.choose(now)
        assert choice.used is choice.candidates[0]
        now += 0.5


def test_late_link_is_proven_by_its_clock() -> None:
    choice, now = LinkChoice(has_autopilot=True), 0.0
    while now < 30.0:
        choice.record_heartbeat(0, now, is_costly=False)
        choice.choose(now)
        choice.record_answer(0, ClockSample(now, 100.0 + now, 0.02), now)
        now += 0.5
    now = 600.0
    for _ in range(4):
        choice.record_heartbeat(1, now, is_costly=False)
        choice.record_answer(1, ClockSample(now - 0.1, 100.03 + now - 0.1, 0.2), now)
        now += 0.5
    choice.choose(now)
    assert choice.used is choice.candidates[1]


@pytest.mark.sampled(4)
@pytest.mark.parametrize("late_s", [2.0, 4.0, 6.0])
@pytest.mark.parametrize("dies", [False, True])
async def test_late_copies_from_a_slow_link_are_dropped(late_s: float, dies: bool) -> None:
    """Both radios carry 100 frames a second; one becomes late, and the other one may fail."""
    radios = Radios(2)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        came: list[int] = []
        states: list[int] = []
        connection.bus.attach(m.Attitude, lambda message: came.append(message.time_boot_ms))
        connection.bus.attach(m.Heartbeat, lambda message: states.append(message.base_mode))
        encoder = FrameEncoder(1, 1)
        for step in range(1200):
            if step == 400:
                radios.links[1].incoming.model = FaultModel(delay_s=late_s)
            if step == 500 and dies:
                radios.cut(0)
            frames = [encoder.encode(m.Attitude(10_000 + 10 * step, 0, 0, 0, 0, 0, 0))]
            if step % 50 == 0:
                armed = 128 if step < 450 else 0
                frames.append(encoder.encode(m.Heartbeat(2, 3, 1 | armed, 0, 4)))
            for data in frames:
                for far in radios.far:
                    far.write(data)
            await anyio.sleep(0.01)
        assert came == sorted(set(came))
        assert sorted(states, reverse=True) == states, "armed was not reported after disarmed"


async def test_signed_copies_are_accepted_in_any_order() -> None:
    """The faster radio is not in use yet; only heartbeats arrive, which are no proof."""
    radios = Radios(2, models=[FaultModel(delay_s=0.05), GOOD])
    await opened(radios)
    key = SigningKey(bytes(range(32)))
    async with open_connection(radios.together(), signing=Signing(key)) as connection:
        refused = EventLog(connection, events.FrameRefused)
        states: list[int] = []
        connection.bus.attach(m.Heartbeat, lambda message: states.append(message.custom_mode))
        vehicle = FrameEncoder(1, 1)
        vehicle.signing = Signing(key)
        for step in range(10):
            data = vehicle.encode(m.Heartbeat(2, 3, 81, step, 4), connection.unix_time())
            for far in radios.far[: 1 if step == 0 else 2]:
                far.write(data)
            await anyio.sleep(1)
        assert states == list(range(10))
        assert refused.all == []


def candidates_of(connection: Connection) -> dict[int, Candidate]:
    assert connection._multilink is not None
    return connection._multilink._choices[1].candidates


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (1, 2)], ids=str)
async def test_copies_prove_only_links_with_frames_of_link_in_use(order: tuple[int, ...]) -> None:
    """The second and the third radio carry equal frames: those of the first, which is in use, or of another vehicle."""
    radios = Radios(3)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        connection.bus.require_frames(m.Attitude)
        for far in radios.far:
            far.write(FrameEncoder(1, 1).encode(AUTOPILOT))
        await anyio.sleep(0.1)
        vehicle = FrameEncoder(1, 1)
        proven: list[list[int]] = []
        for step in range(MIN_COPIES):
            data = vehicle.encode(m.Attitude(10_000 + step, *(0.0,) * 6))
            for index in order:
                radios.far[index].write(data)
                await anyio.sleep(0.01)
            proven.append([link for link in (1, 2) if candidates_of(connection)[link].is_same_vehicle])
        assert proven == [[]] * (MIN_COPIES - 1) + [[1, 2] if 0 in order else []]


@pytest.mark.parametrize("component", [1, 191])
async def test_only_autopilot_answer_counts_as_vehicle_clock(component: int) -> None:
    """A companion computer that answers a probe has another clock, which would seem to show a reboot."""
    radios = Radios(2)
    received = ReceivedMessages(radios)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        for far in radios.far:
            far.write(FrameEncoder(1, 1).encode(AUTOPILOT))
        await anyio.sleep(1)
        probe = next(message for index, message in received.of(m.Timesync) if index == 0)
        assert isinstance(probe, m.Timesync)
        radios.far[0].write(FrameEncoder(1, component).encode(m.Timesync(tc1=5, ts1=probe.ts1)))
        await anyio.sleep(0.1)
        assert (candidates_of(connection)[0].round_trip_s is not None) is (component == 1)


async def test_copies_over_link_to_other_hardware_prove_nothing() -> None:
    radios = Radios(2)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        connection.bus.require_frames(m.Attitude)
        for far in radios.far:
            far.write(FrameEncoder(1, 1).encode(AUTOPILOT))
            await anyio.sleep(0.1)
        candidates_of(connection)[0].is_other_hardware = True
        vehicle = FrameEncoder(1, 1)
        for step in range(MIN_COPIES):
            data = vehicle.encode(m.Attitude(10_000 + step, *(0.0,) * 6))
            for far in radios.far:
                far.write(data)
            await anyio.sleep(0.1)
        assert not candidates_of(connection)[1].is_same_vehicle


@pytest.mark.parametrize("is_first_used", [True, False])
@pytest.mark.parametrize("is_second_sender", [True, False])
async def test_copies_of_second_sender_prove_no_link(is_first_used: bool, is_second_sender: bool) -> None:
    """A second vehicle with the same ids sends over the second link, and to the port of the link in use."""
    async with open_connection(["udpin:127.0.0.1:0", "udpin:127.0.0.1:0"]) as connection:
        link = connection.link
        assert isinstance(link, MultiLink)
        connection.bus.require_frames(m.Attitude)
        ours, theirs = FrameEncoder(1, 1), FrameEncoder(1, 1)
        peers = {0: ("127.0.0.1", 9), 1: ("127.0.0.2", 9)}
        for index, encoder in ((0, ours), (1, theirs)):
            link._members[index].bytes_received(encoder.encode(AUTOPILOT), peers[index])
        for step in range(MIN_COPIES):
            data = theirs.encode(m.Attitude(10_000 + step, *(0.0,) * 6))
            for index in (0, 1) if is_first_used else (1, 0):
                link._members[index].bytes_received(data, peers[1 if is_second_sender else index])
        assert bool(candidates_of(connection)[1].is_same_vehicle) is not is_second_sender


async def test_hardware_id_relayed_by_second_sender_proves_no_link() -> None:
    """The second link leads to another vehicle, but also gets frames that our vehicle sends to both ports."""
    async with open_connection(["udpin:127.0.0.1:0", "udpin:127.0.0.1:0"]) as connection:
        link = connection.link
        assert isinstance(link, MultiLink)
        ours, theirs = FrameEncoder(1, 1), FrameEncoder(1, 1)
        peers = {0: ("127.0.0.1", 9), 1: ("127.0.0.2", 9)}
        for index, encoder, uid in ((0, ours, b"A" * 18), (1, theirs, b"B" * 18)):
            link._members[index].bytes_received(encoder.encode(AUTOPILOT), peers[index])
            link._members[index].bytes_received(encoder.encode(version(uid)), peers[index])
        assert candidates_of(connection)[1].is_other_hardware
        data = ours.encode(version(b"A" * 18))
        for index in (0, 1):
            link._members[index].bytes_received(data, peers[0])
        assert candidates_of(connection)[1].is_other_hardware


@pytest.mark.parametrize("is_signed", [True, False])
async def test_forged_copies_prove_no_link(is_signed: bool) -> None:
    radios = Radios(2)
    await opened(radios)
    key = SigningKey(bytes(range(32)))
    async with open_connection(radios.together(), signing=Signing(key)) as connection:
        connection.bus.require_frames(m.Attitude)
        vehicle, forger = FrameEncoder(1, 1), FrameEncoder(1, 1)
        vehicle.signing = Signing(key)
        for far in radios.far:
            far.write(vehicle.encode(AUTOPILOT, connection.unix_time()))
            await anyio.sleep(0.1)
        for step in range(MIN_COPIES):
            sender = vehicle if is_signed else forger
            data = sender.encode(m.Attitude(10_000 + step, *(0.0,) * 6), connection.unix_time())
            for far in radios.far:
                far.write(data)
            await anyio.sleep(0.1)
        assert bool(candidates_of(connection)[1].is_same_vehicle) is is_signed


async def test_link_in_use_elsewhere_is_left_unchanged() -> None:
    near, far = memory_link_pair()
    other, _ = memory_link_pair()
    await far.open(IgnoringReceiver())
    async with open_connection(near) as connection:
        with pytest.raises(BusyError):
            async with open_connection([other, near]):
                pass
        far.write(FrameEncoder(1, 1).encode(AUTOPILOT))
        await anyio.sleep(0.1)
        assert (1, 1) in connection.heartbeats


class SlowLink(MemoryLink):
    """Takes a second to open."""

    async def _connect(self) -> None:
        await anyio.sleep(1)
        await super()._connect()


async def test_link_lost_while_another_opens_does_not_end_connection() -> None:
    near, far = memory_link_pair()
    await far.open(IgnoringReceiver())
    async with anyio.create_task_group() as tasks:

        async def close_soon() -> None:
            await anyio.sleep(0.5)
            far.close()

        tasks.start_soon(close_soon)
        async with open_connection([near, SlowLink("memory:slow")]) as connection:
            await anyio.sleep(1)
            assert connection.is_open
            assert connection.links is not None
            assert [link.state for link in connection.links.value] == [LinkState.LOST, LinkState.CONNECTED]


async def test_links_all_lost_while_opening_raise() -> None:
    near, far = memory_link_pair()
    await far.open(IgnoringReceiver())

    class Refused(SlowLink):
        async def _connect(self) -> None:
            await super()._connect()
            raise OSError(111, "refused")

    async with anyio.create_task_group() as tasks:

        async def close_soon() -> None:
            await anyio.sleep(0.5)
            far.close()

        tasks.start_soon(close_soon)
        with pytest.raises((LinkLost, LinkOpenError)):
            async with open_connection([near, Refused("memory:refused")]) as connection:
                connection.raise_if_ended()


async def test_link_opened_late_ends_the_interruption() -> None:
    near, far = memory_link_pair()
    await far.open(IgnoringReceiver())
    tries = 0

    class Third(MemoryLink):
        """Opens at the third attempt."""

        async def _connect(self) -> None:
            nonlocal tries
            tries += 1
            if tries < 6:
                raise OSError(111, "refused")
            await super()._connect()

    late = Third("memory:late")
    both: list[Link] = [near, late]
    together = MultiLink([partial(both.__getitem__, index) for index in range(2)], survives_loss=True)
    async with open_connection(together) as connection:
        news = EventLog(connection, events.LinkInterrupted, events.LinkRestored)
        far.close()
        await anyio.sleep(0.1)
        assert [type(event) for event in news.all] == [events.LinkInterrupted]
        await anyio.sleep(20)
        assert [type(event) for event in news.all] == [events.LinkInterrupted, events.LinkRestored]
        late._lose("gone")
        assert not connection.is_open


async def test_camera_received_first_does_not_hide_the_vehicle() -> None:
    radios = Radios(2)
    camera = FrameEncoder(1, 100)
    copter = SimulatedCopter(boot_time_s=5.0)
    async with over(radios, copter, server={"vehicles_on": [[copter], []]}) as connection:
        for _ in range(3):
            radios.far[1].write(camera.encode(m.Heartbeat(30, 8, 0, 0, 4)))
            await anyio.sleep(1)
        async with aerokit.connect(connection, timeout=20) as vehicle:
            assert vehicle.system_id == 1
            links = connection.links
            assert links is not None
            assert links.value[0].used_for == (1,)


async def test_switch_to_better_link_delays_no_command() -> None:
    """Over the radio in use an order takes 1.5 s; meanwhile the connection selects a better one."""
    copter = SimulatedCopter(boot_time_s=0.0)
    radios = Radios(2, models=[FaultModel(delay_s=1.5), GOOD])
    radios.cut(1)
    async with over(radios, copter) as connection, aerokit.connect(connection) as vehicle:
        await vehicle.wait_ready()
        await anyio.sleep(20)
        news = EventLog(connection)
        radios.mend(1)
        assert connection._multilink is not None
        choice = connection._multilink._choices[1]
        with anyio.fail_after(60):
            while choice._better is None or connection.now() - choice._better_since < 2.0:  # noqa: ASYNC110
                await anyio.sleep(0.05)
            connection.send(m.CommandLong(1, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0))
            while not news.chosen:  # noqa: ASYNC110
                await anyio.sleep(0.05)
        connection.send(m.CommandLong(1, 1, 400, 0, 0.0, 0, 0, 0, 0, 0, 0))
        await anyio.sleep(5)
        assert not copter.is_armed
        assert news.chosen == [(radios.links[1].address, "better")]


def test_continuous_commands_delay_switch_for_limited_time() -> None:
    choice, now, changed_at = LinkChoice(has_autopilot=False), 0.0, None
    choice.record_heartbeat(0, now, is_costly=False)
    choice.choose(now)
    while now < 40.0 and changed_at is None:
        for link, round_trip_s in ((0, 1.0), (1, 0.02)):
            choice.record_heartbeat(link, now, is_costly=False).record_round_trip(round_trip_s, now)
        choice.record_command(now)
        if choice.choose(now) == "better":
            changed_at = now
        now += 0.05
    assert changed_at is not None
    assert STEADY_S + MAX_SWITCH_DELAY_S <= changed_at <= STEADY_S + MAX_SWITCH_DELAY_S + 0.2


class Ports:
    """An autopilot with a port and a sequence counter for each radio."""

    def __init__(self, radios: Radios) -> None:
        self._far = radios.far
        self._encoders = [FrameEncoder(1, 1) for _ in radios.far]

    def send(self, message: Message, *ports: int) -> None:
        for port in ports:
            self._far[port].write(self._encoders[port].encode(message))


async def switched_to_better_link(connection: Connection, ports: Ports, radios: Radios) -> LinkChoice:
    """Make the second radio the better one; returns when it has just been selected."""
    for step in range(200):
        both = (0,) if step < 20 else (0, 1)
        if step % 10 == 0:
            ports.send(m.Heartbeat(2, 12, 81, 0, 4), *both)
        await anyio.sleep(0.1)
        assert connection._multilink is not None
        choice = connection._multilink._choices.get(1)
        if choice is not None and 1 in choice.candidates:
            choice.candidates[1].is_same_vehicle = True
            choice.candidates[0].record_round_trip(1.0, connection.now())
            choice.candidates[1].record_round_trip(0.01, connection.now())
        if choice is not None and choice.used is choice.candidates.get(1):
            return choice
    raise AssertionError("it was not taken")


async def test_answer_over_former_link_is_accepted_once() -> None:
    """ArduPilot answers over the port of the request, PX4 over all ports where it has received us."""
    radios = Radios(2, models=[FaultModel(delay_s=0.5), GOOD])
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        ports = Ports(radios)
        await switched_to_better_link(connection, ports, radios)
        answers: list[tuple[int, int]] = []
        connection.bus.attach(m.CommandAck, lambda ack: answers.append((ack.command, ack.result)))
        ports.send(m.CommandAck(176, 0), 0)
        ports.send(m.CommandAck(400, 0), 0, 1)
        await anyio.sleep(0.1)
        ports.send(m.CommandAck(400, 4), 0, 1)
        ports.send(m.CommandAck(400, 0), 0, 1)
        await anyio.sleep(1)
        assert answers == [(400, 0), (400, 4), (400, 0), (176, 0)]


async def test_former_link_stays_proven() -> None:
    radios = Radios(2, models=[FaultModel(delay_s=0.5), GOOD])
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        choice = await switched_to_better_link(connection, Ports(radios), radios)
        radios.far[1].close()
        await anyio.sleep(0.3)
        assert choice.used is choice.candidates[0]


async def test_peer_is_named_as_by_its_member_link() -> None:
    """A program on board is started again, and has another port."""
    here: socket.socket
    async with open_connection(["udpin:127.0.0.1:0", "udpin:127.0.0.1:0"]) as connection:
        news = EventLog(connection, events.RouteChanged)
        link = connection.link
        assert isinstance(link, MultiLink)
        said: list[str] = []
        for round_ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
                here.bind(("127.0.0.1", 0))
                said.append(f"127.0.0.1:{here.getsockname()[1]}")
                encoder = FrameEncoder(1, 1)
                for _ in range(4):
                    link._members[1].bytes_received(encoder.encode(AUTOPILOT), here.getsockname())
                    await anyio.sleep(0.1)
            if round_ == 0:
                await anyio.sleep(4)
        moved = news.all[0]
        assert isinstance(moved, events.RouteChanged)
        assert [moved.before, moved.after] == said


@pytest.mark.exhaustive
async def test_forged_ids_cost_few_probes() -> None:
    radios = Radios(2)
    received = ReceivedMessages(radios)
    await opened(radios)
    async with open_connection(radios.together()) as connection:
        for begin in (1, 101, 1, 101):
            for system in range(1, 251):
                for component in range(begin, begin + 4):
                    radios.far[0].write(FrameEncoder(system, component).encode(AUTOPILOT))
            await anyio.sleep(5)
        asked = len(received.of(m.Timesync))
        assert 200 < asked <= 25 * UNATTACHED_RATE_HZ
        await anyio.sleep(40)
        received.messages.clear()
        await anyio.sleep(10)
        assert received.of(m.Timesync) == []
        assert connection._multilink is not None
        assert not any(connection._multilink._counters.values())
        radios.far[0].write(FrameEncoder(7, 1).encode(AUTOPILOT))
        await anyio.sleep(5)
        assert len(received.of(m.Timesync)) >= 9
