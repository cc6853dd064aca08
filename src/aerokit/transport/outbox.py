"""``Outbox``: write buffer in front of a transport. It is limited in bytes and seconds, and can be discarded."""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

WRITE_TIMEOUT_S = 1.0
"""Seconds after which waiting data is dropped, because a late command is worse than none."""

STALLED_AFTER_S = 1.0
"""A link counts as stalled if data waits, and none has left this machine for this many seconds."""

_POLL_INTERVAL_S = 0.25
_MAX_JOINED_BYTES = 1024  # Small frames that have waited are combined into writes of up to this size.


class _WaitingWrite(NamedTuple):
    deadline: float
    data: bytes


class Outbox:
    """Write buffer of one transport: forwards writes while the transport accepts them, and buffers them otherwise.

    At most ``limit`` bytes (or one larger write) are buffered, for at most `WRITE_TIMEOUT_S`. While the transport is
    stalled, nothing is forwarded, because data in the transport cannot be discarded.

    Args:
        send: writes bytes to the transport.
        pending_bytes: returns the number of unsent bytes in the transport and the kernel.
        limit: maximum number of buffered bytes.
        on_dropped: called with the number of dropped writes.
        on_stalled: called with True when waiting data stays for `STALLED_AFTER_S`, with False when it leaves again.
    """

    def __init__(
        self,
        send: Callable[[bytes], object],
        pending_bytes: Callable[[], int],
        *,
        limit: int,
        on_dropped: Callable[[int], object],
        on_stalled: Callable[[bool], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._send, self._pending_bytes, self._limit = send, pending_bytes, limit
        self._on_dropped, self._on_stalled = on_dropped, on_stalled
        self._waiting: deque[_WaitingWrite] = deque()
        self._waiting_bytes = 0
        self._forwarded_bytes = 0  # number of bytes written to the transport
        self._last_forwarded = (0, math.inf)  # number of writes forwarded last, and the deadline of the oldest of them
        self._sent_bytes = 0  # number of bytes that had left this machine at the last poll
        self._progress_at = 0.0  # time at which data last left this machine, or at which polling began
        self._is_full = False  # True between pause() and resume()
        self._is_stalled = self._is_closed = False
        self._timer: asyncio.TimerHandle | None = None  # None when all data has been sent

    @property
    def is_stalled(self) -> bool:
        return self._is_stalled

    @property
    def unsent_bytes(self) -> int:
        return self._waiting_bytes + self._pending_bytes()

    def write(self, data: bytes) -> None:
        """Forward, buffer or drop data. Never blocks."""
        if self._is_closed:
            self._on_dropped(1)
            return
        if self._is_full or self._is_stalled or self._waiting:
            self._buffer(bytes(data))
        else:
            self._forward(data, 1, self._loop.time() + WRITE_TIMEOUT_S)
        if self._timer is None:
            self._progress_at = self._loop.time()
            self._schedule_poll()

    def pause(self) -> None:
        """Buffer writes from now on. Called when the transport's own buffer is full."""
        self._is_full = True

    def resume(self) -> None:
        """Forward the buffered data. Called when the transport accepts data again."""
        self._is_full = False
        if self._is_closed:
            return
        self._progress_at = self._loop.time()
        self._set_stalled(False)
        self._flush()

    def discard(self) -> None:
        """Drop the data in this buffer. Data in the transport is kept."""
        self._on_dropped(len(self._waiting))
        self._waiting.clear()
        self._waiting_bytes = 0

    def record_discarded(self, count: int) -> None:
        """Record that this many bytes were discarded from the transport or the kernel."""
        self._forwarded_bytes -= count

    def drop_forwarded_if_late(self, size: int) -> bool:
        """Return True if the last forwarded write has waited too long, and count it as dropped.

        Call this method before the transport sends the first of the ``size`` bytes of this write. If the result is
        True, the caller must not send them.
        """
        count, deadline = self._last_forwarded
        if self._loop.time() < deadline:
            return False
        self._on_dropped(count)
        self.record_discarded(size)
        return True

    def close(self) -> None:
        """Forward waiting data, or drop it if the transport is stalled. Afterwards, ``on_stalled`` is not called."""
        if self._is_closed:
            return
        self._is_closed = True
        self._stop_polling()
        if self._is_stalled:
            self.discard()
        self._drop_outdated()
        while self._waiting:
            self._forward_joined()

    def _buffer(self, data: bytes) -> None:
        # An empty buffer accepts even a frame that is larger than the limit.
        if self._waiting and self._waiting_bytes + len(data) > self._limit:
            self._on_dropped(1)
            return
        self._waiting.append(_WaitingWrite(self._loop.time() + WRITE_TIMEOUT_S, data))
        self._waiting_bytes += len(data)

    def _forward(self, data: bytes, count: int, deadline: float) -> None:
        self._forwarded_bytes += len(data)
        self._last_forwarded = count, deadline
        self._send(data)

    def _flush(self) -> None:
        self._drop_outdated()
        while self._waiting and not (self._is_full or self._is_stalled or self._is_closed):
            self._forward_joined()

    def _forward_joined(self) -> None:
        """Remove the next write and forward it, joined with the writes that follow."""
        deadline, count = self._waiting[0].deadline, 1
        joined = self._pop_oldest()
        while self._waiting and len(joined) + len(self._waiting[0].data) <= _MAX_JOINED_BYTES:
            joined += self._pop_oldest()
            count += 1
        self._forward(joined, count, deadline)

    def _pop_oldest(self) -> bytes:
        data = self._waiting.popleft().data
        self._waiting_bytes -= len(data)
        return data

    def _drop_outdated(self) -> None:
        now = self._loop.time()
        outdated = sum(write.deadline <= now for write in self._waiting)  # The deadlines are in order.
        for _ in range(outdated):
            self._pop_oldest()
        if outdated:
            self._on_dropped(outdated)

    # ------------------------------------------------------------------- stall detection

    def _schedule_poll(self) -> None:
        self._timer = self._loop.call_later(_POLL_INTERVAL_S, self._poll)

    def _stop_polling(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _poll(self) -> None:
        """Drop outdated writes, and check whether data has left since the last poll."""
        self._timer = None
        self._drop_outdated()
        pending_bytes, now = self._pending_bytes(), self._loop.time()
        sent_bytes = self._forwarded_bytes - pending_bytes  # Forwarded bytes that are no longer pending have left.
        is_idle = not (pending_bytes or self._waiting or self._is_full)
        if sent_bytes != self._sent_bytes or is_idle:
            self._sent_bytes, self._progress_at = sent_bytes, now
            self._set_stalled(False)
        elif now - self._progress_at >= STALLED_AFTER_S:
            self._set_stalled(True)
        # The callback `on_stalled` may have written data, which starts the timer, or closed this outbox.
        if self._timer is None and not self._is_closed and not is_idle:
            self._schedule_poll()

    def _set_stalled(self, is_stalled: bool) -> None:
        if is_stalled == self._is_stalled:
            return
        self._is_stalled = is_stalled
        if not is_stalled:
            self._flush()
        self._on_stalled(is_stalled)


def kernel_unsent_bytes(fd: int) -> int:
    """Return the number of unsent or unacknowledged bytes in the kernel. 0 on systems other than Linux."""
    if sys.platform != "linux":
        return 0
    import fcntl
    import termios

    with contextlib.suppress(OSError, ValueError):  # The descriptor may have been closed.
        return int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0
