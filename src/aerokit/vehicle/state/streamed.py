"""Messages that come in streams: what they say is worked out when somebody looks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.frame import Frame

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Sequence

    from aerokit.mavlink.message import Message
    from aerokit.runtime.cells import StateCell

__all__ = ["StreamedMessage"]

LOOK_S = 5.0
"""So often, in seconds, they are worked out although nobody looks: a value that a later message does not have any more
(a position without a fix) is known from before."""

_HEADER_LENGTH = 9


class StreamedMessage:
    """One kind of message of one vehicle's autopilot. It keeps the latest frame, and works it out when it is looked at.

    ``number_at``: where in the payload the byte is that says which one of several it speaks of; each of them is kept.
    While one of ``cells`` is watched, each frame is worked out (``apply(frame, message)``) as it comes. Frames come on
    the loop's thread; any thread may look. ``lock`` keeps the threads apart.
    """

    __slots__ = (
        "_apply",
        "_cells",
        "_component_id",
        "_is_watched",
        "_lock",
        "_look_at",
        "_number_at",
        "pending",
    )

    def __init__(
        self,
        component_id: int,
        cells: Sequence[StateCell[object]],
        number_at: int | None,
        apply: Callable[[Frame, Message | None], None],
        lock: threading.RLock,
    ) -> None:
        self._component_id, self._cells, self._apply, self._lock = component_id, cells, apply, lock
        self._number_at = None if number_at is None else number_at + _HEADER_LENGTH
        self._look_at = -math.inf
        self._is_watched = False
        self.pending: dict[int, Frame | Message] = {}
        """The frames that were not worked out yet, by the number of what they speak of."""

    def take(self, frame: Frame, message: Message | None = None) -> None:
        """Take a frame of the vehicle's system; only those of its autopilot count. ``message``: if it is decoded."""
        if frame.component_id != self._component_id:
            return
        if self._is_watched or frame.received_at >= self._look_at:
            self._look_at = frame.received_at + LOOK_S
            with self._lock:  # never left to another thread: who waits for it is told on this one
                self.catch_up()
                self._apply(frame, message)
            return
        number_at = self._number_at
        if number_at is None:
            self.pending[0] = frame if message is None else message
        else:
            number = frame.body[number_at] if len(frame.body) > number_at else 0
            self.pending[number] = frame if message is None else message

    def catch_up(self) -> None:
        """Work out what has come, in the order in which it came."""
        with self._lock:
            waiting: list[tuple[Frame, Message | None]] = []
            # None is left first: who works one out may look at the value before, and come here again.
            while self.pending:
                came = self.pending.popitem()[1]
                if isinstance(came, Frame):
                    waiting.append((came, None))
                elif came.received_frame is not None:
                    waiting.append((came.received_frame, came))
            waiting.sort(key=lambda each: each[0].received_at)
            for frame, message in waiting:
                self._apply(frame, message)

    def watchers_changed(self) -> None:
        """Somebody begins or ends to wait for what is in the cells."""
        self._is_watched = any(cell._is_watched for cell in self._cells)

    def forget(self) -> None:
        """What has come does not count any more."""
        with self._lock:
            self.pending.clear()
            self._look_at = -math.inf
