"""What all tests share: async tests run on asyncio, on virtual time unless a test asks for real sockets."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import AsyncIterator
from typing import Any

import pytest
from flight_harness import Flight, in_the_air, open_flight
from hypothesis import given, settings, strategies
from late_loop import LateLoop
from recorded import headline

if sys.dont_write_bytecode:  # each worker, and each program of a test, would compile everything anew
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # a background job of a script: some tests interrupt themselves
    signal.signal(signal.SIGINT, signal.default_int_handler)
settings.register_profile("aerokit", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("aerokit")


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"loop_factory": LateLoop}


@pytest.fixture(scope="session", autouse=True)
def hypothesis_has_begun() -> None:
    """At its first example it looks for who refers to its generators, and finds nobody who is frozen."""
    given(strategies.none())(lambda _: None)()


@pytest.fixture(scope="module", autouse=True)
def what_was_there_before_is_no_garbage(hypothesis_has_begun: None) -> None:
    """Collections that go through ten thousand tests keep all threads waiting, the simulated vehicles' among them."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_auto_num_workers() -> int:
    """Twice the number of processors: many tests wait for sockets and other processes."""
    return 2 * (os.cpu_count() or 1)


def pytest_report_header() -> str:
    return headline()


@pytest.fixture
async def grounded(anyio_backend: object) -> AsyncIterator[Flight]:
    """Ready, disarmed, in STABILIZE."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.wire.forget()
        yield flight


@pytest.fixture
async def flying(anyio_backend: object) -> AsyncIterator[Flight]:
    """Hovering 10 m above home in GUIDED; nothing but what the test does is in ``wire.sent``."""
    async with in_the_air() as flight:
        yield flight
