"""The other end of a serial cable, for tests: a pseudo-terminal."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Iterator

from link_harness import Recorder

__all__ = ["FarEnd", "far_end"]


class FarEnd:
    """The other end of the cable: the master side of a pseudo-terminal."""

    def __init__(self) -> None:
        self.fd, slave = os.openpty()
        self.device = os.ttyname(slave)
        self._slave: int | None = slave  # held until the link has it: without any holder it hangs up
        os.set_blocking(self.fd, False)
        self.recorder = Recorder()

    def reads(self) -> None:
        asyncio.get_running_loop().add_reader(self.fd, self._read)

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            try:
                self.recorder.bytes_received(os.read(self.fd, 65536), None)
            except OSError:  # hung up
                asyncio.get_running_loop().remove_reader(self.fd)

    async def sends(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self.fd, data) :]
            except BlockingIOError:
                await asyncio.sleep(0)

    def unplug(self) -> None:
        if self._slave is not None:
            with contextlib.suppress(RuntimeError):
                asyncio.get_running_loop().remove_reader(self.fd)
            os.close(self._slave)
            os.close(self.fd)
            self._slave = None


@contextlib.contextmanager
def far_end() -> Iterator[FarEnd]:
    far = FarEnd()
    try:
        yield far
    finally:
        far.unplug()
