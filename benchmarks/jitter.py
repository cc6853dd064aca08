"""Jitter of set-point streams: the 99th percentile of the error of an interval between two set-points, in microseconds.

    python benchmarks/jitter.py

aerokit's ``vehicle.guided.attitude_rate`` and a bare timer of asyncio that sends the same datagram take turns in one
process, at 50, 100 and 400 Hz. The vehicle is simulated in another process. The times are those of the calls that send.
"""

from __future__ import annotations

import asyncio
import itertools
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import anyio
from command_rtt import _free_ports
from table import Row, faster_is_better, quantile

import aerokit
from aerokit import AttitudeRateSetpoint

__all__ = ["RATES_HZ", "rows"]

RATES_HZ = (50, 100, 400)
ALLOWED_SHARE = 0.5
"""The aim: at most twice the jitter of the bare timer."""


def rows(rounds: int = 5, seconds: float = 2.0) -> list[Row]:
    """Return ``jitter_50``, ``jitter_100`` and ``jitter_400``."""
    return anyio.run(_measure, rounds, seconds)


async def _measure(rounds: int, seconds: float) -> list[Row]:
    (port,) = _free_ports(1)
    table: list[Row] = []
    with _simulator(port):
        async with aerokit.connect(f"udpin:127.0.0.1:{port}", timeout=30) as vehicle:
            await vehicle.wait_ready(timeout=30)
            for rate_hz in RATES_HZ:
                own: list[float] = []
                bare: list[float] = []
                for _ in range(rounds):
                    own.append(_jitter_us(await _stream(vehicle, rate_hz, seconds), rate_hz))
                    bare.append(_jitter_us(await _timer(rate_hz, seconds), rate_hz))
                name = f"jitter_{rate_hz}"
                table.append(faster_is_better(name, own, bare, "an asyncio timer", unit="us", aim=ALLOWED_SHARE))
    return table


async def _stream(vehicle: aerokit.Vehicle, rate_hz: float, seconds: float) -> list[float]:
    """Return the times at which the stream sent its set-points."""
    times: list[float] = []
    stream: Any = vehicle.guided.attitude_rate(rate_hz=rate_hz, valid_for_s=60.0, max_lag_s=10.0)
    send = stream._send

    def record() -> None:
        times.append(time.perf_counter())
        send()

    stream._send = record
    async with stream:
        stream.set(AttitudeRateSetpoint())
        await anyio.sleep(seconds)
    return times


async def _timer(rate_hz: float, seconds: float) -> list[float]:
    """Return the times at which a timer fired. Its callback only records the time."""
    loop = asyncio.get_running_loop()
    period_s = 1 / rate_hz
    times: list[float] = []
    done = asyncio.Event()

    def fire(due: float) -> None:
        times.append(time.perf_counter())
        if len(times) * period_s >= seconds:
            done.set()
            return
        next_due = max(due + period_s, loop.time())
        loop.call_at(next_due, fire, next_due)

    fire(loop.time())
    await done.wait()
    return times


def _jitter_us(times: list[float], rate_hz: float) -> float:
    errors = [abs(later - earlier - 1 / rate_hz) for earlier, later in itertools.pairwise(times)]
    return 1e6 * quantile(errors, 0.99)


@contextmanager
def _simulator(port: int) -> Iterator[None]:
    command = [sys.executable, "-m", "aerokit", "sim", f"udpout:127.0.0.1:{port}", "--boot-time", "0"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


if __name__ == "__main__":
    for measured_row in rows():
        print(measured_row)
