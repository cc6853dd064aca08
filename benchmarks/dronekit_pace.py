"""Timing of a vehicle's streams: like ArduCopter, or evenly."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import cycle

__all__ = ["bursts", "wait_until"]

BURST = 10
"""ArduCopter 4.7 sends all that is due in bursts of this size over UDP, a message a datagram,"""
BURST_INTERVAL_S = 0.0055
"""so far from one to the next,"""
SPACING_US = (31, 12, 82, 15, 40, 10, 69, 22, 133, 16, 37, 9, 60, 14, 100, 25)
"""with so much from one message to the next in a burst (observed: median 31 to 40, a tenth above 130)."""

ROUND = 25


def bursts(rate: float, *, evenly: bool) -> Iterator[tuple[float, list[float]]]:
    """Return the seconds between bursts, and the time of each message in a burst."""
    if evenly:
        while True:
            yield 1 / rate, [0.0]
    period = ROUND / rate
    spacing = cycle(SPACING_US)
    sizes = [BURST] * (ROUND // BURST) + [ROUND % BURST]
    apart = min(BURST_INTERVAL_S, period / len(sizes))
    while True:
        for number, size in enumerate(sizes):
            offset, offsets = 0.0, []
            for _ in range(size):
                offsets.append(offset)
                offset += next(spacing) * 1e-6
            is_last = number == len(sizes) - 1
            yield period - apart * number if is_last else apart, offsets


def wait_until(when: float) -> None:
    """Wait until this time of ``time.monotonic``; too short to sleep."""
    while time.monotonic() < when:
        pass
