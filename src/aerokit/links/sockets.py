"""Host names and bound sockets, the same for UDP and TCP."""

from __future__ import annotations

import asyncio
import contextlib
import select
import socket
import struct
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

__all__ = ["Endpoint", "bind_to", "bound_socket", "discard_unsent", "has_more", "is_free", "resolve"]


class Endpoint(NamedTuple):
    """Where to bind, or whom to reach."""

    family: int
    address: Any  # what socket.connect and socket.bind take: a tuple, its length depends on the family


async def resolve(host: str, port: int, kind: socket.SocketKind) -> list[Endpoint]:
    """The endpoints behind a host name, IPv4 first: that is where vehicles and simulators listen.

    An IP address is resolved at once, a name on a thread of the loop's executor.
    """
    try:
        found = socket.getaddrinfo(host, port, type=kind, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=kind)
    endpoints = [Endpoint(family, address) for family, _, _, _, address in found]
    return sorted(endpoints, key=lambda endpoint: endpoint.family != socket.AF_INET)


async def bound_socket(host: str, port: int, kind: socket.SocketKind) -> socket.socket:
    """A non-blocking socket bound to the first endpoint that can be; OSError of the last when none can.

    "::" hears IPv4 too. A UDP port is never shared (no SO_REUSEADDR): a second listener would silently take
    the datagrams of the first.
    """
    endpoints = await resolve(host, port, kind)
    for endpoint in endpoints[:-1]:
        with contextlib.suppress(OSError):
            return bind_to(endpoint, kind)
    return bind_to(endpoints[-1], kind)


async def is_free(host: str, port: int) -> bool:
    """Whether nobody listens on that TCP port of this machine."""
    try:
        (await bound_socket(host, port, socket.SOCK_STREAM)).close()
    except OSError:
        return False
    return True


def bind_to(endpoint: Endpoint, kind: socket.SocketKind) -> socket.socket:
    """A non-blocking socket bound to one endpoint."""
    sock = socket.socket(endpoint.family, kind)
    try:
        sock.setblocking(False)
        if endpoint.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        if kind is socket.SOCK_STREAM and hasattr(socket, "AF_UNIX"):  # on Windows it would share the port
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(endpoint.address)
    except BaseException:
        sock.close()
        raise
    return sock


def discard_unsent(sock: socket.socket) -> None:
    """Without lingering the system forgets what it has not sent when it is closed, instead of sending it late."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def has_more(sock: socket.socket) -> Callable[[], object]:
    """Tells, when called, whether something is there to be read: a third of the cost of reading in vain."""
    if sys.platform == "win32":  # no poll there: read in vain
        return partial(bool, True)
    poll = select.poll()
    poll.register(sock, select.POLLIN)
    return partial(poll.poll, 0)
