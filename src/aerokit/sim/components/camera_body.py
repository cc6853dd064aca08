"""What a simulated camera is made of, without its commands and messages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

from aerokit.mavlink.enums import CameraCapFlags, CameraMode, CameraSource, MavType
from aerokit.mavlink.messages import CameraImageCaptured
from aerokit.parameters import parse_definition
from aerokit.parameters.definition import CameraDefinition
from aerokit.sim.components.captures import GREY_JPEG, CameraHost, Captures, MemoryCard
from aerokit.sim.components.component import pose_of
from aerokit.sim.components.extended_parameters import ExtendedParameters
from aerokit.sim.components.gimbal import SimulatedGimbal
from aerokit.sim.components.lens import Lens, Tracking
from aerokit.sim.file_tree import FileTree

DEFINITION_PATH = "/camera_definition.xml"
"""Where the camera serves its definition by MAVFTP."""
CAPABILITIES = (
    CameraCapFlags.CAPTURE_IMAGE
    | CameraCapFlags.CAPTURE_VIDEO
    | CameraCapFlags.HAS_MODES
    | CameraCapFlags.HAS_BASIC_ZOOM
    | CameraCapFlags.HAS_BASIC_FOCUS
)


def own_definition() -> bytes:
    """The file of cameras that were given no other."""
    return Path(__file__).with_name("camera_definition.xml").read_bytes()


class CameraBody(CameraHost):
    """Lens, card and shutter, and what it is set to; see `SimulatedCamera` for the arguments."""

    TYPE: ClassVar[int] = MavType.CAMERA

    parameters: ExtendedParameters
    """Its settings, once it is on a vehicle."""

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
        """What it serves by MAVFTP: the definition, and the pictures on its card in ``/DCIM``."""
        self.resolution = resolution
        self.streams: tuple[str, ...] = tuple(streams)
        self.gimbal = gimbal
        self.image_mib: float = image_mib
        self.video_mib_s: float = video_mib_s
        self.shutter_s: float = shutter_s
        self.thermal_celsius: tuple[float, float] | None = thermal_celsius
        self.picture = picture
        self.capabilities: int = capabilities | (CameraCapFlags.HAS_VIDEO_STREAM if streams else 0)
        self.capabilities |= CameraCapFlags.HAS_THERMAL_RANGE if thermal_celsius else 0
        self.card: MemoryCard = MemoryCard(capacity_mib)
        self.captures: Captures = Captures(self)
        self.running_streams: set[int] = set()
        """Numbers, from 1, of the streams that run."""
        self.mode: int = CameraMode.IMAGE
        """CAMERA_MODE."""
        self.source: int = CameraSource.DEFAULT
        """CAMERA_SOURCE of the sensor that is shown."""
        self.lens: Lens = Lens(lambda: self.now)
        self.tracking: Tracking = Tracking(self)

    @property
    def zoom(self) -> float:
        """In percent."""
        return self.lens.zoom.percent

    @property
    def focus(self) -> float:
        """In percent."""
        return self.lens.focus.percent

    @property
    def image_count(self) -> int:
        """Pictures on the card."""
        return len(self.captures.images)

    def angles(self) -> tuple[float, float, float] | None:
        """Roll, pitch and yaw in radians of what it looks at, yaw from north; None when nobody knows."""
        pose = pose_of(self.vehicle)
        if self.gimbal is not None:
            roll, pitch, yaw = self.gimbal.angles_from_north()
            return roll, pitch, yaw
        return None if pose is None else (pose.roll, pose.pitch, pose.yaw)

    def reset_settings(self) -> None:
        """Mode, zoom and focus as they were from the factory."""
        self.mode, self.source = CameraMode.IMAGE, CameraSource.DEFAULT
        self.lens.zoom.set(0.0)
        self.lens.focus.set(0.0)

    def start(self) -> None:
        """The power comes on; streams run at once."""
        self.captures.switch_off()
        self.reset_settings()
        self.parameters.restart()
        self.tracking.reset()
        self.running_streams = set(range(1, len(self.streams) + 1))

    def clear_files(self) -> None:
        """Have no pictures any more."""
        for name, _ in self.files.entries("/DCIM") if "/DCIM" in self.files else ():
            self.files.remove_file(f"/DCIM/{name}")

    def keep(self, image: CameraImageCaptured) -> str:
        path = f"/DCIM/IMG_{len(self.captures.images) + 1:04d}.JPG"
        picture = self.picture
        self.files.put(path, picture if isinstance(picture, bytes) else picture(image))
        return f"mftp://{path}"
