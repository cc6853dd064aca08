"""Reasons against arming and flight: one order and one grouping for page, monitor and `aerokit status`."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import in_the_air, open_flight, open_px4

from aerokit.apps.cli.status import _vehicle_lines
from aerokit.apps.monitor.lines import VehicleText
from aerokit.apps.readiness import active_failsafe, arm_refusals, readiness, run_arming_checks
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavSeverity, MavState
from aerokit.sim import SimulatedCopter, SimulatedPx4

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
        assert found.against_arming == without_prefix == tuple(arm_refusals(vehicle, vehicle.missing_for_flight()))
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


async def test_copter_in_rtl_is_armed_in_other_mode() -> None:
    async with open_flight() as flight:
        vehicle = flight.vehicle
        await vehicle.wait_ready()
        assert VehicleText(vehicle).all_missing() == "Nothing is missing."
        await vehicle.set_mode("RTL")
        text = "ArduCopter cannot arm in RTL (Vehicle.arm changes the mode to GUIDED)"
        assert readiness(vehicle).against_arming == (text,)
        assert VehicleText(vehicle).list_row(is_selected=True, more=True).plain.endswith(f"cannot arm: {text} ")
        assert (
            readiness(vehicle, await vehicle.why_not_armable())
            .against_arming[0]
            .startswith("ArduCopter cannot arm in RTL")
        )
        assert readiness(vehicle, changes_mode=True).against_arming == ()


async def test_radio_failsafe_is_named_until_it_ends() -> None:
    async with in_the_air() as flight:
        vehicle, system_status = flight.vehicle, flight.vehicle.system_status
        assert active_failsafe(vehicle) is None
        flight.copter.faults.rc_lost = True
        await system_status.wait_until(lambda state: state == MavState.CRITICAL)
        assert active_failsafe(vehicle) == ["Radio Failsafe"]
        assert ("failsafe", "failsafe: Radio Failsafe") in [
            (label, text.plain) for label, text in VehicleText(vehicle).rows()
        ]
        assert VehicleText(vehicle).list_row(is_selected=True, more=True).plain.endswith("failsafe: Radio Failsafe ")
        assert "  failsafe Radio Failsafe" in _vehicle_lines(vehicle, readiness(vehicle))
        for number in range(100):
            flight.copter.send_text(MavSeverity.INFO, f"SmartRTL point {number}")
        await vehicle.status_text.wait_until(lambda text: text.text == "SmartRTL point 99")
        assert active_failsafe(vehicle) == ["Radio Failsafe"]
        flight.copter.faults.rc_lost = False
        await system_status.wait_until(lambda state: state == MavState.ACTIVE)
        assert active_failsafe(vehicle) is None
        assert dict(VehicleText(vehicle).rows())["missing"].plain == "nothing"
        await anyio.sleep(3)
        flight.copter.faults.lose(m.Statustext, times=1000)
        flight.copter.faults.rc_lost = True
        await system_status.wait_until(lambda state: state == MavState.CRITICAL)
        assert active_failsafe(vehicle) == ["no text about its cause was received"]


async def test_battery_and_estimator_failsafes_show_newest_texts() -> None:
    limits = {"BATT_LOW_MAH": 500.0, "BATT_FS_LOW_ACT": 2.0}
    copter = SimulatedCopter(boot_time_s=0.0, battery_percent=16.0, parameters=limits)
    async with in_the_air(copter=copter) as flight:
        await flight.vehicle.system_status.wait_until(lambda state: state == MavState.CRITICAL)
        battery, failsafe = active_failsafe(flight.vehicle) or []
        assert battery.startswith("Battery 1 is low ")
        assert failsafe == "Battery Failsafe"
        await anyio.sleep(15)
        copter.faults.gps_lost = True
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "LAND")
        await anyio.sleep(2)
        assert active_failsafe(flight.vehicle) == ["EKF variance", "EKF Failsafe: changed to LAND Mode"]


async def test_px4_battery_failsafe_is_named_only_while_armed() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0, parameters={"COM_LOW_BAT_ACT": 3.0})
    async with open_px4(px4) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await flight.vehicle.take_off(10)
        px4.battery.percent = 5.0
        await flight.vehicle.system_status.wait_until(lambda state: state == MavState.CRITICAL)
        assert (active_failsafe(flight.vehicle) or [""])[0] == "Emergency battery level"
        await flight.vehicle.armed.wait_until(lambda is_armed: not is_armed)
        assert active_failsafe(flight.vehicle) is None
