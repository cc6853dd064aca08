"""``Taps``: who sees every frame of a connection: programs that asked for it, and the recording."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, TypeVar

from aerokit.errors import BusyError
from aerokit.runtime.bus import once
from aerokit.runtime.recording import Recording

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.runtime.bus import Detach

    Tap = Callable[[Frame, Peer], object]
    SentTap = Callable[[bytes], object]

__all__ = ["Taps"]

logger: logging.Logger = logging.getLogger("aerokit")

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
