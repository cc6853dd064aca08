"""Guided set-points of Plane, Rover and Sub: frames, masks and time-outs."""

from __future__ import annotations

import math
from typing import Any

import pytest
from simulated_client import Client, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import AttitudeTargetTypemask as Attitude
from aerokit.mavlink.enums import HeadingType, MavCmd, MavFrame, MavResult, PlaneMode, RoverMode, SubMode
from aerokit.mavlink.enums import PositionTargetTypemask as Mask
from aerokit.sim.kinds import simulated
from aerokit.sim.motion import quaternion_from_euler

POS = Mask.X_IGNORE | Mask.Y_IGNORE | Mask.Z_IGNORE
VEL = Mask.VX_IGNORE | Mask.VY_IGNORE | Mask.VZ_IGNORE
ACC = Mask.AX_IGNORE | Mask.AY_IGNORE | Mask.AZ_IGNORE
YAW, RATE = Mask.YAW_IGNORE, Mask.YAW_RATE_IGNORE
RATES = Attitude.BODY_ROLL_RATE_IGNORE | Attitude.BODY_PITCH_RATE_IGNORE | Attitude.BODY_YAW_RATE_IGNORE
LEVEL = (0.0, 0.0, 0.0)
ACCEPTED, DENIED, FAILED = MavResult.ACCEPTED, MavResult.DENIED, MavResult.FAILED


def guided(kind: str, mode: int) -> tuple[Any, Client]:
    """Return an armed vehicle in GUIDED that points north."""
    vehicle: Any = simulated(kind, boot_time_s=0.0, heading_deg=0.0)
    client = Client(vehicle)
    client.run(3.0)
    if kind == "plane":
        assert set_mode(client, PlaneMode.TAKEOFF) == 0
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == 0
    if kind == "plane":
        client.run_until(lambda: vehicle.altitude_m > 48.0)
    assert set_mode(client, mode) == 0
    client.run(0.2)
    client.clear()
    return vehicle, client


def local(
    frame: int, mask: int, place: Any = LEVEL, velocity: Any = LEVEL, yaw: float = 0.0, rate: float = 0.0
) -> m.SetPositionTargetLocalNed:
    (x, y, z), (vx, vy, vz) = place, velocity
    return m.SetPositionTargetLocalNed(0, 1, 1, frame, mask, x, y, z, vx, vy, vz, 0, 0, 0, yaw, rate)


def attitude(mask: int, angles: Any = LEVEL, rate: float = 0.0, thrust: float = 0.5) -> m.SetAttitudeTarget:
    q = quaternion_from_euler(*map(math.radians, angles))
    return m.SetAttitudeTarget(0, 1, 1, mask, q, 0, 0, rate, thrust)


def keep(client: Client, message: Any, seconds: float) -> None:
    for _ in range(round(seconds / 0.5)):
        client.send(message)
        client.run(0.5)


@pytest.mark.parametrize(("kind", "mode"), [("rover", RoverMode.GUIDED), ("sub", SubMode.GUIDED)])
def test_setpoints_work_after_reboot(kind: str, mode: int) -> None:
    """The reboot makes new mode objects. The handlers of the set-points must use the new ones."""
    vehicle, client = guided(kind, mode)
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 0) == 0
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == 0
    client.run(10.0)
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == 0
    assert set_mode(client, mode) == 0
    keep(client, local(MavFrame.LOCAL_NED, POS | ACC | YAW | RATE, velocity=(1.0, 0.0, 0.0)), 5.0)
    assert vehicle.motion.north > 1.0


# ----------------------------------------------------------------------------------------- rover


def rover() -> tuple[Any, Client]:
    return guided("rover", RoverMode.GUIDED)


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (MavFrame.LOCAL_NED, (10.0, 0.0)),
        (MavFrame.LOCAL_OFFSET_NED, (15.0, 0.0)),
        (MavFrame.BODY_OFFSET_NED, (5.0, 10.0)),
    ],
)
def test_rover_position_target_works_in_each_frame(frame: int, expected: tuple[float, float]) -> None:
    vehicle, client = rover()
    vehicle.motion.north, vehicle.motion.yaw = 5.0, math.pi / 2
    client.send(local(frame, VEL | ACC | YAW | RATE, (10.0, 0.0, 0.0)))
    client.run(15.0)
    assert (vehicle.motion.north, vehicle.motion.east) == pytest.approx(expected, abs=1.0)
    assert client.all(m.MissionItemReached)


def test_rover_velocity_target_expires_after_three_seconds() -> None:
    vehicle, client = rover()
    keep(client, local(MavFrame.LOCAL_NED, POS | ACC | YAW | RATE, velocity=(1.0, 0.0, 0.0)), 4.0)
    assert vehicle.motion.velocity_north == pytest.approx(1.0, abs=0.1)
    client.run(2.0)
    assert not client.texts
    client.run(3.0)
    assert client.texts == ["target not received last 3secs, stopping"]
    assert vehicle.motion.ground_speed_m_s < 0.1


def test_rover_backward_velocity_reverses_only_with_heading() -> None:
    vehicle, client = rover()
    keep(client, local(MavFrame.BODY_NED, POS | ACC | RATE, velocity=(-1.0, 0.0, 0.0)), 4.0)
    assert vehicle.motion.speed_m_s == pytest.approx(-1.0, abs=0.1)
    assert abs(vehicle.motion.yaw) < 0.1
    keep(client, local(MavFrame.LOCAL_NED, POS | ACC | YAW | RATE, velocity=(-1.0, 0.0, 0.0)), 8.0)
    assert abs(vehicle.motion.yaw) > 3.0
    assert vehicle.motion.speed_m_s > 0.5


def test_rover_velocity_target_is_limited_to_waypoint_speed() -> None:
    vehicle, client = rover()
    keep(client, local(MavFrame.LOCAL_NED, POS | ACC | YAW | RATE, velocity=(50.0, 0.0, 0.0)), 12.0)
    limit = vehicle.parameters["WP_SPEED"] or vehicle.parameters["CRUISE_SPEED"]
    assert vehicle.motion.speed_m_s == pytest.approx(limit, rel=0.05)


def test_rover_acceleration_target_is_refused() -> None:
    vehicle, client = rover()
    client.send(local(MavFrame.LOCAL_NED, POS | YAW | RATE, velocity=(1.0, 0.0, 0.0)))
    client.run(1.0)
    assert "".join(client.texts) == "Ignoring SET_POSITION_TARGET_LOCAL_NED; set ACC_IGNORE in mask"
    assert vehicle.motion.ground_speed_m_s == 0.0


def test_rover_attitude_target_sets_heading_and_speed() -> None:
    vehicle, client = rover()
    keep(client, attitude(RATES, (0.0, 0.0, 45.0), thrust=0.4), 6.0)
    limit = vehicle.parameters["WP_SPEED"] or vehicle.parameters["CRUISE_SPEED"]
    assert math.degrees(vehicle.motion.yaw) == pytest.approx(45.0, abs=3.0)
    assert vehicle.motion.speed_m_s == pytest.approx(0.4 * limit, rel=0.1)
    before = vehicle.motion.yaw
    keep(client, attitude(RATES & ~Attitude.BODY_YAW_RATE_IGNORE, rate=0.2, thrust=0.4), 3.0)
    assert vehicle.motion.yaw - before == pytest.approx(0.6, abs=0.2)
    keep(client, attitude(RATES | Attitude.THROTTLE_IGNORE, thrust=1.0), 5.0)
    assert "target not received last 3secs, stopping" in client.texts


# ------------------------------------------------------------------------------------- submarine


def sub() -> tuple[Any, Client]:
    return guided("sub", SubMode.GUIDED)


def test_sub_position_target_sets_place_and_depth() -> None:
    vehicle, client = sub()
    client.send(local(MavFrame.LOCAL_NED, VEL | ACC | YAW | RATE, (3.0, 0.0, 4.0)))
    client.run(20.0)
    place = (vehicle.motion.north, vehicle.motion.east, vehicle.motion.down)
    assert place == pytest.approx((3.0, 0.0, 4.0), abs=0.5)


def test_sub_yaw_is_relative_in_one_frame_only() -> None:
    vehicle, client = sub()
    vehicle.motion.yaw = 1.0
    keep(client, local(MavFrame.BODY_NED, POS | ACC | RATE, velocity=(0.3, 0.0, 0.2), yaw=0.5), 4.0)
    assert vehicle.motion.yaw == pytest.approx(0.5, abs=0.05)
    client.send(local(MavFrame.BODY_OFFSET_NED, POS | ACC | RATE, velocity=(0.3, 0.0, 0.0), yaw=0.5))
    client.run(2.5)
    assert vehicle.motion.yaw == pytest.approx(1.0, abs=0.05)


def test_sub_acceleration_target_is_ignored_silently() -> None:
    vehicle, client = sub()
    client.send(local(MavFrame.LOCAL_NED, VEL | YAW | RATE, (3.0, 0.0, 4.0)))
    client.run(5.0)
    assert not client.texts
    assert abs(vehicle.motion.north) < 0.2


def test_sub_thrust_is_climb_rate_for_one_second() -> None:
    vehicle, client = sub()
    keep(client, attitude(RATES, (0.0, 0.0, 90.0), thrust=0.0), 4.0)
    assert vehicle.motion.velocity_down > 0.3
    assert math.degrees(vehicle.motion.yaw) == pytest.approx(90.0, abs=5.0)
    client.run(2.5)
    assert vehicle.motion.velocity_down == pytest.approx(0.0, abs=0.1)


# ------------------------------------------------------------------------------------- aeroplane


def plane() -> tuple[Any, Client]:
    return guided("plane", PlaneMode.GUIDED)


def test_plane_position_target_changes_altitude_only() -> None:
    vehicle, client = plane()
    start = vehicle.altitude_m
    client.send(local(MavFrame.LOCAL_OFFSET_NED, 0, (500.0, 500.0, -20.0)))
    client.run(10.0)
    assert client.texts[0].startswith("Change alt to ")
    assert float(client.texts[0].split()[-1]) == pytest.approx(start + 20.0, abs=2.0)
    assert vehicle.altitude_m == pytest.approx(start + 20.0, abs=3.0)
    middle = vehicle.guided.destination
    client.send(local(MavFrame.LOCAL_NED, 0, (0.0, 0.0, -200.0)))
    only_height = 0xFFF & ~Mask.Z_IGNORE
    place = m.SetPositionTargetGlobalInt(0, 1, 1, 6, only_height, 474_000_000, 85_000_000, 60.0, *[0.0] * 8)
    client.send(place)
    client.run(12.0)
    assert vehicle.altitude_m == pytest.approx(60.0, abs=3.0)
    assert vehicle.guided.destination[:2] == middle[:2]
    client.send(m.SetPositionTargetGlobalInt(0, 1, 1, 99, 0, 0, 0, 60.0, *[0.0] * 8))
    client.run(0.2)
    assert "Unknown mavlink coordinate frame 99" in client.texts


def test_plane_attitude_target_expires_after_three_seconds() -> None:
    vehicle, client = plane()
    assert client.command(MavCmd.GUIDED_CHANGE_HEADING, HeadingType.COURSE_OVER_GROUND, 0.0) == 0
    keep(client, attitude(RATES, (25.0, 5.0, 0.0), thrust=0.6), 3.0)
    assert math.degrees(vehicle.motion.roll) == pytest.approx(25.0, abs=3.0)
    assert vehicle.motion.velocity_down < -0.5
    client.run(1.0)
    assert math.degrees(vehicle.motion.roll) == pytest.approx(25.0, abs=3.0)
    client.run(12.0)
    assert abs(math.degrees(vehicle.motion.roll)) < 5.0


def test_plane_nan_thrust_is_half_throttle() -> None:
    vehicle, client = plane()
    keep(client, attitude(RATES, LEVEL, thrust=math.nan), 20.0)
    assert vehicle.wing.airspeed_m_s == pytest.approx(vehicle.cruise_m_s, abs=0.5)


def test_plane_guided_commands_change_course_speed_altitude() -> None:
    vehicle, client = plane()
    assert client.command(MavCmd.GUIDED_CHANGE_HEADING, 0, 90, 2) == ACCEPTED
    assert client.command(MavCmd.GUIDED_CHANGE_SPEED, 0, 15, 0) == ACCEPTED
    client.run(25.0)
    course = math.degrees(math.atan2(vehicle.motion.velocity_east, vehicle.motion.velocity_north))
    assert course == pytest.approx(90.0, abs=3.0)
    assert vehicle.motion.ground_speed_m_s == pytest.approx(15.0, abs=1.0)
    assert client.command_int(MavCmd.GUIDED_CHANGE_ALTITUDE, 6, 0, 0, 2, z=80.0) == ACCEPTED
    client.run(3.0)
    assert vehicle.motion.velocity_down == pytest.approx(-2.0, abs=0.2)
    client.run(20.0)
    assert vehicle.altitude_m == pytest.approx(80.0, abs=3.0)
    assert client.command(MavCmd.GUIDED_CHANGE_HEADING, 2, 0) == ACCEPTED
    client.run(15.0)
    assert vehicle.motion.velocity_east < 0.0  # back to where it circled


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (MavCmd.GUIDED_CHANGE_SPEED, (0, 200), FAILED),
        (MavCmd.GUIDED_CHANGE_SPEED, (1, 15), DENIED),
        (MavCmd.GUIDED_CHANGE_ALTITUDE, (0, 0, 0, 0, 0, 0, 0), DENIED),
        (MavCmd.GUIDED_CHANGE_HEADING, (1, 400), DENIED),
        (MavCmd.GUIDED_CHANGE_HEADING, (5, 40), DENIED),
        (MavCmd.DO_CHANGE_ALTITUDE, (80, 6), ACCEPTED),
        (MavCmd.DO_CHANGE_ALTITUDE, (80, 99), DENIED),
    ],
)
def test_plane_invalid_guided_commands_are_refused(command: int, params: tuple[float, ...], result: int) -> None:
    _, client = plane()
    assert client.command(command, *params) == result
