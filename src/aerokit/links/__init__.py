"""Bytes in, bytes out: UDP, TCP, serial, memory, recordings. Only this package touches sockets and ports."""

from __future__ import annotations

from .link import Link, Peer, Receiver
from .memory import MemoryLink, memory_link_pair

__all__ = ["Link", "MemoryLink", "Peer", "Receiver", "memory_link_pair"]
