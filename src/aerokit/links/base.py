"""What all transports share: opened once, silent after close, lost at most once, errors that help."""

from __future__ import annotations

import asyncio
import enum
import errno
import socket
from abc import abstractmethod

from aerokit.errors import BusyError, ConnectionClosed, LinkError, LinkLost, LinkOpenError

from .link import DrainListener, Link, Peer, Receiver, keeps_peers

__all__ = ["BaseLink", "link_open_error"]


class _State(enum.Enum):
    NEW = "not open"
    OPENING = "being opened"
    OPEN = "open"
    LOST = "lost"
    CLOSED = "closed"


class BaseLink(Link):
    """The life of a link; a transport adds `_connect`, `_release` and `write`."""

    dropped_writes: int

    def __init__(self, address: str) -> None:
        self.address = address
        self.dropped_writes = 0
        self._state = _State.NEW
        self._receiver: Receiver | None = None  # None: no callback is made
        self._keeps_peers = False  # whether the receiver says whom to remember
        self._stalled_at: float | None = None
        self._released = asyncio.Event()
        self._released.set()

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`."""
        self._check_may_open()
        self._state, self._receiver = _State.OPENING, receiver
        self._keeps_peers = keeps_peers(receiver)
        try:
            await self._connect()
        except BaseException as error:
            self._give_up_opening()
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                raise link_open_error(self.address, error) from None
            raise
        if self._is_closed:
            self._release()
            raise ConnectionClosed(f"{self.address} was closed while it was being opened")
        if self._state is _State.OPENING:
            self._state = _State.OPEN

    def close(self) -> None:
        """See `Link.close`."""
        if self._state is not _State.CLOSED:
            self._state, self._receiver = _State.CLOSED, None
            self._release()

    async def wait_closed(self) -> None:
        """See `Link.wait_closed`."""
        await self._released.wait()

    @property
    def _is_closed(self) -> bool:
        return self._state is _State.CLOSED

    @abstractmethod
    async def _connect(self) -> None:
        """Gets the sockets; an OSError becomes a LinkOpenError; `_release` is called after any failure."""

    @abstractmethod
    def _release(self) -> None:
        """Gives the sockets up without blocking; may be called again. Sets `_released` when they are gone."""

    def _deliver(self, data: bytes, peer: Peer = None) -> None:
        if self._receiver is not None:
            self._receiver.bytes_received(data, peer)

    def _drop(self, writes: int) -> None:
        self.dropped_writes += writes

    def _tell_stalled(self, is_stalled: bool) -> None:
        """Some transport of this link does not drain, or all of them do again."""
        if is_stalled == (self._stalled_at is not None):
            return
        now, since = asyncio.get_running_loop().time(), self._stalled_at
        self._stalled_at = now if is_stalled else None
        receiver = self._receiver
        if not isinstance(receiver, DrainListener):
            return
        if since is None:
            receiver.link_stalled(self.unsent_bytes)
        else:
            receiver.link_drained(now - since)

    def _lose(self, reason: str, cause: BaseException | None = None, kind: type[LinkLost] = LinkLost) -> None:
        """The link has gone by itself: says so once and releases what is left of it."""
        receiver, self._receiver = self._receiver, None
        if receiver is None:
            return
        self._state = _State.LOST
        self._release()
        error = kind(f"{self.address}: {reason}")
        error.__cause__ = cause
        receiver.link_lost(error)

    def _check_may_open(self) -> None:
        if self._state is _State.CLOSED:
            raise ConnectionClosed(f"{self.address} was closed; make a new link to open it again")
        if self._state is not _State.NEW:
            raise BusyError(f"{self.address} is {self._state.value}; a link is opened once")

    def _give_up_opening(self) -> None:
        self._receiver = None
        self._release()
        if self._state is not _State.CLOSED:
            self._state = _State.NEW


def link_open_error(address: str, cause: OSError, hint: str = "") -> LinkOpenError:
    """A LinkOpenError with the address, the system's reason and a hint what to do about it."""
    hint = hint or _hint(address, cause)
    reason = cause.strerror or str(cause) or type(cause).__name__
    error = LinkOpenError(f"cannot open {address}: {reason}" + (f" ({hint})" if hint else ""))
    error.errno = cause.errno
    return error


def _hint(address: str, cause: OSError) -> str:
    if isinstance(cause, socket.gaierror):
        return "the host name is not known here; check its spelling or give the IP address"
    if cause.errno == errno.EADDRNOTAVAIL and address.startswith(("udpin", "tcpin")):
        return (
            "this machine has no such address; listen on 0.0.0.0, or reach another machine by udpout: or tcp:"
        )
    if cause.errno == errno.EACCES and address.startswith("udpout"):
        return "to reach a broadcast address write udpbcast:"
    return _HINTS.get(cause.errno or 0, "")


_HINTS = {
    errno.EADDRINUSE: "another program has this port: a ground station, a simulator, an earlier run of yours",
    errno.ECONNREFUSED: "nothing listens there; is the vehicle or simulator running, and is this its port?",
    errno.EHOSTUNREACH: "no route to this host; is the network or radio up?",
    errno.ENETUNREACH: "no route to this network; is the network or radio up?",
    errno.ETIMEDOUT: "the host does not answer; is it on, and does a firewall drop the port?",
    errno.EACCES: "ports below 1024 need the rights of an administrator",
    errno.EAFNOSUPPORT: "this machine has no such address family, for instance no IPv6",
}
