"""MAVFTP (https://mavlink.io/en/services/ftp.html): one request until its answer, and what all exchanges of it share.

A request that is sent again keeps its sequence number: the servers keep their last reply and give it again, so that
nothing is done twice. A new request gets a new number.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from aerokit.errors import FileError, FileTimeout
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.ftp_message import (
    DATA_SIZE,
    OPERATIONS,
    FtpMessage,
    file_error,
    path_bytes,
)
from aerokit.protocols.transfer import PATIENCE_S, OnProgress, Transfer

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.round_trip import RoundTrip

__all__ = [
    "DATA_SIZE",
    "FtpClient",
    "FtpExchange",
    "FtpMessage",
    "FtpRequest",
    "FtpSessionLost",
    "path_bytes",
]

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
