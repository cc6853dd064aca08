"""MAVFTP messages, errors and single requests (https://mavlink.io/en/services/ftp.html).

A retried request keeps its sequence number. A server stores its last reply, and repeats it if it receives the same
number again, so that no operation is executed twice. A new request gets a new number.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import FileError, FileTimeout, InvalidArgument
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.exchange import Transfer, TransferOptions, is_addressed_to

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack

    from aerokit.mavlink.message import Message

__all__ = [
    "DATA_SIZE",
    "PATH_SIZE",
    "FtpClient",
    "FtpExchange",
    "FtpMessage",
    "FtpRequest",
    "FtpSessionLost",
    "crc32",
    "file_error",
    "path_bytes",
]

DATA_SIZE = 239
"""Maximum number of data bytes in one message."""

PATH_SIZE = DATA_SIZE - 1
"""Maximum number of bytes of a path. ArduPilot and PX4 overwrite the last byte of a longer path with NUL."""

HEADER = struct.Struct("<HBBBBBxI")

PAYLOAD_SIZE = HEADER.size + DATA_SIZE

CODES: dict[int, str] = {
    MavFtpErr.NONE: "no reason given",
    MavFtpErr.FAIL: "the operation failed, no reason given",
    MavFtpErr.FAILERRNO: "the operation failed",
    MavFtpErr.INVALIDDATASIZE: "invalid data size",
    MavFtpErr.INVALIDSESSION: "no file is open in this session, or another program has one open",
    MavFtpErr.NOSESSIONSAVAILABLE: "another program has a file open, or left one open",
    MavFtpErr.EOF: "end of file",
    MavFtpErr.UNKNOWNCOMMAND: "the vehicle does not support this operation",
    MavFtpErr.FILEEXISTS: "the file or directory already exists",
    MavFtpErr.FILEPROTECTED: "the file is write-protected",
    MavFtpErr.FILENOTFOUND: "no such file or directory",
}

# Names and texts of the error numbers that are the same on Linux, NuttX and newlib.
ERRNOS = {
    1: ("EPERM", "operation not permitted"),
    2: ("ENOENT", "no such file or directory"),
    5: ("EIO", "input/output error"),
    9: ("EBADF", "the file is not open for this operation"),
    11: ("EAGAIN", "temporarily unavailable, try again"),
    12: ("ENOMEM", "out of memory"),
    13: ("EACCES", "permission denied"),
    16: ("EBUSY", "busy"),
    17: ("EEXIST", "the file or directory already exists"),
    19: ("ENODEV", "no such device"),
    20: ("ENOTDIR", "not a directory"),
    21: ("EISDIR", "the path is a directory"),
    22: ("EINVAL", "invalid argument"),
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

    ``size`` is the length of ``data``. In READFILE and BURSTREADFILE requests, it is the number of bytes requested.
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
        """Decode a payload without validating it.

        With ``cut``, the field ``data`` of the result has ``size`` bytes, otherwise all 239 bytes of the payload. A
        short payload is padded with zeros.
        """
        payload = payload.ljust(PAYLOAD_SIZE, b"\0")
        sequence, session, opcode, size, request_opcode, burst_complete, offset = HEADER.unpack_from(payload)
        data_end = HEADER.size + size if cut else PAYLOAD_SIZE
        data = payload[HEADER.size : data_end]
        return cls(
            sequence, opcode, session=session, size=size, request_opcode=request_opcode,
            burst_complete=burst_complete != 0, offset=offset, data=data,
        )  # fmt: skip

    def encode(self) -> bytes:
        """Return the payload of the FILE_TRANSFER_PROTOCOL message: 251 bytes."""
        head = HEADER.pack(
            self.sequence, self.session, self.opcode, self.size, self.request_opcode, self.burst_complete, self.offset
        )
        return (head + self.data).ljust(PAYLOAD_SIZE, b"\0")

    @property
    def is_ack(self) -> bool:
        return self.opcode == MavFtpOpcode.ACK

    @property
    def error_code(self) -> int:
        """The MAV_FTP_ERR in a NAK; FAIL if the NAK has no error code."""
        return self.data[0] if self.data else MavFtpErr.FAIL

    @property
    def errno(self) -> int | None:
        """The error number of the vehicle's operating system, if the error is FAILERRNO."""
        return self.data[1] if len(self.data) > 1 and self.data[0] == MavFtpErr.FAILERRNO else None


def crc32(data: bytes, previous_crc: int = 0) -> int:
    """Return the checksum of CalcFileCRC32: CRC-32 without the inversions of the start value and the result."""
    return zlib.crc32(data, previous_crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def path_bytes(path: str) -> bytes:
    """Encode a path for a request.

    Raises:
        InvalidArgument: the path is empty, not encodable as UTF-8, contains NUL, or is longer than 238 bytes.
    """
    if not isinstance(path, str):
        raise InvalidArgument(f"path = {path!r} is not allowed: it must be a string")
    try:
        encoded = path.encode()
    except UnicodeEncodeError:
        raise InvalidArgument(f"path = {path!r} cannot be encoded as UTF-8") from None
    if not encoded or b"\0" in encoded:
        raise InvalidArgument(f"path = {path!r} is not allowed: it must be a non-empty string without NUL")
    if len(encoded) > PATH_SIZE:
        raise InvalidArgument(
            f"path = {path!r} is not allowed: it has {len(encoded)} bytes, but at most {PATH_SIZE} fit into a message"
        )
    return encoded


def file_error(request_opcode: int, path: str, code: int, errno: int | None) -> FileError:
    """Create the error for a NAK. ``code`` is its MAV_FTP_ERR, ``errno`` the error number of a FAILERRNO."""
    operation = OPERATIONS.get(request_opcode, f"operation {request_opcode}")
    text = CODES.get(code, "unknown error code")
    name = MavFtpErr(code).name if code in CODES else f"code {code}"
    if errno is not None:
        errno_name, text = ERRNOS.get(errno, (f"errno {errno}", text))
        name = f"{name}, {errno_name}"
    return FileError(f"{operation} {path}: {text} ({name})", path=path, code=code, errno=errno)


ResultT = TypeVar("ResultT")

SEQUENCE_COUNT = 0x10000

MAX_SESSION = 255

# The vehicle reads or saves a whole file before it answers these requests, so they do not measure the round trip.
SLOW_REQUESTS = (MavFtpOpcode.CALCFILECRC, MavFtpOpcode.TERMINATESESSION)
SLOW_ANSWER_S = 0.25

# Maximum number of times that a request gets a new sequence number.
MAX_RENUMBERED = 3

# Retries back off after this many attempts. Fewer failures may be caused by single frames that a radio has lost.
ATTEMPTS_BEFORE_BACKOFF = 3

SESSION_OPCODES = (MavFtpOpcode.READFILE, MavFtpOpcode.WRITEFILE, MavFtpOpcode.BURSTREADFILE)

# Errors that may mean "no file is open". PX4 answers INVALIDSESSION, ArduPilot FILENOTFOUND. After one FILEEXISTS, PX4
# sends FILEEXISTS instead of any other error, until an operation fails with an errno.
NO_SESSION_ERRORS = (MavFtpErr.INVALIDSESSION, MavFtpErr.FILENOTFOUND, MavFtpErr.FILEEXISTS)


class FtpSessionLost(FileError):
    """The vehicle has closed the file, e.g. because of another program, its own time-out, or a reboot."""


class FtpClient:
    """State shared by all exchanges of one client with one server: addresses, sequence and session numbers.

    ``first_sequence`` should differ between programs, because a server repeats its last reply if a request has the same
    sequence number as the request before it.
    """

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        source_system: int,
        source_component: int,
        first_sequence: int = 0,
    ) -> None:
        self.target_system: int = target_system
        self.target_component: int = target_component
        self.source_system: int = source_system
        self.source_component: int = source_component
        self._sequence = first_sequence
        # Like the sequence numbers, the session numbers of two programs should differ. `next_session` uses 8 bits.
        self._session = first_sequence

    def next_sequence(self, replies: int = 1) -> int:
        """Return the sequence number of a new request.

        ``replies`` replies are expected, with the numbers that follow. The next request has the number of the last
        reply.
        """
        sequence = self._sequence % SEQUENCE_COUNT
        self._sequence = sequence + replies
        return sequence

    def next_session(self) -> int:
        """Return a new session number, 1–255. ArduPilot uses this number; PX4 answers with its own number, always 0."""
        self._session = self._session % MAX_SESSION + 1
        return self._session

    def message(self, request: FtpMessage) -> FileTransferProtocol:
        """Wrap a request into a MAVLink message to the server."""
        return FileTransferProtocol(
            target_network=0,
            target_system=self.target_system,
            target_component=self.target_component,
            payload=request.encode(),
        )

    def is_for_us(self, message: FileTransferProtocol) -> bool:
        """Return True if the message is addressed to this client or to all."""
        return is_addressed_to(message, self.source_system, self.source_component)


class FtpExchange(Transfer[ResultT]):
    """Base class of requests, downloads and uploads."""

    expects: tuple[type[Message], ...] = (FileTransferProtocol,)

    def __init__(self, client: FtpClient, path: str, **options: Unpack[TransferOptions]) -> None:
        super().__init__(client.target_system, client.target_component, **options)
        self._client, self._path = client, path

    def receive(self, message: Message, now: float) -> None:
        """Process a message. Only replies of this server to this client count; all others are ignored."""
        if self.done or not isinstance(message, FileTransferProtocol):
            return
        if self._is_from_target(message) and self._client.is_for_us(message):
            reply = FtpMessage.decode(message.payload)
            if reply.opcode in (MavFtpOpcode.ACK, MavFtpOpcode.NAK):
                self._receive_reply(reply, now)

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        raise NotImplementedError

    def _send(self, request: FtpMessage) -> None:
        self._outbox.append(self._client.message(request))

    def _refused(self, reply: FtpMessage) -> FileError:
        error = file_error(reply.request_opcode, self._path, reply.error_code, reply.errno)
        if reply.request_opcode in SESSION_OPCODES and error.code in NO_SESSION_ERRORS:
            return FtpSessionLost(str(error), path=error.path, code=error.code)
        return error


class FtpRequest(FtpExchange[FtpMessage]):
    """One request with a single reply. The result is the ACK.

    Args:
        path: used in error texts.
        sent_by_caller: True if the caller makes the first transmission. The exchange only repeats the request.
    """

    attempts: int

    # start() sets this attribute.
    _sent_at: float

    def __init__(
        self,
        client: FtpClient,
        opcode: MavFtpOpcode,
        *,
        path: str,
        session: int = 0,
        offset: int = 0,
        data: bytes = b"",
        sent_by_caller: bool = False,
        **options: Unpack[TransferOptions],
    ) -> None:
        super().__init__(client, path, **options)
        self.attempts = 0
        """Number of times the request was sent, including the first one by the caller, which `start` counts."""
        self._request = FtpMessage(
            client.next_sequence(), opcode, session=session, size=len(data), offset=offset, data=data
        )
        self._sent_by_caller = sent_by_caller
        self._renumbered = 0  # number of times the request got a new sequence number

    @property
    def message(self) -> FileTransferProtocol:
        return self._client.message(self._request)

    @property
    def path(self) -> str:
        return self._path

    @property
    def session(self) -> int:
        return self._request.session

    @property
    def is_answered(self) -> bool:
        """True if the vehicle acknowledged the request."""
        return self._result is not None

    def _begin(self, now: float) -> None:
        """Start the exchange: send the request, unless the caller sends it (``sent_by_caller``)."""
        self._transmit(now)
        if self._sent_by_caller:
            self._outbox.clear()

    def expire(self, now: float) -> None:
        if self._is_idle(now):
            self._fail(FileTimeout(f"{self._operation} {self._path}: no answer to {self.attempts} requests"))
        else:
            self._transmit(now)

    def _transmit(self, now: float) -> None:
        self.attempts += 1
        self._sent_at = now
        self._outbox.append(self.message)
        self._wait(now)

    def _wait(self, now: float) -> None:
        timeout_s = self.round_trip.timeout_s(max(1, self.attempts - ATTEMPTS_BEFORE_BACKOFF))
        if self._request.opcode == MavFtpOpcode.CALCFILECRC:
            timeout_s += SLOW_ANSWER_S * (self.attempts - 1)
        self._wait_until(now + timeout_s)

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.sequence != (self._request.sequence + 1) % SEQUENCE_COUNT:
            self._on_reply_to_other_request(reply, now)
        elif reply.request_opcode != self._request.opcode:  # The server has repeated its reply to an earlier request.
            self._renumber(now)
        else:
            if self.attempts == 1 and self._request.opcode not in SLOW_REQUESTS:
                self.round_trip.add_sample(now - self._sent_at)
            self._finish_or_fail(reply)

    def _renumber(self, now: float) -> None:
        """Send the request with a new sequence number, so that the server executes it."""
        # An earlier request had the same number, so the server took this request for a repetition of the earlier one.
        if self._renumbered < MAX_RENUMBERED:
            self._renumbered += 1
            self._request = self._request.replace(sequence=self._client.next_sequence())
            self._sent_at = now
            self._outbox.append(self.message)
            self._wait(now)

    def _on_reply_to_other_request(self, reply: FtpMessage, now: float) -> None:
        # ArduPilot answers TERMINATESESSION only after the current burst, so the blocks of the burst count as progress.
        if self._request.opcode == MavFtpOpcode.TERMINATESESSION and reply.session == self._request.session:
            self._progress_at = now
            self._wait(now)

    def _finish_or_fail(self, reply: FtpMessage) -> None:
        if reply.is_ack or self._is_already_done(reply):
            self._finish(reply)
        else:
            self._fail(self._refused(reply))

    def _is_already_done(self, reply: FtpMessage) -> bool:
        opcode = self._request.opcode
        if opcode == MavFtpOpcode.TERMINATESESSION:
            # A refusal means that the session is not open. PX4 has several errors for this; see `NO_SESSION_ERRORS`.
            return True
        if self.attempts == 1:
            return False
        # An earlier transmission may have been executed although its answer was lost. The file is then already removed,
        # or the directory already created.
        if opcode in (MavFtpOpcode.REMOVEFILE, MavFtpOpcode.REMOVEDIRECTORY):
            return reply.error_code == MavFtpErr.FILENOTFOUND
        return opcode == MavFtpOpcode.CREATEDIRECTORY and reply.error_code == MavFtpErr.FILEEXISTS

    @property
    def _operation(self) -> str:
        return OPERATIONS.get(self._request.opcode, "request")
