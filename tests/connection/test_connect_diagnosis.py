"""A failed connect lists the received and the missing messages."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from random import Random
from typing import Any

import anyio
import pytest
from pymavlink.dialects.v20 import minimal as pymavlink

from aerokit import connect, open_connection
from aerokit.errors import ConnectFailed, InvalidArgument, LinkLost
from aerokit.mavlink.dialect import Dialect
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavType
from aerokit.mavlink.messages import Attitude, Heartbeat, RequestDataStream
from aerokit.mavlink.signing import Signing, SigningKey
from aerokit.sim import ExtraComponent, SimulatedCopter, simulated_link
from aerokit.transport import MemoryLink, Peer, memory_link_pair

pytestmark = pytest.mark.anyio

GCS = Heartbeat(6, 8, 0, 0, 4)
GIMBAL = Heartbeat(26, 8, 0, 0, 4)
COPTER = Heartbeat(2, 3, 81, 0, 3)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
UNKNOWN_FRAME = bytes.fromhex("fd0100000001018888880011f0")


class FarEnd:
    """The other end of the link, which sends the same bytes repeatedly."""

    def __init__(self) -> None:
        self.received = b""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.received += data

    def link_lost(self, error: LinkLost) -> None:
        pass


@asynccontextmanager
async def link_sending(speak: Callable[[], bytes]) -> AsyncIterator[MemoryLink]:
    near, far = memory_link_pair()
    await far.open(FarEnd())

    async def go_on() -> None:
        while True:
            far.write(speak())
            await anyio.sleep(0.5)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(go_on)
        yield near
        tasks.cancel_scope.cancel()
    far.close()


def frames_of(system_id: int, component_id: int, *messages: Heartbeat | Attitude) -> Callable[[], bytes]:
    encoder = FrameEncoder(system_id, component_id)
    return lambda: b"".join(encoder.encode(message) for message in messages)


def heartbeat_of_system_0() -> bytes:
    """Return a HEARTBEAT of system 0, which our encoder refuses to make."""
    unused = pymavlink.MAVLink(None, srcSystem=0, srcComponent=1)
    return bytes(pymavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 3).pack(unused))


def damaged(speak: Callable[[], bytes]) -> Callable[[], bytes]:
    return lambda: speak()[:-1] + b"\xaa"


@pytest.mark.parametrize(
    ("speak", "system_id", "text"),
    [
        (lambda: b"", None, "no bytes were received"),
        (lambda: b"Init ArduCopter V4.7\n", None, "no MAVLink frame: wrong baud rate, or another protocol"),
        (lambda: b"\x00\xff\x13" * 20, None, "no MAVLink frame"),
        (damaged(frames_of(1, 1, ATTITUDE)), None, "damaged frames and no valid one"),
        (lambda: UNKNOWN_FRAME, None, r"unknown dialect \(messages 8947848\)"),
        (frames_of(1, 1, ATTITUDE), None, "no HEARTBEAT among them"),
        (frames_of(255, 190, GCS), None, r"only ground stations were received \(255/190\)"),
        (frames_of(1, 154, GIMBAL), None, r"that are not autopilots were received \(1/154\)"),
        (frames_of(7, 1, COPTER), 3, r"other system ids were received: 7 \(wanted: 3\)"),
        (heartbeat_of_system_0, None, "all with the invalid system id 0"),
    ],
    ids=[
        *("nothing", "text", "noise", "damaged", "dialect", "no heartbeat", "ground stations", "gimbal"),
        *("other vehicle", "system id 0"),
    ],
)
async def test_error_describes_what_was_received(speak: Callable[[], bytes], system_id: int | None, text: str) -> None:
    async with link_sending(speak) as link:
        with pytest.raises(ConnectFailed, match=text) as caught:
            async with connect(link, system_id=system_id, timeout=5):
                pytest.fail("there is no vehicle")
    assert "within 5 s on memory:near" in str(caught.value)
    assert "no heartbeat of" in str(caught.value)


@pytest.mark.parametrize("seed", range(5))
async def test_noise_is_not_diagnosed_as_dialect_or_damage(seed: int) -> None:
    """Noise of a serial port at the wrong baud rate, which contains byte sequences that look like frames."""
    random = Random(seed)
    async with link_sending(lambda: random.randbytes(random.randrange(1, 400))) as link:
        with pytest.raises(ConnectFailed, match="no MAVLink frame: wrong baud rate"):
            async with connect(link, timeout=50):
                pytest.fail("there is no vehicle")


async def test_vehicle_without_heartbeats() -> None:
    copter = SimulatedCopter(boot_time_s=0)
    copter.faults.heartbeats_stopped = True
    async with simulated_link(copter) as link:
        with pytest.raises(ConnectFailed, match="no HEARTBEAT among them"):
            async with open_connection(link) as connection:
                connection.send(RequestDataStream(1, 1, 0, 4, 1))
                async with connect(connection, timeout=5):
                    pytest.fail("it has no heartbeat")


async def test_ground_station_and_gimbal_are_not_vehicles() -> None:
    components = [ExtraComponent(1, type=MavType.GCS, system_id=252), ExtraComponent(154)]
    copter = SimulatedCopter(boot_time_s=0, components=components)
    async with simulated_link(copter) as link, connect(link) as vehicle:
        assert (vehicle.system_id, vehicle.component_id) == (1, 1)
        await anyio.sleep(3)
        assert set(vehicle.connection.heartbeats) == {(1, 1), (252, 1), (1, 154)}


async def test_connect_has_a_default_timeout() -> None:
    started = anyio.current_time()
    async with link_sending(lambda: b"") as link:
        with pytest.raises(ConnectFailed, match="within 30 s"):
            async with connect(link):
                pytest.fail("there is no vehicle")
    assert 30 <= anyio.current_time() - started < 31


async def test_lost_link_while_waiting_is_raised_at_once() -> None:
    near, far = memory_link_pair()
    await far.open(FarEnd())

    async def unplug() -> None:
        await anyio.sleep(2)
        far.close()

    started = anyio.current_time()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(unplug)
        with pytest.raises(LinkLost):
            async with connect(near):
                pytest.fail("there is no vehicle")
    assert anyio.current_time() - started < 3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"system_id": 0}, "system_id = 0"),
        ({"system_id": 256}, "system_id = 256"),
        ({"timeout": 0}, "timeout = 0"),
        ({"source_system": 0}, "source_system = 0"),
        ({"source_component": 256}, "source_component = 256"),
        ({"source_component": -1}, "source_component = -1"),
        ({"mavlink_version": 3}, "mavlink_version = 3"),
        ({"timeout": math.nan}, "timeout = nan"),
        ({"baud": 0}, "baud = 0"),
        ({"rates": {Attitude: 0}}, "rate_hz of ATTITUDE = 0"),
        ({"rates": {Attitude: 1001}}, "rate_hz of ATTITUDE = 1001"),
        ({"dialect": Dialect("mine", [Attitude])}, "'mine' lacks aerokit's HEARTBEAT"),
        ({"dialect": Dialect("mine", [Heartbeat]), "rates": {Attitude: 1}}, "ATTITUDE is not in the dialect"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value,
)
async def test_wrong_arguments_are_refused_before_opening(arguments: dict[str, Any], text: str, tmp_path: Path) -> None:
    near, _ = memory_link_pair()
    record = tmp_path / "flight.tlog"
    record.write_bytes(b"precious")
    with pytest.raises(InvalidArgument, match=text):
        async with connect(near, record=record, **arguments):
            pytest.fail("nothing is opened")
    assert record.read_bytes() == b"precious"
    await near.open(FarEnd())  # it was not opened before
    near.close()


@pytest.mark.parametrize(
    ("arguments", "instead"),
    [
        ({"source_system": 42}, "pass source_system to open_connection"),
        ({"source_component": 1}, "pass source_component to open_connection"),
        ({"baud": 115200}, "pass baud to open_connection"),
        ({"dialect": Dialect("mine", [Heartbeat])}, "pass dialect to open_connection"),
        ({"mavlink_version": 1}, "set connection.mavlink_version"),
        ({"record": "flight.tlog"}, "use connection.record"),
        ({"signing": Signing(SigningKey(bytes(range(32))))}, "set connection.signing"),
        ({"reconnect": True}, "pass reconnect to open_connection"),
        ({"peers": "10.0.0.7"}, "pass them to open_connection"),
        ({"may_move": True}, "pass them to open_connection"),
        ({"heartbeat": None}, "pass heartbeat to open_connection"),
        ({"share": ["tcpin:127.0.0.1:0"]}, "use aerokit.hub.shared"),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
async def test_open_connection_refuses_arguments_of_link(arguments: dict[str, Any], instead: str) -> None:
    (name,) = arguments
    async with simulated_link(SimulatedCopter()) as link, open_connection(link) as connection:
        with pytest.raises(InvalidArgument, match=rf"\b{name}\b.* not allowed here: .* {instead}"):
            async with connect(connection, **arguments):
                pytest.fail("the argument has no effect")
        assert not connection.attached
        async with connect(connection) as vehicle:  # The connection is as before.
            assert vehicle.system_id == 1


@pytest.mark.parametrize("count", [1, 2])
async def test_link_objects_refuse_baud(count: int) -> None:
    links = [memory_link_pair()[0] for _ in range(count)]
    with pytest.raises(InvalidArgument, match="baud = 115200 is not allowed with a link object"):
        async with open_connection(links, baud=115200):
            pytest.fail("nothing is opened")
    await links[0].open(FarEnd())  # it was not opened before
    links[0].close()


async def test_wrong_address_shows_the_accepted_forms() -> None:
    with pytest.raises(InvalidArgument, match="udpin"):
        async with connect("carrier pigeon"):
            pytest.fail("there is no such link")
