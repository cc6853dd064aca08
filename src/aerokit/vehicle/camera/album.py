"""``Album``: the pictures of one camera that were heard of, and those that were missed, asked for again."""

from __future__ import annotations

import math
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import CommandRejected
from aerokit.events import ImageCaptured
from aerokit.mavlink import messages as m
from aerokit.vehicle.camera.capture import (
    SECONDS_IN_1990,
    WRAPS,
    Capture,
    from_feedback,
    from_image,
    from_trigger,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.camera.link import CameraLine

LONGEST = 20_000
"""So many captures are kept: the newest."""
ASKED, ASK_S = 12, 1.0
BETTER_S = 0.3
"""So soon after CAMERA_TRIGGER, PX4 tells the same picture with its place, if it does at all."""
TOLD_TWICE_S = 10.0
"""Two kinds of messages with one index mean the same picture if they come within so long."""
OVERTAKEN_MS = 5000
"""A status that is so much older than the newest one was overtaken on its way; one that is older still: a restart."""
NEAR = 100
"""Indices are by so little above the count that was told last; of a camera that counts otherwise nothing is deduced."""
JUMP = 1000
"""More pictures than this are hardly missed between two."""
HALF = WRAPS // 2
"""Half of what the 16 bits of CAMERA_FEEDBACK can count: an index that is lower by more has begun anew."""


class _Picture:
    """What is known of one picture, and by which message."""

    __slots__ = ("boot_us", "capture", "kind", "utc_us")

    def __init__(self, message: Message, capture: Capture) -> None:
        self.kind, self.capture = type(message), capture
        if isinstance(message, m.CameraImageCaptured):
            self.utc_us, self.boot_us = message.time_utc, message.time_boot_ms * 1000
        else:
            stamp: int = getattr(message, "time_usec", 0)
            is_utc = stamp >= SECONDS_IN_1990 * 1_000_000
            self.utc_us, self.boot_us = (stamp, 0) if is_utc else (0, stamp)

    def is_same(self, other: _Picture) -> bool:
        """Whether it is the picture that was told before under the same index."""
        if self.kind is not other.kind:  # PX4 tells of one in two ways, one soon after the other
            return abs(self.capture.heard_at - other.capture.heard_at) <= TOLD_TWICE_S
        if self.utc_us and other.utc_us:
            return self.utc_us == other.utc_us
        if self.boot_us and other.boot_us:
            return self.boot_us == other.boot_us
        return self.capture.place == other.capture.place

    def is_later(self, other: _Picture) -> bool:
        """Whether it was taken after another one, by the camera's own clock."""
        if self.utc_us and other.utc_us:
            return self.utc_us > other.utc_us
        return bool(self.boot_us and other.boot_us) and self.boot_us > other.boot_us


class Album:
    """Keeps captures by their index. Of PX4's two messages about one picture the one with the place counts.

    A camera that restarts, or that somebody else formats, counts from 0 again: the album then begins anew.
    """

    def __init__(self, line: CameraLine) -> None:
        self._line = line
        self._by_index: dict[int, _Picture] = {}
        self._asked: set[int] = set()
        self._highest: _Picture | None = None
        self._far: _Picture | None = None
        self._failed: _Picture | None = None
        self._count, self._counts = 0, False
        self._count_boot_ms = 0
        self.began_at: float = -math.inf
        """When the album began anew, on the loop's clock: captures heard before are of another log of pictures."""
        self._has_images = False
        self.cell: StateCell[Capture] = line.cell(
            "camera.capture", "CAMERA_IMAGE_CAPTURED, CAMERA_FEEDBACK or CAMERA_TRIGGER"
        )
        line.on_cleared.append(self._begin_anew)
        line.listen(m.CameraImageCaptured, self._on_image)
        line.listen(m.CameraFeedback, self._on_feedback)
        line.listen(m.CameraTrigger, self._on_trigger)
        line.listen(m.CameraCaptureStatus, self._on_status)

    def captures(self) -> list[Capture]:
        """Those that were heard of, by their index."""
        return [self._by_index[index].capture for index in sorted(self._by_index)]

    def has(self, index: int) -> bool:
        """Whether this one was heard of."""
        return index in self._by_index

    async def ask_for(self, index: int) -> Capture | None:
        """One that was missed; None when the camera does not tell of it any more, or nothing gets through."""
        if not self.has(index) and self._line.by_trigger:
            return None
        self._asked.add(index)
        try:
            for _ in range(ASKED):
                if self.has(index) or await self._is_gone(index):
                    break
        finally:
            self._asked.discard(index)
        found = self._by_index.get(index)
        return None if found is None else found.capture

    async def _is_gone(self, index: int) -> bool:
        """Ask for it once; True when the camera says that it has no such picture, or knows only a newer one."""
        ask = self._line.questions.ask
        try:
            if not self._line.is_behind:
                await ask(m.CameraImageCaptured, index, where=partial(_has_index, index), timeout=ASK_S)
                return False
            newest = await ask(m.CameraFeedback, where=self._is_ours, timeout=ASK_S)
        except CommandRejected:
            return True
        return newest is not None and (newest.img_idx - 1) % WRAPS != index

    def _is_ours(self, message: m.CameraFeedback) -> bool:
        return message.cam_idx + 1 == self._line.number

    def hear(self, message: Message) -> None:
        """One that came before anybody listened."""
        if isinstance(message, m.CameraImageCaptured):
            self._on_image(message)
        elif isinstance(message, m.CameraFeedback):
            self._on_feedback(message)
        elif isinstance(message, m.CameraTrigger):
            self._on_trigger(message)

    def _on_image(self, message: m.CameraImageCaptured) -> None:
        self._has_images = True
        self._take(message, from_image(message, self._line.number or 0, self._line.now()))

    def _on_feedback(self, message: m.CameraFeedback) -> None:
        number = message.cam_idx + 1
        highest = self._highest
        has_wrapped = highest is not None and highest.capture.index > HALF
        if (message.img_idx > 0 or has_wrapped) and number == self._line.number:  # all zeros before the first
            self._take(message, from_feedback(message, number, self._line.now()))

    def _on_trigger(self, message: m.CameraTrigger) -> None:
        if self._line.is_behind and not self._has_images:
            capture = from_trigger(message, self._line.number or 0, self._line.now(), self._line.telemetry)
            self._line.later(BETTER_S, lambda: self._take_unless_known(message, capture))

    def _take_unless_known(self, message: m.CameraTrigger, capture: Capture) -> None:
        if not self._has_images:
            self._take(message, capture)

    def _on_status(self, message: m.CameraCaptureStatus) -> None:
        """The count has fallen: what comes now are others. One that was overtaken on its way does not count."""
        boot_ms, count = message.time_boot_ms, message.image_count
        if 0 < self._count_boot_ms - boot_ms < OVERTAKEN_MS:
            return
        self._count_boot_ms = boot_ms
        if count < self._count:
            self._begin_anew()
        self._count = count
        self._counts = self._counts or count > 0

    def _begin_anew(self) -> None:
        self._by_index.clear()
        self._highest = self._far = self._failed = None
        self._count = 0
        self.began_at = self._line.now()

    def _is_anew(self, picture: _Picture, before: _Picture | None) -> bool:
        """Whether this one shows that the camera counts from 0 again."""
        if before is not None and before.capture.success is not False:
            return not picture.is_same(before)
        index, highest = picture.capture.index, self._highest
        if highest is None or index >= highest.capture.index or index in self._asked:
            return False
        return highest.capture.index - index > HALF or picture.is_later(highest)

    def _take(self, message: Message, capture: Capture) -> None:
        picture = _Picture(message, capture)
        if capture.success is False:
            self._take_failed(message, picture)
            return
        before = self._by_index.get(capture.index)
        if self._is_anew(picture, before):
            self._begin_anew()
            before = None
        is_new = before is None or before.capture.success is False
        if before is not None and not is_new and before.kind in (picture.kind, m.CameraImageCaptured):
            return  # told once more, or worse
        self._keep(picture)
        self._note_highest(picture)
        if isinstance(message, m.CameraImageCaptured):
            self._count_boot_ms = message.time_boot_ms
        if (
            self._counts and capture.index <= self._count + NEAR
        ):  # a camera that counts as the standard has it
            self._count = max(self._count, capture.index)
        self._tell(message, capture, is_new=is_new)

    def _note_highest(self, picture: _Picture) -> None:
        """One far ahead of the others is believed when the next one is, too: it may be a lie, or damaged."""
        index, highest, far = picture.capture.index, self._highest, self._far
        self._far = None
        if highest is None or 0 <= index - highest.capture.index <= JUMP:
            self._highest = picture
        elif index > highest.capture.index:
            is_believed = far is not None and 0 <= index - far.capture.index <= JUMP
            self._highest, self._far = (picture, None) if is_believed else (highest, picture)

    def _take_failed(self, message: Message, picture: _Picture) -> None:
        """The next one that works may have its index."""
        index, failed = picture.capture.index, self._failed
        if failed is not None and failed.capture.index == index and failed.is_same(picture):
            return
        self._failed = picture
        before = self._by_index.get(index)
        if before is None or before.capture.success is False:
            self._keep(picture)
        self._tell(message, picture.capture, is_new=True)

    def _keep(self, picture: _Picture) -> None:
        self._by_index.pop(picture.capture.index, None)
        self._by_index[picture.capture.index] = picture
        if len(self._by_index) > LONGEST:
            del self._by_index[next(iter(self._by_index))]

    def _tell(self, message: Message, capture: Capture, *, is_new: bool) -> None:
        self._line.tell(self.cell, capture, message)
        if is_new:
            self._line.publish(
                ImageCaptured, capture.camera, capture.index, capture.success, capture.place, capture.file_url
            )


def _has_index(index: int, message: m.CameraImageCaptured) -> bool:
    return message.image_index == index


class Arrivals:
    """The captures that come within a ``with`` block, to be awaited one after the other."""

    def __init__(self, cell: StateCell[Capture]) -> None:
        self._cell = cell
        self._came: deque[Capture] = deque(maxlen=LONGEST)
        self._event = anyio.Event()
        self._detach: Callable[[], None] | None = None

    def __enter__(self) -> Arrivals:
        self._detach = self._cell.observe(self._take, every_arrival=True)
        return self

    def __exit__(self, *_: Any) -> None:
        if self._detach is not None:
            self._detach()

    def take(self) -> Capture | None:
        """The next one, if it has come."""
        return self._came.popleft() if self._came else None

    async def wait(self, seconds: float) -> bool:
        """Until one is there; False when none has come within so many seconds."""
        with anyio.move_on_after(seconds):
            while not self._came:
                self._cell._raise_if_closed()
                self._event = anyio.Event()
                await self._event.wait()
        return bool(self._came)

    def _take(self, _: Capture | None, capture: Capture) -> None:
        self._came.append(capture)
        self._event.set()
