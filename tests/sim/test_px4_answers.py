"""Answers of the simulated PX4, compared with real firmware (v1.17-alpha)."""

from __future__ import annotations

import math
from collections import Counter

import pytest
from simulated_client import PX4_HOME, Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    MavCmd,
    MavFrame,
    MavResult,
    MavState,
    MavVtolState,
    SerialControlDev,
    SerialControlFlag,
)
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedPx4
from aerokit.sim.px4.telemetry import BUILDERS

NAN = math.nan
ARM = MavCmd.COMPONENT_ARM_DISARM
HOLD, ORBIT, PRECISION_LAND, TERMINATION = (4, 3), (3, 1), (4, 9), (10, 0)


def ready(**options: object) -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(fast_rate_hz=2.0, boot_time_s=1.0, parameter_count=100, home=PX4_HOME, **options)  # type: ignore[arg-type]
    client = Client(px4)
    client.run(2.0)
    client.clear()
    return px4, client


def flying() -> tuple[SimulatedPx4, Client]:
    px4, client = ready()
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 499.4)
    client.command(ARM, 1)
    client.run_until(lambda: px4.mode == HOLD, 40.0)
    client.clear()
    return px4, client


# ------------------------------------------------------------------------------------------ commands


@pytest.mark.parametrize(
    ("command", "param1", "result"),
    [
        (MavCmd.DO_SET_ROI_LOCATION, 0, MavResult.ACCEPTED),
        (MavCmd.DO_SET_ROI_NONE, 0, MavResult.ACCEPTED),
        (MavCmd.DO_LAND_START, 0, 6),
        (MavCmd.DO_GRIPPER, 0, MavResult.IN_PROGRESS),
        (MavCmd.DO_MOTOR_TEST, 0, MavResult.UNSUPPORTED),
        (MavCmd.CONTROL_HIGH_LATENCY, 0, MavResult.FAILED),
        (MavCmd.DO_FLIGHTTERMINATION, 1, MavResult.DENIED),
        (MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 0, MavResult.ACCEPTED),
        (MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 3, MavResult.DENIED),
        (MavCmd.DO_SET_STANDARD_MODE, 3, MavResult.FAILED),
        (MavCmd.DO_SET_STANDARD_MODE, 6, MavResult.ACCEPTED),
    ],
)
def test_results(command: int, param1: float, result: int) -> None:
    _, client = ready()
    assert client.command(command, param1) == result


@pytest.mark.parametrize(
    "command",
    [MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.SET_CAMERA_MODE, MavCmd.DO_WINCH, MavCmd.NAV_DELAY],
)
def test_commands_of_missing_modules_are_not_answered(command: int) -> None:
    _, client = ready()
    assert client.command(command) is None
    client.run(2.0)
    assert client.all(m.CommandAck) == []


def test_invalid_arm_param_sends_text_without_answer() -> None:
    _, client = ready()
    assert client.command(ARM, 2) is None
    assert client.texts == ["Unsupported ARM_DISARM param: 2.000\t"]


def test_some_modes_cannot_be_armed_in() -> None:
    _, client = ready()
    for main, sub in ((4, 5), (4, 6), (4, 8), (4, 4), (6, 0)):
        client.command(MavCmd.DO_SET_MODE, 1, main, sub)
        client.run(1.1)
        assert client.last(m.Heartbeat).system_status == MavState.UNINIT
        assert client.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    client.command(MavCmd.DO_SET_MODE, 1, *HOLD)
    client.run(1.1)
    assert client.last(m.Heartbeat).system_status == MavState.STANDBY
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_each_arming_after_the_first_starts_log() -> None:
    _, client = ready(unix_time_at_boot=1_790_000_000.0)
    for logs in (0, 1):
        client.clear()
        client.command(ARM, 1)
        assert sum(text.startswith("[logger] ./log/2026-09-21/14_13_2") for text in client.texts) == logs
        client.command(ARM, 0)


def test_orbit() -> None:
    px4, client = flying()
    there = px4.frame.to_global(0.0, 0.0, 0.0)
    place = (there.latitude_e7 / 1e7, there.longitude_e7 / 1e7, 501.4)
    client.command(MavCmd.DO_ORBIT, 1500, 4, 0, NAN, *place)
    assert (px4.mode, client.texts) == (HOLD, ["Orbit radius limit exceeded\t"])
    assert client.command(MavCmd.DO_ORBIT, 15, 4, 0, NAN, *place) == MavResult.ACCEPTED
    client.run(30.0)
    assert px4.mode == ORBIT
    assert math.hypot(px4.motion.north, px4.motion.east) == pytest.approx(15.0, abs=1.5)
    assert px4.motion.ground_speed_m_s == pytest.approx(4.0, abs=0.5)
    assert client.last(m.OrbitExecutionStatus).radius == 15.0
    assert client.last(m.Heartbeat).base_mode == 145


def test_reversed_transition_is_not_ended_by_first_timer() -> None:
    px4, client = flying()
    px4.vtol_state = MavVtolState.MC
    client.command(MavCmd.DO_VTOL_TRANSITION, MavVtolState.FW)
    client.run(2.0)
    client.command(MavCmd.DO_VTOL_TRANSITION, MavVtolState.MC)
    states = []
    for seconds in (3.0, 2.0):
        client.run(seconds)
        states.append(px4.vtol_state)
    assert states == [MavVtolState.TRANSITION_TO_MC, MavVtolState.MC]


def test_tuning_starts_again_after_disarming() -> None:
    px4, client = flying()
    client.command(MavCmd.DO_AUTOTUNE_ENABLE, 1)
    client.run(9.0)
    client.command(ARM, 0, 21196)
    client.run(5.0)
    client.command(ARM, 1)
    assert px4.is_armed
    client.command(MavCmd.DO_AUTOTUNE_ENABLE, 1)
    assert client.last(m.CommandAck).progress == 0


def test_shell_line_without_respond_is_forgotten() -> None:
    _, client = ready()
    for flags, data in ((0, b"reboot\n"), (SerialControlFlag.RESPOND, b"echo a\n")):
        client.send(m.SerialControl(SerialControlDev.DEV_SHELL, flags, 0, 0, len(data), data.ljust(70, b"\0")))
    reply = client.last(m.SerialControl)
    assert bytes(reply.data[: reply.count]) == b"echo a\na\npxh> "


def test_restarted_log_stream_sends_one_stream() -> None:
    _, client = ready()
    for command in (MavCmd.LOGGING_START, MavCmd.LOGGING_STOP, MavCmd.LOGGING_START):
        assert client.command(command) == MavResult.ACCEPTED
    client.run(1.0)
    assert len(client.all(m.LoggingDataAcked)) == pytest.approx(20, abs=1)


def test_precision_landing_lands() -> None:
    px4, client = flying()
    assert client.command(MavCmd.NAV_LAND_LOCAL) == MavResult.ACCEPTED
    assert px4.mode == PRECISION_LAND
    client.run_until(lambda: not px4.is_armed, 40.0)
    assert px4.mode == HOLD


def test_precision_landing_after_search_timeout_ignores_target() -> None:
    px4, client = flying()
    assert client.command(MavCmd.NAV_LAND_LOCAL) == MavResult.ACCEPTED
    client.run(px4.parameters["PLD_SRCH_TOUT"] + 1.0)
    east_before = px4.motion.east
    client.send(m.LandingTarget(0, 0, MavFrame.LOCAL_NED, 0.0, 0.0, 9.0, 0.0, 0.0, y=9.0, position_valid=1))
    client.run(2.0)
    assert px4.external.target == (0.0, 9.0)
    assert px4.motion.east == pytest.approx(east_before, abs=0.1)
    assert px4.motion.velocity_down > 0.0


def test_forced_disarm_during_take_off_allows_new_flight() -> None:
    px4, client = ready()
    client.command(MavCmd.DO_SET_MODE, 1, 4, 2)
    client.command(ARM, 1)
    client.run_until(lambda: not px4.is_landed, 10.0)
    client.command(ARM, 0, 21196)
    client.run(3.0)
    assert px4.is_landed
    client.clear()
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 492.4)
    client.command(ARM, 1)
    client.run(6.0)
    assert client.texts[-1] == "Takeoff detected\t"


def test_terminated_flight_falls() -> None:
    px4, client = flying()
    assert client.command(MavCmd.DO_FLIGHTTERMINATION, 1) == MavResult.ACCEPTED
    client.run(6.0)
    assert client.last(m.Heartbeat).system_status == MavState.FLIGHT_TERMINATION
    assert (px4.mode, px4.is_armed) == (TERMINATION, True)
    assert px4.altitude_m == pytest.approx(0.0)
    assert client.command(ARM, 0) == MavResult.TEMPORARILY_REJECTED
    client.command(MavCmd.DO_SET_MODE, 1, *HOLD)
    assert client.texts[-1] == "Switching to Hold is currently not available\t"


def test_take_off_below_current_altitude_does_not_descend() -> None:
    px4, client = flying()
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 493.4)
    assert client.texts == ["Already higher than takeoff altitude\t"]
    client.run(3.0)
    assert px4.altitude_m == pytest.approx(10.0, abs=0.6)


def test_manual_calibration_runs_until_cancelled() -> None:
    _, client = ready()
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 0, 1) == MavResult.ACCEPTED
    client.run(6.0)
    assert client.texts[0] == "[cal] calibration started: 2 mag"
    assert client.texts[-1] == "[cal] Rotate vehicle"
    assert client.last(m.Heartbeat).system_status == MavState.CALIBRATING
    assert client.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    assert client.texts[-1] == "Arming denied: calibrating\t"
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 1) == MavResult.TEMPORARILY_REJECTED
    assert client.texts[-1] == "command denied during calibration: 241\t"
    assert client.last(m.Heartbeat).system_status == MavState.CALIBRATING
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION) == MavResult.ACCEPTED
    assert client.texts[-1] == "[cal] calibration cancelled"
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_vtol_mission_is_rejected() -> None:
    px4, client = ready()
    px4.missions.replace(0, [MissionItem(MavCmd.NAV_VTOL_TAKEOFF, 3, x=473977432, y=85455939, z=10.0)])
    assert client.command(MavCmd.MISSION_START) == MavResult.DENIED
    assert "not a VTOL" in "".join(client.texts)


# -------------------------------------------------------------------------------------------- links


@pytest.mark.parametrize(
    ("mode", "attitude_hz", "status_hz", "imu_hz"),
    [("normal", 2, 1, 0), ("onboard", 100, 5, 50), ("config", 50, 1, 50), ("minimal", 10, 0.1, 0)],
)
def test_rates_depend_on_the_link_mode(mode: str, attitude_hz: float, status_hz: float, imu_hz: float) -> None:
    _, client = ready(link_modes=[mode])
    client.run(10.0)
    observed = Counter(type(message) for _, message in client.received)
    assert observed[m.Attitude] == pytest.approx(attitude_hz * 10, abs=2)
    assert observed[m.SysStatus] == pytest.approx(status_hz * 10, abs=1)
    assert observed[m.HighresImu] == pytest.approx(imu_hz * 10, abs=2)
    assert observed[m.Heartbeat] == observed[m.MissionCurrent] == 10


def test_origin_is_sent_once_on_each_link() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0, parameter_count=100)
    client = Client(px4)
    client.run(10.0)
    assert len(client.all(m.GpsGlobalOrigin)) == 1
    other = px4.open_channel()
    px4.step(client.now + 5.0)
    kinds = [frame.message_id for frame in client.framer.receive(other.take_outbox(), client.now)]
    assert kinds.count(m.GpsGlobalOrigin.ID) == 1
    assert interval(client, m.GpsGlobalOrigin.ID) == 1_000_000, "messages that are always sent"


def test_further_links_use_the_last_mode() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0, parameter_count=100, link_modes=("minimal", "onboard"))
    other = px4.open_channel()
    px4.step(0.0)
    px4.step(5.0)
    assert len(other.take_outbox()) > 10 * len(px4.take_outbox())
    with pytest.raises(ValueError, match="link_modes"):
        SimulatedPx4(link_modes=("fast",))


def interval(client: Client, message_id: int) -> int:
    client.command(MavCmd.GET_MESSAGE_INTERVAL, message_id)
    return client.last(m.MessageInterval).interval_us


def test_message_interval_reports_as_the_firmware() -> None:
    _, client = ready()
    assert interval(client, m.Heartbeat.ID) == 1_000_000
    assert interval(client, m.SysStatus.ID) == 1_000_000
    assert interval(client, m.HighresImu.ID) == -1
    assert interval(client, m.MissionCurrent.ID) == -1
    assert interval(client, 31_999) == -1
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.Heartbeat.ID, 1e6) == MavResult.FAILED
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.MissionCurrent.ID, 1e6) == MavResult.FAILED
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.HighresImu.ID, 1e5) == MavResult.ACCEPTED
    client.clear()
    client.run(2.0)
    assert len(client.all(m.HighresImu)) == pytest.approx(20, abs=1)
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.Attitude.ID, 0)
    assert interval(client, m.Attitude.ID) == 66_666, "the link's own rate, not the simulator's"
    client.command(MavCmd.REQUEST_MESSAGE, m.StorageInformation.ID)
    assert interval(client, m.StorageInformation.ID) == 0, "requested once"


def test_fastest_stream_is_sent_once_per_loop_of_px4() -> None:
    _, client = ready()
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.HighresImu.ID, 1) == MavResult.ACCEPTED
    client.clear()
    client.run(0.15)
    assert len(client.all(m.HighresImu)) == pytest.approx(100, abs=1)
    assert interval(client, m.HighresImu.ID) == 1


REQUESTED = (
    m.ScaledImu,
    m.ScaledPressure,
    m.ManualControl,
    m.Timesync,
    m.DistanceSensor,
    m.Odometry,
    m.StorageInformation,
    m.FlightInformation,
    m.MagCalReport,
    m.OpenDroneIdLocation,
    m.OpenDroneIdSystem,
    m.CurrentMode,
)


@pytest.mark.parametrize("kind", REQUESTED)
def test_messages_on_request(kind: type[m.Heartbeat]) -> None:
    _, client = ready()
    assert client.command(MavCmd.REQUEST_MESSAGE, kind.ID) == MavResult.ACCEPTED
    assert isinstance(client.received[0][1], kind)
    client.last(kind).encode()


def test_unavailable_messages_are_denied() -> None:
    _, client = ready()
    for kind in (m.MissionCurrent, m.ParamValue, m.GimbalManagerInformation, m.RcChannels):
        assert client.command(MavCmd.REQUEST_MESSAGE, kind.ID) == MavResult.DENIED


def test_available_modes_include_external_modes() -> None:
    _, client = ready()
    client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, 0)
    modes = client.all(m.AvailableModes)
    assert len(modes) == 26
    assert [mode.mode_name for mode in modes[-8:]] == ["(Mode not available)"] * 8
    assert {mode.standard_mode for mode in modes} == {0, 1, 2, 4, 5, 6, 7, 8}
    client.clear()
    for index in (99, -1):
        assert client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, index) == MavResult.DENIED
    assert client.all(m.AvailableModes) == []


def test_event_sequence_starts_before_the_overflow() -> None:
    px4, client = ready()
    assert px4.build(m.CurrentEventSequence.ID) == m.CurrentEventSequence(65525, 0)
    client.command(ARM, 1)
    assert px4.build(m.CurrentEventSequence.ID) == m.CurrentEventSequence(65526, 0)
    event = client.last(m.Event)
    assert (event.sequence, event.id, event.arguments[0]) == (65526, 26266355, 4)


def test_every_builder_creates_a_valid_message() -> None:
    px4, _ = ready()
    built = [message for message in map(px4.build, BUILDERS) if message is not None]
    assert len(built) > 30
    assert all(len(message.encode()) == message.LENGTH for message in built)


def test_messages_unknown_to_pymavlink_are_sent() -> None:
    px4, client = ready()
    client.command(MavCmd.REQUEST_MESSAGE, m.ComponentMetadata.ID)
    assert client.last(m.ComponentMetadata).uri == "mftp://etc/extras/component_general.json.xz"
    client.command(MavCmd.REQUEST_PROTOCOL_VERSION)
    assert client.last(m.ProtocolVersion).max_version == 203
    assert px4.build(m.TimeEstimateToTarget.ID) == m.TimeEstimateToTarget(-1, -1, -1, -1, -1)


# ------------------------------------------------------------------------- set-points, fence, rally


def setpoint(frame: int, mask: int) -> m.SetPositionTargetLocalNed:
    return m.SetPositionTargetLocalNed(0, 1, 1, frame, mask, 0, 0, -5, 0, 0, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (setpoint(7, 0b110111111000), "SET_POSITION_TARGET_LOCAL_NED coordinate frame 7 unsupported\t"),
        (setpoint(8, 0b110111111000), "SET_POSITION_TARGET_LOCAL_NED invalid\t"),
        (setpoint(1, 0b111111111111), "SET_POSITION_TARGET_LOCAL_NED invalid\t"),
        (
            m.SetPositionTargetGlobalInt(0, 1, 1, 3, 0b110111111000, 0, 0, 5.0, 0, 0, 0, 0, 0, 0, 0, 0),
            "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame 3\t",
        ),
    ],
)
def test_empty_setpoints_send_a_text(message: m.SetPositionTargetLocalNed, text: str) -> None:
    px4, client = ready()
    client.send(message)
    assert "".join(client.texts) == text
    assert not px4.offboard.is_fresh


def place(px4: SimulatedPx4, north: float, east: float) -> tuple[int, int]:
    there = px4.frame.to_global(north, east, 0.0)
    return there.latitude_e7, there.longitude_e7


def put(px4: SimulatedPx4, kind: int, command: int, north: float, east: float, up: float, param1: float = 0.0) -> None:
    x, y = place(px4, north, east)
    assert px4.missions.replace(kind, [MissionItem(command, 6, param1, x=x, y=y, z=up)]) == 0


def test_fence_that_excludes_home_is_ignored() -> None:
    px4, client = ready(parameters={"GF_ACTION": 2})
    put(px4, 1, MavCmd.NAV_FENCE_CIRCLE_INCLUSION, 200.0, 0.0, 0.0, 50.0)
    client.run(0.1)
    assert client.texts == ["Geofence invalid, doesn't contain Home position\t"]
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_mission_beyond_the_fence_is_rejected() -> None:
    px4, client = ready(parameters={"GF_ACTION": 2})
    put(px4, 1, MavCmd.NAV_FENCE_CIRCLE_INCLUSION, 0.0, 0.0, 0.0, 30.0)
    put(px4, 0, MavCmd.NAV_WAYPOINT, 60.0, 0.0, 10.0)
    client.run(0.1)
    assert client.texts == ["Geofence violation for waypoint 1\t"]
    assert client.command(MavCmd.MISSION_START) == MavResult.DENIED


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("kind", "north"), [(0, 30.0), (1, 30.0), (3, 30.0), (4, 0.0)])
def test_return_uses_nearest_rally_point(kind: int, north: float) -> None:
    px4, client = flying()
    px4.parameters["RTL_TYPE"] = kind
    put(px4, 2, MavCmd.NAV_RALLY_POINT, 30.0, 20.0, 15.0)
    x, y = place(px4, 40.0, 30.0)
    client.command(MavCmd.DO_REPOSITION, -1, 1, 0, NAN, x / 1e7, y / 1e7, 499.4)
    client.run(20.0)
    client.command(MavCmd.NAV_RETURN_TO_LAUNCH)
    above_sea = 534 if north else 519
    client.run(0.1)
    assert f"RTL: start return at {above_sea} m (30 m above destination)\t" in "".join(client.texts)
    client.run_until(lambda: not px4.is_armed, 150.0)
    assert px4.motion.north == pytest.approx(north, abs=1.0)


def test_return_to_rally_point_with_altitude_above_sea() -> None:
    px4, client = flying()
    px4.parameters["RTL_TYPE"] = 1
    x, y = place(px4, 30.0, 20.0)
    item = MissionItem(MavCmd.NAV_RALLY_POINT, MavFrame.GLOBAL_INT, x=x, y=y, z=504.4)
    assert px4.missions.replace(2, [item]) == MavResult.ACCEPTED
    client.command(MavCmd.NAV_RETURN_TO_LAUNCH)
    client.run(0.1)
    assert "RTL: start return at 534 m (30 m above destination)\t" in "".join(client.texts)


def test_mission_starts_at_the_item_in_param_1() -> None:
    px4, client = flying()
    places = [place(px4, north, 0.0) for north in (20.0, 40.0, 60.0)]
    items = [MissionItem(MavCmd.NAV_WAYPOINT, 6, x=x, y=y, z=10.0) for x, y in places]
    assert px4.missions.replace(0, items) == MavResult.ACCEPTED
    assert client.command(MavCmd.MISSION_START, 3) == MavResult.DENIED
    assert client.command(MavCmd.MISSION_START, 2) == MavResult.ACCEPTED
    assert px4.mission.current == 2
    client.run_until(lambda: px4.mission.is_finished, 60.0)
    assert client.command(MavCmd.MISSION_START, 1) == MavResult.ACCEPTED
    client.command(MavCmd.DO_SET_MODE, 1, *HOLD)
    assert client.command(MavCmd.MISSION_START, -1) == MavResult.ACCEPTED
    assert (px4.mission.current, px4.mission.is_finished) == (1, False)


@pytest.mark.parametrize(("down", "limited"), [(-9.0, -2.5), (9.0, 1.25)])
def test_offboard_limits_of_climb_and_descent(down: float, limited: float) -> None:
    px4, client = flying()
    px4.parameters.change({"MPC_Z_VEL_MAX_UP": 2.5, "MPC_Z_VEL_MAX_DN": 1.25, "MPC_Z_V_AUTO_UP": 4.0})
    for _ in range(12):
        client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0b110111000111, 0, 0, 0, 0, 0, down, *(0.0,) * 5))
        client.command(MavCmd.DO_SET_MODE, 1, 6)
        client.run(0.25)
    assert px4.motion.velocity_down == pytest.approx(limited, abs=0.05)
