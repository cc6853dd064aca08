"""A zenoh network on this machine: explicit endpoints on 127.0.0.1, no scouting, other processes, a pausable relay."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator

import anyio
from free_ports import free_port

__all__ = ["SERVER", "HoldingProxy", "eventually", "process", "router"]

ROUTER = """
import json, sys, zenoh
config = zenoh.Config.from_file(sys.argv[2]) if len(sys.argv) > 2 else zenoh.Config()
for key, value in (("mode", "router"), ("scouting/multicast/enabled", False), ("listen/endpoints", [sys.argv[1]])):
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
print("up", flush=True)
sys.stdin.read()
"""
SERVER = """
import asyncio, sys
from aerokit.transport import create_link
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import Heartbeat

class Receiver:
    def bytes_received(self, data, peer): pass
    def link_lost(self, error): sys.exit(str(error))

async def main():
    link, encoder = create_link(sys.argv[1]), FrameEncoder(1, 1)
    await link.open(Receiver())
    print("up", flush=True)
    while True:
        link.write(encoder.encode(Heartbeat(2, 3, 81, 4, 3)))
        await asyncio.sleep(0.1)

asyncio.run(main())
"""


async def eventually(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds, which may depend on threads and other processes. Fail after 100 s."""
    with anyio.fail_after(100):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


@contextlib.contextmanager
def process(program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start another process, and wait until it reports that it is running."""
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as running:
        try:
            assert running.stdout is not None
            assert running.stdout.readline() == "up\n"
            yield running
        finally:
            running.kill()


def router(port: int, config: str = "") -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    """Start a zenoh router, with or without a configuration file."""
    return process(ROUTER, f"tcp/127.0.0.1:{port}", *filter(None, [config]))


class HoldingProxy:
    """A TCP proxy that can hold back its traffic."""

    def __init__(self, port: int) -> None:
        self.port = free_port()
        self.held_bytes = 0
        self._to = port
        self._flows = asyncio.Event()
        self._flows.set()
        self._writers: list[asyncio.StreamWriter] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.AbstractServer | None = None

    async def __aenter__(self) -> HoldingProxy:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", self.port)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for task in self._tasks:
            task.cancel()
        for writer in self._writers:
            writer.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(writer.wait_closed() for writer in self._writers), return_exceptions=True)

    def hold(self) -> None:
        """Hold all traffic back from now on."""
        self._flows.clear()

    def release(self) -> None:
        """Deliver the traffic that was held back."""
        self._flows.set()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._to)
        self._writers += [writer, back]
        for source, sink in ((reader, back), (there, writer)):
            task = asyncio.get_running_loop().create_task(self._carry(source, sink))
            self._tasks.add(task)

    async def _carry(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        held: list[bytes] = []

        async def flush() -> None:
            await self._flows.wait()
            sink.writelines(held)
            held.clear()

        flushing: asyncio.Task[None] | None = None
        with contextlib.suppress(ConnectionError):
            while data := await source.read(65536):
                held.append(data)
                if self._flows.is_set() and (flushing is None or flushing.done()):
                    await flush()
                    continue
                self.held_bytes += len(data)
                if flushing is None or flushing.done():
                    flushing = asyncio.get_running_loop().create_task(flush())
                    self._tasks.add(flushing)
        sink.close()
