"""``CaptureLog``: stores the captures that one camera has reported, and requests lost captures."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import CommandRejected
from aerokit.events import ImageCaptured
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavResult
from aerokit.vehicle.camera.capture import FEEDBACK_INDEX_RANGE, UNIX_TIME_OF_1990_S, Capture, capture_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import EndSignal
    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.camera.link import CameraLink

MAX_CAPTURES = 20_000
FETCH_ATTEMPTS, REQUEST_TIMEOUT_S = 12, 1.0
# PX4 may send CAMERA_IMAGE_CAPTURED, which has the position, up to this many seconds after CAMERA_TRIGGER.
TRIGGER_GRACE_S = 0.3
# Two messages of different types with the same index report the same picture if they arrive within this time.
DUPLICATE_WINDOW_S = 10.0
# If a status has a lower time stamp than the newest one, it arrived late. If it is lower by this many milliseconds or
# more, the camera has restarted instead.
REORDER_WINDOW_MS = 5000
# If an index exceeds the reported count by more than this, the camera's numbering does not follow the standard.
MAX_COUNT_LEAD = 100
# If an index exceeds the highest one so far by more than this, it counts as corrupt until the next picture confirms it.
MAX_INDEX_GAP = 1000
# If an index is lower than the previous one by more than this, the 16-bit counter of CAMERA_FEEDBACK has wrapped.
HALF_RANGE = FEEDBACK_INDEX_RANGE // 2


class _Entry:
    """One capture, with the type and the time stamps of the message that reported it."""

    __slots__ = ("boot_us", "capture", "kind", "utc_us")

    def __init__(self, message: Message, capture: Capture) -> None:
        self.kind = type(message)
        self.capture = capture
        # `utc_us` and `boot_us` are time stamps in microseconds. A time stamp that the message does not have is 0.
        if isinstance(message, m.CameraImageCaptured):
            self.utc_us = message.time_utc
            self.boot_us = message.time_boot_ms * 1000
        else:
            stamp: int = getattr(message, "time_usec", 0)  # UTC, or the time since boot if the sender has no UTC
            is_utc = stamp >= UNIX_TIME_OF_1990_S * 1_000_000
            self.utc_us = stamp if is_utc else 0
            self.boot_us = 0 if is_utc else stamp

    def reports_same_picture(self, other: _Entry) -> bool:
        """Compare two entries that have the same index."""
        # PX4 reports each picture by two messages of different types, which arrive in quick succession.
        if self.kind is not other.kind:
            return abs(self.capture.received_at - other.capture.received_at) <= DUPLICATE_WINDOW_S
        if self.utc_us and other.utc_us:
            return self.utc_us == other.utc_us
        if self.boot_us and other.boot_us:
            return self.boot_us == other.boot_us
        # Without comparable time stamps, only the place can be compared.
        return self.capture.place == other.capture.place

    def was_taken_later(self, other: _Entry) -> bool:
        """Return False if the time stamps cannot be compared."""
        if self.utc_us and other.utc_us:
            return self.utc_us > other.utc_us
        return bool(self.boot_us and other.boot_us) and self.boot_us > other.boot_us


class CaptureLog:
    """Stores the captures of one camera by index.

    PX4 sends two messages for each picture; the log keeps the message with the position.

    When the camera counts from 0 again, after a restart or after its storage was formatted, the log resets itself.
    """

    def __init__(self, link: CameraLink) -> None:
        self._link = link
        self.end: EndSignal = link.session.end
        self._by_index: dict[int, _Entry] = {}
        # Indices of the captures that are being requested; an index that two calls request occurs twice.
        self._requested: list[int] = []
        self._highest: _Entry | None = None  # the entry with the highest plausible index
        self._outlier: _Entry | None = None  # the last entry, if its index is too far above `_highest`
        self._failed: _Entry | None = None  # the last failed picture
        # Number of pictures taken, from CAMERA_CAPTURE_STATUS or an index; 0 for a camera that always reports 0.
        self._count = 0
        self._count_boot_ms = 0  # the camera's time since boot when it last reported the number
        self._has_nonzero_count = False
        # Time of the event loop at the last reset. Captures from before the reset do not belong to this log.
        self.reset_at: float = -math.inf
        # True if the camera sends CAMERA_IMAGE_CAPTURED; CAMERA_TRIGGER is then ignored.
        self._has_images = False
        # Called with every capture that is new or more complete. The state value has only the latest picture.
        self.on_capture: list[Callable[[Capture], None]] = []
        self.cell: StateCell[Capture] = link.new_cell(
            "camera.capture", "CAMERA_IMAGE_CAPTURED, CAMERA_FEEDBACK or CAMERA_TRIGGER"
        )
        link.on_cleared.append(self._reset)
        link.listen(m.CameraImageCaptured, self._on_message)
        link.listen(m.CameraFeedback, self._on_message)
        link.listen(m.CameraTrigger, self._on_message)
        link.listen(m.CameraCaptureStatus, self._on_status)

    def captures(self) -> list[Capture]:
        return [self._by_index[index].capture for index in sorted(self._by_index)]

    def has(self, index: int) -> bool:
        return index in self._by_index

    async def fetch(self, index: int) -> Capture | None:
        """Request a missed capture. Returns None if the camera has deleted it or does not answer."""
        if not self.has(index) and self._link.is_trigger:
            return None  # PX4's trigger cannot send a capture again.
        self._requested.append(index)  # `_shows_reset` must not take the low index of the answer for a reset.
        try:
            for _ in range(FETCH_ATTEMPTS):
                if self.has(index):
                    break
                is_deleted = await self._request(index)
                if is_deleted:
                    break
        finally:
            self._requested.remove(index)
        entry = self._by_index.get(index)
        return None if entry is None else entry.capture

    async def _request(self, index: int) -> bool:
        """Request the capture once. Returns True if the camera answers that it does not have it."""
        request = self._link.requests.request
        try:
            if not self._link.is_autopilot_attached:
                await request(
                    m.CameraImageCaptured,
                    index,
                    where=lambda message: message.image_index == index,
                    timeout=REQUEST_TIMEOUT_S,
                )
                return False  # If the answer was lost, another request may succeed.
            newest = await request(  # The autopilot stores only its newest capture.
                m.CameraFeedback,
                where=lambda message: message.cam_idx + 1 == self._link.number,
                timeout=REQUEST_TIMEOUT_S,
            )
        except CommandRejected as error:
            if error.result != MavResult.TEMPORARILY_REJECTED:
                return True
            await anyio.sleep(REQUEST_TIMEOUT_S)  # The camera is busy, so a later request may succeed.
            return False
        # `img_idx` counts pictures from 1, `index` from 0.
        return newest is not None and (newest.img_idx - 1) % FEEDBACK_INDEX_RANGE != index

    def _on_message(self, message: Message) -> None:
        self.record(
            message, capture_of(message, self._link.number or 0, self._link.now(), self._link.session.telemetry)
        )

    def record(self, message: Message, capture: Capture) -> None:
        if isinstance(message, m.CameraImageCaptured):
            self._has_images = True
            self._add(message, capture)
        elif isinstance(message, m.CameraFeedback):
            # Before the first picture, ArduPilot sends a message of zeros, which is not a capture. An index of 0
            # belongs to a picture only if the 16-bit index may have returned to 0.
            may_have_wrapped = self._highest is not None and self._highest.capture.index > HALF_RANGE
            is_capture = message.img_idx > 0 or may_have_wrapped
            if is_capture and message.cam_idx + 1 == self._link.number:
                self._add(message, capture)
        elif isinstance(message, m.CameraTrigger) and self._link.is_autopilot_attached and not self._has_images:
            self._link.call_later(TRIGGER_GRACE_S, lambda: self._add_unless_reported(message, capture))

    def _add_unless_reported(self, message: m.CameraTrigger, capture: Capture) -> None:
        if not self._has_images:
            self._add(message, capture)

    def _on_status(self, message: m.CameraCaptureStatus) -> None:
        boot_ms, count = message.time_boot_ms, message.image_count
        if 0 < self._count_boot_ms - boot_ms < REORDER_WINDOW_MS:
            return  # This status was sent before the newest one, and arrived late.
        self._count_boot_ms = boot_ms
        if count < self._count:  # The camera counts from 0 again.
            self._reset()
        self._count = count
        self._has_nonzero_count = self._has_nonzero_count or count > 0

    def _reset(self) -> None:
        self._by_index.clear()
        self._highest = None
        self._outlier = None
        self._failed = None
        self._count = 0
        self.reset_at = self._link.now()

    def _shows_reset(self, entry: _Entry, previous: _Entry | None) -> bool:
        """Return True if this entry shows that the camera counts from 0 again.

        ``previous`` is the stored entry with the same index.
        """
        if previous is not None and previous.capture.success is not False:
            # Both entries have the same index. The camera gives it to another picture only if it counts from 0 again.
            return not entry.reports_same_picture(previous)
        # A new picture with a lower index shows a reset. A capture that was requested or arrived late may have a lower
        # index without a reset.
        index, highest = entry.capture.index, self._highest
        if highest is None or index >= highest.capture.index or index in self._requested:
            return False
        has_wrapped = highest.capture.index - index > HALF_RANGE
        return has_wrapped or entry.was_taken_later(highest)

    def _add(self, message: Message, capture: Capture) -> None:
        entry = _Entry(message, capture)
        if capture.success is False:
            self._add_failed(message, entry)
            return
        previous = self._by_index.get(capture.index)
        if self._shows_reset(entry, previous):
            self._reset()
            previous = None
        is_new = previous is None or previous.capture.success is False  # A failed picture's index may be used again.
        if previous is not None and not is_new:
            is_repeated = previous.kind is entry.kind
            # CAMERA_IMAGE_CAPTURED contains everything that CAMERA_TRIGGER of the same picture contains.
            has_better_message = previous.kind is m.CameraImageCaptured
            if is_repeated or has_better_message:
                return
        self._store(entry)
        self._update_highest(entry)
        if isinstance(message, m.CameraImageCaptured) and entry is self._highest:
            # A CAMERA_CAPTURE_STATUS that was sent before this picture does not include it. This time stamp makes
            # `_on_status` ignore such a status.
            self._count_boot_ms = message.time_boot_ms
        # Indices begin at 0, so at least `index` pictures were taken before this one. A camera whose index is far above
        # its own count, or that always counts 0, does not number pictures as the standard says.
        if self._has_nonzero_count and capture.index <= self._count + MAX_COUNT_LEAD:
            self._count = max(self._count, capture.index)
        self._publish(message, capture, is_new=is_new)

    def _update_highest(self, entry: _Entry) -> None:
        index, highest, outlier = entry.capture.index, self._highest, self._outlier
        self._outlier = None
        if highest is None or 0 <= index - highest.capture.index <= MAX_INDEX_GAP:
            self._highest = entry
        elif index > highest.capture.index:
            # The index may be corrupt. The next picture, or a second message about this picture, confirms it.
            if outlier is not None and 0 <= index - outlier.capture.index <= MAX_INDEX_GAP:
                self._highest = entry
            else:
                self._outlier = entry

    def _add_failed(self, message: Message, entry: _Entry) -> None:
        index, last_failed = entry.capture.index, self._failed
        if last_failed is not None and last_failed.capture.index == index and last_failed.reports_same_picture(entry):
            return  # The message is repeated.
        self._failed = entry
        previous = self._by_index.get(index)
        # A successful picture with this index stays, because a camera may use the index of a failed picture again.
        if previous is None or previous.capture.success is False:
            self._store(entry)
        self._publish(message, entry.capture, is_new=True)

    def _store(self, entry: _Entry) -> None:
        self._by_index[entry.capture.index] = entry
        if len(self._by_index) > MAX_CAPTURES:
            del self._by_index[min(self._by_index)]

    def _publish(self, message: Message, capture: Capture, *, is_new: bool) -> None:
        for callback in tuple(self.on_capture):
            callback(capture)
        is_older = self._highest is not None and capture.index < self._highest.capture.index
        # A successful capture with a lower index was requested again or arrived late, so it is not the latest one.
        if not is_older or capture.success is False:
            self._link.set_cell(self.cell, capture, message)
        if is_new:
            self._link.publish(
                ImageCaptured, capture.camera, capture.index, capture.success, capture.place, capture.file_url
            )


class CaptureQueue:
    """Queue of the captures that arrive during a ``with`` block."""

    def __init__(self, log: CaptureLog) -> None:
        self._log = log
        self._queue: deque[Capture] = deque(maxlen=MAX_CAPTURES)
        self._event = anyio.Event()

    def __enter__(self) -> CaptureQueue:
        self._log.on_capture.append(self._add)
        self._detach = self._log.end.on_end(lambda _: self._event.set())
        return self

    def __exit__(self, *_: Any) -> None:
        if self._add in self._log.on_capture:
            self._log.on_capture.remove(self._add)
            self._detach()

    def pop(self) -> Capture | None:
        return self._queue.popleft() if self._queue else None

    async def wait(self, seconds: float) -> bool:
        """Return False if no capture arrives in time."""
        with anyio.move_on_after(seconds):
            while not self._queue:
                self._log.end.raise_if_ended()
                self._event = anyio.Event()
                await self._event.wait()
        return bool(self._queue)

    def _add(self, capture: Capture) -> None:
        self._queue.append(capture)
        self._event.set()
