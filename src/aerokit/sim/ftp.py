"""MAVFTP as a simulated vehicle serves it: what the servers of all autopilots have in common.

https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.sim.file_tree import EEXIST, ENOENT
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.file_tree import FileTree
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["DATA_SIZE", "FtpPacket", "FtpServer", "crc32", "path_in", "read_crc32"]

DATA_SIZE = 239
"""Bytes of data in one message at most."""

_HEADER = struct.Struct("<HBBBBBxI")


@dataclass(frozen=True)
class FtpPacket:
    """The payload of a FILE_TRANSFER_PROTOCOL, and whom it is from or for."""

    sequence: int
    session: int
    opcode: int
    size: int = 0
    request_opcode: int = 0
    burst_complete: int = 0
    offset: int = 0
    data: bytes = b""
    """Of a request all 239 bytes, of an answer those that count."""
    client: tuple[int, int] = (0, 0)
    """System and component id."""

    @classmethod
    def parse(cls, message: FileTransferProtocol) -> FtpPacket:
        """Read what came in; any payload is some packet."""
        payload = message.payload.ljust(_HEADER.size + DATA_SIZE, b"\0")
        sequence, session, opcode, size, request_opcode, complete, offset = _HEADER.unpack_from(payload)
        data, client = payload[_HEADER.size :], sender_of(message)
        return cls(sequence, session, opcode, size, request_opcode, complete, offset, data, client)

    def message(self) -> FileTransferProtocol:
        """The message that carries it."""
        numbers = (self.sequence & 0xFFFF, self.session, self.opcode, self.size, self.request_opcode)
        header = _HEADER.pack(*numbers, self.burst_complete, self.offset & 0xFFFFFFFF)
        return FileTransferProtocol(
            0, *self.client, (header + self.data).ljust(_HEADER.size + DATA_SIZE, b"\0")
        )

    def acknowledge(self, data: bytes = b"", *, offset: int = 0, session: int | None = None) -> FtpPacket:
        """The answer to this request that says yes."""
        session = self.session if session is None else session
        sequence, opcode = self.sequence + 1 & 0xFFFF, MavFtpOpcode.ACK
        return FtpPacket(
            sequence, session, opcode, len(data), self.opcode, 0, offset, data, client=self.client
        )

    def refuse(self, code: int, errno: int | None = None) -> FtpPacket:
        """The answer to this request that says no."""
        data = bytes([code]) if errno is None else bytes([code, errno])
        return replace(self.acknowledge(data), opcode=MavFtpOpcode.NAK)

    def refuse_errno(self, errno: int) -> FtpPacket:
        """The same for what the file system says: two numbers have error codes of their own."""
        own = {EEXIST: MavFtpErr.FILEEXISTS, ENOENT: MavFtpErr.FILENOTFOUND}.get(errno)
        return self.refuse(MavFtpErr.FAILERRNO, errno) if own is None else self.refuse(own)


class FtpServer:
    """Hears requests and answers; an autopilot's own class says how.

    ``no_ftp`` of the vehicle's faults makes it deaf.
    """

    def __init__(self, vehicle: SimulatedVehicle, files: FileTree) -> None:
        self.files = files
        self._vehicle = vehicle
        vehicle.on(FileTransferProtocol, self._on_message)

    @property
    def open_sessions(self) -> int:
        """How many sessions hold a file open and have not run into their time-out."""
        raise NotImplementedError

    def restart(self) -> None:
        """Forget everything, as a reboot does."""
        raise NotImplementedError

    def receive(self, request: FtpPacket, channel: Channel) -> None:
        """Take one request; the answer is sent now or later."""
        raise NotImplementedError

    def _on_message(self, message: FileTransferProtocol, channel: Channel) -> None:
        if not self._vehicle.faults.no_ftp:
            self.receive(FtpPacket.parse(message), channel)


def path_in(data: bytes) -> str:
    """The text up to the first NUL."""
    return data.partition(b"\0")[0].decode("utf-8", "replace")


def crc32(data: bytes, start: int = 0) -> int:
    """The checksum of CalcFileCRC32: the usual polynomial, but neither inverted before nor after."""
    return zlib.crc32(data, start ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def read_crc32(files: FileTree, path: str, block: int) -> int:
    """Read a file in blocks and sum it up; FileFault when it cannot be read."""
    file, checksum, offset = files.open(path), 0, 0
    while data := file.read(offset, block):
        checksum, offset = crc32(data, checksum), offset + len(data)
    file.close()
    return checksum
