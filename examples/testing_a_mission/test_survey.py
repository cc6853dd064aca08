"""Tests of survey.py on simulated vehicles. Run `pytest` in this folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio
import pytest
from survey import ALTITUDE_M, SIDE_M, BatteryTooLow, corners, hop_classic, survey, survey_blocking

from aerokit.mavlink.enums import MavCmd

if TYPE_CHECKING:
    from types import ModuleType

    from aerokit import sync
    from aerokit.testing import Flight, ServedFlight, SimulatedFleet, Track


def assert_surveyed(track: Track) -> None:
    for corner in corners(track.home):
        track.assert_passed(corner, within_m=3)
    track.assert_reached_altitude(ALTITUDE_M)
    track.assert_stayed_within(1.5 * SIDE_M)
    track.assert_landed_near(within_m=2)


async def test_survey_passes_all_corners(flight: Flight) -> None:
    await survey(flight.vehicle)
    assert_surveyed(flight.track)
    flight.track.assert_disarmed_at_end()


@pytest.mark.simulated("px4", seed=4)
def test_survey_on_px4_passes_all_corners(flight: Flight) -> None:
    flight.run(lambda flight: survey(flight.vehicle))  # for tests without async
    assert_surveyed(flight.track)


@pytest.mark.simulated(battery_percent=30)
async def test_low_battery_prevents_take_off(flight: Flight) -> None:
    with pytest.raises(BatteryTooLow, match="30 %"):
        await survey(flight.vehicle)
    flight.track.assert_stayed_below(0.1)


async def test_survey_succeeds_in_wind_with_bad_radio(flight: Flight) -> None:
    flight.faults.set_wind(east_m_s=6, gusts_m_s=1)
    flight.faults.drop_packets(0.1)  # the command to arm is sent once; if it is lost, arm() raises CommandTimeout
    flight.faults.go_silent(for_s=6, after_s=15)
    await survey(flight.vehicle)
    assert_surveyed(flight.track)


@pytest.mark.simulated("copter", count=2)
async def test_every_fleet_member_surveys(fleet: SimulatedFleet) -> None:
    async with anyio.create_task_group() as group:
        for flight in fleet:
            group.start_soon(survey, flight.vehicle)
    for flight in fleet:
        assert_surveyed(flight.track)
        flight.journal.assert_received_command(MavCmd.MISSION_START, times=1)


@pytest.mark.simulated("copter", speedup=30)
def test_blocking_survey_passes_all_corners(blocking_vehicle: sync.Vehicle, served_flight: ServedFlight) -> None:
    survey_blocking(blocking_vehicle)
    assert_surveyed(served_flight.track)


@pytest.mark.simulated("copter", speedup=30)
def test_classic_program_takes_off_and_lands(
    dronekit: ModuleType, dronekit_address: str, served_flight: ServedFlight
) -> None:
    hop_classic(dronekit_address)
    served_flight.track.assert_reached_altitude(ALTITUDE_M)
    served_flight.track.assert_modes("GUIDED", "LAND")
