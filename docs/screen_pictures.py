"""Takes pictures of the monitor, the served page and a report, of simulated flights; see pictures.py.

The served page and the report need playwright and Chromium (AEROKIT_CHROMIUM, or on the path).
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import anyio

import aerokit
from aerokit import Vehicle
from aerokit.apps.monitor.app import Monitor
from aerokit.apps.monitor.model import MonitorModel
from aerokit.connection.opening import open_connection
from aerokit.connection.tasks import BackgroundTasks
from aerokit.logs.report import write_report
from aerokit.missions import (
    Fence,
    FenceCircle,
    FencePolygon,
    Mission,
    RallyPoints,
    rally_point,
    return_to_launch,
    take_off,
    waypoint,
)
from aerokit.sim import HOME, SimulatedCopter, simulated_link
from aerokit.testing import open_flight, run_virtual
from aerokit.vehicle.connect import vehicles_on

ADDRESS = "127.0.0.1:14588"


def take_monitor(target: Path, wide: Path) -> None:
    """Save the monitor with three copters, two of them in the air, in a small and in a wide terminal."""
    for path, columns, rows in ((target, 100, 28), (wide, 200, 50)):
        path.write_text(run_virtual(_fly_and_draw_monitor(columns, rows)), encoding="utf-8")


async def _fly_and_draw_monitor(columns: int, rows: int) -> str:
    latitude_deg, longitude_deg, altitude_m = HOME
    copters = [
        SimulatedCopter(
            system_id=number, boot_time_s=0.0, home=(latitude_deg, longitude_deg + 4e-4 * number, altitude_m)
        )
        for number in (1, 2, 3)
    ]
    async with (
        simulated_link(copters) as link,
        open_connection(link) as connection,
        vehicles_on(connection) as vehicles,
    ):
        model, commands = MonitorModel(connection, vehicles), BackgroundTasks(connection.fail)
        app = Monitor(model, commands, "udpin:0.0.0.0:14550")
        async with app.run_test(size=(columns, rows)) as pilot:
            await anyio.sleep(2)
            flying = [vehicle for vehicle in model.vehicles.values() if vehicle.system_id < 3]
            async with anyio.create_task_group() as group:
                for vehicle, side_m in zip(flying, (30.0, 45.0), strict=True):
                    group.start_soon(_fly_three_sides, vehicle, side_m)
            app.update_view()
            await pilot.pause()
            picture = app.export_screenshot(title="aerokit monitor")
        model.close()
        await commands.aclose()
    return picture


async def _fly_three_sides(vehicle: Vehicle, side_m: float) -> None:
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(15)
    for north_m, east_m in ((side_m, 0), (0, -side_m), (-side_m / 2, 0)):
        await vehicle.go_to(vehicle.position.value.offset(north_m=north_m, east_m=east_m))


def take_report(target: Path, screen: Path, phone: Path) -> None:
    """Save the report of a flight that ends with a radio failsafe: its beginning, one screen of it, and on a phone."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "survey.tlog"
        run_virtual(_fly_with_failsafe(log))
        report = write_report(log, Path(folder) / "survey.html")
        with _browser() as browser:
            for path, width, height in ((target, 1000, 1180), (screen, 1440, 900), (phone, 390, 844)):
                page = browser.new_page(viewport={"width": width, "height": height})
                page.goto(f"file://{report.target}")
                page.wait_for_selector(".plotly .main-svg")
                page.screenshot(path=str(path))


async def _fly_with_failsafe(log: Path) -> None:
    async with (
        open_flight("copter", connect=False, seed=1) as flight,
        aerokit.connect(flight.link, record=log) as vehicle,
    ):
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(20)
        for north_m, east_m in ((60, 0), (0, 70), (-60, 0)):
            await vehicle.go_to(vehicle.position.value.offset(north_m=north_m, east_m=east_m), speed_m_s=8)
        flight.faults.lose_rc()
        await vehicle.armed.wait_until(lambda armed: not armed, timeout=300, description="landing")


def take_page(target: Path, flying: Path, phone: Path) -> None:
    """Save the page of `aerokit serve` during a mission, wide and on a phone."""
    sim = ("sim", f"udpout:{ADDRESS}", "--count", "2", "--spacing", "25", "--boot-time", "0", "--speedup", "4")
    with _running(*sim):
        anyio.run(_upload)
        with _running("serve", f"udpin:{ADDRESS}", "--port", "0", "--json") as server, _browser() as browser:
            assert server.stdout is not None
            page = browser.new_page(viewport={"width": 1360, "height": 820}, color_scheme="dark")
            page.goto(json.loads(server.stdout.readline())["page"])
            for order, done in (("arm", "arm"), ("take_off", "take off"), ("mission/start", "mission start")):
                page.click(f"button[data-order='{order}']")
                page.click("dialog .yes")
                page.locator(".toast.done", has_text=done).first.wait_for(timeout=60_000)
            page.get_by_role("tab", name="Mission").click()
            page.locator("tr.current", has_text="3").wait_for(timeout=90_000)
            page.locator(".toast").first.wait_for(state="hidden", timeout=60_000)
            page.screenshot(path=str(target))
            page.get_by_role("tab", name="State").click()
            page.set_viewport_size({"width": 1440, "height": 900})
            page.screenshot(path=str(flying))
            page.set_viewport_size({"width": 390, "height": 844})
            page.wait_for_timeout(500)
            page.screenshot(path=str(phone))


async def _upload() -> None:
    async with aerokit.connect(f"udpin:{ADDRESS}", system_id=1) as vehicle:
        await vehicle.wait_ready()
        here = vehicle.home.value.position
        corners = [here.offset(north_m=n, east_m=e) for n, e in ((70, -20), (80, 60), (30, 95), (-15, 50))]
        items = [waypoint(corner, altitude_relative_m=20) for corner in corners]
        await vehicle.mission.upload(Mission([take_off(20), *items, return_to_launch()]))
        outline = [here.offset(north_m=n, east_m=e) for n, e in ((-45, -45), (-45, 120), (95, 120), (95, -45))]
        tree = FenceCircle(here.offset(north_m=40, east_m=35), 12, inclusion=False)
        await vehicle.fence.upload(Fence([FencePolygon(outline)], [tree]))
        await vehicle.rally.upload(
            RallyPoints([rally_point(here.offset(north_m=-20, east_m=-25), altitude_relative_m=15)])
        )


@contextlib.contextmanager
def _running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "aerokit", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextlib.contextmanager
def _browser() -> Iterator[Any]:
    sync_playwright = import_module("playwright.sync_api").sync_playwright  # only `nox -s pictures` installs it
    chromium = os.environ.get("AEROKIT_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()
