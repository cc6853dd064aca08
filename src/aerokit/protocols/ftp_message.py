"""MAVFTP on the wire: what is in the payload of FILE_TRANSFER_PROTOCOL, its numbers, and its errors in words.

See https://mavlink.io/en/services/ftp.html.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from aerokit.errors import FileError, LocalProtocolError
from aerokit.snapshot import Snapshot

__all__ = [
    "DATA_SIZE",
    "PATH_SIZE",
    "FtpErrorCode",
    "FtpMessage",
    "FtpOpcode",
    "file_error",
    "path_bytes",
]

DATA_SIZE = 239
"""Bytes of data in one message at most."""
PATH_SIZE = DATA_SIZE - 1
"""Bytes of a path at most: both ArduPilot and PX4 overwrite the last byte of a longer one with their NUL."""
HEADER = struct.Struct("<HBBBBBxI")
PAYLOAD_SIZE = HEADER.size + DATA_SIZE


class FtpOpcode(IntEnum):
    """What a message asks for or answers (https://mavlink.io/en/services/ftp.html#opcodes)."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


class FtpErrorCode(IntEnum):
    """Why a request was refused (https://mavlink.io/en/services/ftp.html#error_codes)."""

    NONE = 0
    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    EOF = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


CODES: dict[int, str] = {
    FtpErrorCode.NONE: "no reason given",
    FtpErrorCode.FAIL: "it failed, no reason given",
    FtpErrorCode.FAIL_ERRNO: "it failed",
    FtpErrorCode.INVALID_DATA_SIZE: "the size of the data is not valid",
    FtpErrorCode.INVALID_SESSION: "no file is open in this session, or another program has one open",
    FtpErrorCode.NO_SESSIONS_AVAILABLE: "another program has a file open, or left one open",
    FtpErrorCode.EOF: "end of file",
    FtpErrorCode.UNKNOWN_COMMAND: "the vehicle does not know this operation",
    FtpErrorCode.FILE_EXISTS: "it exists already",
    FtpErrorCode.FILE_PROTECTED: "it is write protected",
    FtpErrorCode.FILE_NOT_FOUND: "no such file or directory",
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
    39: ("ENOTEMPTY", "the directory is not empty"),
    88: ("ENOSYS", "not implemented"),
    90: ("ENOTEMPTY", "the directory is not empty"),
    91: ("ENAMETOOLONG", "the name is too long"),
    95: ("EOPNOTSUPP", "not supported"),
}
"""Of Linux, NuttX and newlib, which agree in the small numbers."""

OPERATIONS: dict[int, str] = {
    FtpOpcode.TERMINATE_SESSION: "close",
    FtpOpcode.RESET_SESSIONS: "reset sessions",
    FtpOpcode.LIST_DIRECTORY: "list",
    FtpOpcode.OPEN_FILE_RO: "open for reading",
    FtpOpcode.READ_FILE: "read",
    FtpOpcode.CREATE_FILE: "create",
    FtpOpcode.WRITE_FILE: "write",
    FtpOpcode.REMOVE_FILE: "remove",
    FtpOpcode.CREATE_DIRECTORY: "make directory",
    FtpOpcode.REMOVE_DIRECTORY: "remove directory",
    FtpOpcode.OPEN_FILE_WO: "open for writing",
    FtpOpcode.TRUNCATE_FILE: "truncate",
    FtpOpcode.RENAME: "rename",
    FtpOpcode.CALC_FILE_CRC32: "compute CRC-32",
    FtpOpcode.BURST_READ_FILE: "burst read",
}


class FtpMessage(Snapshot):
    """The payload of one FILE_TRANSFER_PROTOCOL message, a request or a reply.

    ``size`` is that of ``data``, except in READ_FILE and BURST_READ_FILE, where it says how much is wanted.
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
    def decode(cls, payload: bytes) -> FtpMessage:
        """Read a payload; ``data`` is cut to ``size``. Never raises for bytes off the air."""
        payload = payload.ljust(PAYLOAD_SIZE, b"\0")
        sequence, session, opcode, size, request_opcode, burst_complete, offset = HEADER.unpack_from(payload)
        data = payload[HEADER.size : HEADER.size + size]
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
        return self.opcode == FtpOpcode.ACK

    @property
    def error_code(self) -> int:
        """The reason of a NAK, one of :class:`FtpErrorCode`; FAIL when it gives none."""
        return self.data[0] if self.data else FtpErrorCode.FAIL

    @property
    def errno(self) -> int | None:
        """The system's error number behind FAIL_ERRNO."""
        return self.data[1] if len(self.data) > 1 and self.data[0] == FtpErrorCode.FAIL_ERRNO else None


def path_bytes(path: str) -> bytes:
    """A path as it is sent.

    Raises:
        LocalProtocolError: it is empty, not text that UTF-8 can encode, has a NUL, or is longer than 238 bytes.
    """
    if not isinstance(path, str):
        raise LocalProtocolError(f"path = {path!r} is not allowed: text")
    try:
        encoded = path.encode()
    except UnicodeEncodeError:
        raise LocalProtocolError(f"path = {path!r} is not allowed: text that UTF-8 can encode") from None
    if not encoded or b"\0" in encoded:
        raise LocalProtocolError(f"path = {path!r} is not allowed: not empty, without NUL")
    if len(encoded) > PATH_SIZE:
        raise LocalProtocolError(
            f"path = {path!r} is not allowed: {len(encoded)} bytes, one message has room for {PATH_SIZE}"
        )
    return encoded


def file_error(request_opcode: int, path: str, code: int, errno: int | None) -> FileError:
    """The error for a NAK: operation, path, and the reason by name and in words."""
    operation = OPERATIONS.get(request_opcode, f"operation {request_opcode}")
    text = CODES.get(code, "not known to the standard")
    name = FtpErrorCode(code).name if code in CODES else f"code {code}"
    if errno is not None:
        errno_name, text = ERRNOS.get(errno, (f"errno {errno}", text))
        name = f"{name}, {errno_name}"
    return FileError(f"{operation} {path}: {text} ({name})", path=path, code=code, errno=errno)
