"""Sockets for UDP and TCP: name resolution, binding and filters by address."""

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

from aerokit._internal.formatting import short_repr
from aerokit.errors import InvalidArgument


class SocketAddress(NamedTuple):
    """Address family, and an address for ``socket.bind`` or ``connect``."""

    family: int
    address: Any  # a tuple of two elements for IPv4, of four for IPv6


async def resolve(host: str, port: int, kind: socket.SocketKind) -> list[SocketAddress]:
    """Resolve a host name to socket addresses, IPv4 first."""
    try:
        results = socket.getaddrinfo(host, port, type=kind, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:  # The host is a name, not an IP address.
        results = await asyncio.get_running_loop().getaddrinfo(host, port, type=kind)
    addresses = [SocketAddress(family, address) for family, _, _, _, address in results]
    # Vehicles and simulators usually listen on IPv4.
    return sorted(addresses, key=lambda address: address.family != socket.AF_INET)


async def bound_socket(host: str, port: int, kind: socket.SocketKind) -> socket.socket:
    """Return a non-blocking socket, bound to the first address that can be bound.

    Raises the OSError of the last address if none can be bound. "::" also receives IPv4.
    """
    addresses = await resolve(host, port, kind)
    for address in addresses[:-1]:
        with contextlib.suppress(OSError):  # If this address cannot be bound, the next one is tried.
            return bind_to(address, kind)
    return bind_to(addresses[-1], kind)


async def is_port_free(host: str, port: int) -> bool:
    try:
        (await bound_socket(host, port, socket.SOCK_STREAM)).close()
    except OSError:
        return False
    return True


def bind_to(address: SocketAddress, kind: socket.SocketKind) -> socket.socket:
    sock = socket.socket(address.family, kind)
    try:
        sock.setblocking(False)
        if address.family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        # With SO_REUSEADDR, a TCP port can be bound again just after it was closed. The option is not set on Windows,
        # where another program could then bind the same port at the same time. UDP ports are not shared either, because
        # a second listener would silently take the datagrams of the first.
        if kind is socket.SOCK_STREAM and sys.platform != "win32":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address.address)
    except BaseException:
        sock.close()
        raise
    return sock


def discard_on_close(sock: socket.socket) -> None:
    """Make the kernel discard unsent data when the socket is closed (SO_LINGER 0)."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def make_readable_check(sock: socket.socket) -> Callable[[], object]:
    """Return a function that tells whether data can be read."""
    if sys.platform == "win32":  # Windows has no poll(), so a read is always attempted.
        return lambda: True
    # This check takes a third of the time that a failed read takes.
    poll = select.poll()
    poll.register(sock, select.POLLIN)
    return partial(poll.poll, 0)


Network = ipaddress.IPv4Network | ipaddress.IPv6Network

PeerFilter = str | ipaddress.IPv4Address | ipaddress.IPv6Address | Network | Iterable[object]
"""Value of ``peers``: IP addresses or networks ("10.0.0.7", "10.0.0.0/24", objects of `ipaddress`), one or several."""

_PEER_TYPES = (
    str,
    ipaddress.IPv4Address,
    ipaddress.IPv6Address,
    ipaddress.IPv4Network,
    ipaddress.IPv6Network,
)


class AllowedPeers:
    """Filter by IP address; None accepts all. Raises InvalidArgument for invalid or empty ``peers``."""

    def __init__(self, peers: PeerFilter | None) -> None:
        self._networks = None if peers is None else tuple(map(_parse_network, _as_iterable(peers)))
        if self._networks == ():
            raise InvalidArgument("peers = [] is not allowed: give at least one IP address or network, or None for all")

    def allows(self, host: str) -> bool:
        if self._networks is None:
            return True
        address = ipaddress.ip_address(host.partition("%")[0])  # without the scope of an IPv6 address (fe80::1%eth0)
        if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        return any(address in network for network in self._networks)


def _as_iterable(peers: PeerFilter) -> Iterable[object]:
    if isinstance(peers, Iterable) and not isinstance(
        peers, (str, bytes, ipaddress.IPv4Network, ipaddress.IPv6Network)
    ):
        return peers
    return (peers,)


def _parse_network(peer: object) -> Network:
    reason = "wrong type"
    if isinstance(peer, _PEER_TYPES):
        try:
            return ipaddress.ip_network(peer)
        except ValueError as error:
            reason = str(error)
    raise InvalidArgument(
        f"peers: {short_repr(peer)} is not an IP address or network such as '10.0.0.7' or '10.0.0.0/24' ({reason})"
    )


def serial_ports() -> list[Any]:
    """Return the serial ports of this computer as pyserial objects (``device``, ``description``), sorted by name."""
    ports: list[Any] = importlib.import_module("serial.tools.list_ports").comports()
    return sorted(ports, key=lambda port: str(port.device))


def port_bind_error(host: str, port: int, *, udp: bool) -> OSError | None:
    """Return the error of binding an IPv4 port, or None if it is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if udp else socket.SOCK_STREAM) as sock:
        if not udp and os.name == "posix":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # A port that was just closed counts as free.
        try:
            sock.bind((host, port))
        except OSError as error:
            return error
    return None
