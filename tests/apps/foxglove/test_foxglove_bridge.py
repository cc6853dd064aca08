"""The Foxglove bridge as a viewer sees it: a WebSocket client of another library, on real time and real sockets."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import struct
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from aerokit import messages as m
from aerokit.apps import foxglove as bridge_module
from aerokit.apps.foxglove import FoxgloveBridge, foxglove_bridge
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.transport.sockets import is_port_free

client = pytest.importorskip("websockets.asyncio.client")
pytest.importorskip("foxglove")

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {}


@asynccontextmanager
async def bridged(*vehicles: SimulatedVehicle, **options: Any) -> AsyncIterator[tuple[FoxgloveBridge, Connection]]:
    vehicles = vehicles or (SimulatedCopter(boot_time_s=0.0),)
    async with (
        simulated_link(vehicles, speedup=10.0) as link,
        open_connection(link) as connection,
        foxglove_bridge(connection, port=0, **options) as bridge,
    ):
        yield bridge, connection


class Viewer:
    """Subscribes to advertised topics, and stores their messages."""

    def __init__(self, websocket: Any, wanted: tuple[str, ...]) -> None:
        self._websocket, self._wanted = websocket, wanted
        self.topics: dict[str, dict[str, Any]] = {}
        self.received: dict[str, list[tuple[float, dict[str, Any]]]] = {}
        self._names: dict[int, str] = {}
        self.server: dict[str, Any] = {}

    async def read_until(self, *wanted: str, count: int = 1) -> None:
        def missing() -> list[str]:
            return [name for name in wanted if len(self.received.get(name, ())) < count]

        with anyio.move_on_after(100):
            while missing():
                await self._read()
        assert not missing()

    async def _read(self) -> None:
        received = await self._websocket.recv()
        if isinstance(received, bytes):
            operation, number, nanoseconds = struct.unpack_from("<BIQ", received)
            assert operation == 1
            self.received.setdefault(self._names[number], []).append((nanoseconds / 1e9, json.loads(received[13:])))
            return
        message = json.loads(received)
        if message["op"] == "serverInfo":
            self.server = message
        for channel in message.get("channels", ()):
            self.topics[channel["topic"]] = channel
            self._names[channel["id"]] = channel["topic"]
            if channel["topic"].endswith(self._wanted):
                subscription = {"id": channel["id"], "channelId": channel["id"]}
                await self._websocket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))


@asynccontextmanager
async def viewing(bridge: FoxgloveBridge, *wanted: str) -> AsyncIterator[Viewer]:
    async with client.connect(bridge.url, subprotocols=["foxglove.sdk.v1"], proxy=None, close_timeout=0.2) as websocket:
        yield Viewer(websocket, wanted)


async def test_viewer_receives_states_and_texts() -> None:
    simulated = SimulatedCopter(boot_time_s=0.0)
    async with (
        bridged(simulated, messages=["GPS_RAW*"]) as (bridge, connection),
        viewing(bridge, "/location", "/transform", "/pose", "/log", "/attitude", "/link", "/GPS_RAW_INT") as viewer,
    ):
        wanted = ["location", "transform", "pose", "log", "attitude", "link"]
        await viewer.read_until("/vehicle/1/location")
        simulated.send_text(4, "a text")
        await viewer.read_until(*(f"/vehicle/1/{name}" for name in wanted), "/mavlink/1/1/GPS_RAW_INT")
        assert viewer.server["name"] == "aerokit"
        assert viewer.server["capabilities"] == []
        schemas = {name: viewer.topics[f"/vehicle/1/{name}"]["schemaName"] for name in wanted[:5]}
        assert schemas == {
            "location": "foxglove.LocationFix",
            "transform": "foxglove.FrameTransform",
            "pose": "foxglove.PoseInFrame",
            "log": "foxglove.Log",
            "attitude": "aerokit.attitude",
        }
        assert {each["encoding"] for each in viewer.topics.values()} == {"json"}
        vehicle = bridge.vehicles[1]
        at, fix = viewer.received["/vehicle/1/location"][-1]
        place = vehicle.position.value
        assert fix["latitude"] == pytest.approx(place.latitude_deg, abs=1e-6)
        assert fix["altitude"] == pytest.approx(place.altitude_amsl_m, abs=0.5)
        assert at == pytest.approx(time.time(), abs=5)
        assert fix["timestamp"]["sec"] + fix["timestamp"]["nsec"] / 1e9 == pytest.approx(at, abs=1e-5)
        _, attitude = viewer.received["/vehicle/1/attitude"][-1]
        assert attitude["yaw_deg"] == pytest.approx(vehicle.attitude.value.yaw_deg, abs=1)
        _, raw = viewer.received["/mavlink/1/1/GPS_RAW_INT"][-1]
        assert raw["lat"] == round(place.latitude_deg * 1e7)
        _, link = viewer.received["/vehicle/1/link"][-1]
        assert link["state"] == "connected"
        _, text = viewer.received["/vehicle/1/log"][0]
        assert (text["message"], text["level"]) == ("a text", 3)
        assert connection.is_open


async def test_second_viewer_receives_current_values_of_all_vehicles() -> None:
    simulated = SimulatedCopter(boot_time_s=0.0), SimulatedPx4(system_id=7, boot_time_s=0.0)
    async with bridged(*simulated) as (bridge, _), viewing(bridge, "/home", "/mode") as first:
        await first.read_until("/vehicle/1/home", "/vehicle/7/mode")
        async with viewing(bridge, "/home") as second:
            await second.read_until("/vehicle/1/home")
            (_, home), (_, home_of_first) = (viewer.received["/vehicle/1/home"][0] for viewer in (second, first))
            assert home == home_of_first
        assert list(bridge.vehicles) == [1, 7]


async def test_topic_rate_is_limited() -> None:
    async with bridged(rate_hz=2.0) as (bridge, _), viewing(bridge, "/attitude") as viewer:
        await viewer.read_until("/vehicle/1/attitude", count=3)
        times = [at for at, _ in viewer.received["/vehicle/1/attitude"]]
        assert times[-1] - times[1] > 0.4  # the first message is sent immediately
        assert times == sorted(set(times))


async def test_slow_viewer_does_not_delay_others() -> None:
    async with bridged(rate_hz=100.0, messages=["*"]) as (bridge, connection), viewing(bridge, "") as viewer:
        await viewer.read_until("/vehicle/1/attitude")
        _, writer = await asyncio.open_connection("127.0.0.1", bridge.port)  # connects, and is silent
        async with viewing(bridge, "") as deaf:
            await deaf.read_until("/vehicle/1/attitude")
            begun = len(viewer.received["/vehicle/1/attitude"])
            await viewer.read_until("/vehicle/1/attitude", count=begun + 5)
            assert connection.now() - bridge.vehicles[1].attitude.updated_at < 1.0
        writer.close()


async def test_viewer_messages_reach_no_vehicle() -> None:
    sent: list[Any] = []
    async with bridged() as (bridge, connection), viewing(bridge, "/mode") as viewer:
        await viewer.read_until("/vehicle/1/mode")
        write = connection.send

        def note(message: Message, *, to: int | None = None) -> None:
            sent.append(message)
            write(message, to=to)

        connection.send = note  # type: ignore[method-assign]
        channel = {"id": 1, "topic": "/mavlink/1/1/COMMAND_LONG", "encoding": "json", "schemaName": ""}
        await viewer._websocket.send(json.dumps({"op": "advertise", "channels": [channel]}))
        await viewer._websocket.send(struct.pack("<BI", 1, 1) + b'{"command":400,"param1":1}')
        await viewer.read_until("/vehicle/1/mode", count=3)
        assert not [each for each in sent if isinstance(each, (m.CommandLong, m.CommandInt, m.SetMode))]
        assert not bridge.vehicles[1].armed.value


async def test_after_block_port_is_free() -> None:
    async with bridged() as (bridge, _):
        port = bridge.port
        threads = _threads()
        async with viewing(bridge, "/mode") as viewer:
            await viewer.read_until("/vehicle/1/mode")
            begun = time.monotonic()
    assert time.monotonic() - begun < 30
    with pytest.raises(OSError, match=r"111|refused|Connect"):
        await asyncio.open_connection("127.0.0.1", port)
    files, tasks = _files(), asyncio.all_tasks()
    for _ in range(5):  # the SDK's own threads may close a socket a moment late: only what adds up is kept
        async with bridged() as (bridge, _):
            assert bridge.port
    assert _threads() <= threads, "other bridges need no more threads"
    assert _files() <= files + 2
    assert asyncio.all_tasks() == tasks


async def test_after_block_slow_server_has_closed_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class SlowServer:
        def __init__(self, *_: object) -> None:
            self.listening = socket.create_server(("127.0.0.1", 0))
            self.port = self.listening.getsockname()[1]

        def stop(self) -> None:
            threading.Timer(0.2, self.listening.close).start()

    monkeypatch.setattr(bridge_module, "_start_server", SlowServer)
    async with bridged() as (bridge, _):
        assert not await is_port_free("127.0.0.1", bridge.port)
    with pytest.raises(OSError, match=r"111|refused|Connect"):
        await asyncio.open_connection("127.0.0.1", bridge.port)


def _threads() -> int:
    return len(os.listdir("/proc/self/task")) if os.path.isdir("/proc/self/task") else 0


def _files() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


async def test_invalid_arguments_and_used_port_raise() -> None:
    async with simulated_link(SimulatedCopter()) as link, open_connection(link) as connection:
        for wrong, text in [
            ({"rate_hz": 0.0}, "rate_hz"),
            ({"port": 70_000}, "port"),
            ({"messages": ["GPSS*"]}, "GPSS"),
        ]:
            with pytest.raises(InvalidArgument, match=text):
                async with foxglove_bridge(connection, **wrong):  # type: ignore[arg-type]
                    raise AssertionError
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            with pytest.raises(LinkOpenError, match=f"port {port}"):
                async with foxglove_bridge(connection, port=port):
                    raise AssertionError
