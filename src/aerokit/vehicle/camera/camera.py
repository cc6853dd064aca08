"""``Camera``: one camera of a vehicle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.arguments import checks_arguments
from aerokit.read_only import ReadOnly
from aerokit.vehicle.camera.lens import LensCalls
from aerokit.vehicle.camera.photos import PhotoCalls
from aerokit.vehicle.camera.storing import StorageCalls
from aerokit.vehicle.camera.tracking import TrackingCalls
from aerokit.vehicle.camera.values import CameraInformation
from aerokit.vehicle.camera.videos import VideoCalls

if TYPE_CHECKING:
    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.camera.line import CameraLine

__all__ = ["Camera"]


@checks_arguments
class Camera(ReadOnly, PhotoCalls, VideoCalls, LensCalls, TrackingCalls, StorageCalls):
    """One camera: pictures, video, lens, tracking, storage, streams (https://mavlink.io/en/services/camera.html).

    ``vehicle.camera`` is the first one that is heard, ``vehicle.camera_at(number)`` any: one with a component id of its
    own (100 to 105), or behind the autopilot (1 to 6), which are ArduPilot's own drivers and PX4's trigger. What a
    camera says that it cannot do is refused before anything is sent. Cells are asked for while somebody looks at them.
    """

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.information: StateCell[CameraInformation] = line.information
        """What it is (CAMERA_INFORMATION): asked for once, by the first call."""

    @property
    def number(self) -> int | None:
        """1 to 6 behind the autopilot, otherwise its component id; None before the first camera was heard."""
        return self._line.number

    async def wait_found(self, *, timeout: float = 10.0) -> CameraInformation:
        """Wait until the camera is heard and says what it is; other calls do so by themselves.

        Raises:
            CommandRejected: it does not say what it is.
            OperationTimeout: none was heard, or it does not say what it is: PX4's trigger never does.
        """
        found: CameraInformation | None = None
        with anyio.move_on_after(timeout):
            found = await self._line.find()
        if found is None:
            raise self._line.timed_out(f"says nothing of itself; waited for {timeout:g} s at most")
        return found

    def __repr__(self) -> str:
        return f"<Camera {self._line.describe().removeprefix('camera ')}>"
