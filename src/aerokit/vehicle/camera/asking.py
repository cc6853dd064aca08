"""What a camera is asked, by the command of now or by those of before, and the cells that are kept fresh by it."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.errors import CommandRejected, CommandTimeout, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.camera.line import CameraLine

__all__ = ["MAYBE_UNKNOWN", "Questions"]

WANTED_S = 10.0
"""Somebody has looked at a cell: so long its messages are asked for."""
LOOK_S = 1.0
MessageT = TypeVar("MessageT", bound=Message)

OF_OLD: dict[type[Message], tuple[int, tuple[float, ...]]] = {
    m.CameraInformation: (MavCmd.REQUEST_CAMERA_INFORMATION, (1,)),
    m.CameraSettings: (MavCmd.REQUEST_CAMERA_SETTINGS, (1,)),
    m.CameraCaptureStatus: (MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, (1,)),
    m.StorageInformation: (MavCmd.REQUEST_STORAGE_INFORMATION, (0, 1)),
    m.CameraImageCaptured: (MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE, (0,)),
    m.VideoStreamInformation: (MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, (0,)),
    m.VideoStreamStatus: (MavCmd.REQUEST_VIDEO_STREAM_STATUS, (0,)),
}
"""What asked for a message before MAV_CMD_REQUEST_MESSAGE did, and its parameters; the first is the number of which."""
NUMBERED = (m.StorageInformation, m.CameraImageCaptured, m.VideoStreamInformation, m.VideoStreamStatus)
UNKNOWN = (MavResult.UNSUPPORTED, MavResult.DENIED)
"""Answers that mean: never, until it reboots. Others mean: not now."""
MAYBE_UNKNOWN = (*UNKNOWN, MavResult.FAILED)
"""ArduPilot says FAILED of messages that it does not know, others of what they cannot do now: asked for rarely."""
RARELY_S = 60.0


class _Wish:
    """Notices that somebody looks at a cell; the camera is asked for what tells it, and reading asks nothing itself."""

    def __init__(
        self, now: Callable[[], float], cell: StateCell[Any], message_type: type[Message], period_s: float
    ) -> None:
        self._now, self._cell = now, cell
        self.message_type, self.period_s = message_type, period_s
        self.looked_at = self.asked_at = -math.inf
        self.is_refused = self.is_doubtful = False
        cell._feed_from(self)

    @property
    def pending(self) -> bool:
        """Never: but who asks has looked."""
        self.looked_at = self._now()
        return False

    def catch_up(self) -> None:
        """There is nothing to work out."""

    def watchers_changed(self) -> None:
        """Somebody begins or ends to wait."""
        self.looked_at = self._now()

    def is_due(self) -> bool:
        """Whether to ask: somebody looks, and nothing has come or was asked for lately."""
        now = self._now()
        is_wanted = self._cell._is_watched or now - self.looked_at <= WANTED_S
        period_s = max(RARELY_S, self.period_s) if self.is_doubtful else self.period_s
        newest = max(self.asked_at, self._cell._updated_at)
        return is_wanted and not self.is_refused and now - newest >= period_s


class Questions:
    """Asks one camera."""

    def __init__(self, line: CameraLine) -> None:
        self._line = line
        self._wishes: list[_Wish] = []
        self._asked_as_of_old: set[type[Message]] = set()

    async def ask(
        self,
        message_type: type[MessageT],
        *params: float,
        where: Callable[[MessageT], bool] = lambda _: True,
        timeout: float = 3.0,
    ) -> MessageT | None:
        """Ask for one message; None when it does not come in time.

        Raises:
            CommandRejected: the camera does not know it.
        """
        refusal: CommandRejected | None = None
        if message_type not in self._asked_as_of_old:
            try:
                return await self._line.component.request(message_type, *params, where=where, timeout=timeout)
            except OperationTimeout:
                return None
            except CommandRejected as error:
                if message_type not in OF_OLD or error.result not in MAYBE_UNKNOWN or self._line.is_behind:
                    raise
                refusal = error
        try:
            found = await self._ask_as_of_old(message_type, params, where, timeout)
        except CommandRejected as error:
            raise refusal or error from None
        self._asked_as_of_old.add(message_type)
        return found

    async def _ask_as_of_old(
        self,
        message_type: type[MessageT],
        params: tuple[float, ...],
        where: Callable[[MessageT], bool],
        timeout: float,
    ) -> MessageT | None:
        command, (first, *others) = OF_OLD[message_type]
        if message_type in NUMBERED and params:
            first = params[0]
        with self._line.component.subscribe(message_type, capacity=100) as answers:
            with suppress(CommandTimeout):
                await self._line.component.command(command, first, *others, retries=1)
            with anyio.move_on_after(timeout):
                async for answer in answers:
                    if where(answer):
                        return answer
        return None

    def keep_fresh(self, cell: StateCell[Any], message_type: type[Message], period_s: float) -> None:
        """Have the message asked for every so often while somebody looks at the cell that it tells."""
        self._wishes.append(_Wish(self._line.now, cell, message_type, period_s))

    def forget_refusals(self) -> None:
        """The camera, or the vehicle, has rebooted."""
        self._asked_as_of_old.clear()
        for wish in self._wishes:
            wish.is_refused = wish.is_doubtful = False

    async def run(self) -> None:
        """Ask for what somebody looks at, until cancelled."""
        while True:
            await anyio.sleep(LOOK_S)
            for wish in self._wishes:
                if self._line.number is not None and wish.is_due():
                    await self._refresh(wish)

    async def _refresh(self, wish: _Wish) -> None:
        wish.asked_at = self._line.now()
        try:
            await self.ask(wish.message_type, timeout=LOOK_S)
        except CommandRejected as error:
            wish.is_refused = error.result in UNKNOWN
            wish.is_doubtful = error.result in MAYBE_UNKNOWN
        else:
            wish.is_doubtful = False
