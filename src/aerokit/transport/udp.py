"""UDP: listen for any number of peers, talk to one, or broadcast until somebody answers.

A non-blocking socket is drained in bounded bursts by ``loop.add_reader``, which costs a third of what
stock asyncio's datagram transport does (one datagram per turn of the loop); that one is kept for loops
without ``add_reader`` (Proactor on Windows).
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
from aerokit.transport.sockets import AllowedPeers, Endpoint, Peers, bind_to, bound_socket, has_more, resolve

DATAGRAMS_PER_WAKE_UP = 64
"""So many are read in one go before everybody else on the loop gets a turn."""

MAX_PEERS = 256
"""So many remote peers a listening link remembers; the one not heard from for longest is forgotten first.

A receiver that keeps peers (`PeerKeeper`) says itself who is remembered.
"""

QUIET_AFTER_S = 3.5
"""Who has answered a broadcast and was not heard for so long may have another port, or another address, now."""

_LARGEST_DATAGRAM = 65535
_RECEIVE_BUFFER = 1024 * 1024  # a burst of a log download while the program is busy for a moment
_PASSING = (
    errno.ENETDOWN,
    errno.ENETUNREACH,
    errno.EHOSTDOWN,
    errno.EHOSTUNREACH,
    errno.ENOBUFS,
    errno.EMSGSIZE,
)


class _UdpLink(BaseLink):
    """What the three have in common: one socket, read in bursts."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        super().__init__(f"{scheme}:{host_and_port(host, port)}")
        self._host, self._port = host, port
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket: socket.socket | None = None
        self._transport: asyncio.DatagramTransport | None = None  # only on loops without add_reader
        self._transport_owns_socket = False
        self._has_more: Callable[[], object] = bool
        self._burst_listener: BurstListener | None = None

    @property
    def local_address(self) -> tuple[str, int]:
        """Host and port this link is bound to; ("", 0) when it is not open."""
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
        self._has_more = has_more(sock)
        _ask_for_buffers(sock)
        try:
            self._loop.add_reader(sock, self._drain)
        except NotImplementedError:
            await self._connect_without_reader(sock)

    async def _connect_without_reader(self, sock: socket.socket) -> None:
        assert self._loop is not None
        self._transport_owns_socket = True
        self._released.clear()
        try:
            await self._loop.create_datagram_endpoint(lambda: _DatagramProtocol(self), sock=sock)
        except BaseException:
            self._released.set()  # asyncio has closed the socket
            raise

    def _transport_made(self, transport: asyncio.DatagramTransport) -> None:
        self._transport = transport
        if self._socket is None:  # closed meanwhile
            self._release()

    def _transport_gone(self, error: Exception | None) -> None:
        self._transport = None
        self._released.set()
        self._lose(f"the socket failed: {error}" if error else "the socket was closed", error)

    def _release(self) -> None:
        sock, self._socket = self._socket, None
        transport, self._transport = self._transport, None
        loop = None if self._loop is None or self._loop.is_closed() else self._loop
        if transport is not None and loop is not None:
            transport.abort()  # _transport_gone comes on the next turn of the loop
        if sock is not None and not self._transport_owns_socket:
            if loop is not None:
                loop.remove_reader(sock)
            sock.close()

    @property
    def tells_bursts(self) -> bool:
        """See `Link.tells_bursts`."""
        return self._socket is not None and not self._transport_owns_socket

    def _drain(self) -> None:
        """Reads what is there, at most a burst of it; the loop comes back while there is more."""
        self._read_burst()
        if self._burst_listener is not None and self._receiver is not None:
            self._burst_listener.burst_ended()

    def _read_burst(self) -> None:
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            if self._socket is None:  # closed by the receiver
                return
            try:
                data, source = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._receive_failed(error)
            else:
                self._datagram_received(data, source)
            if not self._has_more():
                return

    def _receive_failed(self, error: OSError) -> None:
        """An earlier datagram of ours met a closed port, or the network is away: neither ends a UDP link."""
        if not isinstance(error, ConnectionError) and error.errno not in _PASSING:
            self._lose(f"the socket failed: {error.strerror or error}", error)

    def _send(self, data: bytes, address: Any) -> None:
        """Sends one datagram, or drops and counts it."""
        if self._socket is None:
            return
        try:
            self._socket.sendto(data, address)
        except OSError:
            self._drop(1)


class UdpListen(_UdpLink):
    """``udpin:`` binds a port and talks to everybody who was heard on it; each of them is a peer.

    Port 0 lets the system choose one; `address` and `local_address` say which once the link is open. ``peers`` are the
    IP addresses and networks that are listened to (None: all); InvalidArgument for what is none.
    """

    def __init__(self, host: str, port: int, *, peers: Peers | None = None) -> None:
        super().__init__("udpin", host, port)
        self._allowed = AllowedPeers(peers)
        self._peers: dict[Peer, None] = {}  # the one heard last is at the end
        self._heard_last: Peer = None

    @property
    def peers(self) -> tuple[Peer, ...]:
        """All remembered peers, the one heard last comes first."""
        return tuple(reversed(self._peers))

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; with nobody heard yet there is nobody to write to, which is not counted."""
        if peer is None:
            for each in self._peers:
                self._send(data, each)
        elif peer in self._peers:
            self._send(data, peer)
        else:
            self._drop(1)

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`."""
        self._peers[peer] = None

    def forget_peer(self, peer: Peer) -> None:
        """See `Link.forget_peer`."""
        self._peers.pop(peer, None)

    def has_peer(self, peer: Peer) -> bool:
        """See `Link.has_peer`."""
        return peer in self._peers

    async def _make_socket(self) -> socket.socket:
        sock = await bound_socket(self._host, self._port, socket.SOCK_DGRAM)
        self.address: str = f"udpin:{host_and_port(self._host, sock.getsockname()[1])}"
        return sock

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source != self._heard_last:
            if source not in self._peers and not self._allowed.allows(source[0]):
                return
            self._heard_last = source
            if not self._keeps_peers:
                self._remember(source)
        self._deliver(data, source)

    def _remember(self, source: Peer) -> None:
        self._peers.pop(source, None)
        if len(self._peers) >= MAX_PEERS:
            del self._peers[next(iter(self._peers))]
        self._peers[source] = None


class UdpConnect(_UdpLink):
    """``udpout:`` sends to one remote address and hears only that one: host and port must both be its.

    The socket stays unconnected: uvloop stops to read a connected one at the first "connection refused" of
    the other side, which is nothing but a vehicle that has not started yet.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__("udpout", host, port)
        self._remote: Any = None

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`."""
        self._send(data, self._remote)

    async def _make_socket(self) -> socket.socket:
        endpoint = (await resolve(self._host, self._port, socket.SOCK_DGRAM))[0]
        self._remote = _name_of_remote(endpoint)
        return bind_to(Endpoint(endpoint.family, ("", 0)), socket.SOCK_DGRAM)

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source == self._remote:
            self._deliver(data)


class UdpBroadcast(_UdpLink):
    """``udpbcast:`` (IPv4) broadcasts until somebody answers, then talks to that one only.

    When nothing has come from there for 3.5 s, it broadcasts again and hears who answers; another port of the same host
    is heard at once. What is for one peer is sent to that one, and never to everybody. ``peers`` are the IP addresses
    and networks that are listened to (None: all).
    """

    # of _remote
    _heard_at: float

    def __init__(self, host: str, port: int, *, peers: Peers | None = None) -> None:
        super().__init__("udpbcast", host, port)
        self._allowed = AllowedPeers(peers)
        self._everybody: Any = None
        self._remote: Any = None  # who has answered

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`."""
        everybody_or_it = self._everybody if self._is_quiet() else self._remote
        self._send(data, everybody_or_it if peer is None else peer)

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`."""
        self._remote, self._heard_at = peer, self._now()

    def _now(self) -> float:
        return 0.0 if self._loop is None else self._loop.time()

    def _is_quiet(self) -> bool:
        return self._remote is None or self._now() - self._heard_at > QUIET_AFTER_S

    async def _make_socket(self) -> socket.socket:
        endpoint = (await resolve(self._host, self._port, socket.SOCK_DGRAM))[0]
        self._everybody, self._remote = endpoint.address, None
        sock = bind_to(Endpoint(socket.AF_INET, ("", 0)), socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return sock

    def _datagram_received(self, data: bytes, source: Any) -> None:
        if source == self._remote:
            self._heard_at = self._now()
        elif not self._may_answer(source):
            return
        elif not self._keeps_peers:
            self.keep_peer(source)
        self._deliver(data, source if self._keeps_peers else None)

    def _may_answer(self, source: Any) -> bool:
        is_its_host = self._keeps_peers and self._remote is not None and source[0] == self._remote[0]
        return (is_its_host or self._is_quiet()) and self._allowed.allows(source[0])


class _DatagramProtocol(asyncio.DatagramProtocol):
    """Reception on loops that have no add_reader."""

    def __init__(self, link: _UdpLink) -> None:
        self._link = link

    def connection_made(self, transport: Any) -> None:  # not every loop's is a DatagramTransport by its class
        self._link._transport_made(transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._link._socket is not None:
            self._link._datagram_received(data, addr)

    def error_received(self, exc: Exception) -> None:
        if isinstance(exc, OSError):
            self._link._receive_failed(exc)

    def connection_lost(self, exc: Exception | None) -> None:
        self._link._transport_gone(exc)


def _name_of_remote(endpoint: Endpoint) -> Any:
    """The address that datagrams from there will bear (0.0.0.0 is this machine); OSError without a route."""
    with socket.socket(endpoint.family, socket.SOCK_DGRAM) as probe:
        probe.connect(endpoint.address)
        return probe.getpeername()


def _ask_for_buffers(sock: socket.socket) -> None:
    with contextlib.suppress(OSError):
        if sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < _RECEIVE_BUFFER:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
