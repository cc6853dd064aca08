"""Shared by all tests: async tests run on asyncio, on virtual time unless a test needs real sockets."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from flight_harness import Flight, in_the_air, open_flight
from hypothesis import given, settings, strategies
from late_loop import LateLoop
from recorded import headline

if sys.dont_write_bytecode:  # else each worker and each child process would compile every module again
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a background job of a script: some tests interrupt themselves
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # nohup: programs inherit it
    signal.signal(signal.SIGHUP, lambda *_: None)
gc.disable()  # until all tests are collected: nothing of them is garbage, and each worker collects all
# `nox -s exhaustive` loads the profile "thorough".
settings.register_profile("aerokit", deadline=None, max_examples=15, derandomize=True)
settings.register_profile("thorough", settings.get_profile("aerokit"), max_examples=100)
settings.load_profile("aerokit")


def pytest_configure(config: pytest.Config) -> None:
    """Use no constants of this project as examples, unless the profile is "thorough".

    Hypothesis reads them from the source of all imported modules, which takes two seconds in each worker of a new
    clone. The examples would also depend on the modules that other tests have imported.
    """
    if config.getoption("--hypothesis-profile", None) != "thorough":
        with contextlib.suppress(ImportError):  # an old version has no such constants
            providers: Any = importlib.import_module("hypothesis.internal.conjecture.providers")
            providers._get_local_constants = lambda: providers._local_constants


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"loop_factory": LateLoop}


@pytest.fixture(scope="module", autouse=True)
def freeze_existing_objects() -> None:
    """Garbage collections over the objects of ten thousand tests would block all threads, including the simulator's."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)  # pytest-xdist's hook
def pytest_xdist_auto_num_workers() -> int:
    """Twice the number of processors: many tests wait for sockets and other processes."""
    return 2 * (os.cpu_count() or 1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Import a share of the test modules before the others, different ones in each worker.

    pytest rewrites the assertions of a module when it is first imported, and caches the result, as Python does with
    compiled modules. Workers that import all modules in the same order would all rewrite and compile all of them. The
    share is consecutive, because the tests of a folder import the same packages.
    """
    worker, count = os.environ.get("PYTEST_XDIST_WORKER"), os.environ.get("PYTEST_XDIST_WORKER_COUNT")
    # The first example of hypothesis looks up referrers among all objects, so it is run before the tests are imported
    # and frozen. The first text strategy creates a table of characters in a file, which one worker does for all.
    given(strategies.text() if worker == "gw0" else strategies.none())(lambda _: None)()
    if worker is None or count is None:
        return
    number, workers = int(worker.removeprefix("gw")), int(count)
    modules = [file for folder in session.config.args for file in sorted(Path(folder).rglob("test_*.py"))]
    for file in modules[len(modules) * number // workers : len(modules) * (number + 1) // workers]:
        if str(file.parent) not in sys.path:
            sys.path.insert(0, str(file.parent))  # as pytest does
        with contextlib.suppress(Exception, pytest.skip.Exception):  # the collection reports it
            importlib.import_module(file.stem)


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by marker
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the rows of tests marked ``sampled(n)`` as ``exhaustive``, except every ``n``-th."""
    rows: Counter[str] = Counter()
    for item in items:
        sample = item.get_closest_marker("sampled")
        if sample is not None and item.get_closest_marker("exhaustive") is None:
            test = item.nodeid.partition("[")[0]
            if rows[test] % sample.args[0]:
                item.add_marker(pytest.mark.exhaustive)
            rows[test] += 1


def pytest_collection_finish() -> None:
    """Collect garbage ten times less often than usual: the pauses were 8 % of the tests' processor time."""
    gc.freeze()  # Nothing of the collected tests is garbage.
    gc.set_threshold(7_000, 10, 100)
    gc.enable()


def pytest_report_header() -> str:
    return headline()


@pytest.fixture
def any_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the age limits of zenoh links in this process: a busy machine may need longer for a datagram."""
    from aerokit.transport.zenoh import connect, control_lease

    for module, name in ((control_lease, "MAX_DELAY_S"), (control_lease, "LEASE_TIMEOUT_S"), (connect, "LOST_AFTER_S")):
        monkeypatch.setattr(module, name, 3600.0)


@pytest.fixture
async def grounded(anyio_backend: object) -> AsyncIterator[Flight]:
    """A copter that is ready, disarmed and in STABILIZE."""
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.wire.clear()
        yield flight


@pytest.fixture
async def flying(anyio_backend: object) -> AsyncIterator[Flight]:
    """A copter hovering 10 m above home in GUIDED; ``wire.sent`` has only the messages sent during the test."""
    async with in_the_air() as flight:
        yield flight
