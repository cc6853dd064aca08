"""vehicle.rally: upload, download, clear."""

from __future__ import annotations

from typing import Any

import pytest
from flight_harness import open_flight, open_px4
from plan_flights import near_home

from aerokit.missions import RallyPoints
from aerokit.missions.navigation import rally_point

pytestmark = pytest.mark.anyio

POINTS = RallyPoints([rally_point(*near_home(north, 10), altitude_relative_m=30) for north in (10, 20, 30)])


@pytest.mark.parametrize("opened", [open_flight, open_px4])
@pytest.mark.parametrize("method", ["auto", "items"])
async def test_upload_download_round_trip(opened: Any, method: Any) -> None:
    async with opened() as flight:
        rally = flight.vehicle.rally
        await rally.upload(POINTS, method=method)
        assert POINTS.matches(await rally.download(method=method))
        await rally.upload(RallyPoints(POINTS[:1]), method=method)
        assert len(await rally.download(method=method)) == 1
        await rally.clear()
        assert len(await rally.download(method=method)) == 0
