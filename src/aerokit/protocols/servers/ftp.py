"""MAVFTP server with sessions (https://mavlink.io/en/services/ftp.html)."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.ftp import DATA_SIZE, crc32
from aerokit.protocols.servers.files import EFBIG, EINVAL, Entry, FileFault, FileHandle, FileSystem
from aerokit.protocols.servers.ftp_packets import FtpPacket, Refused, checked_path
from aerokit.protocols.servers.host import Channel, ServerHost

FilesT = TypeVar("FilesT", bound=FileSystem)


_BURST_BYTES = 35_000  # A burst ends after this number of bytes.
_BURST_BLOCKS = 24  # number of blocks that a burst sends at once
_CRC_PAUSE_S = 0.002  # pause in a checksum computation, to answer other requests
_MAX_SIZE = 0xFFFFFFFF  # maximum file size in bytes, because sizes and offsets have 32 bits in MAVFTP

Op = MavFtpOpcode


@dataclass(eq=False)
class FtpSession:
    """A file that a client has opened."""

    number: int
    file: FileHandle
    size: int
    is_writing: bool
    next_block: FtpPacket | None = field(default=None, repr=False)
    """Request for the next block of the running burst; None if none runs."""
    burst_sent: int = 0
    """Number of bytes that the current burst has sent."""


@dataclass(eq=False)
class ServedClient:
    """A client: its open files and its latest request."""

    channel: Channel
    sessions: dict[int, FtpSession] = field(default_factory=dict)
    used_at: float = 0.0
    errno: int = 0
    """Error number of the latest failed request; 0 if none failed."""
    request: FtpPacket | None = None
    """The latest request that was executed."""
    reply: FtpPacket | None = None
    checksum_request: FtpPacket | None = None
    """CalcFileCRC32 request that is being executed."""
    checksum_file: FileHandle | None = None
    """File of the latest CalcFileCRC32 request; closed when the checksum is complete."""

    @property
    def is_idle(self) -> bool:
        return not self.sessions and self.checksum_request is None


class SessionFtpServer(Generic[FilesT]):
    """MAVFTP server that answers immediately, with several sessions for each client.

    A session is closed when its client has sent nothing for ``session_timeout_s``. A burst sends ``burst`` blocks every
    ``burst_interval_s`` seconds, and none while ``is_congested()``. A burst ends after 35 kB, and the client must
    request the next burst. A single request with a forged sender therefore cannot cause a whole file to be sent.

    If a request is repeated, its stored reply is sent again. Replies with file content are not stored, but made anew.
    Subclasses for firmware that behaves differently override methods.
    """

    burst: int = _BURST_BLOCKS
    max_clients: ClassVar[int] = 16
    max_sessions: ClassVar[int] = 4
    """Maximum number of sessions of one client."""
    session_timeout_s: ClassVar[float] = 10.0
    list_prefix: ClassVar[tuple[bytes, ...]] = ()
    """Lines that each listing of a folder has before the folder's entries."""
    line_end: ClassVar[bytes] = b"\0"
    creates_missing: ClassVar[bool] = True
    """True if OpenFileWO creates a missing file."""
    max_stored_reply_size: ClassVar[int] = 4
    """Replies with more bytes of data than this are not stored. A stored reply answers a repeated request."""
    crc_block: ClassVar[int] = 65_536
    crc_blocks_at_once: ClassVar[int] = 8
    """Number of blocks of a file that are read for a checksum before the event loop continues."""

    def __init__(
        self,
        host: ServerHost,
        files: FilesT,
        *,
        burst_interval_s: float = 0.005,
        is_congested: Callable[[], bool] = lambda: False,
        is_enabled: Callable[[], bool] = lambda: True,
    ) -> None:
        self.files = files
        self._host = host
        self.burst_interval_s = burst_interval_s
        self._is_enabled = is_enabled
        self._is_congested = is_congested
        self._clients: dict[Hashable, ServedClient] = {}
        host.on(FileTransferProtocol, self._on_message)

    @property
    def open_sessions(self) -> int:
        return sum(len(client.sessions) for client in self._clients.values())

    def restart(self) -> None:
        """Drop all sessions without closing their files, as a power failure does."""
        self._clients.clear()

    def close(self) -> None:
        for client in self._clients.values():
            with suppress(FileFault):
                self._close_all(client)
            if client.checksum_file is not None:  # The file is still open if the checksum is not complete.
                with suppress(FileFault):
                    client.checksum_file.close()
        self._clients.clear()

    def _on_message(self, message: FileTransferProtocol, channel: Channel) -> None:
        if self._is_enabled():
            self.receive(FtpPacket.parse(message), channel)

    def _key(self, request: FtpPacket, channel: Channel) -> Hashable:
        """Return the key under which the state of this client is stored."""
        return request.client

    def _is_repeated(self, client: ServedClient, request: FtpPacket, reply: FtpPacket) -> bool:
        """Return True if the request repeats the client's latest request, and ``reply`` answers that request."""
        # Equal sequence numbers are not sufficient, because MAVProxy starts each operation with number 0.
        is_same = client.request is not None and request.repeats(client.request)
        # Each reply of a burst has the number of the reply before it plus one, and `reply` is the last one. Only the
        # first reply has the number that is compared here. A repeated burst request therefore starts the burst again.
        reply_sequence = (request.sequence + 1) & 0xFFFF
        return is_same and request.opcode == reply.request_opcode and reply_sequence == reply.sequence

    def _new_number(self, client: ServedClient, request: FtpPacket) -> int:
        # A client may choose the number of its new session, as MAVProxy does. 0 means any number.
        if request.session and request.session not in client.sessions:
            return request.session
        return next(number for number in range(self.max_sessions) if number not in client.sessions)

    def _answer_fault(self, client: ServedClient, request: FtpPacket, fault: FileFault) -> FtpPacket:
        return request.refuse_errno(fault.errno)

    def _client_of(self, request: FtpPacket, channel: Channel) -> ServedClient | None:
        """Return the state of a client, or None if too many clients have open files."""
        key = self._key(request, channel)
        if key not in self._clients and len(self._clients) >= self.max_clients:
            idle_key = next((client_key for client_key, client in self._clients.items() if client.is_idle), None)
            if idle_key is None:
                return None
            del self._clients[idle_key]  # A client without open files makes room for the new one.
        client = self._clients.setdefault(key, ServedClient(channel))
        client.channel = channel
        return client

    def receive(self, request: FtpPacket, channel: Channel) -> None:
        client = self._client_of(request, channel)
        if client is None:
            self._host.send(request.refuse(MavFtpErr.NOSESSIONSAVAILABLE).message(), channel)
            return
        client.used_at = self._host.now
        if request.size > DATA_SIZE:
            self._reply(client, request.refuse(MavFtpErr.INVALIDDATASIZE))
        elif (reply := client.reply) is not None and self._is_repeated(client, request, reply):
            self._reply(client, reply)
        else:
            self._answer(client, request)

    def _answer(self, client: ServedClient, request: FtpPacket) -> None:
        """Execute a request, and send the answer. A handler that returns None sends the answer itself, later."""
        handler = _HANDLERS.get(request.opcode)
        client.request = request
        client.reply = None  # The reply to the previous request must not be sent again.
        try:
            answer = self._unknown(request) if handler is None else handler(self, client, request)
        except Refused as refused:
            answer = request.refuse(refused.code)
        except FileFault as fault:
            answer = self._answer_fault(client, request, fault)
        if answer is not None:
            self._reply(client, self._adapted(client, request, answer))

    def _adapted(self, client: ServedClient, request: FtpPacket, answer: FtpPacket) -> FtpPacket:
        """Return the answer with its fields set as the firmware sets them."""
        return answer.replace(offset=request.offset)

    def _reply(self, client: ServedClient, answer: FtpPacket) -> None:
        # NOSESSIONSAVAILABLE is not stored: the client repeats its request until a session is free, and then needs a
        # new answer.
        lacks_session = answer.opcode == Op.NAK and answer.data[:1] == bytes([MavFtpErr.NOSESSIONSAVAILABLE])
        if answer.size <= self.max_stored_reply_size and not lacks_session:
            client.reply = answer
        self._host.send(answer.message(), client.channel)

    def _path(self, request: FtpPacket) -> str:
        return checked_path(request.data[: request.size])

    def _session_of(self, client: ServedClient, request: FtpPacket) -> FtpSession:
        session = client.sessions.get(request.session)
        if session is None:
            raise Refused(MavFtpErr.INVALIDSESSION)
        return session

    def _unknown(self, request: FtpPacket) -> FtpPacket:
        return request.refuse(MavFtpErr.UNKNOWNCOMMAND)

    def _terminate(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        session = self._session_of(client, request)
        del client.sessions[request.session]
        session.next_block = None
        session.file.close()
        return request.acknowledge()

    def _reset(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        self._close_all(client)
        return request.acknowledge()

    def _close_all(self, client: ServedClient) -> None:
        """Close all files of a client. If an error occurs, it is raised after the last file."""
        sessions = list(client.sessions.values())
        client.sessions.clear()
        fault = None
        for session in sessions:
            session.next_block = None
            try:
                session.file.close()
            except FileFault as error:
                fault = error
        if fault is not None:
            raise fault

    def _open(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        if len(client.sessions) >= self.max_sessions:
            return request.refuse(MavFtpErr.NOSESSIONSAVAILABLE)
        path = self._path(request)
        is_reading = request.opcode == Op.OPENFILERO
        try:
            size = self.files.size(path)
        except FileFault:
            if is_reading:
                raise
            size = 0
        if size > _MAX_SIZE:
            raise FileFault(EFBIG)
        may_create = not is_reading and self.creates_missing
        create = request.opcode == Op.CREATEFILE or (may_create and path not in self.files)
        file = self.files.open(path, writing=not is_reading, create=create)
        number = self._new_number(client, request)
        session = FtpSession(number, file, size, is_writing=not is_reading)
        client.sessions[number] = session
        self._close_when_idle(client, session)
        return request.acknowledge(size.to_bytes(4, "little"), session=number)

    def _close_when_idle(self, client: ServedClient, session: FtpSession) -> None:
        """Schedule the time-out that closes the session."""

        def close_if_due() -> None:
            if client.sessions.get(session.number) is not session:
                return  # The session was closed before.
            due_at = client.used_at + self.session_timeout_s
            if self._host.now < due_at:  # The client has sent a request since this call was scheduled.
                self._host.call_at(due_at, close_if_due)
                return
            client.reply = None  # A repeated request must not get a reply that still shows the session open.
            del client.sessions[session.number]
            session.next_block = None
            with suppress(FileFault):
                session.file.close()

        self._host.call_at(client.used_at + self.session_timeout_s, close_if_due)

    def _read(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        session = self._session_of(client, request)
        if request.offset >= session.size:
            return request.refuse(MavFtpErr.EOF)
        return request.acknowledge(session.file.read(request.offset, request.size))

    def _write(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        session = self._session_of(client, request)
        session.file.write(request.offset, request.data[: request.size])
        return request.acknowledge(request.size.to_bytes(4, "little"))

    def _start_burst(self, client: ServedClient, request: FtpPacket) -> FtpPacket | None:
        """Start a burst, or move a running one to another offset."""
        session = self._session_of(client, request)
        is_running = session.next_block is not None
        session.next_block = request
        session.burst_sent = 0
        if not is_running:
            self._host.call_later(self.burst_interval_s, lambda: self._send_blocks(client, session))
        return None

    def _send_blocks(self, client: ServedClient, session: FtpSession) -> None:
        max_blocks = 0 if self._is_congested() else self.burst
        for number in range(max_blocks):
            if session.next_block is None:
                return
            self._send_block(client, session, session.next_block, may_end=number == self.burst - 1)
        if session.next_block is not None:
            self._host.call_later(self.burst_interval_s, lambda: self._send_blocks(client, session))

    def _send_block(self, client: ServedClient, session: FtpSession, request: FtpPacket, *, may_end: bool) -> None:
        """Send a block of a burst, or the NAK that ends the burst.

        With ``may_end``, this block ends the burst if the burst has sent enough bytes.
        """
        refusal = request.refuse(MavFtpErr.EOF)
        try:
            data = b"" if request.offset >= session.size else session.file.read(request.offset, DATA_SIZE)
        except FileFault as fault:
            data = b""
            client.errno = fault.errno
            refusal = request.refuse(MavFtpErr.FAILERRNO, fault.errno)
        if not data:
            session.next_block = None
            self._reply(client, refusal.replace(offset=request.offset, session=session.number))
            return
        session.burst_sent += len(data)
        is_complete = may_end and session.burst_sent > _BURST_BYTES
        answer = request.acknowledge(data, offset=request.offset, session=session.number)
        self._reply(client, answer.replace(burst_complete=is_complete))
        next_sequence = (request.sequence + 1) & 0xFFFF
        next_block = request.replace(sequence=next_sequence, offset=request.offset + len(data))
        session.next_block = None if is_complete else next_block

    def _list(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        max_line_size = DATA_SIZE - len(self.line_end)
        lines = [*self.list_prefix, *map(_line, self._entries(self._path(request)))]
        # A line that fits into no message becomes S ("skip"). Without it, the answer would be EOF, the end of the list.
        lines = [line if len(line) <= max_line_size else b"S" for line in lines]
        listing = b""
        for line in lines[request.offset :]:
            if len(listing) + len(line) + len(self.line_end) > DATA_SIZE:
                break
            listing += line + self.line_end
        if not listing:
            return request.refuse(MavFtpErr.EOF)
        return request.acknowledge(listing)

    def _entries(self, path: str) -> list[Entry]:
        return self.files.entries(path)

    def _change(self, request: FtpPacket, change: Callable[[str], None]) -> FtpPacket:
        change(self._path(request))
        return request.acknowledge()

    def _remove(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        is_file = request.opcode == Op.REMOVEFILE
        return self._change(request, self.files.remove_file if is_file else self.files.remove_folder)

    def _truncate(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        return self._change(request, lambda path: self.files.truncate(path, request.offset))

    def _rename(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        old_path, _, new_path = request.data[: request.size].partition(b"\0")
        if len(old_path) + 2 >= request.size:  # The data ends after the old path, so there is no new path.
            return self._answer_fault(client, request, FileFault(EINVAL))
        self.files.rename(checked_path(old_path), checked_path(new_path))
        return request.acknowledge()

    def _crc32(self, client: ServedClient, request: FtpPacket) -> FtpPacket | None:
        path = self._path(request)
        is_repeated = client.checksum_request is not None and request.repeats(client.checksum_request)
        if not is_repeated:  # The running computation also answers a repeated request.
            file = self.files.open(path)
            client.checksum_request, client.checksum_file = request, file
            self._continue_crc32(client, request, file, offset=0, checksum=0)
        return None

    def _continue_crc32(
        self, client: ServedClient, request: FtpPacket, file: FileHandle, offset: int, checksum: int
    ) -> None:
        # The checksum is computed in slices, so that a large file does not block the event loop.
        has_more = True
        try:
            for _ in range(self.crc_blocks_at_once):
                data = file.read(offset, self.crc_block)
                if not data:
                    has_more = False
                    break
                checksum = crc32(data, checksum)
                offset += len(data)
            answer = request.acknowledge(checksum.to_bytes(4, "little"))
        except FileFault as fault:
            has_more = False
            answer = self._answer_fault(client, request, fault)
        if client.checksum_request is request and has_more:
            self._host.call_later(_CRC_PAUSE_S, lambda: self._continue_crc32(client, request, file, offset, checksum))
            return
        with suppress(FileFault):
            file.close()
        if client.checksum_request is request:  # A request that a newer one has replaced gets no answer.
            client.checksum_request = None
            client.used_at = self._host.now
            self._reply(client, self._adapted(client, request, answer))


def _line(entry: Entry) -> bytes:
    return (f"D{entry.name}" if entry.size is None else f"F{entry.name}\t{entry.size}").encode()


_HANDLERS: dict[int, Callable[[SessionFtpServer[Any], ServedClient, FtpPacket], FtpPacket | None]] = {
    Op.NONE: lambda _server, _client, request: request.acknowledge(request.data[: request.size]),
    Op.TERMINATESESSION: lambda server, client, request: server._terminate(client, request),
    Op.RESETSESSION: lambda server, client, request: server._reset(client, request),
    Op.LISTDIRECTORY: lambda server, client, request: server._list(client, request),
    Op.OPENFILERO: lambda server, client, request: server._open(client, request),
    Op.READFILE: lambda server, client, request: server._read(client, request),
    Op.CREATEFILE: lambda server, client, request: server._open(client, request),
    Op.WRITEFILE: lambda server, client, request: server._write(client, request),
    Op.REMOVEFILE: lambda server, client, request: server._remove(client, request),
    Op.CREATEDIRECTORY: lambda server, _, request: server._change(request, server.files.make_folder),
    Op.REMOVEDIRECTORY: lambda server, client, request: server._remove(client, request),
    Op.OPENFILEWO: lambda server, client, request: server._open(client, request),
    Op.TRUNCATEFILE: lambda server, client, request: server._truncate(client, request),
    Op.RENAME: lambda server, client, request: server._rename(client, request),
    Op.CALCFILECRC: lambda server, client, request: server._crc32(client, request),
    Op.BURSTREADFILE: lambda server, client, request: server._start_burst(client, request),
}
