"""``FrameObservers``: the recording of a connection, and callbacks that get every frame."""

from __future__ import annotations

import errno
import itertools
import logging
import os
import time
from collections import deque
from typing import TYPE_CHECKING, BinaryIO, TypeVar

from aerokit.connection.bus import once
from aerokit.errors import BusyError, LinkOpenError
from aerokit.mavlink.frame import MAGIC_V2
from aerokit.mavlink.tlog import TlogWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.connection.bus import Detach
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

    FrameObserver = Callable[[Frame, Peer], object]
    SentFrameObserver = Callable[[bytes], object]

logger: logging.Logger = logging.getLogger("aerokit")

MAX_WAITING = 1000  # maximum number of sent frames that wait for the first received frame

SETUP_SIGNING_ID = (256).to_bytes(3, "little")  # message id, as in the header of a MAVLink 2 frame


class Recording:
    """A ``.tlog`` file of one connection. An existing file is kept under a numbered name, see :func:`keep_existing`.

    The existing file is renamed when the first frame is received; without a frame, it keeps its name. Frames are
    written unchanged, with their signatures. SETUP_SIGNING is left out, because it contains the key.

    ``now`` is the current time on the clock of :meth:`write`. Time stamps are the system time at the start, advanced by
    that clock. The recording therefore has no jump when the system clock is set in flight, e.g. on a companion computer
    that connects to a network.

    A device or a pipe is opened and written without waiting: the event loop, and with it our heartbeats, must not wait
    for the program that reads it. If that program is too slow, the recording ends.

    Raises:
        LinkOpenError: the file cannot be written, or no program reads the pipe.
    """

    def __init__(self, path: str | os.PathLike[str], now: float) -> None:
        self._path = os.fspath(path)
        self._unix_epoch_s = time.time() - now  # seconds since 1970 at time 0 of the clock
        self._writer: TlogWriter | None = None  # None while frames wait (see `_waiting`) and after the end
        self._file: BinaryIO | None = None  # the file of the writer
        # Sent frames that wait for the first received frame, because only then an existing file is renamed and the new
        # file is opened. None if no file existed, and after the first received frame.
        self._waiting: deque[tuple[bytes, float]] | None = None
        try:
            if os.path.exists(path) and not os.path.isfile(path):  # The path is that of a device or a pipe.
                self._file = open(path, "wb", opener=_open_without_waiting)  # noqa: SIM115 - closed by close()
                self._writer = TlogWriter(self._file)
            elif os.path.exists(path):
                _check_renamable(path)
                self._waiting = deque(maxlen=MAX_WAITING)
            else:
                self._open_new()
        except OSError as error:
            reason = "no program reads this pipe yet" if error.errno == errno.ENXIO else error.strerror or error
            raise LinkOpenError(f"cannot record to {self._path}: {reason}") from None

    def write(self, raw: bytes, at: float) -> None:
        """Add a frame received at this time. Never raises."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._begin(waiting)
        self._write(raw, at)

    def write_sent(self, raw: bytes, at: float) -> None:
        """Add a frame sent at this time. Never raises."""
        if self._waiting is None:
            self._write(raw, at)
        else:
            self._waiting.append((raw, at))

    def _begin(self, waiting: Iterable[tuple[bytes, float]]) -> None:
        try:
            self._open_new()
        except OSError as error:
            self._report(error)
        for raw, at in waiting:
            self._write(raw, at)

    def _open_new(self) -> None:
        while True:
            try:
                # Mode "x" fails if another program has just created the file.
                self._file = open(self._path, "xb")  # noqa: SIM115 - closed by close()
            except FileExistsError:
                if (kept := keep_existing(self._path)) is not None:
                    logger.warning("%s existed and was kept as %s", self._path, kept)
            else:
                self._writer = TlogWriter(self._file)
                return

    def _write(self, raw: bytes, at: float) -> None:
        contains_key = raw[0] == MAGIC_V2 and raw[7:10] == SETUP_SIGNING_ID
        if self._writer is not None and not contains_key:
            try:
                self._writer.write(raw, self._unix_epoch_s + at)
            except OSError as error:
                self._abort(error)

    def flush(self) -> None:
        """Flush to the operating system, so that a crash of the program loses nothing. Never raises."""
        if self._writer is not None:
            try:
                self._writer.flush()
            except OSError as error:
                self._abort(error)

    def close(self) -> None:
        """Close the file. Never raises; idempotent."""
        try:
            self._close()
        except OSError as error:
            self._report(error)

    def _close(self) -> None:
        writer, self._writer = self._writer, None
        file, self._file = self._file, None
        try:
            if writer is not None:
                writer.close()
        finally:
            if file is not None:
                file.close()

    def _abort(self, error: OSError) -> None:
        self._report(error)
        try:
            self._close()
        except OSError:
            logger.debug("the last frames of %s could not be written", self._path)

    def _report(self, error: OSError) -> None:
        logger.error("recording to %s has ended: %s", self._path, error.strerror or error)


def _open_without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # Windows has neither the flag nor pipes with a path.


def _check_renamable(path: str | os.PathLike[str]) -> None:
    """Raise PermissionError if the folder does not allow renaming the file."""
    if not os.access(os.path.dirname(os.path.abspath(path)), os.W_OK):
        raise PermissionError(errno.EACCES, "the file exists and cannot be renamed: its folder is not writable")


def keep_existing(path: str | os.PathLike[str]) -> str | None:
    """Rename ``flight.tlog`` to ``flight.1.tlog``, or to the next free number. Return the new name.

    Never replaces a file, even if several programs do this at the same time. Returns None if the file does not exist
    any more. Raises OSError if it cannot be renamed.
    """
    path = os.fspath(path)
    stem, suffix = os.path.splitext(path)
    for number in itertools.count(1):
        kept = f"{stem}.{number}{suffix}"
        try:
            os.close(os.open(kept, os.O_CREAT | os.O_EXCL | os.O_WRONLY))  # Creating the file claims the name.
        except FileExistsError:
            continue
        try:
            os.replace(path, kept)
        except OSError as error:
            os.unlink(kept)
            if isinstance(error, FileNotFoundError):
                return None
            raise
        return kept
    raise AssertionError("unreachable")


_ObserverT = TypeVar("_ObserverT")


class FrameObservers:
    """Holds the callbacks for received frames and those for sent frames, and the recording of both, if there is one.

    ``on_change()`` is called when :attr:`want_all` may have changed.
    """

    def __init__(self, on_change: Callable[[], object]) -> None:
        self._on_change = on_change
        self._send_callbacks: tuple[SentFrameObserver, ...] = ()
        self.receive_callbacks: tuple[FrameObserver, ...] = ()
        """Called with each received frame."""
        self.recording: Recording | None = None

    @property
    def want_all(self) -> bool:
        """True if a `Frame` must be created for every received message."""
        return self.recording is not None or bool(self.receive_callbacks)

    def add(self, callback: FrameObserver) -> Detach:
        self.receive_callbacks = (*self.receive_callbacks, callback)
        self._on_change()

        def detach() -> None:
            self.receive_callbacks = _without(self.receive_callbacks, callback)
            self._on_change()

        return once(detach)

    def add_sent(self, callback: SentFrameObserver) -> Detach:
        self._send_callbacks = (*self._send_callbacks, callback)

        def detach() -> None:
            self._send_callbacks = _without(self._send_callbacks, callback)

        return once(detach)

    def notify_received(self, frame: Frame, peer: Peer) -> None:
        for observer in self.receive_callbacks:
            try:
                observer(frame, peer)
            except Exception:
                logger.exception("frame observer %r raised an exception; the others are still called", observer)

    def notify_sent(self, raw: bytes) -> None:
        for observer in self._send_callbacks:
            try:
                observer(raw)
            except Exception:
                logger.exception("frame observer %r raised an exception; the frame was sent", observer)

    def record(self, path: str | os.PathLike[str], now: float) -> None:
        if self.recording is not None:
            raise BusyError("this connection is already being recorded")
        self.recording = Recording(path, now)
        self._on_change()

    def record_received(self, raw: bytes, at: float) -> None:
        if self.recording is not None:
            self.recording.write(raw, at)

    def record_sent(self, raw: bytes, at: float) -> None:
        if self.recording is not None:
            self.recording.write_sent(raw, at)

    def flush(self) -> None:
        if self.recording is not None:
            self.recording.flush()

    def close(self) -> None:
        if self.recording is not None:
            self.recording.close()
            self.recording = None


def _without(observers: tuple[_ObserverT, ...], callback: _ObserverT) -> tuple[_ObserverT, ...]:
    remaining = list(observers)
    remaining.remove(callback)
    return tuple(remaining)
