"""A pseudo-terminal: a serial port without a wire, for programs that want the name of one."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import sys

from .base import BaseLink
from .link import Peer

__all__ = ["PtyLink"]

_READ_SIZE = 4096


class PtyLink(BaseLink):
    """This end of a pseudo-terminal; another program opens the other end, whose name `address` says once it is open.

    ``path`` is a symbolic link that is made to the other end, and removed when the link is closed; a dead link of
    that name is replaced, anything else there is a LinkOpenError. Baud rates mean nothing. Programs may open and
    close the other end as often as they like; what nobody reads is dropped. Not on Windows.
    """

    def __init__(self, path: str = "") -> None:
        super().__init__(f"pty:{path}" if path else "pty")
        self._path = path
        self._ends: tuple[int, ...] = ()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._linked = False

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; what does not fit into the system's buffer is dropped."""
        if not self._ends or not data:
            return
        try:
            written = os.write(self._ends[0], data)
        except OSError:
            written = 0
        self._drop(written < len(data))

    async def _connect(self) -> None:
        if sys.platform == "win32":
            raise OSError(errno.ENOSYS, "Windows has no pseudo-terminals")
        import tty

        self._loop = asyncio.get_running_loop()
        ours, theirs = self._ends = (
            os.openpty()
        )  # theirs stays open: else ours fails while nobody has it open
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        name = os.ttyname(theirs)
        if self._path:
            self._link_to(name)
        self.address: str = f"pty:{self._path or name}"
        self._released.clear()
        self._loop.add_reader(ours, self._read)

    def _link_to(self, name: str) -> None:
        if os.path.islink(self._path) and not os.path.exists(self._path):
            os.unlink(self._path)
        os.symlink(name, self._path)
        self._linked = True

    def _read(self) -> None:
        try:
            data = os.read(self._ends[0], _READ_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(f"the pseudo-terminal is gone: {error.strerror or error}", error)
            return
        self._deliver(data)

    def _release(self) -> None:
        ends, self._ends = self._ends, ()
        if self._loop is not None and ends and not self._loop.is_closed():
            self._loop.remove_reader(ends[0])
        for end in ends:
            os.close(end)
        if self._linked:
            self._linked = False
            with contextlib.suppress(OSError):
                os.unlink(self._path)
        self._released.set()
