"""MAVFTP server of ArduPilot 4.7: one session at a time, one worker with a short queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode, MavSeverity
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.protocols.servers.files import EISDIR, ENOENT, Entry, FileFault, FileHandle, FileTree
from aerokit.protocols.servers.ftp import FtpRequestServer
from aerokit.protocols.servers.ftp_packets import FtpPacket, path_in, read_crc32
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import SimulatedVehicle

_SESSION_TIMEOUT_S = 3.0
_QUEUE_DEPTH = 5
_WORKER_PERIOD_S = 0.002
_BURST_BLOCKS = 500
_CRC_BLOCK = 64
_NO_SESSION = 0xFF

Op = MavFtpOpcode


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        self.code = code


class ArduPilotFtp(FtpRequestServer[FileTree]):
    """MAVFTP with the limits of the firmware (GCS_FTP.cpp).

    A worker processes the queue every 2 ms. The queue holds five requests; further requests are lost, also during a
    burst. A burst cannot be stopped. The answer to a repeated sequence number is the last reply.

    The client chooses the session number. A session with an open file blocks other sessions until its client closes
    it, or has sent nothing for 3 s. A close is always acknowledged, even if writing failed. `Faults.no_ftp` turns the
    server off.
    """

    burst_interval_s: float
    """Seconds between two blocks of a burst."""

    def __init__(
        self,
        vehicle: SimulatedVehicle,
        files: FileTree,
        *,
        burst_interval_s: float = 0.0002,
        send_banner: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(vehicle, files)
        self._vehicle = vehicle
        self.burst_interval_s = burst_interval_s
        self._send_banner = send_banner
        self.restart()

    def restart(self) -> None:
        self._queue: deque[tuple[FtpPacket, Channel]] = deque()
        self._is_awake = False
        self._file: FileHandle | None = None
        self._writing = False
        self._session = _NO_SESSION
        self._used_at = float("-inf")
        self._reply = FtpPacket(0, Op.NONE, _NO_SESSION)
        self._banner_wanted = False

    @property
    def is_enabled(self) -> bool:
        return not self._vehicle.faults.no_ftp

    @property
    def open_sessions(self) -> int:
        """1 while an open file blocks other sessions, else 0."""
        return int(self._file is not None and not self._is_idle())

    def receive(self, request: FtpPacket, channel: Channel) -> None:
        if len(self._queue) < _QUEUE_DEPTH:
            self._queue.append((request, channel))
        if not self._is_awake:
            self._is_awake = True
            self._vehicle.call_later(_WORKER_PERIOD_S, self._work)

    def _work(self) -> None:
        """Process the queue. A burst continues by its own timer, and calls this method when it ends."""
        while self._queue:
            request, channel = self._queue.popleft()
            if self._is_repeated(request):
                self._send(self._reply, channel)
            elif request.opcode not in (Op.ACK, Op.NAK):
                answer = self._answer(request, channel)
                if answer is None:
                    return
                self._send(answer, channel)
        self._is_awake = False

    def _is_repeated(self, request: FtpPacket) -> bool:
        last = self._reply
        same = request.client == last.client and request.session == last.session
        return same and request.sequence + 1 == last.sequence

    def _send(self, reply: FtpPacket, channel: Channel) -> None:
        self._reply = reply
        self._vehicle.send(reply.message(), channel)
        ended = reply.request_opcode == Op.TERMINATESESSION
        self._used_at = float("-inf") if ended else self._vehicle.now
        if self._banner_wanted:
            self._banner_wanted = False
            self._send_banner()

    def _is_idle(self) -> bool:
        return self._vehicle.now - self._used_at >= _SESSION_TIMEOUT_S

    def _answer(self, request: FtpPacket, channel: Channel) -> FtpPacket | None:
        if request.size > DATA_SIZE:
            return request.refuse(MavFtpErr.INVALIDDATASIZE)
        if request.session != self._session:
            if request.opcode in (Op.TERMINATESESSION, Op.RESETSESSION):
                return request.acknowledge()
            if self._file is not None and not self._is_idle():
                return request.refuse(MavFtpErr.INVALIDSESSION)
            self._close()
        handler = _HANDLERS.get(request.opcode)
        if handler is None:
            self._vehicle.send_text(MavSeverity.DEBUG, f"Unsupported FTP: {request.opcode}")
            return request.refuse(MavFtpErr.FAIL)
        try:
            if request.opcode == Op.BURSTREADFILE:
                self._opened(writing=False)
                self._burst(request, channel, 0)
                return None
            return handler(self, request)
        except _Refused as refused:
            return request.refuse(refused.code)
        except FileFault as fault:
            is_open = request.opcode in (Op.OPENFILERO, Op.OPENFILEWO, Op.CREATEFILE)
            return request.refuse_errno(ENOENT if is_open and fault.errno == EISDIR else fault.errno)

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        self._session = _NO_SESSION
        with suppress(FileFault):  # The firmware does not report the error.
            file.close()

    def _terminate(self, request: FtpPacket) -> FtpPacket:
        self._close()
        self._session = _NO_SESSION
        return request.acknowledge()

    def _open(self, request: FtpPacket) -> FtpPacket:
        if self._file is not None and self._vehicle.now - self._used_at > _SESSION_TIMEOUT_S:
            self._close()
        if self._file is not None:
            return request.refuse(MavFtpErr.FAIL)
        path = _path(request)
        size = self.files.size(path)
        self._file, self._writing, self._session = self.files.open(path), False, request.session
        self._banner_wanted = path.startswith("@PARAM/param.pck")
        return request.acknowledge(size.to_bytes(4, "little"))

    def _open_for_writing(self, request: FtpPacket) -> FtpPacket:
        if self._file is not None:
            return request.refuse(MavFtpErr.FAIL)
        create = request.opcode == Op.CREATEFILE
        self._file = self.files.open(_path(request), writing=True, create=create)
        self._writing, self._session = True, request.session
        return request.acknowledge()

    def _opened(self, *, writing: bool) -> FileHandle:
        if self._file is None:
            raise _Refused(MavFtpErr.FILENOTFOUND)
        if self._writing != writing:
            raise _Refused(MavFtpErr.FAIL)
        return self._file

    def _read(self, request: FtpPacket) -> FtpPacket:
        data = self._opened(writing=False).read(request.offset, request.size)
        if not data:
            return request.refuse(MavFtpErr.EOF)
        return request.acknowledge(data, offset=request.offset)

    def _write(self, request: FtpPacket) -> FtpPacket:
        self._opened(writing=True).write(request.offset, request.data[: request.size])
        return request.acknowledge(offset=request.offset)

    def _burst(self, request: FtpPacket, channel: Channel, number: int) -> None:
        """Send one block and schedule the next. No other request is processed until the burst ends."""
        step = request.size or DATA_SIZE
        offset = request.offset + number * step
        try:
            data = self._file.read(offset, step) if self._file is not None else b""
            refusal = None if data else request.refuse(MavFtpErr.EOF)
        except FileFault as fault:
            data, refusal = b"", request.refuse_errno(fault.errno)
        sequence = request.sequence + 1 + number & 0xFFFF
        if refusal is not None:
            last = self._reply if number else refusal
            end = refusal.replace(sequence=sequence, offset=last.offset, burst_complete=last.burst_complete)
            self._send(end, channel)
            self._work()
            return
        is_last = number == _BURST_BLOCKS - 1
        complete = len(data) < step or is_last
        block = request.acknowledge(data, offset=offset)
        self._send(block.replace(sequence=sequence, burst_complete=complete), channel)
        after = offset + len(data) if len(data) < step else offset
        self._reply = self._reply.replace(sequence=sequence + 1 & 0xFFFF, offset=after)
        if is_last:
            self._vehicle.call_later(self.burst_interval_s, self._work)
        else:
            following = partial(self._burst, request, channel, number + 1)
            self._vehicle.call_later(self.burst_interval_s, following)

    def _list(self, request: FtpPacket) -> FtpPacket:
        try:
            entries = self._entries(_path(request))
        except _Refused as refused:
            return request.refuse(refused.code).replace(offset=request.offset)
        except FileFault as fault:
            return request.refuse_errno(fault.errno).replace(offset=request.offset)
        listing = b""
        for name, size in entries[request.offset :]:
            text = f"D{name}" if size is None else f"F{name}\t{size}"
            if len(listing) + len(text) + 1 >= DATA_SIZE:
                break
            listing += text.encode() + b"\0\0"
        if not listing:
            return request.refuse(MavFtpErr.EOF).replace(offset=request.offset)
        return request.acknowledge(listing, offset=request.offset)

    def _entries(self, path: str) -> list[Entry]:
        """List a folder with `.` and `..`, like Linux; the root folder also contains the listed mounts."""
        entries = self.files.entries(path)
        if self.files.mounted(path) is not None:
            return entries
        mounts = [(name, None) for name, mount in self.files.mounts.items() if mount.is_listed]
        return [(".", None), ("..", None), *entries, *(mounts if path == "/" else [])]

    def _make_folder(self, request: FtpPacket) -> FtpPacket:
        return self._change(request, self.files.make_folder)

    def _remove(self, request: FtpPacket) -> FtpPacket:
        return self._change(request, self._remove_either)

    def _remove_either(self, path: str) -> None:
        # In the firmware RemoveFile and RemoveDirectory are the same operation.
        try:
            self.files.remove_folder(path)
        except FileFault:
            self.files.remove_file(path)

    def _change(self, request: FtpPacket, change: Callable[[str], None]) -> FtpPacket:
        path = _path(request)
        if self.files.mounted(path) is not None:
            return request.refuse_errno(ENOENT)
        change(path)
        return request.acknowledge()

    def _rename(self, request: FtpPacket) -> FtpPacket:
        first = path_in(request.data)
        second = path_in(request.data[len(first.encode()) + 1 :])
        length = len(first.encode()) + len(second.encode())
        if request.size == 0 or request.size not in (length + 1, length + 2):
            return request.refuse(MavFtpErr.INVALIDDATASIZE)
        if self.files.mounted(first) is not None or self.files.mounted(second) is not None:
            return request.refuse_errno(ENOENT)
        self.files.rename(first, second)
        return request.acknowledge()

    def _crc32(self, request: FtpPacket) -> FtpPacket:
        checksum = read_crc32(self.files, _path(request), _CRC_BLOCK)
        return request.acknowledge(checksum.to_bytes(4, "little"))


def _path(request: FtpPacket) -> str:
    """Return the path; the request's size must be its length, with or without the final NUL."""
    length = len(request.data.partition(b"\0")[0])
    if request.size == 0 or request.size - length not in (0, 1):
        raise _Refused(MavFtpErr.INVALIDDATASIZE)
    return path_in(request.data)


_HANDLERS: dict[int, Callable[[ArduPilotFtp, FtpPacket], FtpPacket]] = {
    Op.NONE: lambda _, request: request.acknowledge(),
    Op.TERMINATESESSION: ArduPilotFtp._terminate,
    Op.RESETSESSION: ArduPilotFtp._terminate,
    Op.LISTDIRECTORY: ArduPilotFtp._list,
    Op.OPENFILERO: ArduPilotFtp._open,
    Op.READFILE: ArduPilotFtp._read,
    Op.BURSTREADFILE: ArduPilotFtp._read,
    Op.CREATEFILE: ArduPilotFtp._open_for_writing,
    Op.OPENFILEWO: ArduPilotFtp._open_for_writing,
    Op.WRITEFILE: ArduPilotFtp._write,
    Op.REMOVEFILE: ArduPilotFtp._remove,
    Op.REMOVEDIRECTORY: ArduPilotFtp._remove,
    Op.CREATEDIRECTORY: ArduPilotFtp._make_folder,
    Op.RENAME: ArduPilotFtp._rename,
    Op.CALCFILECRC: ArduPilotFtp._crc32,
}
