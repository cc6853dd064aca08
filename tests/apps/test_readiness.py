"""Reasons against arming and flight: one order and one grouping for page, monitor and `aerokit status`."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import open_flight, open_px4

from aerokit.apps.monitor.lines import VehicleText
from aerokit.apps.readiness import not_armable, readiness, run_arming_checks
from aerokit.sim import SimulatedPx4

pytestmark = pytest.mark.anyio

POSITION = "position (GLOBAL_POSITION_INT with a fix not received)"


async def test_px4_without_gps_groups_reasons_like_status() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0)
    px4.faults.gps_lost = True
    async with open_px4(px4) as flight:
        vehicle = flight.vehicle
        await anyio.sleep(15)
        await run_arming_checks(vehicle)
        found, asked = readiness(vehicle), readiness(vehicle, await vehicle.why_not_armable())
        without_prefix = tuple(vehicle.autopilot.arming_reason(text) or text for text in asked.against_arming)
        assert found.against_arming == without_prefix == tuple(not_armable(vehicle, vehicle.missing_for_flight()))
        assert found.against_flight == asked.against_flight
        assert POSITION in found.against_flight
        ranks = ["(" in text for text in found.against_arming]
        assert ranks == sorted(ranks), "the vehicle's own texts are first"
        assert not ranks[0]
        shown = VehicleText(vehicle).all_missing().split("\n")
        assert shown[0] == f"cannot arm: {found.against_arming[0]}"
        assert any(line.startswith("also missing for flight: ") for line in shown)


async def test_copter_without_gps_lists_fix_before_estimates() -> None:
    async with open_flight() as flight:
        flight.copter.faults.gps_lost = True
        await flight.vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is True)
        await anyio.sleep(20)
        found = readiness(flight.vehicle)
        assert found.against_arming == ()
        assert found.against_flight[0] == "no GPS receiver has a 3D fix (GPS_RAW_INT)"
        assert found.against_flight[1].startswith("the estimator has no ")


async def test_position_is_no_reason_against_arming_with_failing_check() -> None:
    async with open_flight() as flight:
        flight.copter.faults.gps_lost = True
        flight.copter.faults.prearm_failures = ["Compass not healthy"]
        await anyio.sleep(20)
        await run_arming_checks(flight.vehicle)
        assert flight.vehicle.mode_name == "STABILIZE"
        found = readiness(flight.vehicle)
        assert found.against_arming == ("Compass not healthy", "GPS is not healthy (SYS_STATUS)")
        assert found.against_flight[0] == "no GPS receiver has a 3D fix (GPS_RAW_INT)"
