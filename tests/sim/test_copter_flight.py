"""Flights in simulated time; durations are compared with the recorded flight of a real ArduCopter."""

from __future__ import annotations

import math
from typing import Any

import pytest
from simulated_client import Client, flying_copter, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavFrame,
    MavLandedState,
    MavResult,
    MavState,
    PositionTargetTypemask,
)
from aerokit.sim import SimulatedCopter

T = PositionTargetTypemask
POSITION = T.VX_IGNORE | T.VY_IGNORE | T.VZ_IGNORE | T.AX_IGNORE | T.AY_IGNORE | T.AZ_IGNORE
VELOCITY = T.X_IGNORE | T.Y_IGNORE | T.Z_IGNORE | T.AX_IGNORE | T.AY_IGNORE | T.AZ_IGNORE
ACCELERATION = T.X_IGNORE | T.Y_IGNORE | T.Z_IGNORE | T.VX_IGNORE | T.VY_IGNORE | T.VZ_IGNORE
NO_YAW = T.YAW_IGNORE | T.YAW_RATE_IGNORE
RELATIVE = MavFrame.GLOBAL_RELATIVE_ALT_INT


def local_target(
    client: Client,
    mask: int,
    position: tuple[float, float, float] = (0, 0, 0),
    velocity: tuple[float, float, float] = (0, 0, 0),
    acceleration: tuple[float, float, float] = (0, 0, 0),
    *,
    yaw: float = 0.0,
    rate: float = 0.0,
    frame: int = MavFrame.LOCAL_NED,
) -> None:
    values = (*position, *velocity, *acceleration)
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, frame, mask, *values, yaw, rate))


def speed(copter: SimulatedCopter) -> tuple[float, float, float]:
    motion = copter.motion
    return (motion.velocity_north, motion.velocity_east, motion.velocity_down)


def place(copter: SimulatedCopter) -> tuple[float, float, float]:
    return (copter.motion.north, copter.motion.east, copter.motion.down)


# ---------------------------------------------------------------------------------------- take-off


def test_take_off_duration_matches_recording() -> None:
    copter, client = ready_copter()
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.run(0.4)
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0) == MavResult.ACCEPTED
    lifted = client.run_until(lambda: not copter.is_landed)
    assert lifted == pytest.approx(3.0, abs=0.4)
    risen = client.run_until(lambda: copter.altitude_m > 9.9)
    assert lifted + risen == pytest.approx(10.1, rel=0.15)
    client.run(10.0)
    assert copter.altitude_m == pytest.approx(10.0, abs=0.05)


def test_disarming_during_take_off_falls_and_lands() -> None:
    copter, client = ready_copter()
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0)
    client.run_until(lambda: copter.altitude_m > 3.0)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 0, 21196)
    client.run(4.0)
    assert copter.motion.is_on_ground
    assert copter.is_landed


def test_landed_state_passes_takeoff_to_in_air() -> None:
    copter, client = ready_copter()
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.ExtendedSysState.ID, 100_000)
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 5.0)
    client.run(20.0)
    set_mode(client, CopterMode.LAND)
    client.run(25.0)
    states = [message.landed_state for message in client.all(m.ExtendedSysState)]
    assert list(dict.fromkeys(states)) == [
        MavLandedState.ON_GROUND,
        MavLandedState.TAKEOFF,
        MavLandedState.IN_AIR,
        MavLandedState.LANDING,
    ]
    assert states[-1] == MavLandedState.ON_GROUND
    assert not copter.is_armed


@pytest.mark.parametrize(("armed", "altitude"), [(False, 10.0), (True, 0.0), (True, -5.0)])
def test_take_off_with_invalid_request_is_refused(armed: bool, altitude: float) -> None:
    _, client = ready_copter()
    set_mode(client, CopterMode.GUIDED)
    if armed:
        client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude) == MavResult.FAILED


def test_take_off_needs_capable_mode_and_ground() -> None:
    _, client = ready_copter()
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0) == MavResult.FAILED
    set_mode(client, CopterMode.ALT_HOLD)
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10.0) == MavResult.FAILED
    _, client = flying_copter()
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 20.0) == MavResult.FAILED
    assert client.command_int(MavCmd.NAV_TAKEOFF, MavFrame.GLOBAL, z=20.0) == MavResult.DENIED


# ----------------------------------------------------------------------------------------- targets


def test_flight_duration_over_fifty_metres_matches_recording() -> None:
    copter, client = flying_copter()
    client.send(
        m.SetPositionTargetGlobalInt(
            0, 1, 1, RELATIVE, POSITION | NO_YAW, -353628118, 1491652300, 10, 0, 0, 0, 0, 0, 0, 0, 0
        )
    )
    took = client.run_until(lambda: copter.motion.north > 49.5)
    assert took == pytest.approx(9.7, rel=0.15)
    client.run(5.0)
    assert copter.motion.north == pytest.approx(50.0, abs=0.1)
    assert abs(copter.motion.yaw) < 0.05, "points in the direction of flight"
    client.command(MavCmd.REQUEST_MESSAGE, m.PositionTargetGlobalInt.ID)
    target = client.last(m.PositionTargetGlobalInt)
    assert target.lat_int == -353628118
    assert target.alt == pytest.approx(594.09, abs=0.02)
    assert target.type_mask == 65016


def test_reposition_is_supported_as_command_int_only() -> None:
    copter, client = flying_copter()
    north = copter.navigation.frame.to_global(30.0, 0.0, 0.0)
    x, y = north.latitude_e7, north.longitude_e7
    assert client.command(MavCmd.DO_REPOSITION, -1, 1, 0, 0, x * 1e-7, y * 1e-7, 15) == MavResult.UNSUPPORTED
    assert client.command_int(MavCmd.DO_REPOSITION, RELATIVE, -1, 0, x=x, y=y, z=15.0) == MavResult.ACCEPTED
    client.run(15.0)
    assert place(copter) == pytest.approx((30.0, 0.0, -15.0), abs=0.2)
    set_mode(client, CopterMode.BRAKE)
    assert client.command_int(MavCmd.DO_REPOSITION, RELATIVE, -1, 0, x=x, y=y, z=20.0) == MavResult.DENIED
    assert client.command_int(MavCmd.DO_REPOSITION, RELATIVE, -1, 1, x=x, y=y, z=20.0) == MavResult.ACCEPTED
    assert copter.mode.number == CopterMode.GUIDED
    bad = client.command_int(MavCmd.DO_REPOSITION, MavFrame.BODY_FRD, -1, 1, x=x, y=y, z=20.0)
    assert bad == MavResult.DENIED


def test_position_target_works_in_all_local_frames() -> None:
    copter, client = flying_copter()
    local_target(client, POSITION | NO_YAW, (10, 5, -12))
    client.run(15.0)
    assert place(copter) == pytest.approx((10, 5, -12), abs=0.1)
    local_target(client, POSITION | NO_YAW, (-10, 0, 2), frame=MavFrame.LOCAL_OFFSET_NED)
    client.run(15.0)
    assert place(copter) == pytest.approx((0, 5, -10), abs=0.2)
    heading = copter.motion.yaw
    local_target(client, POSITION | NO_YAW, (10, 0, 0), frame=MavFrame.BODY_OFFSET_NED)
    client.run(15.0)
    wanted = (10 * math.cos(heading), 5 + 10 * math.sin(heading), -10)
    assert place(copter) == pytest.approx(wanted, abs=0.3)


def test_velocity_target_expires_after_three_seconds() -> None:
    copter, client = flying_copter()
    for _ in range(8):
        local_target(client, VELOCITY | NO_YAW, velocity=(3.0, -2.0, -0.5))
        client.run(0.5)
    assert speed(copter) == pytest.approx((3.0, -2.0, -0.5), abs=0.1)
    client.run(2.0)
    assert speed(copter) == pytest.approx((3.0, -2.0, -0.5), abs=0.1)
    client.run(4.0)
    assert speed(copter) == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_body_velocity_target_is_relative_to_heading() -> None:
    copter, client = flying_copter(heading_deg=90.0)
    local_target(client, VELOCITY | T.YAW_IGNORE, velocity=(4.0, 0.0, 0.0), frame=MavFrame.BODY_NED)
    client.run(2.5)
    assert speed(copter) == pytest.approx((0.0, 4.0, 0.0), abs=0.1)


def test_acceleration_target_accelerates_and_expires() -> None:
    copter, client = flying_copter()
    local_target(client, ACCELERATION | NO_YAW, acceleration=(1.0, 0.0, 0.0))
    client.run(2.0)
    assert speed(copter)[0] == pytest.approx(2.0, abs=0.1)
    client.run(6.0)
    assert speed(copter)[0] == pytest.approx(0.0, abs=0.05)


def test_position_velocity_target_tracks_moving_target() -> None:
    copter, client = flying_copter()
    for step in range(40):
        time = step * 0.25
        local_target(client, NO_YAW, (2.0 * time, 0.0, -10.0), (2.0, 0.0, 0.0))
        client.run(0.25)
    assert copter.motion.north == pytest.approx(20.0, abs=1.0)
    assert speed(copter)[0] == pytest.approx(2.0, abs=0.2)


def test_attitude_target_leans_climbs_and_expires() -> None:
    copter, client = flying_copter()
    pitch = math.radians(-10)
    q = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    client.send(m.SetAttitudeTarget(0, 1, 1, 0b111, q, 0, 0, 0, 0.75))
    client.run(2.0)
    assert math.degrees(copter.motion.pitch) == pytest.approx(-10, abs=1)
    assert speed(copter)[2] == pytest.approx(-1.25, abs=0.05)
    client.run(6.0)
    assert speed(copter)[2] == pytest.approx(0.0, abs=0.05)
    assert abs(math.degrees(copter.motion.pitch)) < 3


def test_invalid_setpoint_stops_copter() -> None:
    copter, client = flying_copter()
    local_target(client, VELOCITY | NO_YAW, velocity=(5.0, 0.0, 0.0))
    client.run(2.0)
    local_target(client, VELOCITY | NO_YAW, velocity=(math.nan, 0.0, 0.0))
    client.run(4.0)
    assert speed(copter) == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_setpoints_are_ignored_on_ground_and_outside_guided() -> None:
    copter, client = ready_copter()
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    local_target(client, POSITION | NO_YAW, (0, 0, -10))
    client.run(5.0)
    assert copter.altitude_m == 0.0
    copter, client = flying_copter()
    set_mode(client, CopterMode.BRAKE)
    local_target(client, POSITION | NO_YAW, (50, 0, -10))
    client.run(5.0)
    assert copter.motion.north == pytest.approx(0.0, abs=0.1)


# --------------------------------------------------------------------------- speed, heading, pause


def test_change_speed_is_valid_for_present_kind_of_target() -> None:
    copter, client = flying_copter()
    local_target(client, POSITION | NO_YAW, (200, 0, -10))
    assert client.command(MavCmd.DO_CHANGE_SPEED, 1, 3.0) == MavResult.ACCEPTED
    client.run(10.0)
    assert speed(copter)[0] == pytest.approx(3.0, abs=0.05)
    local_target(client, POSITION | NO_YAW, (400, 0, -10))
    client.run(5.0)
    assert speed(copter)[0] == pytest.approx(3.0, abs=0.05)
    assert client.command(MavCmd.DO_CHANGE_SPEED, 1, 0.0) == MavResult.DENIED
    set_mode(client, CopterMode.LAND)
    assert client.command(MavCmd.DO_CHANGE_SPEED, 1, 3.0) == MavResult.FAILED


def test_heading_follows_condition_yaw_and_region_of_interest() -> None:
    copter, client = flying_copter(heading_deg=0.0)
    assert client.command(MavCmd.CONDITION_YAW, 90, 0, 1, 0) == MavResult.ACCEPTED
    local_target(client, VELOCITY | T.YAW_IGNORE | T.YAW_RATE_IGNORE)  # resets it, as in the firmware
    assert client.command(MavCmd.CONDITION_YAW, 90, 0, 1, 0) == MavResult.ACCEPTED
    client.run(6.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(90, abs=1)
    assert client.command(MavCmd.CONDITION_YAW, 45, 0, -1, 1) == MavResult.ACCEPTED
    client.run(6.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(45, abs=1)
    assert client.command(MavCmd.CONDITION_YAW, 400, 0, 1, 0) == MavResult.FAILED
    south = copter.navigation.frame.to_global(-100.0, 0.0, 0.0)
    x, y = south.latitude_e7, south.longitude_e7
    assert client.command_int(MavCmd.DO_SET_ROI_LOCATION, RELATIVE, x=x, y=y) == MavResult.ACCEPTED
    client.run(8.0)
    assert abs(math.degrees(copter.motion.yaw)) == pytest.approx(180, abs=1)
    assert client.command(MavCmd.DO_SET_ROI_NONE) == MavResult.ACCEPTED


def test_condition_yaw_direction_can_turn_long_way() -> None:
    copter, client = flying_copter(heading_deg=0.0)
    local_target(client, VELOCITY | NO_YAW)
    client.command(MavCmd.CONDITION_YAW, 90, 30, -1, 0)
    client.run(1.0)
    assert copter.motion.yaw_rate < -0.3
    client.run(15.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(90, abs=1)


@pytest.mark.parametrize("direction", [-1, 0, 1])
def test_condition_yaw_rate_applies_until_the_heading(direction: int) -> None:
    copter, client = flying_copter(heading_deg=0.0)
    client.command(MavCmd.CONDITION_YAW, 120, 20, direction, 0)
    client.run(3.0 if direction >= 0 else 9.0)  # After 9 s of turning the long way, less than 180° remain.
    assert abs(math.degrees(copter.motion.yaw_rate)) == pytest.approx(20, abs=0.1)


@pytest.mark.parametrize("rate", [-20, 0, math.nan])
def test_condition_yaw_without_positive_rate_uses_default(rate: float) -> None:
    copter, client = flying_copter(heading_deg=0.0)
    client.command(MavCmd.CONDITION_YAW, 120, rate, -1, 0)
    client.run(1.0)
    assert math.degrees(copter.motion.yaw_rate) == pytest.approx(-60, abs=0.1)


def test_relative_turn_over_180_degrees_keeps_direction() -> None:
    copter, client = flying_copter(heading_deg=0.0)
    client.command(MavCmd.CONDITION_YAW, 270, 30, 1, 1)
    client.run(1.0)
    assert copter.motion.yaw_rate > 0.3
    client.run(15.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(-90, abs=1)


def test_condition_yaw_without_direction_is_accepted() -> None:
    _, client = flying_copter()
    assert client.command(MavCmd.CONDITION_YAW, 90, 0, math.nan, 0) == MavResult.ACCEPTED


def test_attitude_target_with_nan_thrust_holds_altitude() -> None:
    copter, client = flying_copter()
    for _ in range(20):
        client.send(m.SetAttitudeTarget(0, 1, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, math.nan))
        client.run(0.1)
    assert copter.motion.velocity_down == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"angle_x": math.atan(0.3), "angle_y": math.atan(-0.3), "distance": 12.0}, math.pi / 4),
        ({"x": 3.0, "y": 3.0, "z": 10.0, "distance": 11.0, "position_valid": 1}, math.pi / 4),
        ({"x": 3.0, "y": 3.0, "z": 10.0, "distance": 0.0, "position_valid": 1}, None),
    ],
)
def test_landing_target_needs_angles_or_position_with_distance(fields: dict[str, Any], expected: float | None) -> None:
    copter, client = flying_copter(10.0, heading_deg=0.0, parameters={"PLND_ENABLED": 1.0, "PLND_TYPE": 1.0})
    values = {"angle_x": 0.0, "angle_y": 0.0, "size_x": 0.0, "size_y": 0.0, **fields}
    client.send(m.LandingTarget(0, 0, MavFrame.BODY_FRD, **values))
    north, east = copter.external.velocity_to_target()
    bearing = math.atan2(east, north) if (north, east) != (0.0, 0.0) else None
    assert bearing == (expected if expected is None else pytest.approx(expected, abs=0.01))


def test_yaw_rate_target_turns_and_expires() -> None:
    copter, client = flying_copter()
    local_target(client, VELOCITY | T.YAW_IGNORE, rate=0.5)
    client.run(2.0)
    assert copter.motion.yaw_rate == pytest.approx(0.5)
    client.run(3.0)
    assert copter.motion.yaw_rate == 0.0


def test_pause_and_continue_stop_and_resume_flight() -> None:
    copter, client = flying_copter()
    local_target(client, POSITION | NO_YAW, (100, 0, -10))
    client.run(4.0)
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 0) == MavResult.ACCEPTED
    client.run(6.0)
    paused = copter.motion.north
    assert paused < 60
    client.run(5.0)
    assert copter.motion.north == pytest.approx(paused, abs=0.1)
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 1) == MavResult.ACCEPTED
    client.run(20.0)
    assert copter.motion.north == pytest.approx(100, abs=0.2)
    set_mode(client, CopterMode.BRAKE)
    assert client.command(MavCmd.DO_PAUSE_CONTINUE, 0) == MavResult.FAILED
    assert client.texts[-1] == "Failed to pause"


# -------------------------------------------------------------------------------------- coming home


def test_rtl_phases_match_recording() -> None:
    copter, client = flying_copter()
    local_target(client, POSITION | NO_YAW, (50, 0, -10))
    client.run(15.0)
    heading = copter.motion.yaw
    assert client.command(MavCmd.NAV_RETURN_TO_LAUNCH) == MavResult.ACCEPTED
    highest = 0.0

    def has_hit_the_ground() -> bool:
        nonlocal highest
        highest = max(highest, copter.altitude_m)
        return any("SIM Hit ground" in text for text in client.texts)

    assert client.run_until(has_hit_the_ground) == pytest.approx(46.3, rel=0.15)
    assert highest == pytest.approx(15.0, abs=0.1)
    assert copter.motion.yaw == pytest.approx(heading, abs=0.05), "keeps its heading on the way home"
    assert client.run_until(lambda: not copter.is_armed) == pytest.approx(2.1, abs=0.3)
    assert math.hypot(copter.motion.north, copter.motion.east) < 0.5
    assert client.texts[-1] == "Disarming motors"
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.STANDBY


def test_smart_rtl_returns_and_land_lands_in_place() -> None:
    copter, client = flying_copter()
    local_target(client, POSITION | NO_YAW, (0, 30, -8))
    client.run(10.0)
    assert set_mode(client, CopterMode.SMART_RTL) == MavResult.ACCEPTED
    client.run(1.0)
    assert client.last(m.Heartbeat).custom_mode == CopterMode.SMART_RTL
    assert client.command(MavCmd.NAV_LAND) == MavResult.ACCEPTED
    client.run_until(lambda: not copter.is_armed)
    assert copter.altitude_m == 0.0


def test_home_set_by_command_is_kept_at_arming() -> None:
    copter, client = ready_copter()
    spot = copter.navigation.frame.to_global(20.0, -10.0, 0.0)
    x, y = spot.latitude_e7, spot.longitude_e7
    assert client.command_int(MavCmd.DO_SET_HOME, MavFrame.GLOBAL, 0, x=x, y=y, z=584.09) == MavResult.ACCEPTED
    assert client.last(m.HomePosition).latitude == x
    set_mode(client, CopterMode.GUIDED)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    assert copter.navigation.home == pytest.approx((20.0, -10.0, 0.0), abs=0.02)
    assert client.command(MavCmd.DO_SET_HOME, 1) == MavResult.ACCEPTED
    assert copter.navigation.home == pytest.approx((0.0, 0.0, 0.0))


# ------------------------------------------------------------------------------------- other modes


def test_brake_holds_position_and_loiter_follows_throttle() -> None:
    copter, client = flying_copter(20.0)
    local_target(client, VELOCITY | NO_YAW, velocity=(5.0, 0.0, 0.0))
    client.run(3.0)
    set_mode(client, CopterMode.BRAKE)
    client.run(5.0)
    assert speed(copter) == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    client.send(m.RcChannelsOverride(1, 1, 0xFFFF, 0xFFFF, 1500, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF))
    set_mode(client, CopterMode.LOITER)
    client.run(2.5)  # an override holds for 3 s
    assert copter.altitude_m == pytest.approx(20.0, abs=0.2)
    client.send(m.RcChannelsOverride(1, 1, 1500, 1250, 0, 1500, 0, 0, 0, 0))  # forward, throttle released
    client.run(3.0)
    assert copter.motion.ground_speed_m_s > 3.0
    assert speed(copter)[2] > 1.0, "the override's end leaves the throttle low, so it descends"


def test_stabilize_with_low_throttle_descends() -> None:
    copter, client = flying_copter(20.0)
    set_mode(client, CopterMode.STABILIZE)
    client.run(10.0)
    assert copter.is_landed
    client.run_until(lambda: not copter.is_armed, 15.0)


def test_unavailable_modes_are_refused_with_text() -> None:
    copter, client = ready_copter()
    assert set_mode(client, 99) == MavResult.FAILED
    assert client.texts[-1] == "No such mode 99"
    assert client.command(MavCmd.DO_SET_MODE, 0, 4) == MavResult.DENIED
    copter.faults.gps_lost = True
    client.run(11.0)
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    assert copter.is_armed
    assert set_mode(client, CopterMode.GUIDED) == MavResult.FAILED
    assert client.texts[-1] == "Mode change to GUIDED failed: requires position"
    assert client.command(MavCmd.MISSION_START) == MavResult.FAILED


def test_set_mode_message_changes_mode_without_acknowledgement() -> None:
    copter, client = ready_copter()
    client.send(m.SetMode(1, 1, CopterMode.GUIDED))
    assert copter.mode.number == CopterMode.GUIDED
    assert client.all(m.CommandAck) == []
    assert client.last(m.Heartbeat).custom_mode == CopterMode.GUIDED, "broadcast at once"


# --------------------------------------------------------------------------------------- failsafes


def test_gps_loss_in_flight_changes_to_land() -> None:
    copter, client = flying_copter()
    copter.faults.gps_lost = True
    client.run(12.0)
    assert copter.mode.number == CopterMode.LAND
    assert "EKF Failsafe: changed to LAND Mode" in client.texts
    client.run(1.0)
    assert client.last(m.Heartbeat).system_status == MavState.CRITICAL


def test_ground_station_failsafe_is_off_by_default() -> None:
    copter, client = flying_copter()
    client.send(m.Heartbeat(6, 8, 0, 0, 4))
    client.run(8.0)
    assert copter.mode.number == CopterMode.GUIDED
    copter.parameters["FS_GCS_ENABLE"] = 1
    client.send(m.Heartbeat(6, 8, 0, 0, 4))
    client.run(4.5)
    assert copter.mode.number == CopterMode.GUIDED
    client.run(1.0)
    assert copter.mode.number == CopterMode.RTL
    assert "GCS Failsafe" in client.texts
    client.send(m.Heartbeat(6, 8, 0, 0, 4))
    client.run(0.2)
    assert client.texts[-1] == "GCS Failsafe Cleared"


def test_low_battery_in_flight_warns_and_acts() -> None:
    copter, client = flying_copter(battery_percent=100.0, parameters={"BATT_FS_LOW_ACT": 2})
    before = copter.battery.percent
    client.run(10.0)
    assert 1.0 < before - copter.battery.percent < 4.0
    copter.battery.percent = 8.0
    client.run(12.0)
    assert any(text.startswith("Battery 1 is low") for text in client.texts)
    assert copter.mode.number == CopterMode.RTL


def test_failed_motor_crashes_copter() -> None:
    copter, client = flying_copter(20.0)
    copter.faults.motor_failed = True
    client.run(4.0)
    assert copter.altitude_m == 0.0
    assert any("SIM Hit ground" in text for text in client.texts)


def test_flight_termination_stops_motors() -> None:
    copter, client = flying_copter(5.0)
    assert client.command(MavCmd.DO_FLIGHTTERMINATION, 0) == MavResult.FAILED
    assert client.command(MavCmd.DO_FLIGHTTERMINATION, 1) == MavResult.ACCEPTED
    assert not copter.is_armed


def test_misspelled_fault_raises() -> None:
    copter = SimulatedCopter()
    with pytest.raises(AttributeError, match="no fault 'gps_lots'; faults: gps_lost"):
        copter.faults.gps_lots = True  # type: ignore[attr-defined]
