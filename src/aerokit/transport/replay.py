"""``Replay``: a recording (.tlog) as a link."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Generator, Iterator

from aerokit.errors import InvalidArgument, RecordingEnded
from aerokit.mavlink.tlog import read_tlog
from aerokit.transport.address import LinkAddress
from aerokit.transport.link import BaseLink, Peer

MAX_FRAMES_PER_ITERATION = 64
"""Maximum number of frames delivered in one loop iteration, so that other tasks can run."""

MAX_GAP_S = 60.0
"""Seconds to which longer gaps in a recording are shortened, e.g. between flights or at changes of the clock."""


class Replay(BaseLink):
    """A link that delivers the frames of a recording, one per callback, and then calls `link_lost` with RecordingEnded.

    ``speed`` 1.0 is the original speed, 2.0 takes half the time, None or infinity is as fast as possible. Writes are
    ignored and counted in `ignored_writes`.
    """

    def __init__(self, path: str | os.PathLike[str], speed: float | None = 1.0) -> None:
        factor = math.inf if speed is None else float(speed)
        if not factor > 0:
            raise InvalidArgument(f"speed = {speed!r} is not allowed: it must be above 0")
        options = () if factor == 1.0 else (("speed", repr(factor).removesuffix(".0")),)
        super().__init__(str(LinkAddress("replay", path=os.fspath(path), options=options)))
        self.ignored_writes: int = 0
        self.frames: int = 0
        """Number of frames delivered so far."""
        self._path, self._speed = path, factor
        self._loop: asyncio.AbstractEventLoop | None = None  # None before the opening
        self._records: Iterator[tuple[float, bytes]] = iter(())
        self._next: tuple[float, bytes] | None = None  # (time stamp, frame); None at the end of the recording
        self._due = 0.0  # time of the next frame, on the loop's clock
        self._wake_up: asyncio.Handle | None = None  # pending call of `_play`

    def write(self, data: bytes, peer: Peer = None) -> None:
        """Ignore the data and count the call."""
        self.ignored_writes += 1

    async def _connect(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._records = read_tlog(self._path)
        self._due = self._loop.time()
        self._next = next(self._records, None)
        self._wake_up = self._loop.call_soon(self._play)

    def _release(self) -> None:
        if self._wake_up is not None:
            self._wake_up.cancel()
        self._wake_up = None
        records, self._records, self._next = self._records, iter(()), None
        if isinstance(records, Generator):
            records.close()

    def _play(self) -> None:
        assert self._loop is not None
        now = self._loop.time()
        for _ in range(MAX_FRAMES_PER_ITERATION):
            if self._next is None or self._due > now:
                break
            self.frames += 1
            stamp, frame = self._next
            self._deliver(frame)
            self._advance(stamp)
        if self._next is None:  # `_lose` does nothing if the receiver has closed the link.
            self._lose(f"end of recording after {self.frames} frames", kind=RecordingEnded)
        else:
            self._wake_up = self._loop.call_at(max(now, self._due), self._play)

    def _advance(self, stamp: float) -> None:
        if self._receiver is None:  # The receiver has closed the link in its callback.
            return
        try:
            self._next = next(self._records, None)
        except OSError as error:
            reason = f"reading the recording failed: {error.strerror or error}"
            self._lose(reason, error, RecordingEnded)
            return
        if self._next is not None:
            next_stamp, _ = self._next
            gap_s = min(max(next_stamp - stamp, 0.0), MAX_GAP_S)
            self._due += gap_s / self._speed
