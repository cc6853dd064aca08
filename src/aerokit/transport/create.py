"""``create_link``: make an unopened link from a connection string."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.transport.address import LinkAddress, parse_address

if TYPE_CHECKING:
    from aerokit.transport.link import Link
    from aerokit.transport.sockets import PeerFilter
    from aerokit.transport.zenoh.session import NetworkOptions

FILTERING_KINDS = ("udpin", "udpbcast", "tcpin")
"""Kinds of links that filter their senders by ``peers``."""


def create_link(address: str | LinkAddress, *, baud: int = 57600, peers: PeerFilter | None = None) -> Link:
    """Create the link that a connection string describes. The link is not opened.

    Args:
        address: a connection string, or the result of :func:`parse_address`.
        baud: bits per second of a serial port, if the connection string does not give a baud rate.
        peers: IP addresses and networks to accept, for udpin, udpbcast and tcpin; None: all.

    Raises:
        InvalidArgument: the address or ``peers`` are wrong.
    """
    parsed = address if isinstance(address, LinkAddress) else parse_address(address)
    if peers is not None and parsed.kind not in FILTERING_KINDS:
        raise InvalidArgument(
            f"peers = … is not allowed with {parsed}: only udpin, udpbcast and tcpin links filter senders"
        )
    if parsed.kind == "serial":
        # Each kind of link is imported where it is used, because a program uses few kinds.
        from aerokit.transport.serial import SerialLink

        return SerialLink(parsed.device, parsed.baud or baud, rtscts=parsed.option("rtscts") == "1")
    if parsed.kind == "replay":
        from aerokit.transport.replay import Replay

        return Replay(parsed.path, float(parsed.option("speed") or 1.0))
    if parsed.kind == "pty":
        from aerokit.transport.serial import PtyLink

        return PtyLink(parsed.path)
    if parsed.kind in ("zenoh", "zenohin"):
        return _create_zenoh(parsed)
    if parsed.kind in ("tcp", "tcpin"):
        return _create_tcp(parsed, peers)
    return _create_udp(parsed, peers)


def _create_tcp(parsed: LinkAddress, peers: PeerFilter | None) -> Link:
    from aerokit.transport.tcp import CONNECT_TIMEOUT_S, TcpConnect, TcpListen

    if parsed.kind == "tcpin":
        return TcpListen(parsed.host, parsed.port, peers=peers)
    timeout = float(parsed.option("timeout") or CONNECT_TIMEOUT_S)
    return TcpConnect(parsed.host, parsed.port, connect_timeout_s=timeout)


def network_options(parsed: LinkAddress) -> NetworkOptions:
    from aerokit.transport.zenoh.session import NetworkOptions

    return NetworkOptions(
        connect=_endpoints(parsed.option("connect")),
        listen=_endpoints(parsed.option("listen")),
        mode=parsed.option("mode") or "",
        config=parsed.option("config") or "",
    )


def _endpoints(comma_separated: str | None) -> tuple[str, ...]:
    return tuple(endpoint for endpoint in (comma_separated or "").split(",") if endpoint)


def _create_zenoh(parsed: LinkAddress) -> Link:
    fleet, _, name = parsed.path.partition("/")
    options = network_options(parsed)
    if parsed.kind == "zenohin":
        from aerokit.transport.zenoh.listen import ZenohListen

        return ZenohListen(fleet, name, options=options)
    from aerokit.transport.zenoh.connect import OPEN_TIMEOUT_S, ZenohConnect

    return ZenohConnect(
        fleet,
        name,
        options=options,
        client=parsed.option("client") or "",
        control=parsed.option("control") or "free",
        open_timeout_s=float(parsed.option("timeout") or OPEN_TIMEOUT_S),
    )


def _create_udp(parsed: LinkAddress, peers: PeerFilter | None) -> Link:
    from aerokit.transport.udp import UdpBroadcast, UdpConnect, UdpListen

    if parsed.kind == "udpin":
        return UdpListen(parsed.host, parsed.port, peers=peers)
    if parsed.kind == "udpbcast":
        return UdpBroadcast(parsed.host, parsed.port, peers=peers)
    return UdpConnect(parsed.host, parsed.port)
