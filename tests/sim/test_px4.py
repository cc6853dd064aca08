"""The simulated PX4 behaves as real firmware (v1.16.1, v1.17-alpha) was observed to."""

from __future__ import annotations

import math
import struct
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_client import PX4_HOME, Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavLandedState, MavParamType, MavResult, MavState
from aerokit.mavlink.enums import PositionTargetTypemask as T
from aerokit.sim import SimulatedPx4

HOLD, TAKEOFF, RTL, LAND, OFFBOARD, POSITION = (
    0x03040000,
    0x02040000,
    0x05040000,
    0x06040000,
    0x00060000,
    0x00030000,
)
ARM = MavCmd.COMPONENT_ARM_DISARM
VELOCITY = T.X_IGNORE | T.Y_IGNORE | T.Z_IGNORE | T.AX_IGNORE | T.AY_IGNORE | T.AZ_IGNORE | T.YAW_IGNORE
POSITION_ONLY = T.VX_IGNORE | T.VY_IGNORE | T.VZ_IGNORE | T.AX_IGNORE | T.AY_IGNORE | T.AZ_IGNORE
NAN = math.nan


def ready_px4(**options: object) -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(fast_rate_hz=5.0, home=PX4_HOME, **options)  # type: ignore[arg-type]
    client = Client(px4)
    client.run(5.0)
    client.clear()
    return px4, client


def flying_px4(altitude_m: float = 10.0, **options: object) -> tuple[SimulatedPx4, Client]:
    px4, client = ready_px4(**options)
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 489.4 + altitude_m) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    client.run_until(lambda: px4.mode == (4, 3), 40.0)
    client.run(5.0)
    client.clear()
    return px4, client


def set_mode(client: Client, main: int, sub: int = 0) -> list[int]:
    """Return both answers."""
    client.clear()
    client.command(MavCmd.DO_SET_MODE, 1, main, sub)
    return [ack.result for ack in client.all(m.CommandAck)]


def mode(client: Client) -> int:
    client.run(1.1)
    return client.last(m.Heartbeat).custom_mode


def stream_velocity(client: Client, seconds: float, velocity: tuple[float, float, float]) -> None:
    for _ in range(round(seconds / 0.2)):
        client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, VELOCITY, 0, 0, 0, *velocity, 0, 0, 0, 0, 0))
        client.run(0.2)


# -------------------------------------------------------------------------------------------- boot


def test_default_streams_are_sent() -> None:
    client = Client(SimulatedPx4(home=PX4_HOME))
    client.run(30.0)
    kinds = Counter(message.NAME for _, message in client.received)
    assert kinds["ATTITUDE"] == pytest.approx(30 * 50, rel=0.05)
    assert kinds["HEARTBEAT"] == pytest.approx(30, abs=1)
    assert kinds["GPS_RAW_INT"] == pytest.approx(150, abs=5)
    assert kinds["HOME_POSITION"] == pytest.approx(14, abs=2)
    assert kinds["ESTIMATOR_STATUS"] == pytest.approx(15, abs=1)
    assert {
        "VFR_HUD",
        "SYS_STATUS",
        "BATTERY_STATUS",
        "ALTITUDE",
        "EXTENDED_SYS_STATE",
        "CURRENT_MODE",
    } < kinds.keys()
    assert client.last(m.Ping).target_system == 0
    assert client.last(m.MissionCurrent).total == 65535


def test_boot_states_flags_and_health_as_recorded() -> None:
    client = Client(SimulatedPx4(home=PX4_HOME))
    client.run(8.0)
    assert list(dict.fromkeys(b.system_status for b in client.all(m.Heartbeat))) == [
        MavState.UNINIT,
        MavState.STANDBY,
    ]
    assert {b.base_mode for b in client.all(m.Heartbeat)} == {29}
    assert client.last(m.Heartbeat).custom_mode == HOLD
    assert list(dict.fromkeys(s.flags for s in client.all(m.EstimatorStatus))) == [229, 1023]
    assert hex(client.all(m.SysStatus)[0].onboard_control_sensors_health) == "0x320883f"
    assert hex(client.last(m.SysStatus).onboard_control_sensors_health) == "0x1320c83f"
    assert client.texts[0] == "Preflight Fail: heading estimate invalid"


def test_arming_during_boot_fails_without_text() -> None:
    client = Client(SimulatedPx4(home=PX4_HOME))
    client.run(0.5)
    assert client.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    client.run(0.2)
    assert client.texts == []


# ------------------------------------------------------------------------------------ arm, take off


def test_arming_denial_sends_texts_after_acknowledgement() -> None:
    px4, client = ready_px4()
    px4.faults.prearm_failures = ["Compass 0 fault"]
    assert client.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    assert client.texts == [
        "Arming denied: Resolve system health failures first\t"[:50],
        "Arming denied: Resolve system health failures first\t"[50:],
        "Preflight Fail: Compass 0 fault",
    ]
    assert type(client.received[0][1]) is m.CommandAck
    assert client.command(ARM, 1, 21196.0) == MavResult.TEMPORARILY_REJECTED, "external commands are always checked"


def test_take_off_has_duration_of_the_real_one() -> None:
    px4, client = ready_px4()
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 499.4) == MavResult.ACCEPTED
    client.run(3.0)
    assert px4.is_landed
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    took = client.run_until(lambda: px4.mode == (4, 3))
    assert took == pytest.approx(12.6, rel=0.25)
    client.run(5.0)
    assert px4.altitude_m == pytest.approx(10.0, abs=0.05)
    assert client.texts == ["Armed by external command\t", "Takeoff detected\t"]
    states = [state.landed_state for state in client.all(m.ExtendedSysState)]
    assert list(dict.fromkeys(states)) == [
        MavLandedState.ON_GROUND,
        MavLandedState.TAKEOFF,
        MavLandedState.IN_AIR,
    ]
    modes = [beat.custom_mode for beat in client.all(m.Heartbeat)]
    assert list(dict.fromkeys(modes)) == [TAKEOFF, HOLD]
    assert client.last(m.EstimatorStatus).flags == 895


def test_take_off_without_an_altitude_uses_the_parameter() -> None:
    px4, client = ready_px4()
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, NAN)
    client.command(ARM, 1)
    client.run(20.0)
    assert px4.altitude_m == pytest.approx(2.5, abs=0.1)


def test_idle_armed_vehicle_is_disarmed() -> None:
    px4, client = ready_px4()
    client.command(ARM, 1)
    assert client.run_until(lambda: not px4.is_armed) == pytest.approx(10.0, abs=0.2)
    assert client.texts[-1] == "Disarmed by auto preflight disarming\t"


def test_disarming_in_flight_is_refused_with_text() -> None:
    px4, client = flying_px4()
    assert client.command(ARM, 0) == MavResult.TEMPORARILY_REJECTED
    assert client.texts == ["Disarming denied: not landed\t"]
    assert client.command(ARM, 0, 21196.0) == MavResult.ACCEPTED
    client.run(5.0)
    assert px4.is_landed


# ------------------------------------------------------------------------------------------- modes


def test_mode_change_is_acknowledged_twice() -> None:
    _, client = flying_px4()
    assert set_mode(client, 4, 6) == [MavResult.ACCEPTED, MavResult.ACCEPTED]
    assert client.all(m.Heartbeat) == []
    assert mode(client) == LAND
    _, client = ready_px4()
    assert set_mode(client, 99) == [MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED]
    _, client = ready_px4(version="1.16.1")
    assert set_mode(client, 99) == [MavResult.ACCEPTED, MavResult.ACCEPTED]
    assert mode(client) == HOLD


def test_set_mode_message_is_acknowledged_once() -> None:
    _, client = ready_px4()
    client.send(m.SetMode(1, 1, TAKEOFF))
    assert [ack.result for ack in client.all(m.CommandAck)] == [MavResult.ACCEPTED]
    assert mode(client) == TAKEOFF


def test_modes_without_requirements_are_refused_in_flight() -> None:
    _, client = flying_px4()
    assert set_mode(client, 6) == [MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED], "no set-points"
    assert set_mode(client, 4, 4) == [MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED], "no mission"
    assert set_mode(client, 3) == [MavResult.ACCEPTED, MavResult.TEMPORARILY_REJECTED], "no sticks"
    assert mode(client) == HOLD


def test_reposition_holds_at_an_amsl_altitude() -> None:
    px4, client = flying_px4()
    there = px4.frame.to_global(20.0, 10.0, 0.0)
    x, y = there.latitude_e7, there.longitude_e7
    assert client.command_int(MavCmd.DO_REPOSITION, 5, -1, 1, 0, NAN, x=x, y=y, z=504.4) == MavResult.ACCEPTED
    client.run(20.0)
    assert (px4.motion.north, px4.motion.east) == pytest.approx((20.0, 10.0), abs=0.1)
    assert px4.altitude_m == pytest.approx(15.0, abs=0.1)
    held = client.command_int(MavCmd.DO_REPOSITION, 5, -1, 1, 0, NAN, x=0x7FFFFFFF, y=0x7FFFFFFF, z=NAN)
    assert held == MavResult.ACCEPTED
    client.run(5.0)
    assert (px4.motion.north, px4.motion.east) == pytest.approx((20.0, 10.0), abs=0.1)
    assert client.command(MavCmd.DO_REPOSITION, -1, 0) == MavResult.UNSUPPORTED


def test_hold_stops_without_flying_back() -> None:
    px4, client = flying_px4()
    stream_velocity(client, 1.0, (0.0, 0.0, 0.0))
    set_mode(client, 6)
    stream_velocity(client, 5.0, (6.0, 0.0, 0.0))
    assert px4.motion.velocity_north > 5.0
    set_mode(client, 4, 3)
    speeds = []
    for _ in range(80):
        client.run(0.1)
        speeds.append(px4.motion.velocity_north)
    assert min(speeds) > -0.05
    assert speeds[-1] < 0.1


def test_return_climbs_lands_and_disarms_at_home() -> None:
    px4, client = flying_px4()
    there = px4.frame.to_global(34.0, 23.0, 0.0)
    client.command(MavCmd.DO_REPOSITION, -1, 1, 0, NAN, there.latitude_e7 / 1e7, there.longitude_e7 / 1e7, 502.4)
    client.run(20.0)
    client.clear()
    assert client.command(MavCmd.NAV_RETURN_TO_LAUNCH) == MavResult.ACCEPTED
    highest = 0.0

    def is_disarmed() -> bool:
        nonlocal highest
        highest = max(highest, px4.altitude_m)
        return not px4.is_armed

    assert client.run_until(is_disarmed) == pytest.approx(54.0, rel=0.2)
    assert highest == pytest.approx(30.0, abs=0.3)
    text = "".join(client.texts)
    assert "RTL: start return at 519 m (30 m above destination)\t" in text
    assert text.endswith("RTL: land at destination\tLanding detected\tDisarmed by landing\t")
    assert math.hypot(px4.motion.north, px4.motion.east) < 0.6
    assert mode(client) == HOLD
    own = client.all(m.CommandLong)
    assert [(c.target_system, c.target_component, c.command) for c in own] == [(1, 0, MavCmd.NAV_RETURN_TO_LAUNCH)]


def test_disarming_after_landing_can_be_turned_off() -> None:
    px4, client = flying_px4(5.0)
    px4.parameters["COM_DISARM_LAND"] = 0.0
    client.command(MavCmd.NAV_LAND)
    client.run_until(lambda: px4.is_landed, 30.0)
    client.run(20.0)
    assert px4.is_armed


def test_landing() -> None:
    px4, client = flying_px4(5.0)
    assert client.command(MavCmd.NAV_LAND) == MavResult.ACCEPTED
    assert client.texts == ["Landing at current position\t"]
    client.run_until(lambda: not px4.is_armed, 30.0)
    assert px4.altitude_m == pytest.approx(0.0)


# ---------------------------------------------------------------------------------------- offboard


def test_offboard_flies_streamed_velocities() -> None:
    px4, client = flying_px4()
    stream_velocity(client, 1.0, (0.0, 0.0, 0.0))
    assert set_mode(client, 6) == [MavResult.ACCEPTED, MavResult.ACCEPTED]
    stream_velocity(client, 5.0, (3.0, -1.0, -0.5))
    motion = px4.motion
    assert (motion.velocity_north, motion.velocity_east, motion.velocity_down) == pytest.approx((3, -1, -0.5), abs=0.1)
    assert client.last(m.Heartbeat).custom_mode == OFFBOARD


def test_offboard_positions_in_local_and_global_frames() -> None:
    px4, client = flying_px4()
    target = m.SetPositionTargetLocalNed(0, 1, 1, 1, POSITION_ONLY, 15, -5, -12, 0, 0, 0, 0, 0, 0, 1.0, 0)
    for _ in range(60):
        client.send(target)
        client.run(0.25)
        if px4.mode != (6, 0):
            set_mode(client, 6)
    assert (px4.motion.north, px4.motion.east, px4.motion.down) == pytest.approx((15, -5, -12), abs=0.1)
    assert px4.motion.yaw == pytest.approx(1.0, abs=0.02)
    there = px4.frame.to_global(0.0, 0.0, 0.0)
    place = (there.latitude_e7, there.longitude_e7, 20.0)
    frame = MavFrame.GLOBAL_RELATIVE_ALT_INT
    for _ in range(60):
        client.send(m.SetPositionTargetGlobalInt(0, 1, 1, frame, POSITION_ONLY, *place, *(0.0,) * 8))
        client.run(0.25)
    assert (px4.motion.north, px4.altitude_m) == pytest.approx((0.0, 20.0), abs=0.1)


def test_offboard_can_take_off() -> None:
    px4, client = ready_px4()
    target = m.SetPositionTargetLocalNed(0, 1, 1, 1, POSITION_ONLY, 0, 0, -5, *(0.0,) * 8)
    client.send(target)
    set_mode(client, 6)
    client.command(ARM, 1)
    for _ in range(60):
        client.send(target)
        client.run(0.25)
    assert px4.altitude_m == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(("version", "action"), [("1.16.1", POSITION), ("1.17.0-alpha", RTL)])
def test_lost_setpoints_trigger_the_failsafe(version: str, action: int) -> None:
    _, client = flying_px4(version=version)
    stream_velocity(client, 1.0, (1.0, 0.0, 0.0))
    set_mode(client, 6)
    stream_velocity(client, 2.0, (1.0, 0.0, 0.0))
    client.run(2.5)
    assert client.last(m.Heartbeat).custom_mode == action
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL
    assert "Failsafe activated\t" in client.texts


def test_offboard_resumes_with_new_setpoints() -> None:
    _, client = flying_px4()
    stream_velocity(client, 1.0, (1.0, 0.0, 0.0))
    set_mode(client, 6)
    client.run(2.0)
    assert client.last(m.Heartbeat).custom_mode == RTL
    stream_velocity(client, 2.0, (1.0, 0.0, 0.0))
    assert client.last(m.Heartbeat).custom_mode == OFFBOARD


def test_attitude_setpoints() -> None:
    px4, client = flying_px4()
    angle = math.radians(-8)
    q = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)
    for _ in range(12):
        client.send(m.SetAttitudeTarget(0, 1, 1, 0b111, q, 0, 0, 0, 0.5))
        client.run(0.25)
        if px4.mode != (6, 0):
            set_mode(client, 6)
    assert math.degrees(px4.motion.pitch) == pytest.approx(-8, abs=1)
    assert px4.motion.velocity_north > 1.5


# ------------------------------------------------------------------------------------ link protocol


def test_requested_message_precedes_its_acknowledgement() -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.AutopilotVersion.ID) == MavResult.ACCEPTED
    assert [type(message) for _, message in client.received] == [m.AutopilotVersion, m.CommandAck]
    version = client.last(m.AutopilotVersion)
    assert (version.flight_sw_version, version.capabilities) == (17891392, 0xE8FF)
    assert client.command(MavCmd.REQUEST_MESSAGE, 12345) == MavResult.DENIED
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, 12345, 1000) == MavResult.FAILED
    assert client.command(31010) == MavResult.UNSUPPORTED


def test_intervals_can_be_changed_and_reset() -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.VfrHud.ID, 100_000) == MavResult.ACCEPTED
    client.run(3.0)
    assert len(client.all(m.VfrHud)) == pytest.approx(30, abs=1)
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.VfrHud.ID, 0)
    client.command(MavCmd.GET_MESSAGE_INTERVAL, m.VfrHud.ID)
    assert client.last(m.MessageInterval).interval_us == 250_000


def test_standard_modes_have_no_name() -> None:
    _, client = ready_px4()
    client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, 0)
    modes = client.all(m.AvailableModes)
    assert len(modes) == modes[0].number_modes > 8
    assert all(bool(mode.mode_name) == (mode.standard_mode == 0) for mode in modes)


def test_calibration_texts() -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.PREFLIGHT_CALIBRATION, 1) == MavResult.ACCEPTED
    client.run(5.0)
    assert client.texts[:2] == ["[cal] calibration started: 2 gyro", "[cal] progress <0>"]
    assert client.texts[-1] == "[cal] calibration done: gyro"


def test_integer_parameters_are_encoded_bytewise() -> None:
    px4, client = ready_px4()
    client.send(m.ParamRequestList(1, 1))
    client.run(1.0)
    values = client.all(m.ParamValue)
    assert (values[0].param_id, values[0].param_index, values[0].param_type) == ("_HASH_CHECK", 65535, 5)
    assert [v.param_id for v in values[1:]] == sorted(px4.parameters.names)
    cells = next(v for v in values if v.param_id == "BAT1_N_CELLS")
    assert cells.param_type == MavParamType.INT32
    assert struct.unpack("<i", struct.pack("<f", cells.param_value)) == (4,)
    client.clear()
    bits = struct.unpack("<f", struct.pack("<i", 2))[0]
    client.send(m.ParamSet(1, 1, "COM_LOW_BAT_ACT", bits, MavParamType.INT32))
    assert px4.parameters["COM_LOW_BAT_ACT"] == 2
    client.run(0.1)
    assert len(client.all(m.ParamValue)) == 2, "echoed twice"
    client.send(m.ParamRequestRead(1, 1, "NO_SUCH_PARAM", -1))
    assert len(client.all(m.ParamValue)) == 2


def test_setting_the_hash_stops_the_list() -> None:
    px4, client = ready_px4()
    client.send(m.ParamRequestList(1, 1))
    client.send(m.ParamSet(1, 1, "_HASH_CHECK", 0.0, 5))
    client.run(1.0)
    assert 0 < len(client.all(m.ParamValue)) < len(px4.parameters)


def test_lost_gps_drops_the_position() -> None:
    px4, client = ready_px4()
    px4.faults.gps_lost = True
    client.run(3.0)
    assert client.last(m.GpsRawInt).fix_type < 3
    assert client.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    client.clear()
    client.run(2.0)
    assert client.all(m.GlobalPositionInt) == []


def test_home_set_by_hand_has_no_attitude() -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.DO_SET_HOME, 0, 0, 0, NAN, 47.3978, 8.5457, 490.0) == MavResult.ACCEPTED
    assert client.command(MavCmd.GET_HOME_POSITION) == MavResult.ACCEPTED
    home = client.last(m.HomePosition)
    assert home.latitude == pytest.approx(473978000, abs=20)
    assert math.isnan(home.q[0])


def test_reboot_resets_the_state() -> None:
    px4, client = ready_px4()
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == MavResult.ACCEPTED
    client.run(0.3)
    client.clear()
    client.run(1.2)
    assert client.received == []
    client.run(6.0)
    assert px4.is_ready
    assert client.all(m.Statustext)[0].id == 0


@pytest.mark.exhaustive
@given(
    command=st.sampled_from([int(c) for c in MavCmd]),
    numbers=st.tuples(*(st.floats(width=32),) * 7),
    flying=st.booleans(),
)
def test_any_command_is_answered(command: int, numbers: tuple[float, ...], flying: bool) -> None:
    _, client = flying_px4(3.0) if flying else ready_px4()
    client.command(command, *numbers)
    client.run(15.0)
    finals = [ack for ack in client.all(m.CommandAck) if ack.result != MavResult.IN_PROGRESS]
    at_most = 2 if command == MavCmd.DO_SET_MODE else 1  # A command for a module that does not run is not answered.
    assert at_most - 1 <= len(finals) <= at_most
    assert client.framer.statistics.bad_crcs == 0


@pytest.mark.exhaustive
@settings(max_examples=15)
@given(mask=st.integers(0, 0xFFF), frame=st.integers(0, 21), numbers=st.tuples(*(st.floats(width=32),) * 11))
def test_any_setpoint_is_handled(mask: int, frame: int, numbers: tuple[float, ...]) -> None:
    rates_and_thrust = numbers[4], numbers[5], numbers[6], numbers[7]
    px4, client = flying_px4(3.0)
    for _ in range(8):
        client.send(m.SetPositionTargetLocalNed(0, 1, 1, frame, mask, *numbers))
        client.send(m.SetAttitudeTarget(0, 1, 1, mask & 0xFF, numbers[:4], *rates_and_thrust))
        client.send(m.SetPositionTargetGlobalInt(0, 1, 1, frame, mask, 473_000_000, 85_000_000, *numbers[2:]))
        client.run(0.25)
        set_mode(client, 6)
    client.run(1.0)
    assert math.isfinite(px4.motion.north + px4.motion.down)
