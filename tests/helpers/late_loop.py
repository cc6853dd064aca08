"""A virtual clock that does not start at 0, as on a real computer, to reveal code that assumes it does."""

from __future__ import annotations

import asyncio

from aerokit.testing.clock import VirtualClockLoop

__all__ = ["BEGINS_AT", "LateLoop", "since_the_beginning"]

BEGINS_AT = 10_000.0


class LateLoop(VirtualClockLoop):
    """Virtual time, starting at `BEGINS_AT`."""

    def __init__(self) -> None:
        super().__init__()
        self._now = BEGINS_AT


def since_the_beginning() -> float:
    """Return the time on the running loop's clock."""
    return asyncio.get_running_loop().time() - BEGINS_AT
