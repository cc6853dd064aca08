"""Calibrations for which the vehicle is turned by hand; origin and home set by a client."""

from __future__ import annotations

import math
from typing import Any

import pytest
from simulated_client import Client, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import AccelcalVehiclePos, MagCalStatus, MavCmd, MavDataStream, MavResult
from aerokit.sim.kinds import simulated

ACCEPTED, DENIED, FAILED = MavResult.ACCEPTED, MavResult.DENIED, MavResult.FAILED
LEVEL_TEXT = "Place vehicle level and press any key."


def streaming_copter() -> tuple[Any, Client]:
    copter, client = ready_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA3, 10, 1))
    return copter, client


def test_compass_calibration_reports_progress() -> None:
    _, client = streaming_copter()
    assert client.command(MavCmd.DO_START_MAG_CAL, 0, 1, 0) == ACCEPTED
    assert client.command(MavCmd.DO_ACCEPT_MAG_CAL, 0) == FAILED
    client.run(16.0)
    reports = client.all(m.MagCalProgress)
    assert {progress.compass_id for progress in reports} == {0, 1, 2}
    percents = [progress.completion_pct for progress in reports]
    assert percents == sorted(percents)
    assert percents[-1] == pytest.approx(50, abs=2)
    assert reports[-1].cal_mask == 7
    assert not client.all(m.MagCalReport)
    client.run(20.0)
    assert {report.cal_status for report in client.all(m.MagCalReport)} == {MagCalStatus.SUCCESS}
    assert client.command(MavCmd.DO_ACCEPT_MAG_CAL, 0) == ACCEPTED
    client.clear()
    client.run(2.0)
    assert not client.all(m.MagCalReport)


def test_calibration_of_missing_compass_fails() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.DO_START_MAG_CAL, 8) == FAILED
    assert client.command(MavCmd.DO_START_MAG_CAL, 9) == ACCEPTED
    assert copter.calibrations.compasses.is_running


def test_compass_calibration_without_rotation_makes_no_progress() -> None:
    copter, client = streaming_copter()
    copter.calibrations.compasses.turning_time_s = math.inf
    client.command(MavCmd.DO_START_MAG_CAL, 2)
    client.run(60.0)
    assert {(report.compass_id, report.completion_pct) for report in client.all(m.MagCalProgress)} == {(1, 0)}
    assert client.command(MavCmd.DO_CANCEL_MAG_CAL, 0) == ACCEPTED
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == ACCEPTED


def requested_positions(client: Client) -> list[float]:
    return [order.param1 for order in client.all(m.CommandLong) if order.command == MavCmd.ACCELCAL_VEHICLE_POS]


def test_accelerometer_calibration_requests_six_positions() -> None:
    _, client = ready_copter()
    client.command(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 1)
    client.run(2.1)
    assert client.texts == ["Initialising ArduPilot", LEVEL_TEXT]
    assert requested_positions(client) == [1.0, 1.0]
    assert client.command(MavCmd.ACCELCAL_VEHICLE_POS, 2) == FAILED
    for position in range(1, 7):
        assert requested_positions(client)[-1] == position
        assert client.command(MavCmd.ACCELCAL_VEHICLE_POS, position) == ACCEPTED
        client.run(1.5)
    assert client.texts[-1] == "Calibration successful"
    assert requested_positions(client)[-1] == AccelcalVehiclePos.SUCCESS


def test_accelerometer_calibration_with_wrong_positions_fails() -> None:
    copter, client = ready_copter()
    copter.calibrations.accelerometers.is_held_wrong = True
    client.command(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 1)
    client.run(1.0)
    for position in (1, 2):
        assert client.command(MavCmd.ACCELCAL_VEHICLE_POS, position) == ACCEPTED
        client.run(2.0)
    assert client.texts[-1] == "Calibration FAILED"
    assert requested_positions(client)[-1] == AccelcalVehiclePos.FAILED
    assert client.command(MavCmd.ACCELCAL_VEHICLE_POS, 3) == FAILED


# ------------------------------------------------------------------------------- origin and home


def booting(kind: str) -> tuple[Any, Client]:
    """Ready, without GPS yet."""
    vehicle: Any = simulated(kind, boot_time_s=41.5)
    client = Client(vehicle)
    client.run_until(lambda: vehicle.is_initialised)
    client.run(0.5)
    client.clear()
    return vehicle, client


def origin_at(vehicle: Any, metres_up: float) -> m.SetGpsGlobalOrigin:
    place = vehicle.frame.origin
    height = round((place.altitude_m + metres_up) * 1000)
    return m.SetGpsGlobalOrigin(vehicle.system_id, place.latitude_e7 + 1000, place.longitude_e7, height)


@pytest.mark.parametrize("kind", ["copter", "plane", "rover", "sub"])
def test_origin_can_be_set_once_before_gps(kind: str) -> None:
    vehicle, client = booting(kind)
    client.send(origin_at(vehicle, 12.0))
    client.run(0.2)
    (origin,) = client.all(m.GpsGlobalOrigin)
    assert origin.latitude == vehicle.frame.origin.latitude_e7 + 1000
    assert "EKF3 IMU0 origin set" in client.texts
    client.send(origin_at(vehicle, 30.0))
    client.run(0.2)
    assert len(client.all(m.GpsGlobalOrigin)) == 1
    client.run(40.0)
    assert client.texts.count("EKF3 IMU0 origin set") == 1
    assert client.last(m.GpsGlobalOrigin).altitude == origin.altitude
    assert client.last(m.HomePosition).latitude == pytest.approx(vehicle.frame.origin.latitude_e7, abs=50)


@pytest.mark.parametrize(
    ("kind", "result"), [("copter", FAILED), ("plane", ACCEPTED), ("rover", ACCEPTED), ("sub", FAILED)]
)
def test_home_before_origin_is_accepted_by_some_kinds(kind: str, result: int) -> None:
    _, client = booting(kind)
    assert client.command(MavCmd.GET_HOME_POSITION) == FAILED
    assert client.command(MavCmd.DO_SET_HOME, 1) == FAILED
    assert client.command(MavCmd.DO_SET_HOME, 0, 0, 0, 0, 47.4, 8.5, 500) == result
    client.run(0.2)
    homes = [(home.latitude, home.longitude, home.altitude) for home in client.all(m.HomePosition)]
    expected = [pytest.approx((474_000_000, 85_000_000, 500_000), abs=20)]  # COMMAND_LONG has 32-bit floats.
    assert homes == (expected if result == ACCEPTED else [])
    texts = [text for text in client.texts if text.startswith("Set HOME to 47.4000")]
    assert bool(texts) == (kind == "rover")


def test_home_at_invalid_place_is_refused() -> None:
    _, client = ready_copter()
    home = MavCmd.DO_SET_HOME
    assert client.command(home, 1) == ACCEPTED
    assert client.command_int(home, 3, 0, x=474_000_000, y=85_000_000, z=10.0) == ACCEPTED
    assert client.command_int(home, 1, 0, x=474_000_000, y=85_000_000, z=10.0) == DENIED
    assert client.command_int(home, 0, 0, x=2_000_000_000, y=85_000_000, z=10.0) == FAILED
    assert client.command(home, 2, 0, 0, 0, 47, 8, 0) == FAILED
    client.run(0.1)
    assert "Unknown mavlink coordinate frame 1" in client.texts


def test_battery_reset_sets_remaining_charge() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.BATTERY_RESET, 1, 60) == ACCEPTED
    client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID)
    client.run(0.1)
    assert client.last(m.SysStatus).battery_remaining == 60
