"""Gimbal of a simulated PX4, compared with PX4 1.17 in simulation (MNT_MODE_IN 4, MNT_MODE_OUT 0)."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMountMode, MavResult
from aerokit.sim import SimulatedPx4
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler
from aerokit.sim.px4.modes import RTL

CONFIGURE, POINT = MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, MavCmd.DO_GIMBAL_MANAGER_PITCHYAW
NAN = math.nan
LEVEL, LOCKED, RETRACT, NEUTRAL = 12, 28, 1, 2
ACCEPTED, DENIED = MavResult.ACCEPTED, MavResult.DENIED


@pytest.fixture
def client() -> Client:
    px4 = SimulatedPx4(boot_time_s=1.0, parameters={"MNT_MODE_IN": 4.0})
    connected = Client(px4)
    connected.run(3.0)
    connected.clear()
    return connected


@pytest.fixture
def claimed(client: Client) -> Client:
    assert client.command(CONFIGURE, 255, 190, -1, -1) == ACCEPTED
    return client


def gimbal(client: Client) -> SimulatedPx4:
    assert isinstance(client.vehicle, SimulatedPx4)
    return client.vehicle


def angles(client: Client) -> list[float]:
    client.run(0.3)
    reported = client.last(m.GimbalDeviceAttitudeStatus)
    return [round(math.degrees(angle), 1) for angle in euler_from_quaternion(*reported.q)]


def test_commands_without_gimbal_are_not_answered() -> None:
    connected = Client(SimulatedPx4(boot_time_s=1.0))
    connected.run(3.0)
    assert connected.command(POINT, -10, 0, NAN, NAN, LEVEL) is None
    assert connected.command(CONFIGURE, 255, 190) is None
    assert connected.command(MavCmd.DO_MOUNT_CONTROL, 0, 0, 0, 0, 0, 0, 2) is None
    assert connected.command(MavCmd.REQUEST_MESSAGE, m.GimbalManagerInformation.ID) == DENIED
    assert connected.all(m.GimbalDeviceAttitudeStatus) == []


def test_messages_are_streamed_and_sent_on_request(client: Client) -> None:
    client.run(4.0)
    assert len(client.all(m.GimbalDeviceAttitudeStatus)) == pytest.approx(20, abs=2)
    assert len(client.all(m.GimbalManagerStatus)) == pytest.approx(2, abs=1)
    assert client.command(MavCmd.REQUEST_MESSAGE, m.GimbalManagerInformation.ID) == ACCEPTED
    reported = client.last(m.GimbalManagerInformation)
    assert (reported.gimbal_device_id, reported.cap_flags) == (1, 132530)
    assert math.degrees(reported.pitch_min) == pytest.approx(-45)


def test_commands_without_control_are_denied(client: Client) -> None:
    assert client.command(POINT, -30, 0, NAN, NAN, LEVEL) == DENIED
    assert client.command(CONFIGURE, -2, -2, -1, -1) == ACCEPTED
    assert gimbal(client).gimbal.in_control == (1, 1), "PX4 itself sends the request"
    assert client.command(POINT, -30, 0, NAN, NAN, LEVEL) == DENIED
    assert client.command(CONFIGURE, -3, -3, -1, -1) == ACCEPTED
    assert gimbal(client).gimbal.in_control == (1, 1), "control of another station is not released"
    assert client.command(CONFIGURE, 255, 190, 7, 7) == ACCEPTED
    assert client.command(POINT, -30, 20, NAN, NAN, LEVEL) == ACCEPTED
    assert angles(client) == [0, -30, 20]
    client.command(MavCmd.REQUEST_MESSAGE, m.GimbalManagerStatus.ID)
    reported = client.last(m.GimbalManagerStatus)
    assert (reported.primary_control_sysid, reported.secondary_control_sysid) == (255, 0)
    assert client.command(CONFIGURE, -3, -3, -1, -1) == ACCEPTED
    assert gimbal(client).gimbal.in_control == (0, 0)


def test_frames_neutral_and_retracted(claimed: Client) -> None:
    assert claimed.command(POINT, -30, 90, NAN, NAN, LOCKED) == ACCEPTED
    assert angles(claimed) == [0, -30, 90]
    assert claimed.last(m.GimbalDeviceAttitudeStatus).flags == LOCKED
    assert claimed.command(POINT, NAN, NAN, NAN, NAN, RETRACT) == ACCEPTED
    assert angles(claimed) == [0, -30, 90], "accepted without effect"
    assert claimed.command(POINT, NAN, NAN, NAN, NAN, NEUTRAL) == ACCEPTED
    assert angles(claimed) == [0, 0, 0]
    assert claimed.last(m.GimbalDeviceAttitudeStatus).flags == 32
    assert claimed.command(POINT, -80, 0, NAN, NAN, LEVEL) == ACCEPTED
    assert angles(claimed) == [0, -45, 0]


def test_rates_are_slow_and_time_out(claimed: Client) -> None:
    nothing = (NAN,) * 4
    rates = (0.0, math.radians(-100), math.radians(200))
    claimed.send(m.GimbalManagerSetPitchyaw(1, 1, LEVEL, 0, NAN, NAN, -1.0, 1.0))
    claimed.run(1.0)
    assert angles(claimed) == [0, 0, 0]
    claimed.send(m.GimbalManagerSetAttitude(1, 1, LEVEL, 0, nothing, *rates))
    claimed.run(2.5)
    turned = angles(claimed)
    assert turned[1:] == pytest.approx([-11.7, 23.5], abs=1.0)
    claimed.run(5.0)
    assert angles(claimed) == pytest.approx(turned, abs=0.5)
    q = quaternion_from_euler(0.0, math.radians(-20), 0.0)
    claimed.send(m.GimbalManagerSetAttitude(1, 1, LEVEL, 0, q, NAN, NAN, NAN))
    assert angles(claimed) == [0, -20, 0]


def test_region_of_interest_needs_no_control(client: Client) -> None:
    px4 = gimbal(client)
    there = px4.frame.to_global(0.0, 50.0, 0.0)
    roi = MavCmd.DO_SET_ROI_LOCATION
    x, y = there.latitude_e7, there.longitude_e7
    assert client.command_int(roi, MavFrame.GLOBAL_INT, x=x, y=y, z=there.altitude_m) == ACCEPTED
    assert angles(client) == pytest.approx([0, 0, 90], abs=0.5)
    assert client.command_int(roi, MavFrame.GLOBAL_INT, x=x, y=y, z=there.altitude_m + 500.0) == ACCEPTED
    assert angles(client) == pytest.approx([0, 45, 90], abs=0.5)
    assert client.command(MavCmd.DO_SET_ROI_NONE) == ACCEPTED
    assert angles(client) == [0, 0, 0]


def test_mount_command_needs_no_control(client: Client) -> None:
    mount = MavCmd.DO_MOUNT_CONTROL
    assert client.command(mount, -20, 5, 340, 0, 0, 0, MavMountMode.MAVLINK_TARGETING) == ACCEPTED
    assert angles(client) == [5, -20, -20]
    assert client.command(mount, 0, 0, 0, 0, 0, 0, MavMountMode.NEUTRAL) == ACCEPTED
    assert angles(client) == [0, 0, 0]
    assert client.command(mount, 0, 0, 0, 0, 0, 0, MavMountMode.RC_TARGETING) == ACCEPTED


def test_return_resets_angles_and_control(claimed: Client) -> None:
    px4 = gimbal(claimed)
    claimed.command(POINT, -30, 0, NAN, NAN, LEVEL)
    px4.change_mode(RTL)
    claimed.run(1.0)
    assert px4.gimbal.in_control == (0, 0)
    assert angles(claimed) == [0, 0, 0]
    assert claimed.command(POINT, -30, 0, NAN, NAN, LEVEL) == DENIED
    claimed.command(CONFIGURE, 255, 190)
    claimed.run(1.0)
    assert claimed.command(POINT, -30, 0, NAN, NAN, LEVEL) == ACCEPTED


def test_reboot_resets_control(claimed: Client) -> None:
    gimbal(claimed).restart()
    claimed.run(5.0)
    assert gimbal(claimed).gimbal.in_control == (0, 0)
