"""TCP links: a client of one server, and a server for several clients."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from abc import abstractmethod
from typing import Any

import anyio

from aerokit.transport.address import host_and_port
from aerokit.transport.link import LINGER_S, BaseLink, Peer, PeerListener
from aerokit.transport.outbox import Outbox, kernel_unsent_bytes
from aerokit.transport.sockets import (
    AllowedPeers,
    PeerFilter,
    SocketAddress,
    bound_socket,
    discard_on_close,
    resolve,
)

CONNECT_TIMEOUT_S = 10.0
"""Default time-out of `TcpConnect.open`."""

MAX_PENDING_BYTES = 256 * 1024
"""Size of each connection's write buffer in bytes. Writes that do not fit, or have waited for 1 s, are dropped."""

SEND_BUFFER = 16 * 1024
"""Kernel send buffer (Linux doubles it). The buffer is small because data in it cannot be discarded."""

NOT_SENT_LOW_WATER = 1024
"""Limit of unsent data in the kernel (TCP_NOTSENT_LOWAT, where available)."""

# Maximum number of loop iterations between accepting a client and `connection_made`. A closed link waits for this many
# iterations, because the connection of a client can only be closed once `connection_made` was called.
ACCEPT_ITERATIONS = 5

MAX_CLIENTS = 64
"""Maximum number of clients. Another client replaces a client that is not kept (`Link.keep_peer`), or is refused."""


class _TcpLink(BaseLink):
    """Common base of TCP links. Connections outlive a closed link by at most `LINGER_S`."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        super().__init__(f"{scheme}:{host_and_port(host, port)}")
        self._host, self._port = host, port
        self._streams: set[_Stream] = set()  # includes streams that are closed, but still send their remaining data
        self._stalled: set[_Stream] = set()  # streams with data that does not leave this machine

    @property
    def unsent_bytes(self) -> int:
        """Sum of `Link.unsent_bytes` over all connections."""
        return sum(stream.unsent_bytes for stream in self._streams)

    def discard_unsent(self) -> None:
        for stream in self._streams:
            stream.discard_unsent()

    @abstractmethod
    def _on_connected(self, stream: _Stream) -> None: ...

    @abstractmethod
    def _on_disconnected(self, stream: _Stream, error: Exception | None) -> None: ...

    def _add_stream(self, stream: _Stream) -> None:
        self._streams.add(stream)
        self._released.clear()
        if self._receiver is None:  # The link was closed while this connection was being made.
            stream.close()
        else:
            self._on_connected(stream)

    def _remove_stream(self, stream: _Stream, error: Exception | None) -> None:
        self._streams.discard(stream)
        if not self._streams:
            self._released.set()
        self._on_disconnected(stream, error)
        self._on_stalled(stream, False)

    def _on_stalled(self, stream: _Stream, is_stalled: bool) -> None:
        if is_stalled:
            self._stalled.add(stream)
        else:
            self._stalled.discard(stream)
        self._report_stalled(bool(self._stalled))

    def _release(self) -> None:
        for stream in tuple(self._streams):
            stream.close()


class TcpConnect(_TcpLink):
    """``tcp:`` link: connects to a server. The link is lost when the server closes the connection."""

    def __init__(self, host: str, port: int, *, connect_timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        super().__init__("tcp", host, port)
        self._connect_timeout_s = connect_timeout_s
        self._stream: _Stream | None = None  # None while the link is not open

    @property
    def local_address(self) -> tuple[str, int]:
        """Own host and port; ("", 0) while the link is not open."""
        return self._stream.own_address if self._stream is not None else ("", 0)

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. Drops data beyond `MAX_PENDING_BYTES`, and data that has waited for a second."""
        if self._stream is not None:
            self._stream.write(data)

    async def _connect(self) -> None:
        with anyio.move_on_after(self._connect_timeout_s):
            return await self._connect_to_any(await resolve(self._host, self._port, socket.SOCK_STREAM))
        # Only a time-out leads here, because the `with` block returns after a success.
        raise OSError(errno.ETIMEDOUT, f"no answer within {self._connect_timeout_s:g} s")

    async def _connect_to_any(self, addresses: list[SocketAddress]) -> None:
        first_error: OSError | None = None
        for address in addresses:
            try:
                return await self._connect_to(address)
            except OSError as error:
                first_error = first_error or error  # The first address is the preferred one, so its error is raised.
        raise first_error or OSError(errno.EADDRNOTAVAIL, "the host has no address")

    async def _connect_to(self, address: SocketAddress) -> None:
        """Connect to one address. `_on_connected` stores the stream."""
        loop = asyncio.get_running_loop()
        sock = socket.socket(address.family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            await loop.sock_connect(sock, address.address)
        except BaseException:
            sock.close()
            raise
        stream = _Stream(self)
        try:
            await loop.create_connection(lambda: stream, sock=sock)
        except BaseException:
            self._stream = None  # Otherwise, closing the stream would count as the loss of an open link.
            stream.close()
            # After a failure, uvloop neither closes the socket nor calls `connection_lost`, which removes the stream.
            sock.close()
            self._remove_stream(stream, None)
            raise

    def _on_connected(self, stream: _Stream) -> None:
        self._stream = stream

    def _on_disconnected(self, stream: _Stream, error: Exception | None) -> None:
        if stream is self._stream:
            self._lose(_why_lost(error), error)

    def _release(self) -> None:
        self._stream = None
        super()._release()


class TcpListen(_TcpLink):
    """``tcpin:`` link: serves clients. Each client is a peer; the link is not lost when clients disconnect.

    With port 0, the system chooses a port. `address` and `local_address` have this port once the link is open.
    ``peers`` are the IP addresses and networks that may connect; None: all.
    """

    def __init__(self, host: str, port: int, *, peers: PeerFilter | None = None) -> None:
        super().__init__("tcpin", host, port)
        self._allowed = AllowedPeers(peers)
        self._kept: set[Peer] = set()  # clients that the receiver keeps
        self._socket: socket.socket | None = None  # None once the server owns the socket
        self._server: asyncio.AbstractServer | None = None
        self._local_address = ("", 0)  # host and port
        self._clients: dict[Peer, _Stream] = {}

    @property
    def local_address(self) -> tuple[str, int]:
        """Host and port of the listening socket; ("", 0) before the link is open."""
        return self._local_address

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Connected clients."""
        return tuple(self._clients)

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. For each client, drops data beyond `MAX_PENDING_BYTES` or older than a second."""
        if peer is None:
            for client in tuple(self._clients.values()):
                client.write(data)
        elif client_of_peer := self._clients.get(peer):
            client_of_peer.write(data)
        else:
            self._count_dropped(1)

    def unsent_bytes_to(self, peer: Peer) -> int:
        stream = self._clients.get(peer)
        return 0 if stream is None else stream.unsent_bytes

    def keep_peer(self, peer: Peer) -> None:
        """See `Link.keep_peer`. A kept client is not replaced by a new client."""
        if peer in self._clients:
            self._kept.add(peer)

    def forget_peer(self, peer: Peer) -> None:
        """See `Link.forget_peer`. The client stays connected, but a new client may replace it."""
        self._kept.discard(peer)

    def has_peer(self, peer: Peer) -> bool:
        return peer in self._clients

    def close_clients(self) -> None:
        """Disconnect all clients. They may reconnect."""
        for stream in tuple(self._clients.values()):
            stream.close()

    async def wait_closed(self) -> None:
        for _ in range(ACCEPT_ITERATIONS):  # Meanwhile, `_add_stream` closes clients that were just accepted.
            await asyncio.sleep(0)
        await super().wait_closed()
        if self._server is not None and self._receiver is None:
            with anyio.move_on_after(LINGER_S):
                await self._server.wait_closed()

    async def _connect(self) -> None:
        self._socket = sock = await bound_socket(self._host, self._port, socket.SOCK_STREAM)
        self._local_address = sock.getsockname()[:2]
        _, port = self._local_address
        self.address: str = f"tcpin:{host_and_port(self._host, port)}"
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Stream(self), sock=sock, backlog=16, start_serving=False)
        self._socket = None  # The server now owns the socket and closes it.
        await self._server.start_serving()

    def _on_connected(self, stream: _Stream) -> None:
        # The host is unknown if the client has already disconnected.
        host = stream.peer[0] if isinstance(stream.peer, tuple) else ""
        is_forbidden = bool(host) and not self._allowed.allows(host)
        if is_forbidden or not self._make_room():
            stream.close()
        else:
            self._clients[stream.peer] = stream
            if isinstance(self._receiver, PeerListener):
                self._receiver.peer_joined(stream.peer)

    def _make_room(self) -> bool:
        """Disconnect a client if there is no room for another. Return False if no client may be disconnected."""
        if len(self._clients) < MAX_CLIENTS:
            return True
        unkept = next((peer for peer in self._clients if peer not in self._kept), None)
        if not self._keeps_peers or unkept is None:  # Without a `PeerKeeper`, every client counts as kept.
            return False
        self._clients.pop(unkept).close()
        if isinstance(self._receiver, PeerListener):
            self._receiver.peer_left(unkept)
        return True

    def _on_disconnected(self, stream: _Stream, error: Exception | None) -> None:
        if self._clients.get(stream.peer) is stream:
            del self._clients[stream.peer]
            self._kept.discard(stream.peer)
            if isinstance(self._receiver, PeerListener):
                self._receiver.peer_left(stream.peer)

    def _release(self) -> None:
        self._clients.clear()
        if self._server is not None:
            with contextlib.suppress(RuntimeError):  # The loop may be closed, and its sockets with it.
                self._server.close()
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        super()._release()


class _Stream(asyncio.Protocol):
    """One TCP connection, with a bounded write buffer and a bounded linger time."""

    def __init__(self, link: _TcpLink) -> None:
        self._link = link
        self._transport: asyncio.Transport | None = None  # None until the connection is made
        self._outbox: Outbox | None = None  # None until the connection is made
        self._fd = -1  # file descriptor of the socket; −1 while there is none
        self._loop = asyncio.get_running_loop()
        self._linger_timer: asyncio.TimerHandle | None = None  # runs from close() until the remaining data is sent
        self.peer: Peer = None  # address of the other end, set in `connection_made`

    @property
    def own_address(self) -> tuple[str, int]:
        address: Any = None if self._transport is None else self._transport.get_extra_info("sockname")
        return address[:2] if address else ("", 0)

    @property
    def unsent_bytes(self) -> int:
        return 0 if self._outbox is None else self._outbox.unsent_bytes

    def write(self, data: bytes) -> None:
        if self._outbox is None or self._transport is None or self._transport.is_closing():
            self._link._count_dropped(1)
        else:
            self._outbox.write(data)

    def discard_unsent(self) -> None:
        if self._outbox is not None:
            self._outbox.discard()

    def close(self) -> None:
        """Send remaining data for up to `LINGER_S`, then close."""
        if self._transport is None or self._outbox is None or self._transport.is_closing():
            return
        with contextlib.suppress(RuntimeError):  # The loop may be closed.
            if self._outbox.is_stalled:
                self._abort()
                return
            self._outbox.close()
            self._transport.close()
            if self._transport.get_write_buffer_size():
                self._linger_timer = self._loop.call_later(LINGER_S, self._abort)

    def _abort(self) -> None:
        assert self._transport is not None
        sock = self._transport.get_extra_info("socket")
        discard_on_close(sock)
        self._transport.abort()

    # The type of `transport` is Any, because the transports of some loops do not inherit from asyncio.Transport.
    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        # The address is unknown (None) if the client has already disconnected. The peer then gets a unique name.
        self.peer = transport.get_extra_info("peername") or f"client {id(self):#x}"
        # The transport must buffer nothing itself: data that cannot be sent at once waits in the outbox, where it can
        # be discarded.
        transport.set_write_buffer_limits(high=0)
        sock = transport.get_extra_info("socket")
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_LOW_WATER)
        self._fd = sock.fileno()
        self._outbox = Outbox(
            send=transport.write,
            pending_bytes=self._pending_bytes,
            limit=MAX_PENDING_BYTES,
            on_dropped=self._link._count_dropped,
            on_stalled=lambda is_stalled: self._link._on_stalled(self, is_stalled),
        )
        self._link._add_stream(self)

    def data_received(self, data: bytes) -> None:
        peer = self.peer if isinstance(self._link, TcpListen) else None
        self._link._deliver(data, peer)

    def eof_received(self) -> None:
        # asyncio alone would wait without limit until the other end reads what was written.
        self.close()

    def pause_writing(self) -> None:
        if self._outbox is not None:
            self._outbox.pause()

    def resume_writing(self) -> None:
        # The outbox resumes in a later loop iteration. Otherwise, a write could fail inside this callback, and asyncio
        # would end the connection twice, the second time with an AttributeError.
        if self._outbox is not None:
            self._loop.call_soon(self._outbox.resume)

    def _pending_bytes(self) -> int:
        if self._transport is None or self._fd < 0:
            return 0
        return self._transport.get_write_buffer_size() + kernel_unsent_bytes(self._fd)

    def connection_lost(self, exc: Exception | None) -> None:
        self._fd = -1  # The system may give the same number to another file.
        if self._outbox is not None:
            self._outbox.discard()
            self._outbox.close()
        if self._linger_timer is not None:
            self._linger_timer.cancel()
        self._link._remove_stream(self, exc)


def _why_lost(error: Exception | None) -> str:
    if error is None:
        return "the other end closed the connection"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
