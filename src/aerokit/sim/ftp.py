"""MAVFTP of the simulated vehicles: `Faults.no_ftp` turns their servers off."""

from __future__ import annotations

from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.servers import ftp
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.ftp_packets import FtpPacket
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import MessageHost


class FtpServer(ftp.FtpRequestServer[FileTree]):
    """Receives MAVFTP requests; each autopilot's subclass answers them."""

    def __init__(self, vehicle: MessageHost, files: FileTree) -> None:
        super().__init__(vehicle, files)
        self._vehicle = vehicle

    def _on_message(self, message: FileTransferProtocol, channel: Channel) -> None:
        if not self._vehicle.faults.no_ftp:
            self.receive(FtpPacket.parse(message), channel)
