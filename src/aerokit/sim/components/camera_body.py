"""State and messages of a simulated camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from aerokit.mavlink.enums import CameraCapFlags, CameraMode, CameraSource, MavType
from aerokit.mavlink.messages import CameraImageCaptured, CameraTrackingGeoStatus, StorageInformation
from aerokit.parameters import parse_definition
from aerokit.parameters.definition import CameraDefinition
from aerokit.protocols.servers.camera import camera_builders
from aerokit.protocols.servers.camera_device import CameraDevice
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.host import ServerHost
from aerokit.protocols.servers.intervals import Builder
from aerokit.sim.components.captures import FOCAL_LENGTH_MM, GREY_JPEG, Lens, MemoryCard, captured_image, tracked_place
from aerokit.sim.components.component import ExtendedParameters, SimulatedComponent, pose_of
from aerokit.sim.components.gimbal import SimulatedGimbal

_SENSOR_MM = (6.17, 4.63)
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


class CameraBody(SimulatedComponent, CameraDevice):
    """Base of `SimulatedCamera`, with lens, card, shutter and settings. See that class for the arguments."""

    TYPE: ClassVar[int] = MavType.CAMERA

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
    def host(self) -> ServerHost:
        return self

    @property
    def free_mib(self) -> float:
        return self.card.free_mib

    def has_space(self) -> bool:
        return self.card.free_mib >= self.image_mib

    @property
    def gimbal_device_id(self) -> int:
        return 0 if self.gimbal is None else self.gimbal.component_id

    def storage(self, number: int) -> list[StorageInformation]:
        return self.card.information(self, number)

    def tracked_place(self) -> list[CameraTrackingGeoStatus]:
        return tracked_place(self, self.tracking.flags, self.angles())

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

    def clear_files(self) -> None:
        """Delete all images."""
        self.files.clear_folder("/DCIM")

    def expose(self, done: Callable[[CameraImageCaptured | None], None]) -> None:
        # A camera that is a separate component has the id 0.
        image = captured_image(self.vehicle, self.time_boot_ms, self.angles(), camera_id=0)
        self.call_later(self.shutter_s, lambda: done(image))

    def store_image(self, image: CameraImageCaptured) -> str | None:
        if not self.card.store(self.image_mib):
            return None
        path = f"/DCIM/IMG_{self.captures.image_count + 1:04d}.JPG"
        picture = self.picture
        self.files.put(path, picture if isinstance(picture, bytes) else picture(image))
        return f"mftp://{path}"
