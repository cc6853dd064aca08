"""`free_port`: port numbers for tests that must know the number before the port is opened."""

from __future__ import annotations

import itertools
import os
import socket

# Below the range from which systems assign ports, so that no other test gets the port before it is opened. Each process
# starts at another number, because tests run in several processes.
_PORTS = range(10_000, 32_000)
_next_ports = itertools.islice(itertools.cycle(_PORTS), os.getpid() * 500 % len(_PORTS), None)


def free_port() -> int:
    """Return a number at which neither a TCP nor a UDP port of this machine is open."""
    for port in _next_ports:
        try:
            for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return port
    raise AssertionError("the numbers are a cycle")
