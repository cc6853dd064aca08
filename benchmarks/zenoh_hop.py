"""Cost of a hop over a zenoh network compared with UDP: round trips of a frame between two processes on this machine.

    python benchmarks/zenoh_hop.py            # a minute; writes bench-zenoh.json
    python benchmarks/zenoh_hop.py --quick    # a short check that it runs; the figures mean little

``udp`` is ``udpout:`` to ``udpin:``. ``zenoh`` is a client that is connected to the side of the vehicle. In
``zenoh_router`` both are clients of a router, which is a third process. A PING is sent 50 times a second, and its echo
is awaited. Then a burst of 1000 is sent, and the returned frames are counted. The processor time is that of the
requesting program.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from aerokit.errors import LinkLost
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.messages import Ping
from aerokit.transport import Link, Peer, create_link

ECHO = """
import asyncio, sys
from aerokit.transport import create_link

class Echo:
    def __init__(self, link): self.link = link
    def bytes_received(self, data, peer): self.link.write(data, peer)
    def link_lost(self, error): sys.exit(str(error))

async def main():
    link = create_link(sys.argv[1])
    await link.open(Echo(link))
    print("up", flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""
ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
for key, value in (("mode", "router"), ("scouting/multicast/enabled", False), ("listen/endpoints", [sys.argv[1]])):
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
print("up", flush=True)
sys.stdin.read()
"""


class EchoReceiver:
    """Counts echoes, and sets an event for each."""

    def __init__(self) -> None:
        self.count = 0
        self.has_received = asyncio.Event()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """See `Receiver`."""
        self.count += 1
        self.has_received.set()

    def link_lost(self, error: LinkLost) -> None:
        """See `Receiver`."""
        sys.exit(str(error))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--output", type=Path, default=Path("bench-zenoh.json"))
    options = parser.parse_args(arguments)
    count = 100 if options.quick else 1000
    rows = {}
    for name in ("udp", "zenoh", "zenoh_router"):
        rows[name] = _measure(name, count)
        figures = ", ".join(f"{figure} {value:.0f}" for figure, value in rows[name].items())
        print(f"{name:14} {figures}")
    options.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def _measure(name: str, count: int) -> dict[str, float]:
    port = _free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    with contextlib.ExitStack() as stack:
        if name == "udp":
            stack.enter_context(_process(ECHO, f"udpin:127.0.0.1:{port}"))
            return asyncio.run(_measure_link(f"udpout:127.0.0.1:{port}", count))
        if name == "zenoh_router":
            stack.enter_context(_process(ROUTER, endpoint))
        option = "connect" if name == "zenoh_router" else "listen"
        stack.enter_context(_process(ECHO, f"zenohin://bench/echo?{option}={endpoint}"))
        return asyncio.run(_measure_link(f"zenoh://bench/echo?connect={endpoint}", count))


async def _measure_link(address: str, count: int) -> dict[str, float]:
    """Measure ``count`` round trips one by one, and how many frames of a burst return."""
    link = create_link(address)
    receiver = EchoReceiver()
    encoder = FrameEncoder(255, 190)
    await link.open(receiver)
    await _round_trip(link, receiver, _ping(encoder, 0), 2.0)  # import everything before the first measured frame
    round_trips: list[float] = []
    cpu_before_s = time.process_time()
    for number in range(count):
        duration_s = await _round_trip(link, receiver, _ping(encoder, number), 1.0)
        if duration_s is not None:
            round_trips.append(duration_s)
        await asyncio.sleep(0.02)
    cpu_s = time.process_time() - cpu_before_s
    receiver.count = 0
    for number in range(1000):
        link.write(_ping(encoder, number))
    await asyncio.sleep(1)
    link.close()
    await link.wait_closed()
    *_, percentile_99 = statistics.quantiles(round_trips, n=100)
    return {
        "round_trip_median_us": statistics.median(round_trips) * 1e6,
        "round_trip_p99_us": percentile_99 * 1e6,
        "processor_us": cpu_s / count * 1e6,
        "lost": count - len(round_trips),
        "of_1000_came_back": receiver.count,
    }


def _ping(encoder: FrameEncoder, number: int) -> bytes:
    return encoder.encode(Ping(time_usec=0, seq=number, target_system=0, target_component=0))


async def _round_trip(link: Link, receiver: EchoReceiver, frame: bytes, timeout_s: float) -> float | None:
    """Send a frame, and return the seconds until its echo; None if there is no echo."""
    receiver.has_received.clear()
    started_at = time.perf_counter()
    link.write(frame)
    try:
        await asyncio.wait_for(receiver.has_received.wait(), timeout_s)
    except asyncio.TimeoutError:
        return None
    return time.perf_counter() - started_at


@contextlib.contextmanager
def _process(program: str, argument: str) -> Iterator[None]:
    with subprocess.Popen(
        [sys.executable, "-c", program, argument], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as running:
        try:
            assert running.stdout is not None
            if running.stdout.readline() != "up\n":
                sys.exit(f"{argument} did not start")
            yield
        finally:
            running.kill()


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        _, port = sock.getsockname()
        return int(port)


if __name__ == "__main__":
    sys.exit(main())
