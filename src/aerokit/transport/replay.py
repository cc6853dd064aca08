"""A recording (.tlog) as a link: the same program runs on a recorded flight."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Generator, Iterator

from aerokit.errors import InvalidArgument, RecordingEnded
from aerokit.mavlink.tlog import read_tlog
from aerokit.transport.address import LinkAddress
from aerokit.transport.link import BaseLink, Peer

FRAMES_PER_TURN = 64
"""So many frames are handed over in one go before everybody else on the loop gets a turn."""

LONGEST_GAP_S = 60.0
"""A longer silence in a recording is cut to this: it is a pause between flights, or the clock was set."""


class Replay(BaseLink):
    """Hands over the frames of a recording, each as one piece, then is lost with "end of recording".

    ``speed`` 1.0 keeps the original pace, 2.0 takes half the time, None or infinity goes as fast as it can.
    What is written goes nowhere and is counted in `ignored_writes`.
    """

    ignored_writes: int
    frames: int

    def __init__(self, path: str | os.PathLike[str], speed: float | None = 1.0) -> None:
        factor = math.inf if speed is None else float(speed)
        if not factor > 0:
            raise InvalidArgument(f"the speed of a replay must be above 0, not {speed!r}")
        options = () if factor == 1.0 else (("speed", repr(factor).removesuffix(".0")),)
        super().__init__(str(LinkAddress("replay", path=os.fspath(path), options=options)))
        self.ignored_writes = 0
        self.frames = 0
        """Frames handed over up to now."""
        self._path, self._speed = path, factor
        self._loop: asyncio.AbstractEventLoop | None = None
        self._records: Iterator[tuple[float, bytes]] = iter(())
        self._next: tuple[float, bytes] | None = None
        self._due = 0.0  # of the next frame, on the loop's clock
        self._wake_up: asyncio.Handle | None = None

    def write(self, data: bytes, peer: Peer = None) -> None:
        """Ignores the bytes and counts the call."""
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
        """Hands over what is due, at most `FRAMES_PER_TURN`, and comes back for the rest."""
        assert self._loop is not None
        now = self._loop.time()
        for _ in range(FRAMES_PER_TURN):
            if self._next is None or self._due > now:
                break
            self.frames += 1
            stamp, frame = self._next
            self._deliver(frame)
            self._advance(stamp)
        if self._next is None:  # nothing is lost that the receiver has closed
            self._lose(f"end of recording after {self.frames} frames", kind=RecordingEnded)
        else:
            self._wake_up = self._loop.call_at(max(now, self._due), self._play)

    def _advance(self, stamp: float) -> None:
        if self._receiver is None:  # closed by the receiver
            return
        try:
            self._next = next(self._records, None)
        except OSError as error:
            reason = f"the recording cannot be read on: {error.strerror or error}"
            self._lose(reason, error, RecordingEnded)
            return
        if self._next is not None:
            gap = min(max(self._next[0] - stamp, 0.0), LONGEST_GAP_S)
            self._due += gap / self._speed
