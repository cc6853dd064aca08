"""Messages for programs that read them from ``vehicle._master`` instead of listening to them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.pymavlink_messages import message_of
from aerokit.dronekit.weakly import weakly
from aerokit.errors import LocalProtocolError
from aerokit.mavlink.dialect import STANDARD

if TYPE_CHECKING:
    from aerokit.dronekit.line import Line
    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame

__all__ = ["Inbox"]

MOST_KEPT = 1000
OLDEST_S = 5.0
"""A program that asks rarely gets what came lately, not what came when it asked last."""
FIRST_S = 1.0
"""How long the first look-ups wait for a message: nothing was kept before."""
SLICE_S = 0.2
"""Ctrl-C and the end of the connection are noticed between waits of this length."""


class Inbox(Mapping[str, Any]):
    """The last message of every type by its name, and what came since it was asked before, as pymavlink's objects.

    It begins with the first question; the first look-ups of a second wait for their message. It hears the vehicle,
    radios and ground stations; not other vehicles.
    """

    def __init__(self, connection: Line) -> None:
        self._connection = connection
        self._latest: dict[int, Frame] = {}
        self._frames: deque[Frame] = deque(maxlen=MOST_KEPT)
        self._came = threading.Condition()
        self._started: float | None = None

    def next_match(self, names: Collection[str] | None, condition: Any, timeout: float | None) -> Any:
        """The next message of one of these types that meets ``condition(message)``.

        None after ``timeout`` seconds (0: when there is none yet; None: never).

        Raises:
            APIException: the connection was closed meanwhile.
        """
        self._start()
        end = None if timeout is None else time.monotonic() + timeout
        while (frame := self._pop(end)) is not None:
            message = message_of(frame)
            if (names is None or message.get_type() in names) and condition(message):
                return message
        return None

    def age_s(self, name: str) -> float:
        """Seconds since a message of this type came, or since the first question."""
        self._start()
        frame = self._latest.get(_id_of(name))
        if frame is None:
            return time.monotonic() - (self._started or 0.0)
        return self._connection.connection.now() - frame.received_at

    def __getitem__(self, name: str) -> Any:
        self._start()
        message_id = _id_of(name)
        while (frame := self._latest.get(message_id)) is None and self._waits():
            with self._came:
                self._came.wait(SLICE_S / 10)
        if frame is None:
            raise KeyError(name)
        return message_of(frame)

    def __iter__(self) -> Iterator[str]:
        self._start()
        return iter([message_of(frame).get_type() for frame in self._latest.copy().values()])

    def __len__(self) -> int:
        self._start()
        return len(self._latest)

    # ------------------------------------------------------------------------------- inside

    def _start(self) -> None:
        with self._came:
            is_first, self._started = self._started is None, self._started or time.monotonic()
        if is_first:
            loop, tap = self._connection.loop, self._connection.connection.tap
            if loop.is_current:
                tap(weakly(self._take))
            else:
                loop.call(tap, weakly(self._take))  # which waits: what comes after the first question is kept

    def _waits(self) -> bool:
        is_young = self._started is not None and time.monotonic() < self._started + FIRST_S
        return is_young and self._connection.connection.is_open and not self._connection.loop.is_current

    def _take(self, frame: Frame, peer: Peer) -> None:
        """On the loop's thread."""
        if self._connection.is_of_another_vehicle(frame.system_id):
            return
        with self._came:
            self._latest[frame.message_id] = frame
            self._frames.append(frame)
            self._came.notify_all()

    def _pop(self, end: float | None) -> Frame | None:
        """The oldest frame that is not too old; None when the time is over."""
        now = self._connection.connection.now
        while True:
            with self._came:
                while self._frames:
                    frame = self._frames.popleft()
                    if now() - frame.received_at < OLDEST_S:
                        return frame
                left = SLICE_S if end is None else min(end - time.monotonic(), SLICE_S)
                if left > 0:
                    self._check()
                    self._came.wait(left)
                elif not self._frames:
                    return None

    def _check(self) -> None:
        if self._connection.is_closed or not self._connection.connection.is_open:
            raise APIException("the connection was closed")


def _id_of(name: str) -> int:
    try:
        return STANDARD.by_name(name).ID
    except LocalProtocolError:
        raise KeyError(name) from None
