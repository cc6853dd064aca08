"""UDP links: listen for many peers, connect to one, or broadcast until a peer answers.

Sockets are read in bounded bursts with ``loop.add_reader``, which costs a third of asyncio's datagram transport (one
datagram per loop iteration). asyncio's transport is used on loops without ``add_reader`` (Proactor on Windows).
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from aerokit.transport.address import host_and_port
from aerokit.transport.link import BaseLink, BurstListener, Peer
from aerokit.transport.sockets import (
    AllowedPeers,
    PeerFilter,
    SocketAddress,
    bind_to,
    bound_socket,
    make_readable_check,
    resolve,
)

MAX_BURST_DATAGRAMS = 64
"""Maximum number of datagrams read in one loop iteration, so that other tasks can run."""

MAX_PEERS = 256
"""Maximum number of peers if the receiver is not a `PeerKeeper`. A new peer replaces the peer silent for longest."""

REMOTE_TIMEOUT_S = 3.5
"""A `UdpBroadcast` broadcasts again after this silence of its peer, because the peer's address may have changed."""

_MAX_DATAGRAM_BYTES = 65535
_RECEIVE_BUFFER = 1024 * 1024  # enough for a burst of a log download that arrives while the program is busy
_TRANSIENT_ERRORS = (
    errno.ENETDOWN,
    errno.ENETUNREACH,
    errno.EHOSTDOWN,
    errno.EHOSTUNREACH,
    errno.ENOBUFS,
    errno.EMSGSIZE,
)


class _UdpLink(BaseLink):
    """Common base of UDP links: one socket, which is read in bursts."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        super().__init__(f"{scheme}:{host_and_port(host, port)}")
        self._host, self._port = host, port
        self._loop: asyncio.AbstractEventLoop | None = None  # None before the opening
        self._socket: socket.socket | None = None  # None while the link is not open
        self._transport: asyncio.DatagramTransport | None = None  # used only on loops without add_reader
        self._transport_owns_socket = False  # True if asyncio reads and closes the socket
        self._has_more: Callable[[], object] = lambda: False  # returns a true value if a datagram can be read
        self._burst_listener: BurstListener | None = None  # the receiver, if it is a BurstListener

    @property
    def local_address(self) -> tuple[str, int]:
        """Host and port of the bound socket; ("", 0) while the link is not open."""
        return self._socket.getsockname()[:2] if self._socket is not None else ("", 0)

    @abstractmethod
    async def _make_socket(self) -> socket.socket: ...

    @abstractmethod
    def _datagram_received(self, data: bytes, source: Any) -> None: ...

    async def _connect(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._transport_owns_socket = False
        self._burst_listener = self._receiver if isinstance(self._receiver, BurstListener) else None
        self._socket = sock = await self._make_socket()
        self._has_more = make_readable_check(sock)
        _enlarge_buffer(sock)
        try:
            self._loop.add_reader(sock, self._on_readable)
        except NotImplementedError:  # The loop has no add_reader, e.g. the Proactor loop on Windows.
            await self._connect_without_reader(sock)

    async def _connect_without_reader(self, sock: socket.socket) -> None:
        assert self._loop is not None
        self._transport_owns_socket = True
        self._released.clear()
        try:
            await self._loop.create_datagram_endpoint(lambda: _DatagramProtocol(self), sock=sock)
        except BaseException:
            self._released.set()  # asyncio closes the socket in the next iteration of the loop.
            raise

    def _transport_opened(self, transport: asyncio.DatagramTransport) -> None:
        self._transport = transport
        if self._socket is None:  # The link was closed while the endpoint was being created.
            self._release()

    def _transport_closed(self, error: Exception | None) -> None:
        self._transport = None
        self._released.set()
        self._lose(f"the socket failed: {error}" if error else "the socket was closed", error)

    def _release(self) -> None:
        sock, self._socket = self._socket, None
        transport, self._transport = self._transport, None
        loop = None if self._loop is None or self._loop.is_closed() else self._loop
        if transport is not None and loop is not None:
            transport.abort()  # asyncio calls `_transport_closed` in the next loop iteration.
        if sock is not None and not self._transport_owns_socket:
            if loop is not None:
                loop.remove_reader(sock)
            sock.close()

    @property
    def reports_bursts(self) -> bool:
        return self._socket is not None and not self._transport_owns_socket

    def _on_readable(self) -> None:
        self._read_burst()
        if self._burst_listener is not None and self._receiver is not None:
            self._burst_listener.burst_ended()

    def _read_burst(self) -> None:
        for _ in range(MAX_BURST_DATAGRAMS):
            if self._socket is None:  # The receiver has closed the link in its callback.
                return
            try:
                data, source = self._socket.recvfrom(_MAX_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._receive_failed(error)
            else:
                self._datagram_received(data, source)
            if not self._has_more():
                return

    def _receive_failed(self, error: OSError) -> None:
        # A UDP link continues after errors that may pass, e.g. a closed port at the other end, or a missing network.
        if not isinstance(error, ConnectionError) and error.errno not in _TRANSIENT_ERRORS:
            self._lose(f"the socket failed: {error.strerror or error}", error)

    def _send(self, data: bytes, address: Any) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(data, address)
        except OSError:
            self._count_dropped(1)


class UdpListen(_UdpLink):
    """``udpin:`` link: binds a port. Each sender becomes a peer. Data that is written without a peer goes to all peers.

    With port 0, the system chooses a port. `address` and `local_address` have this port once the link is open.
    ``peers`` are the IP addresses and networks to accept; None: all.
    """

    def __init__(self, host: str, port: int, *, peers: PeerFilter | None = None) -> None:
        super().__init__("udpin", host, port)
        self._allowed = AllowedPeers(peers)
        self._peers: dict[Peer, None] = {}  # ordered, the most recent peer last
        self._last_source: Peer = None  # sender of the last accepted datagram

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Remembered peers, newest first.

        They are ordered by their last datagrams or, if the receiver is a `PeerKeeper`, by the time they were added.
        """
        return tuple(reversed(self._peers))

    def write(self, data: bytes, peer: Peer = None) -> None:
        if peer is None:  # If there is no peer yet, nothing counts as dropped.
            for known_peer in self._peers:
                self._send(data, known_peer)
        elif peer in self._peers:
            self._send(data, peer)
        else:
            self._count_dropped(1)

    def keep_peer(self, peer: Peer) -> None:
        self._peers[peer] = None

    def forget_peer(self, peer: Peer) -> None:
        self._peers.pop(peer, None)

    def has_peer(self, peer: Peer) -> bool:
        return peer in self._peers

    async def _make_socket(self) -> socket.socket:
        sock = await bound_socket(self._host, self._port, socket.SOCK_DGRAM)
        self.address: str = f"udpin:{host_and_port(self._host, sock.getsockname()[1])}"
        return sock

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source != self._last_source:  # Consecutive datagrams of one sender are checked once, to save time.
            host, *_ = source
            if source not in self._peers and not self._allowed.allows(host):
                return
            self._last_source = source
            if not self._keeps_peers:
                self._remember(source)
        self._deliver(data, source)

    def _remember(self, source: Peer) -> None:
        self._peers.pop(source, None)
        if len(self._peers) >= MAX_PEERS:
            del self._peers[next(iter(self._peers))]
        self._peers[source] = None


class UdpConnect(_UdpLink):
    """``udpout:`` link: sends to one remote address, and receives only from that host and port.

    The socket is not connected. uvloop would stop reading a connected socket at the first "connection refused", which
    only means that the vehicle has not started yet.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__("udpout", host, port)
        self._remote: Any = None  # address of the other end, resolved when the link opens

    def write(self, data: bytes, peer: Peer = None) -> None:
        self._send(data, self._remote)

    async def _make_socket(self) -> socket.socket:
        remote, *_ = await resolve(self._host, self._port, socket.SOCK_DGRAM)
        self._remote = _source_address(remote)
        return bind_to(SocketAddress(remote.family, ("", 0)), socket.SOCK_DGRAM)

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source == self._remote:
            self._deliver(data)


class UdpBroadcast(_UdpLink):
    """``udpbcast:`` link (IPv4): broadcasts until a peer answers, then uses that peer only.

    After 3.5 s of silence it broadcasts again, and accepts another peer. Another port of the same host is accepted at
    once if the receiver is a `PeerKeeper`. Data for one peer is never broadcast. ``peers`` are the IP addresses and
    networks to accept; None: all.
    """

    _received_at: float  # time of the last datagram from `_remote`; set together with `_remote`

    def __init__(self, host: str, port: int, *, peers: PeerFilter | None = None) -> None:
        super().__init__("udpbcast", host, port)
        self._allowed = AllowedPeers(peers)
        self._broadcast_address: Any = None  # resolved when the link opens
        self._remote: Any = None  # the peer that answered

    def write(self, data: bytes, peer: Peer = None) -> None:
        if peer is None:
            peer = self._broadcast_address if self._is_remote_silent() else self._remote
        self._send(data, peer)

    def keep_peer(self, peer: Peer) -> None:
        self._remote, self._received_at = peer, self._now()

    def _now(self) -> float:
        return 0.0 if self._loop is None else self._loop.time()

    def _is_remote_silent(self) -> bool:
        return self._remote is None or self._now() - self._received_at > REMOTE_TIMEOUT_S

    async def _make_socket(self) -> socket.socket:
        remote, *_ = await resolve(self._host, self._port, socket.SOCK_DGRAM)
        self._broadcast_address, self._remote = remote.address, None
        sock = bind_to(SocketAddress(socket.AF_INET, ("", 0)), socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return sock

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source == self._remote:
            self._received_at = self._now()
        elif not self._is_accepted(source):
            return
        elif not self._keeps_peers:
            # The receiver does not choose peers, so this link does: `write` sends to this peer instead of broadcasting.
            self.keep_peer(source)
        # Without a `PeerKeeper`, this link has only one remote end, so the peer is None.
        self._deliver(data, source if self._keeps_peers else None)

    def _is_accepted(self, source: Any) -> bool:
        """Return True if datagrams from ``source``, which is not the present peer, may be delivered."""
        host, *_ = source
        # If a `PeerKeeper` checks the frames, another port of the same host is accepted without a silence of `_remote`.
        is_same_host = self._keeps_peers and self._remote is not None and self.host_of(self._remote) == host
        return (is_same_host or self._is_remote_silent()) and self._allowed.allows(host)


class _DatagramProtocol(asyncio.DatagramProtocol):
    """asyncio protocol that receives datagrams on loops without ``add_reader``."""

    def __init__(self, link: _UdpLink) -> None:
        self._link = link

    # The type of `transport` is Any, because the transports of some loops do not inherit from DatagramTransport.
    def connection_made(self, transport: Any) -> None:
        self._link._transport_opened(transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._link._socket is not None:
            self._link._datagram_received(data, addr)

    def error_received(self, exc: Exception) -> None:
        if isinstance(exc, OSError):
            self._link._receive_failed(exc)

    def connection_lost(self, exc: Exception | None) -> None:
        self._link._transport_closed(exc)


def _source_address(remote: SocketAddress) -> Any:
    """Return the address from which ``remote`` sends datagrams. Raises OSError if there is no route."""
    # 0.0.0.0 means this host, which sends from another address.
    with socket.socket(remote.family, socket.SOCK_DGRAM) as probe:
        probe.connect(remote.address)
        return probe.getpeername()


def _enlarge_buffer(sock: socket.socket) -> None:
    with contextlib.suppress(OSError):
        if sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < _RECEIVE_BUFFER:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
