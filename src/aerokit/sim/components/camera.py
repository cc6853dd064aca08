"""`SimulatedCamera`: a camera component that implements the MAVLink camera protocol.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from aerokit.mavlink.enums import (
    CameraCapFlags,
    CameraMode,
    CameraSource,
    MavCmd,
    MavResult,
    MavType,
    StorageStatus,
    StorageType,
    StorageUsageFlag,
)
from aerokit.mavlink.messages import CameraImageCaptured, CameraTrackingGeoStatus, StorageInformation
from aerokit.parameters import SettingValue, parse_definition
from aerokit.parameters.definition import CameraDefinition
from aerokit.protocols.servers.camera import (
    AsyncHandler,
    camera_builders,
    camera_commands,
    camera_settings,
    legacy_requests,
)
from aerokit.protocols.servers.camera_device import CameraDevice
from aerokit.protocols.servers.commands import CommandHandler, CommandProgress, ReceivedCommand
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.host import ServerHost
from aerokit.protocols.servers.intervals import Builder
from aerokit.sim.components.captures import FOCAL_LENGTH_MM, GREY_JPEG, Lens, MemoryCard, captured_image
from aerokit.sim.components.component import ExtendedParameters, SimulatedComponent, pose_of, serve_files
from aerokit.sim.components.gimbal import SimulatedGimbal
from aerokit.sim.motion import LocalFrame

_SENSOR_MM = (6.17, 4.63)
_STORAGE_ID = 1
_READ_MIB_S, _WRITE_MIB_S = 90.0, 45.0
# With a pitch above this limit, the optical axis meets the ground too far away or not at all.
_MAX_GROUND_PITCH_RAD = -math.radians(5)
_UNKNOWN, _ACCURACY_M = math.nan, 1.0
DEFINITION_PATH = "/camera_definition.xml"
"""MAVFTP path of the camera definition."""
CAPABILITIES = (
    CameraCapFlags.CAPTURE_IMAGE
    | CameraCapFlags.CAPTURE_VIDEO
    | CameraCapFlags.HAS_MODES
    | CameraCapFlags.HAS_BASIC_ZOOM
    | CameraCapFlags.HAS_BASIC_FOCUS
)


def own_definition() -> bytes:
    return Path(__file__).with_name("camera_definition.xml").read_bytes()


MODE, EXPOSURE, ISO, SHUTTER = "CAM_MODE", "CAM_EXPMODE", "CAM_ISO", "CAM_SHUTTER"
AUTO, AUTO_ISO, AUTO_SHUTTER_S = 0, 200, 0.002
MAX_VIDEO_ISO = 400


class CameraParameters(ExtendedParameters):
    """The settings of the camera (PARAM_EXT). During a capture or a recording, the mode cannot be set."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self._camera = camera
        super().__init__(camera, camera.definition)

    def refresh(self) -> None:
        values, camera = self.values, self._camera
        if MODE in values:
            values[MODE] = int(camera.mode)
        has_iso_and_shutter = {ISO, SHUTTER} <= values.keys()
        if values.get(EXPOSURE) == AUTO and has_iso_and_shutter:
            values[ISO] = AUTO_ISO
            values[SHUTTER] = AUTO_SHUTTER_S
        iso = values.get(ISO)
        if camera.mode == CameraMode.VIDEO and isinstance(iso, int) and iso > MAX_VIDEO_ISO:
            values[ISO] = MAX_VIDEO_ISO

    def can_set(self, name: str) -> bool:
        captures = self._camera.captures
        return name != MODE or not (captures.is_busy or captures.is_recording)

    def on_set(self, name: str, value: SettingValue) -> None:
        if name == MODE and isinstance(value, int) and value != self._camera.mode:
            self._camera.mode = value
            self._camera.send(camera_settings(self._camera))


_FORMAT_INTERVAL_S, _FORMAT_PERCENTS = 0.5, (0, 25, 50, 75)


def _format(camera: SimulatedCamera, command: ReceivedCommand) -> int | CommandProgress:
    captures = camera.captures
    is_card_known = command.param1 in (0.0, 1.0)  # STORAGE_FORMAT: 0 selects all cards; there is one card.
    if not is_card_known or not camera.card.is_inserted:
        return MavResult.DENIED
    if captures.is_busy or captures.is_recording:
        return MavResult.TEMPORARILY_REJECTED

    formats_card, resets_image_log = command.param2 == 1.0, command.param3 == 1.0

    def finish() -> None:
        if formats_card:
            camera.card.used_mib = 0.0
            camera.files.clear_folder("/DCIM")
        if resets_image_log:
            captures.clear()

    return CommandProgress(_FORMAT_PERCENTS, _FORMAT_INTERVAL_S, finish=finish)


def _synchronous(handler: AsyncHandler) -> CommandHandler:
    """Return a synchronous version of a handler that never has to wait."""

    def execute(command: ReceivedCommand) -> int:
        try:
            handler(command).send(None)  # runs the coroutine until it waits or returns
        except StopIteration as end:  # A coroutine returns its value by this exception.
            return int(end.value)
        raise AssertionError("a command handler of the simulated camera must not wait, but it did")

    return execute


class SimulatedCamera(SimulatedComponent, CameraDevice):
    """Camera component that takes images, series and videos, with the true position and attitude of each image.

    - ``component_id``: MAVLink reserves 100 to 105 for cameras; ``system_id``: None uses that of the vehicle
    - ``vendor``, ``model``, ``definition_uri``, ``capabilities`` (CAMERA_CAP_FLAGS), ``resolution`` (pixels):
      content of CAMERA_INFORMATION. Without HAS_MODES it takes images and videos at any time.
    - ``streams``: addresses of video streams, such as ``rtsp://192.168.0.10:8554/main``; no video is sent
    - ``thermal_celsius``: lowest and highest temperature in the image of a thermal camera; None for a visible-light
      camera. The last stream of a thermal camera is the thermal stream.
    - ``picture``: content of image files (JPEG), or a function that returns it for a `Capture`; the files are in
      ``/DCIM`` and served by MAVFTP
    - ``gimbal``: the gimbal that carries the camera and determines the direction of images
    - ``capacity_mib``, ``image_mib``, ``video_mib_s``: size of the card, of an image, of a second of video
    - ``shutter_s``: seconds until an image is available

    ``definition`` defines the settings (PARAM_EXT); the default is ``camera_definition.xml`` beside this file. The
    camera serves the definition by MAVFTP. ``definition_uri`` announces another location; "" announces none.

    Images, settings and files survive a reboot; modes and series do not. A tracked target is kept until
    ``tracking.lose()``.
    """

    TYPE: ClassVar[int] = MavType.CAMERA
    ALL_CAPABILITIES: ClassVar[int] = (
        CAPABILITIES
        | CameraCapFlags.HAS_IMAGE_SURVEY_MODE
        | CameraCapFlags.HAS_TRACKING_POINT
        | CameraCapFlags.HAS_TRACKING_RECTANGLE
        | CameraCapFlags.HAS_TRACKING_GEO_STATUS
    )
    """Value for ``capabilities`` that adds survey mode and tracking to the default."""

    parameters: ExtendedParameters
    """Settings, which exist once the camera has joined a vehicle."""

    def __init__(
        self,
        component_id: int = 100,
        *,
        system_id: int | None = None,
        vendor: str = "aerokit",
        model: str = "Simulated camera",
        definition: bytes | None = None,
        definition_uri: str | None = None,
        capabilities: int = CAPABILITIES,
        resolution: tuple[int, int] = (4000, 3000),
        streams: Sequence[str] = (),
        thermal_celsius: tuple[float, float] | None = None,
        gimbal: SimulatedGimbal | None = None,
        capacity_mib: float = 8192.0,
        image_mib: float = 5.0,
        video_mib_s: float = 10.0,
        shutter_s: float = 0.2,
        picture: bytes | Callable[[CameraImageCaptured], bytes] = GREY_JPEG,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.host: ServerHost = self
        self.vendor: str = vendor
        self.model: str = model
        content = own_definition() if definition is None else definition
        self.definition: CameraDefinition = parse_definition(content)
        self.definition_uri = f"mftp://{DEFINITION_PATH}" if definition_uri is None else definition_uri
        self.files: FileTree = FileTree().put(DEFINITION_PATH, content)
        """Files served by MAVFTP: the definition, and images in ``/DCIM``."""
        self.resolution = resolution
        self.streams: tuple[str, ...] = tuple(streams)
        self.gimbal = gimbal
        self.image_mib: float = image_mib
        self.video_mib_s: float = video_mib_s
        self.shutter_s: float = shutter_s
        self.thermal_celsius: tuple[float, float] | None = thermal_celsius
        self.picture = picture
        self.capabilities: int = capabilities
        if streams:
            self.capabilities |= CameraCapFlags.HAS_VIDEO_STREAM
        if thermal_celsius:
            self.capabilities |= CameraCapFlags.HAS_THERMAL_RANGE
        self.definition_version: int = self.definition.version
        self.sensor_mm: tuple[float, float] = _SENSOR_MM
        self.focal_length_mm: float = FOCAL_LENGTH_MM
        self.card: MemoryCard = MemoryCard(capacity_mib)
        self.set_up_captures()
        self.mode: int = CameraMode.IMAGE
        """CAMERA_MODE."""
        self.source: int = CameraSource.DEFAULT
        """CAMERA_SOURCE of the displayed sensor."""
        self.lens: Lens = Lens(lambda: self.now)

    @property
    def free_mib(self) -> float:
        return self.card.free_mib

    def has_space(self) -> bool:
        return self.card.free_mib >= self.image_mib

    @property
    def gimbal_device_id(self) -> int:
        return 0 if self.gimbal is None else self.gimbal.component_id

    def storage(self, number: int) -> list[StorageInformation]:
        card = self.card
        if number not in (0, _STORAGE_ID):
            return []
        return [
            StorageInformation(
                time_boot_ms=self.time_boot_ms, storage_id=_STORAGE_ID, storage_count=1,
                status=StorageStatus.READY if card.is_inserted else StorageStatus.EMPTY,
                total_capacity=card.capacity_mib if card.is_inserted else 0.0,
                used_capacity=card.used_mib if card.is_inserted else 0.0, available_capacity=card.free_mib,
                read_speed=_READ_MIB_S, write_speed=_WRITE_MIB_S, type=StorageType.MICROSD, name="SD",
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]  # fmt: skip

    def tracked_place(self) -> list[CameraTrackingGeoStatus]:
        """Return CAMERA_TRACKING_GEO_STATUS for the point where the optical axis meets the ground."""
        pose, angles = pose_of(self.vehicle), self.angles()
        if pose is None or angles is None:
            return []
        _, pitch, yaw = angles
        if pitch > _MAX_GROUND_PITCH_RAD:
            return []
        # The ground is level, at the altitude of home.
        distance = pose.height_m / math.tan(-pitch)
        place = LocalFrame(pose.place).to_global(distance * math.cos(yaw), distance * math.sin(yaw), pose.height_m)
        return [
            CameraTrackingGeoStatus(
                tracking_status=self.tracking.flags, lat=place.latitude_e7, lon=place.longitude_e7,
                alt=place.altitude_m, h_acc=_ACCURACY_M, v_acc=_ACCURACY_M, vel_n=0.0, vel_e=0.0, vel_d=0.0,
                vel_acc=_UNKNOWN, dist=math.hypot(distance, pose.height_m), hdg=_UNKNOWN, hdg_acc=_UNKNOWN,
            )
        ]  # fmt: skip

    @property
    def zoom(self) -> float:
        return self.lens.zoom.percent

    @property
    def focus(self) -> float:
        return self.lens.focus.percent

    @property
    def image_count(self) -> int:
        """Number of images on the card."""
        return self.captures.image_count

    def angles(self) -> tuple[float, float, float] | None:
        """Roll, pitch and yaw (from north) of the view in radians; None if unknown."""
        if self.gimbal is not None:
            return self.gimbal.angles_from_north()
        pose = pose_of(self.vehicle)
        return None if pose is None else (pose.roll, pose.pitch, pose.yaw)

    async def stop_video(self) -> None:
        """Stop the recording and store the video on the card."""
        seconds = self.captures.stop_recording()
        self.card.store(min(self.card.free_mib, seconds * self.video_mib_s))

    async def set_zoom(self, kind: int, value: float) -> bool:
        return self.lens.set_zoom(kind, value)

    async def set_focus(self, kind: int, value: float) -> bool:
        return self.lens.set_focus(kind, value)

    async def set_source(self, source: int) -> bool:
        """Select the sensor. RGB is accepted, and on a thermal camera also IR."""
        is_thermal = self.thermal_celsius is not None
        return source in (CameraSource.DEFAULT, CameraSource.RGB) or (source == CameraSource.IR and is_thermal)

    async def reset_settings(self) -> None:
        self.reset_lens()
        self.parameters.reset()

    def reset_lens(self) -> None:
        """Restore the default mode, zoom and focus."""
        self.mode, self.source = CameraMode.IMAGE, CameraSource.DEFAULT
        self.lens.zoom.set(0.0)
        self.lens.focus.set(0.0)

    def start(self) -> None:
        """Called at power-on. All video streams start at once."""
        self.captures.switch_off()
        self.reset_lens()
        self.parameters.restart()
        self.tracking.reset()
        self.running_streams: set[int] = set(range(1, len(self.streams) + 1))

    def builders(self) -> dict[int, Builder]:
        return camera_builders(self)

    def expose(self, done: Callable[[CameraImageCaptured | None], None]) -> None:
        # CAMERA_IMAGE_CAPTURED has the camera id 0 if the camera is a separate component, not part of an autopilot.
        image = captured_image(self.vehicle, self.time_boot_ms, self.angles(), camera_id=0)
        self.call_later(self.shutter_s, lambda: done(image))

    def store_image(self, image: CameraImageCaptured) -> str | None:
        if not self.card.store(self.image_mib):
            return None
        path = f"/DCIM/IMG_{self.captures.image_count + 1:04d}.JPG"
        picture = self.picture
        self.files.put(path, picture if isinstance(picture, bytes) else picture(image))
        return f"mftp://{path}"

    def listen(self) -> None:
        """Serve files by MAVFTP and settings by PARAM_EXT."""
        serve_files(self, self.files)
        self.parameters = CameraParameters(self)

    def commands(self) -> dict[int, CommandHandler]:
        return {
            **{command: _synchronous(handler) for command, handler in camera_commands(self).items()},
            MavCmd.STORAGE_FORMAT: lambda command: _format(self, command),
            **legacy_requests(self._streams),
        }
