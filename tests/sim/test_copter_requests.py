"""Message and parameter requests to a simulated copter."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client, flying_copter, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavDataStream, MavResult, ParachuteAction, WinchActions

STREAMED_BY_A_REAL_COPTER = {
    "AHRS", "AHRS2", "ATTITUDE", "BATTERY_STATUS", "EKF_STATUS_REPORT", "ESC_TELEMETRY_1_TO_4",
    "GLOBAL_POSITION_INT", "GPS_RAW_INT", "HEARTBEAT", "LOCAL_POSITION_NED", "MEMINFO", "MISSION_CURRENT",
    "NAV_CONTROLLER_OUTPUT",
    "POSITION_TARGET_GLOBAL_INT", "POWER_STATUS", "RAW_IMU", "RC_CHANNELS", "SCALED_IMU2", "SCALED_IMU3",
    "SCALED_PRESSURE", "SCALED_PRESSURE2", "SERVO_OUTPUT_RAW", "SIMSTATE", "SYSTEM_TIME", "SYS_STATUS",
    "TERRAIN_REPORT", "TERRAIN_REQUEST", "VFR_HUD", "VIBRATION", "WIND",
}  # fmt: skip
"""Messages after REQUEST_DATA_STREAM ALL, in GUIDED with a target."""


def interval(client: Client, message_id: int, microseconds: float) -> int | None:
    return client.command(MavCmd.SET_MESSAGE_INTERVAL, message_id, microseconds)


def test_all_streams_match_recorded_copter() -> None:
    _, client = flying_copter()
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 3576, 5, 0, -10, 0, 0, 0, 0, 0, 0, 0, 0))
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 10, 1))
    client.run(5.0)
    kinds = {message.NAME for _, message in client.received}
    assert kinds - {"TIMESYNC"} == STREAMED_BY_A_REAL_COPTER
    per_second = len(client.received) / 5.0
    assert per_second == pytest.approx(275, rel=0.05)


def test_stream_group_starts_and_stops_alone() -> None:
    _, client = ready_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 4, 1))
    client.run(5.0)
    assert len(client.all(m.Attitude)) == pytest.approx(20, abs=1)
    assert client.all(m.VfrHud) == []
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 4, 0))
    client.clear()
    client.run(2.0)
    assert client.all(m.Attitude) == []


def test_message_interval_sets_rate_by_id() -> None:
    _, client = ready_copter()
    assert interval(client, m.Attitude.ID, 100_000) == MavResult.ACCEPTED
    assert interval(client, m.AttitudeQuaternion.ID, 500_000) == MavResult.ACCEPTED
    client.run(5.0)
    assert len(client.all(m.Attitude)) == pytest.approx(50, abs=1)
    assert len(client.all(m.AttitudeQuaternion)) == pytest.approx(10, abs=1)
    assert interval(client, m.Attitude.ID, -1) == MavResult.ACCEPTED
    assert interval(client, m.AttitudeQuaternion.ID, 0) == MavResult.ACCEPTED
    client.clear()
    client.run(2.0)
    assert {type(message) for _, message in client.received} == {m.Heartbeat}


def test_invalid_message_intervals_are_refused() -> None:
    _, client = ready_copter()
    assert interval(client, 12345, 100_000) == MavResult.DENIED
    assert client.texts == ["No ap_message for mavlink id (12345)"]
    assert interval(client, m.Attitude.ID, 1000) == MavResult.DENIED
    assert client.texts[1].startswith("Requested rate for message ID 30 too fast")
    assert interval(client, m.Attitude.ID, -5) == MavResult.DENIED


def test_heartbeat_interval_can_be_changed() -> None:
    _, client = ready_copter()
    interval(client, m.Heartbeat.ID, 200_000)
    client.run(2.0)
    assert len(client.all(m.Heartbeat)) >= 10
    interval(client, m.Heartbeat.ID, 0)
    client.clear()
    client.run(5.0)
    assert len(client.all(m.Heartbeat)) <= 6


def test_get_message_interval_returns_interval() -> None:
    _, client = ready_copter()
    interval(client, m.Attitude.ID, 100_000)
    for message_id, expected in ((m.Attitude.ID, 100_000), (m.VfrHud.ID, -1)):
        assert client.command(MavCmd.GET_MESSAGE_INTERVAL, message_id) == MavResult.ACCEPTED
        answer = client.last(m.MessageInterval)
        assert (answer.message_id, answer.interval_us) == (message_id, expected)
    assert client.command(MavCmd.GET_MESSAGE_INTERVAL, 12345) == MavResult.FAILED
    assert client.last(m.MessageInterval).interval_us == 0
    assert client.command(MavCmd.REQUEST_MESSAGE, m.MessageInterval.ID, m.Attitude.ID) == MavResult.ACCEPTED
    assert client.last(m.MessageInterval).message_id == m.Attitude.ID


def test_requested_message_follows_acknowledgement() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID) == MavResult.ACCEPTED
    assert [type(message) for _, message in client.received] == [m.CommandAck, m.SysStatus]
    assert client.command(MavCmd.REQUEST_MESSAGE, 12345) == MavResult.FAILED
    client.clear()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.DistanceSensor.ID) == MavResult.ACCEPTED
    assert client.all(m.DistanceSensor) == [], "accepted, but there is no sensor"


def test_available_modes_can_be_requested() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, 0) == MavResult.ACCEPTED
    modes = client.all(m.AvailableModes)
    assert [mode.mode_index for mode in modes] == list(range(1, len(modes) + 1))
    assert {mode.number_modes for mode in modes} == {len(modes)}
    assert {(mode.custom_mode, mode.mode_name) for mode in modes} >= {(4, "GUIDED"), (6, "RTL"), (9, "LAND")}
    client.clear()
    client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, 2)
    client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, -1)
    assert [mode.mode_index for mode in client.all(m.AvailableModes)] == [2]
    client.run(11.0)
    assert len(client.all(m.AvailableModesMonitor)) >= 2
    assert copter.requests is not None


def test_unsupported_commands_and_streams_can_be_configured() -> None:
    without = (MavCmd.SET_MESSAGE_INTERVAL, MavCmd.DO_SET_MODE)
    _, client = ready_copter(unsupported_commands=without)
    assert interval(client, m.Attitude.ID, 100_000) == MavResult.UNSUPPORTED
    assert client.command(MavCmd.DO_SET_MODE, 1, 4) == MavResult.UNSUPPORTED
    _, client = ready_copter(stream_groups=False)
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 4, 1))
    client.run(2.0)
    assert {type(message) for _, message in client.received} == {m.Heartbeat}


def test_range_finder_reports_height() -> None:
    _, client = flying_copter(rangefinder_reach_m=30.0)
    interval(client, m.DistanceSensor.ID, 100_000)
    interval(client, m.Rangefinder.ID, 100_000)
    client.run(1.0)
    assert client.last(m.DistanceSensor).current_distance == pytest.approx(1020, abs=5)
    assert client.last(m.Rangefinder).distance == pytest.approx(10.2, abs=0.05)


def test_telemetry_values_are_consistent_in_flight() -> None:
    copter, client = flying_copter()
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 10, 1))
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 3576, 100, 0, -10, 0, 0, 0, 0, 0, 0, 0, 0))
    client.run(5.0)
    position, local, hud = (
        client.last(m.GlobalPositionInt),
        client.last(m.LocalPositionNed),
        client.last(m.VfrHud),
    )
    assert position.relative_alt / 1000 == pytest.approx(-local.z, abs=0.01)
    assert position.vx / 100 == pytest.approx(local.vx, abs=0.01)
    assert hud.groundspeed == pytest.approx(local.vx, abs=0.01)
    assert hud.alt == pytest.approx(position.alt / 1000, abs=0.01)
    assert 30 < hud.throttle < 50
    assert client.last(m.NavControllerOutput).wp_dist == pytest.approx(100 - local.x, abs=1)
    battery, status = client.last(m.BatteryStatus), client.last(m.SysStatus)
    assert battery.voltages[0] == status.voltage_battery == pytest.approx(12200, abs=300)
    assert battery.voltages[1] == 65535
    assert 2500 < status.current_battery < 3500
    assert client.last(m.ServoOutputRaw).servo1_raw == pytest.approx(1600, abs=60)
    assert copter.battery.percent > 95


def test_gyro_calibration_takes_time_and_needs_disarmed() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 1) is None
    client.run(1.1)
    assert client.last(m.CommandAck).result == MavResult.ACCEPTED
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 1) == MavResult.ACCEPTED
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 1) == MavResult.FAILED
    assert client.texts[-1] == "Disarm to allow calibration"
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == MavResult.FAILED


def test_unknown_command_is_unsupported() -> None:
    _, client = ready_copter()
    assert client.command(31010) == MavResult.UNSUPPORTED
    assert client.command(MavCmd.DO_SET_REVERSE) == MavResult.UNSUPPORTED


def test_timesync_is_answered_and_ping_is_not() -> None:
    copter, client = ready_copter()
    client.send(m.Timesync(0, 123_456_789))
    answer = client.last(m.Timesync)
    assert answer.ts1 == 123_456_789
    assert answer.tc1 == pytest.approx(copter.uptime * 1e9)
    client.send(m.Timesync(5, 6))
    assert len(client.all(m.Timesync)) == 1, "an answer gets no reply"
    client.send(m.Ping(99, 7, 0, 0))
    assert client.all(m.Ping) == []


# -------------------------------------------------------------------------------------- parameters


def test_parameter_list_is_complete_and_ordered() -> None:
    copter, client = ready_copter()
    client.send(m.ParamRequestList(1, 1))
    client.run(1.0)
    values = client.all(m.ParamValue)
    assert [value.param_index for value in values] == list(range(len(copter.parameters)))
    assert {value.param_count for value in values} == {len(copter.parameters)}
    assert {value.param_id: value.param_value for value in values} == pytest.approx(
        {name: copter.parameters[name] for name in copter.parameters}
    )


def test_parameter_can_be_read_and_set() -> None:
    copter, client = ready_copter()
    client.send(m.ParamRequestRead(1, 1, "WPNAV_SPEED", -1))
    assert client.last(m.ParamValue).param_value == 1000.0
    client.run(0.05)
    client.send(m.ParamRequestRead(1, 1, "", 0))
    assert client.last(m.ParamValue).param_id == copter.parameters.names[0]
    client.send(m.ParamSet(1, 1, "WPNAV_SPEED", 525.0, 9))
    echo = client.last(m.ParamValue)
    assert (echo.param_id, echo.param_value, echo.param_index) == ("WPNAV_SPEED", 525.0, 0xFFFF)
    client.send(m.ParamSet(1, 1, "DISARM_DELAY", 300.7, 2))
    assert client.last(m.ParamValue).param_value == 127.0, "the limit of an INT8"


def test_unknown_parameter_gets_no_answer() -> None:
    _, client = ready_copter()
    client.send(m.ParamRequestRead(1, 1, "NO_SUCH_PARAM", -1))
    client.send(m.ParamRequestRead(1, 1, "", 9999))
    client.send(m.ParamSet(1, 1, "NO_SUCH_PARAM", 1.0, 9))
    client.send(m.ParamSet(1, 1, "WPNAV_SPEED", float("nan"), 9))
    assert client.received == []


def test_flight_parameter_takes_effect() -> None:
    copter, client = ready_copter(parameters={"WPNAV_SPEED_UP": 100})
    client.send(m.ParamSet(1, 1, "WPNAV_SPEED", 200.0, 9))
    client.command(MavCmd.DO_SET_MODE, 1, 4)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0)
    client.run(8.0)
    assert copter.motion.velocity_down == pytest.approx(-1.0, abs=0.05)
    client.run(15.0)
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 3576, 100, 0, -10, 0, 0, 0, 0, 0, 0, 0, 0))
    client.run(5.0)
    assert copter.motion.ground_speed_m_s == pytest.approx(2.0, abs=0.05)


def test_winch_restarted_within_step_keeps_its_rate() -> None:
    copter, client = ready_copter(parameters={"WINCH_TYPE": 1.0})
    for _ in range(3):
        client.command(MavCmd.DO_WINCH, 1, WinchActions.RATE_CONTROL, 0, 0.5)
        client.command(MavCmd.DO_WINCH, 1, WinchActions.RELAXED)
    client.command(MavCmd.DO_WINCH, 1, WinchActions.RATE_CONTROL, 0, 0.5)
    client.run(10.0)
    assert copter.devices.line_m == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(
    ("action", "length_m", "rate_m_s", "expected_m"),
    [
        (WinchActions.RELATIVE_LENGTH_CONTROL, 0.25, 0.0, 0.25),
        (WinchActions.RELATIVE_LENGTH_CONTROL, 0.0, 0.0, 0.0),
        (WinchActions.RELATIVE_LENGTH_CONTROL, math.nan, 0.0, 0.0),
        (WinchActions.RATE_CONTROL, 0.0, math.nan, 0.0),
    ],
)
def test_winch_stops_at_its_goal(action: int, length_m: float, rate_m_s: float, expected_m: float) -> None:
    copter, client = ready_copter(parameters={"WINCH_TYPE": 1.0})
    client.command(MavCmd.DO_WINCH, 1, action, length_m, rate_m_s)
    client.run(3.0)
    assert copter.devices.line_m == expected_m


def test_parachute_altitude_is_above_home() -> None:
    copter, client = flying_copter(20.0, parameters={"CHUTE_ENABLED": 1.0})
    north, east, down = copter.motion.place
    copter.navigation.set_home((north, east, down + 5.0), lock=True)
    assert client.command(MavCmd.DO_PARACHUTE, ParachuteAction.RELEASE) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts[-1] == "Parachute: Too low"
    assert copter.is_armed
