"""MAVFTP server of PX4: one session per port, immediate answers, bursts from the main loop."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.sim.channel import Channel
from aerokit.sim.ftp import EEXIST, FileFault, FileHandle, FileTree, FtpPacket, FtpServer, path_in, read_crc32
from aerokit.sim.vehicle import MessageHost

_SESSION_TIMEOUT_S = 10.0
_REPLY_KEPT = 4
_BURST_BYTES = 35_000
_CRC_BLOCK = 256

Op = MavFtpOpcode


@dataclass(eq=False)
class _Port:
    """Server state of one port."""

    channel: Channel
    file: FileHandle | None = None
    path: str = ""
    size: int = 0
    used_at: float = 0.0
    errno: int = 0
    """Error of the latest failure. PX4 never clears it: after EEXIST, every refusal reports FILEEXISTS."""
    reply: FtpPacket | None = None
    burst: FtpPacket | None = field(default=None, repr=False)
    """Sequence number and offset of the next block."""
    burst_sent: int = 0
    """Bytes that the burst has sent."""


class Px4Ftp(FtpServer):
    """MAVFTP server of PX4. Sessions always have number 0; a session is closed after 10 s without a request.

    A burst ignores the requested size and sends ``burst`` blocks every ``burst_interval_s`` seconds. It ends after
    35 kB, so that the client must request the next burst, or with EOF. A small reply is sent again if its sequence
    number is repeated.
    """

    burst = 24

    def __init__(self, vehicle: MessageHost, files: FileTree, *, burst_interval_s: float = 0.005) -> None:
        super().__init__(vehicle, files)
        self.burst_interval_s = burst_interval_s
        self._ports: dict[Channel, _Port] = {}

    @property
    def open_sessions(self) -> int:
        """Number of ports with an open file."""
        return sum(port.file is not None for port in self._ports.values())

    def restart(self) -> None:
        self._ports.clear()

    def receive(self, request: FtpPacket, channel: Channel) -> None:
        port = self._ports.setdefault(channel, _Port(channel))
        port.used_at = self._vehicle.now
        if request.size > DATA_SIZE:
            self._reply(port, request.refuse(MavFtpErr.INVALIDDATASIZE))
        elif (last := port.reply) is not None and _is_repeated(request, last):
            self._vehicle.send(last.message(), channel)
        else:
            self._answer(port, request)

    def _answer(self, port: _Port, request: FtpPacket) -> None:
        handler = _HANDLERS.get(request.opcode)
        try:
            answer = request.refuse(MavFtpErr.UNKNOWNCOMMAND) if handler is None else handler(self, port, request)
        except FileFault as fault:
            port.errno = fault.errno
            answer = request.refuse_errno(fault.errno)
        port.reply = None
        if answer is None:
            return
        if answer.opcode == Op.NAK:
            if port.errno == EEXIST:
                answer = request.refuse(MavFtpErr.FILEEXISTS)
            answer = answer.replace(offset=request.offset)
        self._reply(port, answer)

    def _reply(self, port: _Port, answer: FtpPacket) -> None:
        if answer.size <= _REPLY_KEPT and answer.data[:1] != bytes([MavFtpErr.NOSESSIONSAVAILABLE]):
            port.reply = answer
        self._vehicle.send(answer.message(), port.channel)

    def _none(self, port: _Port, request: FtpPacket) -> FtpPacket:
        return request.acknowledge(request.data[: request.size], offset=request.offset)

    def _terminate(self, port: _Port, request: FtpPacket) -> FtpPacket:
        if request.session != 0 or port.file is None:
            return request.refuse(MavFtpErr.INVALIDSESSION)
        return self._reset(port, request)

    def _reset(self, port: _Port, request: FtpPacket) -> FtpPacket:
        self._close(port)
        return request.acknowledge(offset=request.offset)

    def _close(self, port: _Port) -> None:
        file, port.file, port.burst = port.file, None, None
        if file is not None:
            file.close()

    def _open(self, port: _Port, request: FtpPacket) -> FtpPacket:
        if port.file is not None:
            return request.refuse(MavFtpErr.NOSESSIONSAVAILABLE)
        path = path_in(request.data[: request.size])
        if _leaves(path):
            return request.refuse(MavFtpErr.FILEPROTECTED)
        reading = request.opcode == Op.OPENFILERO
        size = self._size(path, reading=reading)
        create = request.opcode == Op.CREATEFILE or (not reading and path not in self.files)
        port.file = self.files.open(path, writing=not reading, create=create)
        port.path, port.size, port.burst = path, size, None
        self._watch(port)
        return request.acknowledge(size.to_bytes(4, "little"), offset=request.offset, session=0)

    def _size(self, path: str, *, reading: bool) -> int:
        try:
            return self.files.size(path)
        except FileFault:
            if reading:
                raise
            return 0

    def _watch(self, port: _Port) -> None:
        """Schedule the time-out that closes the session."""
        file = port.file

        def close_if_due() -> None:
            if port.file is not file or file is None:
                return
            if self._vehicle.now < (end := port.used_at + _SESSION_TIMEOUT_S):
                self._vehicle.call_at(end, close_if_due)
                return
            port.reply = None
            with suppress(FileFault):
                self._close(port)

        self._vehicle.call_at(port.used_at + _SESSION_TIMEOUT_S, close_if_due)

    def _read(self, port: _Port, request: FtpPacket) -> FtpPacket:
        if request.session != 0 or port.file is None:
            return request.refuse(MavFtpErr.INVALIDSESSION)
        if request.offset >= port.size:
            return request.refuse(MavFtpErr.EOF)
        return request.acknowledge(port.file.read(request.offset, request.size), offset=request.offset)

    def _write(self, port: _Port, request: FtpPacket) -> FtpPacket:
        if request.session != 0 or port.file is None:
            return request.refuse(MavFtpErr.INVALIDSESSION)
        port.file.write(request.offset, request.data[: request.size])
        return request.acknowledge(request.size.to_bytes(4, "little"), offset=request.offset)

    def _start_burst(self, port: _Port, request: FtpPacket) -> FtpPacket | None:
        if request.session != 0 or port.file is None:
            return request.refuse(MavFtpErr.INVALIDSESSION)
        is_running = port.burst is not None
        port.burst, port.burst_sent = request.replace(sequence=request.sequence + 1 & 0xFFFF), 0
        if not is_running:
            self._vehicle.call_later(self.burst_interval_s, lambda: self._send_blocks(port))
        return None

    def _send_blocks(self, port: _Port) -> None:
        for number in range(self.burst):
            if port.burst is None or port.file is None:
                return
            self._send_block(port, port.file, port.burst, may_end=number == self.burst - 1)
        if port.burst is None:
            return
        self._vehicle.call_later(self.burst_interval_s, lambda: self._send_blocks(port))

    def _send_block(self, port: _Port, file: FileHandle, burst: FtpPacket, *, may_end: bool) -> None:
        answer = burst.acknowledge(offset=burst.offset, session=0).replace(sequence=burst.sequence)
        refusal = burst.refuse(MavFtpErr.EOF).replace(sequence=burst.sequence, offset=burst.offset, session=0)
        try:
            data = b"" if burst.offset >= port.size else file.read(burst.offset, DATA_SIZE)
        except FileFault as fault:
            data, port.errno = b"", fault.errno
            refusal = refusal.replace(data=bytes([MavFtpErr.FAILERRNO, port.errno]), size=2)
        if not data:
            port.burst = None
            self._reply(port, refusal)
            return
        port.burst_sent += len(data)
        complete = may_end and port.burst_sent > _BURST_BYTES
        self._reply(port, answer.replace(data=data, size=len(data), burst_complete=complete))
        following = burst.replace(sequence=burst.sequence + 1 & 0xFFFF, offset=burst.offset + len(data))
        port.burst = None if complete else following

    def _list(self, port: _Port, request: FtpPacket) -> FtpPacket:
        path = path_in(request.data[: request.size])
        if _leaves(path):
            return request.refuse(MavFtpErr.FILEPROTECTED)
        try:
            entries = self.files.entries(path)
        except FileFault as fault:
            port.errno = fault.errno
            return request.refuse(MavFtpErr.FILENOTFOUND)
        port.errno = 0
        listing = b""
        for text in [b"S", b"S", *map(_line, entries)][request.offset :]:
            if len(listing) + len(text) + 1 > DATA_SIZE:
                break
            listing += text + b"\0"
        if not listing:
            return request.refuse(MavFtpErr.EOF)
        return request.acknowledge(listing, offset=request.offset)

    def _change(self, request: FtpPacket, change: Callable[[str], None]) -> FtpPacket:
        path = path_in(request.data[: request.size])
        if _leaves(path):
            return request.refuse(MavFtpErr.FILEPROTECTED)
        change(path)
        return request.acknowledge(offset=request.offset)

    def _remove_file(self, _: _Port, request: FtpPacket) -> FtpPacket:
        return self._change(request, self.files.remove_file)

    def _remove_folder(self, _: _Port, request: FtpPacket) -> FtpPacket:
        return self._change(request, self.files.remove_folder)

    def _make_folder(self, _: _Port, request: FtpPacket) -> FtpPacket:
        return self._change(request, self.files.make_folder)

    def _truncate(self, port: _Port, request: FtpPacket) -> FtpPacket:
        try:
            return self._change(request, lambda path: self.files.truncate(path, request.offset))
        except FileFault:
            return request.refuse_errno(port.errno)  # The firmware reports the error of an earlier failure.

    def _rename(self, port: _Port, request: FtpPacket) -> FtpPacket:
        first, _, rest = request.data[: request.size].partition(b"\0")
        if len(first) + 2 >= request.size:
            return request.refuse_errno(port.errno)
        path, to = path_in(first), path_in(rest)
        if _leaves(path) or _leaves(to):
            return request.refuse(MavFtpErr.FILEPROTECTED)
        self.files.rename(path, to)
        return request.acknowledge(offset=request.offset)

    def _crc32(self, port: _Port, request: FtpPacket) -> FtpPacket:
        path = path_in(request.data[: request.size])
        if _leaves(path):
            return request.refuse(MavFtpErr.FILEPROTECTED)
        try:
            checksum = read_crc32(self.files, path, _CRC_BLOCK)
        except FileFault:
            return request.refuse_errno(port.errno)  # The error of an earlier failure, as in the firmware.
        return request.acknowledge(checksum.to_bytes(4, "little"), offset=request.offset)


def _is_repeated(request: FtpPacket, last: FtpPacket) -> bool:
    return request.sequence + 1 == last.sequence and request.client == last.client


def _leaves(path: str) -> bool:
    return ".." in path.split("/")


def _line(entry: tuple[str, int | None]) -> bytes:
    name, size = entry
    return (f"D{name}" if size is None else f"F{name}\t{size}").encode()


_HANDLERS: dict[int, Callable[[Px4Ftp, _Port, FtpPacket], FtpPacket | None]] = {
    Op.NONE: Px4Ftp._none,
    Op.TERMINATESESSION: Px4Ftp._terminate,
    Op.RESETSESSION: Px4Ftp._reset,
    Op.LISTDIRECTORY: Px4Ftp._list,
    Op.OPENFILERO: Px4Ftp._open,
    Op.READFILE: Px4Ftp._read,
    Op.CREATEFILE: Px4Ftp._open,
    Op.WRITEFILE: Px4Ftp._write,
    Op.REMOVEFILE: Px4Ftp._remove_file,
    Op.CREATEDIRECTORY: Px4Ftp._make_folder,
    Op.REMOVEDIRECTORY: Px4Ftp._remove_folder,
    Op.OPENFILEWO: Px4Ftp._open,
    Op.TRUNCATEFILE: Px4Ftp._truncate,
    Op.RENAME: Px4Ftp._rename,
    Op.CALCFILECRC: Px4Ftp._crc32,
    Op.BURSTREADFILE: Px4Ftp._start_burst,
}
