"""Serial ports, by pyserial-asyncio, and pseudo-terminals.

Of pyserial-asyncio only the transport is used. The methods of its port are replaced because of these observed problems:

* Closing calls ``tcdrain`` on the event loop, which blocks the program while flow control stops the port.
* pyserial's ``write`` spins while the device accepts nothing; its ``read`` fails above file descriptor 1023.
* A failed write to an unplugged device is also reported to the loop's exception handler. A failed read is reported only
  after the remaining data has been written.
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

from serial import SerialException

from aerokit.errors import InvalidArgument
from aerokit.transport.address import LinkAddress
from aerokit.transport.link import LINGER_S, BaseLink, Peer, link_open_error
from aerokit.transport.outbox import Outbox
from aerokit.transport.sockets import serial_ports

if sys.platform == "win32":
    _TermiosError = OSError
else:
    from termios import error as _TermiosError  # noqa: N812

_OnFailure = Callable[[OSError], None]

_READ_SIZE = 4096

_LINGER_STEP_S = 0.005

_MAX_BUFFER_S = 2.0  # The write buffer holds as much data as the port sends in this time.


class AddressError(SerialException, InvalidArgument):  # type: ignore[misc]  # pyserial has no types
    """An invalid connection string. It is also a SerialException, which pymavlink raises for it."""


class SerialLink(BaseLink):
    """A serial port, 8N1, opened exclusively. Unplugging the device counts as a lost link.

    ``baud`` is in bits per second. The rate matters for UARTs, not for USB ports such as /dev/ttyACM0. ``rtscts``
    enables hardware flow control. The write buffer holds about two seconds of data (at least 4096 bytes). Data that has
    waited in it for a second is dropped.
    """

    def __init__(self, device: str, baud: int = 57600, *, rtscts: bool = False) -> None:
        options = (("rtscts", "1"),) if rtscts else ()
        super().__init__(str(LinkAddress("serial", device=device, baud=baud, options=options)))
        self._device, self._baud, self._rtscts = device, baud, rtscts
        self._loop: asyncio.AbstractEventLoop | None = None
        self._port: Any = None  # pyserial's port
        self._transport: Any = None  # pyserial-asyncio's transport; None while the link is not open
        self._outbox: Outbox | None = None  # None while the link is not open
        self._is_partly_sent = False  # True while the transport keeps the rest of a write that the driver cut off

    @property
    def unsent_bytes(self) -> int:
        """See `Link.unsent_bytes`; includes the driver's buffer."""
        return 0 if self._outbox is None else self._outbox.unsent_bytes

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. Drops data beyond the write buffer, and data that has waited for a second."""
        if self._outbox is not None and data:
            self._outbox.write(data)

    def discard_unsent(self) -> None:
        """See `Link.discard_unsent`. Also clears the driver's buffer, which may cut off a frame that is being sent."""
        if self._outbox is None or not self._loop or self._loop.is_closed():
            return
        self._outbox.discard()
        bytes_before = self._unsent_bytes_of(self._transport)
        self._transport.flush()  # In pyserial-asyncio, flush() discards the transport's buffer.
        self._is_partly_sent = False
        with contextlib.suppress(Exception):
            self._port.reset_output_buffer()
        discarded_bytes = bytes_before - self._unsent_bytes_of(self._transport)
        self._outbox.record_discarded(discarded_bytes)
        # The number of discarded writes is unknown, so they count as one.
        if discarded_bytes > 0:
            self._count_dropped(1)

    async def _connect(self) -> None:
        # This method contains no await, so that it cannot be cancelled halfway.
        self._loop = asyncio.get_running_loop()
        self._port, self._transport = self._open_port()
        self._released.clear()
        _replace_port_methods(self._port, self._device_failed)
        self._port.write = partial(self._write_in_time, self._port.write)
        bytes_per_s = self._baud / 10  # 8N1 sends a start bit and a stop bit with the eight bits of each byte.
        limit = max(4096, int(bytes_per_s * _MAX_BUFFER_S))
        # The transport must buffer nothing itself: data that the driver does not accept waits in the outbox, where it
        # can be discarded.
        self._transport.set_write_buffer_limits(high=0)
        self._outbox = Outbox(
            send=self._transport.write,
            pending_bytes=partial(self._unsent_bytes_of, self._transport),
            limit=limit,
            on_dropped=self._count_dropped,
            on_stalled=self._report_stalled,
        )

    def _open_port(self) -> tuple[Any, Any]:
        """Return the open port and its transport."""
        try:
            return self._open_device()
        except (OSError, ValueError, OverflowError) as error:
            raise _open_error(self.address, error) from None

    def _open_device(self) -> tuple[Any, Any]:
        """Like `_open_port`. Raises OSError, or ValueError for an unsupported baud rate."""
        serial = importlib.import_module("serial")
        try:
            port = serial.Serial(
                self._device, self._baud, rtscts=self._rtscts, exclusive=True, timeout=0, write_timeout=0
            )
            try:
                transport_class = importlib.import_module("serial_asyncio").SerialTransport
                return port, transport_class(self._loop, _SerialProtocol(self), port)  # configures the port once more
            except BaseException:
                port.close()
                raise
        except _TermiosError as error:
            # pyserial does not convert a termios.error, which occurs if the device vanishes while it is being opened.
            raise serial.SerialException(*error.args) from error

    def _write_in_time(self, write: Callable[[bytes], int], data: bytes) -> int:
        """Replacement of the port's ``write`` that drops data for which the driver had no room in time."""
        # The transport keeps one write until the driver has room. The rest of a frame that was sent in part is always
        # sent, because the receiver would take the next frame for it.
        if self._outbox is not None and not self._is_partly_sent and self._outbox.drop_forwarded_if_late(len(data)):
            return len(data)
        size = write(data)
        self._is_partly_sent = size < len(data)
        return size

    def _device_failed(self, error: OSError) -> None:
        # The loss is reported in a later loop iteration, because `write` must not call the receiver.
        if self._loop is not None and self._transport is not None:
            self._transport.pause_reading()
            self._loop.call_soon(self._lose, f"the device failed: {error.strerror or error}", error)

    def _release(self) -> None:
        transport, self._transport = self._transport, None
        outbox, self._outbox = self._outbox, None
        if transport is None or self._loop is None:
            return
        if outbox is not None:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                outbox.close()
        transport.pause_reading()
        if self._loop.is_running():
            linger_s = LINGER_S if self._is_closed else 0.0  # If the device was lost, nothing can be sent any more.
            self._loop.call_soon(self._close_when_sent, transport, self._loop.time() + linger_s)
        else:
            self._close_port(transport)

    def _close_when_sent(self, transport: Any, deadline: float) -> None:
        assert self._loop is not None
        if self._unsent_bytes_of(transport) and self._loop.time() < deadline:
            self._loop.call_later(_LINGER_STEP_S, self._close_when_sent, transport, deadline)
        else:
            self._close_port(transport)

    def _unsent_bytes_of(self, transport: Any) -> int:
        """Return the number of unsent bytes in the transport and the driver. 0 if the device is gone."""
        with contextlib.suppress(OSError):
            return int(transport.get_write_buffer_size() + self._port.out_waiting)
        return 0

    def _close_port(self, transport: Any) -> None:
        """Close the port without waiting for unsent data."""
        unsent = self._unsent_bytes_of(transport)
        with contextlib.suppress(RuntimeError):  # The loop may be closed.
            # `_release` has already called pause_reading(), but before the transport's first loop iteration that call
            # has no effect.
            transport.pause_reading()
            transport.flush()  # In pyserial-asyncio, flush() discards the transport's buffer.
        if unsent:
            with contextlib.suppress(Exception):
                # Without this call, close() would wait up to 30 s for the unsent data.
                self._port.reset_output_buffer()
        with contextlib.suppress(OSError):  # The device may be gone.
            self._port.close()
        self._released.set()


class _SerialProtocol(asyncio.Protocol):
    """Passes the callbacks of the transport to the link and its outbox."""

    def __init__(self, link: SerialLink) -> None:
        self._link = link

    def data_received(self, data: bytes) -> None:
        self._link._deliver(data)

    def pause_writing(self) -> None:
        if self._link._outbox is not None:
            self._link._outbox.pause()

    def resume_writing(self) -> None:
        # The outbox resumes in a later loop iteration, because the transport calls this method during a write.
        if self._link._outbox is not None and self._link._loop is not None:
            with contextlib.suppress(RuntimeError):  # The loop may be closed.
                self._link._loop.call_soon(self._link._outbox.resume)

    # Errors of read and write do not arrive here: `_replace_port_methods` reports them.
    def connection_lost(self, exc: Exception | None) -> None:
        self._link._lose(f"the device failed: {exc}", exc)


def _replace_port_methods(port: Any, on_failure: _OnFailure) -> None:
    """Replace methods of a port by ones that never block, and that call ``on_failure`` if the device is lost."""
    port.flush = lambda: None
    if os.name == "posix":
        port.read = partial(_read, port.fileno(), on_failure)
        port.write = partial(_write, partial(os.write, port.fileno()), on_failure)
    else:
        port.write = partial(_write, port.write, on_failure)


def _read(fd: int, on_failure: _OnFailure, _size: int) -> bytes:
    """Replacement of pyserial's ``read`` that never blocks."""
    try:
        data = os.read(fd, _READ_SIZE)
    except (BlockingIOError, InterruptedError):
        return b""
    except OSError as error:
        on_failure(error)
        return b""
    if not data:  # The end of the file means that the device is gone.
        on_failure(OSError(errno.ENODEV, "unplugged"))
    return data


def _write(write: Callable[[bytes], int], on_failure: _OnFailure, data: bytes) -> int:
    """Replacement of pyserial's ``write`` that reports a lost device."""
    try:
        return write(data)
    except (BlockingIOError, InterruptedError):
        raise  # The transport itself retries a write that would block.
    except OSError as error:
        on_failure(error)
        return len(data)  # The data counts as written, because the link is closed soon and a retry is useless.


def _open_error(address: str, error: Exception) -> OSError:
    number = error.errno if isinstance(error, OSError) else None
    # pyserial puts an error of termios into its text: "Could not configure port: (25, 'Inappropriate ioctl …')".
    if number is None and f"({errno.ENOTTY}, " in str(error):
        number = errno.ENOTTY
    cause = OSError(number, os.strerror(number)) if number else OSError(str(error))
    is_missing = number in (errno.ENOENT, errno.ENXIO, errno.ENODEV)
    return link_open_error(address, cause, _available_ports() if is_missing else _HINTS.get(number or 0, ""))


def _available_ports() -> str:
    names = ", ".join(port.device for port in serial_ports())
    return f"available serial ports: {names}" if names else "no serial port was found; is the device plugged in?"


_HINTS = {
    errno.EACCES: "on Linux: sudo usermod -a -G dialout $USER, then log in again",
    errno.EPERM: "on Linux: sudo usermod -a -G dialout $USER, then log in again",
    errno.EAGAIN: "another program uses this port",
    errno.EBUSY: "another program uses this port",
    errno.ENOTTY: "this is not a serial port; use replay:PATH to replay a recording",
    errno.EISDIR: "this is a directory",
}


class PtyLink(BaseLink):
    """One end of a pseudo-terminal. Another program opens the other end; `address` has its name once the link is open.

    ``path`` is the name of a symbolic link to the other end, which is removed when this link is closed. A dangling
    symbolic link of that name is replaced; for any other file, `open` raises LinkOpenError. Baud rates have no effect.
    Programs may open and close the other end repeatedly. Unread data stays in the kernel's buffer for the next program;
    further data is dropped while the buffer is full. Not available on Windows.
    """

    def __init__(self, path: str = "") -> None:
        super().__init__(f"pty:{path}" if path else "pty")
        self._path = path
        self._our_end = self._other_end = -1  # file descriptors; −1 while the link is not open
        self._loop: asyncio.AbstractEventLoop | None = None
        self._has_symlink = False  # True while `_path` is a symbolic link that this link has made

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. Data that does not fit into the kernel's buffer is dropped."""
        if self._our_end < 0 or not data:
            return
        try:
            written = os.write(self._our_end, data)
        except OSError:
            written = 0
        if written < len(data):
            self._count_dropped(1)

    async def _connect(self) -> None:
        if sys.platform == "win32":
            raise OSError(errno.ENOSYS, "Windows has no pseudo-terminals")
        import tty

        self._loop = asyncio.get_running_loop()
        # The other end is kept open here, because reading our end fails while no process has the other end open.
        self._our_end, self._other_end = os.openpty()
        tty.setraw(self._other_end)
        os.set_blocking(self._our_end, False)
        name = os.ttyname(self._other_end)
        if self._path:
            self._make_symlink(name)
        self.address: str = f"pty:{self._path or name}"
        self._released.clear()
        self._loop.add_reader(self._our_end, self._read)

    def _make_symlink(self, target: str) -> None:
        """Make the symbolic link. Raises OSError if a file exists at its path."""
        # A symbolic link without a target is left over, e.g. from a killed program.
        if os.path.islink(self._path) and not os.path.exists(self._path):
            os.unlink(self._path)
        os.symlink(target, self._path)
        self._has_symlink = True

    def _read(self) -> None:
        try:
            data = os.read(self._our_end, _READ_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(f"the pseudo-terminal failed: {error.strerror or error}", error)
            return
        self._deliver(data)

    def _release(self) -> None:
        if self._our_end >= 0:
            if self._loop is not None and not self._loop.is_closed():
                self._loop.remove_reader(self._our_end)
            os.close(self._our_end)
            os.close(self._other_end)
            self._our_end = self._other_end = -1
        if self._has_symlink:
            self._has_symlink = False
            with contextlib.suppress(OSError):
                os.unlink(self._path)
        self._released.set()
