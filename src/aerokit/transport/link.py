"""``Link``: the interface of all links, with receive callbacks and non-blocking writes; base class and memory link."""

from __future__ import annotations

import asyncio
import enum
import errno
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Hashable
from importlib import import_module
from typing import Any, NamedTuple, Protocol, runtime_checkable

from aerokit.errors import BusyError, ConnectionClosed, LinkError, LinkLost, LinkOpenError

Peer = Hashable
"""Opaque identifier of a remote end, to be passed to `Link.write`; None for links with a single remote end."""


class Receiver(Protocol):
    """Callbacks of a link. They run on the loop that opened the link, and never inside `Link.write`.

    Callbacks may run before `Link.open` returns; none runs after `Link.close`. They must not raise: an exception goes
    to the loop's exception handler and may end a stream link.
    """

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Process a datagram, or any part of a stream."""

    def link_lost(self, error: LinkLost) -> None:
        """Called when the link is lost, at most once and as the last callback."""


@runtime_checkable
class DrainListener(Receiver, Protocol):
    """A receiver that is notified when written data stays in this machine's buffers."""

    def link_stalled(self, unsent_bytes: int) -> None:
        """Called when unsent data has waited for a second without progress. Commands in it may be late or lost."""

    def link_drained(self, stalled_s: float) -> None:
        """Called when unsent data is sent at last, ``stalled_s`` seconds after `link_stalled`."""


@runtime_checkable
class OrderRefusalListener(Receiver, Protocol):
    """A receiver that is notified when the other end of a zenoh network refuses a command (docs/network.md)."""

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        """Called when the other end did not forward a message to the vehicle.

        ``message`` is the name of the message. ``lease_holder`` is the client that has control, if this is why the
        message was refused. ``answers`` are the frames by which a vehicle would reject the command; they may be empty.
        """


@runtime_checkable
class PeerKeeper(Receiver, Protocol):
    """A receiver that calls `Link.keep_peer` for each peer that the link must remember, so that noise adds no peers.

    A link that wraps another link forwards `Link.keep_peer`, `Link.forget_peer` and `Link.host_of`.
    """

    keeps_peers: bool
    """True if the receiver chooses the peers that the link remembers. If False, the link chooses them itself."""


@runtime_checkable
class BurstListener(Receiver, Protocol):
    """A receiver that processes datagrams together if a link has read them at once (see `Link.reports_bursts`)."""

    def burst_ended(self) -> None:
        """Called after the last ``bytes_received`` of datagrams that were read at once."""


@runtime_checkable
class PeerListener(Receiver, Protocol):
    """A receiver that is notified of connecting and disconnecting peers, i.e. the clients of a TCP server."""

    def peer_joined(self, peer: Peer) -> None:
        """Called when a peer has connected, even if the peer never sends anything."""

    def peer_left(self, peer: Peer) -> None:
        """Called when a peer has disconnected."""


def keeps_peers(receiver: Receiver) -> bool:
    """Return True if the receiver, and not the link, chooses the peers to remember."""
    return isinstance(receiver, PeerKeeper) and receiver.keeps_peers


class Link(ABC):
    """Transports bytes between this program and one or more peers.

    A link belongs to the event loop it was opened on, and can be opened once. `open` may be repeated if it failed or
    was cancelled.
    """

    address: str
    """Name of the link, usually in a form that `create_link` accepts, with the actual port instead of 0."""

    dropped_writes: int = 0
    """Number of writes dropped because of a full buffer, a long wait, a missing route or a missing peer."""

    is_multilink: bool = False
    """True for `MultiLink`, which joins several links to the same vehicles."""

    @abstractmethod
    async def open(self, receiver: Receiver) -> None:
        """Open the link and start calling the receiver. If it fails or is cancelled, all resources are released.

        Raises:
            LinkOpenError: the text has the address, the system's reason and a hint; ``__context__`` is the system's
                error (ConnectionRefusedError, socket.gaierror, serial.SerialException, …).
            BusyError: the link is open.
            ConnectionClosed: the link was closed.
        """

    @abstractmethod
    def write(self, data: bytes, peer: Peer = None) -> None:
        """Send bytes to one peer, or to all known peers (None).

        Never blocks or raises. Data that cannot be sent is dropped as a whole and counted in `dropped_writes`. Does
        nothing while the link is not open.
        """

    @property
    def reports_bursts(self) -> bool:
        """True if the open link calls `BurstListener.burst_ended`."""
        return False

    @property
    def unsent_bytes(self) -> int:
        """Written bytes that have not left this machine: in the link, in its transport and, on Linux, in the kernel.

        Commands in these bytes may still arrive. 0 does not mean that the other end has received everything.
        """
        return 0

    def unsent_bytes_to(self, peer: Peer) -> int:
        """Return the number of unsent bytes for one peer, or for all peers if the link does not count per peer."""
        return self.unsent_bytes

    def discard_unsent(self) -> None:
        """Discard written data that has not left this machine, and count it in `dropped_writes`.

        Data in the kernel's TCP buffer cannot be discarded; it stays in `unsent_bytes`.
        """
        return

    def keep_peer(self, peer: Peer) -> None:
        """Remember a peer until `forget_peer`, so that `write` can send to it; see `PeerKeeper`."""
        return

    def forget_peer(self, peer: Peer) -> None:
        """Stop writing to a peer."""
        return

    def host_of(self, peer: Peer) -> object:
        """Return an identifier of the peer's host: the IP address, or the peer itself if there is none."""
        return peer[0] if isinstance(peer, tuple) else peer

    def has_peer(self, peer: Peer) -> bool:
        """Return False if the peer has disconnected."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Close the link. No callback runs afterwards. Never blocks; idempotent.

        Data already written is still sent in the background, for up to `LINGER_S` seconds.
        """

    @abstractmethod
    async def wait_closed(self) -> None:
        """Wait until a closed or lost link has released all resources, at most about `LINGER_S` seconds."""


LINGER_S = 1.0
"""Seconds for which a closed link may continue to send data written before."""


class _State(enum.Enum):
    NEW = "not open"
    OPENING = "being opened"
    OPEN = "open"
    LOST = "lost"
    CLOSED = "closed"


class BaseLink(Link):
    """Base class of links, with their state machine. Subclasses implement `_connect`, `_release` and `write`."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.dropped_writes: int = 0
        self._state = _State.NEW
        self._receiver: Receiver | None = None  # None before the link is opened and after it has ended
        self._keeps_peers = False  # True if the receiver decides which peers are remembered; see `PeerKeeper`
        self._stalled_at: float | None = None  # time at which the link stalled; None while it is not stalled
        self._released = asyncio.Event()  # set while no socket is open
        self._released.set()

    async def open(self, receiver: Receiver) -> None:
        """See `Link.open`. After a failure, the link can be opened again."""
        self._check_may_open()
        self._state, self._receiver = _State.OPENING, receiver
        self._keeps_peers = keeps_peers(receiver)
        try:
            await self._connect()
        except BaseException as error:
            self._abort_opening()
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                raise link_open_error(self.address, error) from None
            raise
        if self._is_closed:
            self._release()
            raise ConnectionClosed(f"{self.address} was closed while it was being opened")
        if self._state is _State.OPENING:  # In any other state, the link was lost while it was being opened.
            self._state = _State.OPEN

    def close(self) -> None:
        if self._state is not _State.CLOSED:
            self._state, self._receiver = _State.CLOSED, None
            self._release()

    async def wait_closed(self) -> None:
        await self._released.wait()

    @property
    def _is_closed(self) -> bool:
        return self._state is _State.CLOSED

    @abstractmethod
    async def _connect(self) -> None:
        """Open sockets. `open` raises an OSError as LinkOpenError, and calls `_release` after any failure."""

    @abstractmethod
    def _release(self) -> None:
        """Close sockets without blocking, and set `_released` when they are closed. May be called repeatedly."""

    def _deliver(self, data: bytes, peer: Peer = None) -> None:
        if self._receiver is not None:
            self._receiver.bytes_received(data, peer)

    def _count_dropped(self, writes: int) -> None:
        self.dropped_writes += writes

    def _report_stalled(self, is_stalled: bool) -> None:
        stalled_at, now = self._stalled_at, asyncio.get_running_loop().time()
        listener = self._receiver if isinstance(self._receiver, DrainListener) else None
        if is_stalled and stalled_at is None:
            self._stalled_at = now
            if listener is not None:
                listener.link_stalled(self.unsent_bytes)
        elif not is_stalled and stalled_at is not None:
            self._stalled_at = None
            if listener is not None:
                listener.link_drained(now - stalled_at)

    def _lose(self, reason: str, cause: BaseException | None = None, kind: type[LinkLost] = LinkLost) -> None:
        """Release the link and report its loss to the receiver, once."""
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
            raise BusyError(f"{self.address} is {self._state.value}; a link can be opened only once")

    def _abort_opening(self) -> None:
        self._receiver = None
        self._release()
        if self._state is not _State.CLOSED:
            self._state = _State.NEW


def link_open_error(address: str, cause: OSError, hint: str = "") -> LinkOpenError:
    hint = hint or _hint(address, cause)
    reason = cause.strerror or str(cause) or type(cause).__name__
    error = LinkOpenError(f"cannot open {address}: {reason}" + (f" ({hint})" if hint else ""))
    error.errno = cause.errno
    return error


def _hint(address: str, cause: OSError) -> str:
    """Return what the user can do about an error of opening a link. Empty if unknown."""
    if isinstance(cause, socket.gaierror):
        return "unknown host name; check the spelling or use the IP address"
    if cause.errno == errno.EADDRNOTAVAIL and address.startswith(("udpin", "tcpin")):
        return "this machine does not have this address; listen on 0.0.0.0, or reach another machine by udpout: or tcp:"
    if cause.errno == errno.EACCES and address.startswith("udpout"):
        return "for a broadcast address use udpbcast:"
    return _HINTS.get(cause.errno or 0, "")


_HINTS = {
    errno.EADDRINUSE: "another program uses this port: a ground station, a simulator, an earlier run; stop it, let the"
    " vehicle send to a second port, or share the link by `aerokit hub`",
    errno.ECONNREFUSED: "nothing listens there; is the vehicle or simulator running, and is this its port?",
    errno.EHOSTUNREACH: "no route to this host; is the network or radio up?",
    errno.ENETUNREACH: "no route to this network; is the network or radio up?",
    errno.ETIMEDOUT: "the host does not answer; is it on, and does a firewall drop the port?",
    errno.EACCES: "ports below 1024 need administrator rights",
    errno.EAFNOSUPPORT: "this machine does not support this address family, e.g. IPv6",
}


def import_optional(address: str, module: str, package: str, extra: str) -> Any:
    """Import a module. Raises LinkOpenError with the package to install if it is missing."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise LinkOpenError(
            f"cannot open {address}: this needs {package}, which is not installed:"
            f" pip install 'aerokit-mavlink[{extra}]'"
        ) from error


def memory_link_pair(*, latency_s: float = 0.0) -> tuple[MemoryLink, MemoryLink]:
    """Return two links that are connected to each other. Open both on the same event loop.

    Each write arrives unsplit and in order, ``latency_s`` seconds later, but never before `Link.write` returns. Data
    for an end that is not open is dropped, as with UDP. When one end closes, the other end first receives the data
    written before, and then reports its loss.
    """
    near, far = MemoryLink("memory:near", latency_s), MemoryLink("memory:far", latency_s)
    near._far, far._far = far, near
    return near, far


class _Arrival(NamedTuple):
    due: float
    data: bytes | None  # None means that the far end was closed


class MemoryLink(BaseLink):
    """One end of `memory_link_pair`."""

    def __init__(self, address: str, latency_s: float = 0.0) -> None:
        super().__init__(address)
        self._latency_s = latency_s
        self._far: MemoryLink | None = None  # the other end, set by `memory_link_pair`
        self._loop: asyncio.AbstractEventLoop | None = None  # None while the link is not open
        self._inbox: deque[_Arrival] = deque()
        self._wake_up: asyncio.Handle | None = None  # pending call of `_deliver_due`

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. The far end receives the data in a later loop iteration."""
        if self._receiver is not None and self._far is not None:
            self._far._schedule_arrival(bytes(data), sender=self)

    async def _connect(self) -> None:
        self._loop = asyncio.get_running_loop()

    def _release(self) -> None:
        if self._wake_up is not None:
            self._wake_up.cancel()
        self._wake_up = None
        self._inbox.clear()
        was_open = self._loop is not None
        self._loop = None
        if was_open and self._far is not None:
            # The far end delivers the data written so far, and then reports that the link is lost.
            self._far._schedule_arrival(None, sender=self)

    def _schedule_arrival(self, data: bytes | None, *, sender: MemoryLink) -> None:
        """Schedule the arrival of data. None means that ``sender`` was closed."""
        if self._loop is None or self._receiver is None:
            if data is not None:
                sender.dropped_writes += 1
            return
        self._inbox.append(_Arrival(self._loop.time() + self._latency_s, data))
        if self._wake_up is None:
            self._schedule_wake_up(self._loop)

    def _schedule_wake_up(self, loop: asyncio.AbstractEventLoop) -> None:
        if not loop.is_closed():
            due = self._inbox[0].due
            self._wake_up = (
                loop.call_at(due, self._deliver_due) if self._latency_s else loop.call_soon(self._deliver_due)
            )

    def _deliver_due(self) -> None:
        self._wake_up = None
        if self._loop is None or not self._inbox:
            return
        now = max(self._loop.time(), self._inbox[0].due)  # A timer may fire early by the clock's resolution.
        # Due items are counted before the delivery. Data that the far end writes in response may be due at once, but
        # must arrive in a later iteration of the event loop. The first item is always due.
        due_count = 1 if len(self._inbox) == 1 else sum(arrival.due <= now for arrival in self._inbox)
        for _ in range(due_count):
            if not self._inbox:  # The receiver has closed the link in its callback.
                return
            data = self._inbox.popleft().data
            if data is None:
                self._lose("the other end was closed")
            else:
                self._deliver(data)
        if self._inbox and self._wake_up is None:
            self._schedule_wake_up(self._loop)
