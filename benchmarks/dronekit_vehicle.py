"""A scripted vehicle in a separate process, for all three libraries of ``dronekit_compare.py``.

    python benchmarks/dronekit_vehicle.py '{"transport": "udp", "port": 14550, "version": 2}'

The vehicle uses none of these libraries: it packs and parses frames by pymavlink, and sends them from a blocking loop.
It prints ``ready``, and starts when a client has connected, or for UDP when it reads a line ``go``. Further lines on
standard input are commands:

- ``rate 500``: messages per second, in bursts; ``rate 500 evenly`` without bursts; ``rate max`` as fast as possible.
- ``stamps``: print a line of JSON with the name, the round number and the time of each sent message (CLOCK_MONOTONIC in
  ns).

The process runs until it is terminated.
"""

from __future__ import annotations

import heapq
import json
import math
import select
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any

from dronekit_link import make_link
from dronekit_pace import bursts, wait_until
from dronekit_services import Services
from dronekit_traffic import Numbering, heartbeat, rounds

__all__ = ["Options", "Vehicle"]

STREAM_KINDS_AT_ONCE = 25
PIECE = 1400
"""Bytes of one write on TCP at the maximum rate."""
# Number of datagrams sent in a row before other work.
DATAGRAMS_IN_A_ROW = 16


@dataclass(frozen=True)
class Options:
    """Properties of the vehicle."""

    transport: str = "udp"
    port: int = 14550
    version: int = 2
    rate: float = 0.0
    """Streamed messages per second; 0: as requested by REQUEST_DATA_STREAM."""
    parameters: int = 20
    list_rate: float = 1400.0
    """Parameters per second."""
    has_ftp: bool = False
    file_rate: float = 46_000.0
    """Bytes per second of a file that is read by MAVFTP."""
    heartbeat_after: float = 0.0
    """Seconds from the start of the vehicle to its first heartbeat. The others follow each second."""
    bandwidth: float = 0.0
    """Bytes per second of the link; 0: no limit."""
    delay: float = 0.0
    """Delay in each direction in seconds."""


class Vehicle:
    """Sends heartbeats, streams and answers at their scheduled times."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.link = make_link(options.transport, options.port, options.delay, options.bandwidth)
        self.stamps: list[tuple[str, int, int]] = []
        self._numbering = Numbering()
        self._services = Services(self)
        self._frames = rounds(options.version)
        self._position = 0
        self._rate = options.rate
        self._stream_number = 0  # a stream with an older number stops
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._lines = open(0, "rb", buffering=0)  # noqa: SIM115 - select sees nothing that a buffer has

    def run(self) -> None:
        """Print ``ready``, then run until the process is terminated."""
        print("ready", flush=True)
        if not self.link.is_stream:
            self._lines.readline()  # The line "go" means that a client listens.
        self.link.wait_for_peer()
        self.at(time.monotonic() + self.options.heartbeat_after, self._send_heartbeats)
        self.set_rate(self._rate)
        while True:
            self._run_due_functions()
            if self._rate == math.inf:
                self._send_without_pace()
            self._wait()

    # ------------------------------------------------------------------------- used by Services

    def at(self, when: float, function: Callable[[], None]) -> None:
        """Call a function at a time of ``time.monotonic``."""
        heapq.heappush(self._due, (when, next(self._order), function))

    def send(self, frame: bytes) -> None:
        """Send a frame with the next sequence number."""
        self.link.send(self._numbering.numbered(frame))

    def stream(self, hertz: float) -> None:
        """Send every message of the streams this many times a second."""
        if self.options.rate == 0:
            self.set_rate(hertz * STREAM_KINDS_AT_ONCE)

    def set_rate(self, rate: float, *, evenly: bool = False) -> None:
        """Stream this many messages per second from now on, in bursts like ArduCopter or evenly."""
        self._rate = rate
        self._stream_number += 1
        if 0 < rate < math.inf:
            self._send_burst(time.monotonic(), self._stream_number, bursts(rate, evenly=evenly))

    # ------------------------------------------------------------------------------- inside

    def _send_burst(self, due_at: float, stream_number: int, pace: Iterator[tuple[float, list[float]]]) -> None:
        """Send the next burst of a stream, and schedule the one after it."""
        if stream_number != self._stream_number:
            return
        interval_s, offsets = next(pace)
        begins_at = time.monotonic()
        for offset in offsets:
            wait_until(begins_at + offset)
            self._send_next()
        next_due = due_at + interval_s
        self.at(next_due, lambda: self._send_burst(next_due, stream_number, pace))

    def _send_next(self) -> None:
        raw, kind, number = self._frames[self._position]
        self._position = (self._position + 1) % len(self._frames)
        if kind == "HEARTBEAT" and self.options.rate == 0:
            return  # Heartbeats are sent each second, independently of streams.
        numbered = self._numbering.numbered(raw)
        if self._rate < math.inf:
            self.stamps.append((kind, number, time.monotonic_ns()))
        self.link.send(numbered)

    def _send_without_pace(self) -> None:
        """Send as many messages as the link accepts now."""
        if not self.link.is_stream:
            for _ in range(DATAGRAMS_IN_A_ROW):
                self._send_next()
        elif self.link.is_writable:
            piece = b""
            while len(piece) < PIECE:
                raw, _, _ = self._frames[self._position]
                piece += self._numbering.numbered(raw)
                self._position = (self._position + 1) % len(self._frames)
            self.link.send(piece)

    def _send_heartbeats(self) -> None:
        if self.options.rate == 0:
            self.send(heartbeat(self.options.version))
            self.at(time.monotonic() + 1.0, self._send_heartbeats)

    def _next_due(self) -> float:
        if not self._due:
            return math.inf
        due_at, _, _ = self._due[0]
        return due_at

    def _run_due_functions(self) -> None:
        now = time.monotonic()
        while self._next_due() <= now:
            _, _, function = heapq.heappop(self._due)
            function()

    def _wait(self) -> None:
        """Wait until a message arrives or an action is due. At the maximum rate, do not wait."""
        next_due = min(self.link.release_due(), self._next_due())
        has_maximum_rate = self._rate == math.inf
        can_send_at_once = has_maximum_rate and (not self.link.is_stream or self.link.is_writable)
        timeout = 0.0 if can_send_at_once else max(0.0, min(next_due - time.monotonic(), 1.0))
        writers: list[Any] = [self.link.socket] if self.link.wants_to_write or has_maximum_rate else []
        readers: list[Any] = [self.link.socket, self._lines]
        ready, _, _ = select.select(readers, writers, [], timeout)
        if self.link.socket in ready:
            self.link.read()
        if self._lines in ready:
            self._execute(self._lines.readline().decode().split())
        for message in self.link.received():
            self._services.receive(message)

    def _execute(self, words: list[str]) -> None:
        """Execute a command of standard input. At the end of the input, which has no words, exit."""
        if not words:
            sys.exit()
        command, *arguments = words
        if command == "rate":
            rate, *options = arguments
            self.stamps.clear()
            self.set_rate(math.inf if rate == "max" else float(rate), evenly=options == ["evenly"])
        if command == "stamps":
            print(json.dumps(self.stamps), flush=True)


def main(arguments: list[str]) -> None:
    """Serve until the process is terminated."""
    (options_text,) = arguments
    options: dict[str, Any] = json.loads(options_text)
    Vehicle(Options(**options)).run()


if __name__ == "__main__":
    main(sys.argv[1:])
