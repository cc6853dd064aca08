"""The clock of tests on virtual time begins somewhere, as on a real computer: counting from zero is noticed."""

from __future__ import annotations

import asyncio

from aerokit.testing.clock import VirtualClockLoop

__all__ = ["BEGINS_AT", "LateLoop", "since_the_beginning"]

BEGINS_AT = 10_000.0


class LateLoop(VirtualClockLoop):
    """Virtual time from `BEGINS_AT` on."""

    def __init__(self) -> None:
        super().__init__()
        self._now = BEGINS_AT


def since_the_beginning() -> float:
    """Seconds on the running loop's clock."""
    return asyncio.get_running_loop().time() - BEGINS_AT
