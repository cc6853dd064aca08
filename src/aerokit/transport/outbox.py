"""``Outbox``: what a transport cannot take waits here, bounded in bytes and seconds, and can be taken back."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections import deque
from collections.abc import Callable

WRITE_DEADLINE_S = 1.0
"""What has waited for so long is not written any more: an order that arrives late is worse than none."""

STALLED_AFTER_S = 1.0
"""Bytes wait and none of them has left for so long: the link does not drain."""

_LOOK_EVERY_S = 0.25
_JOINED = 1024  # small frames that waited go out in pieces of up to so many bytes


class Outbox:
    """In front of one transport: passes writes on while it takes them, keeps them while it does not.

    ``send(data)`` hands bytes to the transport, ``pending()`` counts those that it, or the system, still has.
    At most ``limit`` bytes wait here, a single larger write excepted, none of them longer than `WRITE_DEADLINE_S`;
    ``dropped(n)`` is told of n writes that were thrown away. ``stalled(True)`` is called when nothing has left for
    `STALLED_AFTER_S` although something waits, ``stalled(False)`` when it goes on. Meanwhile nothing more is handed
    to the transport, so that no more than it has already is beyond recall.
    """

    def __init__(
        self,
        send: Callable[[bytes], object],
        pending: Callable[[], int],
        *,
        limit: int,
        dropped: Callable[[int], object],
        stalled: Callable[[bool], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._send, self._pending, self._limit = send, pending, limit
        self._dropped, self._tell_stalled = dropped, stalled
        self._waiting: deque[tuple[float, bytes]] = deque()  # (until when, frame)
        self._waiting_bytes = 0
        self._handed_over = 0  # bytes that were given to the transport
        self._left = 0  # bytes that had left it when somebody looked last
        self._moved_at = 0.0  # when some had, or when the first began to wait
        self._is_full = False  # the transport has said so
        self._is_stalled = self._is_closed = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_stalled(self) -> bool:
        """Whether something waits and nothing leaves."""
        return self._is_stalled

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were accepted and have not left this machine."""
        return self._waiting_bytes + self._pending()

    def write(self, data: bytes) -> None:
        """Hand over, keep, or drop and count; never blocks."""
        if self._is_closed:
            self._dropped(1)
            return
        if self._is_full or self._is_stalled or self._waiting:
            self._keep(bytes(data))
        else:
            self._hand_over(data)
        if self._timer is None:
            self._moved_at = self._loop.time()
            self._look_later()

    def pause(self) -> None:
        """The transport takes no more."""
        self._is_full = True

    def resume(self) -> None:
        """The transport takes some again: something has left it, whatever waits here."""
        self._is_full = False
        if self._is_closed:
            return
        self._moved_at = self._loop.time()
        self._set_stalled(False)
        self._flush()

    def discard(self) -> None:
        """Take back everything that waits here; the transport keeps what it has."""
        self._dropped(len(self._waiting))
        self._waiting.clear()
        self._waiting_bytes = 0

    def taken_back(self, count: int) -> None:
        """So many bytes were taken out of the transport, or out of the system: they have not left."""
        self._handed_over -= count

    def close(self) -> None:
        """Give the transport all that may still be written; no callback comes any more but ``dropped``."""
        if self._is_closed:
            return
        self._is_closed = True
        self._stop_looking()
        if self._is_stalled:
            self.discard()
        self._expire()
        while self._waiting:
            self._hand_over(self._joined())

    def _keep(self, data: bytes) -> None:
        if self._waiting and self._waiting_bytes + len(data) > self._limit:
            self._dropped(1)
            return
        self._waiting.append((self._loop.time() + WRITE_DEADLINE_S, data))
        self._waiting_bytes += len(data)

    def _hand_over(self, data: bytes) -> None:
        self._handed_over += len(data)
        self._send(data)

    def _flush(self) -> None:
        self._expire()
        while self._waiting and not self._is_full and not self._is_stalled and not self._is_closed:
            self._hand_over(self._joined())

    def _joined(self) -> bytes:
        """The next of what waits: whole writes, as few bytes as one has or up to `_JOINED`."""
        data = self._next()
        while self._waiting and len(data) + len(self._waiting[0][1]) <= _JOINED:
            data += self._next()
        return data

    def _next(self) -> bytes:
        data = self._waiting.popleft()[1]
        self._waiting_bytes -= len(data)
        return data

    def _expire(self) -> None:
        now, count = self._loop.time(), 0
        while self._waiting and self._waiting[0][0] <= now:
            self._next()
            count += 1
        if count:
            self._dropped(count)

    # ----------------------------------------------------------------------- does it drain?

    def _look_later(self) -> None:
        self._timer = self._loop.call_later(_LOOK_EVERY_S, self._look)

    def _stop_looking(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        """Four times a second while something waits, here or in the transport."""
        self._timer = None
        self._expire()
        pending, now = self._pending(), self._loop.time()
        left = self._handed_over - pending
        is_idle = not (pending or self._waiting or self._is_full)
        if left != self._left or is_idle:
            self._left, self._moved_at = left, now
            self._set_stalled(False)
        elif now - self._moved_at >= STALLED_AFTER_S:
            self._set_stalled(True)
        if self._timer is None and not self._is_closed and not is_idle:
            self._look_later()

    def _set_stalled(self, is_stalled: bool) -> None:
        if is_stalled == self._is_stalled:
            return
        self._is_stalled = is_stalled
        if not is_stalled:
            self._flush()
        self._tell_stalled(is_stalled)


def unsent_in_kernel(fd: int) -> int:
    """Bytes of a socket or terminal that the system still has, unsent or not acknowledged; 0 where it does not say."""
    if sys.platform != "linux":
        return 0
    import fcntl
    import termios

    with contextlib.suppress(OSError, ValueError):  # closed meanwhile
        return int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0
