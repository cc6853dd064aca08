"""The pytest plugin of `aerokit-mavlink[testing]`: simulated vehicles as fixtures, see docs/testing.md.

- ``flight``, ``fleet``: on virtual time, for ``async def`` tests (with or without anyio's plugin) or
  ``flight.run(main)``
- ``served_flight``: on a socket, for blocking programs; ``blocking_vehicle`` is an `aerokit.sync.Vehicle` on it
- ``dronekit_address``, ``dronekit``: on a socket, and `aerokit.dronekit` under DroneKit's name
- ``@pytest.mark.simulated("plane", seed=3)``: selects the simulated vehicle

Tests that use none of these are not affected, and do not import aerokit.
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
    from aerokit.testing.flights import Flight, SimulatedFleet
    from aerokit.testing.served import ServedFlight

_MARKER = "simulated"
_PICTURES_OPTION = "--flight-pictures"
# Name of an attribute of test functions that pytest-asyncio runs. Its value is a function that opens the flights and
# calls the test.
_TEST_WITH_OPEN_FLIGHTS = "_aerokit_test_with_open_flights"
# The plugin compares names instead of classes, because tests without flights must not import aerokit.
_REPORTED_CLASSES = ("SimulatedFleet", "Flight", "ServedFlight")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("aerokit").addoption(
        _PICTURES_OPTION,
        metavar="DIR",
        help="for each failed test, write a picture of its flights (.svg), their recordings (.tlog) and reports (.html)"
        " to this directory",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Exclude aerokit from assertion rewriting."""
    # pytest rewrites all modules of a package with a plugin. This is slow, and two threads that import at once can fail
    # in Python 3.10 to 3.12.
    rewriting = getattr(early_config.pluginmanager, "rewrite_hook", None)
    marked = getattr(rewriting, "_must_rewrite", None)  # pytest has no public API to exclude a package.
    if rewriting is not None and isinstance(marked, set):
        marked -= {name for name in marked if name.partition(".")[0] == "aerokit"}
        rewriting.mark_rewrite()  # This call clears pytest's cache of the modules to rewrite.


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        f"{_MARKER}(*kinds, count=None, connect=True, speedup=10, **options): the vehicle of aerokit's fixtures,"
        ' such as "copter" or "px4", with the options of its class',
    )


@pytest.fixture
def flight(request: pytest.FixtureRequest) -> Flight:
    """A simulated vehicle and an `aerokit.Vehicle` connected to it, on virtual time."""
    from aerokit.testing.flights import SimulatedFleet

    kinds, options = _requested(request)
    if len(kinds) != 1 or "count" in options:
        raise pytest.UsageError("the fixture `flight` has one vehicle; use the fixture `fleet` for several vehicles")
    return SimulatedFleet(*kinds, **options)[0]


@pytest.fixture
def fleet(request: pytest.FixtureRequest) -> SimulatedFleet:
    """Simulated vehicles on one link, on virtual time. By default, these are two copters."""
    from aerokit.testing.flights import SimulatedFleet, expand_kinds

    kinds, options = _requested(request)
    count = options.pop("count", 2 if len(kinds) == 1 else None)
    return SimulatedFleet(*expand_kinds(kinds, count), **options)


@pytest.fixture
def served_flight(request: pytest.FixtureRequest) -> Iterator[ServedFlight]:
    """A simulated vehicle on a socket, at ten times real time by default."""
    from aerokit.testing.served import hosted_flight

    kinds, options = _requested(request)
    with hosted_flight(*kinds, **options) as served:
        yield served


@pytest.fixture
def blocking_vehicle(served_flight: ServedFlight) -> Iterator[aerokit.sync.Vehicle]:
    """An `aerokit.sync.Vehicle` connected to ``served_flight``."""
    from aerokit import sync

    with sync.connect(served_flight.address) as vehicle:
        yield vehicle


@pytest.fixture
def dronekit_address(served_flight: ServedFlight) -> str:
    """Address of ``served_flight``, for ``dronekit.connect``."""
    return served_flight.address


@pytest.fixture
def dronekit() -> Iterator[ModuleType]:
    """The module `aerokit.dronekit`, which ``import dronekit`` also returns during the test.

    Raises ImportError if DroneKit itself was imported before.
    """
    import sys

    import aerokit.dronekit as package
    from aerokit.dronekit.runner import install, uninstall

    was_installed = sys.modules.get("dronekit") is package
    install()
    yield package
    if not was_installed:
        uninstall()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Open ``flight`` and ``fleet`` before pytest-asyncio runs the test."""
    fleets = _fleets(item)
    if not fleets or item.get_closest_marker("asyncio") is None:
        return (yield)
    assert isinstance(item, pytest.Function)
    with _function_replaced(item, _only_on_virtual_time(_with_open_flights(item.obj, fleets))):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Open the fixtures ``flight`` and ``fleet`` around an ``async def`` test. Run the test if no async plugin does."""
    # A test with `served_flight` fails as soon as the simulated vehicle raises an exception.
    with _function_replaced(pyfuncitem, _runnable_function(pyfuncitem)), _raising_vehicle_errors(pyfuncitem):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    flights = _reported_flights(item) if report.when == "call" and report.failed else []
    if flights:
        from aerokit.testing.failure import failure_report

        directory = item.config.getoption(_PICTURES_OPTION)
        report.sections.append(("simulated flights", failure_report(flights, item.nodeid, directory)))
    return report


def _requested(request: pytest.FixtureRequest) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the kinds and options of the test's marker ``simulated``. The default is a copter."""
    marker = request.node.get_closest_marker(_MARKER)
    options = {} if marker is None else dict(marker.kwargs)
    options.setdefault("record", request.config.getoption(_PICTURES_OPTION) is not None)
    kinds = () if marker is None else marker.args
    return kinds or ("copter",), options


def _flight_fixtures(item: pytest.Item) -> list[Any]:
    fixture_values = getattr(item, "funcargs", None) or {}
    named = [fixture_values[name] for name in ("flight", "fleet", "served_flight") if name in fixture_values]
    return [value for value in named if _is_of_this_package(value)]


def _reported_flights(item: pytest.Item) -> list[Any]:
    """Return the flights and fleets among the fixture values of a test, those of this plugin first."""
    fixture_values = getattr(item, "funcargs", None) or {}
    flights: list[Any] = []
    for value in (*_flight_fixtures(item), *fixture_values.values()):
        is_flight = _is_of_this_package(value) and type(value).__name__ in _REPORTED_CLASSES
        if is_flight and not any(value is flight for flight in flights):
            flights.append(value)
    return flights


def _is_of_this_package(value: object) -> bool:
    return type(value).__module__.startswith("aerokit.testing.")


def _fleets(item: pytest.Item) -> list[SimulatedFleet]:
    """Return the fleets of a test that the plugin has to open."""
    # A `ServedFlight` has no `run`, because it is already open.
    return [getattr(value, "_fleet", value) for value in _flight_fixtures(item) if hasattr(value, "run")]


def _runnable_function(item: pytest.Function) -> Callable[..., Any]:
    """Return the function that pytest must call to run the test."""
    fleets = _fleets(item)
    test: Callable[..., Any] = item.obj
    marked_test = getattr(test, _TEST_WITH_OPEN_FLIGHTS, None)
    if marked_test is not None:  # The test has the asyncio marker.
        # A plain function is a wrapper by pytest-asyncio, which runs the test on pytest-asyncio's own loop.
        wrapped_by_pytest_asyncio = None if inspect.iscoroutinefunction(test) else test
        return _on_virtual_time(marked_test, try_first=wrapped_by_pytest_asyncio)
    if not fleets or not inspect.iscoroutinefunction(test):
        return test
    test_with_open_flights = _with_open_flights(test, fleets)
    # A test that uses the fixture `anyio_backend` is run by anyio's plugin.
    is_run_by_anyio = "anyio_backend" in item.fixturenames
    return test_with_open_flights if is_run_by_anyio else _on_virtual_time(test_with_open_flights)


def _with_open_flights(test: Callable[..., Any], fleets: list[SimulatedFleet]) -> Callable[..., Any]:
    @functools.wraps(test)
    async def run_with_open_flights(**arguments: Any) -> None:
        async with contextlib.AsyncExitStack() as stack:
            for fleet in fleets:
                await stack.enter_async_context(fleet.open())
            await test(**arguments)

    return run_with_open_flights


class _NotVirtualTime(Exception):
    """Raised if the running loop is not on virtual time."""


def _only_on_virtual_time(test_with_open_flights: Callable[..., Any]) -> Callable[..., Any]:
    """Return a test that raises `_NotVirtualTime` if pytest-asyncio's loop runs in real time."""

    @functools.wraps(test_with_open_flights)
    async def run(**arguments: Any) -> None:
        import asyncio

        from aerokit.testing.clock import VirtualClockLoop

        if not isinstance(asyncio.get_running_loop(), VirtualClockLoop):
            raise _NotVirtualTime
        await test_with_open_flights(**arguments)

    # pytest-asyncio copies this attribute to the function that wraps `run`. `_runnable_function` reads it there.
    setattr(run, _TEST_WITH_OPEN_FLIGHTS, test_with_open_flights)
    return run


def _on_virtual_time(test: Callable[..., Any], *, try_first: Callable[..., Any] | None = None) -> Callable[..., None]:
    """Return a function that runs an ``async def`` test on virtual time.

    If ``try_first`` is given, the function calls it, and runs ``test`` only if it raises `_NotVirtualTime`.
    """

    @functools.wraps(test)
    def run(**arguments: Any) -> None:
        from aerokit.testing.clock import run_virtual

        if try_first is not None:
            with contextlib.suppress(_NotVirtualTime):
                try_first(**arguments)
                return
        run_virtual(test(**arguments))

    return run


@contextlib.contextmanager
def _function_replaced(item: pytest.Function, test: Callable[..., Any]) -> Iterator[None]:
    original = item.obj
    item.obj = test
    try:
        yield
    finally:
        item.obj = original


def _raising_vehicle_errors(item: pytest.Function) -> contextlib.AbstractContextManager[None]:
    served = [value for value in _flight_fixtures(item) if hasattr(value, "raising_vehicle_errors")]
    return served[0].raising_vehicle_errors() if served else contextlib.nullcontext()
