"""`SimulatedCamera`: a camera that speaks the MAVLink camera protocol with a component id of its own.

https://mavlink.io/en/services/camera.html
"""

from __future__ import annotations

from typing import ClassVar

from aerokit.mavlink.enums import CameraCapFlags
from aerokit.sim.commands import CommandHandler
from aerokit.sim.components.camera_body import CAPABILITIES, CameraBody
from aerokit.sim.components.camera_commands import CameraParameters, camera_commands
from aerokit.sim.components.camera_messages import camera_builders
from aerokit.sim.components.component import Builder, serve_files


class SimulatedCamera(CameraBody):
    """Takes pictures, series and videos, and tells each picture with where it was taken, as the vehicle truly lies.

    - ``component_id``: 100 to 105 are MAVLink's cameras; ``system_id``: None is the vehicle's own
    - ``vendor``, ``model``, ``definition_uri``, ``capabilities`` (CAMERA_CAP_FLAGS), ``resolution`` in pixels: go into
      CAMERA_INFORMATION. Without HAS_MODES it takes both pictures and videos at any time.
    - ``streams``: addresses of its video streams, such as ``rtsp://192.168.0.10:8554/main``; nothing is streamed
    - ``thermal_celsius``: the coldest and the hottest that it sees, at the edges of its picture; None: it sees light.
      Its last stream is the thermal one.
    - ``picture``: what each picture's file holds, as JPEG, or what makes it of the capture; ``files`` has them
      below ``/DCIM`` and they are given away by MAVFTP
    - ``gimbal``: what it hangs on; its pictures look where that points
    - ``capacity_mib``, ``image_mib``, ``video_mib_s``: size of the card, of a picture, of a second of video
    - ``shutter_s``: seconds until a picture is there

    Its settings (PARAM_EXT) are those of ``camera_definition.xml`` beside this file, which it serves by MAVFTP, or of
    another ``definition``; a ``definition_uri`` names the place that is told instead, an empty one none.

    Pictures, settings and files stay over a reboot, modes and series do not. What it tracks it keeps until
    ``tracking.lose()``.
    """

    ALL_CAPABILITIES: ClassVar[int] = (
        CAPABILITIES
        | CameraCapFlags.HAS_IMAGE_SURVEY_MODE
        | CameraCapFlags.HAS_TRACKING_POINT
        | CameraCapFlags.HAS_TRACKING_RECTANGLE
        | CameraCapFlags.HAS_TRACKING_GEO_STATUS
    )
    """For ``capabilities``: survey mode and tracking, too."""

    def listen(self) -> None:
        """Files by MAVFTP, settings by PARAM_EXT."""
        serve_files(self, self.files)
        self.parameters: CameraParameters = CameraParameters(self)

    def commands(self) -> dict[int, CommandHandler]:
        return camera_commands(self)

    def builders(self) -> dict[int, Builder]:
        return camera_builders(self)
