"""What the parts of a camera rest on, and their ``async with`` blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import CommandRejected

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType

    from aerokit.vehicle.camera.link import CameraLine
    from aerokit.vehicle.commanding.order import Order


class CameraPart:
    """Some of the calls of a camera. Parts know the line to it, and not each other."""

    def __init__(self, line: CameraLine) -> None:
        self._line = line


class Begun:
    """What a camera has begun and is told to end when the block about it does, or the vehicle's."""

    def __init__(self, line: CameraLine, subject: str, stop: Callable[[], tuple[float, ...]]) -> None:
        self._line, self._stop = line, stop
        self.given: Order = line.begin(subject)
        self._is_over = False
        line.on_finish.append(self._finish)

    def settle(self, error: BaseException | None = None) -> bool:
        """It was begun, unless there was an error; whether it may have begun in spite of that, and is to be ended."""
        if error is not None and (not self.given.is_given or isinstance(error, CommandRejected)):
            self.given.withdraw()
            self.drop()
            return False
        self.given.settle()
        return error is not None

    def drop(self) -> None:
        """There is nothing to end."""
        self._is_over = True
        if self._finish in self._line.on_finish:
            self._line.on_finish.remove(self._finish)

    async def end(self, *, is_awaited: bool) -> None:
        """Tell the camera to end it, once; a newer order about the same is left alone."""
        if not self._is_over:
            self.drop()
            command, *params = self._stop()
            await self._line.finish(self.given, int(command), *params, is_awaited=is_awaited)

    def _finish(self) -> None:
        """The block of the vehicle is left: the order leaves at once, and nobody waits for its answer."""
        is_meant = self.given.is_given and self.given.is_newest
        self.drop()
        if is_meant:
            command, *params = self._stop()
            self._line.order_now(int(command), *params)


class CameraBlock:
    """Something that a camera does for the time of an ``async with`` block: it ends with it, whatever comes.

    The order to end leaves at once, also when the program is cancelled, and is sent again until it is answered. It
    leaves with the vehicle's block, too, if that ends before. A newer order about the same is not undone by it.
    """

    def __init__(
        self,
        line: CameraLine,
        subject: str,
        able: Callable[[], Awaitable[None]],
        start: Callable[[Order], Awaitable[None]],
        stop: Callable[[], tuple[float, ...]],
    ) -> None:
        self._line, self._subject = line, subject
        self._able, self._start, self._stop = able, start, stop
        self._begun: Begun | None = None

    async def __aenter__(self) -> None:
        await self._able()
        begun = self._begun = Begun(self._line, self._subject, self._stop)
        try:
            await self._start(begun.given)
        except BaseException as error:
            if begun.settle(error):
                await begun.end(is_awaited=False)
            raise
        begun.settle()

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._begun is not None:
            await self._begun.end(is_awaited=exc is None)
