"""A publisher that raises must not cost anybody the link to a vehicle in the air."""

from __future__ import annotations

import asyncio
import logging

import pytest

import aerokit
from aerokit.apps.network import Publisher, publishing
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import run_virtual


class Broken(Publisher):
    """A client of some network that has gone."""

    def __init__(self) -> None:
        self.puts = 0

    def put(self, name: str, data: bytes) -> None:
        self.puts += 1
        raise ConnectionError("the broker has gone")


def test_a_publisher_that_raises_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        broken = Broken()
        async with (
            simulated_link(SimulatedCopter(boot_time_s=0.0)) as link,
            aerokit.connect(link) as vehicle,
            publishing(vehicle, broken) as under_way,
        ):
            await asyncio.sleep(3)
            vehicle.connection.raise_if_ended()
            assert broken.puts > 10
            assert under_way.published == 0

    with caplog.at_level(logging.ERROR, "aerokit"):
        run_virtual(run())
    assert len([each for each in caplog.records if "publisher" in each.getMessage()]) == 1
