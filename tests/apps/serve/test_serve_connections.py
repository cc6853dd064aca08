"""Connections of `aerokit serve` on real sockets: clients without the token cannot block the owner."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import pytest
import uvicorn
import websockets
from serve_stage import TOKEN
from websockets.typing import Subprotocol

import aerokit
import aerokit.apps.serve.guard as connections
from aerokit.apps.cli.serve import config_of
from aerokit.apps.serve import make_app
from aerokit.apps.serve.guard import MAX_ANONYMOUS_CONNECTIONS
from aerokit.sim import SimulatedCopter, simulated_link

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    """Real sockets and the real clock."""
    return "asyncio"


TcpStream = tuple[asyncio.StreamReader, asyncio.StreamWriter]
GIVEN = (200, 202)
HALF = b"GET /api HTTP/1.1\r\nHost: 127"


class Server:
    """The application on a real port, with client connections."""

    def __init__(self, server: uvicorn.Server) -> None:
        self._server = server
        self.port = server.servers[0].sockets[0].getsockname()[1]
        self._streams: list[TcpStream] = []
        self._keys = 0

    async def connect(self, *, first: bytes = b"", host: str = "127.0.0.1") -> TcpStream:
        stream = await asyncio.open_connection("127.0.0.1", self.port, local_addr=(host, 0))
        self._streams.append(stream)
        stream[1].write(first)
        return stream

    async def close(self) -> None:
        for _, writer in self._streams:
            writer.close()
            with suppress(ConnectionError):
                await writer.wait_closed()

    async def flood(self, count: int, first: bytes = HALF, *, host: str = "127.0.0.1") -> None:
        for _ in range(count):
            await self.connect(first=first, host=host)

    def open_connections(self) -> int:
        return len(self._server.server_state.connections)

    async def order(self, stream: TcpStream) -> int:
        """Order `hold` with the token; return the status code."""
        self._keys += 1
        head = (
            f"POST /api/vehicles/1/hold?wait=false HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
            f"Idempotency-Key: key-{self._keys:08}\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{{}}"
        )
        return await ask(stream, head.encode())


def has_ended(stream: TcpStream) -> bool:
    return stream[0].at_eof() or stream[0].exception() is not None


async def end_of(stream: TcpStream) -> bytes:
    """Read until the server closes the connection."""
    with anyio.fail_after(100), suppress(ConnectionResetError):
        return await stream[0].read()
    return b""


async def ask(stream: TcpStream, request: bytes) -> int:
    reader, writer = stream
    writer.write(request)
    with anyio.fail_after(100):
        head = await reader.readuntil(b"\r\n\r\n")
        length = next(line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        await reader.readexactly(int(length.partition(b":")[2]))
    return int(head.split()[1])


@asynccontextmanager
async def open_server() -> AsyncIterator[Server]:
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0.0), speedup=10.0) as link,
        aerokit.connect(link) as vehicle,
        make_app(vehicle, token=TOKEN, open_reading=True) as app,
    ):
        server = uvicorn.Server(config_of(uvicorn, app, "127.0.0.1", 0))
        serving = asyncio.ensure_future(server._serve())
        with anyio.fail_after(100):
            while not server.started:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        stage = Server(server)
        try:
            yield stage
        finally:
            await stage.close()
            server.should_exit = True
            await serving


@pytest.mark.parametrize("first", [b"", HALF], ids=["silent", "half"])
async def test_partial_anonymous_requests_do_not_block_command(first: bytes) -> None:
    async with open_server() as server:
        owner = await server.connect()
        assert await server.order(owner) in GIVEN
        await server.flood(200, first)
        assert await server.order(await server.connect()) in GIVEN
        assert await server.order(owner) in GIVEN, "his own connection is not ended for strangers"
        assert server.open_connections() <= MAX_ANONYMOUS_CONNECTIONS + 2


@pytest.mark.exhaustive
async def test_idle_anonymous_connections_do_not_block_command() -> None:
    async with open_server() as server:
        request = b"GET /api/vehicles HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        await server.flood(200, request)
        assert await server.order(await server.connect()) in GIVEN
        assert await ask(await server.connect(), request) == 200
        assert server.open_connections() <= MAX_ANONYMOUS_CONNECTIONS + 2


async def test_page_with_old_token_is_refused_without_an_error(caplog: pytest.LogCaptureFixture) -> None:
    """After a restart, pages that are still open reconnect with the token of the previous server."""
    async with open_server() as server:
        protocols = [Subprotocol("aerokit.v1"), Subprotocol("bearer.of-the-previous-server")]
        # uvicorn 0.35 sends Content-Length twice, which this client refuses before it looks at the status.
        with pytest.raises((websockets.InvalidStatus, websockets.InvalidMessage)) as refused:
            await websockets.connect(f"ws://127.0.0.1:{server.port}/api/stream", subprotocols=protocols)
        if isinstance(refused.value, websockets.InvalidStatus):
            assert refused.value.response.status_code == 401
        with anyio.fail_after(100):
            while server.open_connections():  # noqa: ASYNC110
                await asyncio.sleep(0.01)
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


async def test_flood_from_one_address_keeps_connection_of_another() -> None:
    async with open_server() as server:
        page = await server.connect(host="127.0.0.2")
        await server.flood(200)
        assert await ask(page, b"GET /api HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") == 200


async def test_missing_headers_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = b"GET /api HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    async with open_server() as server:
        idle = await server.connect()
        assert await ask(idle, whole) == 200
        monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.3)
        silent, half, second = [await server.connect(first=first) for first in (b"", HALF, whole + HALF)]
        assert await end_of(silent) == await end_of(half) == b""
        await asyncio.sleep(0.5)
        assert await ask(idle, whole) == 200, "between requests it may wait"
        idle[1].write(HALF)
        assert await end_of(idle) == b""
        assert not has_ended(second), "it has uvicorn's time for the next request"


async def test_slow_headers_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.3)
    async with open_server() as server:
        stream = await server.connect(first=HALF)
        with anyio.fail_after(100):
            while not has_ended(stream):
                stream[1].write(b"x")
                await asyncio.sleep(0.02)


@pytest.mark.parametrize("noise", [b"\x16\x03\x01 TLS\r\n\r\n", b"GET /" + b"x" * 100_000, b"\xfd" * 1000])
async def test_non_http_request_is_refused(noise: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_server() as server:
        with monkeypatch.context() as patched:
            patched.setattr(connections, "REQUEST_TIMEOUT_S", 0.3)
            assert (await end_of(await server.connect(first=noise)))[9:12] in (b"400", b"")
        assert await server.order(await server.connect()) in GIVEN


@pytest.mark.parametrize("method", ["POST", "HEAD"])
async def test_invalid_body_of_running_request_logs_no_error(method: str, caplog: pytest.LogCaptureFixture) -> None:
    """uvicorn would answer twice: once for the invalid body, once for the request."""
    request = f"{method} /api/vehicles HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n"
    async with open_server() as server:
        answer = await end_of(await server.connect(first=request.encode() + b"no chunk\r\n"))
        assert answer.count(b"HTTP/1.1 ") <= 1
        assert await server.order(await server.connect()) in GIVEN
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


# --------------------------------------------------------------------------------- the stream


def stream(server: Server, token: str | None = TOKEN, **options: Any) -> Any:
    protocols = [Subprotocol("aerokit.v1"), *([Subprotocol(f"bearer.{token}")] if token else [])]
    return websockets.connect(f"ws://127.0.0.1:{server.port}/api/stream", subprotocols=protocols, **options)


@pytest.mark.parametrize(
    "said", ["x" * 2_000, "x" * 2_000_000, b"\0" * 2_000_000], ids=["text", "long text", "long bytes"]
)
async def test_websocket_client_message_closes_connection(said: str | bytes) -> None:
    async with open_server() as server, stream(server) as socket:
        with pytest.raises(websockets.ConnectionClosed), anyio.fail_after(100):
            await socket.send(said)
            while True:
                await socket.recv()
        assert await server.order(await server.connect()) in GIVEN


async def test_stream_outlives_request_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "REQUEST_TIMEOUT_S", 0.3)
    async with open_server() as server, stream(server, None) as viewer:
        until = asyncio.get_running_loop().time() + 1.0
        with anyio.fail_after(100):
            while asyncio.get_running_loop().time() < until:
                assert await viewer.recv()
        await server.flood(100)
        assert await viewer.recv()


async def test_cross_site_websocket_is_refused() -> None:
    """Cross-site WebSocket hijacking, and a name that was pointed here (DNS rebinding)."""
    async with open_server() as server:
        for wrong in ({"origin": "http://evil.example"}, {"origin": f"http://127.0.0.1:{server.port + 1}"}):
            with pytest.raises(websockets.InvalidStatus):
                async with stream(server, None, **wrong):
                    pass
        async with stream(server, None, origin=f"http://127.0.0.1:{server.port}") as own:
            assert await own.recv()


async def test_dropped_streams_release_everything() -> None:
    async with open_server() as server:
        for _ in range(100):
            reader, writer = await server.connect(
                first=b"GET /api/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
                b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
            )
            with anyio.fail_after(100):
                assert b" 101 " in await reader.readuntil(b"\r\n")
            writer.transport.abort()
        async with stream(server) as owner:
            assert await owner.recv()
        with anyio.fail_after(100):
            while server.open_connections():  # noqa: ASYNC110
                await asyncio.sleep(0.01)


async def test_request_headers_are_not_reflected() -> None:
    async with open_server() as server:
        evil = b"%0d%0aSet-Cookie:%20a=b"
        for path in (
            b"/" + evil,
            b"/api/orders/" + evil,
            b"/api?refresh=" + evil,
            b"/api/vehicles/1/" + evil,
        ):
            reader, writer = await server.connect(first=b"GET " + path + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            with anyio.fail_after(100):
                assert b"set-cookie" not in (await reader.readuntil(b"\r\n\r\n")).lower()
            writer.close()


async def test_request_smuggling_is_refused() -> None:
    """Two lengths, or a length and chunks: what a proxy takes for a body would be a request here."""
    hidden = b"POST /api/vehicles/1/land HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    async with open_server() as server:
        for lengths in (
            b"Content-Length: 0\r\nContent-Length: 60",
            b"Content-Length: 4\r\nTransfer-Encoding: chunked",
        ):
            request = b"POST /api/vehicles/1/hold HTTP/1.1\r\nHost: 127.0.0.1\r\n" + lengths + b"\r\n\r\n" + hidden
            answer = await end_of(await server.connect(first=request))
            assert answer.count(b"HTTP/1.1 ") == 1
            assert answer[9:12] in (b"400", b"401")
