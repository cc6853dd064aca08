"""Zoom and focus."""

from __future__ import annotations

from typing import Literal

from aerokit.arguments import checks_arguments
from aerokit.mavlink.enums import CameraZoomType, MavCmd, SetFocusType
from aerokit.vehicle.camera.part import CameraBlock, CameraPart
from aerokit.vehicle.checks import check_range

__all__ = ["AutoFocus", "LensCalls"]

ZOOM, FOCUS = MavCmd.SET_CAMERA_ZOOM, MavCmd.SET_CAMERA_FOCUS
SUBJECTS: dict[int, str] = {ZOOM: "zoom", FOCUS: "focus"}
AutoFocus = Literal["auto", "single", "continuous"]
AUTO: dict[str, int] = {
    "auto": SetFocusType.AUTO,
    "single": SetFocusType.AUTO_SINGLE,
    "continuous": SetFocusType.AUTO_CONTINUOUS,
}
HAS_ZOOM, HAS_FOCUS = "has_basic_zoom", "has_basic_focus"


@checks_arguments
class LensCalls(CameraPart):
    """Zoom and focus: by steps, as long as a block lasts, and to a value."""

    async def zoom_step(self, steps: int) -> None:
        """Zoom in by so many steps of the camera's own, out if negative (MAV_CMD_SET_CAMERA_ZOOM).

        Not sent again without an answer: a step would be made twice.

        Args:
            steps: −100 to 100.

        Raises:
            InvalidArgument: ``steps`` is out of range. Nothing was sent.
            NotSupported: the camera has no zoom. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer; it may have zoomed.
            OperationTimeout: no camera was heard.
        """
        check_range("steps", steps, -100, 100)
        await self._set("zoom_step", HAS_ZOOM, ZOOM, CameraZoomType.STEP, steps, attempts=1)

    async def zoom_to(self, percent: float) -> None:
        """Zoom to a part of the range: 0 (widest) to 100 %; errors are those of :meth:`zoom_step`."""
        check_range("percent", percent, 0, 100)
        await self._set("zoom_to", HAS_ZOOM, ZOOM, CameraZoomType.RANGE, percent)

    async def zoom_to_focal_length(self, millimetres: float) -> None:
        """Zoom to a focal length, above 0 to 10,000 mm; errors are those of :meth:`zoom_step`."""
        check_range("millimetres", millimetres, 0, 10_000, above=True)
        await self._set("zoom_to_focal_length", HAS_ZOOM, ZOOM, CameraZoomType.FOCAL_LENGTH, millimetres)

    def zooming(self, speed: float = 1.0) -> CameraBlock:
        """Zoom for as long as an ``async with`` block lasts; it stops with it, also under cancellation.

        Entering raises what :meth:`zoom_step` does.

        Args:
            speed: −1 (out) to 1 (in); most cameras know these two.

        Raises:
            InvalidArgument: ``speed`` is out of range. Nothing was sent.
        """
        check_range("speed", speed, -1, 1)
        return self._moving("zooming", HAS_ZOOM, ZOOM, CameraZoomType.CONTINUOUS, speed)

    async def focus_step(self, steps: int) -> None:
        """Focus farther by so many steps of the camera's own, nearer if negative (MAV_CMD_SET_CAMERA_FOCUS).

        Not sent again without an answer: a step would be made twice.

        Args:
            steps: −100 to 100.

        Raises:
            InvalidArgument: ``steps`` is out of range. Nothing was sent.
            NotSupported: the camera cannot be focused. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer; it may have moved.
            OperationTimeout: no camera was heard.
        """
        check_range("steps", steps, -100, 100)
        await self._set("focus_step", HAS_FOCUS, FOCUS, SetFocusType.STEP, steps, attempts=1)

    async def focus_to(self, percent: float) -> None:
        """Focus to a part of the range: 0 (nearest) to 100 %; errors are those of :meth:`focus_step`."""
        check_range("percent", percent, 0, 100)
        await self._set("focus_to", HAS_FOCUS, FOCUS, SetFocusType.RANGE, percent)

    async def focus_at(self, metres: float) -> None:
        """Focus at a distance, above 0 to 100,000 m; errors are those of :meth:`focus_step`."""
        check_range("metres", metres, 0, 100_000, above=True)
        await self._set("focus_at", HAS_FOCUS, FOCUS, SetFocusType.METERS, metres)

    async def auto_focus(self, kind: AutoFocus = "auto") -> None:
        """Have the camera focus by itself: ``"auto"`` as it likes, ``"single"`` once, ``"continuous"`` from now on.

        Raises:
            NotSupported: the camera cannot be focused. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._set("auto_focus", HAS_FOCUS, FOCUS, AUTO[kind], 0)

    def focusing(self, speed: float = 1.0) -> CameraBlock:
        """Move the focus for as long as an ``async with`` block lasts; it stops with it, also under cancellation.

        Entering raises what :meth:`focus_step` does.

        Args:
            speed: −1 (nearer) to 1 (farther); most cameras know these two.

        Raises:
            InvalidArgument: ``speed`` is out of range. Nothing was sent.
        """
        check_range("speed", speed, -1, 1)
        return self._moving("focusing", HAS_FOCUS, FOCUS, SetFocusType.CONTINUOUS, speed)

    async def _set(
        self, action: str, capability: str, command: int, kind: int, value: float, *, attempts: int = 4
    ) -> None:
        await self._line.able(action, capability)
        with self._line.giving(SUBJECTS[command]) as given:
            await self._line.order(command, kind, value, self._line.device, given=given, attempts=attempts)

    def _moving(self, action: str, capability: str, command: int, kind: int, speed: float) -> CameraBlock:
        line = self._line
        return CameraBlock(
            line,
            SUBJECTS[command],
            lambda: line.able(action, capability),
            lambda given: line.order(command, kind, speed, line.device, given=given),
            lambda: (command, kind, 0, line.device),
        )
