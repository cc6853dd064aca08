"""A hostile broker: its messages reach no vehicle, and the program keeps flying."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest
from zenoh_network import eventually

import aerokit
from aerokit.apps.network import publishing
from aerokit.apps.network.publishing import publisher_for
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import CommandLong
from aerokit.sim import SimulatedCopter, simulated_link

pytest.importorskip("paho.mqtt.client")
pytestmark = pytest.mark.anyio

CONNACK = b"\x20\x02\x00\x00"
ORDER = FrameEncoder(255, 190).encode(CommandLong(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def publish(topic: bytes, payload: bytes) -> bytes:
    body = len(topic).to_bytes(2, "big") + topic + payload
    length, digits = len(body), bytearray()
    while True:
        length, digit = divmod(length, 128)
        digits.append(digit | (0x80 if length else 0))
        if not length:
            return b"\x30" + bytes(digits) + body


@asynccontextmanager
async def broker(answer: bytes) -> AsyncIterator[tuple[int, list[bytes]]]:
    """Accept every client, and send ``answer`` after the first state; yield the port and the data received since."""
    received: list[bytes] = []
    has_answered = False

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal has_answered
        writer.write(CONNACK)
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                if has_answered:
                    received.append(data)
                elif b"/state/1/" in data:
                    has_answered = True
                    writer.write(answer)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1], received


@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    "answer",
    [
        publish(b"aerokit/north/alpha/state/1/mode", b"{}" * 1000) + publish(b"aerokit/north/alpha/to/1", ORDER),
        b"\x30\xff\xff\xff\xff\xff\xff",  # a length that never ends
        b"\x30\x01\x00",  # shorter than its own topic
        publish(b"\xff\xfe", b"no text") * 100,
        b"\xe0\x00",  # goodbye
    ],
    ids=["orders", "length", "short", "topic", "goodbye"],
)
async def test_messages_of_hostile_broker_reach_no_vehicle(answer: bytes, caplog: pytest.LogCaptureFixture) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with (
        broker(answer) as (port, received),
        simulated_link(copter, speedup=10.0) as link,
        aerokit.connect(link) as vehicle,
        publisher_for(f"mqtt://127.0.0.1:{port}/north/alpha") as publisher,
        publishing(vehicle, publisher, rate_hz=50),
    ):
        await eventually(lambda: b"".join(received).count(b"/state/1/") >= 3)
        assert vehicle.connection.is_open
        assert not copter.is_armed
    assert "Traceback" not in caplog.text
