"""Lens, tracking and storage of a camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CameraZoomType, MavCmd, SetFocusType
from aerokit.vehicle.camera.link import CameraBlock, CameraMixin
from aerokit.vehicle.camera.values import (
    MODES,
    CameraStorage,
    ModeName,
    TrackedPlace,
    TrackingStatus,
    finite_or_none,
    mode_of,
    storage_of,
    tracked_place_of,
    tracking_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Detach
    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.camera.link import CameraLink

ZOOM, FOCUS = MavCmd.SET_CAMERA_ZOOM, MavCmd.SET_CAMERA_FOCUS

ORDER_SUBJECTS: dict[int, str] = {ZOOM: "zoom", FOCUS: "focus"}

AutoFocus = Literal["auto", "single", "continuous"]

AUTO_FOCUS_TYPES: dict[str, int] = {
    "auto": SetFocusType.AUTO,
    "single": SetFocusType.AUTO_SINGLE,
    "continuous": SetFocusType.AUTO_CONTINUOUS,
}

HAS_ZOOM, HAS_FOCUS = "has_basic_zoom", "has_basic_focus"


@checks_arguments
class LensMixin(CameraMixin):
    """Zoom and focus: by steps, to a value, or at a speed for the duration of a block."""

    async def zoom_step(self, steps: int) -> None:
        """Zoom in by a number of steps, or out if the number is negative (MAV_CMD_SET_CAMERA_ZOOM).

        The camera defines the size of a step. An unanswered command is not retried, because the camera could make the
        step twice.

        Args:
            steps: −100 to 100.

        Raises:
            InvalidArgument: ``steps`` is out of range. Nothing was sent.
            NotSupported: the camera has no zoom. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: the camera did not answer; it may have zoomed.
            OperationTimeout: no camera was found.
        """
        check_range("steps", steps, -100, 100)
        await self._set("zoom_step", HAS_ZOOM, ZOOM, CameraZoomType.STEP, steps, attempts=1)

    async def zoom_to(self, percent: float) -> None:
        """Zoom to a percentage of the range, 0 (widest) to 100; errors as for :meth:`zoom_step`."""
        check_range("percent", percent, 0, 100)
        await self._set("zoom_to", HAS_ZOOM, ZOOM, CameraZoomType.RANGE, percent)

    async def zoom_to_focal_length(self, millimetres: float) -> None:
        """Zoom to a focal length, above 0 and at most 10,000 mm; errors as for :meth:`zoom_step`."""
        check_range("millimetres", millimetres, 0, 10_000, above=True)
        await self._set("zoom_to_focal_length", HAS_ZOOM, ZOOM, CameraZoomType.FOCAL_LENGTH, millimetres)

    def zooming(self, speed: float = 1.0) -> CameraBlock:
        """Zoom for the duration of an ``async with`` block.

        The end of the block stops the zoom, also under cancellation. Entering raises as :meth:`zoom_step`.

        Args:
            speed: −1 (out) to 1 (in); many cameras support only these two values.

        Raises:
            InvalidArgument: ``speed`` is out of range. Nothing was sent.
        """
        check_range("speed", speed, -1, 1)
        return self._continuous("zooming", HAS_ZOOM, ZOOM, CameraZoomType.CONTINUOUS, speed)

    async def focus_step(self, steps: int) -> None:
        """Focus farther by a number of steps, or nearer if the number is negative (MAV_CMD_SET_CAMERA_FOCUS).

        The camera defines the size of a step. An unanswered command is not retried, because the camera could make the
        step twice. Raises as :meth:`zoom_step`.

        Args:
            steps: −100 to 100.
        """
        check_range("steps", steps, -100, 100)
        await self._set("focus_step", HAS_FOCUS, FOCUS, SetFocusType.STEP, steps, attempts=1)

    async def focus_to(self, percent: float) -> None:
        """Focus to a percentage of the range, 0 (nearest) to 100; errors as for :meth:`focus_step`."""
        check_range("percent", percent, 0, 100)
        await self._set("focus_to", HAS_FOCUS, FOCUS, SetFocusType.RANGE, percent)

    async def focus_at(self, metres: float) -> None:
        """Focus at a distance, above 0 and at most 100,000 m; errors as for :meth:`focus_step`."""
        check_range("metres", metres, 0, 100_000, above=True)
        await self._set("focus_at", HAS_FOCUS, FOCUS, SetFocusType.METERS, metres)

    async def auto_focus(self, kind: AutoFocus = "auto") -> None:
        """Start the auto focus.

        ``"single"`` focuses once, ``"continuous"`` keeps the image in focus from now on, and ``"auto"`` lets the camera
        choose.

        Raises as :meth:`reset_settings`, and NotSupported if the camera cannot be focused.
        """
        await self._set("auto_focus", HAS_FOCUS, FOCUS, AUTO_FOCUS_TYPES[kind], 0)

    def focusing(self, speed: float = 1.0) -> CameraBlock:
        """Move the focus for the duration of an ``async with`` block.

        The end of the block stops the movement, also under cancellation.

        Entering raises as :meth:`focus_step`.

        Args:
            speed: −1 (nearer) to 1 (farther); many cameras support only these two values.

        Raises:
            InvalidArgument: ``speed`` is out of range. Nothing was sent.
        """
        check_range("speed", speed, -1, 1)
        return self._continuous("focusing", HAS_FOCUS, FOCUS, SetFocusType.CONTINUOUS, speed)

    async def _set(
        self, action: str, capability: str, command: int, kind: int, value: float, *, attempts: int = 4
    ) -> None:
        """Send a zoom or focus command. Raises NotSupported if the camera lacks the capability."""
        await self._link.require_capability(action, capability)
        with self._link.new_order(ORDER_SUBJECTS[command]) as order:
            await self._link.command(command, kind, value, self._link.device_id, order=order, attempts=attempts)

    def _continuous(self, action: str, capability: str, command: int, kind: int, speed: float) -> CameraBlock:
        link = self._link
        return CameraBlock(
            link,
            ORDER_SUBJECTS[command],
            check=lambda: link.require_capability(action, capability),
            start=lambda order: link.command(command, kind, speed, link.device_id, order=order),
            stop_command=lambda: (command, kind, 0, link.device_id),
        )


EDGE_NAMES = ("left", "top", "right", "bottom")


@checks_arguments
class TrackingMixin(CameraMixin):
    """Tracking of a point or a rectangle of the image."""

    def __init__(self, link: CameraLink) -> None:
        super().__init__(link)
        self.tracking: StateCell[TrackingStatus] = link.new_cell("camera.tracking", "CAMERA_TRACKING_IMAGE_STATUS")
        """The tracked point or rectangle. :meth:`track_point` and :meth:`track_rectangle` request it at a rate."""
        self.tracked_place: StateCell[TrackedPlace] = link.new_cell(
            "camera.tracked_place", "CAMERA_TRACKING_GEO_STATUS"
        )
        """Position of the tracked object on earth, if the camera reports it; requested like ``tracking``."""
        self._status_rates: list[Detach] = []  # functions that end the requests for the status messages
        link.listen(
            m.CameraTrackingImageStatus,
            lambda message: link.set_cell(self.tracking, tracking_of(message), message),
        )
        link.listen(
            m.CameraTrackingGeoStatus,
            lambda message: link.set_cell(self.tracked_place, tracked_place_of(message), message),
        )

    async def track_point(self, x: float, y: float, *, radius: float = 0.0, status_hz: float = 5.0) -> None:
        """Track the object at a point of the image (MAV_CMD_CAMERA_TRACK_POINT) until :meth:`stop_tracking`.

        Returns when the camera has accepted; ``camera.tracking`` reports whether it has found the object.

        Args:
            x: 0 (left) to 1 (right).
            y: 0 (top) to 1 (bottom).
            radius: radius of the object as a fraction of the image width, 0 (one pixel) to 1.
            status_hz: rate of ``camera.tracking``, above 0 and at most 50.

        Raises:
            InvalidArgument: an argument is out of range. Nothing was sent.
            NotSupported: the camera cannot track a point. Nothing was sent.
            CommandRejected: the camera refused.
            CommandTimeout: the camera did not answer.
            OperationTimeout: no camera was found.
        """
        for name, value in (("x", x), ("y", y), ("radius", radius)):
            check_range(name, value, 0, 1)
        check_range("status_hz", status_hz, 0, 50, above=True)
        await self._link.require_capability("track_point", "has_tracking_point")
        await self._track(MavCmd.CAMERA_TRACK_POINT, x, y, radius)
        self._request_status(status_hz)

    async def track_rectangle(
        self, left: float, top: float, right: float, bottom: float, *, status_hz: float = 5.0
    ) -> None:
        """Track the object in a rectangle of the image (MAV_CMD_CAMERA_TRACK_RECTANGLE) until :meth:`stop_tracking`.

        An empty rectangle is invalid. Raises as :meth:`track_point`.

        Args:
            left: 0 to 1.
            top: 0 to 1.
            right: 0 to 1, right of ``left``.
            bottom: 0 to 1, below ``top``.
            status_hz: rate of ``camera.tracking``, above 0 and at most 50.
        """
        for name, value in zip(EDGE_NAMES, (left, top, right, bottom), strict=True):
            check_range(name, value, 0, 1)
        check_range("status_hz", status_hz, 0, 50, above=True)
        if left >= right or top >= bottom:
            raise InvalidArgument(
                f"left = {left:g}, top = {top:g}, right = {right:g}, bottom = {bottom:g} is not allowed:"
                " left must be less than right, and top less than bottom"
            )
        await self._link.require_capability("track_rectangle", "has_tracking_rectangle")
        await self._track(MavCmd.CAMERA_TRACK_RECTANGLE, left, top, right, bottom)
        self._request_status(status_hz)

    async def stop_tracking(self) -> None:
        """Stop tracking (MAV_CMD_CAMERA_STOP_TRACKING).

        Raises as :meth:`reset_settings`, and NotSupported if the camera cannot track.
        """
        await self._link.require_capability("stop_tracking", "has_tracking_point", "has_tracking_rectangle")
        try:
            await self._track(MavCmd.CAMERA_STOP_TRACKING)
        finally:
            self._release_status_rates()

    async def _track(self, command: int, *params: float) -> None:
        with self._link.new_order("tracking") as order:
            await self._link.command(command, *params, self._link.device_id, order=order)

    def _request_status(self, status_hz: float) -> None:
        self._release_status_rates()
        information = self._link.information.latest
        self._status_rates = [self._link.request_rate(m.CameraTrackingImageStatus, status_hz)]
        if information is None or information.can("has_tracking_geo_status"):
            self._status_rates.append(self._link.request_rate(m.CameraTrackingGeoStatus, status_hz))

    def _release_status_rates(self) -> None:
        while self._status_rates:
            release = self._status_rates.pop()
            release()


SETTINGS_POLL_INTERVAL_S, STORAGE_POLL_INTERVAL_S = 5.0, 5.0
MODE_REQUEST_TIMEOUT_S, MODE_POLL_INTERVAL_S = 1.0, 0.5
FORMAT_TIMEOUT_S = 60.0


@checks_arguments
class StorageMixin(CameraMixin):
    """Mode, lens position and storage of the camera."""

    def __init__(self, link: CameraLink) -> None:
        super().__init__(link)
        self.mode: StateCell[str] = link.polled_cell("camera.mode", m.CameraSettings, SETTINGS_POLL_INTERVAL_S)
        """``"photo"``, ``"video"``, ``"survey"`` or ``"unknown"`` (CAMERA_SETTINGS); polled every 5 s while used."""
        self.zoom_percent: StateCell[float | None] = link.polled_cell(
            "camera.zoom_percent", m.CameraSettings, SETTINGS_POLL_INTERVAL_S
        )
        """Zoom from 0 (widest) to 100; None if the camera does not know it. Polled like ``mode``."""
        self.focus_percent: StateCell[float | None] = link.polled_cell(
            "camera.focus_percent", m.CameraSettings, SETTINGS_POLL_INTERVAL_S
        )
        """Focus from 0 (nearest) to 100; None if the camera does not know it. Polled like ``mode``."""
        self.storage: StateCell[tuple[CameraStorage, ...]] = link.polled_cell(
            "camera.storage", m.StorageInformation, STORAGE_POLL_INTERVAL_S
        )
        """Storage media by number; polled every 5 s while your program uses this value."""
        self._media: dict[int, CameraStorage] = {}  # storage media by number
        link.listen(m.CameraSettings, self._on_settings)
        link.listen(m.StorageInformation, self._on_storage)

    async def set_mode(self, mode: ModeName, *, timeout: float = 5.0) -> None:
        """Change the mode (MAV_CMD_SET_CAMERA_MODE); returns when the camera reports the new mode.

        If the camera refuses to report its mode (CAMERA_SETTINGS), the call returns when the camera has accepted the
        command.

        Args:
            mode: ``"photo"``, ``"video"`` or ``"survey"``.
            timeout: seconds to wait for the report.

        Raises:
            NotSupported: the camera has no modes. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or does not support this mode.
            CommandTimeout: the camera did not answer.
            OperationTimeout: the camera accepted the command, but reports another mode or none; or no camera was found.
        """
        await self._link.require_capability("set_mode", "has_modes")
        with self._link.new_order("mode") as order:
            await self._link.command(MavCmd.SET_CAMERA_MODE, self._link.device_id, MODES[mode], order=order)
        reported = ""
        with anyio.move_on_after(timeout):
            while reported != mode:
                message = await self._link.request(m.CameraSettings, timeout=MODE_REQUEST_TIMEOUT_S)
                if message is not None:
                    reported = mode_of(message)
                if m.CameraSettings in self._link.unavailable:  # The camera cannot report its mode.
                    return
                if reported != mode:
                    await anyio.sleep(MODE_POLL_INTERVAL_S)
            return
        # The time-out has expired.
        outcome = f"reports {reported}" if reported else "reports no mode"
        raise self._link.timeout_error(f"accepted the mode {mode}, but {outcome} after {timeout:g} s")

    async def load_storage(self) -> tuple[CameraStorage, ...]:
        """Request information about the storage media (STORAGE_INFORMATION), and return what the camera reports.

        Raises:
            OperationTimeout: the camera reported no storage, or no camera was found.
        """
        await self._link.identify()
        self._media.clear()  # Media that were reported earlier may have changed.
        answer = await self._link.request(m.StorageInformation, 0)  # 0 requests all media, one message for each.
        if answer is None:
            raise self._link.timeout_error("reported no storage")
        for number in range(1, answer.storage_count + 1):
            if number not in self._media:
                await self._request_medium(number)
        return self.storage.value

    async def _request_medium(self, number: int) -> None:
        await self._link.request(m.StorageInformation, number, where=lambda message: message.storage_id == number)

    async def format_storage(
        self,
        number: int = 1,
        *,
        timeout: float = FORMAT_TIMEOUT_S,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> None:
        """Format a storage medium (MAV_CMD_STORAGE_FORMAT), which erases all data on it and clears the log of captures.

        Args:
            number: number of the medium, 1 to 255.
            timeout: seconds to wait for the answer. Each progress report restarts this time.
            on_progress: called with the progress in percent, or None if unknown.

        Raises:
            InvalidArgument: ``number`` is out of range. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or there is no such medium.
            CommandTimeout: the camera did not answer; it may be formatting.
            OperationTimeout: no camera was found.
        """
        check_range("number", number, 1, 255)
        await self._link.identify()
        format_medium, reset_image_log = 1, 1  # param2 and param3
        with self._link.new_order("storage"):
            await self._link.command(
                MavCmd.STORAGE_FORMAT,
                number,
                format_medium,
                reset_image_log,
                attempts=1,
                attempt_timeout=timeout,
                progress_timeout=timeout,
                on_progress=on_progress,
            )
        for callback in self._link.on_cleared:  # The captures on the medium are lost.
            callback()
        await self._link.request(m.StorageInformation, 0, timeout=MODE_REQUEST_TIMEOUT_S)

    async def reset_settings(self) -> None:
        """Restore the factory settings (MAV_CMD_RESET_CAMERA_SETTINGS).

        Raises:
            CommandRejected: the camera refused.
            CommandTimeout: the camera did not answer.
            OperationTimeout: no camera was found.
        """
        await self._link.identify()
        # The reset also changes the mode, so it ends the retries of an earlier order to change the mode.
        with self._link.new_order("mode") as order:
            reset = 1  # param1
            await self._link.command(MavCmd.RESET_CAMERA_SETTINGS, reset, self._link.device_id, order=order)
        await self._link.request(m.CameraSettings, timeout=MODE_REQUEST_TIMEOUT_S)

    def _on_settings(self, message: m.CameraSettings) -> None:
        self._link.set_cell(self.mode, mode_of(message), message)
        self._link.set_cell(self.zoom_percent, finite_or_none(message.zoomLevel), message)
        self._link.set_cell(self.focus_percent, finite_or_none(message.focusLevel), message)

    def _on_storage(self, message: m.StorageInformation) -> None:
        medium = storage_of(message)
        # Media with a number above the reported count were removed.
        self._media = {number: known for number, known in self._media.items() if number <= medium.count}
        self._media[medium.number] = medium
        media = tuple(self._media[number] for number in sorted(self._media))
        self._link.set_cell(self.storage, media, message)
