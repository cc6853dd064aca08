"""MAVFTP server of PX4: one session per port, immediate answers, bursts from the main loop."""

from __future__ import annotations

from collections.abc import Hashable
from typing import ClassVar

from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.servers.files import EEXIST, FileFault, FileTree
from aerokit.protocols.servers.ftp import ServedClient, SessionFtpServer
from aerokit.protocols.servers.ftp_packets import FtpPacket
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import MessageHost


class Px4Ftp(SessionFtpServer[FileTree]):
    """MAVFTP server of PX4. Each link has one session (number 0), which ends after 10 s without a request.

    A burst ignores the requested size. After a failure, the next refusals may report its errno, until the client has
    listed a directory. `Faults.no_ftp` turns the server off.
    """

    max_clients: ClassVar[int] = 1 << 16
    max_sessions: ClassVar[int] = 1
    list_prefix: ClassVar[tuple[bytes, ...]] = (b"S", b"S")
    crc_block: ClassVar[int] = 256
    crc_blocks_at_once: ClassVar[int] = 1 << 32

    def __init__(self, vehicle: MessageHost, files: FileTree) -> None:
        super().__init__(vehicle, files, is_enabled=lambda: not vehicle.faults.no_ftp)

    def _key(self, request: FtpPacket, channel: Channel) -> Hashable:
        return channel

    def _is_repeated(self, client: ServedClient, request: FtpPacket, reply: FtpPacket) -> bool:
        return request.sequence + 1 == reply.sequence and request.client == reply.client

    def _new_number(self, client: ServedClient, request: FtpPacket) -> int:
        return 0

    def _answer_fault(self, client: ServedClient, request: FtpPacket, fault: FileFault) -> FtpPacket:
        if request.opcode in (MavFtpOpcode.TRUNCATEFILE, MavFtpOpcode.CALCFILECRC):
            return request.refuse_errno(client.errno)  # The firmware reports the errno of an earlier failure.
        client.errno = fault.errno
        if request.opcode == MavFtpOpcode.LISTDIRECTORY:
            return request.refuse(MavFtpErr.FILENOTFOUND)
        return request.refuse_errno(fault.errno)

    def _adapted(self, client: ServedClient, request: FtpPacket, answer: FtpPacket) -> FtpPacket:
        if answer.opcode == MavFtpOpcode.NAK and client.errno == EEXIST:
            answer = request.refuse(MavFtpErr.FILEEXISTS)
        return super()._adapted(client, request, answer)

    def _list(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        answer = super()._list(client, request)
        client.errno = 0
        return answer

    def _rename(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        old_name, _, _ = request.data[: request.size].partition(b"\0")
        has_new_name = len(old_name) + 2 < request.size
        if not has_new_name:
            return request.refuse_errno(client.errno)  # The firmware reports the errno of an earlier failure.
        return super()._rename(client, request)
