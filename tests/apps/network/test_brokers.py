"""States over MQTT with a real broker: topics, reconnection, and no late messages."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from brokers import PASSWORD, USER, Broker, needs_a_broker
from free_ports import free_port
from test_state_schema import SCHEMA, faults
from zenoh_network import HoldingProxy, eventually

import aerokit
from aerokit.apps.cli.main import make_parser
from aerokit.apps.network import publishing
from aerokit.apps.network.mqtt_publisher import MqttLink, _LinkPublisher, _NullReceiver, parse_broker
from aerokit.apps.network.publishing import publisher_for
from aerokit.errors import LinkOpenError
from aerokit.sim import SimulatedCopter, simulated_link

needs_a_broker()
pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def broker(tmp_path: Path) -> AsyncIterator[Broker]:
    async with Broker(tmp_path) as running:
        yield running


def topic(name: str) -> str:
    return f"aerokit/north/alpha/state/{name}"


def address(port: int, login: str = "") -> str:
    return f"mqtt://{login}127.0.0.1:{port}/north/alpha"


def waiting(publisher: Any) -> dict[str, bytes]:
    """Return the unsent values."""
    assert isinstance(publisher, _LinkPublisher)
    link: Any = publisher._link._link
    found: dict[str, bytes] = link._unsent
    return found


async def test_mqtt_states_match_schema(broker: Broker) -> None:
    by_name = {each["properties"]["state"]["const"]: each for each in SCHEMA["oneOf"]}
    async with (
        broker.received() as received,
        simulated_link(SimulatedCopter()) as link,
        aerokit.connect(link) as vehicle,
        publishing(vehicle, address(broker.port), rate_hz=20),
    ):
        wanted = {topic(f"1/{name}") for name in ("mode", "armed", "position", "link")}
        await eventually(lambda: wanted <= {each[0] for each in received})
    states = [each for each in received if "alive" not in each[0]]
    for where, data, is_retained in states:
        message = json.loads(data)
        assert where == topic(f"1/{message['state']}")
        assert faults(message, by_name[message["state"]]) == []
        assert not is_retained


async def test_mqtt_broker_restart_reconnects(broker: Broker, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "aerokit")

    def is_logged(text: str) -> bool:
        return any(text in each.getMessage() for each in caplog.records)

    line = HoldingProxy(broker.port)
    async with line, publisher_for(address(line.port)) as publisher:
        async with broker.received() as received:
            publisher.put("1/mode", b"first")
            await eventually(lambda: any(each[1] == b"first" for each in received))
        broker.kill()
        await line.__aexit__()
        await eventually(lambda: is_logged("reopening it"))
        for number in range(20_000):
            publisher.put(f"1/{number}", b"old")
        assert len(waiting(publisher)) == 0
        await broker.start()
        async with broker.received() as received:  # subscribes before any message passes
            again = HoldingProxy(broker.port)
            again.port = line.port
            async with again:

                def arrives() -> bool:
                    publisher.put("1/mode", b"new")
                    return any(each[1] == b"new" for each in received)

                await eventually(arrives)
                await eventually(lambda: is_logged("is back after"))
        assert {each[1] for each in received} - {b"online", b"offline"} == {b"new"}


@asynccontextmanager
async def stalled() -> AsyncIterator[int]:
    """Yield the port of a broker that accepts a client, and then stops reading."""
    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        await reader.read(1)
        writer.write(b"\x20\x02\x00\x00")  # CONNACK

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]
        for writer in writers:
            writer.close()


async def test_stalled_broker_receives_latest_state_only() -> None:
    async with stalled() as port, publisher_for(address(port)) as publisher:
        for number in range(2000):
            for name in "abc":
                publisher.put(f"1/{name}", b"%4d" % number * 1000)  # 24 MB, more than the system takes
            await asyncio.sleep(0)
        assert sorted(waiting(publisher)) == ["1/a", "1/b", "1/c"]
        assert set(waiting(publisher).values()) <= {b"%4d" % number * 1000 for number in (1998, 1999)}
    await eventually(lambda: len(asyncio.all_tasks()) <= 2)


async def test_mqtt_without_broker_raises() -> None:
    port = free_port()
    with pytest.raises(LinkOpenError, match=f"127.0.0.1:{port}/north/alpha: Connect.*is the broker running"):
        async with publisher_for(address(port, f"{USER}:geheim@")):
            pass


async def test_mqtt_silent_server_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    before = asyncio.all_tasks()
    monkeypatch.setattr(sys.modules["aerokit.apps.network.mqtt_publisher"], "CONNECT_TIMEOUT_S", 0.2)
    silent = await asyncio.start_server(lambda _r, w: writers.append(w), "127.0.0.1", 0)
    writers: list[asyncio.StreamWriter] = []
    async with silent:
        port = silent.sockets[0].getsockname()[1]
        with pytest.raises(LinkOpenError, match=r"no answer within 0\.2 s"):
            async with publisher_for(address(port)):
                pass
        for writer in writers:
            writer.close()
    await eventually(lambda: asyncio.all_tasks() <= before)


async def test_mqtt_cancellation_at_time_out_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    # On Python 3.10 a scope of anyio loses a cancellation in the iteration of the loop in which its deadline passes.
    monkeypatch.setattr(sys.modules["aerokit.apps.network.mqtt_publisher"], "CONNECT_TIMEOUT_S", 0.2)
    writers: list[asyncio.StreamWriter] = []
    async with await asyncio.start_server(lambda _r, w: writers.append(w), "127.0.0.1", 0) as silent:
        link = MqttLink(parse_broker(address(silent.sockets[0].getsockname()[1])))
        opening = asyncio.create_task(link.open(_NullReceiver()))
        await eventually(lambda: link._client is not None)  # then it waits for the broker's answer
        asyncio.get_running_loop().call_later(0.21, opening.cancel)
        time.sleep(0.3)  # noqa: ASYNC251 - the loop is late, so it handles both times in one iteration
        await asyncio.wait({opening})
        assert opening.cancelled()
        for writer in writers:
            writer.close()


async def test_mqtt_password_is_never_shown(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with Broker(tmp_path, with_password=True) as broker:
        port = broker.port
        with pytest.raises(LinkOpenError, match=r"(?i)authoriz") as refused:
            async with publisher_for(address(port, f"{USER}:geheim@")):
                pass
        login = f"{USER}:{quote(PASSWORD, safe='')}@"
        async with (
            broker.received((USER, PASSWORD)) as received,
            publisher_for(address(port, login)) as publisher,
        ):
            publisher.put("1/mode", b"1")
            await eventually(lambda: any(each[1] == b"1" for each in received))
            assert "alpha" in repr(publisher)
            assert PASSWORD not in repr(publisher)
    chain: BaseException | None = refused.value
    while chain is not None:
        assert "geheim" not in repr(chain)
        chain = chain.__cause__
    assert not any(word in caplog.text for word in ("geheim", PASSWORD, quote(PASSWORD, safe="")))


async def test_mqtt_block_exit_and_cancellation_release_everything(broker: Broker) -> None:
    before = asyncio.all_tasks()
    where = address(broker.port)
    async with publisher_for(where) as publisher:
        publisher.put("1/mode", b"1")
    assert asyncio.all_tasks() <= before

    async def fly() -> None:
        async with publisher_for(where) as publisher:
            inside.set()
            publisher.put("1/mode", b"1")
            await asyncio.sleep(1000)

    inside = asyncio.Event()
    task = asyncio.get_running_loop().create_task(fly())
    await inside.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await eventually(lambda: asyncio.all_tasks() <= before)
    for turns in range(0, 40, 3):  # while it is being opened
        task = asyncio.get_running_loop().create_task(fly())
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await eventually(lambda: asyncio.all_tasks() <= before)


async def test_mqtt_alive_topic_shows_presence(broker: Broker) -> None:
    alive = "aerokit/north/alpha/alive"
    async with broker.received() as received, HoldingProxy(broker.port) as line:
        async with publisher_for(address(line.port)):
            await eventually(lambda: (alive, b"online", False) in received)
            async with broker.received() as later:  # a later subscriber gets the retained message
                await eventually(lambda: (alive, b"online", True) in later)
        await eventually(lambda: received[-1][:2] == (alive, b"offline"))
        async with publisher_for(address(line.port)):
            await eventually(lambda: received[-1][:2] == (alive, b"online"))
            await line.__aexit__()  # no DISCONNECT, so the broker sends the last will
            await eventually(lambda: received[-1][:2] == (alive, b"offline"))


async def test_bridge_mqtt_publishes_states(broker: Broker, capsys: pytest.CaptureFixture[str]) -> None:
    network = address(broker.port, f"{USER}:geheim@")
    options = make_parser("bridge").parse_args(["bridge", "mqtt", network, "--json", "--rate", "20"])
    async with broker.received() as received, simulated_link(SimulatedCopter()) as options.address:
        command = asyncio.get_running_loop().create_task(options.run(options))
        await eventually(lambda: topic("1/mode") in {each[0] for each in received})
        os.kill(os.getpid(), signal.SIGINT)
        assert await command is None  # no exit code: the command succeeded
    printed = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [each["type"] for each in printed] == ["publishing", "bridged_vehicle"]
    assert printed[0]["network"] == address(broker.port)


@pytest.mark.parametrize(
    "network",
    [
        "zenoh://north/alpha",
        "mqtt://alpha:geheim@host",
        "mqtt://alpha:geheim@host:x/north/alpha",
        "tcp:127.0.0.1:5763",
        "http://alpha:geheim@host/north/alpha",
    ],
)
def test_bridge_mqtt_with_invalid_address_exits_with_code_2(network: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        make_parser("bridge").parse_args(["bridge", "mqtt", network])
    assert ended.value.code == 2
    assert "argument NETWORK: " in (printed := capsys.readouterr().err)
    assert "mqtt://" in printed
    assert "geheim" not in printed
