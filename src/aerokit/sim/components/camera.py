"""`SimulatedCamera`: a camera that speaks the MAVLink camera protocol with a component id of its own.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import CameraCapFlags, CameraMode, MavType
from aerokit.sim.components.camera_commands import camera_commands
from aerokit.sim.components.camera_messages import camera_builders
from aerokit.sim.components.captures import Captures
from aerokit.sim.components.component import Builder, SimulatedComponent
from aerokit.sim.components.pose import pose_of
from aerokit.sim.components.storage import MemoryCard

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.sim.commands import CommandHandler
    from aerokit.sim.components.gimbal import SimulatedGimbal

__all__ = ["SimulatedCamera"]

_CAPABILITIES = (
    CameraCapFlags.CAPTURE_IMAGE
    | CameraCapFlags.CAPTURE_VIDEO
    | CameraCapFlags.HAS_MODES
    | CameraCapFlags.HAS_BASIC_ZOOM
    | CameraCapFlags.HAS_BASIC_FOCUS
)


class SimulatedCamera(SimulatedComponent):
    """Takes pictures, series and videos, and tells each picture with where it was taken, as the vehicle truly lies.

    - ``component_id``: 100 to 105 are MAVLink's cameras; ``system_id``: None is the vehicle's own
    - ``vendor``, ``model``, ``definition_uri``, ``capabilities`` (CAMERA_CAP_FLAGS), ``resolution`` in pixels: go into
      CAMERA_INFORMATION. Without HAS_MODES it takes both pictures and videos at any time.
    - ``streams``: addresses of its video streams, such as ``rtsp://192.168.0.10:8554/main``; nothing is streamed
    - ``gimbal``: what it hangs on; its pictures look where that points
    - ``capacity_mib``, ``image_mib``, ``video_mib_s``: size of the card, of a picture, of a second of video
    - ``shutter_s``: seconds until a picture is there

    Pictures stay over a reboot, modes and series do not. Not simulated: tracking, thermal ranges, the parameters of a
    camera definition (PARAM_EXT).
    """

    TYPE: ClassVar[int] = MavType.CAMERA

    def __init__(
        self,
        component_id: int = 100,
        *,
        system_id: int | None = None,
        vendor: str = "aerokit",
        model: str = "Simulated camera",
        definition_uri: str = "",
        capabilities: int = _CAPABILITIES,
        resolution: tuple[int, int] = (4000, 3000),
        streams: Sequence[str] = (),
        gimbal: SimulatedGimbal | None = None,
        capacity_mib: float = 8192.0,
        image_mib: float = 5.0,
        video_mib_s: float = 10.0,
        shutter_s: float = 0.2,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.vendor, self.model = vendor, model
        self.definition_uri = definition_uri
        self.resolution = resolution
        self.streams = tuple(streams)
        self.gimbal = gimbal
        self.image_mib, self.video_mib_s, self.shutter_s = image_mib, video_mib_s, shutter_s
        self.capabilities = capabilities | (CameraCapFlags.HAS_VIDEO_STREAM if streams else 0)
        self.card = MemoryCard(capacity_mib)
        self.captures = Captures(self)
        self.running_streams: set[int] = set()
        """Numbers, from 1, of the streams that run."""
        self.mode: int = CameraMode.IMAGE
        """CAMERA_MODE."""
        self.zoom = self.focus = 0.0
        """In percent."""

    @property
    def image_count(self) -> int:
        """Pictures on the card."""
        return len(self.captures.images)

    def can(self, *flags: int) -> bool:
        """Whether it has one of these CAMERA_CAP_FLAGS."""
        return any(self.capabilities & flag for flag in flags)

    def angles(self) -> tuple[float, float, float] | None:
        """Roll, pitch and yaw in radians of what it looks at, yaw from north; None when nobody knows."""
        pose = pose_of(self.vehicle)
        if self.gimbal is not None:
            roll, pitch, yaw = self.gimbal.angles_from_north()
            return roll, pitch, yaw
        return None if pose is None else (pose.roll, pose.pitch, pose.yaw)

    def reset_settings(self) -> None:
        """Mode, zoom and focus as they were from the factory."""
        self.mode, self.zoom, self.focus = CameraMode.IMAGE, 0.0, 0.0

    def start(self) -> None:
        """The power comes on; streams run at once."""
        self.captures.switch_off()
        self.reset_settings()
        self.running_streams = set(range(1, len(self.streams) + 1))

    def commands(self) -> dict[int, CommandHandler]:
        """See `camera_commands`."""
        return camera_commands(self)

    def builders(self) -> dict[int, Builder]:
        """See `camera_builders`."""
        return camera_builders(self)
