"""Actions and texts of ArduSub's failsafes: ground station, pilot, radio, battery, hull."""

from __future__ import annotations

import pytest
from vehicles import (
    ARM,
    BATTERY,
    CRITICAL,
    GROUND_STATION,
    LOW,
    armed_sub,
    drain,
    healthy,
    lose_ground_station,
    ready_sub,
)

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavResult, MavState, SubMode
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor

NO_PILOT = {"FS_PILOT_INPUT": 0.0}


@pytest.mark.parametrize(
    ("action", "mode"),
    [(1, SubMode.MANUAL), (2, SubMode.MANUAL), (3, SubMode.ALT_HOLD), (4, SubMode.SURFACE)],
)
def test_ground_station_failsafe_executes_configured_action(action: int, mode: int) -> None:
    sub, client = armed_sub(SubMode.MANUAL, FS_GCS_ENABLE=float(action))
    lose_ground_station(client, 4.9)
    assert client.texts == []
    client.run(0.3)
    assert client.texts == ["MYGCS: 255, heartbeat lost", *["Disarming motors"] * (action == 2)]
    assert (sub.mode.number, sub.is_armed) == (mode, action != 2)
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    client.send(GROUND_STATION)
    client.run(0.5)
    assert client.texts[-1] == "GCS Failsafe Cleared"


def test_lost_ground_station_is_reported_every_half_minute() -> None:
    _, client = armed_sub(FS_GCS_ENABLE=1.0, **NO_PILOT)
    lose_ground_station(client, 34.0)
    assert client.texts == ["MYGCS: 255, heartbeat lost"]
    client.run(3.0)
    assert client.texts == ["MYGCS: 255, heartbeat lost"] * 2


def test_arming_without_ground_station_disarms_immediately() -> None:
    sub, client = ready_sub(FS_GCS_ENABLE=2.0)
    lose_ground_station(client, 8.0)
    assert client.texts == ["MYGCS: 255, heartbeat lost"]
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    client.run(0.3)
    assert client.texts[1:] == ["Arming motors", "Disarming motors"]
    assert not sub.is_armed


@pytest.mark.parametrize("action", [0, 1, 2])
def test_pilot_input_failsafe_centers_sticks_or_disarms(action: int) -> None:
    sub, client = armed_sub(FS_PILOT_INPUT=float(action))
    sub.rc[4] = 1700
    sub.faults.rc_lost = True
    client.run(2.8)
    assert client.texts == []
    client.run(0.5)
    assert client.texts == ["Lost manual control"] * (action > 0) + ["Disarming motors"] * (action > 1)
    assert sub.is_armed == (action < 2)
    assert sub.rc[4] == (1500 if action else 1700), "neutral controls"
    client.run(1.0)
    assert (client.last(m.Heartbeat).system_status == MavState.CRITICAL) == (action > 0)


@pytest.mark.parametrize("action", [0, 1, 2])
def test_radio_failsafe_warns_or_surfaces(action: int) -> None:
    sub, client = armed_sub(FS_THR_ENABLE=float(action), **NO_PILOT)
    sub.faults.rc_lost = True
    client.run(1.3)
    assert client.texts == ["RC Failsafe"] * (action > 0)
    assert sub.mode.number == (SubMode.SURFACE if action == 2 else SubMode.ALT_HOLD)
    assert healthy(client, Sensor.RC_RECEIVER) == (action == 0)
    sub.faults.rc_lost = False
    client.run(0.5)
    assert client.texts[1:] == ["Radio Failsafe Cleared"] * (action > 0)
    assert healthy(client, Sensor.RC_RECEIVER)


def test_lost_radio_prevents_arming() -> None:
    sub, client = ready_sub(FS_THR_ENABLE=1.0)
    sub.faults.rc_lost = True
    client.run(3.0)
    assert "PreArm: Radio failsafe on" in client.texts
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: Radio failsafe on"


def test_low_battery_surfaces_and_critical_disarms() -> None:
    sub, client = armed_sub(**BATTERY, BATT_FS_LOW_ACT=3.0, BATT_FS_CRT_ACT=2.0)
    drain(sub, client, LOW)
    assert client.texts[0].startswith("Battery 1 is low 10.")
    assert sub.mode.number == SubMode.SURFACE
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    drain(sub, client, CRITICAL)
    assert client.texts[1].startswith("Battery 1 is critical ")
    assert client.texts[2] == "Disarming motors"
    assert not sub.is_armed


@pytest.mark.parametrize("action", [0, 1])
def test_low_battery_can_only_warn(action: int) -> None:
    sub, client = armed_sub(**BATTERY, BATT_FS_LOW_ACT=float(action))
    drain(sub, client, LOW)
    assert len(client.texts) == 1
    assert (sub.mode.number, sub.is_armed) == (SubMode.ALT_HOLD, True)


@pytest.mark.parametrize("action", [0, 1, 2])
def test_leak_failsafe_warns_or_surfaces(action: int) -> None:
    sub, client = armed_sub(FS_LEAK_ENABLE=float(action))
    sub.faults.leak = True
    client.run(1.5)
    assert client.texts == ["Leak Detected"] * (action > 0)
    assert sub.mode.number == (SubMode.SURFACE if action == 2 else SubMode.ALT_HOLD)
    assert (client.last(m.Heartbeat).system_status == MavState.CRITICAL) == (action > 0)
    client.run(20.0)
    assert client.texts == ["Leak Detected"] * 2 * (action > 0)


def test_hull_pressure_failsafe_warns() -> None:
    sub, client = armed_sub(FS_PRESS_ENABLE=1.0)
    client.run(1.0)
    sub.hull_pressure_pa = 106_000.0
    client.run(3.5)
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    assert client.texts == []
    client.run(28.0)
    assert client.texts == ["Internal pressure critical!"]
    sub.hull_pressure_pa = 101_000.0
    client.run(1.5)
    assert client.last(m.Heartbeat).system_status == MavState.ACTIVE


def test_hull_temperature_check_enabled_late_reports_immediately() -> None:
    sub, client = armed_sub(**NO_PILOT)
    sub.hull_temperature_c = 70.0
    client.run(35.0)
    assert client.texts == []
    sub.parameters["FS_TEMP_ENABLE"] = 1.0
    client.run(0.3)
    assert client.texts == ["Internal temperature critical!"]
