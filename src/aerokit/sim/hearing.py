"""What the bytes on one link say, read once for all vehicles that share it."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING

from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.framer import Framer

if TYPE_CHECKING:
    from collections.abc import Container

    from aerokit.mavlink.message import Message

__all__ = ["MOST_PEERS", "Hearing", "SharedHearing"]

MOST_PEERS = 256


class Hearing:
    """Frames of any number of peers, each with a framer of its own; ``wanted`` are ids of messages, None is all."""

    def __init__(self, wanted: Container[int] | None) -> None:
        self._wanted = wanted
        self._framers: dict[Hashable, Framer] = {}

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        """What is complete with these bytes, each with its ``received_frame``."""
        framer = self._framers.get(peer)
        if framer is None:
            if len(self._framers) >= MOST_PEERS:
                del self._framers[next(iter(self._framers))]
            framer = self._framers[peer] = Framer()
            framer.wanted = self._wanted
        decode = STANDARD.decode
        return [decode(frame) for frame in framer.receive(data, now)]


class SharedHearing(Hearing):
    """Of several vehicles: what the first of them asks for is kept for the others, until `forget`."""

    def __init__(self) -> None:
        super().__init__(None)
        self._read: list[Message] | None = None

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        """See `Hearing`."""
        if self._read is None:
            self._read = super().messages(data, now, peer)
        return self._read

    def forget(self) -> None:
        """Everybody has heard it."""
        self._read = None
