"""Gimbal of a simulated ArduCopter, compared with ArduCopter 4.7 in simulation."""

from __future__ import annotations

import gc
import math
import weakref

import pytest
from simulated_client import Client, flying_copter, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavDataStream, MavFrame, MavMountMode, MavResult
from aerokit.sim import SimulatedCopter
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler

NAN = math.nan
RETRACT, NEUTRAL, LOCKED = 1, 2, 16
FOLLOWS, LOCKS = 0x2C, 0x3C
ACCEPTED, FAILED = MavResult.ACCEPTED, MavResult.FAILED
WITH_GIMBAL = {"MNT1_TYPE": 1.0}
HOME_E7 = (-353632610, 1491652299)


@pytest.fixture
def client() -> Client:
    """A client of a copter on the ground that faces east."""
    _, connected = ready_copter(parameters=WITH_GIMBAL, heading_deg=90.0)
    return connected


def status(client: Client) -> m.GimbalDeviceAttitudeStatus:
    client.clear()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.GimbalDeviceAttitudeStatus.ID) == ACCEPTED
    client.run(0.05)
    return client.last(m.GimbalDeviceAttitudeStatus)


def angles(client: Client) -> list[int]:
    """Return roll, pitch and yaw from the nose in whole degrees."""
    return [round(math.degrees(angle)) for angle in euler_from_quaternion(*status(client).q)]


def mount(client: Client, mode: int, pitch: float = 0, roll: float = 0, yaw: float = 0) -> int | None:
    return client.command(MavCmd.DO_MOUNT_CONTROL, pitch, roll, yaw, 0, 0, 0, mode)


def manage(client: Client, *params: float) -> int | None:
    return client.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, *params)


# ----------------------------------------------------------------------------------------- messages


def test_commands_without_gimbal_fail() -> None:
    _, client = ready_copter()
    assert mount(client, MavMountMode.RC_TARGETING) == FAILED
    assert manage(client, -45, 0, NAN, NAN) == FAILED
    assert client.command(MavCmd.DO_MOUNT_CONFIGURE, 3) == FAILED
    assert client.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190) == FAILED
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, 10, 1))
    client.run(1.0)
    assert client.all(m.GimbalDeviceAttitudeStatus) == []


def test_parameters_are_listed_with_the_gimbal() -> None:
    assert len(SimulatedCopter().parameters) == 1349
    assert len(SimulatedCopter(parameters=WITH_GIMBAL).parameters) == 1368
    small = SimulatedCopter(parameters=WITH_GIMBAL, parameter_count=80)
    assert small.gimbal.angles == (0, -35, 0)


def test_attitude_is_streamed_and_sent_on_request(client: Client) -> None:
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA3, 10, 1))
    client.run(1.0)
    assert len(client.all(m.GimbalDeviceAttitudeStatus)) >= 10
    reported = status(client)
    assert (reported.flags, reported.gimbal_device_id) == (FOLLOWS, 1)
    assert math.isnan(reported.delta_yaw)
    for kind in (m.GimbalManagerInformation, m.GimbalManagerStatus):
        assert client.command(MavCmd.REQUEST_MESSAGE, kind.ID) == ACCEPTED
    client.run(0.1)
    information = client.last(m.GimbalManagerInformation)
    assert math.degrees(information.pitch_min) == pytest.approx(-90.0)
    assert math.degrees(information.yaw_max) == pytest.approx(180.0)
    assert client.command(MavCmd.REQUEST_MESSAGE, m.GimbalDeviceInformation.ID) == FAILED


# -------------------------------------------------------------------------------------- orders


def test_initial_mode_follows_centered_sticks(client: Client) -> None:
    assert angles(client) == [0, -35, 0]


def test_mount_command_is_relative_to_the_nose(client: Client) -> None:
    assert mount(client, MavMountMode.MAVLINK_TARGETING, -45, 5, 30) == ACCEPTED
    assert angles(client) == [5, -45, 30]
    assert mount(client, MavMountMode.MAVLINK_TARGETING, -45, 50, 350) == ACCEPTED
    assert angles(client) == [30, -45, -10]
    assert status(client).flags == FOLLOWS
    client.clear()
    assert mount(client, MavMountMode.MAVLINK_TARGETING, -100) == FAILED
    client.run(0.1)
    assert client.texts == ["Mount: invalid angle targets"]
    assert mount(client, 5) == FAILED


def test_mount_modes(client: Client) -> None:
    mount(client, MavMountMode.MAVLINK_TARGETING, -45)
    assert mount(client, MavMountMode.RETRACT) == ACCEPTED
    assert angles(client) == [0, 0, 0]
    assert status(client).flags == FOLLOWS | RETRACT
    assert mount(client, MavMountMode.NEUTRAL) == ACCEPTED
    assert status(client).flags == FOLLOWS | NEUTRAL
    assert client.command(MavCmd.DO_MOUNT_CONFIGURE, MavMountMode.RC_TARGETING) == ACCEPTED
    assert angles(client) == [0, -35, 0]
    assert client.command(MavCmd.DO_MOUNT_CONFIGURE, 77) == ACCEPTED
    assert angles(client) == [0, -35, 0]


def test_manager_angles_relative_to_nose_or_north(client: Client) -> None:
    assert manage(client, -90, 200, NAN, NAN, 0) == ACCEPTED
    assert angles(client)[1] == -90
    assert manage(client, -20, 30, NAN, NAN, LOCKED) == ACCEPTED
    assert angles(client) == [0, -20, -60]
    assert status(client).flags == LOCKS
    assert manage(client, 0, 0, NAN, NAN, RETRACT) == ACCEPTED
    assert manage(client, 0, 0, NAN, NAN, NEUTRAL) == ACCEPTED
    assert angles(client) == [0, 0, 0]
    assert manage(client, NAN, 5, NAN, 5, 0) == FAILED
    assert client.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, 0, 0, NAN, NAN, 0, 0, 2) == FAILED
    assert client.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, 0, 0, NAN, NAN, 0, 0, 1) == ACCEPTED


def test_manager_rates_stop_at_the_limit(client: Client) -> None:
    manage(client, 0, 0, NAN, NAN, 0)
    assert manage(client, NAN, NAN, -10, 20, 0) == ACCEPTED
    client.run(2.0)
    assert angles(client) == pytest.approx([0, -20, 41], abs=1)
    client.run(30.0)
    assert angles(client)[1:] == [-90, 0]  # Straight down, all rotations share one axis.
    assert client.vehicle.gimbal.angles[2] == 180  # type: ignore[attr-defined]
    assert manage(client, NAN, NAN, 0, 90, LOCKED) == ACCEPTED
    client.run(1.0)
    assert client.vehicle.gimbal.target.yaw == pytest.approx(0, abs=10)  # type: ignore[attr-defined]


def test_manager_command_of_nan_sets_yaw_lock(client: Client) -> None:
    assert manage(client, NAN, NAN, NAN, NAN, LOCKED) == ACCEPTED
    assert angles(client) == [0, -35, -90]
    assert manage(client, NAN, NAN, NAN, NAN, 0) == ACCEPTED
    assert angles(client) == [0, -35, 0]


def test_manager_messages_control_the_gimbal(client: Client) -> None:
    q = quaternion_from_euler(math.radians(10), math.radians(-30), math.radians(100))
    client.send(m.GimbalManagerSetAttitude(1, 1, LOCKED, 0, q, NAN, NAN, NAN))
    assert angles(client) == [10, -30, 10]
    # Angles together with rates are ignored.
    client.send(m.GimbalManagerSetAttitude(1, 1, LOCKED, 0, q, 0.0, 0.0, 0.0))
    client.send(m.GimbalManagerSetPitchyaw(1, 1, 0, 0, math.radians(-15), math.radians(5), NAN, NAN))
    assert angles(client) == [0, -15, 5]
    client.send(m.GimbalManagerSetPitchyaw(1, 1, 0, 0, NAN, NAN, math.radians(-10), 0.0))
    client.run(1.0)
    assert angles(client) == pytest.approx([0, -25, 5], abs=1)


def test_control_is_stored_and_reported(client: Client) -> None:
    def configure(system: float, component: float) -> list[tuple[int, int]]:
        client.clear()
        assert client.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, system, component) == ACCEPTED
        client.run(0.1)
        reported = client.all(m.GimbalManagerStatus)
        return [(event.primary_control_sysid, event.primary_control_compid) for event in reported]

    assert configure(-2, -2) == [(255, 190)]
    assert configure(255, 190) == []
    assert configure(-1, -1) == []
    assert configure(42, 7) == [(42, 7)]
    assert configure(-3, -3) == []
    assert configure(255, 190) == [(255, 190)]
    assert configure(-3, -3) == [(0, 0)]
    assert client.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, -4, 0) == FAILED
    assert manage(client, -10, 0, NAN, NAN) == ACCEPTED, "no controller is required"


# -------------------------------------------------------------------------------------- places


def test_gimbal_keeps_pointing_at_a_position() -> None:
    copter, client = flying_copter(20.0, parameters=WITH_GIMBAL, heading_deg=90.0)
    north = {"x": HOME_E7[0] + 2000, "y": HOME_E7[1]}  # 22 m
    roi = MavCmd.DO_SET_ROI_LOCATION
    assert client.command_int(roi, MavFrame.GLOBAL_RELATIVE_ALT_INT, z=0.0, **north) == ACCEPTED
    assert angles(client) == pytest.approx([0, -42, -90], abs=2)
    assert status(client).flags == LOCKS
    client.run(5.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(90, abs=2)
    assert client.command_int(roi, MavFrame.GLOBAL_INT, z=584.09 + 20, **north) == ACCEPTED
    assert angles(client) == pytest.approx([0, 0, -90], abs=2)
    assert client.command(MavCmd.DO_SET_ROI_NONE) == ACCEPTED
    assert angles(client) == pytest.approx([0, -35, 0], abs=2)


def test_without_gimbal_the_vehicle_turns() -> None:
    copter, client = flying_copter(20.0, heading_deg=90.0)
    client.command_int(MavCmd.DO_SET_ROI, MavFrame.GLOBAL_RELATIVE_ALT_INT, x=HOME_E7[0] + 2000, y=HOME_E7[1])
    client.run(5.0)
    assert math.degrees(copter.motion.yaw) == pytest.approx(0, abs=3)


def test_mount_command_supports_positions(client: Client) -> None:
    params = (0, 0, 0, 100.0, HOME_E7[0], HOME_E7[1] + 10_000, MavMountMode.GPS_POINT)
    assert client.command(MavCmd.DO_MOUNT_CONTROL, *params) == ACCEPTED
    assert angles(client)[1:] == pytest.approx([20, 0], abs=2)  # 45 degrees up, limited.
    assert client.command(MavCmd.DO_MOUNT_CONTROL, -35, 149, 0, 0, 0, 0, MavMountMode.GPS_POINT) == FAILED
    assert client.command(MavCmd.DO_MOUNT_CONTROL, -35, 0, 0, 0, 0, 0, MavMountMode.GPS_POINT) == ACCEPTED
    assert mount(client, MavMountMode.HOME_LOCATION) == ACCEPTED
    assert status(client).flags == LOCKS


def test_reboot_resets_to_stick_control(client: Client) -> None:
    mount(client, MavMountMode.MAVLINK_TARGETING, -45)
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    client.run(10.0)
    assert angles(client) == [0, -35, 0]


def test_reboot_with_own_silence_resets_gimbal_and_devices(client: Client) -> None:
    copter = client.vehicle
    assert isinstance(copter, SimulatedCopter)
    mount(client, MavMountMode.MAVLINK_TARGETING, -45)
    copter.camera.image_count, copter.devices.line_m = 5, 5.0
    copter.reboot(1.0)
    client.run(9.0)
    assert angles(client) == [0, -35, 0]
    assert (copter.camera.image_count, copter.devices.line_m) == (0, 0.0)


def test_reboot_releases_previous_gimbal(client: Client) -> None:
    copter = client.vehicle
    assert isinstance(copter, SimulatedCopter)
    previous = weakref.ref(copter.gimbal)
    copter.reboot(1.0)
    client.run(9.0)
    gc.collect()
    assert previous() is None
