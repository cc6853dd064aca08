"""A few rounds leave no more objects than two rounds; `nox -s soak` runs for an hour."""

from __future__ import annotations

import os
import sys
import time

import pytest
from soak_rounds import ProcessObjects, count_objects, fly_round

MINUTES = float(os.environ.get("AEROKIT_SOAK_MINUTES", "0"))
pytestmark = [pytest.mark.anyio, pytest.mark.timeout(120 + 120 * MINUTES)]
WARM, ROUNDS = 2, 4
# In a short run, the interpreter's memory varies, and pytest keeps log records. One more object per round is a leak.
OBJECTS, OBJECTS_A_ROUND, KB_A_ROUND = 300, 0.3, 4


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.mark.exhaustive
async def test_soak_rounds_leak_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    begin: ProcessObjects | None = None
    end, count, until = None, 0, time.monotonic() + 60 * MINUTES
    while count < WARM + ROUNDS or time.monotonic() < until:
        await fly_round(count)
        count += 1
        end = count_objects()
        if count == WARM:
            begin = end
        if MINUTES:
            with capsys.disabled():
                sys.stdout.write(f"{count} {end}\n")
    assert begin is not None
    assert end is not None
    rounds = count - WARM
    assert (end.tasks, end.threads, end.descriptors) == (begin.tasks, begin.threads, begin.descriptors)
    assert end.objects - begin.objects <= OBJECTS + OBJECTS_A_ROUND * rounds
    if MINUTES:
        assert end.resident_kb - begin.resident_kb <= max(8_000, KB_A_ROUND * rounds)
