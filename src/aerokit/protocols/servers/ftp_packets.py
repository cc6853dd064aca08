"""MAVFTP packets, and checksums of files (https://mavlink.io/en/services/ftp.html)."""

from __future__ import annotations

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.ftp import FtpMessage
from aerokit.protocols.servers.files import EEXIST, ENOENT
from aerokit.protocols.servers.host import ComponentIds, sender_of


class FtpPacket(FtpMessage):
    """Payload of a FILE_TRANSFER_PROTOCOL message, and the client that the message is from or for.

    In a request, ``data`` always has 239 bytes.
    """

    client: ComponentIds = ComponentIds()

    @classmethod
    def parse(cls, message: FileTransferProtocol) -> FtpPacket:
        return cls.decode(message.payload, cut=False).replace(client=sender_of(message))

    def repeats(self, other: FtpPacket) -> bool:
        fields = ("client", "sequence", "session", "opcode", "offset", "size")
        are_equal = all(getattr(self, field) == getattr(other, field) for field in fields)
        return are_equal and self.data[: self.size] == other.data[: other.size]

    def message(self) -> FileTransferProtocol:
        target_network = 0
        return FileTransferProtocol(target_network, *self.client, self.encode())

    def acknowledge(self, data: bytes = b"", *, offset: int = 0, session: int | None = None) -> FtpPacket:
        return FtpPacket(
            sequence=(self.sequence + 1) & 0xFFFF, opcode=MavFtpOpcode.ACK,
            session=self.session if session is None else session, size=len(data), request_opcode=self.opcode,
            offset=offset & 0xFFFFFFFF, data=data, client=self.client,
        )  # fmt: skip

    def refuse(self, code: int, errno: int | None = None) -> FtpPacket:
        data = bytes([code]) if errno is None else bytes([code, errno])
        return self.acknowledge(data).replace(opcode=MavFtpOpcode.NAK)

    def refuse_errno(self, errno: int) -> FtpPacket:
        separate_code = {EEXIST: MavFtpErr.FILEEXISTS, ENOENT: MavFtpErr.FILENOTFOUND}.get(errno)
        return self.refuse(MavFtpErr.FAILERRNO, errno) if separate_code is None else self.refuse(separate_code)


def path_in(data: bytes) -> str:
    return data.partition(b"\0")[0].decode("utf-8", "replace")


class Refused(Exception):
    """A request that the server refuses; ``code`` is the MAV_FTP_ERR."""

    def __init__(self, code: int) -> None:
        self.code = code


def checked_path(data: bytes) -> str:
    """Return the path of a request. Raises Refused if it contains ``..``."""
    path = path_in(data)
    if ".." in path.split("/"):
        raise Refused(MavFtpErr.FILEPROTECTED)
    return path
