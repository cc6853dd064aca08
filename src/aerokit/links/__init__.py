"""Bytes in, bytes out: UDP, TCP, serial, zenoh, memory, recordings, and a bad radio around any of them.

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
    from .link import (
        BurstListener,
        DrainListener,
        HelmListener,
        Link,
        Peer,
        PeerKeeper,
        PeerListener,
        Receiver,
    )
    from .memory import MemoryLink, memory_link_pair
    from .pty import PtyLink
    from .reconnecting import Interruptible, ReconnectingLink
    from .replay import Replay
    from .serial import SerialLink
    from .several import LinkPeer, OneOfSeveralListener, SeveralLinks
    from .tcp import TcpConnect, TcpListen
    from .udp import UdpBroadcast, UdpConnect, UdpListen
    from .zenoh_connect import ZenohConnect
    from .zenoh_listen import ZenohListen
    from .zenoh_session import NetworkOptions

__all__ = [
    "ACCEPTED_FORMS",
    "BurstListener",
    "DrainListener",
    "FaultModel",
    "FaultyLink",
    "HelmListener",
    "Interruptible",
    "Link",
    "LinkAddress",
    "LinkPeer",
    "MemoryLink",
    "NetworkOptions",
    "OneOfSeveralListener",
    "Peer",
    "PeerKeeper",
    "PeerListener",
    "PtyLink",
    "Receiver",
    "ReconnectingLink",
    "Replay",
    "SerialLink",
    "SeveralLinks",
    "TcpConnect",
    "TcpListen",
    "UdpBroadcast",
    "UdpConnect",
    "UdpListen",
    "ZenohConnect",
    "ZenohListen",
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
    "HelmListener": "aerokit.links.link",
    "Interruptible": "aerokit.links.reconnecting",
    "Link": "aerokit.links.link",
    "LinkAddress": "aerokit.links.address",
    "LinkPeer": "aerokit.links.several",
    "MemoryLink": "aerokit.links.memory",
    "OneOfSeveralListener": "aerokit.links.several",
    "NetworkOptions": "aerokit.links.zenoh_session",
    "Peer": "aerokit.links.link",
    "PeerKeeper": "aerokit.links.link",
    "PeerListener": "aerokit.links.link",
    "PtyLink": "aerokit.links.pty",
    "Receiver": "aerokit.links.link",
    "ReconnectingLink": "aerokit.links.reconnecting",
    "Replay": "aerokit.links.replay",
    "SerialLink": "aerokit.links.serial",
    "SeveralLinks": "aerokit.links.several",
    "TcpConnect": "aerokit.links.tcp",
    "TcpListen": "aerokit.links.tcp",
    "UdpBroadcast": "aerokit.links.udp",
    "UdpConnect": "aerokit.links.udp",
    "UdpListen": "aerokit.links.udp",
    "ZenohConnect": "aerokit.links.zenoh_connect",
    "ZenohListen": "aerokit.links.zenoh_listen",
    "create_link": "aerokit.links.create",
    "memory_link_pair": "aerokit.links.memory",
    "parse_address": "aerokit.links.address",
}

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
