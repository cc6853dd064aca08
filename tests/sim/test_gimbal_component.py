"""A simulated gimbal component: control, directions and messages."""

from __future__ import annotations

import math

import pytest
from component_client import ComponentClient, copter_with, source

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.mavlink.enums import MavCmd, MavFrame, MavResult, MavType
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler

GIMBAL = 154
CONFIGURE, POINT = MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, MavCmd.DO_GIMBAL_MANAGER_PITCHYAW
DONE, DENIED = [MavResult.ACCEPTED], [MavResult.DENIED]
NAN = math.nan
KEEP = (-1.0, -1.0)


def fitted(**options: object) -> tuple[SimulatedGimbal, ComponentClient]:
    gimbal = SimulatedGimbal(**options)  # type: ignore[arg-type]
    _, client = copter_with(gimbal, heading_deg=0.0)
    return gimbal, client


def claimed(**options: object) -> tuple[SimulatedGimbal, ComponentClient]:
    gimbal, client = fitted(**options)
    assert client.ask(GIMBAL, CONFIGURE, -2, -2, *KEEP) == DONE
    return gimbal, client


def degrees(gimbal: SimulatedGimbal) -> list[float]:
    return [math.degrees(angle) for angle in gimbal.angles()]


def test_information_is_sent_on_request() -> None:
    _, client = fitted(pitch_deg=(-80.0, 10.0))
    client.run(2.0)
    assert client.messages_from(GIMBAL, m.Heartbeat)[0].type == MavType.GIMBAL
    (device,) = client.request(GIMBAL, m.GimbalDeviceInformation)
    (manager,) = client.request(GIMBAL, m.GimbalManagerInformation)
    assert manager.gimbal_device_id == GIMBAL
    for reported in (device, manager):
        assert (reported.pitch_min, reported.pitch_max) == pytest.approx((math.radians(-80), math.radians(10)))
    status = client.last(m.GimbalManagerStatus)
    assert (status.gimbal_device_id, status.primary_control_sysid) == (GIMBAL, 0)


def test_attitude_is_streamed() -> None:
    _, client = fitted(attitude_rate_hz=10.0)
    client.run(2.0)
    assert len(client.all(m.GimbalDeviceAttitudeStatus)) == pytest.approx(20, abs=1)
    client.ask(GIMBAL, MavCmd.SET_MESSAGE_INTERVAL, m.GimbalDeviceAttitudeStatus.ID, -1)
    client.clear()
    client.run(1.0)
    assert not client.all(m.GimbalDeviceAttitudeStatus)


def test_fastest_stream_has_200_hz() -> None:
    _, client = fitted()
    client.ask(GIMBAL, MavCmd.SET_MESSAGE_INTERVAL, m.GimbalDeviceAttitudeStatus.ID, 1)
    client.clear()
    client.run(0.1)
    assert len(client.all(m.GimbalDeviceAttitudeStatus)) == pytest.approx(20, abs=1)


def test_commands_without_control_are_denied() -> None:
    gimbal, client = fitted()
    assert client.ask(GIMBAL, POINT, -30, 0, NAN, NAN) == DENIED
    assert client.ask(GIMBAL, MavCmd.DO_SET_ROI_NONE) == DENIED
    client.send(m.GimbalManagerSetPitchyaw(1, GIMBAL, 0, 0, -0.5, 0.0, NAN, NAN))
    client.run(1.0)
    assert degrees(gimbal) == [0.0, 0.0, 0.0]


def test_control_is_claimed_reported_and_released() -> None:
    gimbal, client = fitted()
    assert client.ask(GIMBAL, CONFIGURE, -2, -2, *KEEP) == DONE
    status = client.last(m.GimbalManagerStatus)
    assert (status.primary_control_sysid, status.primary_control_compid) == (255, 190)
    assert client.ask(GIMBAL, CONFIGURE, *KEEP, 7, 191) == DONE
    assert (gimbal.primary, gimbal.secondary) == ((255, 190), (7, 191))
    assert client.ask(GIMBAL, CONFIGURE, -3, -3, *KEEP) == DONE
    assert (gimbal.primary, gimbal.secondary) == ((0, 0), (7, 191))
    assert client.ask(GIMBAL, CONFIGURE, 300, 0, *KEEP) == DENIED


def test_another_ground_station_takes_control() -> None:
    gimbal, client = claimed()
    other = FrameEncoder(254, 190)
    claim = m.CommandLong(1, GIMBAL, CONFIGURE, 0, -2, -2, -1, -1, 0, 0, 0)
    client.vehicle.receive(other.encode(claim), client.now)
    client.listen()
    assert gimbal.primary == (254, 190)
    assert client.ask(GIMBAL, POINT, -30, 0, NAN, NAN) == DENIED
    assert client.ask(GIMBAL, CONFIGURE, -3, -3, *KEEP) == DONE  # Releases control that it does not have.
    assert gimbal.primary == (254, 190)


def test_turn_rate_is_limited() -> None:
    gimbal, client = claimed(slew_deg_s=30.0)
    assert client.ask(GIMBAL, POINT, -60, 20, NAN, NAN) == DONE
    client.run(1.0)
    assert degrees(gimbal) == pytest.approx([0.0, -30.0, 20.0], abs=0.1)
    client.run(1.5)
    assert degrees(gimbal) == pytest.approx([0.0, -60.0, 20.0], abs=0.1)
    (status,) = client.request(GIMBAL, m.GimbalDeviceAttitudeStatus)
    assert math.degrees(euler_from_quaternion(*status.q)[1]) == pytest.approx(-60.0, abs=0.1)


def test_angles_are_limited() -> None:
    gimbal, client = claimed(pitch_deg=(-45.0, 10.0))
    client.ask(GIMBAL, POINT, -90, 0, NAN, NAN)
    client.run(3.0)
    assert degrees(gimbal)[1] == pytest.approx(-45.0)
    client.ask(GIMBAL, POINT, NAN, NAN, 20, 0)
    client.run(1.0)
    assert degrees(gimbal)[1] == pytest.approx(-25.0, abs=0.1)
    client.run(9.0)
    assert degrees(gimbal)[1] == pytest.approx(10.0)


def test_locked_yaw_keeps_its_direction() -> None:
    gimbal, client = claimed()
    copter = client.vehicle
    assert isinstance(copter, SimulatedCopter)
    client.ask(GIMBAL, POINT, 0, 90, NAN, NAN, Flags.YAW_LOCK)
    client.run(3.0)
    copter.motion.yaw = math.radians(30.0)
    assert degrees(gimbal)[2] == pytest.approx(60.0, abs=0.1)
    (status,) = client.request(GIMBAL, m.GimbalDeviceAttitudeStatus)
    assert status.flags & Flags.YAW_IN_EARTH_FRAME
    assert math.degrees(euler_from_quaternion(*status.q)[2]) == pytest.approx(90.0, abs=0.1)
    client.ask(GIMBAL, POINT, 0, 0, NAN, NAN)
    client.run(3.0)
    assert degrees(gimbal)[2] == pytest.approx(0.0, abs=0.1)


def test_messages_control_the_gimbal() -> None:
    gimbal, client = claimed()
    client.send(m.GimbalManagerSetPitchyaw(1, GIMBAL, 0, 0, math.radians(-20), 0.0, NAN, NAN))
    client.run(2.0)
    assert degrees(gimbal)[1] == pytest.approx(-20.0)
    q = quaternion_from_euler(math.radians(5), math.radians(-10), math.radians(40))
    client.send(m.GimbalManagerSetAttitude(1, GIMBAL, 0, GIMBAL, q, NAN, NAN, NAN))
    client.run(2.0)
    assert degrees(gimbal) == pytest.approx([5.0, -10.0, 40.0], abs=0.01)
    client.send(m.GimbalManagerSetManualControl(1, GIMBAL, 0, 0, NAN, NAN, -0.5, 0.0))
    client.run(1.0)
    assert degrees(gimbal)[1] == pytest.approx(-40.0, abs=1.0)
    client.send(m.GimbalManagerSetManualControl(1, GIMBAL, 0, 0, -0.5, 0.25, NAN, NAN))
    client.run(3.0)
    assert degrees(gimbal) == pytest.approx([0.0, -45.0, 45.0])  # The limits are -90 to 25 and -180 to 180.
    client.send(m.GimbalManagerSetManualControl(1, GIMBAL, 0, 0, 1.0, 0.0, NAN, NAN))
    client.run(3.0)
    assert degrees(gimbal) == pytest.approx([0.0, 25.0, 0.0])
    client.send(m.GimbalManagerSetPitchyaw(1, GIMBAL, Flags.NEUTRAL, 0, NAN, NAN, NAN, NAN))
    client.run(3.0)
    assert degrees(gimbal) == pytest.approx([0.0, 0.0, 0.0])


def test_gimbal_points_at_a_position() -> None:
    gimbal, client = claimed()
    copter = client.vehicle
    assert isinstance(copter, SimulatedCopter)
    place = copter.frame.to_global(0.0, 100.0, 0.0)
    frame, where = MavFrame.GLOBAL_RELATIVE_ALT, (place.latitude_e7, place.longitude_e7)
    order = m.CommandInt(1, GIMBAL, frame, MavCmd.DO_SET_ROI_LOCATION, 0, 0, 0, 0, 0, 0, *where, 100.0)
    client.send(order)
    assert client.last(m.CommandAck).result == MavResult.ACCEPTED
    client.run(4.0)
    assert degrees(gimbal) == pytest.approx([0.0, 25.0, 90.0], abs=0.5)  # 45 degrees up exceed the limit.
    copter.motion.north = 100.0
    assert degrees(gimbal)[2] == pytest.approx(135.0, abs=0.5)
    assert client.ask(GIMBAL, MavCmd.DO_SET_ROI_NONE) == DONE
    client.run(4.0)
    assert degrees(gimbal) == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


def test_commands_select_one_of_two_gimbals() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    _, client = copter_with(one, two, heading_deg=0.0, parameters={"MNT1_TYPE": 1.0})
    client.run(1.0)
    for gimbal in (154, 171):
        client.ask(gimbal, CONFIGURE, -2, -2, *KEEP)
    assert client.ask(171, POINT, -10, 0, NAN, NAN, 0, 0, 171) == DONE
    assert client.ask(171, POINT, -10, 0, NAN, NAN, 0, 0, 154) == DENIED
    client.run(1.0)
    assert (degrees(one)[1], degrees(two)[1]) == pytest.approx((0.0, -10.0))
    client.clear()
    client.ask(0, MavCmd.REQUEST_MESSAGE, m.GimbalManagerInformation.ID)
    client.run(0.1)
    reported = {source(message): message.gimbal_device_id for message in client.all(m.GimbalManagerInformation)}
    assert reported == {(1, 1): 1, (1, 154): 154, (1, 171): 171}


def test_camera_has_direction_of_its_gimbal() -> None:
    gimbal = SimulatedGimbal()
    camera = SimulatedCamera(gimbal=gimbal)
    _, client = copter_with(gimbal, camera, heading_deg=90.0)
    client.ask(GIMBAL, CONFIGURE, -2, -2, *KEEP)
    client.ask(GIMBAL, POINT, -45, 10, NAN, NAN)
    client.run(2.0)
    client.ask(100, MavCmd.IMAGE_START_CAPTURE, 0, 0, 1)
    client.run(0.3)
    _, pitch, yaw = map(math.degrees, euler_from_quaternion(*client.last(m.CameraImageCaptured).q))
    assert (pitch, yaw) == pytest.approx((-45.0, 100.0), abs=0.5)
    assert client.request(100, m.CameraInformation)[0].gimbal_device_id == GIMBAL
