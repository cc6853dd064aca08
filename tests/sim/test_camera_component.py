"""A simulated camera component: messages, captures, storage and refusals."""

from __future__ import annotations

import math

import pytest
from component_client import ComponentClient, copter_with, settled, source

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    MavCmd,
    MavResult,
    MavType,
    VideoStreamStatusFlags,
)
from aerokit.sim import ExtraComponent, SimulatedCamera, SimulatedCopter, SimulatedPx4, SimulatedVehicle

CAMERA = 100
START, STOP = MavCmd.IMAGE_START_CAPTURE, MavCmd.IMAGE_STOP_CAPTURE
DONE, DENIED, BUSY = [MavResult.ACCEPTED], [MavResult.DENIED], [MavResult.TEMPORARILY_REJECTED]
FAILED, UNSUPPORTED = [MavResult.FAILED], [MavResult.UNSUPPORTED]


def fitted(**options: object) -> tuple[SimulatedCamera, ComponentClient]:
    camera = SimulatedCamera(**options)  # type: ignore[arg-type]
    _, client = copter_with(camera)
    return camera, client


def test_camera_sends_its_own_heartbeat() -> None:
    _, client = fitted()
    client.run(3.0)
    heartbeats = client.messages_from(CAMERA, m.Heartbeat)
    assert [heartbeat.type for heartbeat in heartbeats] == [MavType.CAMERA] * 3
    assert len(client.messages_from(1, m.Heartbeat)) == 3


def test_camera_information_is_sent_on_request() -> None:
    camera, client = fitted(model="Eye", resolution=(640, 480), streams=["rtsp://127.0.0.1/a"])
    (information,) = client.request(CAMERA, m.CameraInformation)
    assert information.model_name.rstrip(b"\0") == b"Eye"
    assert (information.resolution_h, information.resolution_v) == (640, 480)
    assert information.flags == camera.capabilities
    assert information.flags & CameraCapFlags.HAS_VIDEO_STREAM
    (settings,) = client.request(CAMERA, m.CameraSettings)
    assert (settings.mode_id, settings.zoomLevel) == (CameraMode.IMAGE, 0.0)
    (card,) = client.request(CAMERA, m.StorageInformation)
    assert (card.storage_count, card.total_capacity, card.used_capacity) == (1, 8192.0, 0.0)
    assert client.ask(CAMERA, MavCmd.REQUEST_MESSAGE, m.StorageInformation.ID, 2) == FAILED
    assert client.ask(CAMERA, MavCmd.REQUEST_MESSAGE, m.Attitude.ID) == DENIED


def test_legacy_request_commands_are_answered() -> None:
    _, client = fitted(streams=["rtsp://127.0.0.1/a"])
    for command, kind in (
        (MavCmd.REQUEST_CAMERA_INFORMATION, m.CameraInformation),
        (MavCmd.REQUEST_CAMERA_SETTINGS, m.CameraSettings),
        (MavCmd.REQUEST_STORAGE_INFORMATION, m.StorageInformation),
        (MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, m.CameraCaptureStatus),
        (MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, m.VideoStreamInformation),
    ):
        assert client.ask(CAMERA, command, 1) == DONE
        assert client.all(kind), kind


def test_image_is_available_after_shutter_time() -> None:
    camera, client = fitted()
    copter = client.vehicle
    assert isinstance(copter, SimulatedCopter)
    assert client.ask(CAMERA, START, 0, 0, 1) == DONE
    (status,) = client.request(CAMERA, m.CameraCaptureStatus)
    assert (status.image_status, status.image_count) == (1, 0)
    client.run(0.3)
    (image,) = client.all(m.CameraImageCaptured)
    place = copter.frame.to_global(copter.motion.north, copter.motion.east, copter.motion.down)
    assert (image.image_index, image.capture_result) == (0, 1)
    assert (image.lat, image.lon) == (place.latitude_e7, place.longitude_e7)
    assert image.alt == pytest.approx(place.altitude_m * 1000, abs=1)
    assert image.q[0] == pytest.approx(math.cos(copter.motion.yaw / 2), abs=0.01)
    assert client.last(m.CameraCaptureStatus).image_count == camera.image_count == 1
    assert source(image) == (1, CAMERA)


def test_repeated_sequence_number_takes_no_second_image() -> None:
    camera, client = fitted()
    for number, count in ((1, 1), (1, 1), (2, 2)):
        assert client.ask(CAMERA, START, 0, 0, 1, number) == DONE
        client.run(0.3)
        assert camera.image_count == count


def test_series_ends_after_its_count() -> None:
    camera, client = fitted()
    assert client.ask(CAMERA, START, 0, 1.0, 3) == DONE
    assert client.ask(CAMERA, START, 0, 0, 1) == BUSY
    client.run(1.5)
    (status,) = client.request(CAMERA, m.CameraCaptureStatus)
    assert (status.image_status, status.image_interval, status.image_count) == (2, 1.0, 2)
    client.run(3.0)
    assert [image.image_index for image in client.all(m.CameraImageCaptured)] == [0, 1, 2]
    (status,) = client.request(CAMERA, m.CameraCaptureStatus)
    assert (status.image_status, camera.image_count) == (0, 3)


def test_unlimited_series_stops_on_command() -> None:
    camera, client = fitted()
    client.ask(CAMERA, START, 0, 0.5, 0)
    client.run(2.3)
    assert client.ask(CAMERA, STOP) == DONE
    client.run(3.0)
    assert camera.image_count == 5


def test_lost_image_reports_are_sent_on_request() -> None:
    """The client counts: each image index is one more than the last."""
    camera, client = fitted()
    client.ask(CAMERA, START, 0, 1.0, 6)
    client.run(0.9)
    camera.faults.silent = True
    client.run(3.0)
    camera.faults.silent = False
    client.run(3.0)
    received = {image.image_index for image in client.all(m.CameraImageCaptured)}
    (status,) = client.request(CAMERA, m.CameraCaptureStatus)
    missing = set(range(status.image_count)) - received
    assert missing == {1, 2, 3}
    (again,) = client.request(CAMERA, m.CameraImageCaptured, 2)
    assert again.image_index == 2
    two = client.request(CAMERA, m.CameraImageCaptured, 1, 3)
    assert [image.image_index for image in two] == [1, 2, 3]
    assert len(client.request(CAMERA, m.CameraImageCaptured, 4, -1)) == 2
    assert len(client.request(CAMERA, m.CameraImageCaptured, -1)) == 6
    assert client.ask(CAMERA, MavCmd.REQUEST_MESSAGE, m.CameraImageCaptured.ID, 6) == FAILED


def test_full_image_log_drops_oldest_and_continues_indices() -> None:
    camera, client = fitted()
    camera.max_images = 4
    client.ask(CAMERA, START, 0, 0.5, 6)
    client.run(4.0)
    assert [image.image_index for image in client.all(m.CameraImageCaptured)] == [0, 1, 2, 3, 4, 5]
    assert camera.image_count == 6
    assert [image.image_index for image in client.request(CAMERA, m.CameraImageCaptured, -1)] == [2, 3, 4, 5]
    assert [image.image_index for image in client.request(CAMERA, m.CameraImageCaptured, 1, 3)] == [2, 3]
    assert client.ask(CAMERA, MavCmd.REQUEST_MESSAGE, m.CameraImageCaptured.ID, 1) == FAILED


def test_full_card_refuses_images() -> None:
    camera, client = fitted(capacity_mib=12.0)
    client.ask(CAMERA, START, 0, 0.5, 0)
    client.run(4.0)
    assert [image.capture_result for image in client.all(m.CameraImageCaptured)] == [1, 1, 0]
    assert client.ask(CAMERA, START, 0, 0, 1) == FAILED
    (card,) = client.request(CAMERA, m.StorageInformation)
    assert (card.used_capacity, card.available_capacity) == (10.0, 2.0)
    camera.card.is_inserted = False
    (card,) = client.request(CAMERA, m.StorageInformation)
    assert (card.status, card.available_capacity) == (0, 0.0)


def test_formatting_reports_progress() -> None:
    camera, client = fitted()
    client.ask(CAMERA, START, 0, 0, 1)
    client.run(1.0)
    client.clear()
    client.ask(CAMERA, MavCmd.STORAGE_FORMAT, 1, 1, 1)
    client.run(3.0)
    acks = [(ack.result, ack.progress) for ack in client.all(m.CommandAck)]
    assert acks == [
        *((MavResult.IN_PROGRESS, percent) for percent in (0, 25, 50, 75)),
        (MavResult.ACCEPTED, 0),
    ]
    assert (camera.card.used_mib, camera.image_count) == (0.0, 0)


def test_video_needs_video_mode() -> None:
    camera, client = fitted()
    assert client.ask(CAMERA, MavCmd.VIDEO_START_CAPTURE) == DENIED
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_MODE, 0, CameraMode.VIDEO) == DONE
    assert client.last(m.CameraSettings).mode_id == CameraMode.VIDEO
    assert client.ask(CAMERA, START, 0, 0, 1) == DENIED
    assert client.ask(CAMERA, MavCmd.VIDEO_START_CAPTURE, 0, 1.0) == DONE
    assert client.ask(CAMERA, MavCmd.VIDEO_START_CAPTURE) == BUSY
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_MODE, 0, CameraMode.IMAGE) == BUSY
    client.run(3.5)
    reported = client.all(m.CameraCaptureStatus)
    assert [(status.video_status, status.recording_time_ms) for status in reported] == [
        (1, 0), (1, 1000), (1, 2000), (1, 3000),
    ]  # fmt: skip
    assert client.ask(CAMERA, MavCmd.VIDEO_STOP_CAPTURE) == DONE
    assert client.last(m.CameraCaptureStatus).video_status == 0
    assert camera.card.used_mib == pytest.approx(35.0)


def test_zoom_and_focus_are_reported() -> None:
    _, client = fitted()
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_ZOOM, 2, 40.0) == DONE
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_ZOOM, 0, 1.0) == DONE
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_FOCUS, 2, 70.0) == DONE
    settings = client.last(m.CameraSettings)
    assert (settings.zoomLevel, settings.focusLevel) == (50.0, 70.0)
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_ZOOM, 2, 140.0) == DENIED
    assert client.ask(CAMERA, MavCmd.RESET_CAMERA_SETTINGS, 1) == DONE
    assert client.last(m.CameraSettings).zoomLevel == 0.0


def test_missing_capabilities_are_unsupported() -> None:
    _, client = fitted(capabilities=CameraCapFlags.CAPTURE_IMAGE)
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_ZOOM, 2, 40.0) == UNSUPPORTED
    assert client.ask(CAMERA, MavCmd.VIDEO_START_CAPTURE) == UNSUPPORTED
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_MODE, 0, 0) == UNSUPPORTED
    assert client.ask(CAMERA, MavCmd.VIDEO_START_STREAMING) == UNSUPPORTED
    assert math.isnan(client.request(CAMERA, m.CameraSettings)[0].zoomLevel)


def test_video_streams_are_listed_and_switched() -> None:
    _, client = fitted(streams=["rtsp://10.0.0.1/main", "udp://10.0.0.1:5600"])
    streams = client.request(CAMERA, m.VideoStreamInformation, 0)
    assert [(stream.stream_id, stream.count) for stream in streams] == [(1, 2), (2, 2)]
    assert client.request(CAMERA, m.VideoStreamInformation, 2)[0].uri == "udp://10.0.0.1:5600"
    assert client.ask(CAMERA, MavCmd.VIDEO_STOP_STREAMING, 2) == DONE
    flags = [status.flags for status in client.request(CAMERA, m.VideoStreamStatus, 0)]
    assert flags == [VideoStreamStatusFlags.RUNNING, 0]
    assert client.ask(CAMERA, MavCmd.VIDEO_START_STREAMING, 3) == DENIED


def test_message_intervals_apply_to_the_component() -> None:
    _, client = fitted()
    interval = MavCmd.SET_MESSAGE_INTERVAL
    assert client.ask(CAMERA, interval, m.CameraCaptureStatus.ID, 500_000) == DONE
    client.ask(CAMERA, MavCmd.GET_MESSAGE_INTERVAL, m.CameraCaptureStatus.ID)
    assert client.last(m.MessageInterval).interval_us == 500_000
    client.run(2.2)
    assert len(client.all(m.CameraCaptureStatus)) == 5
    assert client.ask(CAMERA, interval, m.CameraCaptureStatus.ID, -1) == DONE
    client.clear()
    client.run(2.0)
    assert not client.all(m.CameraCaptureStatus)
    assert client.ask(CAMERA, interval, m.Attitude.ID, 500_000) == DENIED


# ----------------------------------------------------------------------------------- several cameras


def test_commands_are_handled_by_their_target() -> None:
    """This camera, both cameras, all components; an absent component does not answer."""
    one, two = SimulatedCamera(100), SimulatedCamera(101)
    _, client = copter_with(one, two, ExtraComponent(102))
    assert client.ask(101, START, 0, 0, 1) == DONE
    client.run(0.3)
    assert (one.image_count, two.image_count) == (0, 1)
    assert [source(image) for image in client.all(m.CameraImageCaptured)] == [(1, 101)]
    assert client.ask(102, START, 0, 0, 1) == []
    client.clear()
    client.ask(0, START, 0, 0, 1)
    client.run(0.3)
    assert (one.image_count, two.image_count) == (1, 2)
    assert {source(ack) for ack in client.all(m.CommandAck)} == {(1, 1), (1, 100), (1, 101)}


def test_unknown_broadcast_command_is_ignored() -> None:
    _, client = fitted()
    assert client.ask(0, MavCmd.RUN_PREARM_CHECKS) == DONE
    assert client.ask(CAMERA, MavCmd.RUN_PREARM_CHECKS) == UNSUPPORTED
    assert client.ask(1, MavCmd.STORAGE_FORMAT, 1) == UNSUPPORTED


def test_camera_with_its_own_system_id() -> None:
    camera = SimulatedCamera(100, system_id=42)
    _, client = copter_with(camera)
    client.run(2.0)
    assert client.messages_from(100, m.Heartbeat, system=42)
    assert client.ask(100, START, 0, 0, 1) == []
    assert client.ask(100, START, 0, 0, 1, system=42) == DONE


def test_faults_apply_to_the_component_only() -> None:
    camera, client = fitted()
    camera.faults.refuse(START, MavResult.TEMPORARILY_REJECTED, "card is slow", times=1)
    assert client.ask(CAMERA, START, 0, 0, 1) == BUSY
    assert client.texts == ["card is slow"]
    assert source(client.last(m.Statustext)) == (1, CAMERA)
    camera.faults.silent = True
    client.clear()
    assert client.ask(CAMERA, START, 0, 0, 1) == []
    client.run(3.0)
    assert not client.messages_from(CAMERA, m.Heartbeat)
    assert client.messages_from(1, m.Heartbeat)
    camera.faults.silent = False
    camera.faults.drop_incoming = 1
    assert client.ask(CAMERA, START, 0, 0, 1) == []
    assert client.ask(CAMERA, START, 0, 0, 1) == DONE


@pytest.mark.parametrize("make", [SimulatedPx4, SimulatedCopter])
def test_reboot_of_autopilot_does_not_reboot_camera(make: type[SimulatedVehicle]) -> None:
    camera = SimulatedCamera()
    client = settled(make(components=[camera]))  # type: ignore[call-arg]
    client.ask(CAMERA, START, 0, 0.5, 0)
    client.run(1.3)
    client.ask(1, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1)
    client.clear()
    client.run(0.5)
    client.clear()
    client.run(0.5)
    assert not client.messages_from(CAMERA, m.Heartbeat)  # The autopilot forwards nothing while it reboots.
    client.run(8.7)
    assert camera.image_count == 22
    assert client.messages_from(CAMERA, m.CameraImageCaptured)
    assert camera.time_boot_ms > client.vehicle.time_boot_ms


def test_reboot_ends_series_and_keeps_images() -> None:
    camera, client = fitted()
    client.ask(CAMERA, START, 0, 0.5, 0)
    client.run(1.3)
    taken = camera.image_count
    assert taken == 3
    camera.reboot()
    client.run(6.3)
    assert camera.image_count == taken
    assert client.ask(CAMERA, START, 0, 0, 1) == DONE
    client.clear()
    client.run(2.05)
    assert len(client.messages_from(CAMERA, m.Heartbeat)) == 2


@pytest.mark.parametrize("make", [SimulatedPx4, SimulatedCopter])
def test_camera_works_on_every_vehicle(make: type[SimulatedVehicle]) -> None:
    camera = SimulatedCamera()
    vehicle = make(components=[camera])  # type: ignore[call-arg]
    client = settled(vehicle)
    assert client.ask(CAMERA, START, 0, 0, 1) == DONE
    client.run(0.3)
    assert client.last(m.CameraImageCaptured).lat == pytest.approx(vehicle.frame.origin.latitude_e7, abs=50)  # type: ignore[attr-defined]


def test_second_vehicle_is_refused() -> None:
    camera = SimulatedCamera()
    with pytest.raises(InvalidArgument):
        _ = camera.system_id
    SimulatedCopter(components=[camera])
    with pytest.raises(InvalidArgument):
        SimulatedCopter(components=[camera])


def test_repeated_stream_request_keeps_its_rate() -> None:
    _, client = fitted()
    for interval_us in (1e6, -1, 1e6, 2e6, 1e6):
        client.ask(CAMERA, MavCmd.SET_MESSAGE_INTERVAL, m.CameraCaptureStatus.ID, interval_us)
    client.clear()
    client.run(10.0)
    assert len(client.all(m.CameraCaptureStatus)) == 10


def test_continuous_zoom_stops_on_command_or_at_limit() -> None:
    camera, client = fitted()
    zoom = MavCmd.SET_CAMERA_ZOOM
    assert client.ask(CAMERA, zoom, 1, 1.0) == DONE
    client.run(2.0)
    assert client.ask(CAMERA, zoom, 1, 0.0) == DONE
    stopped_at = camera.zoom
    assert stopped_at == pytest.approx(40.0, abs=1.0)
    client.run(2.0)
    assert camera.zoom == stopped_at
    assert client.ask(CAMERA, zoom, 1, -1.0) == DONE
    client.run(5.0)
    assert camera.zoom == 0.0
    assert client.ask(CAMERA, zoom, 3, 45.0) == DONE
    assert camera.zoom == pytest.approx(100.0)
    assert camera.lens.focal_length_mm == pytest.approx(45.0)
    assert client.ask(CAMERA, zoom, 3, 46.0) == DENIED
    assert client.ask(CAMERA, zoom, 4, 30.0) == DENIED
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_FOCUS, 3, 30.0) == DONE
    assert camera.focus == 75.0


def test_tracking_status_is_reported() -> None:
    _, without = fitted()
    for command in (MavCmd.CAMERA_TRACK_POINT, MavCmd.CAMERA_TRACK_RECTANGLE, MavCmd.CAMERA_STOP_TRACKING):
        assert without.ask(CAMERA, command, 0.1, 0.1, 0.2, 0.2) == UNSUPPORTED
    camera, client = fitted(capabilities=SimulatedCamera.ALL_CAPABILITIES)
    (status,) = client.request(CAMERA, m.CameraTrackingImageStatus)
    assert (status.tracking_status, status.tracking_mode) == (0, 0)
    assert client.ask(CAMERA, MavCmd.CAMERA_TRACK_POINT, 0.5, 1.5, 0.1) == DENIED
    assert client.ask(CAMERA, MavCmd.CAMERA_TRACK_POINT, 0.5, 0.25, 0.125) == DONE
    (status,) = client.request(CAMERA, m.CameraTrackingImageStatus)
    assert (status.tracking_status, status.tracking_mode, status.target_data) == (1, 1, 4)
    assert (status.point_x, status.point_y, status.radius) == (0.5, 0.25, 0.125)
    assert math.isnan(status.rec_top_x)
    camera.tracking.lose()
    (status,) = client.request(CAMERA, m.CameraTrackingImageStatus)
    assert status.tracking_status == 2
    assert client.ask(CAMERA, MavCmd.CAMERA_STOP_TRACKING) == DONE
    assert client.request(CAMERA, m.CameraTrackingImageStatus)[0].tracking_mode == 0
    assert client.request(CAMERA, m.CameraTrackingGeoStatus) == [], "it points at the horizon"


def test_thermal_camera_reports_its_range() -> None:
    _, without = fitted()
    assert without.ask(CAMERA, MavCmd.REQUEST_MESSAGE, m.CameraThermalRange.ID) == FAILED
    assert without.ask(CAMERA, MavCmd.SET_CAMERA_SOURCE, 0, 2) == DENIED
    _, client = fitted(thermal_celsius=(-10.0, 90.0), streams=["rtsp://a/light", "rtsp://a/warm"])
    (reported,) = client.request(CAMERA, m.CameraThermalRange)
    assert (reported.stream_id, reported.min, reported.max, reported.max_point_x) == (2, -10.0, 90.0, 1.0)
    light, warm = client.request(CAMERA, m.VideoStreamInformation, 0)
    assert (light.flags, warm.flags) == (1, 7)
    assert client.request(CAMERA, m.CameraInformation)[0].flags & CameraCapFlags.HAS_THERMAL_RANGE
    assert client.ask(CAMERA, MavCmd.SET_CAMERA_SOURCE, 0, 2) == DONE


def test_image_files_exist_until_formatting() -> None:
    camera, client = fitted(picture=lambda image: b"picture %d" % image.image_index)
    for _ in range(2):
        client.ask(CAMERA, START, 0, 0, 1)
        client.run(0.5)
    assert [image.file_url for image in client.all(m.CameraImageCaptured)] == [
        "mftp:///DCIM/IMG_0001.JPG",
        "mftp:///DCIM/IMG_0002.JPG",
    ]
    assert camera.files.get("/DCIM/IMG_0002.JPG") == b"picture 1"
    client.ask(CAMERA, MavCmd.STORAGE_FORMAT, 1, 1, 1)
    client.run(3.0)
    assert camera.files.entries("/DCIM") == []


def test_lost_messages_drop_single_messages() -> None:
    camera, client = fitted()
    camera.faults.lose(m.CameraImageCaptured, times=2)
    client.ask(CAMERA, START, 0, 0.5, 3)
    client.run(3.0)
    assert [image.image_index for image in client.all(m.CameraImageCaptured)] == [2]
    client.vehicle.faults.lose(m.Heartbeat)
    client.clear()
    client.run(3.0)
    assert len(client.all(m.Heartbeat)) == 5, "one of the two heartbeats of a second"
