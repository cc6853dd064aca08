"""Bytes in, bytes out: UDP, TCP, serial, memory, recordings. Only this package touches sockets and ports."""

from __future__ import annotations

from .address import ACCEPTED_FORMS, LinkAddress, parse_address
from .create import create_link
from .fault_model import FaultModel
from .faulty import FaultyLink
from .link import Link, Peer, Receiver
from .memory import MemoryLink, memory_link_pair
from .replay import Replay
from .serial import SerialLink
from .tcp import TcpConnect, TcpListen
from .udp import UdpBroadcast, UdpConnect, UdpListen

__all__ = [
    "ACCEPTED_FORMS",
    "FaultModel",
    "FaultyLink",
    "Link",
    "LinkAddress",
    "MemoryLink",
    "Peer",
    "Receiver",
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
