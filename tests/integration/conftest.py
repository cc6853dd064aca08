"""Real time and real sockets, on stock asyncio and on uvloop; options that say which vehicle the flights fly."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

LOOPS = [
    pytest.param(("asyncio", {}), id="asyncio"),
    pytest.param(
        ("asyncio", {"use_uvloop": True}),
        id="uvloop",
        marks=pytest.mark.skipif(
            importlib.util.find_spec("uvloop") is None, reason="uvloop is not installed"
        ),
    ),
]


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("aerokit", "which vehicle tests/integration/test_any_vehicle.py flies")
    group.addoption(
        "--vehicle", default="sim", help="sim, an address, or the path of an arducopter or px4 binary"
    )
    group.addoption(
        "--vehicle-kind", default="copter", choices=("copter", "px4"), help="which firmware it is"
    )
    group.addoption("--vehicle-speedup", type=float, default=None, help="of sim (10) and of a binary (5)")
    group.addoption("--i-know-it-flies", action="store_true", help="needed for an address: motors will turn")


@pytest.fixture(params=LOOPS)
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param
