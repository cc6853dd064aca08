"""Bytes in, bytes out: UDP, TCP, serial, memory, recordings, and a bad radio around any of them.

Only this package touches sockets and ports.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.lazy import lazy_names

if TYPE_CHECKING:
    from collections.abc import Callable

    from .address import ACCEPTED_FORMS, LinkAddress, parse_address
    from .create import create_link
    from .fault_model import FaultModel
    from .faulty import FaultyLink
    from .link import BurstListener, DrainListener, Link, Peer, PeerKeeper, PeerListener, Receiver
    from .memory import MemoryLink, memory_link_pair
    from .pty import PtyLink
    from .reconnecting import Interruptible, ReconnectingLink
    from .replay import Replay
    from .serial import SerialLink
    from .tcp import TcpConnect, TcpListen
    from .udp import UdpBroadcast, UdpConnect, UdpListen

__all__ = [
    "ACCEPTED_FORMS",
    "BurstListener",
    "DrainListener",
    "FaultModel",
    "FaultyLink",
    "Interruptible",
    "Link",
    "LinkAddress",
    "MemoryLink",
    "Peer",
    "PeerKeeper",
    "PeerListener",
    "PtyLink",
    "Receiver",
    "ReconnectingLink",
    "Replay",
    "SerialLink",
    "TcpConnect",
    "TcpListen",
    "UdpBroadcast",
    "UdpConnect",
    "UdpListen",
    "create_link",
    "memory_link_pair",
    "parse_address",
]

# Imported when first asked for: a program has one link, of one kind.
_HOMES = {
    "ACCEPTED_FORMS": "aerokit.links.address",
    "BurstListener": "aerokit.links.link",
    "DrainListener": "aerokit.links.link",
    "FaultModel": "aerokit.links.fault_model",
    "FaultyLink": "aerokit.links.faulty",
    "Interruptible": "aerokit.links.reconnecting",
    "Link": "aerokit.links.link",
    "LinkAddress": "aerokit.links.address",
    "MemoryLink": "aerokit.links.memory",
    "Peer": "aerokit.links.link",
    "PeerKeeper": "aerokit.links.link",
    "PeerListener": "aerokit.links.link",
    "PtyLink": "aerokit.links.pty",
    "Receiver": "aerokit.links.link",
    "ReconnectingLink": "aerokit.links.reconnecting",
    "Replay": "aerokit.links.replay",
    "SerialLink": "aerokit.links.serial",
    "TcpConnect": "aerokit.links.tcp",
    "TcpListen": "aerokit.links.tcp",
    "UdpBroadcast": "aerokit.links.udp",
    "UdpConnect": "aerokit.links.udp",
    "UdpListen": "aerokit.links.udp",
    "create_link": "aerokit.links.create",
    "memory_link_pair": "aerokit.links.memory",
    "parse_address": "aerokit.links.address",
}

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
