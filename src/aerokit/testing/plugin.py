"""The pytest plugin of `aerokit-mavlink[testing]`: simulated vehicles as fixtures; docs/testing.md shows each.

- ``flight``, ``fleet``: on virtual time, for ``async def`` tests (with anyio's plugin or none) or ``flight.run(main)``
- ``served_flight``: on a socket, for blocking programs; ``blocking_vehicle`` is an `aerokit.sync.Vehicle` on it
- ``dronekit_address``, ``dronekit``: on a socket, and `aerokit.dronekit` under DroneKit's name
- ``@pytest.mark.simulated("plane", seed=3)``: which vehicle these fixtures simulate

A test that uses none of them is not touched, and nothing of aerokit is imported for it.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Generator, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from types import ModuleType

    import aerokit.sync
    from aerokit.testing.flights import Fleet, Flight
    from aerokit.testing.served import ServedFlight

_MARKER, _PICTURES = "simulated", "--flight-pictures"
_OPENED = "_aerokit_opened"
_TOLD = ("Fleet", "Flight", "ServedFlight")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for pictures."""
    parser.getgroup("aerokit").addoption(
        _PICTURES,
        metavar="DIR",
        help="draw what was flown in each test that fails, as an .svg in this directory, and put its recording"
        " (.tlog) and report (.html) there",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Import aerokit as it is: pytest rewrites all modules of a package that has a plugin, in whatever thread.

    That takes its time, and two threads that do it at once can stumble over each other in Python 3.10 to 3.12.
    """
    rewriting = getattr(early_config.pluginmanager, "rewrite_hook", None)
    marked = getattr(rewriting, "_must_rewrite", None)  # there is no public way back
    if rewriting is not None and isinstance(marked, set):
        marked -= {name for name in marked if name.partition(".")[0] == "aerokit"}
        rewriting.mark_rewrite()  # forgets what it knew of each name


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line(
        "markers",
        f"{_MARKER}(*kinds, count=None, connect=True, speedup=10, **options): the vehicle of aerokit's fixtures,"
        ' such as "copter" or "px4", with the options of its class',
    )


@pytest.fixture
def flight(request: pytest.FixtureRequest) -> Flight:
    """One simulated vehicle and the program's `aerokit.Vehicle` on it, on virtual time."""
    from aerokit.testing.flights import Fleet

    kinds, options = _wanted(request)
    if len(kinds) != 1 or "count" in options:
        raise pytest.UsageError("`flight` is one vehicle: use the fixture `fleet` for several")
    found: Flight = Fleet(*kinds, **options)[0]
    return found


@pytest.fixture
def fleet(request: pytest.FixtureRequest) -> Fleet:
    """Simulated vehicles on one link, on virtual time; two copters unless the marker says otherwise."""
    from aerokit.testing.flights import Fleet, repeated

    kinds, options = _wanted(request)
    count = options.pop("count", 2 if len(kinds) == 1 else None)
    return Fleet(*repeated(kinds, count), **options)


@pytest.fixture
def served_flight(request: pytest.FixtureRequest) -> Iterator[ServedFlight]:
    """One simulated vehicle on a socket, ten times as fast as real time unless the marker says otherwise."""
    from aerokit.testing.served import hosted_flight

    kinds, options = _wanted(request)
    with hosted_flight(*kinds, **options) as served:
        yield served


@pytest.fixture
def blocking_vehicle(served_flight: ServedFlight) -> Iterator[aerokit.sync.Vehicle]:
    """An `aerokit.sync.Vehicle` that is connected to ``served_flight``."""
    from aerokit import sync

    with sync.connect(served_flight.address) as vehicle:
        yield vehicle


@pytest.fixture
def dronekit_address(served_flight: ServedFlight) -> str:
    """The address of ``served_flight``, for ``dronekit.connect``."""
    return served_flight.address


@pytest.fixture
def dronekit() -> Iterator[ModuleType]:
    """`aerokit.dronekit`; while the test runs, ``import dronekit`` means it, unless another was imported before."""
    import sys

    import aerokit.dronekit as package
    from aerokit.dronekit.runner import install, uninstall

    was_there = sys.modules.get("dronekit") is package
    install()
    yield package
    if not was_there:
        uninstall()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Open ``flight`` and ``fleet`` before pytest-asyncio takes the test, if that is what its marker says."""
    fleets = _fleets(item)
    if not fleets or item.get_closest_marker("asyncio") is None:
        return (yield)
    assert isinstance(item, pytest.Function)
    with _replaced(item, _only_on_virtual_time(_opened(item.obj, fleets))):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Open ``flight`` and ``fleet`` around an ``async def`` test; without an async plugin, run it as well.

    Let a test of a served vehicle fail at once when the vehicle does.
    """
    with _replaced(pyfuncitem, _as_it_runs(pyfuncitem)), _failing_at_once(pyfuncitem):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Say what was flown when a test has failed."""
    report = yield
    flown = _told(item) if report.when == "call" and report.failed else []
    if flown:
        from aerokit.testing.failure import what_was_flown

        directory = item.config.getoption(_PICTURES)
        report.sections.append(("what was flown", what_was_flown(flown, item.nodeid, directory)))
    return report


def _wanted(request: pytest.FixtureRequest) -> tuple[tuple[str, ...], dict[str, Any]]:
    marker = request.node.get_closest_marker(_MARKER)
    kinds, options = (marker.args, dict(marker.kwargs)) if marker else ((), {})
    options.setdefault("record", request.config.getoption(_PICTURES) is not None)
    return kinds or ("copter",), options


def _flown(item: pytest.Item) -> list[Any]:
    """The fixtures of a test that fly; a project may have others of these names."""
    funcargs = getattr(item, "funcargs", None) or {}
    found = [funcargs[name] for name in ("flight", "fleet", "served_flight") if name in funcargs]
    return [each for each in found if type(each).__module__.startswith("aerokit.testing.")]


def _told(item: pytest.Item) -> list[Any]:
    """The same, and what fixtures of the project's own have opened."""
    values = (getattr(item, "funcargs", None) or {}).values()
    others = [each for each in values if type(each).__module__.startswith("aerokit.testing.")]
    return list(
        {id(each): each for each in (*_flown(item), *others) if type(each).__name__ in _TOLD}.values()
    )


def _fleets(item: pytest.Item) -> list[Fleet]:
    return [getattr(each, "_fleet", each) for each in _flown(item) if hasattr(each, "run")]


def _as_it_runs(item: pytest.Function) -> Callable[..., Any]:
    fleets = _fleets(item)
    test: Callable[..., Any] = item.obj
    opened = getattr(test, _OPENED, None)
    if opened is not None:  # pytest-asyncio's, which runs it on a loop of its own
        return _on_virtual_time(opened, instead_of=None if inspect.iscoroutinefunction(test) else test)
    if not fleets or not inspect.iscoroutinefunction(test):
        return test
    opened = _opened(test, fleets)
    return opened if "anyio_backend" in item.fixturenames else _on_virtual_time(opened)


def _opened(test: Callable[..., Any], fleets: list[Fleet]) -> Callable[..., Any]:
    @functools.wraps(test)
    async def opened(**arguments: Any) -> None:
        from contextlib import AsyncExitStack

        async with AsyncExitStack() as stack:
            for fleet in fleets:
                await stack.enter_async_context(fleet.open())
            await test(**arguments)

    return opened


class _AnotherLoop(Exception):
    """This loop is not on virtual time."""


def _only_on_virtual_time(opened: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(opened)
    async def run(**arguments: Any) -> None:
        import asyncio

        from aerokit.testing.clock import VirtualClockLoop

        if not isinstance(asyncio.get_running_loop(), VirtualClockLoop):
            raise _AnotherLoop
        await opened(**arguments)

    setattr(run, _OPENED, opened)  # stays on what pytest-asyncio makes of it
    return run


def _on_virtual_time(
    test: Callable[..., Any], *, instead_of: Callable[..., Any] | None = None
) -> Callable[..., None]:
    @functools.wraps(test)
    def run(**arguments: Any) -> None:
        from aerokit.testing.clock import run_virtual

        if instead_of is not None:
            with contextlib.suppress(_AnotherLoop):
                instead_of(**arguments)
                return
        run_virtual(test(**arguments))

    return run


@contextlib.contextmanager
def _replaced(item: pytest.Function, test: Callable[..., Any]) -> Iterator[None]:
    before, item.obj = item.obj, test
    try:
        yield
    finally:
        item.obj = before


def _failing_at_once(item: pytest.Function) -> contextlib.AbstractContextManager[None]:
    served = [each for each in _flown(item) if hasattr(each, "failing_at_once")]
    return served[0].failing_at_once() if served else contextlib.nullcontext()
