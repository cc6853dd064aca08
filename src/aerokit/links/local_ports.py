"""The ports of this computer: serial ones that it has, and those of the network that somebody uses."""

from __future__ import annotations

import importlib
import os
import socket
from typing import Any

__all__ = ["network_port_error", "serial_ports"]


def serial_ports() -> list[Any]:
    """The serial ports of this computer, as pyserial lists them (``device``, ``description``), by their names."""
    ports: list[Any] = importlib.import_module("serial.tools.list_ports").comports()
    return sorted(ports, key=lambda port: str(port.device))


def network_port_error(host: str, port: int, *, udp: bool) -> OSError | None:
    """What keeps us from listening at a port, errno.EADDRINUSE for one that is in use; None: nothing. IPv4 only."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if udp else socket.SOCK_STREAM) as sock:
        if not udp and os.name == "posix":
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one just closed is free
        try:
            sock.bind((host, port))
        except OSError as error:
            return error
    return None
