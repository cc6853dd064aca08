"""Links that carry bytes: UDP, TCP, serial ports, zenoh, memory and recordings.

Only this package uses sockets and serial ports.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.transport.address import ACCEPTED_FORMS as ACCEPTED_FORMS
    from aerokit.transport.address import LinkAddress as LinkAddress
    from aerokit.transport.address import parse_address as parse_address
    from aerokit.transport.create import create_link as create_link
    from aerokit.transport.link import BurstListener as BurstListener
    from aerokit.transport.link import DrainListener as DrainListener
    from aerokit.transport.link import Link as Link
    from aerokit.transport.link import MemoryLink as MemoryLink
    from aerokit.transport.link import OrderRefusalListener as OrderRefusalListener
    from aerokit.transport.link import Peer as Peer
    from aerokit.transport.link import PeerKeeper as PeerKeeper
    from aerokit.transport.link import PeerListener as PeerListener
    from aerokit.transport.link import Receiver as Receiver
    from aerokit.transport.link import memory_link_pair as memory_link_pair
    from aerokit.transport.multilink import LinkPeer as LinkPeer
    from aerokit.transport.multilink import MemberLinkListener as MemberLinkListener
    from aerokit.transport.multilink import MultiLink as MultiLink
    from aerokit.transport.reconnecting import InterruptionListener as InterruptionListener
    from aerokit.transport.reconnecting import ReconnectingLink as ReconnectingLink
    from aerokit.transport.replay import Replay as Replay
    from aerokit.transport.serial import PtyLink as PtyLink
    from aerokit.transport.serial import SerialLink as SerialLink
    from aerokit.transport.tcp import TcpConnect as TcpConnect
    from aerokit.transport.tcp import TcpListen as TcpListen
    from aerokit.transport.udp import UdpBroadcast as UdpBroadcast
    from aerokit.transport.udp import UdpConnect as UdpConnect
    from aerokit.transport.udp import UdpListen as UdpListen
    from aerokit.transport.zenoh.connect import ZenohConnect as ZenohConnect
    from aerokit.transport.zenoh.listen import ZenohListen as ZenohListen
    from aerokit.transport.zenoh.session import NetworkOptions as NetworkOptions


__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.transport.address": ("ACCEPTED_FORMS", "LinkAddress", "parse_address"),
        "aerokit.transport.create": ("create_link",),
        "aerokit.transport.link": (
            "BurstListener",
            "DrainListener",
            "Link",
            "MemoryLink",
            "OrderRefusalListener",
            "Peer",
            "PeerKeeper",
            "PeerListener",
            "Receiver",
            "memory_link_pair",
        ),
        "aerokit.transport.reconnecting": ("InterruptionListener", "ReconnectingLink"),
        "aerokit.transport.replay": ("Replay",),
        "aerokit.transport.serial": ("PtyLink", "SerialLink"),
        "aerokit.transport.multilink": ("LinkPeer", "MemberLinkListener", "MultiLink"),
        "aerokit.transport.tcp": ("TcpConnect", "TcpListen"),
        "aerokit.transport.udp": ("UdpBroadcast", "UdpConnect", "UdpListen"),
        "aerokit.transport.zenoh.connect": ("ZenohConnect",),
        "aerokit.transport.zenoh.listen": ("ZenohListen",),
        "aerokit.transport.zenoh.session": ("NetworkOptions",),
    },
)
