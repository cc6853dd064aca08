"""The pytest plugin of `aerokit[testing]`: simulated vehicles as fixtures; docs/testing.md shows each.

- ``flight``, ``fleet``: on virtual time, for ``async def`` tests (with anyio's plugin or none) or ``flight.run(main)``
- ``served_flight``: on a socket, for blocking programs; ``blocking_vehicle`` is an `aerokit.sync.Vehicle` on it
- ``dronekit_address``, ``dronekit``: on a socket, and `aerokit.dronekit` under DroneKit's name
- ``@pytest.mark.simulated("plane", seed=3)``: which vehicle these fixtures simulate

A test that uses none of them is not touched, and nothing of aerokit is imported for it.
"""

from __future__ import annotations

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

__all__ = [
    "blocking_vehicle",
    "dronekit",
    "dronekit_address",
    "fleet",
    "flight",
    "pytest_configure",
    "pytest_pyfunc_call",
    "served_flight",
]

_MARKER = "simulated"


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
    from aerokit.testing.served import serve_flight

    kinds, options = _wanted(request)
    with serve_flight(*kinds, **options) as served:
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
    from aerokit.dronekit.alias import install, uninstall

    was_there = sys.modules.get("dronekit") is package
    install()
    yield package
    if not was_there:
        uninstall()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Open ``flight`` and ``fleet`` around an ``async def`` test; without an async plugin, run it as well."""
    fleets = _fleets(pyfuncitem)
    if not fleets or not inspect.iscoroutinefunction(pyfuncitem.obj):
        return (yield)
    test = pyfuncitem.obj
    opened = _opened(test, fleets)
    pyfuncitem.obj = opened if "anyio_backend" in pyfuncitem.fixturenames else _on_virtual_time(opened)
    try:
        return (yield)
    finally:
        pyfuncitem.obj = test


def _wanted(request: pytest.FixtureRequest) -> tuple[tuple[str, ...], dict[str, Any]]:
    marker = request.node.get_closest_marker(_MARKER)
    return (marker.args or ("copter",), dict(marker.kwargs)) if marker else (("copter",), {})


def _fleets(item: pytest.Function) -> list[Fleet]:
    found = [item.funcargs[name] for name in ("flight", "fleet") if name in item.funcargs]
    if not found:
        return []
    from aerokit.testing.flights import Fleet, Flight

    fleets = [each._fleet if isinstance(each, Flight) else each for each in found]
    return [each for each in fleets if isinstance(each, Fleet)]  # a project may have fixtures of these names


def _opened(test: Callable[..., Any], fleets: list[Fleet]) -> Callable[..., Any]:
    @functools.wraps(test)
    async def opened(**arguments: Any) -> None:
        from contextlib import AsyncExitStack

        async with AsyncExitStack() as stack:
            for fleet in fleets:
                await stack.enter_async_context(fleet.open())
            await test(**arguments)

    return opened


def _on_virtual_time(test: Callable[..., Any]) -> Callable[..., None]:
    @functools.wraps(test)
    def run(**arguments: Any) -> None:
        from aerokit.testing.clock import run_virtual

        run_virtual(test(**arguments))

    return run
