"""``create_link``: make an unopened link from a connection string."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.transport.address import LinkAddress, parse_address

if TYPE_CHECKING:
    from aerokit.transport.link import Link
    from aerokit.transport.sockets import PeerFilter
    from aerokit.transport.zenoh.session import NetworkOptions


def create_link(address: str | LinkAddress, *, baud: int = 57600, peers: PeerFilter | None = None) -> Link:
    """Make the link that a connection string describes, without opening it.

    Args:
        address: a connection string, or the result of :func:`parse_address`.
        baud: bits per second of a serial port whose string does not give them.
        peers: IP addresses and networks to accept, for udpin, udpbcast and tcpin; None: all.

    Raises:
        InvalidArgument: the address or ``peers`` are wrong.
    """
    where = address if isinstance(address, LinkAddress) else parse_address(address)
    if peers is not None and where.kind not in ("udpin", "udpbcast", "tcpin"):
        raise InvalidArgument(
            f"peers = … is not allowed with {where}: only udpin, udpbcast and tcpin links filter senders"
        )
    if where.kind == "serial":
        from aerokit.transport.serial import SerialLink  # imported here because a program uses few kinds of links

        return SerialLink(where.device, where.baud or baud, rtscts=where.option("rtscts") == "1")
    if where.kind == "replay":
        from aerokit.transport.replay import Replay

        return Replay(where.path, float(where.option("speed") or 1.0))
    if where.kind == "pty":
        from aerokit.transport.serial import PtyLink

        return PtyLink(where.path)
    if where.kind in ("zenoh", "zenohin"):
        return _zenoh(where)
    if where.kind in ("tcp", "tcpin"):
        return _tcp(where, peers)
    return _udp(where, peers)


def _tcp(where: LinkAddress, peers: PeerFilter | None) -> Link:
    from aerokit.transport.tcp import CONNECT_TIMEOUT_S, TcpConnect, TcpListen

    if where.kind == "tcpin":
        return TcpListen(where.host, where.port, peers=peers)
    timeout = float(where.option("timeout") or CONNECT_TIMEOUT_S)
    return TcpConnect(where.host, where.port, connect_timeout_s=timeout)


def network_options(where: LinkAddress) -> NetworkOptions:
    """Return the zenoh options of an address."""
    from aerokit.transport.zenoh.session import NetworkOptions

    connect, listen = (tuple(filter(None, (where.option(key) or "").split(","))) for key in ("connect", "listen"))
    return NetworkOptions(connect, listen, where.option("mode") or "", where.option("config") or "")


def _zenoh(where: LinkAddress) -> Link:
    fleet, _, name = where.path.partition("/")
    options = network_options(where)
    if where.kind == "zenohin":
        from aerokit.transport.zenoh.listen import ZenohListen

        return ZenohListen(fleet, name, options=options)
    from aerokit.transport.zenoh.connect import OPEN_TIMEOUT_S, ZenohConnect

    return ZenohConnect(
        fleet,
        name,
        options=options,
        client=where.option("client") or "",
        control=where.option("control") or "free",
        open_timeout_s=float(where.option("timeout") or OPEN_TIMEOUT_S),
    )


def _udp(where: LinkAddress, peers: PeerFilter | None) -> Link:
    from aerokit.transport.udp import UdpBroadcast, UdpConnect, UdpListen

    if where.kind == "udpin":
        return UdpListen(where.host, where.port, peers=peers)
    if where.kind == "udpbcast":
        return UdpBroadcast(where.host, where.port, peers=peers)
    return UdpConnect(where.host, where.port)
