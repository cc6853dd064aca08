"""Taking photos, one or a series."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import CommandRejected, CommandTimeout, OperationRejected
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.vehicle.camera.capture import Capture
from aerokit.vehicle.camera.capture_log import CaptureLog, CaptureQueue
from aerokit.vehicle.camera.link import ActiveOperation
from aerokit.vehicle.camera.orders import MAX_ORDER_ATTEMPTS
from aerokit.vehicle.camera.values import CameraStatus, status_of

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.vehicle.camera.link import CameraLink
    from aerokit.vehicle.commanding.order import Order

START, STOP = MavCmd.IMAGE_START_CAPTURE, MavCmd.IMAGE_STOP_CAPTURE
TRIGGER, TRIGGER_INTERVAL = MavCmd.DO_TRIGGER_CONTROL, MavCmd.DO_SET_CAM_TRIGG_INTERVAL
UNCHANGED = -1  # leaves the shutter time, or the sequence number of the trigger, as it is
# Seconds without a capture after which the status of a series is requested, and seconds to wait for the status.
CHECK_INTERVAL_S, STATUS_TIMEOUT_S = 1.0, 2.0
# Maximum number of status requests before an order. FIRST_STATUS_ATTEMPTS is for a camera that has never sent its
# status.
STATUS_ATTEMPTS, FIRST_STATUS_ATTEMPTS = 8, 3
# A series has failed if this many successive status checks have shown no new capture.
MAX_SILENT_CHECKS = 6
# Since the newest capture, a camera may plausibly have taken twice as many pictures as its interval allows, plus this
# many. A higher index counts as corrupt.
MAX_EXTRA_CAPTURES = 10
# If this many successive requests for missing captures are unanswered, the remaining gap is skipped.
MAX_UNANSWERED = 3


class Shutter:
    """Orders one photo, or a series, and determines whether an unacknowledged order was executed."""

    def __init__(self, link: CameraLink, log: CaptureLog) -> None:
        self.link: CameraLink = link
        self.log: CaptureLog = log
        self._sequence_number = 0  # sequence number of the photo that was ordered last
        self._lock = anyio.Lock()
        self._reports_status = False  # True once the camera has sent CAMERA_CAPTURE_STATUS
        self._ignored_requests = False  # True if the requests before an order have never been answered

    async def request_status(self, timeout: float = CHECK_INTERVAL_S) -> CameraStatus | None:
        """Request CAMERA_CAPTURE_STATUS; None if the camera does not send it."""
        if self.link.is_trigger or m.CameraCaptureStatus in self.link.unavailable:
            return None
        message = await self.link.request(m.CameraCaptureStatus, timeout=timeout)
        self._reports_status = self._reports_status or message is not None
        return None if message is None else status_of(message)

    async def request_status_reliably(self) -> CameraStatus | None:
        # The answer decides whether an order may be sent again, so the request is repeated. A camera that has never
        # sent its status may not support the message, so it gets fewer requests: FIRST_STATUS_ATTEMPTS for the first
        # order, and only one for later orders.
        if self._reports_status:
            attempts = STATUS_ATTEMPTS
        elif not self._ignored_requests:
            attempts = FIRST_STATUS_ATTEMPTS
        else:
            attempts = 1
        for _ in range(attempts):
            status = await self.request_status(STATUS_TIMEOUT_S)
            if status is not None or self.link.is_trigger or m.CameraCaptureStatus in self.link.unavailable:
                return status
        self._ignored_requests = not self._reports_status
        return None

    async def take_photo(self, timeout: float) -> Capture:
        async with self._lock:
            series_before = self.link.latest_order("series")
            status_before = await self.request_status_reliably()
            old_indices = {capture.index for capture in self.log.captures()}
            watch = self.link.session.watch
            reboots, other_boots = watch.reboots, watch.other_boots
            # The error to raise at the time-out; None once the last order is acknowledged. It is set here, because the
            # time may expire while the first order waits for its acknowledgement.
            unacknowledged: CommandTimeout | None = CommandTimeout(
                f"{self.link.describe()} did not acknowledge the order for a picture within {timeout:g} s;"
                " it may have taken one"
            )
            with CaptureQueue(self.log) as new_captures, anyio.move_on_after(timeout):
                attempts = 1
                unacknowledged = await self.order_photo(status_before)
                while True:
                    # The reopened link may lead to another vehicle, whose camera takes the next picture.
                    watch.raise_if_other_boot(other_boots, f"{self.link.describe()} may have taken the picture")
                    while capture := new_captures.pop():
                        if _is_new(capture, status_before, old_indices):
                            return self._successful(capture)
                    round_trip_s = self.link.session.link_watch.round_trip_s or 0.0
                    has_arrived = await new_captures.wait(max(CHECK_INTERVAL_S, 2.0 * round_trip_s))
                    if has_arrived:
                        continue
                    # The report may have been lost, so ask the camera whether it has taken a picture.
                    status = await self.request_status()
                    if status is None:
                        continue
                    is_accepted = unacknowledged is None
                    missed = await self._fetch_missed(status_before, status, old_indices, is_accepted=is_accepted)
                    if missed is not None:
                        return self._successful(missed)
                    # If a series was started or stopped meanwhile, the image count does not show whether the ordered
                    # picture was taken.
                    is_series_unchanged = self.link.latest_order("series") is series_before
                    was_lost = not is_accepted and is_series_unchanged and _has_taken_none(status_before, status)
                    if was_lost and attempts < MAX_ORDER_ATTEMPTS and watch.reboots == reboots:
                        attempts += 1
                        unacknowledged = await self.order_photo(status_before, is_repeated=True)
            raise unacknowledged or self.link.timeout_error(
                f"accepted the order, but reported no picture within {timeout:g} s; it may have taken one"
            )

    async def _fetch_missed(
        self, status_before: CameraStatus | None, status: CameraStatus, old_indices: set[int], *, is_accepted: bool
    ) -> Capture | None:
        """Request the capture of the ordered picture, if the status shows that the picture was taken."""
        if status_before is not None:
            was_taken = status.image_count > status_before.image_count
            new_index = status_before.image_count  # Indices begin at 0.
            return await self.log.fetch(new_index) if was_taken else None
        # Without a status from before the order, the newest picture counts as the ordered one if the camera accepted
        # the order.
        newest = status.image_count - 1
        has_new_picture = newest >= 0 and newest not in old_indices
        if is_accepted and not status.is_capturing and has_new_picture:
            return await self.log.fetch(newest)
        return None

    def _successful(self, capture: Capture) -> Capture:
        if capture.success is False:
            raise OperationRejected(f"{self.link.describe()} could not take the picture")
        return capture

    async def order_photo(
        self, status_before: CameraStatus | None, *, is_repeated: bool = False
    ) -> CommandTimeout | None:
        """Send the order once. Returns the time-out if it was not acknowledged."""
        # A repeated order keeps its sequence number, so that a camera does not execute it twice.
        if not is_repeated:
            pictures = 0 if status_before is None else status_before.image_count
            # An earlier program may have ordered the existing pictures with sequence numbers up to the image count, so
            # the new sequence number must be above it.
            self._sequence_number = max(pictures + 1, self._sequence_number + 1)
        try:
            if self.link.is_trigger:
                await self._send_digicam_control()
            else:
                await self._send_image_start()
        except CommandTimeout as error:
            error.was_sent = error.was_sent or is_repeated
            return error
        return None

    async def _send_image_start(self) -> None:
        interval_s, count = 0, 1
        params = (self.link.device_id, interval_s, count, self._sequence_number)
        try:
            await self.link.command(START, *params, attempts=1)
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            try:
                await self._send_digicam_control()
            except CommandRejected:  # The camera supports neither command.
                raise error from None

    async def _send_digicam_control(self) -> None:
        unchanged, take_photo = (0, 0, 0, 0), 1  # session, zoom and focus in param1 to param4, the shutter in param5
        await self.link.command(MavCmd.DO_DIGICAM_CONTROL, *unchanged, take_photo, attempts=1)

    async def start_series(self, order: Order, seconds: float, count: int, status_before: CameraStatus | None) -> None:
        if self.link.is_trigger:
            interval_ms, shutter_time, enable, sequence = seconds * 1000.0, UNCHANGED, 1, UNCHANGED
            await self.link.command(TRIGGER_INTERVAL, interval_ms, shutter_time)
            await self.link.command(TRIGGER, enable, sequence, order=order)
            return

        async def has_started() -> bool | None:
            status = await self.request_status_reliably()
            if status is None or status_before is None:
                return None  # Without both reports, the number of pictures cannot be compared.
            has_new_picture = status.image_count > status_before.image_count
            return status.is_in_series or status.is_capturing or has_new_picture

        params = (self.link.device_id, seconds, count)
        await self.link.order_once(
            order, lambda: self.link.command(START, *params, order=order, attempts=1), check_effect=has_started
        )

    @property
    def stop_command(self) -> tuple[float, ...]:
        return (TRIGGER, 0, UNCHANGED) if self.link.is_trigger else (STOP, self.link.device_id)


def _is_new(capture: Capture, status_before: CameraStatus | None, old_indices: set[int]) -> bool:
    """Return True if the picture may have been ordered after ``status_before`` was reported."""
    # A low index usually means an older picture. If no older capture has this index, the picture may be new, because a
    # camera may use the index of a failed picture again.
    is_low = status_before is not None and capture.index < status_before.image_count
    return not is_low or capture.index not in old_indices


def _has_taken_none(status_before: CameraStatus | None, status: CameraStatus) -> bool:
    is_count_unchanged = status_before is not None and status.image_count <= status_before.image_count
    return is_count_unchanged and not status.is_capturing


class PhotoInterval:
    """A series of photos for the duration of an ``async with`` block; an async iterator over its captures, in order.

    Returned by :meth:`Camera.photo_interval`. Missed captures are requested; ``missed`` counts those that the camera
    did not send. ArduPilot and PX4 keep only the last capture of the cameras attached to them.
    """

    def __init__(self, shutter: Shutter, seconds: float, count: int) -> None:
        self._shutter = shutter
        self._interval_s = seconds
        self._count = count  # number of ordered pictures; 0 for a series without an end
        self._link = shutter.link
        self._log = shutter.log
        self._new_captures = CaptureQueue(self._log)
        # Index of the capture to deliver next.
        self._next_index: int | None = None
        # Time of the log's last reset. After another reset, the camera counts from 0, so `_next_index` is set again.
        self._known_reset_at = self._log.reset_at
        # The last capture, if it may be the first one after a reset; see `_first_after_reset`.
        self._possible_first: Capture | None = None
        # True if the index of the first capture was taken as the start, because no status was available.
        self._is_start_guessed = False
        # The highest plausible index so far, and when it was received.
        self._newest_index = 0
        self._newest_at = 0.0
        self._unanswered_requests = 0  # number of consecutive requests without an answer
        # Received captures that were not delivered yet: the successful ones by index, and the failed ones.
        self._received: dict[int, Capture] = {}
        self._failed: list[Capture] = []
        # How many captures the iterator has returned, and how many could not be received.
        self._delivered = 0
        self._missed = 0
        self._operation: ActiveOperation | None = None

    @property
    def missed(self) -> int:
        """Number of photos that were taken, but whose captures (the reports) were not received."""
        return self._missed

    async def __aenter__(self) -> Self:
        await self._link.require_capability("photo_interval", "capture_image")
        operation = ActiveOperation(self._link, "series", lambda: self._shutter.stop_command)
        self._operation = operation
        async with operation.starting():
            try:
                await self._begin(operation)
            except BaseException:
                self._new_captures.__exit__()  # Does nothing if `_begin` has not entered it yet.
                raise
        return self

    async def _begin(self, operation: ActiveOperation) -> None:
        status_before = await self._shutter.request_status_reliably()
        self._next_index = None if status_before is None else status_before.image_count
        first_index = 0 if status_before is None else status_before.image_count
        self._set_newest(first_index - 1)
        self._known_reset_at = self._log.reset_at
        self._new_captures.__enter__()
        await self._shutter.start_series(operation.order, self._interval_s, self._count, status_before)

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self._new_captures.__exit__()
        # PX4's trigger does not know the requested number, so it never ends the series by itself.
        has_ended = 0 < self._count <= self._delivered and not self._link.is_trigger
        if self._operation is not None and has_ended:
            self._operation.discard()
        elif self._operation is not None:
            await self._operation.stop(is_awaited=error is None)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Capture:
        """Return the next capture.

        Raises:
            OperationRejected: the camera ended the series early.
            OperationTimeout: the camera reports no more pictures.
        """
        silent_checks = 0
        while True:
            if self._count and self._delivered + self._missed >= self._count:
                raise StopAsyncIteration
            self._process_new_captures()
            if self._failed:
                self._delivered += 1
                return self._failed.pop(0)
            if self._next_index is not None and self._next_index in self._received:
                capture = self._received.pop(self._next_index)
                self._unanswered_requests = 0
                self._next_index += 1
                self._delivered += 1
                return capture
            if self._received and self._next_index is not None:  # Later captures have arrived, but not the next one.
                await self._fetch_next()
                continue
            patience_s = max(2.0 * self._interval_s, CHECK_INTERVAL_S) + CHECK_INTERVAL_S  # A picture may be late.
            has_arrived = await self._new_captures.wait(patience_s)
            if has_arrived:
                silent_checks = 0
                continue
            silent_checks += 1
            await self._check_silence(silent_checks)

    def _first_after_reset(self, capture: Capture) -> Capture | None:
        """Return the previous capture if it was the first after the camera began to count from 0 again."""
        previous, self._possible_first = self._possible_first, None
        has_log_reset = self._log.reset_at > self._known_reset_at
        if has_log_reset and self._next_index is not None and capture.index < self._next_index:
            self._possible_first = capture
            # A single low index could be corrupt, so two successive ones are needed.
            if previous is not None and capture.index == previous.index + 1:
                return previous
        return None

    def _process_new_captures(self) -> None:
        while capture := self._new_captures.pop():
            first_capture = self._first_after_reset(capture)
            if first_capture is not None:
                self._continue_after_reset(first_capture)
            # If the camera has not reported its image count, the first capture counts as the start of the series. If a
            # later capture has a much lower index, the first one was corrupt, and the later one is the start.
            if self._next_index is None or self._contradicts_guess(capture.index):
                self._guess_start(capture.index)
            if self._is_plausible(capture.index):
                self._add(capture)

    def _continue_after_reset(self, first_capture: Capture) -> None:
        """Continue the series with the new indices, of which ``first_capture`` has the lowest."""
        self._known_reset_at = self._log.reset_at
        self._next_index = first_capture.index
        self._is_start_guessed = False
        self._set_newest(first_capture.index)
        self._received = {first_capture.index: first_capture}

    def _guess_start(self, index: int) -> None:
        self._is_start_guessed = self._next_index is None  # True in the first call; a second call corrects the guess.
        self._next_index = index
        self._received.clear()  # It may contain a capture with a corrupt index.
        self._newest_index = index - 1  # One less, so that `_add` accepts the capture as the newest one.

    def _add(self, capture: Capture) -> None:
        # A failed capture is not stored by its index, because a later picture may have the same index.
        if capture.success is False:
            self._failed.append(capture)
        elif self._next_index is not None and capture.index >= self._next_index:
            self._received[capture.index] = capture
            if capture.index > self._newest_index:
                if self._delivered:  # A second capture in ascending order confirms the guess.
                    self._is_start_guessed = False
                self._set_newest(capture.index)

    def _set_newest(self, index: int) -> None:
        self._newest_index = index
        self._newest_at = self._link.now()

    def _max_new_captures(self) -> float:
        return 2.0 * (self._link.now() - self._newest_at) / self._interval_s + MAX_EXTRA_CAPTURES

    def _is_plausible(self, index: int) -> bool:
        return index <= self._newest_index + self._max_new_captures()

    def _contradicts_guess(self, index: int) -> bool:
        return (
            self._is_start_guessed
            and self._next_index is not None
            and index < self._next_index - self._max_new_captures()
        )

    async def _fetch_next(self) -> None:
        """Request the next capture. If it does not arrive, it counts as missed."""
        index = self._next_index
        assert index is not None
        capture = None
        can_fetch = not self._link.is_trigger and self._unanswered_requests < MAX_UNANSWERED
        if can_fetch:
            capture = await self._log.fetch(index)
        self._process_new_captures()
        if self._next_index != index:  # The captures that have arrived meanwhile show another start of the series.
            return
        if capture is not None:
            self._unanswered_requests = 0
            if capture.success is False:  # `_process_new_captures` has added it to `_failed`.
                self._next_index = index + 1
            else:
                self._received[index] = capture
        elif index not in self._received:
            self._unanswered_requests += 1
            following_index = index + 1
            if not can_fetch and self._received:  # Skip to the next capture that was received.
                following_index = min(self._received)
            self._missed += following_index - index
            self._next_index = following_index

    async def _check_silence(self, silent_checks: int) -> None:
        """Request the camera's status, and the next capture if the status shows that it was taken.

        Raises OperationRejected if the camera has ended the series, and OperationTimeout after ``MAX_SILENT_CHECKS``
        checks without a capture.
        """
        status = await self._shutter.request_status(2.0 * CHECK_INTERVAL_S)
        self._process_new_captures()
        is_ahead = status is not None and self._next_index is not None and status.image_count > self._next_index
        is_over = status is not None and not status.is_in_series and not status.is_capturing
        has_undelivered = bool(self._received or self._failed)
        if status is not None and is_ahead and self._is_plausible(status.image_count - 1):
            await self._fetch_next()
        elif is_over and not has_undelivered:
            raise OperationRejected(
                f"{self._link.describe()} ended the series after {self._delivered + self._missed} pictures"
            )
        elif silent_checks >= MAX_SILENT_CHECKS:
            activity = "takes pictures, but " if status is not None and not is_over else ""
            raise self._link.timeout_error(f"{activity}reports no more pictures")
