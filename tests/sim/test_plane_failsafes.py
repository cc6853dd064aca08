"""Actions and texts of ArduPlane's failsafes: radio (short and long), ground station, battery."""

from __future__ import annotations

import pytest
from simulated_client import set_mode
from vehicles import (
    BATTERY,
    CRITICAL,
    GROUND_STATION,
    LOW,
    drain,
    flying_plane,
    healthy,
    lose_ground_station,
    ready_plane,
)

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, MavState, PlaneMode
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.missions import MissionItem

HEARTBEAT = {"FS_GCS_ENABL": 1.0}


# ------------------------------------------------------------------------------------------- short


def test_radio_failsafe_circles_then_returns() -> None:
    plane, client = flying_plane(PlaneMode.FLY_BY_WIRE_A)
    plane.faults.rc_lost = True
    client.run(1.15)
    assert client.texts == []
    client.run(0.25)
    assert client.texts == ["Throttle failsafe on", "RC Short Failsafe: switched to CIRCLE"]
    assert not healthy(client, Sensor.RC_RECEIVER)
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    client.run(3.5)
    assert plane.mode.number == PlaneMode.CIRCLE, "FS_LONG_TIMEOUT counts from the short failsafe"
    client.run(1.0)
    assert client.texts[2:] == ["RC Long Failsafe On: RTL"]


def test_early_radio_recovery_restores_mode() -> None:
    plane, client = flying_plane(PlaneMode.FLY_BY_WIRE_A)
    plane.faults.rc_lost = True
    client.run(2.0)
    client.clear()
    plane.faults.rc_lost = False
    client.run(1.5)
    assert client.texts == [
        "Throttle failsafe off",
        "Short Failsafe Cleared",
        "Flight mode FLY_BY_WIRE_A restored",
    ]
    assert plane.mode.number == PlaneMode.FLY_BY_WIRE_A
    assert client.last(m.Heartbeat).system_status == MavState.ACTIVE
    assert healthy(client, Sensor.RC_RECEIVER)


def test_late_radio_recovery_keeps_mode() -> None:
    plane, client = flying_plane(PlaneMode.CRUISE)
    plane.faults.rc_lost = True
    client.run(7.0)
    client.clear()
    plane.faults.rc_lost = False
    client.run(1.0)
    assert client.texts == ["Throttle failsafe off", "RC Long Failsafe Cleared"]
    assert plane.mode.number == PlaneMode.RTL


@pytest.mark.parametrize(
    ("action", "mode", "then"),
    [
        (0, PlaneMode.LOITER, PlaneMode.LOITER),
        (1, PlaneMode.LOITER, PlaneMode.CIRCLE),
        (2, PlaneMode.GUIDED, PlaneMode.FLY_BY_WIRE_A),
        (4, PlaneMode.GUIDED, PlaneMode.FLY_BY_WIRE_B),
        (1, PlaneMode.RTL, PlaneMode.RTL),
        (2, PlaneMode.MANUAL, PlaneMode.FLY_BY_WIRE_A),
    ],
)
def test_short_failsafe_executes_configured_action(action: int, mode: int, then: int) -> None:
    plane, client = flying_plane(mode, FS_SHORT_ACTN=float(action))
    plane.faults.rc_lost = True
    client.run(2.0)
    assert plane.mode.number == then
    switched = f"RC Short Failsafe: switched to {plane.mode.name}"
    assert client.texts[1] == (switched if mode != then else "RC Short Failsafe On")


def test_long_failsafe_without_short_counts_from_last_pulse() -> None:
    plane, client = flying_plane(FS_SHORT_ACTN=3.0)
    plane.faults.rc_lost = True
    client.run(4.9)
    assert client.texts == ["Throttle failsafe on"]
    client.run(0.4)
    assert client.texts[1:] == ["RC Long Failsafe On: RTL"]


def test_low_throttle_triggers_radio_failsafe() -> None:
    plane, client = flying_plane()
    plane.parameters["SIM_RC_FAIL"] = 2.0
    client.run(0.5)
    assert client.texts == ["Throttle failsafe on", "RC Short Failsafe On"]


@pytest.mark.parametrize("enabled", [0.0, 2.0])
def test_disabled_throttle_failsafe_shows_in_sys_status_only(enabled: float) -> None:
    plane, client = flying_plane(THR_FAILSAFE=enabled)
    plane.faults.rc_lost = True
    client.run(8.0)
    assert client.texts == []
    assert plane.mode.number == PlaneMode.LOITER
    assert not healthy(client, Sensor.RC_RECEIVER)


# -------------------------------------------------------------------------------------------- long


@pytest.mark.parametrize(
    ("action", "mode", "then"),
    [
        (0, PlaneMode.GUIDED, PlaneMode.GUIDED),
        (1, PlaneMode.GUIDED, PlaneMode.RTL),
        (2, PlaneMode.LOITER, PlaneMode.FLY_BY_WIRE_A),
        (5, PlaneMode.LOITER, PlaneMode.AUTOLAND),
        (5, PlaneMode.RTL, PlaneMode.AUTOLAND),
        (1, PlaneMode.AUTOLAND, PlaneMode.AUTOLAND),
    ],
)
def test_long_failsafe_executes_configured_action(action: int, mode: int, then: int) -> None:
    plane, client = flying_plane(mode, FS_SHORT_ACTN=3.0, FS_LONG_ACTN=float(action), **HEARTBEAT)
    lose_ground_station(client, 5.5)
    assert plane.mode.number == then
    landing = mode == PlaneMode.AUTOLAND
    assert client.texts == ([] if landing else [f"GCS Failsafe On: {plane.mode.name}"])


def test_long_failsafe_waits_for_end_of_take_off() -> None:
    plane, client = ready_plane(**HEARTBEAT)
    assert set_mode(client, PlaneMode.TAKEOFF) == MavResult.ACCEPTED
    plane.arming.arm()
    client.run(1.0)
    client.clear()
    lose_ground_station(client, 5.5)
    assert plane.mode.is_taking_off
    assert client.texts == ["GCS Failsafe On: TAKEOFF"]
    client.run_until(lambda: plane.mode.number != PlaneMode.TAKEOFF)
    assert plane.mode.number == PlaneMode.RTL
    assert plane.altitude_m > 40.0


# ---------------------------------------------------------------------------------- ground station


def test_ground_station_recovery_is_reported() -> None:
    plane, client = flying_plane(**HEARTBEAT)
    lose_ground_station(client, 4.9)
    assert client.texts == []
    client.run(1.6)
    assert client.texts == ["GCS Failsafe On: RTL"]
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    client.send(GROUND_STATION)
    client.run(1.5)
    assert client.texts[1:] == ["GCS Failsafe Off"]
    assert plane.mode.number == PlaneMode.RTL
    assert client.last(m.Heartbeat).system_status == MavState.ACTIVE


def test_ground_station_never_seen_triggers_no_failsafe() -> None:
    plane, client = flying_plane(**HEARTBEAT)
    client.run(8.0)
    assert plane.mode.number == PlaneMode.LOITER


def test_ground_station_failsafe_can_be_limited_to_auto() -> None:
    plane, client = flying_plane(FS_GCS_ENABL=3.0)
    lose_ground_station(client, 8.0)
    assert (client.texts, plane.mode.number) == ([], PlaneMode.LOITER)


def test_radio_failsafe_while_disarmed_acts_and_prevents_arming() -> None:
    plane, client = ready_plane()
    plane.faults.rc_lost = True
    client.run(4.0)
    assert plane.mode.number == PlaneMode.CIRCLE
    assert client.texts == [
        "Throttle failsafe on",
        "RC Short Failsafe: switched to CIRCLE",
        "PreArm: Radio failsafe on",
    ]
    assert not plane.arming.arm()
    client.run(0.1)
    assert client.texts[-1] == "Arm: Radio failsafe on"


# ----------------------------------------------------------------------------------------- battery


def test_low_battery_returns_and_critical_lacks_landing_sequence() -> None:
    plane, client = flying_plane(**BATTERY, BATT_FS_LOW_ACT=1.0, BATT_FS_CRT_ACT=2.0)
    drain(plane, client, LOW)
    assert plane.mode.number == PlaneMode.RTL
    assert client.texts[0].startswith("Battery 1 is low 10.")
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    assert not healthy(client, Sensor.BATTERY)
    assert set_mode(client, PlaneMode.LOITER) == MavResult.ACCEPTED
    client.clear()
    drain(plane, client, CRITICAL)
    assert client.texts[0].startswith("Battery 1 is critical 9.")
    assert client.texts[1:] == ["Unable to start landing sequence"]
    assert plane.mode.number == PlaneMode.RTL


def test_less_severe_battery_action_is_not_executed() -> None:
    plane, client = flying_plane(**BATTERY, BATT_FS_LOW_ACT=2.0, BATT_FS_CRT_ACT=1.0)
    drain(plane, client, LOW)
    assert set_mode(client, PlaneMode.LOITER) == MavResult.ACCEPTED
    drain(plane, client, CRITICAL)
    assert plane.mode.number == PlaneMode.LOITER


@pytest.mark.parametrize(("action", "then"), [(0, PlaneMode.LOITER), (7, PlaneMode.AUTOLAND), (3, PlaneMode.LOITER)])
def test_low_battery_executes_other_actions(action: int, then: int) -> None:
    plane, client = flying_plane(**BATTERY, BATT_FS_LOW_ACT=float(action))
    drain(plane, client, LOW)
    assert plane.mode.number == then
    assert plane.is_armed


def test_low_battery_lands_at_mission_landing_sequence() -> None:
    plane, client = flying_plane(**BATTERY, BATT_FS_LOW_ACT=2.0)
    place = plane.frame.to_global(1500.0, 0.0, 0.0)
    x, y = place.latitude_e7, place.longitude_e7
    way = [MissionItem(command, 3, x=x, y=y, z=40.0) for command in (16, 16, 189, 16)]
    plane.missions.replace(0, way)
    drain(plane, client, LOW)
    assert plane.mode.number == PlaneMode.AUTO
    assert plane.mission.nav_index == 3


def test_flight_termination_is_refused() -> None:
    plane, client = flying_plane(**BATTERY, BATT_FS_LOW_ACT=3.0)
    assert client.command(MavCmd.DO_FLIGHTTERMINATION, 1) == MavResult.FAILED
    assert client.texts == ["AFS not enabled, can't terminate the vehicle"]
    plane.parameters["AFS_ENABLE"] = 1.0
    drain(plane, client, LOW)
    assert client.texts[-1] == "Unable to terminate, termination is not configured"
    assert plane.is_armed


def test_radio_failsafe_returns_without_position() -> None:
    plane, client = flying_plane(**HEARTBEAT)
    plane.faults.gps_lost = True
    client.run(11.0)
    assert not plane.navigation.has_position
    lose_ground_station(client, 5.5)
    assert plane.mode.number == PlaneMode.RTL
