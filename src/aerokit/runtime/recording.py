"""Writes everything sent and received into a ``.tlog`` file; a disk that is full ends the recording, not the flight."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from typing import TYPE_CHECKING

from aerokit.errors import LinkOpenError
from aerokit.mavlink.frame import MAGIC_V2
from aerokit.mavlink.tlog import TlogWriter

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["Recording"]

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
