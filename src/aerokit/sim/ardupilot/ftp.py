"""MAVFTP server of ArduPilot 4.7: one session at a time, one worker with a short queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from contextlib import suppress
from functools import partial
from typing import ClassVar

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode, MavSeverity
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.protocols.servers.files import EISDIR, ENOENT, Entry, FileFault, FileTree
from aerokit.protocols.servers.ftp import FtpSession, ServedClient, SessionFtpServer
from aerokit.protocols.servers.ftp_packets import FtpPacket, Refused, path_in
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import SimulatedVehicle

_SESSION_TIMEOUT_S = 3.0
_QUEUE_DEPTH = 5
_WORKER_PERIOD_S = 0.002
_BURST_BLOCKS = 500

Op = MavFtpOpcode
_WITHOUT_DATA = (Op.NONE, Op.CREATEFILE, Op.OPENFILEWO, Op.WRITEFILE)


class ArduPilotFtp(SessionFtpServer[FileTree]):
    """MAVFTP with the limits of the firmware (GCS_FTP.cpp).

    A worker processes the queue every 2 ms, except during a burst, which cannot be stopped. The queue has space for
    five requests. Further requests are lost. A request that repeats the last sequence number gets the last reply again.

    The client chooses the session number. A session blocks other sessions until its file is closed, or until 3 s after
    the last reply. A close is always acknowledged, even if writing failed. `Faults.no_ftp` turns the server off.
    """

    max_sessions: ClassVar[int] = 1
    line_end: ClassVar[bytes] = b"\0\0"
    creates_missing: ClassVar[bool] = False
    max_stored_reply_size: ClassVar[int] = DATA_SIZE
    crc_block: ClassVar[int] = 64
    crc_blocks_at_once: ClassVar[int] = 1 << 32

    def __init__(
        self, vehicle: SimulatedVehicle, files: FileTree, *, send_banner: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(vehicle, files, burst_interval_s=0.0002, is_enabled=lambda: not vehicle.faults.no_ftp)
        self._send_banner = send_banner
        self.restart()

    def restart(self) -> None:
        super().restart()
        self._queue: deque[tuple[FtpPacket, Channel]] = deque()
        self._is_worker_scheduled = self._is_bursting = self._is_banner_due = False
        self._sent_at = float("-inf")  # Time of the last reply; minus infinity after a session was closed.

    @property
    def open_sessions(self) -> int:
        # 3 s after the last reply, an open file no longer blocks other sessions.
        return 0 if self._is_idle() else super().open_sessions

    def _is_idle(self) -> bool:
        return self._host.now - self._sent_at >= _SESSION_TIMEOUT_S

    def receive(self, request: FtpPacket, channel: Channel) -> None:
        if len(self._queue) < _QUEUE_DEPTH:
            self._queue.append((request, channel))
        if not self._is_worker_scheduled:
            self._is_worker_scheduled = True
            self._host.call_later(_WORKER_PERIOD_S, self._work)

    def _work(self) -> None:
        while self._queue and not self._is_bursting:
            request, channel = self._queue.popleft()
            client = self._client_of(request, channel)
            assert client is not None
            if client.reply is not None and self._is_repeated(client, request, client.reply):
                self._reply(client, client.reply)
            elif request.opcode not in (Op.ACK, Op.NAK):
                super().receive(request, channel)
        self._is_worker_scheduled = self._is_bursting

    def _key(self, request: FtpPacket, channel: Channel) -> Hashable:
        return None  # Like the firmware, use a single state for all clients.

    def _is_repeated(self, client: ServedClient, request: FtpPacket, reply: FtpPacket) -> bool:
        is_same_session = request.client == reply.client and request.session == reply.session
        return is_same_session and request.sequence + 1 == reply.sequence

    def _new_number(self, client: ServedClient, request: FtpPacket) -> int:
        return request.session

    def _close_when_idle(self, client: ServedClient, session: FtpSession) -> None:
        """Do nothing. The firmware closes an idle session only at a request for another session."""

    def _answer(self, client: ServedClient, request: FtpPacket) -> None:
        # A request for another session closes the open session if it is idle, and is refused otherwise.
        is_close = request.opcode in (Op.TERMINATESESSION, Op.RESETSESSION)
        is_for_other_session = bool(client.sessions) and request.session not in client.sessions
        if is_for_other_session and not is_close:
            if not self._is_idle():
                self._reply(client, request.refuse(MavFtpErr.INVALIDSESSION))
                return
            self._close_all(client)
        super()._answer(client, request)

    def _adapted(self, client: ServedClient, request: FtpPacket, answer: FtpPacket) -> FtpPacket:
        is_acknowledged = answer.opcode == Op.ACK
        is_transfer = request.opcode in (Op.READFILE, Op.WRITEFILE) and is_acknowledged
        # Only file transfers and directory listings have an offset. In all other replies, the firmware sends 0.
        offset = request.offset if is_transfer or request.opcode == Op.LISTDIRECTORY else 0
        if is_acknowledged and request.opcode in _WITHOUT_DATA:
            answer = request.acknowledge()  # an acknowledgement without data
        return answer.replace(offset=offset)

    def _reply(self, client: ServedClient, answer: FtpPacket) -> None:
        super()._reply(client, answer)
        is_session_closed = answer.request_opcode == Op.TERMINATESESSION
        self._sent_at = float("-inf") if is_session_closed else self._host.now
        if self._is_banner_due:
            self._is_banner_due = False
            self._send_banner()

    def _answer_fault(self, client: ServedClient, request: FtpPacket, fault: FileFault) -> FtpPacket:
        is_opening = request.opcode in (Op.OPENFILERO, Op.OPENFILEWO, Op.CREATEFILE)
        # If a folder is opened as a file, the firmware reports a missing file.
        errno = ENOENT if is_opening and fault.errno == EISDIR else fault.errno
        return request.refuse_errno(errno)

    def _unknown(self, request: FtpPacket) -> FtpPacket:
        self._host.send_text(MavSeverity.DEBUG, f"Unsupported FTP: {request.opcode}")
        return request.refuse(MavFtpErr.FAIL)

    def _path(self, request: FtpPacket) -> str:
        path, _, _ = request.data.partition(b"\0")
        length = len(path)
        # The length, with or without the final NUL, must be the request's `size`.
        if request.size == 0 or request.size - length not in (0, 1):
            raise Refused(MavFtpErr.INVALIDDATASIZE)
        return path_in(request.data)

    def _session_of(self, client: ServedClient, request: FtpPacket) -> FtpSession:
        session = client.sessions.get(request.session)
        if session is None:
            raise Refused(MavFtpErr.FILENOTFOUND)
        if session.is_writing != (request.opcode == Op.WRITEFILE):
            raise Refused(MavFtpErr.FAIL)
        return session

    def _close_all(self, client: ServedClient) -> None:
        with suppress(FileFault):  # The firmware does not report an error of a close.
            super()._close_all(client)

    def _terminate(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        if request.session in client.sessions:
            self._close_all(client)
        return request.acknowledge()

    def _reset(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        return self._terminate(client, request)

    def _open(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        is_reading = request.opcode == Op.OPENFILERO
        is_idle = self._host.now - self._sent_at > _SESSION_TIMEOUT_S
        if is_reading and is_idle:  # The client may have missed the reply to its previous request to open a file.
            self._close_all(client)
        if client.sessions:
            raise Refused(MavFtpErr.FAIL)
        answer = super()._open(client, request)
        # A client that reads the parameter file also gets the banner, as after PARAM_REQUEST_LIST (GCS_FTP.cpp).
        self._is_banner_due = is_reading and self._path(request).startswith("@PARAM/param.pck")
        return answer

    def _read(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        data = self._session_of(client, request).file.read(request.offset, request.size)
        return request.acknowledge(data) if data else request.refuse(MavFtpErr.EOF)

    def _start_burst(self, client: ServedClient, request: FtpPacket) -> None:
        session = self._session_of(client, request)
        self._is_bursting = True
        self._send_next(client, session, request, 0)

    def _send_next(self, client: ServedClient, session: FtpSession, request: FtpPacket, block_number: int) -> None:
        block_size = request.size or DATA_SIZE
        offset = request.offset + block_number * block_size
        sequence = (request.sequence + 1 + block_number) & 0xFFFF
        refusal = request.refuse(MavFtpErr.EOF)  # sent if there is no data at `offset`
        try:
            data = session.file.read(offset, block_size)
        except FileFault as fault:
            data = b""
            refusal = request.refuse_errno(fault.errno)
        if not data:
            # The firmware sends the refusal with the offset and the flag burst_complete of the previous block.
            previous = client.reply if block_number and client.reply is not None else refusal
            end = refusal.replace(sequence=sequence, offset=previous.offset, burst_complete=previous.burst_complete)
            self._reply(client, end)
            self._end_burst()
            return
        is_short = len(data) < block_size
        is_last = block_number == _BURST_BLOCKS - 1
        block = request.acknowledge(data, offset=offset)
        block = block.replace(sequence=sequence, burst_complete=is_short or is_last)
        self._reply(client, block)
        # The firmware reuses one reply for the whole burst (GCS_FTP.cpp). It increments the sequence number after each
        # block, and advances the offset after a short block. The refusal at the end of the burst contains both values.
        next_offset = offset + len(data) if is_short else offset
        client.reply = block.replace(sequence=(sequence + 1) & 0xFFFF, offset=next_offset)
        next_step = self._end_burst if is_last else partial(self._send_next, client, session, request, block_number + 1)
        self._host.call_later(self.burst_interval_s, next_step)

    def _end_burst(self) -> None:
        self._is_bursting = False
        self._work()

    def _entries(self, path: str) -> list[Entry]:
        entries = super()._entries(path)
        if self.files.mounted(path) is not None:
            return entries
        mounts = [Entry(name, None) for name, mount in self.files.mounts.items() if mount.is_listed]
        return [Entry(".", None), Entry("..", None), *entries, *(mounts if path == "/" else [])]

    def _change(self, request: FtpPacket, change: Callable[[str], None]) -> FtpPacket:
        if self.files.mounted(self._path(request)) is not None:
            raise FileFault(ENOENT)
        return super()._change(request, change)

    def _remove(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        return self._change(request, self._remove_either)

    def _remove_either(self, path: str) -> None:
        # In the firmware, RemoveFile also removes folders, and RemoveDirectory also removes files.
        try:
            self.files.remove_folder(path)
        except FileFault:
            self.files.remove_file(path)

    def _truncate(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        return self._unknown(request)

    def _rename(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        old_name, _, remainder = request.data.partition(b"\0")
        new_name, _, _ = remainder.partition(b"\0")
        length = len(old_name) + len(new_name)
        if request.size == 0 or request.size not in (length + 1, length + 2):  # with or without the final NUL
            raise Refused(MavFtpErr.INVALIDDATASIZE)
        old_path, new_path = path_in(old_name), path_in(new_name)
        if self.files.mounted(old_path) is not None or self.files.mounted(new_path) is not None:
            raise FileFault(ENOENT)  # Virtual files, such as those of @PARAM, cannot be renamed.
        self.files.rename(old_path, new_path)
        return request.acknowledge()
