"""Zoom and focus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraZoomType, MavCmd, SetFocusType
from aerokit.vehicle.camera.part import CameraBlock, CameraPart
from aerokit.vehicle.camera.values import (
    MODES,
    ModeName,
    Storage,
    TrackedPlace,
    TrackingStatus,
    known,
    mode_of,
    storage_of,
    tracked_place_of,
    tracking_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Detach
    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.camera.link import CameraLine

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


SETTINGS_S, STORAGE_S = 5.0, 5.0

ASK_S, AGAIN_S = 1.0, 0.5

FORMATTING_S = 60.0


@checks_arguments
class StorageCalls(CameraPart):
    """What the camera is set to, and what it keeps pictures on."""

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.mode: StateCell[str] = line.asked_cell("camera.mode", m.CameraSettings, SETTINGS_S)
        """``"photo"``, ``"video"`` or ``"survey"`` (CAMERA_SETTINGS), which a camera tells when it changes; asked for
        every 5 s while somebody looks at this cell, as the next two."""
        self.zoom_percent: StateCell[float | None] = line.asked_cell(
            "camera.zoom_percent", m.CameraSettings, SETTINGS_S
        )
        """0 (widest) to 100; None while the camera does not know."""
        self.focus_percent: StateCell[float | None] = line.asked_cell(
            "camera.focus_percent", m.CameraSettings, SETTINGS_S
        )
        """0 (nearest) to 100; None while the camera does not know."""
        self.storage: StateCell[tuple[Storage, ...]] = line.asked_cell(
            "camera.storage", m.StorageInformation, STORAGE_S
        )
        """Its storage media by their numbers; asked for every 5 s while somebody looks at this cell."""
        self._media: dict[int, Storage] = {}
        line.listen(m.CameraSettings, self._on_settings)
        line.listen(m.StorageInformation, self._on_storage)

    async def set_mode(self, mode: ModeName, *, timeout: float = 5.0) -> None:
        """Change the mode (MAV_CMD_SET_CAMERA_MODE); returns when the camera tells that it is in it.

        A camera that tells no mode (CAMERA_SETTINGS) is believed when it accepts.

        Args:
            mode: ``"photo"``, ``"video"`` or ``"survey"``.
            timeout: seconds until it must be told.

        Raises:
            NotSupported: the camera has no modes. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or does not know this one.
            CommandTimeout: it did not answer.
            OperationTimeout: it accepted, and tells another mode; or no camera was heard.
        """
        await self._line.able("set_mode", "has_modes")
        with self._line.giving("mode") as given:
            await self._line.order(MavCmd.SET_CAMERA_MODE, self._line.device, MODES[mode], given=given)
        told = ""
        with anyio.move_on_after(timeout):
            while told != mode:
                message = await self._line.ask(m.CameraSettings, timeout=ASK_S)
                told = told if message is None else mode_of(message)
                if m.CameraSettings in self._line.untold:
                    return
                if told != mode:
                    await anyio.sleep(AGAIN_S)
            return
        tells = f"tells {told}" if told else "tells no mode"
        raise self._line.timed_out(f"accepted {mode}, and {tells} after {timeout:g} s")

    async def load_storage(self) -> tuple[Storage, ...]:
        """Ask for the storage media (STORAGE_INFORMATION).

        Raises:
            OperationTimeout: none was told of, or no camera was heard.
        """
        await self._line.find()
        if await self._line.ask(m.StorageInformation, 0) is None:
            raise self._line.timed_out("told of no storage")
        return self.storage.value

    async def format_storage(
        self,
        number: int = 1,
        *,
        timeout: float = FORMATTING_S,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> None:
        """Format a storage medium, and clear the log of pictures (MAV_CMD_STORAGE_FORMAT): what is on it is lost.

        Args:
            number: of the medium, 1 to 255.
            timeout: seconds to wait after the order, and after each sign of progress.
            on_progress: called with 0–100, or None.

        Raises:
            InvalidArgument: ``number`` is out of range. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or there is no such medium.
            CommandTimeout: it did not answer; it may be formatting.
            OperationTimeout: no camera was heard.
        """
        check_range("number", number, 1, 255)
        await self._line.find()
        await self._line.order(
            MavCmd.STORAGE_FORMAT, number, 1, 1, attempts=1, progress_timeout=timeout, on_progress=on_progress
        )
        for forget in self._line.on_cleared:
            forget()
        await self._line.ask(m.StorageInformation, 0, timeout=ASK_S)

    async def reset_settings(self) -> None:
        """Set everything as it came from the factory (MAV_CMD_RESET_CAMERA_SETTINGS).

        Raises:
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._line.find()
        with self._line.giving("mode") as given:
            await self._line.order(MavCmd.RESET_CAMERA_SETTINGS, 1, self._line.device, given=given)
        await self._line.ask(m.CameraSettings, timeout=ASK_S)

    def _on_settings(self, message: m.CameraSettings) -> None:
        self._line.tell(self.mode, mode_of(message), message)
        self._line.tell(self.zoom_percent, known(message.zoomLevel), message)
        self._line.tell(self.focus_percent, known(message.focusLevel), message)

    def _on_storage(self, message: m.StorageInformation) -> None:
        medium = storage_of(message)
        self._media = {number: each for number, each in self._media.items() if number <= medium.count}
        self._media[medium.number] = medium
        media = tuple(self._media[number] for number in sorted(self._media))
        self._line.tell(self.storage, media, message)
