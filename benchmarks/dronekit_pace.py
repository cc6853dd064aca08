"""Timing of a vehicle's streams: in bursts like ArduCopter, or evenly spaced."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import cycle

__all__ = ["bursts", "wait_until"]

# Observed in ArduCopter 4.7 over UDP, where each message is a datagram: it sends messages that are due in bursts of 10,
# 5.5 ms apart. Within a burst, the median distance of messages is 31 to 40 µs, and a tenth of them exceed 130 µs.
BURST = 10
BURST_INTERVAL_S = 0.0055
SPACING_US = (31, 12, 82, 15, 40, 10, 69, 22, 133, 16, 37, 9, 60, 14, 100, 25)

# Number of messages that are due at the same time: one of each type.
ROUND = 25


def bursts(rate: float, *, evenly: bool) -> Iterator[tuple[float, list[float]]]:
    """Yield for each burst the seconds until the next one, and the time offset of each message in it."""
    if evenly:
        while True:
            yield 1 / rate, [0.0]
    period_s = ROUND / rate
    spacings_us = cycle(SPACING_US)
    sizes = [BURST] * (ROUND // BURST) + [ROUND % BURST]
    interval_s = min(BURST_INTERVAL_S, period_s / len(sizes))
    while True:
        remaining_s = period_s
        for size in sizes[:-1]:
            remaining_s -= interval_s
            yield interval_s, _offsets(size, spacings_us)
        yield remaining_s, _offsets(sizes[-1], spacings_us)


def _offsets(size: int, spacings_us: Iterator[int]) -> list[float]:
    """Return the seconds from the beginning of a burst to each of its messages."""
    offsets = []
    offset_s = 0.0
    for _ in range(size):
        offsets.append(offset_s)
        offset_s += next(spacings_us) * 1e-6
    return offsets


def wait_until(when: float) -> None:
    """Wait until this time of ``time.monotonic`` in a busy loop, because the time is too short to sleep."""
    while time.monotonic() < when:
        pass
