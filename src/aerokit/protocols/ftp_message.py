"""MAVFTP on the wire: what is in the payload of FILE_TRANSFER_PROTOCOL, its numbers, and its errors in words.

See https://mavlink.io/en/services/ftp.html.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from aerokit.errors import FileError, InvalidArgument
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "DATA_SIZE",
    "PATH_SIZE",
    "FtpMessage",
    "file_error",
    "path_bytes",
]

DATA_SIZE = 239
"""Bytes of data in one message at most."""
PATH_SIZE = DATA_SIZE - 1
"""Bytes of a path at most: both ArduPilot and PX4 overwrite the last byte of a longer one with their NUL."""
HEADER = struct.Struct("<HBBBBBxI")
PAYLOAD_SIZE = HEADER.size + DATA_SIZE


CODES: dict[int, str] = {
    MavFtpErr.NONE: "no reason given",
    MavFtpErr.FAIL: "it failed, no reason given",
    MavFtpErr.FAILERRNO: "it failed",
    MavFtpErr.INVALIDDATASIZE: "the size of the data is not valid",
    MavFtpErr.INVALIDSESSION: "no file is open in this session, or another program has one open",
    MavFtpErr.NOSESSIONSAVAILABLE: "another program has a file open, or left one open",
    MavFtpErr.EOF: "end of file",
    MavFtpErr.UNKNOWNCOMMAND: "the vehicle does not know this operation",
    MavFtpErr.FILEEXISTS: "it exists already",
    MavFtpErr.FILEPROTECTED: "it is write protected",
    MavFtpErr.FILENOTFOUND: "no such file or directory",
}
ERRNOS = {
    1: ("EPERM", "not permitted"),
    2: ("ENOENT", "no such file or directory"),
    5: ("EIO", "input or output error"),
    9: ("EBADF", "the file is not open for that"),
    11: ("EAGAIN", "not now, try again"),
    12: ("ENOMEM", "out of memory"),
    13: ("EACCES", "permission denied"),
    16: ("EBUSY", "busy"),
    17: ("EEXIST", "it exists already"),
    19: ("ENODEV", "no such device"),
    20: ("ENOTDIR", "not a directory"),
    21: ("EISDIR", "it is a directory"),
    22: ("EINVAL", "not valid"),
    23: ("ENFILE", "too many open files"),
    24: ("EMFILE", "too many open files"),
    27: ("EFBIG", "the file is too large"),
    28: ("ENOSPC", "no space left"),
    30: ("EROFS", "read-only file system"),
    36: ("ENAMETOOLONG", "the name is too long"),
    38: ("ENOSYS", "not implemented"),
    39: ("ENOTEMPTY", "the directory is not empty"),
    88: ("ENOSYS", "not implemented"),
    90: ("ENOTEMPTY", "the directory is not empty"),
    91: ("ENAMETOOLONG", "the name is too long"),
    95: ("EOPNOTSUPP", "not supported"),
}
"""Of Linux, NuttX and newlib, which agree in the small numbers."""

OPERATIONS: dict[int, str] = {
    MavFtpOpcode.TERMINATESESSION: "close",
    MavFtpOpcode.RESETSESSION: "reset sessions",
    MavFtpOpcode.LISTDIRECTORY: "list",
    MavFtpOpcode.OPENFILERO: "open for reading",
    MavFtpOpcode.READFILE: "read",
    MavFtpOpcode.CREATEFILE: "create",
    MavFtpOpcode.WRITEFILE: "write",
    MavFtpOpcode.REMOVEFILE: "remove",
    MavFtpOpcode.CREATEDIRECTORY: "make directory",
    MavFtpOpcode.REMOVEDIRECTORY: "remove directory",
    MavFtpOpcode.OPENFILEWO: "open for writing",
    MavFtpOpcode.TRUNCATEFILE: "truncate",
    MavFtpOpcode.RENAME: "rename",
    MavFtpOpcode.CALCFILECRC: "compute CRC-32",
    MavFtpOpcode.BURSTREADFILE: "burst read",
}


class FtpMessage(Snapshot):
    """The payload of one FILE_TRANSFER_PROTOCOL message, a request or a reply.

    ``size`` is that of ``data``, except in READFILE and BURSTREADFILE, where it says how much is wanted.
    """

    sequence: int
    opcode: int
    session: int = 0
    size: int = 0
    request_opcode: int = 0
    burst_complete: bool = False
    offset: int = 0
    data: bytes = b""

    @classmethod
    def decode(cls, payload: bytes, *, cut: bool = True) -> Self:
        """Read a payload; ``data`` is cut to ``size``, or all 239 bytes. Never raises for bytes off the air."""
        payload = payload.ljust(PAYLOAD_SIZE, b"\0")
        sequence, session, opcode, size, request_opcode, burst_complete, offset = HEADER.unpack_from(payload)
        data = payload[HEADER.size : HEADER.size + size if cut else PAYLOAD_SIZE]
        return cls(sequence, opcode, session, size, request_opcode, burst_complete != 0, offset, data)

    def encode(self) -> bytes:
        """The 251 bytes of the payload."""
        head = HEADER.pack(
            self.sequence,
            self.session,
            self.opcode,
            self.size,
            self.request_opcode,
            self.burst_complete,
            self.offset,
        )
        return (head + self.data).ljust(PAYLOAD_SIZE, b"\0")

    @property
    def is_ack(self) -> bool:
        """Whether it is the answer to a request that was carried out."""
        return self.opcode == MavFtpOpcode.ACK

    @property
    def error_code(self) -> int:
        """The reason of a NAK, a MAV_FTP_ERR; FAIL when it gives none."""
        return self.data[0] if self.data else MavFtpErr.FAIL

    @property
    def errno(self) -> int | None:
        """The system's error number behind FAILERRNO."""
        return self.data[1] if len(self.data) > 1 and self.data[0] == MavFtpErr.FAILERRNO else None


def path_bytes(path: str) -> bytes:
    """A path as it is sent.

    Raises:
        InvalidArgument: it is empty, not text that UTF-8 can encode, has a NUL, or is longer than 238 bytes.
    """
    if not isinstance(path, str):
        raise InvalidArgument(f"path = {path!r} is not allowed: text")
    try:
        encoded = path.encode()
    except UnicodeEncodeError:
        raise InvalidArgument(f"path = {path!r} is not allowed: text that UTF-8 can encode") from None
    if not encoded or b"\0" in encoded:
        raise InvalidArgument(f"path = {path!r} is not allowed: not empty, without NUL")
    if len(encoded) > PATH_SIZE:
        raise InvalidArgument(
            f"path = {path!r} is not allowed: {len(encoded)} bytes, one message has room for {PATH_SIZE}"
        )
    return encoded


def file_error(request_opcode: int, path: str, code: int, errno: int | None) -> FileError:
    """The error for a NAK: operation, path, and the reason by name and in words."""
    operation = OPERATIONS.get(request_opcode, f"operation {request_opcode}")
    text = CODES.get(code, "not known to the standard")
    name = MavFtpErr(code).name if code in CODES else f"code {code}"
    if errno is not None:
        errno_name, text = ERRNOS.get(errno, (f"errno {errno}", text))
        name = f"{name}, {errno_name}"
    return FileError(f"{operation} {path}: {text} ({name})", path=path, code=code, errno=errno)
