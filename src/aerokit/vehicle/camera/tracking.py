"""Tracking what is in the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.arguments import checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.camera.decoding import tracked_place_of, tracking_of
from aerokit.vehicle.camera.part import CameraPart
from aerokit.vehicle.camera.values import TrackedPlace, TrackingStatus
from aerokit.vehicle.checks import check_range

if TYPE_CHECKING:
    from aerokit.runtime.bus import Detach
    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.camera.line import CameraLine

__all__ = ["TrackingCalls"]

PLACE_NAMES = ("left", "top", "right", "bottom")


@checks_arguments
class TrackingCalls(CameraPart):
    """Points and rectangles that the camera keeps in sight."""

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.tracking: StateCell[TrackingStatus] = line.cell(
            "camera.tracking", "CAMERA_TRACKING_IMAGE_STATUS"
        )
        """What it tracks in its picture; asked for at a rate from :meth:`track_point` or :meth:`track_rectangle` on."""
        self.tracked_place: StateCell[TrackedPlace] = line.cell(
            "camera.tracked_place", "CAMERA_TRACKING_GEO_STATUS"
        )
        """Where on earth that is, of a camera that can tell; asked for in the same way."""
        self._releases: list[Detach] = []
        line.listen(
            m.CameraTrackingImageStatus, lambda each: line.tell(self.tracking, tracking_of(each), each)
        )
        line.listen(
            m.CameraTrackingGeoStatus,
            lambda each: line.tell(self.tracked_place, tracked_place_of(each), each),
        )

    async def track_point(self, x: float, y: float, *, radius: float = 0.0, status_hz: float = 5.0) -> None:
        """Track what is at a point of the picture (MAV_CMD_CAMERA_TRACK_POINT), until :meth:`stop_tracking`.

        Returns when the camera has accepted; ``camera.tracking`` tells whether it holds it.

        Args:
            x: 0 (left) to 1 (right).
            y: 0 (top) to 1 (bottom).
            radius: part of the picture's width, 0 (one pixel) to 1.
            status_hz: how often it shall tell, above 0 to 50.

        Raises:
            InvalidArgument: an argument is out of range. Nothing was sent.
            NotSupported: the camera cannot track a point. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        for name, value in (("x", x), ("y", y), ("radius", radius)):
            check_range(name, value, 0, 1)
        check_range("status_hz", status_hz, 0, 50, above=True)
        await self._line.able("track_point", "has_tracking_point")
        await self._track(MavCmd.CAMERA_TRACK_POINT, x, y, radius)
        self._ask(status_hz)

    async def track_rectangle(
        self, left: float, top: float, right: float, bottom: float, *, status_hz: float = 5.0
    ) -> None:
        """Track what is in a rectangle of the picture (MAV_CMD_CAMERA_TRACK_RECTANGLE), until :meth:`stop_tracking`.

        Args:
            left: 0 to 1.
            top: 0 to 1.
            right: 0 to 1, right of ``left``.
            bottom: 0 to 1, below ``top``.
            status_hz: how often it shall tell, above 0 to 50.

        Raises:
            InvalidArgument: an argument is out of range, or the rectangle is none. Nothing was sent.
            NotSupported: the camera cannot track a rectangle. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        for name, value in zip(PLACE_NAMES, (left, top, right, bottom), strict=True):
            check_range(name, value, 0, 1)
        check_range("status_hz", status_hz, 0, 50, above=True)
        if left >= right or top >= bottom:
            raise InvalidArgument(
                f"left = {left:g}, top = {top:g}, right = {right:g}, bottom = {bottom:g} is no rectangle"
            )
        await self._line.able("track_rectangle", "has_tracking_rectangle")
        await self._track(MavCmd.CAMERA_TRACK_RECTANGLE, left, top, right, bottom)
        self._ask(status_hz)

    async def stop_tracking(self) -> None:
        """Track nothing any more (MAV_CMD_CAMERA_STOP_TRACKING).

        Raises:
            NotSupported: the camera cannot track. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._line.able("stop_tracking", "has_tracking_point", "has_tracking_rectangle")
        try:
            await self._track(MavCmd.CAMERA_STOP_TRACKING)
        finally:
            self._release()

    async def _track(self, command: int, *params: float) -> None:
        with self._line.giving("tracking") as given:
            await self._line.order(command, *params, self._line.device, given=given)

    def _ask(self, status_hz: float) -> None:
        self._release()
        information = self._line.information.latest
        kinds: list[type[m.CameraTrackingImageStatus | m.CameraTrackingGeoStatus]] = [
            m.CameraTrackingImageStatus
        ]
        if information is None or information.can("has_tracking_geo_status"):
            kinds.append(m.CameraTrackingGeoStatus)
        self._releases = [self._line.want(each, status_hz) for each in kinds]

    def _release(self) -> None:
        while self._releases:
            self._releases.pop()()
