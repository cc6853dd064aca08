"""A countdown while nothing is heard, so that one sees what is waited for, where, and for how long."""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator

__all__ = ["waiting"]

AFTER_S = 1.0
"""What is heard sooner is not worth a line."""
CLEAR_LINE = "\r\x1b[K"


@asynccontextmanager
async def waiting(
    options: argparse.Namespace, address: str, seconds: float, what: str = "a heartbeat"
) -> AsyncIterator[None]:
    """While the block lasts, say on stderr how many of these seconds are left: on a terminal, and not with --json."""
    if options.json or not sys.stderr.isatty():
        yield
        return
    task = asyncio.create_task(_count_down(f"waiting for {what} on {address}", seconds))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def _count_down(text: str, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    await asyncio.sleep(AFTER_S)
    try:
        while (left := until - loop.time()) > 0:
            print(f"{CLEAR_LINE}{text} … {left:.0f} s", end="", file=sys.stderr, flush=True)
            await asyncio.sleep(1.0)
    finally:
        print(CLEAR_LINE, end="", file=sys.stderr, flush=True)
