"""Inertial sensors, pressures, odometry, ground truth, traffic, winch: units, unknown values, rates while watched."""

from __future__ import annotations

import math
from typing import Any

import anyio
import pytest
from flight_harness import Flight, open_flight, open_px4

from aerokit import messages as m
from aerokit.autopilots import autopilot_for
from aerokit.errors import OperationTimeout
from aerokit.mavlink.enums import AdsbFlags, MavCmd
from aerokit.vehicle.state.telemetry import Telemetry

pytestmark = pytest.mark.anyio

NAN = math.nan


def telemetry_of(autopilot: int) -> Telemetry:
    return Telemetry(lambda: 0.0, autopilot=autopilot_for(m.Heartbeat(2, autopilot, 81, 0, 4, 3)))


ARDUPILOT, PX4 = 3, 12


@pytest.mark.parametrize(("autopilot", "reported"), [(PX4, 0.25), (ARDUPILOT, 250_000.0)])
def test_imu_field_is_in_microtesla_on_both(autopilot: int, reported: float) -> None:
    """ArduPilot reports gauss times a million."""
    telemetry = telemetry_of(autopilot)
    telemetry.receive(m.HighresImu(0, 1.0, 2.0, -9.8, math.pi, 0, 0, reported, 0, 0, 950.0, 1.0, 500.0, 20.0, 0))
    imu = telemetry.imu.value
    assert imu.field_ut[0] == pytest.approx(25.0)
    assert imu.rate_deg_s[0] == pytest.approx(180.0)
    assert (imu.acceleration_m_s2, imu.pressure_pa, imu.differential_pressure_pa) == ((1.0, 2.0, -9.8), 95_000.0, 100.0)


def test_scaled_imu_is_converted_to_si_units() -> None:
    telemetry = telemetry_of(PX4)
    telemetry.receive(m.ScaledImu(0, 1000, 0, -1000, 1000, 0, 0, 250, 0, 0, temperature=1500))
    imu = telemetry.scaled_imu.value
    assert imu.acceleration_m_s2 == pytest.approx((9.80665, 0, -9.80665))
    assert imu.rate_deg_s[0] == pytest.approx(math.degrees(1))
    assert (imu.field_ut[0], imu.temperature_c, imu.pressure_pa) == (25.0, 15.0, None)


def test_odometry_without_covariance_has_none() -> None:
    telemetry = telemetry_of(PX4)
    unknown = (NAN, *[0.0] * 20)
    telemetry.receive(m.Odometry(0, 1, 12, 1, 2, 3, (1, 0, 0, 0), 4, 5, 6, math.pi, 0, 0, unknown, unknown, 0, 8, -1))
    odometry = telemetry.odometry.value
    assert (odometry.position_m, odometry.velocity_m_s) == ((1, 2, 3), (4, 5, 6))
    assert (odometry.pose_covariance, odometry.quality_percent) == (None, -1)
    assert odometry.rate_deg_s[0] == pytest.approx(180)


def test_altitude_unknown_values_are_none() -> None:
    telemetry = telemetry_of(PX4)
    telemetry.receive(m.Altitude(0, 500, 490, 3, 2, -2000, -1))
    altitude = telemetry.altitude.value
    assert (altitude.amsl_m, altitude.relative_m) == (490, 2)
    assert (altitude.terrain_m, altitude.bottom_clearance_m) == (None, None)


def test_ground_truth_of_both_simulations() -> None:
    px4, ardupilot = telemetry_of(PX4), telemetry_of(ARDUPILOT)
    px4.receive(m.HilStateQuaternion(0, (1, 0, 0, 0), 0, 0, 0, 473977000, 85456000, 488_000, *[0] * 8))
    fields: dict[str, Any] = {field.name: 0.0 for field in m.SimState.FIELDS}
    ardupilot.receive(m.SimState(**{**fields, "lat": 47.3977, "lon": 8.5456, "alt": 488.0, "lat_int": 0, "lon_int": 0}))
    for telemetry in (px4, ardupilot):
        place = telemetry.ground_truth.value
        assert (place.latitude_deg, place.longitude_deg) == pytest.approx((47.3977, 8.5456), abs=1e-5)
        assert place.altitude_amsl_m == 488.0


def aircraft(icao: int, flags: int = 0xFFFF, height_mm: int = 1_000_000) -> m.AdsbVehicle:
    return m.AdsbVehicle(icao, 473977000, 85456000, 1, height_mm, 9000, 5000, -200, "SWR12", 3, 1, flags, 1234)


def test_transponder_keeps_last_report_of_each_aircraft() -> None:
    telemetry = telemetry_of(PX4)
    for report in (aircraft(1), aircraft(2), aircraft(1, height_mm=2_000_000)):
        telemetry.receive(report)
    assert [(seen.icao, seen.altitude_m) for seen in telemetry.transponder.value] == [(2, 1000.0), (1, 2000.0)]
    for number in range(200):
        telemetry.receive(aircraft(1000 + number))
    assert len(telemetry.transponder.value) == 64
    assert telemetry.transponder.value[-1].icao == 1199


def test_transponder_fields_that_are_not_valid_are_none() -> None:
    telemetry = telemetry_of(PX4)
    telemetry.receive(aircraft(1, flags=AdsbFlags.VALID_ALTITUDE))
    (seen,) = telemetry.transponder.value
    assert (seen.altitude_m, seen.latitude_deg, seen.course_deg, seen.callsign, seen.squawk) == (
        1000.0,
        None,
        None,
        "",
        None,
    )


# ------------------------------------------------------------------------------- while watched


def requested(flight: Flight, kind: type[Any]) -> list[float]:
    sent: list[Any] = flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)
    return [message.param2 for message in sent if message.param1 == kind.ID]


async def test_message_is_requested_only_while_cell_is_watched() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        assert not flight.vehicle.raw_imu.is_known
        assert requested(flight, m.RawImu) == []
        await flight.vehicle.raw_imu.wait_until(lambda _: True, timeout=3)
        await anyio.sleep(1.0)
        assert requested(flight, m.RawImu)[0] == 100_000
        assert requested(flight, m.RawImu)[-1] != 100_000


async def test_cell_that_firmware_does_not_report_says_so() -> None:
    async with open_flight() as flight:
        with pytest.raises(OperationTimeout, match="no ALTITUDE, which ArduCopter does not send, has been received"):
            await flight.vehicle.altitude.wait_until(lambda _: True, timeout=1)
        assert requested(flight, m.Altitude) == []
    async with open_px4() as px4:
        assert (await px4.vehicle.altitude.wait_until(lambda _: True, timeout=3)).amsl_m is not None
