"""Bytes in, bytes out: UDP, TCP, serial, memory, recordings, and a bad radio around any of them.

Only this package touches sockets and ports.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .address import ACCEPTED_FORMS, LinkAddress, parse_address
from .create import create_link
from .link import DrainListener, Link, Peer, PeerKeeper, Receiver
from .memory import MemoryLink, memory_link_pair
from .pty import PtyLink
from .reconnecting import Interruptible, ReconnectingLink
from .replay import Replay
from .serial import SerialLink
from .tcp import TcpConnect, TcpListen
from .udp import UdpBroadcast, UdpConnect, UdpListen

if TYPE_CHECKING:
    from .fault_model import FaultModel
    from .faulty import FaultyLink

__all__ = [
    "ACCEPTED_FORMS",
    "DrainListener",
    "FaultModel",
    "FaultyLink",
    "Interruptible",
    "Link",
    "LinkAddress",
    "MemoryLink",
    "Peer",
    "PeerKeeper",
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

# Imported when first asked for: only tests want them, and `random` is dear.
_HOMES = {"FaultModel": "aerokit.links.fault_model", "FaultyLink": "aerokit.links.faulty"}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value
