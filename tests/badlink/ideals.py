"""The minimum duration of each transfer, computed from its data, never measured.

``ideal = round trips that depend on each other × round-trip time + the longer of (bytes / bandwidth, vehicle's pace)``

It is the duration of a perfect client over a lossless radio: independent requests are sent at once, nothing is sent
twice, and processing takes no time. With a radio of two frequencies the busier direction counts, with one frequency the
sum of both. (A little less is possible where bytes move while others wait for their round trip.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from bad_link import Radio

FTP_DATA = 239
FTP_BLOCK = 12 + 3 + 12 + FTP_DATA  # MAVLink's frame, the targets, the FTP header
FTP_REQUEST = 12 + 3 + 12
PARAM_VALUE, PARAM_SET, PARAM_REQUEST = 37, 35, 32
ITEM, ITEM_REQUEST, SHORT = 50, 17, 20
QUEUE = 20
LOG_DATA, LOG_BLOCK = 90, 12 + 97


@dataclass(frozen=True)
class Ideal:
    """Minimum traffic of one transfer."""

    round_trips: int
    """Round trips that must follow each other."""
    up: int = 0
    """Bytes to the vehicle."""
    down: int = 0
    """Bytes from the vehicle."""
    vehicle_s: float = 0.0
    """Time that the vehicle itself takes to send its part."""

    def seconds(self, radio: Radio) -> float:
        """Ideal duration over this kind of radio without faults."""
        moved = self.up + self.down if radio.half_duplex else max(self.up, self.down)
        return self.round_trips * 2 * radio.model.delay_s + max(moved / radio.model.bandwidth, self.vehicle_s)

    def __add__(self, other: Ideal) -> Ideal:
        """Sum of consecutive exchanges."""
        return Ideal(
            self.round_trips + other.round_trips,
            self.up + other.up,
            self.down + other.down,
            self.vehicle_s + other.vehicle_s,
        )


def parameter_list(count: int, *, per_second: float) -> Ideal:
    """The request and its answer."""
    return Ideal(1, PARAM_REQUEST, count * PARAM_VALUE, count / per_second)


def parameter_writes(count: int) -> Ideal:
    """Each write is sent and confirmed independently, but a vehicle queues at most `QUEUE` writes."""
    return Ideal(math.ceil(count / QUEUE), count * PARAM_SET, count * PARAM_VALUE)


def parameter_reads(count: int) -> Ideal:
    """Like writes."""
    return Ideal(math.ceil(count / QUEUE), count * PARAM_REQUEST, count * PARAM_VALUE)


def file_read(size: int, *, blocks_per_second: float = math.inf) -> Ideal:
    """Open, burst. (That the session is closed need not be waited for.)"""
    blocks = math.ceil(size / FTP_DATA)
    pace_s = max(0, blocks - 1) / blocks_per_second
    return Ideal(2, 3 * FTP_REQUEST, size + (blocks + 2) * (FTP_BLOCK - FTP_DATA), pace_s)


def file_write(size: int) -> Ideal:
    """Create, write all blocks, close: it is not there before."""
    blocks = math.ceil(size / FTP_DATA)
    return Ideal(3, size + (blocks + 2) * (FTP_BLOCK - FTP_DATA), (blocks + 2) * FTP_REQUEST)


def checksum() -> Ideal:
    """One request and one answer."""
    return Ideal(1, FTP_REQUEST, FTP_REQUEST)


def directory(pages: int) -> Ideal:
    """Each page has the start of the next one; the last answer is an end-of-file error."""
    return Ideal(pages + 1, (pages + 1) * FTP_REQUEST, pages * FTP_BLOCK)


def items_read(count: int) -> Ideal:
    """The count, then item by item, as the standard has it. (aerokit asks ArduPilot for several at a time.)"""
    return Ideal(count + 1, count * ITEM_REQUEST, count * ITEM)


def items_written(count: int) -> Ideal:
    """The count, then the vehicle asks for item by item. (aerokit sends ahead.)"""
    return Ideal(count + 1, count * ITEM, count * ITEM_REQUEST)


def log_list(count: int, *, per_second: float) -> Ideal:
    """One request, one entry for each."""
    return Ideal(1, SHORT, count * (14 + 12), (count - 1) / per_second)


def log_read(size: int, *, blocks_per_second: float = math.inf) -> Ideal:
    """One request and its answer."""
    blocks = math.ceil(size / LOG_DATA)
    return Ideal(1, SHORT, blocks * LOG_BLOCK, max(0, blocks - 1) / blocks_per_second)
