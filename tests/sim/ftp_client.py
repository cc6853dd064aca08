"""MAVFTP client for tests of simulated vehicles: sends single requests and returns their replies."""

from __future__ import annotations

from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.servers.ftp_packets import FtpPacket

Op = MavFtpOpcode
Err = MavFtpErr
BLOCK = 239


class FtpClient:
    def __init__(self, client: Client) -> None:
        self.client = client
        self.sequence = 0

    def send(
        self,
        opcode: int,
        data: bytes | str = b"",
        *,
        size: int | None = None,
        offset: int = 0,
        session: int = 0,
        sequence: int | None = None,
    ) -> None:
        data = data.encode() if isinstance(data, str) else data
        self.sequence = (self.sequence + 1) & 0xFFFF if sequence is None else sequence
        size = len(data) if size is None else size
        packet = FtpPacket(self.sequence, opcode, session, size, offset=offset, data=data, client=self.client.target)
        self.client.send(packet.message())

    def wait(self, seconds: float) -> None:
        """Let time pass without receiving."""
        self.client.now += seconds
        self.client.vehicle.step(self.client.now)
        self.client.vehicle.take_outbox()

    def answers(self, seconds: float = 0.1) -> list[FtpPacket]:
        self.client.run(seconds)
        answers = [FtpPacket.parse(message) for message in self.client.all(m.FileTransferProtocol)]
        self.client.clear()
        return answers

    def ask(
        self,
        opcode: int,
        data: bytes | str = b"",
        *,
        size: int | None = None,
        offset: int = 0,
        session: int = 0,
    ) -> FtpPacket:
        self.client.clear()
        self.send(opcode, data, size=size, offset=offset, session=session)
        (answer,) = self.answers()
        return answer

    def data(self, opcode: int, data: bytes | str = b"", **options: int) -> bytes:
        answer = self.ask(opcode, data, **options)
        assert answer.opcode == Op.ACK, answer.data[:2]
        return answer.data[: answer.size]

    def refusal(self, opcode: int, data: bytes | str = b"", **options: int) -> tuple[int, ...]:
        """Return the error code, and the errno if there is one."""
        answer = self.ask(opcode, data, **options)
        assert answer.opcode == Op.NAK
        return tuple(answer.data[: answer.size])

    def burst(self, seconds: float = 1.0, *, size: int = BLOCK, offset: int = 0) -> list[FtpPacket]:
        self.client.clear()
        self.send(Op.BURSTREADFILE, size=size, offset=offset)
        return self.answers(seconds)

    def download(self, path: str) -> bytes:
        self.data(Op.OPENFILERO, path)
        content = b""
        while True:
            answer = self.ask(Op.READFILE, size=BLOCK, offset=len(content))
            if answer.opcode == Op.NAK:
                assert answer.data[0] == Err.EOF
                self.data(Op.TERMINATESESSION)
                return content
            content += answer.data[: answer.size]

    def upload(self, path: str, content: bytes) -> None:
        self.data(Op.CREATEFILE, path)
        for offset in range(0, len(content), BLOCK):
            self.data(Op.WRITEFILE, content[offset : offset + BLOCK], offset=offset)
        self.data(Op.TERMINATESESSION)
