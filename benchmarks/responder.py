"""A vehicle that only answers commands, in a separate process, so that it is not measured.

    python benchmarks/responder.py PORT ...

It sends a heartbeat to each of these UDP ports of this machine four times a second, and answers each COMMAND_LONG
with an ACCEPTED COMMAND_ACK prepared in advance. On MAV_CMD_REQUEST_MESSAGE for a message that connecting programs
need, it sends that one as well. It ends when it is terminated.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Callable, Hashable
from functools import partial

from aerokit.mavlink import FrameEncoder, Message, messages

MAGIC_V2 = 0xFD
COMMAND_LONG = 76
REQUEST_MESSAGE = 512
HEARTBEAT_INTERVAL_S = 0.25
SYSTEM_ID = 1
COMPONENT_ID = 1

HEADER_SIZE = 10
COMMAND_FIELDS = struct.Struct("<f24xH")
"""The fields param1 and command of COMMAND_LONG. Param2 to param7 are between them."""

Address = tuple[str, int]

SENT_ON_REQUEST: dict[int, Callable[[], Message]] = {
    148: lambda: messages.AutopilotVersion(0, 0x04070000, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 1),
    242: lambda: messages.HomePosition(0, 0, 0, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0),
    49: lambda: messages.GpsGlobalOrigin(0, 0, 0),
}


class Peer:
    """One client, with continuous sequence numbers."""

    def __init__(self) -> None:
        self._sequence = -1
        self._frames: dict[Hashable, list[bytes]] = {}

    def next_frame(self, key: Hashable, make: Callable[[], Message]) -> bytes:
        """Return a message with the next sequence number. Its 256 frames are encoded on first use."""
        self._sequence = (self._sequence + 1) & 0xFF
        if key not in self._frames:
            encoder = FrameEncoder(SYSTEM_ID, COMPONENT_ID)
            message = make()
            self._frames[key] = [encoder.encode(message) for _ in range(256)]
        return self._frames[key][self._sequence]


class Responder:
    """Sends heartbeats and acknowledgements on blocking sockets."""

    def __init__(self, ports: list[int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(HEARTBEAT_INTERVAL_S)
        self._peers: dict[Address, Peer] = {("127.0.0.1", port): Peer() for port in ports}

    def run(self) -> None:
        """Print a line, then answer until the process is terminated."""
        print("ready", flush=True)
        due = time.monotonic()
        while True:
            if time.monotonic() >= due:
                due = time.monotonic() + HEARTBEAT_INTERVAL_S
                self._send_heartbeats()
            try:
                data, address = self._socket.recvfrom(4096)
            except (TimeoutError, ConnectionError):  # no request has arrived, or the client does not listen yet
                continue
            self._answer(data, address)

    def _send_heartbeats(self) -> None:
        for address, peer in self._peers.items():
            self._socket.sendto(peer.next_frame("heartbeat", _heartbeat), address)

    def _answer(self, data: bytes, address: Address) -> None:
        if data[0] != MAGIC_V2 or int.from_bytes(data[7:10], "little") != COMMAND_LONG:
            return
        peer = self._peers.get(address)
        if peer is None:
            return
        param1, command = COMMAND_FIELDS.unpack_from(data, HEADER_SIZE)
        system_id, component_id = data[5], data[6]  # of the sender
        make_ack = partial(
            messages.CommandAck,
            command=command,
            result=0,
            progress=0,
            result_param2=0,
            target_system=system_id,
            target_component=component_id,
        )
        self._socket.sendto(peer.next_frame((command, system_id, component_id), make_ack), address)
        if command == REQUEST_MESSAGE:
            self._send_requested(int(param1), peer, address)

    def _send_requested(self, message_id: int, peer: Peer, address: Address) -> None:
        make = SENT_ON_REQUEST.get(message_id)
        if make is not None:
            self._socket.sendto(peer.next_frame(("requested", message_id), make), address)


def _heartbeat() -> Message:
    return messages.Heartbeat(type=2, autopilot=3, base_mode=81, custom_mode=4, system_status=4)


if __name__ == "__main__":
    Responder([int(port) for port in sys.argv[1:]]).run()
