"""``AllowedPeers``: the IP addresses and networks that a link listens to."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable

from aerokit.errors import InvalidArgument
from aerokit.wording import shown

__all__ = ["AllowedPeers", "Network", "Peers"]

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
