"""Real time and real sockets, on stock asyncio and on uvloop; options that select the vehicle."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest
from any_vehicle import Choice
from exhaustive import exhaustive
from vehicle_kinds import KINDS

DEFAULT_KINDS = ("copter", "px4")
"""The other simulated ones are exhaustive, unless one of them is asked for."""
LOOPS = [
    pytest.param(("asyncio", {}), id="asyncio"),
    pytest.param(
        ("asyncio", {"use_uvloop": True}),
        id="uvloop",
        marks=[
            pytest.mark.exhaustive,  # tests/links has every kind of link on uvloop
            pytest.mark.skipif(importlib.util.find_spec("uvloop") is None, reason="uvloop is not installed"),
        ],
    ),
]


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("aerokit", "which vehicle tests/integration/test_any_*.py try and fly")
    group.addoption(
        "--vehicle",
        default="sim",
        help="sim, an address, or the path of an arducopter, arduplane, ardurover, ardusub or px4 binary",
    )
    group.addoption(
        "--vehicle-kind", choices=KINDS, help="which firmware; without it, all of sim, copter at an address"
    )
    group.addoption(
        "--vehicle-speedup",
        type=float,
        help="of a binary (5); sim is then served on UDP, not in virtual time",
    )
    group.addoption("--i-know-it-flies", action="store_true", help="needed for an address: motors will turn")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "choice" in metafunc.fixturenames:
        choices = Choice.from_options(metafunc.config)
        rows = [pytest.param(choice, id=choice.kind.name) for choice in choices]
        few = len(rows) == 1
        metafunc.parametrize("choice", [row if few or row.id in DEFAULT_KINDS else exhaustive(row) for row in rows])


@pytest.fixture(params=LOOPS)
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param
