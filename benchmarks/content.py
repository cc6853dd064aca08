"""What is transferred in ``transfers.py``: made by a rule, so that each side knows what it has to be."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

__all__ = [
    "DOWNLOAD_PATH",
    "FULL",
    "LIMIT_S",
    "QUICK",
    "UPLOAD_PATH",
    "Item",
    "Sizes",
    "file_content",
    "mission_items",
]

PARAMETERS = 1350
DOWNLOAD_PATH = "/APM/bench.bin"
UPLOAD_PATH = "/APM/upload.bin"
LIMIT_S = 120.0
"""Who has not finished after so many seconds has failed."""

WAYPOINT, GLOBAL_RELATIVE_ALT = 16, 3

Item = tuple[int, int, float, float, float, float, int, int, float]
"""command, frame, param1 to param4, latitude and longitude in 1e-7 degrees, altitude."""


@dataclass(frozen=True)
class Sizes:
    """How much is transferred."""

    items: int = 200
    file_bytes: int = 1_000_000


FULL = Sizes()
QUICK = Sizes(items=10, file_bytes=20_000)


def mission_items(count: int) -> list[Item]:
    """Waypoints, without a home item."""
    return [
        (WAYPOINT, GLOBAL_RELATIVE_ALT, 0.0, 0.0, 0.0, 0.0,
         -353632610 + 1000 * n, 1491652299 + 700 * n, 20.0 + n % 50)
        for n in range(count)
    ]  # fmt: skip


def as_numbers(item: Any) -> Item:
    """The same of a MissionItem."""
    numbers = (item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z)
    return (int(item.command), int(item.frame), *numbers)


def file_content(size: int) -> bytes:
    """Bytes that cannot be guessed: what a download fills a hole with is not what belongs there."""
    return random.Random(size).randbytes(size)
