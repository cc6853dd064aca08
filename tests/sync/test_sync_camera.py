"""Cameras without async: pictures, series, blocks, cells."""

from __future__ import annotations

import pytest
from served_copter import served

import aerokit.sync
from aerokit.errors import NotSupported
from aerokit.mavlink.enums import CameraCapFlags
from aerokit.sim import SimulatedCamera, SimulatedCopter

BOTH = CameraCapFlags.CAPTURE_IMAGE | CameraCapFlags.CAPTURE_VIDEO


def test_camera() -> None:
    camera = SimulatedCamera(capabilities=BOTH, shutter_s=0.02)
    copter = SimulatedCopter(boot_time_s=0.0, components=[camera])
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        assert vehicle.camera.wait_found().number == vehicle.camera.number == 100
        assert vehicle.cameras.value == (100,)
        capture = vehicle.camera.take_photo()
        assert vehicle.camera.read_picture(capture).startswith(b"\xff\xd8")
        assert vehicle.camera.captures() == [capture]
        assert vehicle.camera.capture.value == capture
        with vehicle.camera.photo_interval(0.1, count=3) as captures:
            assert [capture.index for capture in captures] == [1, 2, 3]
            assert captures.missed == 0
        with vehicle.camera.video():
            assert vehicle.camera.status.wait_until(lambda status: status.is_recording, timeout=100)
        assert not camera.captures.is_recording
        with pytest.raises(NotSupported):
            vehicle.camera.zoom_to(10)
        assert vehicle.camera_at(100).aio is vehicle.camera.aio
