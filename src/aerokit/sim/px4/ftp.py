"""MAVFTP server of PX4: one session per port, immediate answers, bursts from the main loop."""

from __future__ import annotations

from collections.abc import Hashable
from typing import ClassVar

from aerokit.mavlink.enums import MavFtpErr
from aerokit.protocols.servers.files import EEXIST, FileFault, FileTree
from aerokit.protocols.servers.ftp import FtpPeer, SessionFtpServer
from aerokit.protocols.servers.ftp_packets import FtpPacket, checked_path, read_crc32
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import MessageHost

_CRC_BLOCK = 256


class Px4Ftp(SessionFtpServer[FileTree]):
    """MAVFTP server of PX4. Sessions always have number 0; a session is closed after 10 s without a request.

    A burst ignores the requested size. PX4 never clears the error of the latest failure: after EEXIST, every refusal
    reports FILEEXISTS. `Faults.no_ftp` turns the server off.
    """

    max_clients: ClassVar[int] = 1 << 16
    max_sessions: ClassVar[int] = 1
    list_prefix: ClassVar[tuple[bytes, ...]] = (b"S", b"S")

    def __init__(self, vehicle: MessageHost, files: FileTree, *, burst_interval_s: float = 0.005) -> None:
        super().__init__(vehicle, files, burst_interval_s=burst_interval_s)
        self._vehicle = vehicle

    @property
    def is_enabled(self) -> bool:
        return not self._vehicle.faults.no_ftp

    def _key(self, request: FtpPacket, channel: Channel) -> Hashable:
        return channel

    def _is_repeated(self, request: FtpPacket, last: FtpPacket) -> bool:
        return request.sequence + 1 == last.sequence and request.client == last.client

    def _new_number(self, peer: FtpPeer, request: FtpPacket) -> int:
        return 0

    def _fault(self, peer: FtpPeer, request: FtpPacket, fault: FileFault) -> FtpPacket:
        peer.errno = fault.errno
        return request.refuse_errno(fault.errno)

    def _refusal(self, peer: FtpPeer, request: FtpPacket, answer: FtpPacket) -> FtpPacket:
        return request.refuse(MavFtpErr.FILEEXISTS) if peer.errno == EEXIST else answer

    def _list(self, peer: FtpPeer, request: FtpPacket) -> FtpPacket:
        try:
            answer = super()._list(peer, request)
        except FileFault as fault:
            peer.errno = fault.errno
            return request.refuse(MavFtpErr.FILENOTFOUND)
        peer.errno = 0
        return answer

    def _rename(self, peer: FtpPeer, request: FtpPacket) -> FtpPacket:
        if len(request.data[: request.size].partition(b"\0")[0]) + 2 >= request.size:
            return request.refuse_errno(peer.errno)  # The error of an earlier failure, as in the firmware.
        return super()._rename(peer, request)

    def _truncate(self, peer: FtpPeer, request: FtpPacket) -> FtpPacket:
        try:
            return super()._truncate(peer, request)
        except FileFault:
            return request.refuse_errno(peer.errno)  # The firmware reports the error of an earlier failure.

    def _crc32(self, peer: FtpPeer, request: FtpPacket) -> FtpPacket:
        path = checked_path(request.data[: request.size])
        try:
            checksum = read_crc32(self.files, path, _CRC_BLOCK)
        except FileFault:
            return request.refuse_errno(peer.errno)  # The error of an earlier failure, as in the firmware.
        return request.acknowledge(checksum.to_bytes(4, "little"), offset=request.offset)
