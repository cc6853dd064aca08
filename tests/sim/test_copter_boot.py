"""Boot of the simulated copter, compared with a recording of ArduCopter 4.7-dev."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, GpsFixType, MavCmd, MavDataStream, MavState, MavSysStatusSensor
from aerokit.mavlink.message import Message
from aerokit.sim import BootTimeline, SimulatedCopter

REAL_TIME_S = BootTimeline().position_good
REAL_EKF_FLAGS = [1024, 0, 167, 831]
REAL_TEXTS = [
    "ArduPilot Ready",
    "AHRS: DCM active",
    "EKF3 IMU0 initialised",
    "EKF3 IMU1 initialised",
    "AHRS: EKF3 active",
    "EKF3 IMU0 tilt alignment complete",
    "EKF3 IMU0 MAG0 initial yaw alignment complete",
    "GPS 1: probing for u-blox at 230400 baud",
    "GPS 1: detected u-blox",
    "EKF3 IMU0 origin set",
    "Field Elevation Set: 584m",
    "EKF3 IMU0 is using GPS",
]


def booting(boot_time_s: float = REAL_TIME_S, rate: int = 10) -> tuple[SimulatedCopter, Client]:
    copter = SimulatedCopter(boot_time_s=boot_time_s)
    client = Client(copter)
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, rate, 1))
    return copter, client


def first(client: Client, kind: type[Message]) -> float:
    return next(now for now, message in client.received if isinstance(message, kind))


def test_boot_texts_match_recording() -> None:
    _, client = booting()
    client.run(45.0)
    texts = iter(client.texts)
    for wanted in REAL_TEXTS:
        assert any(text.startswith(wanted) for text in texts), wanted
    assert 0.8 < first(client, m.Heartbeat) < 1.0
    assert 2.2 < first(client, m.SysStatus) < 2.5
    assert 3.2 < first(client, m.EkfStatusReport) < 3.6
    assert 19.8 < first(client, m.HomePosition) < 20.1
    assert 41.3 < first(client, m.LocalPositionNed) < 41.8


def test_estimator_flags_match_recording() -> None:
    _, client = booting()
    client.run(45.0)
    flags = [report.flags for report in client.all(m.EkfStatusReport)]
    assert list(dict.fromkeys(flags)) == REAL_EKF_FLAGS


def test_positions_before_fix_and_estimate_match_recording() -> None:
    copter, client = booting()
    client.run(9.0)
    assert copter.navigation.position is None
    position = client.last(m.GlobalPositionInt)
    assert (position.lat, position.lon, position.alt) == (0, 0, 0)
    assert client.last(m.GpsRawInt).fix_type == GpsFixType.NO_GPS
    assert client.last(m.SystemTime).time_unix_usec == 0
    client.run(3.0)
    assert client.last(m.GlobalPositionInt).lat == -353632610
    assert client.last(m.GpsRawInt).fix_type >= GpsFixType.TYPE_3D_FIX
    assert client.last(m.SystemTime).time_unix_usec > 1e15
    assert client.all(m.LocalPositionNed) == []
    assert client.all(m.Wind) == []
    assert client.command(MavCmd.GET_HOME_POSITION) == 4


def test_sensor_health_matches_recording() -> None:
    _, client = booting()
    client.run(45.0)
    health = dict.fromkeys(hex(status.onboard_control_sensors_health) for status in client.all(m.SysStatus))
    assert list(health)[-3:] == ["0x47519c2f", "0x47719c2f", "0x57719c2f"]
    assert hex(client.last(m.SysStatus).onboard_control_sensors_present) == "0x5371fc2f"
    assert hex(client.last(m.SysStatus).onboard_control_sensors_enabled) == "0x52619c2f"
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.run(1.0)
    status = client.last(m.SysStatus)
    assert hex(status.onboard_control_sensors_enabled) == "0x5361fc2f"
    assert hex(status.onboard_control_sensors_health) == "0x5771fc2f"


def test_system_state_leaves_boot_after_ready() -> None:
    _, client = booting()
    client.run(4.1)
    beats = [(beat.base_mode, beat.system_status) for beat in client.all(m.Heartbeat)]
    assert beats[0] == (89, MavState.BOOT)
    assert beats[-1] == (81, MavState.STANDBY)


def test_no_streams_without_request() -> None:
    client = Client(SimulatedCopter(boot_time_s=1.0))
    client.run(12.0)
    kinds = {type(message) for _, message in client.received}
    assert kinds == {m.Heartbeat, m.Statustext, m.HomePosition, m.GpsGlobalOrigin, m.Timesync}
    assert len(client.all(m.Heartbeat)) == 12


def test_boot_time_zero_is_ready_at_once() -> None:
    copter, client = booting(boot_time_s=2.0)
    took = client.run_until(lambda: copter.navigation.has_position)
    assert took == pytest.approx(2.0, abs=0.1)
    copter, _ = booting(boot_time_s=0.0)
    assert copter.navigation.home == (0.0, 0.0, 0.0)


def test_boot_text_precedes_first_frame() -> None:
    copter = SimulatedCopter(boot_text=True)
    copter.step(0.0)
    text = copter.take_outbox()
    assert text.lstrip().startswith(b"Init ArduCopter V4.7.0-dev")
    assert 60 < len(text) < 200


def test_version_number_is_packed_as_in_autopilot_version() -> None:
    _, client = ready_copter(version="4.5.7")
    assert client.command(MavCmd.REQUEST_MESSAGE, m.AutopilotVersion.ID) == 0
    version = client.last(m.AutopilotVersion)
    assert version.flight_sw_version == 0x040507FF
    assert version.capabilities == 0xFBEF
    _, client = ready_copter()
    client.command(MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, 1)
    assert client.last(m.AutopilotVersion).flight_sw_version == 0x04070000


def test_home_position_quaternion_is_nan() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.GET_HOME_POSITION) == 0
    home = client.last(m.HomePosition)
    assert all(math.isnan(part) for part in home.q)
    kinds = [type(message) for _, message in client.received]
    assert kinds.index(m.HomePosition) < kinds.index(m.CommandAck), "sent before the answer"


def test_reboot_is_silent_and_resets_vehicle() -> None:
    copter, client = ready_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
    set_mode(client, CopterMode.GUIDED)
    copter.parameters["RTL_ALT"] = 2000
    client.run(5.0)
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == 0
    client.run(0.2)
    client.clear()
    client.run(1.0)
    assert client.received == []
    client.run(4.0)
    assert "ArduPilot Ready" in client.texts
    assert client.all(m.Attitude) == [], "stream rates are reset"
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
    client.run(1.0)
    assert client.last(m.Attitude).time_boot_ms < 6000
    assert client.last(m.Heartbeat).custom_mode == CopterMode.STABILIZE
    assert copter.parameters["RTL_ALT"] == 2000
    assert copter.parameters["STAT_BOOTCNT"] == 2


def test_gps_loss_affects_receiver_first_and_estimator_later() -> None:
    copter, client = ready_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
    copter.faults.gps_lost = True
    client.run(1.0)
    assert client.last(m.GpsRawInt).fix_type == GpsFixType.NO_FIX
    assert not client.last(m.SysStatus).onboard_control_sensors_health & MavSysStatusSensor.GPS
    assert client.last(m.EkfStatusReport).flags == 831
    client.run(7.0)
    assert client.last(m.EkfStatusReport).flags == 39
    client.run(8.0)
    assert client.last(m.EkfStatusReport).flags == 167
    copter.faults.gps_lost = False
    client.run(1.0)
    assert client.last(m.EkfStatusReport).flags == 831


def test_gps_that_comes_late_is_reported_once() -> None:
    copter, client = booting(10.0)
    client.run_until(lambda: "EKF3 IMU0 origin set" in client.texts)
    copter.faults.gps_lost = True
    client.run(10.0)
    assert "EKF3 IMU0 is using GPS" not in client.texts
    copter.faults.gps_lost = False
    client.run(5.0)
    assert client.texts.count("EKF3 IMU0 is using GPS") == 1
