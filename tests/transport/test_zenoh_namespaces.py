"""Two machines, as network namespaces with a cable between them that is pulled out; needs privileges."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

pytest.importorskip("zenoh")

VEHICLE = """
import asyncio, sys
from aerokit.transport import create_link

class Receiver:
    def bytes_received(self, data, peer): print("received", len(data), flush=True)
    def link_lost(self, error): sys.exit(str(error))

async def main():
    link = create_link("zenohin://north/alpha?listen=tcp/10.99.7.1:7447")
    await link.open(Receiver())
    print("up", flush=True)
    while await asyncio.to_thread(sys.stdin.readline):
        print("late", link.late_datagrams, flush=True)

asyncio.run(main())
"""
CLIENT = """
import asyncio, sys
from aerokit.transport import create_link
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import CommandLong

class Receiver:
    def bytes_received(self, data, peer): pass
    def link_lost(self, error): sys.exit(str(error))

async def main():
    link, encoder = create_link("zenoh://north/alpha?connect=tcp/10.99.7.1:7447"), FrameEncoder(255, 190)
    await link.open(Receiver())
    print("up", flush=True)
    while (line := await asyncio.to_thread(sys.stdin.readline)):
        while True:
            dropped = link.dropped_writes  # which notices about late ones raise too
            link.write(encoder.encode(CommandLong(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)))
            is_dropped = link.dropped_writes > dropped
            if is_dropped == line.startswith("until dropped"):
                break
            await asyncio.sleep(0.05)
        print("done", flush=True)

asyncio.run(main())
"""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, timeout=100)


@pytest.fixture
def machines() -> Iterator[tuple[str, str]]:
    """Names of two namespaces, 10.99.7.1 and 10.99.7.2."""
    if sys.platform != "linux" or shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("namespaces are made by root, with iproute2, on Linux")
    one, two = (f"aerokit-{os.getpid()}-{n}" for n in (1, 2))
    with ExitStack() as stack:
        try:
            for name in (one, two):
                ip("netns", "add", name)
                stack.callback(ip, "netns", "del", name)
            ip("link", "add", "cable", "netns", one, "type", "veth", "peer", "name", "cable", "netns", two)
            for name, address in ((one, "10.99.7.1/24"), (two, "10.99.7.2/24")):
                ip("-n", name, "addr", "add", address, "dev", "cable")
                ip("-n", name, "link", "set", "cable", "up")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no namespaces here: {error.stderr!r}")
        yield one, two


class Program:
    """A process in a network namespace, which answers each line with a line."""

    def __init__(self, namespace: str, program: str) -> None:
        self.running = subprocess.Popen(
            ["ip", "netns", "exec", namespace, sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Program:
        assert self.line() == "up"
        return self

    def __exit__(self, *_: object) -> None:
        self.running.kill()
        self.running.communicate()

    def line(self) -> str:
        assert self.running.stdout is not None
        return self.running.stdout.readline().strip()

    def ask(self, words: str) -> str:
        assert self.running.stdin is not None
        self.running.stdin.write(words + "\n")
        self.running.stdin.flush()
        return self.line()


def test_unplugged_cable(machines: tuple[str, str]) -> None:
    one, two = machines
    late = 0
    with Program(one, VEHICLE) as vehicle, Program(two, CLIENT) as client:

        def received() -> int:
            """Return the number of datagrams that the server reported since the last call; update ``late``."""
            nonlocal late
            line, count = vehicle.ask("late?"), 0
            while line.startswith("received"):
                line, count = vehicle.line(), count + 1
            late = int(line.split()[1])
            return count

        sent = arrived = 0
        while not arrived:  # a busy machine may delay one for longer than two seconds
            assert client.ask("until sent") == "done"
            sent += 1
            time.sleep(0.05)
            arrived += received()
        late_before = late
        ip("-n", one, "link", "set", "cable", "down")
        assert client.ask("until dropped") == "done"  # for two seconds it is written into the void
        ip("-n", one, "link", "set", "cable", "up")
        arrived_before = arrived
        while arrived == arrived_before or late == late_before:  # TCP delivers what it has kept.
            assert client.ask("until sent") == "done"  # a beacon has come
            sent += 1
            time.sleep(0.05)
            arrived += received()
        assert arrived <= sent  # none of the others
