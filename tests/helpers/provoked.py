"""A provoked error: the state of the vehicle, the preparation, and the call that must raise it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from call_stage import Place, Stage, airborne, anywhere

from aerokit import messages as m
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode, MavResult
from aerokit.protocols.ftp import FtpMessage

__all__ = [
    "LOSING_STATE",
    "NONSENSE",
    "REFUSING",
    "Do",
    "Provocation",
    "Table",
    "accepted",
    "ignored",
    "later",
    "lost",
    "no_modes",
    "pilot",
    "refused",
    "stops_sending",
]

Do = Callable[[Stage], Awaitable[object]]
Trouble = Callable[[Stage], object]


@dataclass(frozen=True)
class Provocation:
    """A call that must raise an error.

    ``place`` brings the vehicle to the required state; then ``before`` prepares the error. ``alone`` is True if the
    vehicle cannot be used afterwards.
    """

    do: Do
    place: Place = anywhere
    before: Trouble = lambda stage: None
    on: str = "ardupilot"
    alone: bool = False


Table = dict[tuple[str, str], Provocation]
"""Maps (call, error) to the provocation of the error."""


def refused(command: int, result: int = MavResult.FAILED) -> Trouble:
    """Make the vehicle refuse the command."""
    return lambda stage: stage.simulated.faults.refuse(command, result)


def ignored(command: int) -> Trouble:
    """Make the vehicle ignore the command: it neither executes nor answers it."""
    return lambda stage: stage.simulated.faults.ignore(command)


def stops_sending(stage: Stage) -> None:
    """Lose all messages in both directions."""
    stage.simulated.faults.silent = True


def lost(stage: Stage) -> None:
    """Lose the link, as when the cable is unplugged."""
    stage.wire.lose()


def pilot(stage: Stage) -> None:
    """Change the mode by the remote control."""
    stage.simulated.rc[2] = 1500  # type: ignore[union-attr]
    assert stage.simulated.set_mode(2)  # type: ignore[union-attr]


def later(do: Do, trouble: Trouble, after_s: float = 1.0, place: Place = airborne, **options: Any) -> Provocation:
    """Create a provocation whose disturbance happens during the call."""

    async def disturbed(stage: Stage) -> object:
        asyncio.get_running_loop().call_later(after_s, trouble, stage)
        return await do(stage)

    return Provocation(disturbed, place, **options)


def no_modes(stage: Stage) -> None:
    """Make the vehicle a type without modes for any purpose."""
    autopilot: Any = stage.vehicle.autopilot
    autopilot.mode_for = lambda purpose, **_: None
    autopilot.take_off = lambda *_, **__: None


def accepted(command: int) -> Trouble:
    """Make the vehicle answer ACCEPTED without executing the command."""
    return refused(command, MavResult.ACCEPTED)


def file_server(answers: dict[int, bytes | int]) -> Trouble:
    """Replace the file server by one with fixed answers by opcode: the data of an ACK, or the code of a NAK."""

    def trouble(stage: Stage) -> None:
        def handle(message: m.FileTransferProtocol, channel: Any) -> None:
            request = FtpMessage.decode(message.payload)
            data = answers.get(request.opcode, answers.get(-1, b""))
            stage.simulated.send(m.FileTransferProtocol(0, 255, 190, _reply(request, data).encode()), channel)

        stage.simulated.handlers[m.FileTransferProtocol.ID] = handle

    return trouble


def _reply(request: FtpMessage, data: bytes | int) -> FtpMessage:
    payload = bytes([data]) if isinstance(data, int) else data
    return FtpMessage(
        (request.sequence + 1) % 65536,
        MavFtpOpcode.NAK if isinstance(data, int) else MavFtpOpcode.ACK,
        session=request.session,
        size=len(payload),
        request_opcode=request.opcode,
        offset=request.offset,
        data=payload,
    )


Op = MavFtpOpcode
REFUSING = file_server({-1: int(MavFtpErr.FILENOTFOUND)})
"""A server without files."""
NONSENSE = file_server(
    {
        Op.OPENFILERO: (10_000).to_bytes(4, "little"),
        Op.READFILE: int(MavFtpErr.EOF),
        Op.BURSTREADFILE: int(MavFtpErr.EOF),
        Op.CALCFILECRC: b"\1",
        Op.LISTDIRECTORY: b"Fsame\t1\0",
    }
)
"""A server whose files end early, whose CRC-32 has one byte, and whose lists never end."""
LOSING_STATE = file_server({Op.CALCFILECRC: bytes(4)})
"""A server that confirms writing, but stores something else."""
