"""The camera of a simulated ArduPilot: messages, single images, series, trigger distance, missions."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client, flying_copter, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter

FITTED = {"CAM1_TYPE": 1.0}


def fitted() -> tuple[SimulatedCopter, Client]:
    return ready_copter(parameters=FITTED)


def test_camera_messages_are_sent_on_request() -> None:
    _, client = fitted()
    for message in (m.CameraInformation, m.CameraSettings, m.CameraCaptureStatus, m.CameraFeedback):
        assert client.command(MavCmd.REQUEST_MESSAGE, message.ID) == MavResult.ACCEPTED
        client.run(0.1)
        assert client.all(message), message
    assert math.isnan(client.last(m.CameraSettings).zoomLevel)
    assert client.command(MavCmd.REQUEST_MESSAGE, m.CameraImageCaptured.ID) == MavResult.FAILED


def test_without_camera_commands_fail_and_nothing_is_streamed() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.CameraInformation.ID) == MavResult.ACCEPTED
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1) == MavResult.FAILED
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 0, 1, 3) == MavResult.FAILED
    assert client.command(MavCmd.IMAGE_STOP_CAPTURE, 0) == MavResult.ACCEPTED
    assert client.command(MavCmd.IMAGE_STOP_CAPTURE, 1) == MavResult.UNSUPPORTED
    assert client.command(MavCmd.DO_DIGICAM_CONTROL, 0, 0, 0, 0, 1) == MavResult.ACCEPTED
    client.run(1.0)
    assert not client.all(m.CameraInformation)
    assert not client.all(m.CameraFeedback)


def test_feedback_has_position_of_the_image() -> None:
    copter, client = flying_copter(parameters=FITTED)
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1) == MavResult.ACCEPTED
    picture = client.last(m.CameraFeedback)
    place = copter.frame.to_global(copter.motion.north, copter.motion.east, copter.motion.down)
    assert picture.img_idx == 1
    assert (picture.lat, picture.lng) == pytest.approx((place.latitude_e7, place.longitude_e7), abs=20)
    assert picture.alt_rel == pytest.approx(10.0, abs=0.5)
    assert 0.0 <= picture.yaw < 360.0
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 1, 0, 1) == MavResult.FAILED  # The shutter is still open.
    client.run(0.2)
    assert client.command(MavCmd.DO_DIGICAM_CONTROL, 0, 0, 0, 0, 1) == MavResult.ACCEPTED
    assert client.last(m.CameraFeedback).img_idx == 2


def test_series_ends_after_its_count() -> None:
    _, client = fitted()
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 0, 1, 3) == MavResult.ACCEPTED
    client.run(1.5)
    client.command(MavCmd.REQUEST_MESSAGE, m.CameraCaptureStatus.ID)
    client.run(0.1)
    status = client.last(m.CameraCaptureStatus)
    assert (status.image_status, status.image_interval, status.image_count) == (2, 1.0, 2)
    client.run(5.0)
    assert [picture.img_idx for picture in client.all(m.CameraFeedback)] == [1, 2, 3]


def test_unlimited_series_stops_on_command() -> None:
    copter, client = fitted()
    assert client.command(MavCmd.IMAGE_START_CAPTURE, 0, 0.5, 0) == MavResult.ACCEPTED
    client.run(2.2)
    assert client.command(MavCmd.IMAGE_STOP_CAPTURE, 0) == MavResult.ACCEPTED
    taken = copter.camera.image_count
    assert taken >= 4
    client.run(2.0)
    assert copter.camera.image_count == taken


@pytest.mark.parametrize(("camera", "result"), [(-1, MavResult.UNSUPPORTED), (2, MavResult.FAILED)])
def test_only_camera_number_one_is_supported(camera: int, result: int) -> None:
    _, client = fitted()
    assert client.command(MavCmd.IMAGE_START_CAPTURE, camera, 0, 1) == result


def test_trigger_distance_takes_images() -> None:
    copter, client = flying_copter(parameters=FITTED)
    assert client.command(MavCmd.DO_SET_CAM_TRIGG_DIST, 5, 0, 1) == MavResult.ACCEPTED
    assert copter.camera.image_count == 1
    place = copter.frame.to_global(0.0, 22.0, 0.0)
    x, y = place.latitude_e7, place.longitude_e7
    client.command_int(MavCmd.DO_REPOSITION, 3, -1, 1, x=x, y=y, z=10)
    client.run(20.0)
    assert copter.camera.image_count == 5
    assert client.command(MavCmd.DO_SET_CAM_TRIGG_DIST, 0) == MavResult.ACCEPTED


def test_mission_commands_take_images() -> None:
    copter, client = fitted()
    for item in (
        MissionItem(MavCmd.DO_DIGICAM_CONTROL, 2, x=1),
        MissionItem(MavCmd.DO_SET_CAM_TRIGG_DIST, 2, 20.0, 0.0, 1.0),
        MissionItem(MavCmd.IMAGE_START_CAPTURE, 2, 0.0, 0.0, 1.0),
        MissionItem(MavCmd.NAV_WAYPOINT, 2),
    ):
        copter.camera.run(item)
        client.run(0.2)
    assert copter.camera.image_count == 3
    assert copter.camera.trigger_distance_m == 20.0


def test_regressions_of_camera_commands() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.ParamValue.ID, 1_000_000) == MavResult.ACCEPTED
    copter.booted_at -= 5000.0
    assert client.command(MavCmd.REQUEST_MESSAGE, m.ServoOutputRaw.ID) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.last(m.ServoOutputRaw).time_usec < 2**32
