"""How an error is provoked: where, what is done to the vehicle before, and the call that must raise it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from call_stage import Place, Stage, airborne, anywhere

from aerokit import messages as m
from aerokit.mavlink.enums import MavFtpOpcode, MavResult
from aerokit.protocols.ftp_message import FtpMessage

__all__ = ["Do", "Provocation", "falls_silent", "garbage", "ignored", "later", "lost", "pilot", "refused"]

Do = Callable[[Stage], Awaitable[object]]
Trouble = Callable[[Stage], object]


@dataclass(frozen=True)
class Provocation:
    """``before`` is done once the vehicle is in its place. ``alone``: nothing can be done with the vehicle afterwards."""

    do: Do
    place: Place = anywhere
    before: Trouble = lambda stage: None
    on: str = "ardupilot"
    alone: bool = False


def refused(command: int, result: int = MavResult.FAILED) -> Trouble:
    """The vehicle refuses this command."""
    return lambda stage: stage.simulated.faults.refuse(command, result)


def ignored(command: int) -> Trouble:
    """The vehicle neither does this command nor answers."""
    return lambda stage: stage.simulated.faults.ignore(command)


def falls_silent(stage: Stage) -> None:
    """Nothing comes through."""
    stage.simulated.faults.silent = True


def lost(stage: Stage) -> None:
    """The cable is pulled out."""
    stage.wire.lose()


def pilot(stage: Stage) -> None:
    """The mode switch is turned."""
    stage.simulated.rc[2] = 1500  # type: ignore[union-attr]
    assert stage.simulated.set_mode(2)  # type: ignore[union-attr]


def later(do: Do, trouble: Trouble, after_s: float = 1.0, place: Place = airborne, **options: Any) -> Provocation:
    """The trouble comes while the call is under way."""

    async def disturbed(stage: Stage) -> object:
        asyncio.get_running_loop().call_later(after_s, trouble, stage)
        return await do(stage)

    return Provocation(disturbed, place, **options)


def garbage(stage: Stage) -> None:
    """A file server that gives much less than it promised, no CRC-32, and lists without an end."""

    def handle(message: m.FileTransferProtocol, channel: Any) -> None:
        request = FtpMessage.decode(message.payload)
        data = {
            MavFtpOpcode.OPENFILERO: (10_000).to_bytes(4, "little"),
            MavFtpOpcode.CALCFILECRC: b"\1",
            MavFtpOpcode.LISTDIRECTORY: b"Fsame\t1\0",
            MavFtpOpcode.BURSTREADFILE: bytes(300),
            MavFtpOpcode.READFILE: bytes(300),
        }.get(MavFtpOpcode(request.opcode), b"")
        reply = FtpMessage(
            (request.sequence + 1) % 65536,
            MavFtpOpcode.ACK,
            session=request.session,
            size=len(data[:239]),
            request_opcode=request.opcode,
            offset=request.offset,
            data=data[:239],
        )
        stage.simulated.send(m.FileTransferProtocol(0, 255, 190, reply.encode()), channel)

    stage.simulated.handlers[m.FileTransferProtocol.ID] = handle
