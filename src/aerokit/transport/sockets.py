"""Host names and bound sockets, the same for UDP and TCP."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import os
import select
import socket
import struct
import sys
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument


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


Network = ipaddress.IPv4Network | ipaddress.IPv6Network

Peers = str | ipaddress.IPv4Address | ipaddress.IPv6Address | Network | Iterable[object]
"""What ``peers`` may be: an IP address or network ("10.0.0.7", "10.0.0.0/24", those of `ipaddress`), or several."""

_KINDS = (
    str,
    ipaddress.IPv4Address,
    ipaddress.IPv6Address,
    ipaddress.IPv4Network,
    ipaddress.IPv6Network,
)


class AllowedPeers:
    """Who may be heard; None: everybody. InvalidArgument for what is no address or network, and for none at all."""

    def __init__(self, peers: Peers | None) -> None:
        self._networks = None if peers is None else tuple(map(_network, _several(peers)))
        if self._networks == ():
            raise InvalidArgument("peers is empty: name at least one IP address or network, or leave it out")

    def allows(self, host: str) -> bool:
        """Whether this IP address is among them."""
        if self._networks is None:
            return True
        address = ipaddress.ip_address(host.partition("%")[0])
        if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        return any(address in network for network in self._networks)


def _several(peers: Peers) -> Iterable[object]:
    if isinstance(peers, Iterable) and not isinstance(
        peers, (str, bytes, ipaddress.IPv4Network, ipaddress.IPv6Network)
    ):
        return peers
    return (peers,)


def _network(item: object) -> Network:
    error: object = "of another type"
    if isinstance(item, _KINDS):
        try:
            return ipaddress.ip_network(item)
        except ValueError as refused:
            error = refused
    raise InvalidArgument(
        f"peers: {shown(item)} is no IP address or network, such as '10.0.0.7' or '10.0.0.0/24' ({error})"
    )


def serial_ports() -> list[Any]:
    """The serial ports of this computer, as pyserial lists them (``device``, ``description``), by their names."""
    ports: list[Any] = importlib.import_module("serial.tools.list_ports").comports()
    return sorted(ports, key=lambda port: str(port.device))


def network_port_error(host: str, port: int, *, udp: bool) -> OSError | None:
    """What keeps us from listening at a port, errno.EADDRINUSE for one that is in use; None: nothing. IPv4 only."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if udp else socket.SOCK_STREAM) as sock:
        if not udp and os.name == "posix":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one just closed is free
        try:
            sock.bind((host, port))
        except OSError as error:
            return error
    return None
