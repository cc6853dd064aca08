"""``Taps``: who sees every frame of a connection: programs that asked for it, and the recording."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from typing import TYPE_CHECKING, TypeVar

from aerokit.connection.bus import once
from aerokit.errors import BusyError, LinkOpenError
from aerokit.mavlink.frame import MAGIC_V2
from aerokit.mavlink.tlog import TlogWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.connection.bus import Detach
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

    Tap = Callable[[Frame, Peer], object]
    SentTap = Callable[[bytes], object]

logger: logging.Logger = logging.getLogger("aerokit")

MAX_WAITING = 1000

SETUP_SIGNING = (256).to_bytes(3, "little")


class Recording:
    """A ``.tlog`` of one connection, begun anew: a file of that name is replaced as soon as a frame is received.

    So a connection on which nobody is heard leaves an older recording as it was.

    Everything is kept as it is, signatures too, but SETUP_SIGNING is left out: it holds the key.

    ``now`` is the time on the clock that :meth:`write` is given times of. The stamps are the wall clock's at the
    beginning and go on by the other one: setting the clock during a flight, as a companion computer does when it
    finds a network, makes no step.

    Raises:
        LinkOpenError: the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], now: float) -> None:
        self._path = os.fspath(path)
        self._wall_at_0 = time.time() - now
        self._writer: TlogWriter | None = None
        self._waiting: deque[tuple[bytes, float]] | None = None  # what was sent before anything was received
        try:
            if os.path.isfile(path) and os.path.getsize(path):
                with open(path, "ab"):
                    self._waiting = deque(maxlen=MAX_WAITING)
            else:
                self._writer = TlogWriter(path)
        except OSError as error:
            raise LinkOpenError(f"cannot record to {self._path}: {error.strerror or error}") from None

    def write(self, raw: bytes, at: float) -> None:
        """Add one frame that was received at this time; never raises."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._replace(waiting)
        self._write(raw, at)

    def write_sent(self, raw: bytes, at: float) -> None:
        """Add one frame that was sent at this time; never raises."""
        if self._waiting is None:
            self._write(raw, at)
        else:
            self._waiting.append((raw, at))

    def _replace(self, waiting: Iterable[tuple[bytes, float]]) -> None:
        try:
            self._writer = TlogWriter(self._path)
        except OSError as error:
            self._report(error)
        for raw, at in waiting:
            self._write(raw, at)

    def _write(self, raw: bytes, at: float) -> None:
        if self._writer is not None and not (raw[0] == MAGIC_V2 and raw[7:10] == SETUP_SIGNING):
            try:
                self._writer.write(raw, self._wall_at_0 + at)
            except OSError as error:
                self._give_up(error)

    def flush(self) -> None:
        """Hand everything to the system, so that a crash of the program loses nothing; never raises."""
        if self._writer is not None:
            try:
                self._writer.flush()
            except OSError as error:
                self._give_up(error)

    def close(self) -> None:
        """End the file; never raises, idempotent."""
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                writer.close()
            except OSError as error:
                self._report(error)

    def _give_up(self, error: OSError) -> None:
        self._report(error)
        writer, self._writer = self._writer, None
        if writer is not None:
            try:
                writer.close()
            except OSError:
                logger.debug("the end of %s was lost too", self._path)

    def _report(self, error: OSError) -> None:
        logger.error("recording to %s has ended: %s", self._path, error.strerror or error)


_TapT = TypeVar("_TapT")


class Taps:
    """``on_change()`` is called when frames that nobody subscribed to are wanted, or are so no more."""

    def __init__(self, on_change: Callable[[], object]) -> None:
        self._on_change = on_change
        self._sent: tuple[SentTap, ...] = ()
        self.received: tuple[Tap, ...] = ()
        """Who gets what is received."""
        self.recording: Recording | None = None

    @property
    def want_all(self) -> bool:
        """Whether somebody wants every frame that is received."""
        return self.recording is not None or bool(self.received)

    def add(self, sink: Tap) -> Detach:
        """Give every frame that is received to ``sink(frame, peer)``."""
        self.received = (*self.received, sink)
        self._on_change()

        def detach() -> None:
            self.received = _without(self.received, sink)
            self._on_change()

        return once(detach)

    def add_sent(self, sink: SentTap) -> Detach:
        """Give every frame that is sent to ``sink(raw)``."""
        self._sent = (*self._sent, sink)

        def detach() -> None:
            self._sent = _without(self._sent, sink)

        return once(detach)

    def give(self, frame: Frame, peer: Peer) -> None:
        """A frame was received, and delivered to those who subscribed to its message."""
        for tap in self.received:
            try:
                tap(frame, peer)
            except Exception:
                logger.exception("a tap (%r) raised; the frame was delivered to the others", tap)

    def give_sent(self, raw: bytes) -> None:
        """A frame was sent."""
        for tap in self._sent:
            try:
                tap(raw)
            except Exception:
                logger.exception("a tap (%r) raised; the frame was sent all the same", tap)

    def record(self, path: str | os.PathLike[str], now: float) -> None:
        """Record from now on; LinkOpenError when the file cannot be written, BusyError when another one is."""
        if self.recording is not None:
            raise BusyError("this connection is being recorded already")
        self.recording = Recording(path, now)
        self._on_change()

    def keep_received(self, raw: bytes, at: float) -> None:
        """A frame that was received goes into the recording, if there is one."""
        if self.recording is not None:
            self.recording.write(raw, at)

    def keep_sent(self, raw: bytes, at: float) -> None:
        """A frame that was sent goes into the recording, if there is one."""
        if self.recording is not None:
            self.recording.write_sent(raw, at)

    def flush(self) -> None:
        """Hand what is recorded to the system."""
        if self.recording is not None:
            self.recording.flush()

    def close(self) -> None:
        """End the recording."""
        if self.recording is not None:
            self.recording.close()
            self.recording = None


def _without(taps: tuple[_TapT, ...], sink: _TapT) -> tuple[_TapT, ...]:
    left = list(taps)
    left.remove(sink)
    return tuple(left)
