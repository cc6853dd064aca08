"""A camera's definition file from a server of the web: what is taken, and what ends the download."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NoReturn

import anyio
import pytest

from aerokit._internal.files import LARGEST_FILE
from aerokit.errors import FileFormatError, FileTimeout, OperationRejected
from aerokit.parameters import parse_definition
from aerokit.sim.components.camera_body import own_definition
from aerokit.vehicle.components.session import fetch

pytestmark = pytest.mark.anyio
PATIENCE_S = 5.0


class Site:
    """Answers each path as a test says."""

    def __init__(self) -> None:
        self.answers: dict[str, Callable[[BaseHTTPRequestHandler], None]] = {}
        self.is_over = threading.Event()
        self.visitor_has_gone = threading.Event()
        site = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    site.answers[self.path](self)
                except OSError:
                    site.visitor_has_gone.set()

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base class's word
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.server.block_on_close = False
        self.address = f"http://127.0.0.1:{self.server.server_port}"

    def says(self, path: str, content: bytes, *, status: int = 200, length: int | None = None) -> str:
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
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    made = Site()
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


async def fetched(uri: str, patience_s: float = PATIENCE_S) -> bytes:
    return await fetch(uri, no_files, 100, patience_s)


async def test_a_definition_from_the_web(site: Site) -> None:
    place = site.says("/camera.xml", own_definition())
    assert len(parse_definition(await fetched(place)).settings) == 12
    assert await fetched(site.leads("/latest", place)) == own_definition()


async def test_what_the_server_does_not_give(site: Site) -> None:
    with pytest.raises(OperationRejected, match="404"):
        await fetched(site.says("/gone", b"", status=404))
    with pytest.raises(OperationRejected, match=r"5 bytes did not come|IncompleteRead"):
        await fetched(site.says("/cut", b"12345", length=10))
    with pytest.raises(OperationRejected, match="was not given"):
        await fetched("http://127.0.0.1:1/camera.xml")
    with pytest.raises(OperationRejected, match="was not given"):
        await fetched("http://127.0.0.1:port/camera.xml")


@pytest.mark.parametrize("target", ["file:///etc/hostname", "ftp://127.0.0.1/a", "data:text/plain,a"])
async def test_an_address_does_not_lead_to_files_of_this_computer(site: Site, target: str) -> None:
    with pytest.raises(OperationRejected):
        await fetched(site.leads("/elsewhere", target))


async def test_it_does_not_go_round_in_circles(site: Site) -> None:
    with pytest.raises(OperationRejected):
        await fetched(site.leads("/round", f"{site.address}/round"))


async def test_no_more_is_taken_than_such_files_have(site: Site) -> None:
    with pytest.raises(FileFormatError, match="more than 16 MB"):
        await fetched(site.says("/large", bytes(LARGEST_FILE + 1)))


async def test_a_server_that_says_nothing(site: Site) -> None:
    def answer(_: BaseHTTPRequestHandler) -> None:
        site.is_over.wait()

    site.answers["/silent"] = answer
    with pytest.raises(FileTimeout, match=r"did not come: nothing for 0\.2 s"):
        await fetched(f"{site.address}/silent", patience_s=0.2)


async def test_who_gives_up_leaves_no_thread_behind_that_waits(site: Site) -> None:
    """The server sends a byte of its header now and then, for ever."""
    loop, has_begun = asyncio.get_running_loop(), asyncio.Event()

    def drip(handler: BaseHTTPRequestHandler) -> None:
        loop.call_soon_threadsafe(has_begun.set)
        handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Long: ")
        while not site.is_over.wait(0.01):
            handler.wfile.write(b"x")

    site.answers["/drip"] = drip
    async with anyio.create_task_group() as group:
        group.start_soon(fetched, f"{site.address}/drip")
        await has_begun.wait()
        group.cancel_scope.cancel()
    assert await asyncio.to_thread(site.visitor_has_gone.wait, 10)
