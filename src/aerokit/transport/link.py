"""The contract of every link: bytes in by callback, bytes out without waiting."""

from __future__ import annotations

import asyncio
import enum
import errno
import socket
from abc import ABC, abstractmethod
from collections.abc import Hashable
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from aerokit.errors import BusyError, ConnectionClosed, LinkError, LinkLost, LinkOpenError

Peer = Hashable
"""Who sent the bytes, to be handed back to `Link.write`; None where there is only one. Opaque."""


class Receiver(Protocol):
    """What a link calls, always on the loop it was opened on and never from inside `Link.write`.

    Calls may come before `Link.open` has returned to its caller, and none comes after `Link.close`. They must
    not raise: what they raise goes to the loop's exception handler, and a stream link may end by it.
    """

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Bytes came in: a datagram, or any piece of a stream."""

    def link_lost(self, error: LinkLost) -> None:
        """The link has gone by itself; called at most once, and the last call there is."""


@runtime_checkable
class DrainListener(Receiver, Protocol):
    """A receiver that wants to be told when a link takes bytes and does not get rid of them."""

    def link_stalled(self, unsent_bytes: int) -> None:
        """Nothing has left for a second although something waits; orders among it may arrive late, or never."""

    def link_drained(self, stalled_s: float) -> None:
        """It goes on, after so many seconds."""


@runtime_checkable
class HelmListener(Receiver, Protocol):
    """A receiver that wants to be told when the other side of a network refuses an order (docs/network.md)."""

    def order_refused(self, message: str, reason: str, helm: str | None, answers: tuple[bytes, ...]) -> None:
        """A message of this name did not go to the vehicle; ``helm`` is who orders it, if that is why.

        ``answers`` are frames such as the vehicle would refuse it by, for whoever waits for them; not of every message.
        """


@runtime_checkable
class PeerKeeper(Receiver, Protocol):
    """A receiver that says by `Link.keep_peer` whom to remember: who sends nothing but noise holds no place.

    A link around another one passes `Link.keep_peer`, `Link.forget_peer` and `Link.host_of` on to it.
    """

    keeps_peers: bool
    """Whether it does: the link then writes to nobody else, and forgets nobody by itself."""


@runtime_checkable
class BurstListener(Receiver, Protocol):
    """A receiver that gathers what comes in one go, and wants to be told that this is all for now.

    Called by links whose `Link.tells_bursts` is True, after one or several ``bytes_received``.
    """

    def burst_ended(self) -> None:
        """Nothing more comes before the loop has turned."""


@runtime_checkable
class PeerListener(Receiver, Protocol):
    """A receiver that wants to be told of peers that come and go by themselves: the clients of a TCP server.

    They are there before they have said anything, and some never do.
    """

    def peer_joined(self, peer: Peer) -> None:
        """A peer can be written to."""

    def peer_left(self, peer: Peer) -> None:
        """It cannot any more."""


def keeps_peers(receiver: Receiver) -> bool:
    """Whether a receiver says whom to remember."""
    return isinstance(receiver, PeerKeeper) and receiver.keeps_peers


class Link(ABC):
    """Moves bytes between this program and one or several peers; knows nothing of what they mean.

    A link belongs to the event loop it was opened on and is opened once; when `open` has failed or was
    cancelled it may be tried again.
    """

    address: str
    """What to call it: mostly a form that `create_link` takes; a listening port 0 becomes the real one."""

    dropped_writes: int = 0
    """Writes (datagrams, whole calls of `write`) that were thrown away: no room in time, no route, nobody there."""

    is_several: bool = False
    """Whether it is several links to the same vehicles (`SeveralLinks`), with a way for each peer over each of them."""

    @abstractmethod
    async def open(self, receiver: Receiver) -> None:
        """Opens the link; from now on the receiver is called.

        Raises LinkOpenError with the address, the system's reason and a hint (its ``__context__`` is the system's
        error: ConnectionRefusedError, socket.gaierror, serial.SerialException, …), BusyError when it is open
        already, and ConnectionClosed after `close`. A cancelled or failed `open` leaves nothing behind.
        """

    @abstractmethod
    def write(self, data: bytes, peer: Peer = None) -> None:
        """Sends bytes to one peer, or to every known one (None).

        Never blocks and never raises: what cannot be sent is dropped whole and counted in `dropped_writes`;
        before `open` and after the end it does nothing.
        """

    @property
    def tells_bursts(self) -> bool:
        """Whether a `BurstListener` is told, now that the link is open."""
        return False

    @property
    def unsent_bytes(self) -> int:
        """Bytes that `write` took and that have not left: an order among them may still arrive.

        What waits in the link, in its transport, and, where it can be asked (Linux), in the system. 0 does not say
        that the other side has read them.
        """
        return 0

    def unsent_bytes_to(self, peer: Peer) -> int:
        """The same of one peer; all of them together where the link does not tell them apart."""
        return self.unsent_bytes

    def discard_unsent(self) -> None:
        """Take back what has not left, as far as that is possible, and count it in `dropped_writes`.

        What the system has of a TCP connection is beyond recall, and stays in `unsent_bytes`.
        """
        return

    def keep_peer(self, peer: Peer) -> None:
        """A peer has shown that it is one: remember it, and write to it, until `forget_peer` (see `PeerKeeper`)."""
        return

    def forget_peer(self, peer: Peer) -> None:
        """A peer is not written to any more."""
        return

    def host_of(self, peer: Peer) -> object:
        """What stays the same when a peer changes its port: its IP address. Of other links the peer itself."""
        return peer[0] if isinstance(peer, tuple) else peer

    def has_peer(self, peer: Peer) -> bool:
        """Whether a peer that was heard could still be written to: not a client that has gone."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Closes the link: at once to the eye, no callback comes any more. Never blocks, idempotent.

        What was written is still handed to the system, for up to `LINGER_S` seconds.
        """

    @abstractmethod
    async def wait_closed(self) -> None:
        """Returns when nothing of a closed or lost link is left; at most about `LINGER_S` seconds later."""


LINGER_S = 1.0
"""Seconds that a closed link may spend on sending what was written before."""


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


def needed(address: str, module: str, package: str, extra: str) -> Any:
    """Import it; LinkOpenError with what to install when it is not there."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise LinkOpenError(
            f"cannot open {address}: this needs {package}, which is not installed:"
            f" pip install 'aerokit-mavlink[{extra}]'"
        ) from error
