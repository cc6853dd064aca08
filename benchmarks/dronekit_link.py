"""The link of the scripted vehicle: UDP or TCP, with a delay in each direction and a bandwidth limit."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

__all__ = ["Link", "make_link"]

HOST = "127.0.0.1"
MAX_UNSENT = 65536


class Link:
    """Base class of links that send bytes and receive pymavlink messages."""

    is_stream = False

    def __init__(self, delay: float, bandwidth: float) -> None:
        self.socket = socket.socket()
        self._delay = delay
        self._bandwidth = bandwidth
        self._free_at = 0.0  # when the bandwidth allows the next byte
        # Delayed bytes and messages, each with the time at which it is due.
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self._incoming: deque[tuple[float, Any]] = deque()
        dialect: Any = ardupilotmega
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True

    @property
    def is_writable(self) -> bool:
        """Return True if more can be sent at once."""
        return not self.wants_to_write

    @property
    def wants_to_write(self) -> bool:
        """Return True if bytes are queued because the socket accepts no more."""
        return False

    def wait_for_peer(self) -> None:
        """Wait until there is a peer to send to."""

    def send(self, data: bytes) -> None:
        """Send bytes after the delay, within the bandwidth."""
        if not self._delay and not self._bandwidth:
            self._write(data)
            return
        begins_at = max(time.monotonic(), self._free_at)
        duration_s = len(data) / self._bandwidth if self._bandwidth else 0.0
        self._free_at = begins_at + duration_s
        self._outgoing.append((self._free_at + self._delay, data))

    def release_due(self) -> float:
        """Send the delayed bytes that are due. Return the time at which more bytes or messages are due."""
        now = time.monotonic()
        while _next_due(self._outgoing) <= now:
            _, data = self._outgoing.popleft()
            self._write(data)
        return min(_next_due(self._outgoing), _next_due(self._incoming))

    def read(self) -> None:
        """Read the socket. Messages are received after their delay."""
        data = self._read()
        for message in self._parser.parse_buffer(data) or ():
            self._incoming.append((time.monotonic() + self._delay, message))

    def received(self) -> Iterator[Any]:
        """Yield the pymavlink messages whose delay has passed."""
        while _next_due(self._incoming) <= time.monotonic():
            _, message = self._incoming.popleft()
            yield message

    def _write(self, data: bytes) -> None:
        raise NotImplementedError

    def _read(self) -> bytes:
        raise NotImplementedError


def _next_due(queue: deque[tuple[float, Any]]) -> float:
    """Return the time at which the first entry of a queue is due; infinity if the queue is empty."""
    if not queue:
        return math.inf
    due_at, _ = queue[0]
    return due_at


class UdpLink(Link):
    """Sends UDP datagrams to a port of this machine."""

    def __init__(self, port: int, delay: float, bandwidth: float) -> None:
        super().__init__(delay, bandwidth)
        self.socket.close()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HOST, 0))
        self._peer = (HOST, port)

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(ConnectionError):  # There is no peer yet.
            self.socket.sendto(data, self._peer)

    def _read(self) -> bytes:
        try:
            return self.socket.recv(4096)
        except ConnectionError:
            return b""


class TcpLink(Link):
    """Serves one TCP client."""

    is_stream = True

    def __init__(self, port: int, delay: float, bandwidth: float) -> None:
        super().__init__(delay, bandwidth)
        self._server = self.socket
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._server.bind((HOST, port))
        self._server.listen()
        self._unsent = b""

    def wait_for_peer(self) -> None:
        self.socket, _ = self._server.accept()
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.setblocking(False)

    @property
    def wants_to_write(self) -> bool:
        return bool(self._unsent)

    def release_due(self) -> float:
        if self._unsent:
            self._write(b"")
        return super().release_due()

    def _write(self, data: bytes) -> None:
        if len(self._unsent) < MAX_UNSENT:
            self._unsent += data
        try:
            sent = self.socket.send(self._unsent)
            self._unsent = self._unsent[sent:]
        except BlockingIOError:
            return
        except ConnectionError:
            raise SystemExit from None

    def _read(self) -> bytes:
        try:
            data = self.socket.recv(65536)
        except BlockingIOError:
            return b""
        except ConnectionError:
            raise SystemExit from None
        if not data:
            raise SystemExit
        return data


def make_link(transport: str, port: int, delay: float, bandwidth: float) -> Link:
    """Create a link: ``udp`` sends to the port, ``tcp`` listens on it."""
    return UdpLink(port, delay, bandwidth) if transport == "udp" else TcpLink(port, delay, bandwidth)
