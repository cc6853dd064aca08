"""Fixtures of the browser tests: Chromium, and two simulated copters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from anyio.from_thread import start_blocking_portal
from page_stage import CHROMIUM
from served_copter import served

import aerokit
from aerokit.missions import (
    Mission,
    return_to_launch,
    take_off,
    waypoint,
)
from aerokit.sim import SimulatedCopter
from aerokit.sim.motion import GlobalPoint, LocalFrame

HOME = (-35.363261, 149.165230, 584.0)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    quiet = [
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is installed by `nox -s browser`")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-quic", *quiet]
        )
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def copters() -> Iterator[tuple[list[SimulatedCopter], str]]:
    frame = LocalFrame(GlobalPoint(round(HOME[0] * 1e7), round(HOME[1] * 1e7), HOME[2]))
    made = []
    for number in (1, 2):
        place = frame.to_global(0.0, 25.0 * (number - 1), 0.0)
        made.append(
            SimulatedCopter(
                system_id=number,
                home=(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, HOME[2]),
                boot_time_s=0.0,
            )
        )
    with served(made, speedup=4.0) as address:
        with start_blocking_portal() as portal:  # this thread has playwright's loop
            portal.call(upload, address)
        yield made, address


async def upload(address: str) -> None:
    async with aerokit.connect(address, system_id=1) as vehicle:
        await vehicle.wait_ready()
        here = vehicle.position.value
        corners = [here.offset(north_m=n, east_m=e) for n, e in ((70, -20), (80, 60), (30, 95), (-15, 50))]
        items = [waypoint(at.latitude_deg, at.longitude_deg, altitude_relative_m=20) for at in corners]
        await vehicle.mission.upload(Mission([take_off(altitude_relative_m=20), *items, return_to_launch()]))
