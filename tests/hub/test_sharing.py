"""A program that shares its link; and transfers through a hub, in both directions at once, on virtual time."""

from __future__ import annotations

import asyncio
import random
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from exhaustive import exhaustive
from hub_stage import COPTER, STATION, Program, settle
from served_copter import served_copter

import aerokit
import aerokit.sync
from aerokit import Signing, SigningKey, Vehicle
from aerokit.errors import ConnectionClosed, InvalidArgument, LinkOpenError
from aerokit.hub import Endpoint, Hub, HubEvent, shared
from aerokit.mavlink.messages import Attitude, CommandLong, ParamRequestList, ParamSet, SetupSigning
from aerokit.missions import Mission, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.testing import FaultModel, FaultyLink, run_virtual
from aerokit.transport import Link, Peer, memory_link_pair

KEY = SigningKey.from_passphrase("border")
DATA = random.Random(7).randbytes(6_000)
MISSION = Mission([waypoint(-35.3632, 149.1652 + number * 1e-4, altitude_relative_m=20) for number in range(40)])
ORDER = CommandLong(1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0)


def make(kind: str) -> tuple[SimulatedVehicle, str]:
    """A vehicle with a file on it, and the file's path."""
    vehicle = SimulatedCopter(boot_time_s=0.0) if kind == "ardupilot" else SimulatedPx4(boot_time_s=0.0)
    path = "/APM/data.bin" if kind == "ardupilot" else "/fs/microsd/data.bin"
    file = vehicle.ftp.files.open(path, writing=True, create=True)
    file.write(0, DATA)
    file.close()
    return vehicle, path


async def transfer_at_once(one: Vehicle, other: Vehicle, path: str, new: str) -> None:
    """Each program runs all three kinds of transfers while the other one runs a different kind."""
    for this, that in ((one, other), (other, one)):
        parameters, _, data = await asyncio.gather(
            this.parameters.download(method="list", refresh=True),
            that.mission.upload(MISSION),
            this.files.read(path),
        )
        assert len(parameters) > 500
        assert data == DATA
        downloaded, _, parameters = await asyncio.gather(
            this.mission.download(),
            that.files.write(new, DATA),
            this.parameters.download(method="list", refresh=True),
        )
        assert len(downloaded) == len(MISSION)
        assert len(parameters) > 500
        assert await this.files.read(new) == DATA


@asynccontextmanager
async def through_a_hub(vehicle: SimulatedVehicle, change: Any = None) -> AsyncIterator[tuple[Vehicle, Vehicle]]:
    (one, far), (other, far_other) = memory_link_pair(latency_s=0.005), memory_link_pair(latency_s=0.005)
    async with (
        simulated_link(vehicle, latency_s=0.01) as link,
        Hub(
            [
                Endpoint(change(link) if change else link, name="a"),
                Endpoint(one, name="b"),
                Endpoint(other, name="c"),
            ]
        ),
        aerokit.connect(far, rates={}) as first,
        aerokit.connect(far_other, rates={}, source_system=250) as second,
    ):
        yield first, second


@asynccontextmanager
async def through_a_program(vehicle: SimulatedVehicle, change: Any = None) -> AsyncIterator[tuple[Vehicle, Vehicle]]:
    near, far = memory_link_pair(latency_s=0.005)
    async with (
        simulated_link(vehicle, latency_s=0.01) as link,
        aerokit.connect(change(link) if change else link, rates={}, share=[near]) as program,
        aerokit.connect(far, rates={}, source_system=250) as station,
    ):
        yield program, station


def lossy(link: Link) -> FaultyLink:
    return FaultyLink(link, FaultModel(loss=0.03), seed=11)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", [through_a_hub, through_a_program], ids=["hub", "share"])
@pytest.mark.parametrize("kind", ["ardupilot", exhaustive("px4")])
def test_transfers_pass_in_both_directions_at_once(way: Any, kind: str) -> None:
    vehicle, path = make(kind)

    async def run() -> None:
        async with way(vehicle) as (one, other):
            await transfer_at_once(one, other, path, path.replace("data", "new"))

    run_virtual(run())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", [through_a_hub, through_a_program], ids=["hub", "share"])
def test_transfers_pass_over_a_lossy_link(way: Any) -> None:
    vehicle, path = make("px4")

    async def run() -> None:
        async with way(vehicle, lossy) as (one, other):
            _, data = await asyncio.gather(other.mission.upload(MISSION), one.files.read(path))
            assert data == DATA
            assert len(await one.mission.download()) == len(MISSION)

    run_virtual(run())


def test_station_flies_and_the_program_sees_it() -> None:
    async def run() -> None:
        async with through_a_program(SimulatedCopter(boot_time_s=0.0)) as (program, station):
            await station.wait_ready()
            await station.arm()
            await station.take_off(5)
            await program.position.wait_until(lambda position: (position.altitude_relative_m or 0) > 4, timeout=5)
            await program.land()
            await station.armed.wait_until(lambda armed: not armed, timeout=60)

    run_virtual(run())


@pytest.mark.parametrize(("way", "seen"), [(through_a_hub, [1, 192]), (through_a_program, [1])], ids=["hub", "share"])
def test_component_of_a_station_is_seen_only_through_a_hub(way: Any, seen: list[int]) -> None:
    """docs/hub.md: a program does not see its stations, so that none can take the place of its vehicle."""

    async def run() -> None:
        async with (
            way(SimulatedCopter(boot_time_s=0.0)) as (program, station),
            aerokit.component(connection=station.connection, component_id=192),
        ):
            await asyncio.sleep(3)
            assert [part.component_id for part in program.components.value] == seen

    run_virtual(run())


# ------------------------------------------------------------------------------ forwarding


class Stage:
    """A program with a vehicle simulated by frames, and a station on its link."""

    def __init__(self, vehicle: Program, station: Program, connection: aerokit.Connection, hub: Hub) -> None:
        self.vehicle, self.station, self.connection, self.hub = vehicle, station, connection, hub


@asynccontextmanager
async def stage(
    signing: Signing | None = None, vehicle: Program | None = None, ids: tuple[int, int] = (255, 190)
) -> AsyncIterator[Stage]:
    vehicle, station = vehicle or Program(1, 1), Program(250, 190)
    assert vehicle.near is not None
    async with (
        vehicle,
        station,
        aerokit.open_connection(
            vehicle.near, signing=signing, source_system=ids[0], source_component=ids[1]
        ) as connection,
        shared(connection, [station.endpoint("station")]) as hub,
    ):
        vehicle.send(COPTER)
        await settle()
        yield Stage(vehicle, station, connection, hub)


def on_stage(play: Any, **options: Any) -> None:
    async def run() -> None:
        async with stage(**options) as on:
            await play(on)

    run_virtual(run())


def test_station_receives_vehicle_and_program() -> None:
    async def play(on: Stage) -> None:
        on.connection.send(ORDER)
        on.connection.send(ParamRequestList(0, 0))
        await settle()
        assert [(frame.system_id, frame.message_id) for frame in on.station.frames if frame.system_id == 1] == [(1, 0)]
        assert [frame.message_id for frame in on.station.frames if frame.system_id == 255] == [0, 21]
        assert on.vehicle.received == ["HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_LIST"]

    on_stage(play)


def test_vehicle_receives_station_frames_once() -> None:
    async def play(on: Stage) -> None:
        on.vehicle.frames.clear()
        on.station.frames.clear()
        on.station.send(STATION, ORDER, ParamRequestList(77, 1), ParamRequestList(255, 190))
        on.station.send(SetupSigning(1, 1, bytes(range(32)), 5))
        await settle()
        assert on.vehicle.received == ["HEARTBEAT", "COMMAND_LONG"]
        assert {(frame.system_id, frame.component_id) for frame in on.vehicle.frames} == {(250, 190)}
        assert on.station.frames == []

    on_stage(play)


def test_vehicle_with_our_system_id_gets_station_frames() -> None:
    async def play(on: Stage) -> None:
        on.vehicle.frames.clear()
        on.station.send(STATION, ORDER, ParamRequestList(1, 0), ParamRequestList(1, 191))
        await settle()
        assert on.vehicle.received == ["HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_LIST"]

    on_stage(play, ids=(1, 191))


def test_frames_that_the_shared_link_drops_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    async def play(on: Stage) -> None:
        link = on.connection.link

        def drop(data: bytes, peer: Peer = None) -> None:
            link.dropped_writes += 1

        monkeypatch.setattr(link, "write", drop)
        on.station.send(ORDER)
        await settle()
        assert {endpoint.name: endpoint.dropped for endpoint in on.hub.endpoints}["program"] == {"link": 1}

    on_stage(play)


def test_answers_go_to_their_target() -> None:
    async def play(on: Stage) -> None:
        on.station.send(STATION)
        await settle()
        on.station.frames.clear()
        on.vehicle.send(ParamSet(250, 190, "A", 1.0, 9), ParamSet(255, 190, "B", 1.0, 9))
        await settle()
        assert on.station.received == ["PARAM_SET"]

    on_stage(play)


def test_signing_program_signs_for_its_stations() -> None:
    async def play(on: Stage) -> None:
        on.station.send(STATION, ORDER)
        on.vehicle.send(Attitude(0, 0, 0, 0, 0, 0, 0))
        await settle()
        assert all(Signing(KEY).has_signed(frame) for frame in on.vehicle.frames)
        assert [(frame.system_id, frame.message_id) for frame in on.vehicle.frames] == [
            (255, 0),
            (250, 0),
            (250, 76),
        ]
        assert {frame.incompat_flags for frame in on.station.frames} == {0}
        assert {frame.system_id for frame in on.station.frames} == {1, 255}

    on_stage(play, signing=Signing(KEY), vehicle=Program(1, 1, signing=Signing(KEY)))


def test_sharing_ends_with_connection_but_not_vice_versa() -> None:
    async def run() -> None:
        vehicle, station = Program(1, 1), Program(250, 190)
        assert vehicle.near is not None
        async with vehicle, station, aerokit.open_connection(vehicle.near) as connection:
            async with shared(connection, [station.endpoint("station")]) as hub:
                events: list[HubEvent] = []
                hub.on_event(events.append)
                with pytest.raises(InvalidArgument, match="two endpoints"):
                    await hub.share(connection)
            assert connection.is_open
            assert station.is_lost
            again = Program(250, 190)
            async with again, shared(connection, [again.endpoint("station")]) as hub:
                hub.on_event(events.append)
                connection.close()
                await settle()
                assert [(event.endpoint, event.kind) for event in events] == [("program", "lost")]
                again.send(STATION)
                await settle()
                with pytest.raises(ConnectionClosed):
                    await hub.share(connection, name="again")

    run_virtual(run())


def test_connection_is_shared_once_and_vehicle_gets_no_echo() -> None:
    async def play(on: Stage) -> None:
        with pytest.raises(InvalidArgument, match="shares it already"):
            await on.hub.share(on.connection, name="again")
        on.vehicle.send(COPTER, Attitude(0, 0, 0, 0, 0, 0, 0))
        await settle()
        assert "ATTITUDE" not in on.vehicle.received

    on_stage(play)


def test_blocking_twin_shares() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with (
        served_copter(speedup=20) as address,
        aerokit.sync.connect(address, share=[f"tcpin:127.0.0.1:{port}"]) as vehicle,
        aerokit.sync.connect(f"tcp:127.0.0.1:{port}", source_system=250, rates={}) as station,
    ):
        assert station.system_id == vehicle.system_id
        assert station.parameters.read("RTL_ALT").value > 0


def test_sent_frame_observer_exception_does_not_affect_sharing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def play(on: Stage) -> None:
        frames_sent: list[bytes] = []
        on.connection.observe_sent_frames(lambda raw: 1 / 0)
        detach = on.connection.observe_sent_frames(frames_sent.append)
        on.connection.send(ORDER)
        on.connection.write_raw(on.station.encoder.encode(STATION))
        detach()
        detach()
        on.connection.send(ORDER)
        assert [raw[7] for raw in frames_sent] == [76]
        await settle()
        assert on.vehicle.received.count("COMMAND_LONG") == 2

    on_stage(play)
    assert "ZeroDivisionError" in caplog.text


def test_invalid_sharing_is_refused_at_once() -> None:
    async def run() -> None:
        async with simulated_link(SimulatedCopter()) as link:
            with pytest.raises(InvalidArgument):
                async with aerokit.connect(link, share=["nonsense"]):
                    pass
        async with simulated_link(SimulatedCopter()) as link:
            with pytest.raises(LinkOpenError):
                async with aerokit.connect(link, share=["tcpin:203.0.113.9:5760"]):
                    pass
        async with simulated_link(SimulatedCopter()) as link, aerokit.open_connection(link) as connection:
            with pytest.raises(InvalidArgument, match=r"aerokit\.hub\.shared"):
                async with aerokit.connect(connection, share=["tcpin:127.0.0.1:0"]):
                    pass

    asyncio.run(run())
