"""MAVFTP as a simulated vehicle serves it: what the servers of all autopilots have in common.

https://mavlink.io/en/services/ftp.html
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any, Protocol

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.ftp import FtpMessage
from aerokit.sim.file_tree import EEXIST, ENOENT
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.mavlink.message import Message
    from aerokit.sim.channel import Channel
    from aerokit.sim.faults import Faults
    from aerokit.sim.file_tree import FileTree

__all__ = ["FileHost", "FtpPacket", "FtpServer", "crc32", "path_in", "read_crc32"]


class FtpPacket(FtpMessage):
    """What is in a FILE_TRANSFER_PROTOCOL, and whom it is from or for. A request's ``data`` are all 239 bytes."""

    client: tuple[int, int] = (0, 0)
    """System and component id."""

    @classmethod
    def parse(cls, message: FileTransferProtocol) -> FtpPacket:
        """Read what came in; any payload is some packet."""
        return cls.decode(message.payload, cut=False).replace(client=sender_of(message))

    def message(self) -> FileTransferProtocol:
        """The message that carries it."""
        return FileTransferProtocol(0, *self.client, self.encode())

    def acknowledge(self, data: bytes = b"", *, offset: int = 0, session: int | None = None) -> FtpPacket:
        """The answer to this request that says yes."""
        session = self.session if session is None else session
        sequence, opcode = self.sequence + 1 & 0xFFFF, MavFtpOpcode.ACK
        return FtpPacket(
            sequence,
            opcode,
            session,
            len(data),
            self.opcode,
            offset=offset & 0xFFFFFFFF,
            data=data,
            client=self.client,
        )

    def refuse(self, code: int, errno: int | None = None) -> FtpPacket:
        """The answer to this request that says no."""
        data = bytes([code]) if errno is None else bytes([code, errno])
        return self.acknowledge(data).replace(opcode=MavFtpOpcode.NAK)

    def refuse_errno(self, errno: int) -> FtpPacket:
        """The same for what the file system says: two numbers have error codes of their own."""
        own = {EEXIST: MavFtpErr.FILEEXISTS, ENOENT: MavFtpErr.FILENOTFOUND}.get(errno)
        return self.refuse(MavFtpErr.FAILERRNO, errno) if own is None else self.refuse(own)


class FileHost(Protocol):
    """Who serves files: a vehicle, or a device beside its autopilot."""

    faults: Faults

    @property
    def now(self) -> float:
        """Simulated seconds."""
        raise NotImplementedError

    def on(self, message_class: type[Message], handler: Callable[[Any, Channel], None]) -> None:
        """Hear such messages."""

    def send(self, message: Message, channel: Channel | None = None) -> None:
        """Send on one channel, or on all."""

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT."""

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        """Do something at this time."""

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Do something after ``delay`` seconds."""


class FtpServer:
    """Hears requests and answers; an autopilot's own class says how.

    ``no_ftp`` of the vehicle's faults makes it deaf.
    """

    def __init__(self, vehicle: FileHost, files: FileTree) -> None:
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
