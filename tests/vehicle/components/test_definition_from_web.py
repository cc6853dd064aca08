"""Camera definition files from a web server: accepted files and failures."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NoReturn

import anyio
import pytest

from aerokit._internal.files import MAX_FILE_SIZE
from aerokit.errors import FileFormatError, FileTimeout, OperationRejected
from aerokit.parameters import parse_definition
from aerokit.sim.components.camera import own_definition
from aerokit.vehicle.components.session import fetch

pytestmark = pytest.mark.anyio
PATIENCE_S = 5.0


class WebServer:
    """HTTP handler that answers each path as configured by the test."""

    def __init__(self) -> None:
        self.answers: dict[str, Callable[[BaseHTTPRequestHandler], None]] = {}
        self.is_over = threading.Event()
        self.visitor_has_gone = threading.Event()
        web_server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    web_server.answers[self.path](self)
                except OSError:
                    web_server.visitor_has_gone.set()

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base class's word
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.server.block_on_close = False
        self.address = f"http://127.0.0.1:{self.server.server_port}"

    def serve_content(self, path: str, content: bytes, *, status: int = 200, length: int | None = None) -> str:
        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(status)
            handler.send_header("Content-Length", str(len(content) if length is None else length))
            handler.end_headers()
            handler.wfile.write(content)

        self.answers[path] = answer
        return self.address + path

    def leads(self, path: str, to: str) -> str:
        def answer(handler: BaseHTTPRequestHandler) -> None:
            handler.send_response(302)
            handler.send_header("Location", to)
            handler.end_headers()

        self.answers[path] = answer
        return self.address + path


@pytest.fixture
def web_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[WebServer]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    made = WebServer()
    thread = threading.Thread(target=made.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield made
    finally:
        made.is_over.set()
        made.server.shutdown()
        made.server.server_close()
        thread.join()


def no_files(_: int) -> NoReturn:
    raise AssertionError("this is no file of a component")


async def fetched(uri: str, idle_timeout_s: float = PATIENCE_S) -> bytes:
    return await fetch(uri, no_files, 100, idle_timeout_s)


async def test_definition_is_fetched_from_the_web(web_server: WebServer) -> None:
    place = web_server.serve_content("/camera.xml", own_definition())
    assert len(parse_definition(await fetched(place)).settings) == 12
    assert await fetched(web_server.leads("/latest", place)) == own_definition()


async def test_web_server_errors_are_operation_rejected(web_server: WebServer) -> None:
    with pytest.raises(OperationRejected, match="404"):
        await fetched(web_server.serve_content("/gone", b"", status=404))
    with pytest.raises(OperationRejected, match=r"5 bytes before the end|IncompleteRead"):
        await fetched(web_server.serve_content("/cut", b"12345", length=10))
    with pytest.raises(OperationRejected, match="could not be fetched"):
        await fetched("http://127.0.0.1:1/camera.xml")
    with pytest.raises(OperationRejected, match="could not be fetched"):
        await fetched("http://127.0.0.1:port/camera.xml")


@pytest.mark.parametrize("target", ["file:///etc/hostname", "ftp://127.0.0.1/a", "data:text/plain,a"])
async def test_file_url_is_refused(web_server: WebServer, target: str) -> None:
    with pytest.raises(OperationRejected):
        await fetched(web_server.leads("/elsewhere", target))


async def test_redirect_loop_is_an_error(web_server: WebServer) -> None:
    with pytest.raises(OperationRejected):
        await fetched(web_server.leads("/round", f"{web_server.address}/round"))


async def test_oversized_web_file_is_refused(web_server: WebServer) -> None:
    with pytest.raises(FileFormatError, match="more than 16 MB"):
        await fetched(web_server.serve_content("/large", bytes(MAX_FILE_SIZE + 1)))


async def test_silent_web_server_times_out(web_server: WebServer) -> None:
    def answer(_: BaseHTTPRequestHandler) -> None:
        web_server.is_over.wait()

    web_server.answers["/silent"] = answer
    with pytest.raises(FileTimeout, match=r"stalled: no data for 0\.2 s"):
        await fetched(f"{web_server.address}/silent", idle_timeout_s=0.2)


async def test_cancelled_fetch_leaves_no_thread(web_server: WebServer) -> None:
    """The server keeps sending single bytes of its header."""
    loop, has_begun = asyncio.get_running_loop(), asyncio.Event()

    def send_slowly(handler: BaseHTTPRequestHandler) -> None:
        loop.call_soon_threadsafe(has_begun.set)
        handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Long: ")
        while not web_server.is_over.wait(0.01):
            handler.wfile.write(b"x")

    web_server.answers["/drip"] = send_slowly
    async with anyio.create_task_group() as group:
        group.start_soon(fetched, f"{web_server.address}/drip")
        await has_begun.wait()
        group.cancel_scope.cancel()
    assert await asyncio.to_thread(web_server.visitor_has_gone.wait, 10)
