"""MAVFTP on the wire: what is in the payload of FILE_TRANSFER_PROTOCOL, its numbers, and its errors in words.

See https://mavlink.io/en/services/ftp.html.

A request that is sent again keeps its sequence number: the servers keep their last reply and give it again, so that
nothing is done twice. A new request gets a new number.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import FileError, FileTimeout, InvalidArgument
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.exchange import PATIENCE_S, OnProgress, Transfer

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.mavlink.message import Message
    from aerokit.protocols.exchange import RoundTrip

__all__ = [
    "DATA_SIZE",
    "PATH_SIZE",
    "FtpClient",
    "FtpExchange",
    "FtpMessage",
    "FtpRequest",
    "FtpSessionLost",
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


ResultT = TypeVar("ResultT")

SEQUENCES = 0x10000

SESSIONS = 255

SLOW_REQUESTS = (MavFtpOpcode.CALCFILECRC, MavFtpOpcode.TERMINATESESSION)
"""The vehicle reads a whole file, or takes over what was written to it, before it answers."""

SLOW_ANSWER_S = 0.25

MOST_RENUMBERED = 3

STEADY = 3
"""So often it is sent again before that happens ever more rarely: radios lose single frames."""

NEED_SESSION = (MavFtpOpcode.READFILE, MavFtpOpcode.WRITEFILE, MavFtpOpcode.BURSTREADFILE)

NO_SESSION = (MavFtpErr.INVALIDSESSION, MavFtpErr.FILENOTFOUND, MavFtpErr.FILEEXISTS)
"""What they are answered when no file is open: by PX4, by ArduPilot, and by a PX4 that has said once that a file exists
already: it says so of whatever it refuses until another operation fails in the system.
"""


class FtpSessionLost(FileError):
    """The vehicle has closed the file: another program's session, its own time-out, or a reboot."""


class FtpClient:
    """What the exchanges of one client with one server share: addresses, sequence numbers, session numbers.

    ``first_sequence`` should differ from program to program: the servers answer a request that has the number of the
    one before with the reply of the one before.
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
        self._session = first_sequence

    def next_sequence(self, replies: int = 1) -> int:
        """The number of a new request. ``replies``: at most so many numbers after it are used in its replies."""
        sequence = self._sequence % SEQUENCES
        self._sequence = sequence + replies
        return sequence

    def next_session(self) -> int:
        """The number of a new session, 1–255. ArduPilot takes it; PX4 answers with its own, which is always 0."""
        self._session = self._session % SESSIONS + 1
        return self._session

    def message(self, request: FtpMessage) -> FileTransferProtocol:
        """The request as a message to the server."""
        return FileTransferProtocol(0, self.target_system, self.target_component, request.encode())

    def is_for_us(self, message: FileTransferProtocol) -> bool:
        """Whether it is addressed to us; servers may leave the address out."""
        return message.target_system in (0, self.source_system) and message.target_component in (
            0,
            self.source_component,
        )


class FtpExchange(Transfer[ResultT]):
    """What one request, a download and an upload have in common."""

    expects: tuple[type[Message], ...] = (FileTransferProtocol,)

    def __init__(
        self,
        client: FtpClient,
        path: str,
        *,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
        on_progress: OnProgress | None = None,
    ) -> None:
        super().__init__(
            client.target_system,
            client.target_component,
            round_trip=round_trip,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        self._client, self._path = client, path

    def receive(self, message: Message, now: float) -> None:
        """Take a message; replies of this server to us are looked at."""
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
        if reply.request_opcode in NEED_SESSION and error.code in NO_SESSION:
            return FtpSessionLost(str(error), path=error.path, code=error.code)
        return error


class FtpRequest(FtpExchange[FtpMessage]):
    """One request and its answer, for everything that takes one message: the result is the ACK.

    Args:
        path: for the texts of errors.
        is_sent: it was sent already, outside of this exchange.
    """

    attempts: int

    # from start() on
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
        is_sent: bool = False,
        round_trip: RoundTrip | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        super().__init__(client, path, round_trip=round_trip, patience_s=patience_s)
        self.attempts = 0
        """How often it was sent."""
        self._request = FtpMessage(
            client.next_sequence(), opcode, session=session, size=len(data), offset=offset, data=data
        )
        self._is_sent = is_sent
        self._renumbered = 0

    @property
    def message(self) -> FileTransferProtocol:
        """The request as it is sent."""
        return self._client.message(self._request)

    @property
    def path(self) -> str:
        """What it is about."""
        return self._path

    @property
    def session(self) -> int:
        """The session that it names."""
        return self._request.session

    @property
    def is_answered(self) -> bool:
        """Whether it was carried out."""
        return self._result is not None

    def start(self, now: float) -> None:
        """Send it, unless that was done."""
        self._begin(now)
        self._transmit(now)
        if self._is_sent:
            self._outbox.clear()

    def expire(self, now: float) -> None:
        """Send it again, or give up."""
        if self._is_out_of_patience(now):
            self._fail(FileTimeout(f"{self._operation} {self._path}: no answer to {self.attempts} requests"))
        else:
            self._transmit(now)

    def _transmit(self, now: float) -> None:
        self.attempts += 1
        self._sent_at = now
        self._outbox.append(self.message)
        self._wait(now)

    def _wait(self, now: float) -> None:
        timeout_s = self.round_trip.timeout_s(max(1, self.attempts - STEADY))
        if self._request.opcode == MavFtpOpcode.CALCFILECRC:
            timeout_s += SLOW_ANSWER_S * (self.attempts - 1)
        self.deadline: float | None = min(now + timeout_s, self._moved_at + self._patience_s)

    def _receive_reply(self, reply: FtpMessage, now: float) -> None:
        if reply.sequence != (self._request.sequence + 1) % SEQUENCES:
            self._receive_other(reply, now)
        elif reply.request_opcode != self._request.opcode:
            self._renumber(now)
        else:
            if self.attempts == 1 and self._request.opcode not in SLOW_REQUESTS:
                self.round_trip.measured(now - self._sent_at)
            self._end(reply)

    def _renumber(self, now: float) -> None:
        """The server took it for the request before, which had the same number, and gave that one's reply again."""
        if self._renumbered < MOST_RENUMBERED:
            self._renumbered += 1
            self._request = self._request.replace(sequence=self._client.next_sequence())
            self._sent_at = now
            self._outbox.append(self.message)
            self._wait(now)

    def _receive_other(self, reply: FtpMessage, now: float) -> None:
        """ArduPilot finishes a burst before it looks at the next request."""
        if self._request.opcode == MavFtpOpcode.TERMINATESESSION and reply.session == self._request.session:
            self._moved_at = now
            self._wait(now)

    def _end(self, reply: FtpMessage) -> None:
        if reply.is_ack or self._is_done_before(reply):
            self._finish(reply)
        else:
            self._fail(self._refused(reply))

    def _is_done_before(self, reply: FtpMessage) -> bool:
        """A NAK says that what was asked for is so already."""
        opcode, code = self._request.opcode, reply.error_code
        if opcode == MavFtpOpcode.TERMINATESESSION:
            return True  # there is no such session, or no longer
        if self.attempts == 1:
            return False  # else: an earlier sending did it, and its answer was lost
        if opcode in (MavFtpOpcode.REMOVEFILE, MavFtpOpcode.REMOVEDIRECTORY):
            return code == MavFtpErr.FILENOTFOUND
        return opcode == MavFtpOpcode.CREATEDIRECTORY and code == MavFtpErr.FILEEXISTS

    @property
    def _operation(self) -> str:
        return OPERATIONS.get(self._request.opcode, "request")
