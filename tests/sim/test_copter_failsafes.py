"""Actions, options and texts of ArduCopter's radio, ground station and battery failsafes."""

from __future__ import annotations

import pytest
from simulated_client import Client, flying_copter, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, MavBatteryChargeState, MavCmd, MavResult, MavState
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.sim import SimulatedCopter


def healthy(client: Client, bit: int) -> bool:
    client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID)
    client.run(0.1)
    return bool(client.last(m.SysStatus).onboard_control_sensors_health & bit)


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (1, CopterMode.RTL),
        (3, CopterMode.SMART_RTL),
        (4, CopterMode.SMART_RTL),
        (5, CopterMode.LAND),
        (6, CopterMode.RTL),
        (7, CopterMode.BRAKE),
    ],
)
def test_radio_failsafe_executes_configured_action(action: int, mode: int) -> None:
    copter, client = flying_copter(parameters={"FS_THR_ENABLE": float(action)})
    copter.faults.rc_lost = True
    client.run(2.0)
    assert copter.mode.number == mode
    assert client.texts[0] == "Radio Failsafe"
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    assert not healthy(client, Sensor.RC_RECEIVER)


def test_radio_recovery_keeps_mode() -> None:
    copter, client = flying_copter()
    copter.parameters["SIM_RC_FAIL"] = 1.0
    client.run(2.0)
    copter.parameters["SIM_RC_FAIL"] = 0.0
    client.run(1.0)
    assert client.texts == ["Radio Failsafe", "Radio Failsafe Cleared"]
    assert copter.mode.number == CopterMode.RTL
    assert healthy(client, Sensor.RC_RECEIVER)


def test_low_throttle_triggers_radio_failsafe() -> None:
    copter, client = flying_copter()
    copter.rc[2] = 950
    client.run(1.0)
    assert copter.mode.number == CopterMode.RTL


def test_disabled_radio_failsafe_does_nothing() -> None:
    copter, client = flying_copter(parameters={"FS_THR_ENABLE": 0.0})
    copter.faults.rc_lost = True
    client.run(3.0)
    assert copter.mode.number == CopterMode.GUIDED
    assert client.texts == []


def test_rc_override_prevents_radio_failsafe() -> None:
    copter, client = flying_copter()
    for _ in range(6):
        client.send(m.RcChannelsOverride(1, 1, 1500, 1500, 1500, 1500, 0, 0, 0, 0))
        copter.faults.rc_lost = True
        client.run(0.5)
    assert copter.mode.number == CopterMode.GUIDED


def test_radio_failsafe_option_continues_guided() -> None:
    copter, client = flying_copter(parameters={"FS_OPTIONS": 4.0})
    copter.faults.rc_lost = True
    client.run(2.0)
    assert client.texts == ["Radio Failsafe - Continuing Guided Mode"]
    assert copter.mode.number == CopterMode.GUIDED


def test_radio_failsafe_option_continues_landing() -> None:
    copter, client = flying_copter(parameters={"FS_OPTIONS": 8.0})
    assert set_mode(client, CopterMode.LAND) == MavResult.ACCEPTED
    copter.faults.rc_lost = True
    client.run(2.0)
    assert client.texts == ["Radio Failsafe - Continuing Landing"]
    assert copter.mode.number == CopterMode.LAND


def test_lost_radio_prevents_arming() -> None:
    copter, client = ready_copter()
    copter.faults.rc_lost = True
    client.run(2.0)
    assert client.texts == ["Radio Failsafe - Disarming"]
    client.clear()
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.FAILED
    assert client.texts == ["Arm: Radio failsafe on"]


def lose_ground_station(options: float, mode: int) -> tuple[SimulatedCopter, Client]:
    copter, client = flying_copter(parameters={"FS_GCS_ENABLE": 1.0, "FS_OPTIONS": options})
    copter.rc[2] = 1500
    assert set_mode(client, mode) == MavResult.ACCEPTED
    client.send(m.Heartbeat(6, 8, 0, 0, 4, 3))
    client.run(5.5)
    return copter, client


def test_ground_station_failsafe_returns_home() -> None:
    copter, client = lose_ground_station(16.0, CopterMode.GUIDED)
    assert client.texts == ["GCS Failsafe"]
    assert copter.mode.number == CopterMode.RTL
    client.send(m.Heartbeat(6, 8, 0, 0, 4, 3))
    client.run(0.5)
    assert client.texts[-1] == "GCS Failsafe Cleared"


def test_ground_station_failsafe_option_continues_pilot_control() -> None:
    copter, client = lose_ground_station(16.0, CopterMode.LOITER)
    assert client.texts == ["GCS Failsafe - Continuing Pilot Control"]
    assert copter.mode.number == CopterMode.LOITER


def test_ground_station_failsafe_while_disarmed_prevents_arming() -> None:
    copter, client = ready_copter(parameters={"FS_GCS_ENABLE": 1.0})
    client.send(m.Heartbeat(6, 8, 0, 0, 4, 3))
    client.run(6.0)
    assert client.texts == ["GCS Failsafe"]
    assert copter.arming.reasons() == ["GCS failsafe on"]


BATTERY = {"BATT_FS_LOW_ACT": 2.0, "BATT_FS_CRT_ACT": 1.0, "BATT_CRT_VOLT": 9.5, "BATT_LOW_TIMER": 2.0}


def test_battery_failsafe_acts_at_low_and_critical() -> None:
    copter, client = flying_copter(parameters=BATTERY)
    copter.battery.percent = 10.0
    client.run(3.0)
    assert copter.mode.number == CopterMode.RTL
    assert client.texts[0].startswith("Battery 1 is low 9.8")
    assert client.texts[1] == "Battery Failsafe"
    client.clear()
    copter.battery.percent = 2.0
    client.run(3.0)
    assert copter.mode.number == CopterMode.LAND
    assert client.texts[0].startswith("Battery 1 is critical 8.")
    assert not healthy(client, Sensor.BATTERY)
    client.command(MavCmd.REQUEST_MESSAGE, m.BatteryStatus.ID)
    client.run(0.1)
    assert client.last(m.BatteryStatus).charge_state == MavBatteryChargeState.CRITICAL


def test_less_severe_battery_action_is_not_executed() -> None:
    copter, client = flying_copter(parameters={**BATTERY, "BATT_FS_LOW_ACT": 1.0, "BATT_FS_CRT_ACT": 2.0})
    copter.battery.percent = 10.0
    client.run(3.0)
    copter.battery.percent = 2.0
    client.run(3.0)
    assert copter.mode.number == CopterMode.LAND
    assert client.texts.count("Battery Failsafe") == 1


def test_voltage_dip_is_ignored_but_low_charge_acts_immediately() -> None:
    copter, client = flying_copter(parameters={**BATTERY, "BATT_LOW_TIMER": 10.0})
    copter.battery.percent = 10.0
    client.run(3.0)
    copter.battery.percent = 90.0
    client.run(8.0)
    assert client.texts == []
    copter.parameters["BATT_LOW_MAH"] = 3290.0
    client.run(0.5)
    assert client.texts[1] == "Battery Failsafe"


def test_battery_failsafe_can_stop_motors() -> None:
    copter, client = flying_copter(parameters={**BATTERY, "BATT_FS_LOW_ACT": 5.0})
    copter.battery.percent = 10.0
    client.run(3.0)
    assert not copter.is_armed


def test_battery_failsafe_on_ground_disarms() -> None:
    copter, client = ready_copter(parameters={**BATTERY, "DISARM_DELAY": 0.0})
    assert set_mode(client, CopterMode.GUIDED) == MavResult.ACCEPTED
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.ACCEPTED
    client.clear()
    copter.battery.percent = 10.0
    client.run(3.0)
    assert client.texts[1:] == ["Disarming motors", "Battery Failsafe - Disarming"]


def test_low_battery_while_disarmed_only_prevents_arming() -> None:
    copter, client = ready_copter(battery_percent=10.0)
    client.run(15.0)
    assert client.texts == []
    assert copter.arming.reasons() == ["Battery 1 low voltage failsafe"]
