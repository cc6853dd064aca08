"""``MAVWriter``: where programs that build their own MAVLink write to."""

from __future__ import annotations

import queue
from typing import NoReturn

__all__ = ["MAVWriter"]


class MAVWriter:
    """A file-like object whose ``write`` puts bytes into a queue, as programs that build their own MAVLink use it."""

    def __init__(self, queue: queue.Queue[bytes]) -> None:
        self.queue = queue

    def write(self, pkt: bytes) -> None:
        """Put them there."""
        self.queue.put(pkt)

    def read(self) -> NoReturn:
        """Nothing can be read.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError("a MAVWriter is for writing")
