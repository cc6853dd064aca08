"""Several links to one vehicle: accepted messages, the link that carries orders, and failures of a link."""

from __future__ import annotations

from itertools import pairwise

import anyio
import pytest
from flight_harness import block_loop
from several_harness import DEAD, GOOD, EventLog, Radios, ReceivedMessages, over

import aerokit
from aerokit import events
from aerokit import messages as m
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.errors import AerokitError, InvalidArgument, LinkLost, LinkOpenError
from aerokit.events import LinkState
from aerokit.hub import shared
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.missions import Mission, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, SimulatorServer
from aerokit.testing import VIRTUAL_BACKEND, FaultModel
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


@pytest.fixture(params=[SimulatedCopter, SimulatedPx4])
def vehicle(request: pytest.FixtureRequest) -> SimulatedVehicle:
    made: SimulatedVehicle = request.param(boot_time_s=0.0)
    return made


def a_copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0)


async def proven(connection: aerokit.Connection, link: int) -> None:
    """Wait until a link may be used, too."""
    choice = connection._routes._choices[1]  # type: ignore[union-attr]
    with anyio.fail_after(20):
        while link not in choice.candidates or not choice.candidates[link].is_same_vehicle:  # noqa: ASYNC110
            await anyio.sleep(0.1)


@pytest.mark.sampled(2)
async def test_flight_continues_when_the_used_link_fails(vehicle: SimulatedVehicle) -> None:
    radios = Radios(2)
    received = ReceivedMessages(radios)
    async with over(radios, vehicle) as connection, aerokit.connect(connection) as flying:
        news = EventLog(connection, events.LinkSelected, events.VehicleSilent, events.LinkStateChanged)
        await flying.wait_ready()
        await flying.arm()
        await flying.take_off(10)
        await proven(connection, 1)
        there, cut_at = flying.position.value.offset(north_m=80), 0.0
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flying.go_to, there)
            await anyio.sleep(3)
            radios.cut(0)
            cut_at = connection.now()
            await anyio.sleep(1.6)
            assert news.chosen == [(radios.links[1].address, "silent")]
            assert flying.position.age < 1.0
        assert flying.distance_to(there) < 3
        assert connection.now() - cut_at > 3, "it was lost in transit"
        await flying.land()
        assert flying.heartbeat_age < 2
    assert [event for event in news.all if not isinstance(event, events.LinkSelected)] == []
    orders = received.of(m.CommandLong, m.CommandInt, m.SetMode, m.SetPositionTargetGlobalInt)
    assert orders[0][0] == 0
    assert orders[-1][0] == 1


async def test_command_is_sent_once_over_one_link() -> None:
    radios = Radios(3)
    received = ReceivedMessages(radios)
    async with over(radios, a_copter()) as connection, aerokit.connect(connection) as flying:
        await flying.wait_ready()
        await proven(connection, 1)
        received.messages.clear()
        await flying.arm()
        await flying.take_off(5)
        orders = [entry for entry in received.of(m.CommandLong) if getattr(entry[1], "command", 0) in (400, 22)]
        assert [getattr(order, "command", 0) for _, order in orders] == [400, 22]
        assert len({index for index, _ in orders}) == 1
        await anyio.sleep(3)
        heartbeats = received.of(m.Heartbeat)
        assert {index for index, _ in heartbeats} == {0, 1, 2}, "our heartbeat is sent over every link"


async def test_shared_stream_is_delivered_once() -> None:
    """A router on board copies one stream: half of it is lost on each radio, and nearly all of it arrives."""
    lossy = FaultModel(loss=0.5)
    radios = Radios(2, models=[lossy, lossy], seed=3)
    async with over(radios, a_copter(), copied=True) as connection:
        came: list[m.Attitude] = []
        connection.bus.attach(m.Attitude, came.append)
        async with aerokit.connect(connection, rates={m.Attitude: 20}):
            await anyio.sleep(10)
            came.clear()
            await anyio.sleep(20)
        times = [message.time_boot_ms for message in came]
        assert len(set(times)) == len(times), "no duplicates"
        assert times == sorted(times), "in order"
        assert 0.65 < len(times) / 400 < 0.85, "three of four arrive over at least one link"


async def test_copies_leave_no_gap_when_one_radio_fails() -> None:
    radios = Radios(2)
    async with over(radios, a_copter(), copied=True) as connection:
        came: list[m.Attitude] = []
        connection.bus.attach(m.Attitude, came.append)
        news = EventLog(connection)
        async with aerokit.connect(connection, rates={m.Attitude: 20}):
            await anyio.sleep(5)
            used = connection.links.value[0].used_for == (1,) if connection.links is not None else True
            came.clear()
            radios.cut(0 if used else 1)
            await anyio.sleep(5)
        times = [message.time_boot_ms for message in came]
        gaps = [after - before for before, after in pairwise(times)]
        assert max(gaps) <= 60
        assert [reason for _, reason in news.chosen] == ["silent"]


async def test_second_stream_of_the_vehicle_is_not_mixed_in() -> None:
    """It may be older: the second radio needs a second."""
    radios = Radios(2, models=[GOOD, FaultModel(delay_s=1.0)])
    async with over(radios, a_copter()) as connection:
        times: list[int] = []
        connection.bus.attach(m.Attitude, lambda attitude: times.append(attitude.time_boot_ms))
        async with aerokit.connect(connection, rates={m.Attitude: 10}):
            await proven(connection, 1)
            await anyio.sleep(5)
            radios.cut(0)
            await anyio.sleep(10)
        assert times == sorted(times)
        assert len(times) - len(set(times)) <= 1, "the vehicle restarts its stream on the other link"


async def test_costly_link_is_used_only_while_other_fails() -> None:
    radios = Radios(2)
    received = ReceivedMessages(radios)
    async with over(radios, a_copter(), links={"costly": [0]}) as connection:
        news = EventLog(connection)
        async with aerokit.connect(connection):
            await anyio.sleep(10)
            cheap, costly = radios.links[1].address, radios.links[0].address
            used = [event.link for event in news.all if isinstance(event, events.LinkSelected)][-1]
            assert used == cheap
            radios.cut(1)
            await anyio.sleep(3)
            assert news.chosen[-1] == (costly, "silent")
            radios.mend(1)
            await anyio.sleep(10)
            assert news.chosen[-1] == (cheap, "cheaper")
            received.messages.clear()
            await anyio.sleep(20)
            asked = [len([1 for index, _ in received.of(m.Timesync) if index == link]) for link in (0, 1)]
            assert asked[0] < asked[1] / 5, "requests are rare"


async def test_better_link_is_preferred() -> None:
    radios = Radios(2, models=[FaultModel(delay_s=0.6, loss=0.2), GOOD])
    async with over(radios, a_copter()) as connection:
        news = EventLog(connection)
        async with aerokit.connect(connection):
            await anyio.sleep(20)
            status = connection.links
            assert status is not None
            slow, good = status.value
            assert (good.used_for, slow.used_for) == ((1,), ())
            assert slow.round_trip_s == pytest.approx(1.2, abs=0.2)
            assert slow.loss_percent == pytest.approx(20, abs=15)
            assert good.round_trip_s is not None
            assert good.round_trip_s < 0.2
            assert len(news.chosen) <= 1, "the link does not alternate"


async def test_other_vehicle_with_same_id_is_never_accepted() -> None:
    """Its link is open and ours fails: it gets no orders."""
    ours, another = SimulatedCopter(boot_time_s=0.0), SimulatedCopter(boot_time_s=0.0)
    radios = Radios(2)
    received = ReceivedMessages(radios)
    server = {"vehicles_on": [[ours], [another]]}
    async with over(radios, [ours, another], server=server) as connection:
        another.booted_at = -500.0
        doubts = EventLog(connection, events.DuplicateSender)
        async with aerokit.connect(connection) as flying:
            await flying.wait_ready()
            await anyio.sleep(5)
            assert doubts.all
            received.messages.clear()
            radios.cut(0)
            await anyio.sleep(8)
            assert flying.link_state.value is LinkState.SILENT
            with pytest.raises(AerokitError):
                await flying.arm()
            assert not another.is_armed
            to_it = [message for index, message in received.of(m.CommandLong) if index == 1]
            assert to_it == []


async def test_component_behind_other_link_is_reached_there() -> None:
    """A camera is on the second radio, while the vehicle is reached over the first one."""
    radios = Radios(2)
    events, camera = ReceivedMessages(radios), FrameEncoder(1, 100)
    async with over(radios, a_copter()) as connection, aerokit.connect(connection):
        received: list[m.Heartbeat] = []
        connection.bus.attach(m.Heartbeat, received.append)
        await proven(connection, 1)
        for _ in range(3):
            radios.far[1].write(camera.encode(m.Heartbeat(30, 8, 0, 0, 4)))
            await anyio.sleep(1)
        assert len([message for message in received if message.autopilot == 8]) == 3
        events.messages.clear()
        connection.send(m.CommandLong(1, 100, 512, 0, 259.0, 0, 0, 0, 0, 0, 0))
        connection.send(m.CommandLong(1, 1, 512, 0, 148.0, 0, 0, 0, 0, 0, 0))
        assert [index for index, _ in events.of(m.CommandLong)] == [1, 0]


async def test_own_frames_forwarded_by_vehicle_are_ignored() -> None:
    """PX4 forwards heartbeats of ground stations."""
    radios = Radios(2)
    async with over(radios, a_copter()) as connection, aerokit.connect(connection):
        ours = FrameEncoder(connection.source_system, connection.source_component)
        for _ in range(5):
            radios.far[1].write(ours.encode(m.Heartbeat(6, 8, 0, 0, 4)))
            await anyio.sleep(1)
        assert connection.links is not None
        assert all(link.systems == (1,) for link in connection.links.value)
        assert (connection.source_system, connection.source_component) not in connection.heartbeats


@pytest.mark.sampled(2)
async def test_transfers_continue_over_the_next_link(vehicle: SimulatedVehicle) -> None:
    slow = FaultModel(delay_s=0.1, bandwidth=30_000)
    radios = Radios(2, models=[slow, slow])
    items = [waypoint(-35.36 + index * 1e-4, 149.16, altitude_relative_m=20.0) for index in range(150)]
    async with over(radios, vehicle) as connection, aerokit.connect(connection) as flying:
        await flying.wait_ready()
        await proven(connection, 1)
        used = 0 if flying.connection.links.value[0].used_for else 1  # type: ignore[union-attr]
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flying.mission.upload, Mission(items))
            await anyio.sleep(1.0)
            radios.cut(used)
        assert connection.links.value[1 - used].used_for, "the other link is used"  # type: ignore[union-attr]
        radios.mend(used)
        await anyio.sleep(5)
        used = 1 - used
        back: list[Mission] = []

        async def download() -> None:
            back.append(await flying.mission.download())

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(download)
            await anyio.sleep(1.0)
            radios.cut(used)
        assert len(back[0].items) == 150


async def test_unsent_data_of_a_stalled_link_is_discarded() -> None:
    radios = Radios(2)
    copter = a_copter()
    async with over(radios, copter) as connection, aerokit.connect(connection) as flying:
        news = EventLog(connection)
        await flying.wait_ready()
        await proven(connection, 1)
        used = 0 if connection.links.value[0].used_for else 1  # type: ignore[union-attr]
        radios.links[used].stall()
        connection.send(m.CommandLong(1, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0))
        await anyio.sleep(3)
        assert [reason for _, reason in news.chosen] in (["stalled"], ["silent"])
        radios.links[used].drain()
        await anyio.sleep(3)
        assert not copter.is_armed, "the order was discarded and did not arrive late"


async def test_system_found_while_link_stalls_uses_other_link() -> None:
    radios, first, second = Radios(2), a_copter(), SimulatedCopter(system_id=2, boot_time_s=0.0)
    second.faults.silent = True
    async with over(radios, [first, second]) as connection:
        await anyio.sleep(5)
        radios.links[0].stall()
        await anyio.sleep(3)
        second.faults.silent = False
        await anyio.sleep(3)
        assert connection.links.value[1].used_for == (1, 2)  # type: ignore[union-attr]


async def test_closed_link_is_left_and_all_closed_end_connection() -> None:
    radios = Radios(2)
    async with over(radios, a_copter()) as connection, aerokit.connect(connection):
        news = EventLog(connection, events.LinkSelected, events.MemberLinkStateChanged, events.LinkClosed)
        await proven(connection, 1)
        used = 0 if connection.links.value[0].used_for else 1  # type: ignore[union-attr]
        radios.far[used].close()
        await anyio.sleep(0.2)
        assert [reason for _, reason in news.chosen] == ["lost"]
        changed = [event for event in news.all if isinstance(event, events.MemberLinkStateChanged)]
        assert (changed[0].link, changed[0].after) == (radios.links[used].address, LinkState.LOST)
        radios.far[1 - used].close()
        await anyio.sleep(0.2)
        assert not connection.is_open
        with pytest.raises(LinkLost, match="all links are lost"):
            connection.raise_if_ended()


async def test_links_that_cannot_be_opened() -> None:
    with pytest.raises(LinkOpenError, match=r"no link can be opened.*tcp:127.0.0.1:1.*tcp:127.0.0.1:2"):
        async with open_connection(["tcp:127.0.0.1:1", "tcp:127.0.0.1:2"]):
            pass
    with pytest.raises(InvalidArgument, match=r"\[\] is not allowed"):
        async with open_connection([]):
            pass
    with pytest.raises(InvalidArgument, match="they must all lead to vehicles"):
        async with open_connection(["udpin:127.0.0.1:0", "flight.tlog"]):
            pass
    with pytest.raises(InvalidArgument, match="not a link address"):
        async with open_connection(["udpin:127.0.0.1:0", "nonsense"]):
            pass


async def test_one_address_in_a_list_is_one_link() -> None:
    near, far = aerokit.transport.memory_link_pair()
    async with SimulatorServer(a_copter(), far), open_connection([near]) as connection:
        assert connection.links is None
        async with aerokit.connect(connection) as vehicle:
            assert vehicle.system_id == 1


async def test_link_that_opens_late_is_used() -> None:
    radios = Radios(2)
    radios.links[1].incoming.model = radios.links[1].outgoing.model = DEAD
    async with over(radios, a_copter()) as connection, aerokit.connect(connection) as vehicle:
        news = EventLog(connection)
        await vehicle.wait_ready()
        radios.mend(1)
        await proven(connection, 1)
        radios.cut(0)
        await anyio.sleep(3)
        assert [reason for _, reason in news.chosen] == ["silent"]
        await vehicle.arm()


@pytest.mark.exhaustive
async def test_ground_station_shares_all_links() -> None:
    """Its transfer continues when one of them fails, and each of its orders arrives once."""
    radios = Radios(2, models=[FaultModel(delay_s=0.02)] * 2)
    received = ReceivedMessages(radios)
    ours, theirs = memory_link_pair(latency_s=0.005)
    async with (
        over(radios, a_copter()) as connection,
        aerokit.connect(connection) as flying,
        shared(connection, [ours]),
        aerokit.connect(theirs, source_system=254) as station,
    ):
        await flying.wait_ready()
        await proven(connection, 1)
        used = 0 if connection.links.value[0].used_for else 1  # type: ignore[union-attr]
        received.messages.clear()
        await station.arm()
        arming = [index for index, message in received.of(m.CommandLong) if getattr(message, "command", 0) == 400]
        assert arming == [used]
        found: list[int] = []

        async def download() -> None:
            found.append(len(await station.parameters.download(method="list", refresh=True)))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(download)
            await anyio.sleep(0.5)
            radios.cut(used)
        assert found == [len(await flying.parameters.download(method="list", refresh=True))]
        assert station.is_armed
        await station.disarm()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("seconds", [0.0, 0.3, 0.6, 0.8, 1.0, 1.5])
@pytest.mark.parametrize("is_silent", [False, True])
async def test_link_that_fails_after_clock_pause_is_left(seconds: float, is_silent: bool) -> None:
    """The vehicle's clock stands still for 1.5 s, as a simulation's does; then the link in use dies."""
    radios, copter = Radios(2), SimulatedCopter()
    async with over(radios, copter) as connection, aerokit.connect(connection) as flying:
        news = EventLog(connection)
        # In the first ten seconds, an ack over one link may equal an earlier one over the other, and count as its copy.
        await anyio.sleep(12)
        await stand_still(copter, radios, is_silent=is_silent)
        await anyio.sleep(seconds)
        radios.cut(used_of(connection))
        await anyio.sleep(4)
        assert [reason for _, reason in news.chosen] == ["silent"]
        assert flying.position.age < 1.0


@pytest.mark.sampled(9)
@pytest.mark.parametrize("seconds", [0.1, 0.6, 0.8, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("hiccups", [0, 1, 2])
async def test_link_that_fails_after_reboot_is_left(seconds: float, hiccups: int) -> None:
    radios, copter = Radios(2), SimulatedCopter(boot_time_s=0.0)
    copter.uid = b"A" * 18
    async with over(radios, copter) as connection, aerokit.connect(connection):
        news = EventLog(connection)
        await anyio.sleep(6)
        copter.booted_at = copter.now
        await anyio.sleep(seconds)
        radios.cut(used_of(connection))
        for _ in range(hiccups):
            await stand_still(copter, radios, is_silent=False)
        await anyio.sleep(6)
        assert [reason for _, reason in news.chosen] == ["silent"]


def used_of(connection: Connection) -> int:
    assert connection.links is not None
    return next(index for index, link in enumerate(connection.links.value) if link.used_for)


async def stand_still(copter: SimulatedCopter, radios: Radios, *, is_silent: bool) -> None:
    for link in radios.links if is_silent else ():
        link.incoming.model = DEAD
    for _ in range(15):
        await anyio.sleep(0.1)
        copter.booted_at += 0.1
    for index in range(2 if is_silent else 0):
        radios.mend(index)


@pytest.mark.parametrize("blocked_s", [2.0, 40.0])
async def test_blocked_loop_is_no_silence_of_a_link(blocked_s: float) -> None:
    radios = Radios(2)
    async with (
        over(radios, SimulatedCopter(boot_time_s=0.0)) as connection,
        aerokit.connect(connection) as vehicle,
    ):
        await vehicle.wait_ready()
        await anyio.sleep(5.0)
        changes = EventLog(connection, events.MemberLinkStateChanged, events.LinkSelected)
        block_loop(blocked_s)
        await anyio.sleep(5.0)
        assert changes.all == []
