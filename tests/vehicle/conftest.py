"""Flights for the tests of the vehicle layer: on a simulated copter, on virtual time."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
from flight_harness import Flight, in_the_air, open_flight


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
