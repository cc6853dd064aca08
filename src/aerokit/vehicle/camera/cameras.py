"""``Camera`` and ``Cameras``: the cameras of one vehicle."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.connection.cells import Source, StateCell
from aerokit.errors import InvalidArgument, NotSupported
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavType
from aerokit.vehicle.camera.capture import Capture, capture_of
from aerokit.vehicle.camera.capture_log import MAX_CAPTURES, CaptureLog
from aerokit.vehicle.camera.controls import LensMixin, StorageMixin, TrackingMixin
from aerokit.vehicle.camera.link import DISCOVERY_TIMEOUT_S, CameraLink
from aerokit.vehicle.camera.orders import AUTOPILOT_CAMERA_IDS
from aerokit.vehicle.camera.photos import PhotoInterval, Shutter
from aerokit.vehicle.camera.values import CameraInformation
from aerokit.vehicle.camera.videos import VideoMixin

if TYPE_CHECKING:
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.components.component import Components

__all__ = ["Camera", "Cameras"]

MAX_SERIES_LENGTH, MAX_CONSECUTIVE_MISSING = 32_767, 3
MAVFTP_URL = re.compile(r"(?:mftp|mavlinkftp)://.|/.", re.IGNORECASE)


@checks_arguments
class Camera(ReadOnly, VideoMixin, LensMixin, TrackingMixin, StorageMixin):
    """One camera: photos, video, lens, tracking, storage, streams (https://mavlink.io/en/services/camera.html).

    ``vehicle.camera`` is the first camera, ``vehicle.camera_at(number)`` any other. A camera has its own component id
    (usually 100 to 105), or is attached to the autopilot (1 to 6) by ArduPilot's drivers or PX4's trigger. aerokit
    refuses a call, and sends nothing, if the camera has reported that it lacks the capability for the call. State
    values are polled only while your program uses them.
    """

    def __init__(self, link: CameraLink) -> None:
        super().__init__(link)
        self._log = CaptureLog(link)
        self._shutter = Shutter(link, self._log)
        self.capture: StateCell[Capture] = self._log.cell
        """The latest capture."""
        self.information: StateCell[CameraInformation] = link.information
        """Vendor, model, capabilities (CAMERA_INFORMATION). The first call to the camera requests the message."""

    @property
    def number(self) -> int | None:
        """Number of the camera: 1 to 6 if attached to the autopilot, otherwise its component id.

        None until a camera is found.
        """
        return self._link.number

    async def wait_found(self, *, timeout: float = 10.0) -> CameraInformation:
        """Wait until the camera is found and has identified itself.

        Every other call to the camera first waits in the same way, but does not require a camera that is attached to
        the autopilot to identify itself.

        Raises:
            CommandRejected: the camera refused to identify itself.
            OperationTimeout: no camera was found, or the camera did not identify itself. PX4's camera trigger never
                identifies itself.
        """
        information: CameraInformation | None = None
        with anyio.move_on_after(timeout) as scope:
            information = await self._link.identify()
        if information is None:  # The time-out has expired, or an autopilot has no information about its camera.
            limit = f" within {timeout:g} s" if scope.cancelled_caught else ""
            raise self._link.timeout_error(f"did not identify itself{limit}")
        return information

    async def take_photo(self, *, timeout: float = 10.0) -> Capture:
        """Take one photo; returns when the camera has reported it.

        Sends MAV_CMD_IMAGE_START_CAPTURE (https://mavlink.io/en/services/camera.html). PX4's trigger, and cameras that
        do not support this command, get MAV_CMD_DO_DIGICAM_CONTROL. The order is sent again only if the camera reports
        afterwards that it has taken no picture and is taking none. A lost CAMERA_IMAGE_CAPTURED is requested again. If
        you cancel the call, the camera may still take the picture.

        Args:
            timeout: seconds to wait for the report.

        Raises:
            NotSupported: the camera cannot take pictures. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or in the wrong mode.
            CommandTimeout: the camera did not answer; it may have taken the picture.
            OperationRejected: the camera failed to take the picture.
            OperationTimeout: the camera reported no picture, or no camera was found.
        """
        await self._link.require_capability("take_photo", "capture_image")
        with self._link.new_order("photo"):
            return await self._shutter.take_photo(timeout)

    def photo_interval(self, seconds: float, count: int = 0) -> PhotoInterval:
        """Take a photo every ``seconds`` for the duration of an ``async with`` block.

        Entering gives an asynchronous iterator over the captures, in order; lost captures are requested again.
        MAV_CMD_IMAGE_STOP_CAPTURE is sent at the end of the block, also under cancellation. PX4's trigger is started
        and stopped by MAV_CMD_DO_TRIGGER_CONTROL.

        Args:
            seconds: time between two pictures, above 0, at most 3600.
            count: number of pictures, after which the iterator ends: 1 to 32767, or 0 for no limit.

        Raises:
            InvalidArgument: an argument is out of range. Nothing was sent.
        """
        check_range("seconds", seconds, 0, 3600, above=True)
        check_range("count", count, 0, MAX_SERIES_LENGTH)
        return PhotoInterval(self._shutter, seconds, count)

    def captures(self) -> list[Capture]:
        """Return the newest captures received so far, at most 20,000, ordered by index."""
        return self._log.captures()

    async def load_captures(self, *, timeout: float = 600.0) -> list[Capture]:
        """Return the captures in the camera's log, also those from before this program started.

        Missing captures are requested, the newest first, until the camera does not send three in succession. At most
        the newest 20,000 are returned; a camera attached to the autopilot has only its newest capture.

        Args:
            timeout: seconds to wait for all captures; :meth:`captures` returns those that arrived in time.

        Raises:
            OperationTimeout: the camera did not report its number of captures or identify itself, or not all captures
                arrived in time.
        """
        count: int | None = None
        with anyio.move_on_after(timeout):
            await self._link.identify()
            status = await self._shutter.request_status_reliably()
            if status is None:
                raise self._link.timeout_error("did not report how many pictures it has taken")
            count = status.image_count
            consecutive_missing = 0
            # The autopilot stores only its newest capture.
            max_stored = 1 if self._link.is_autopilot_attached else MAX_CAPTURES
            for index in reversed(range(max(0, count - max_stored), count)):  # A camera deletes the oldest first.
                capture = await self._log.fetch(index)
                consecutive_missing = consecutive_missing + 1 if capture is None else 0
                if consecutive_missing == MAX_CONSECUTIVE_MISSING:
                    break
            return self.captures()
        # The time-out has expired.
        not_reported = "how many pictures it has taken" if count is None else f"all of its {count} pictures"
        raise self._link.timeout_error(f"did not report {not_reported} within {timeout:g} s")

    async def read_picture(self, capture: Capture) -> bytes:
        """Read the file of a picture by MAVFTP, at most 16 MB. Its ``file_url`` must begin with ``mftp://`` or ``/``.

        Raises:
            NotSupported: the capture has another URL, or none. No file was requested.
            FileError: the camera has no such file.
            OperationTimeout: the transfer stopped, or no camera was found.
        """
        url = capture.file_url
        if not MAVFTP_URL.match(url):
            reason = f"{url[:100]!r} is not a MAVFTP URL" if url else "the capture has no URL"
            raise NotSupported(f"read_picture: {reason}; nothing was sent")
        await self._link.identify()
        try:
            return await self._link.component.fetch(f"mftp://{url}" if url.startswith("/") else url)
        except InvalidArgument as error:
            raise NotSupported(f"read_picture: {error}; no file was requested") from None

    def __repr__(self) -> str:
        return f"<Camera {self._link.describe().removeprefix('camera ')}>"


CAMERA_COMPONENT_IDS = range(100, 106)
MAX_EARLY_CAPTURES = 100


class Cameras:
    """Discovers the cameras of one vehicle and creates their ``Camera`` objects."""

    def __init__(self, context: VehicleContext, components: Components) -> None:
        self._context = context
        self._session = context.session
        self._components = components
        self._cameras: dict[int, Camera] = {}
        session = context.session
        self.cell: StateCell[tuple[int, ...]] = session.connection.new_cell(
            "cameras", "HEARTBEAT or CAMERA_INFORMATION of a camera"
        )
        # Messages of cameras attached to the autopilot, each with its decoded capture. They are kept until it is known
        # which camera is `first`.
        self._early_captures: list[tuple[Any, Capture]] = []
        self._first_link = CameraLink(context, components.component, None, on_bound=self._on_first_bound)
        self._first = Camera(self._first_link)
        # True once the program has got `_first`; the property `first` then never returns another object.
        self._is_first_in_use = False
        session.register_cell(self.cell)
        bus = session.connection.bus
        for message_type, callback in (
            (m.Heartbeat, self._on_heartbeat),
            (m.CameraInformation, self._on_information),
            # Camera ids count from 1, but `cam_idx` from 0. CAMERA_TRIGGER has no id.
            (m.CameraFeedback, lambda message: self._on_capture(message, message.cam_idx + 1)),
            (m.CameraImageCaptured, lambda message: self._on_capture(message, message.camera_id or 1)),
            (m.CameraTrigger, lambda message: self._on_capture(message, 1)),
        ):
            if bus.dialect.get(message_type.ID) is not None:  # The user's dialect may lack a message.
                session.at_close(bus.attach(message_type, callback, system_id=session.system_id))
        for (system_id, _), heartbeat in tuple(session.connection.heartbeats.items()):
            if system_id == session.system_id:
                self._on_heartbeat(heartbeat)

    @property
    def first(self) -> Camera:
        """The first camera found with its own component id; if there is none, one attached to the autopilot."""
        if not self._is_first_in_use and self._first_link.number in self._cameras:
            # `at` has already created an object for this camera.
            return self._cameras[self._first_link.number]
        self._is_first_in_use = True
        self._first_link.start_polling()
        return self._first

    def at(self, number: int) -> Camera:
        """Return the camera with this number, always the same object, even before the camera is discovered."""
        if number not in AUTOPILOT_CAMERA_IDS and not 7 <= number <= 255:
            raise InvalidArgument(
                f"number = {number} is not allowed: it must be 1 to 6 (attached to the autopilot) or 7 to 255"
                " (component id)"
            )
        if number not in self._cameras:
            if number == self._first_link.number:  # `first` already stands for this camera.
                self._first_link.bind(number)  # If the number was a guess, the program has now confirmed it.
                return self.first
            link = CameraLink(self._context, self._components.component, number)
            link.start_polling()
            self._cameras[number] = Camera(link)
        return self._cameras[number]

    def _on_heartbeat(self, heartbeat: m.Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None and (heartbeat.type == MavType.CAMERA or frame.component_id in CAMERA_COMPONENT_IDS):
            self._register_sender(heartbeat, frame.component_id)

    def _on_information(self, message: m.CameraInformation) -> None:
        # ArduPilot does not set camera_device_id but lens_id, which is 0 for its first camera (AP_Camera_Backend.cpp).
        self._register_sender(message, message.camera_device_id or message.lens_id + 1)

    def _on_first_bound(self, number: int) -> None:
        # `at` may have created another object for the same camera. The first link is then muted, so that events are
        # published only once.
        self._first_link.is_muted = number in self._cameras

    def _on_capture(self, message: Any, device_id: int) -> None:
        number = self._register_sender(message, device_id)
        has_object = number == self._first_link.number or number in self._cameras
        if number is None or has_object:  # The object of a known camera receives this message by itself.
            return
        capture = capture_of(message, number, self._session.connection.now(), self._session.telemetry)
        if self._first_link.number is None:
            if not self._early_captures:
                self._first_link.call_later(DISCOVERY_TIMEOUT_S, self._process_early_captures)
            # If the list is full, a new capture replaces the last one.
            del self._early_captures[MAX_EARLY_CAPTURES - 1 :]
            self._early_captures.append((message, capture))
        else:  # `at` creates the camera only now, so it has not received this message.
            self.at(number)._log.record(message, capture)

    def _process_early_captures(self) -> None:
        # No camera with its own component id was discovered, so the first camera is attached to the autopilot.
        captures, self._early_captures = self._early_captures, []
        _, first_capture = captures[0]
        self._first_link.bind(first_capture.camera)
        for message, capture in captures:
            self.at(capture.camera)._log.record(message, capture)

    def _register_sender(self, message: Any, device_id: int) -> int | None:
        """Add the camera that sent a message to `cell` and return its number, or None if the sender is no camera."""
        frame = message.received_frame
        if frame is None:
            return None
        is_from_autopilot = frame.component_id == self._session.component_id
        number: int = device_id if is_from_autopilot else frame.component_id
        # Cameras of the autopilot have the numbers 1 to 6; all other cameras have their component ids.
        has_autopilot_number = number in AUTOPILOT_CAMERA_IDS
        if has_autopilot_number != is_from_autopilot or number == 0:
            return None
        numbers = self.cell.latest or ()
        if number not in numbers:
            source = Source(self._session.system_id, frame.component_id, message.NAME)
            self.cell.set(tuple(sorted((*numbers, number), key=_sort_key)), source)
        # A camera with its own component id becomes `first`, unless another camera is known to be the first.
        if not has_autopilot_number:
            self._first_link.bind(number)
        return number


def _sort_key(number: int) -> tuple[bool, int]:
    return number in AUTOPILOT_CAMERA_IDS, number
