"""A few rounds leave as much as two did; `nox -s soak` goes on for an hour."""

from __future__ import annotations

import os
import sys
import time

import pytest
from soak_rounds import Left, fly_round, left

pytestmark = pytest.mark.anyio

MINUTES = float(os.environ.get("AEROKIT_SOAK_MINUTES", "0"))
WARM, ROUNDS = 2, 4
OBJECTS_A_ROUND, KB_A_ROUND = 30, 40
"""More than this in each round is a leak; less is the interpreter's own wandering."""


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


async def test_nothing_grows(capsys: pytest.CaptureFixture[str]) -> None:
    begin: Left | None = None
    end, count, until = None, 0, time.monotonic() + 60 * MINUTES
    while count < WARM + ROUNDS or time.monotonic() < until:
        await fly_round(count)
        count += 1
        end = left()
        if count == WARM:
            begin = end
        if MINUTES:
            with capsys.disabled():
                sys.stdout.write(f"{count} {end}\n")
    assert begin is not None
    assert end is not None
    rounds = count - WARM
    assert (end.tasks, end.threads, end.descriptors) == (begin.tasks, begin.threads, begin.descriptors)
    assert end.objects - begin.objects <= OBJECTS_A_ROUND * rounds
    if MINUTES:
        assert end.resident_kb - begin.resident_kb <= max(8_000, KB_A_ROUND * rounds)
