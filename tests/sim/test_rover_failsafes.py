"""Actions and texts of ArduRover's failsafes: radio, ground station, battery, estimator, crash."""

from __future__ import annotations

import pytest
from simulated_client import set_mode
from vehicles import (
    BATTERY,
    CRITICAL,
    GROUND_STATION,
    LOW,
    drain,
    driving_rover,
    healthy,
    lose_ground_station,
    ready_rover,
)

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, MavState, RoverMode
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.missions import MissionItem

ACTIONS = [
    (0, RoverMode.GUIDED),
    (1, RoverMode.RTL),
    (2, RoverMode.HOLD),
    (3, RoverMode.SMART_RTL),
    (4, RoverMode.SMART_RTL),
    (6, RoverMode.LOITER),
]


@pytest.mark.parametrize(("action", "mode"), ACTIONS)
def test_radio_failsafe_executes_configured_action(action: int, mode: int) -> None:
    rover, client = driving_rover(FS_ACTION=float(action))
    rover.faults.rc_lost = True
    client.run(1.9)
    assert client.texts == []
    assert not healthy(client, Sensor.RC_RECEIVER), "the change takes half a second"
    client.run(1.1)
    assert client.texts == ["Radio Failsafe"]
    assert rover.mode.number == mode
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    rover.faults.rc_lost = False
    client.run(0.5)
    assert client.texts[-1] == "Radio Failsafe Cleared"
    assert rover.mode.number == mode
    assert healthy(client, Sensor.RC_RECEIVER)


def test_radio_failsafe_can_disarm() -> None:
    rover, client = driving_rover(FS_ACTION=5.0)
    rover.faults.rc_lost = True
    client.run(2.5)
    assert client.texts == ["Radio Failsafe", "Throttle disarmed"]
    assert not rover.is_armed


def test_battery_failsafe_can_disarm() -> None:
    rover, client = driving_rover(**BATTERY, BATT_FS_LOW_ACT=5.0)
    drain(rover, client, LOW)
    assert client.texts[1:] == ["Throttle disarmed"]
    assert client.command(MavCmd.DO_FLIGHTTERMINATION, 1) == MavResult.UNSUPPORTED


def test_low_throttle_triggers_failsafe_but_short_dip_does_not() -> None:
    rover, client = driving_rover()
    rover.rc[2] = 900
    client.run(1.0)
    rover.rc[2] = 1500
    client.run(1.0)
    assert client.texts == []
    rover.rc[2] = 900
    client.run(2.0)
    assert client.texts == ["Radio Failsafe"]


@pytest.mark.parametrize("mode", [RoverMode.RTL, RoverMode.HOLD])
def test_failsafe_in_rtl_and_hold_does_nothing(mode: int) -> None:
    rover, client = driving_rover(FS_ACTION=3.0)
    client.run(5.0)
    assert set_mode(client, mode) == MavResult.ACCEPTED
    rover.faults.rc_lost = True
    client.run(4.0)
    assert (client.texts, rover.mode.number) == ([], mode)


def test_failsafe_option_acts_in_hold() -> None:
    rover, client = driving_rover(FS_ACTION=1.0, FS_OPTIONS=1.0)
    assert set_mode(client, RoverMode.HOLD) == MavResult.ACCEPTED
    rover.faults.rc_lost = True
    client.run(4.0)
    assert rover.mode.number == RoverMode.RTL


def test_radio_failsafe_while_disarmed_acts_and_prevents_arming() -> None:
    rover, client = ready_rover()
    rover.faults.rc_lost = True
    client.run(4.0)
    assert client.texts == ["PreArm: Radio failsafe on", "Radio Failsafe"]
    assert rover.mode.number == RoverMode.HOLD
    assert rover.arming.reasons() == ["Radio failsafe on"]


def test_disabled_radio_failsafe_does_nothing() -> None:
    rover, client = driving_rover(FS_THR_ENABLE=0.0)
    rover.faults.rc_lost = True
    client.run(5.0)
    assert (client.texts, rover.mode.number) == ([], RoverMode.GUIDED)


def test_ground_station_failsafe_is_reported_as_radio_if_enabled() -> None:
    rover, client = driving_rover(FS_GCS_ENABLE=1.0)
    lose_ground_station(client, 6.4)
    assert client.texts == []
    client.run(0.4)
    assert client.texts == ["Radio Failsafe"]
    assert rover.mode.number == RoverMode.HOLD
    client.send(GROUND_STATION)
    client.run(0.5)
    assert client.texts[1:] == ["GCS Failsafe Cleared"]


def test_ground_station_failsafe_is_reported_as_gcs_alone() -> None:
    rover, client = driving_rover(FS_GCS_ENABLE=1.0, FS_THR_ENABLE=0.0, FS_ACTION=1.0)
    lose_ground_station(client, 7.0)
    assert (client.texts, rover.mode.number) == (["GCS Failsafe"], RoverMode.RTL)


def test_failsafe_option_continues_mission() -> None:
    rover, client = driving_rover(FS_THR_ENABLE=2.0)
    place = rover.frame.to_global(300.0, 0.0, 0.0)
    item = MissionItem(16, 3, x=place.latitude_e7, y=place.longitude_e7)
    rover.missions.replace(0, [item, item])
    assert set_mode(client, RoverMode.AUTO) == MavResult.ACCEPTED
    rover.faults.rc_lost = True
    client.run(2.5)
    assert client.texts[-2:] == ["Radio Failsafe", "Failsafe - Continuing Auto Mode"]
    assert rover.mode.number == RoverMode.AUTO


def test_low_battery_holds_and_skips_less_severe_action() -> None:
    rover, client = driving_rover(**BATTERY, BATT_FS_LOW_ACT=2.0, BATT_FS_CRT_ACT=1.0)
    drain(rover, client, LOW)
    assert client.texts[0].startswith("Battery 1 is low 10.")
    assert len(client.texts) == 1
    assert rover.mode.number == RoverMode.HOLD
    assert not healthy(client, Sensor.BATTERY)
    assert set_mode(client, RoverMode.GUIDED) == MavResult.ACCEPTED
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.ACTIVE, "a low battery is not critical here"
    drain(rover, client, CRITICAL)
    assert client.texts[-1].startswith("Battery 1 is critical 9.")
    assert rover.mode.number == RoverMode.GUIDED


@pytest.mark.parametrize(("action", "mode"), ACTIONS)
def test_battery_failsafe_executes_configured_action(action: int, mode: int) -> None:
    rover, client = driving_rover(**BATTERY, BATT_FS_LOW_ACT=float(action))
    drain(rover, client, LOW)
    assert rover.mode.number == mode


@pytest.mark.parametrize(
    ("action", "mode", "texts"),
    [
        (1, RoverMode.HOLD, ["EKF variance", "EKF failsafe"]),
        (2, RoverMode.GUIDED, ["EKF variance", "EKF failsafe"]),
        (0, RoverMode.GUIDED, ["EKF variance"]),
    ],
)
def test_estimator_failsafe_executes_configured_action(action: int, mode: int, texts: list[str]) -> None:
    rover, client = driving_rover(FS_EKF_ACTION=float(action))
    rover.faults.gps_lost = True
    client.run(12.0)
    assert [text for text in client.texts if not text.startswith("EKF3")] == texts
    assert rover.mode.number == mode
    rover.faults.gps_lost = False
    client.run(2.0)
    assert "EKF failsafe cleared" in client.texts


@pytest.mark.parametrize(("action", "mode"), [(0, RoverMode.GUIDED), (1, RoverMode.HOLD), (2, RoverMode.HOLD)])
def test_crash_check_executes_configured_action(action: int, mode: int) -> None:
    rover, client = driving_rover(FS_CRASH_CHECK=float(action))
    rover.faults.motor_failed = True
    client.run(8.0)
    assert ("Crash: Going to HOLD" in client.texts) == (action > 0)
    assert rover.mode.number == mode
    assert rover.is_armed == (action < 2)
