"""Serial ports, by pyserial-asyncio.

It is used for its transport alone, with the port's own calls replaced, because of what was seen:

* It waits in ``tcdrain`` on the loop itself when it closes: a port that is held up blocks everything.
* pyserial's ``write`` spins while the device takes nothing; its ``read`` fails above file descriptor 1023.
* A write to an unplugged device goes to the loop's exception handler too; a read from one is told only when
  what is left to write has gone.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from aerokit.transport.address import LinkAddress
from aerokit.transport.link import LINGER_S, BaseLink, Peer, link_open_error
from aerokit.transport.outbox import Outbox

if sys.platform == "win32":
    _TermiosError = OSError
else:
    from termios import error as _TermiosError  # noqa: N812

_Failed = Callable[[OSError], None]

_READ_SIZE = 4096

_LINGER_STEP_S = 0.005

_SECONDS_HELD_BACK = 2.0  # more would only be stale when it arrives


class SerialLink(BaseLink):
    """A serial port, 8N1, not shared with other programs; unplugging it is a lost link.

    ``baud`` is in bits per second and matters to real UARTs, not to USB ports such as /dev/ttyACM0;
    ``rtscts`` turns hardware flow control on. About two seconds' worth of bytes may wait to be sent, at least
    4096; none waits here for longer than a second.
    """

    def __init__(self, device: str, baud: int = 57600, *, rtscts: bool = False) -> None:
        options = (("rtscts", "1"),) if rtscts else ()
        super().__init__(str(LinkAddress("serial", device=device, baud=baud, options=options)))
        self._device, self._baud, self._rtscts = device, baud, rtscts
        self._loop: asyncio.AbstractEventLoop | None = None
        self._port: Any = None
        self._transport: Any = None
        self._outbox: Outbox | None = None

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; with what waits in the port's driver."""
        return 0 if self._outbox is None else self._outbox.unsent_bytes

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; drops what is more than the line carries in two seconds, or has waited for one."""
        if self._outbox is not None and data:
            self._outbox.write(data)

    def discard_unsent(self) -> None:
        """See `Link.discard_unsent`; the driver's share too, which may cut a frame in two."""
        if self._outbox is None or not self._loop or self._loop.is_closed():
            return
        self._outbox.discard()
        before = self._waiting_to_be_sent(self._transport)
        self._transport.flush()
        with contextlib.suppress(Exception):
            self._port.reset_output_buffer()
        taken = before - self._waiting_to_be_sent(self._transport)
        self._outbox.taken_back(taken)
        self._drop(taken > 0)

    async def _connect(self) -> None:
        """Without an await in it: there is no half-way at which it could be cancelled."""
        self._loop = asyncio.get_running_loop()
        self._port = port = self._open_port()
        self._released.clear()
        self._transport = importlib.import_module("serial_asyncio").SerialTransport(
            self._loop, _SerialProtocol(self), port
        )
        _replace_calls(port, self._device_failed)
        limit = max(4096, int(self._baud / 10 * _SECONDS_HELD_BACK))
        self._transport.set_write_buffer_limits(high=0)  # what the driver does not take waits in the outbox
        self._outbox = Outbox(
            self._transport.write,
            partial(self._waiting_to_be_sent, self._transport),
            limit=limit,
            dropped=self._drop,
            stalled=self._tell_stalled,
        )

    def _open_port(self) -> Any:
        try:
            return self._open_device()
        except (OSError, ValueError, OverflowError) as error:
            raise _open_error(self.address, error) from None

    def _open_device(self) -> Any:
        serial = importlib.import_module("serial")
        try:
            return serial.Serial(
                self._device, self._baud, rtscts=self._rtscts, exclusive=True, timeout=0, write_timeout=0
            )
        except _TermiosError as error:
            # it vanished while it was being opened: pyserial lets this one through
            raise serial.SerialException(*error.args) from error

    def _device_failed(self, error: OSError) -> None:
        """Reading or writing failed; said on a later turn, for it may be inside `write`."""
        if self._loop is not None and self._transport is not None:
            self._transport.pause_reading()
            self._loop.call_soon(self._lose, f"the device is gone: {error.strerror or error}", error)

    def _release(self) -> None:
        transport, self._transport = self._transport, None
        outbox, self._outbox = self._outbox, None
        if transport is None or self._loop is None:
            return
        if outbox is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                outbox.close()
        transport.pause_reading()
        if self._loop.is_running():
            until = self._loop.time() + (LINGER_S if self._is_closed else 0.0)
            self._loop.call_soon(self._finish, transport, until)
        else:
            self._close_port(transport)

    def _finish(self, transport: Any, until: float) -> None:
        """Closes the port when what was written has left the machine, or has had its time."""
        assert self._loop is not None
        if self._waiting_to_be_sent(transport) and self._loop.time() < until:
            self._loop.call_later(_LINGER_STEP_S, self._finish, transport, until)
        else:
            self._close_port(transport)

    def _waiting_to_be_sent(self, transport: Any) -> int:
        with contextlib.suppress(OSError):
            return int(transport.get_write_buffer_size() + self._port.out_waiting)
        return 0

    def _close_port(self, transport: Any) -> None:
        unsent = self._waiting_to_be_sent(transport)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            transport.pause_reading()  # again: before its first turn there was nothing to pause
            transport.flush()
        if unsent:
            with contextlib.suppress(Exception):
                self._port.reset_output_buffer()  # else the system's close waits for it, up to 30 s
        self._port.close()
        self._released.set()


class _SerialProtocol(asyncio.Protocol):
    def __init__(self, link: SerialLink) -> None:
        self._link = link

    def data_received(self, data: bytes) -> None:
        self._link._deliver(data)

    def pause_writing(self) -> None:
        if self._link._outbox is not None:
            self._link._outbox.pause()

    def resume_writing(self) -> None:
        """On a later turn: the transport is in the middle of a write."""
        if self._link._outbox is not None and self._link._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._link._loop.call_soon(self._link._outbox.resume)

    def connection_lost(self, exc: Exception | None) -> None:  # only where the port's own calls are in use
        self._link._lose(f"the device is gone: {exc}", exc)


def _replace_calls(port: Any, failed: _Failed) -> None:
    """Gives a port calls that never wait and report a lost device to ``failed``."""
    port.flush = lambda: None
    if os.name == "posix":
        port.read = partial(_read, port.fileno(), failed)
        port.write = partial(_write, partial(os.write, port.fileno()), failed)
    else:
        port.write = partial(_write, port.write, failed)


def _read(fd: int, failed: _Failed, _size: int) -> bytes:
    try:
        data = os.read(fd, _READ_SIZE)
    except (BlockingIOError, InterruptedError):
        return b""
    except OSError as error:
        failed(error)
        return b""
    if not data:  # ready to be read, and nothing there
        failed(OSError(errno.ENODEV, "unplugged"))
    return data


def _write(write: Callable[[bytes], int], failed: _Failed, data: bytes) -> int:
    try:
        return write(data)
    except (BlockingIOError, InterruptedError):
        raise  # the transport keeps it for later
    except OSError as error:
        failed(error)
        return len(data)


def _open_error(address: str, error: Exception) -> OSError:
    number = error.errno if isinstance(error, OSError) else None
    if number is None and str(errno.ENOTTY) in str(error):
        number = errno.ENOTTY
    cause = OSError(number, os.strerror(number)) if number else OSError(str(error))
    missing = number in (errno.ENOENT, errno.ENXIO, errno.ENODEV)
    return link_open_error(address, cause, _ports_here() if missing else _HINTS.get(number or 0, ""))


def _ports_here() -> str:
    comports = importlib.import_module("serial.tools.list_ports").comports
    names = ", ".join(sorted(port.device for port in comports()))
    return f"serial ports here: {names}" if names else "there is no serial port here; is it plugged in?"


_HINTS = {
    errno.EACCES: "on Linux: sudo usermod -a -G dialout $USER, then log in again",
    errno.EPERM: "on Linux: sudo usermod -a -G dialout $USER, then log in again",
    errno.EAGAIN: "another program uses this port",
    errno.EBUSY: "another program uses this port",
    errno.ENOTTY: "this is no serial port; to replay a recording write replay:PATH",
    errno.EISDIR: "this is a directory",
}


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
