"""Taking pictures: one, or one after the other, and how it is found out what became of an order to do so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    OperationRejected,
)
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.vehicle.camera.album import Album, Arrivals
from aerokit.vehicle.camera.orders import SENT
from aerokit.vehicle.camera.part import Begun
from aerokit.vehicle.camera.values import CameraStatus, status_of

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.vehicle.camera.capture import Capture
    from aerokit.vehicle.camera.link import CameraLine
    from aerokit.vehicle.commanding.order import Order

START, STOP = MavCmd.IMAGE_START_CAPTURE, MavCmd.IMAGE_STOP_CAPTURE
CONTROL, TRIGGER = MavCmd.DO_DIGICAM_CONTROL, MavCmd.DO_TRIGGER_CONTROL
TRIGGER_INTERVAL = MavCmd.DO_SET_CAM_TRIGG_INTERVAL
LOOK_S, ASK_S = 1.0, 2.0
"""Without a word for so long, the camera is asked what it does; so long an answer is waited for."""
ASKED, ASKED_FIRST = 8, 3
"""So often a camera is asked what it does before an order, and one that has never said so."""
MOST_SILENT = 6
"""So many times nothing is heard of a series, and the camera does not say that it is over."""
AHEAD = 10
"""So many pictures more than twice what its interval allows for may have been taken within a series."""
UNTOLD = 3
"""After so many missing pictures that the camera does not tell of, it is not asked for the ones up to the next."""


class Shutter:
    """What pictures are ordered by, of one camera."""

    def __init__(self, line: CameraLine, album: Album) -> None:
        self.line: CameraLine = line
        self.album: Album = album
        self._number = 0
        self._lock = anyio.Lock()
        self._has_told = self._is_mute = False

    async def status(self, timeout: float = LOOK_S) -> CameraStatus | None:
        """What the camera does now; None when it does not tell."""
        if self.line.by_trigger or m.CameraCaptureStatus in self.line.untold:
            return None
        message = await self.line.ask(m.CameraCaptureStatus, timeout=timeout)
        self._has_told = self._has_told or message is not None
        return None if message is None else status_of(message)

    async def status_before(self) -> CameraStatus | None:
        """Asked with more patience, of a camera that is known to tell: what becomes of an order is judged by it."""
        for _ in range(ASKED if self._has_told else 1 if self._is_mute else ASKED_FIRST):
            told = await self.status(ASK_S)
            if told is not None or self.line.by_trigger or m.CameraCaptureStatus in self.line.untold:
                return told
        self._is_mute = not self._has_told
        return None

    async def take(self, timeout: float) -> Capture:
        """One picture; see `Camera.take_photo`."""
        async with self._lock:
            series = self.line.latest("series")
            before = await self.status_before()
            known = {each.index for each in self.album.captures()}
            error: CommandTimeout | None = None
            with Arrivals(self.album.cell) as arrivals, anyio.move_on_after(timeout):
                sent, error = 1, await self.order_one(before)
                while True:
                    while capture := arrivals.take():
                        if _is_new(capture, before, known):
                            return self._done(capture)
                    if await arrivals.wait(self._patience_s()):
                        continue
                    now = await self.status()
                    if now is None:
                        continue
                    if before is None:  # then an order that was accepted has made the newest
                        newest = now.image_count - 1
                        is_there = (
                            error is None and not now.is_capturing and newest >= 0 and newest not in known
                        )
                        missed = await self.album.ask_for(newest) if is_there else None
                    elif now.image_count > before.image_count:
                        missed = await self.album.ask_for(before.image_count)
                    elif self.line.latest("series") is not series:
                        continue  # a series was begun or ended since: this one is not ordered again
                    elif error is not None and sent < SENT and not now.is_capturing:
                        # it says, after the order, that it takes and has taken none: the order was lost
                        sent, error = sent + 1, await self.order_one(before, again=True)
                        continue
                    else:
                        continue
                    if missed is not None:
                        return self._done(missed)
            raise error or self.line.timed_out(
                f"accepted the order, and told of no picture within {timeout:g} s; it may have taken one"
            )

    def _done(self, capture: Capture) -> Capture:
        if capture.success is False:
            raise OperationRejected(f"{self.line.describe()} could not take the picture")
        return capture

    def _patience_s(self) -> float:
        return max(LOOK_S, 2.0 * (self.line.round_trip_s or 0.0))

    async def order_one(self, before: CameraStatus | None, *, again: bool = False) -> CommandTimeout | None:
        """Order a picture, once; the time-out if nothing was answered.

        The number of the order is the same if it is given again, so that a camera takes none twice.
        """
        if not again:
            count = 0 if before is None else before.image_count
            self._number = max(count + 1, self._number + 1)
        try:
            if self.line.by_trigger:
                await self._control()
            else:
                await self.line.order(START, self.line.device, 0, 1, self._number, attempts=1)
        except CommandTimeout as error:
            return error
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED or self.line.by_trigger:
                raise
            await self._control_or(error)
        return None

    async def _control(self) -> None:
        """The command of before, to whoever has nothing better."""
        await self.line.order(CONTROL, 0, 0, 0, 0, 1, 0, 0, attempts=1)

    async def _control_or(self, refusal: CommandRejected) -> None:
        try:
            await self._control()
        except CommandRejected:
            raise refusal from None

    async def start_series(
        self, given: Order, seconds: float, count: int, before: CameraStatus | None
    ) -> None:
        """Order pictures one after the other; again only when the camera says, after that, that it takes none."""
        if self.line.by_trigger:
            await self.line.order(TRIGGER_INTERVAL, seconds * 1000.0, -1)
            await self.line.order(TRIGGER, 1, -1, 0, 0, given=given)
            return

        async def has_begun() -> bool | None:
            now = await self.status_before()
            if now is None or before is None:
                return None
            return now.is_in_series or now.is_capturing or now.image_count > before.image_count

        order = (START, self.line.device, seconds, count, 0)
        await self.line.order_once(given, lambda: self.line.order(*order, given=given, attempts=1), has_begun)

    @property
    def stop_order(self) -> tuple[float, ...]:
        """What ends a series, with its parameters."""
        return (TRIGGER, 0, -1, 0, 0) if self.line.by_trigger else (STOP, self.line.device)


def _is_new(capture: Capture, before: CameraStatus | None, known: set[int]) -> bool:
    """Whether it can be the picture that was ordered: the index of a failed one may be used again."""
    return before is None or capture.index >= before.image_count or capture.index not in known


class PhotoInterval:
    """Pictures one after the other, for the time of an ``async with`` block; an iterator over them, in order.

    Made by :meth:`Camera.photo_interval`. What was missed is asked for again; ``missed`` counts pictures of which the
    camera could not tell any more (ArduPilot's and PX4's own know no more than the last one).
    """

    def __init__(self, shutter: Shutter, seconds: float, count: int) -> None:
        self._shutter, self._seconds, self._count = shutter, seconds, count
        self._line, self._album = shutter.line, shutter.album
        self._arrivals = Arrivals(self._album.cell)
        self._next: int | None = None
        self._began_at = self._album.began_at
        self._suspect: Capture | None = None
        self._is_guessed = False
        """Nobody has said that the series begins there: its first picture had this index."""
        self._believed_at = 0.0
        self._newest = 0
        """The highest index that could be true, heard at that time."""
        self._untold = 0
        self._came: dict[int, Capture] = {}
        self._failed: list[Capture] = []
        self._given = 0
        self._missed = 0
        self._begun: Begun | None = None

    @property
    def missed(self) -> int:
        """How many pictures were taken of which nothing more is known."""
        return self._missed

    async def __aenter__(self) -> Self:
        await self._line.able("photo_interval", "capture_image")
        begun = self._begun = Begun(self._line, "series", lambda: self._shutter.stop_order)
        try:
            await self._begin(begun)
        except BaseException as error:
            self._arrivals.__exit__()
            if begun.settle(error):
                await begun.end(is_awaited=False)
            raise
        begun.settle()
        return self

    async def _begin(self, begun: Begun) -> None:
        before = await self._shutter.status_before()
        self._next = None if before is None else before.image_count
        self._newest, self._believed_at = (self._next or 0) - 1, self._line.now()
        self._began_at = self._album.began_at
        self._arrivals.__enter__()
        await self._shutter.start_series(begun.given, self._seconds, self._count, before)

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._arrivals.__exit__()
        has_ended = 0 < self._count <= self._given and not self._line.by_trigger  # surely
        if self._begun is not None and has_ended:
            self._begun.drop()
        elif self._begun is not None:
            await self._begun.end(is_awaited=exc is None)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Capture:
        """The next picture.

        Raises:
            OperationRejected: the camera has ended the series before its time.
            OperationTimeout: nothing is heard of it any more.
        """
        silent = 0
        while True:
            if self._count and self._given + self._missed >= self._count:
                raise StopAsyncIteration
            self._sort()
            if self._failed:
                self._given += 1
                return self._failed.pop(0)
            if self._next is not None and self._next in self._came:
                capture = self._came.pop(self._next)
                self._untold = 0
                self._next += 1
                self._given += 1
                return capture
            if self._came and self._next is not None:
                await self._fill()
                continue
            if await self._arrivals.wait(max(2.0 * self._seconds, LOOK_S) + LOOK_S):
                silent = 0
                continue
            silent += 1
            await self._look(silent)

    def _first_anew(self, capture: Capture) -> Capture | None:
        """The first of two pictures on end that a camera has counted anew: a single one could be a lie."""
        before, self._suspect = self._suspect, None
        if self._album.began_at > self._began_at and self._next is not None and capture.index < self._next:
            self._suspect = capture
            if before is not None and capture.index == before.index + 1:
                return before
        return None

    def _sort(self) -> None:
        while capture := self._arrivals.take():
            first = self._first_anew(capture)
            if first is not None:
                self._began_at = self._album.began_at
                self._next, self._is_guessed = first.index, False
                self._newest, self._believed_at = first.index, self._line.now()
                self._came = {first.index: first}
            if self._next is None or self._was_guessed_wrong(capture.index):
                self._next, self._is_guessed = capture.index, self._next is None
                self._newest = capture.index - 1
            if not self._is_plausible(capture.index):
                continue
            if capture.success is False:  # the next one may have its index
                self._failed.append(capture)
            elif capture.index >= self._next:
                self._came[capture.index] = capture
                if capture.index > self._newest:
                    self._is_guessed = self._is_guessed and not self._given
                    self._newest, self._believed_at = capture.index, self._line.now()

    def _could_have_taken(self) -> float:
        """How many pictures, at most, since the newest one."""
        return 2.0 * (self._line.now() - self._believed_at) / self._seconds + AHEAD

    def _is_plausible(self, index: int) -> bool:
        """Whether there can be this one in the series by now; an index far ahead is a lie, or damaged."""
        return index <= self._newest + self._could_have_taken()

    def _was_guessed_wrong(self, index: int) -> bool:
        """The first picture told of an index, and this one, which came later, of one far below."""
        return self._is_guessed and self._next is not None and index < self._next - self._could_have_taken()

    async def _fill(self) -> None:
        """Those that are missing before those that have come."""
        assert self._next is not None
        found = None
        if not self._line.by_trigger and self._untold < UNTOLD:
            found = await self._album.ask_for(self._next)
        self._sort()
        if found is not None:
            self._untold = 0
        if found is not None and found.success is False:
            self._next += 1
        elif found is not None:
            self._came[self._next] = found
        elif self._next not in self._came:
            self._untold += 1
            is_told = not self._line.by_trigger and self._untold <= UNTOLD
            following = self._next + 1 if is_told or not self._came else min(self._came)
            self._missed += following - self._next
            self._next = following

    async def _look(self, silent: int) -> None:
        """Nothing has come for longer than it should take."""
        now = await self._shutter.status(2.0 * LOOK_S)
        self._sort()
        is_ahead = now is not None and self._next is not None and now.image_count > self._next
        if now is not None and is_ahead and self._is_plausible(now.image_count - 1):
            await self._fill()
        elif (
            now is not None
            and not now.is_in_series
            and not now.is_capturing
            and not self._came
            and not self._failed
        ):
            raise OperationRejected(
                f"{self._line.describe()} has ended the series after {self._given + self._missed} pictures"
            )
        elif silent >= MOST_SILENT:
            raise self._line.timed_out("takes pictures, and tells of none any more")
