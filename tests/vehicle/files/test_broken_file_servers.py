"""MAVFTP servers that violate the standard: every call ends with an error that names the violation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from flight_harness import Flight, now

from aerokit.errors import FileError, InvalidArgument, RemoteProtocolError
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.ftp import DATA_SIZE, FtpMessage
from aerokit.vehicle.files import files

pytestmark = pytest.mark.anyio

SIZE = 10_000
Answer = Callable[[FtpMessage], Iterator[FtpMessage]]


def ack(request: FtpMessage, data: bytes = b"", *, offset: int | None = None, number: int = 1) -> FtpMessage:
    return FtpMessage(
        (request.sequence + number) % 65536,
        MavFtpOpcode.ACK,
        session=request.session,
        size=len(data),
        request_opcode=request.opcode,
        offset=request.offset if offset is None else offset,
        data=data,
    )


def nak(request: FtpMessage, code: int) -> FtpMessage:
    return FtpMessage(
        (request.sequence + 1) % 65536,
        MavFtpOpcode.NAK,
        session=request.session,
        size=1,
        request_opcode=request.opcode,
        offset=request.offset,
        data=bytes([code]),
    )


def serve(flight: Flight, answer: Answer) -> None:
    copter = flight.copter

    def handle(message: FileTransferProtocol, channel: Any) -> None:
        for reply in answer(FtpMessage.decode(message.payload)):
            copter.send(FileTransferProtocol(0, 255, 190, reply.encode()), channel)

    copter.handlers[FileTransferProtocol.ID] = handle


def opened(request: FtpMessage) -> FtpMessage | None:
    """Answers to all requests except reads."""
    if request.opcode == MavFtpOpcode.OPENFILERO:
        return ack(request, SIZE.to_bytes(4, "little"))
    if request.opcode in (MavFtpOpcode.BURSTREADFILE, MavFtpOpcode.READFILE):
        return None
    return ack(request)


def short_block(request: FtpMessage) -> Iterator[FtpMessage]:
    yield opened(request) or ack(request, b"x" * 100)


def end_at_once(request: FtpMessage) -> Iterator[FtpMessage]:
    yield opened(request) or nak(request, MavFtpErr.EOF)


def empty_blocks(request: FtpMessage) -> Iterator[FtpMessage]:
    if request.opcode == MavFtpOpcode.BURSTREADFILE:
        yield nak(request, MavFtpErr.UNKNOWNCOMMAND)
    else:
        yield opened(request) or ack(request)


@pytest.mark.parametrize("answer", [short_block, end_at_once, empty_blocks])
async def test_file_shorter_than_its_size_is_an_error(grounded: Flight, answer: Answer) -> None:
    serve(grounded, answer)
    with pytest.raises(RemoteProtocolError, match=f"its size is {SIZE}"):
        await grounded.vehicle.files.read("/a")


async def test_block_far_ahead_is_ignored(grounded: Flight) -> None:
    def far_and_near(request: FtpMessage) -> Iterator[FtpMessage]:
        if request.opcode == MavFtpOpcode.OPENFILERO:
            yield ack(request, (0xFFFF_FFFF).to_bytes(4, "little"))
        elif request.opcode == MavFtpOpcode.BURSTREADFILE:
            yield ack(request, b"y" * DATA_SIZE, offset=request.offset + 65536 * 200 * DATA_SIZE)
        else:
            yield nak(request, MavFtpErr.FAIL)

    serve(grounded, far_and_near)
    with pytest.raises(FileError):
        await grounded.vehicle.files.crc32("/a")
    with pytest.raises(Exception, match="0 bytes received"):
        await grounded.vehicle.files.read("/a", idle_timeout_s=2.0)


async def test_file_shrinking_before_reopen_is_an_error(grounded: Flight) -> None:
    """Virtual files are exempt: their size is unknown until they are read."""
    openings = 0

    def shrinks(request: FtpMessage) -> Iterator[FtpMessage]:
        nonlocal openings
        if request.opcode == MavFtpOpcode.OPENFILERO:
            openings += 1
            yield ack(request, (SIZE if openings == 1 else 500).to_bytes(4, "little"))
        elif opened(request) is not None:
            yield ack(request)
        elif openings == 1 and request.offset < 2000:
            yield ack(request, b"x" * DATA_SIZE)
        else:
            yield nak(request, MavFtpErr.INVALIDSESSION if openings == 1 else MavFtpErr.EOF)

    serve(grounded, shrinks)
    with pytest.raises(RemoteProtocolError, match="became shorter"):
        await grounded.vehicle.files.read("/a")
    openings = 0
    assert 500 < len(await grounded.vehicle.files.read("@PARAM/param.pck")) < SIZE


@pytest.mark.parametrize(("idle_timeout_s", "waited_s"), [(2.0, 2.0), (10.0, 3.0)])
async def test_error_waits_at_most_3_s_for_close(grounded: Flight, idle_timeout_s: float, waited_s: float) -> None:
    def never_closes(request: FtpMessage) -> Iterator[FtpMessage]:
        if request.opcode != MavFtpOpcode.TERMINATESESSION:
            yield opened(request) or nak(request, MavFtpErr.FAIL)

    serve(grounded, never_closes)
    with pytest.raises(FileError, match="read /any"):
        await grounded.vehicle.files.read("/any", idle_timeout_s=idle_timeout_s)
    closings = [
        at
        for at, message in grounded.wire.sent
        if isinstance(message, FileTransferProtocol)
        and FtpMessage.decode(message.payload).opcode == MavFtpOpcode.TERMINATESESSION
    ]
    assert now() - closings[0] == pytest.approx(waited_s, abs=0.01)


async def test_link_lost_while_closing_does_not_replace_error_of_reading(grounded: Flight) -> None:
    def loses_link(request: FtpMessage) -> Iterator[FtpMessage]:
        if request.opcode == MavFtpOpcode.TERMINATESESSION:
            grounded.wire.lose()
        else:
            yield opened(request) or nak(request, MavFtpErr.FILEPROTECTED)

    serve(grounded, loses_link)
    with pytest.raises(FileError) as raised:
        await grounded.vehicle.files.read("/any")
    assert raised.value.code == MavFtpErr.FILEPROTECTED


@pytest.mark.parametrize("data", [b"Fa\t1\0", b""])
async def test_endless_listing_is_an_error(grounded: Flight, data: bytes) -> None:
    serve(grounded, lambda request: iter([ack(request, data)]))
    with pytest.raises(RemoteProtocolError, match="does not end"):
        await grounded.vehicle.files.list("/")


async def test_listing_invalid_size_is_none(grounded: Flight) -> None:
    def listing(request: FtpMessage) -> Iterator[FtpMessage]:
        yield ack(request, "Fa\t²\0".encode()) if request.offset == 0 else nak(request, MavFtpErr.EOF)

    serve(grounded, listing)
    (entry,) = await grounded.vehicle.files.list("/")
    assert (entry.name, entry.size) == ("a", None)


async def test_write_of_vanished_file_raises(grounded: Flight) -> None:
    def lacks_checksums(request: FtpMessage) -> Iterator[FtpMessage]:
        missing = request.opcode == MavFtpOpcode.CALCFILECRC
        yield nak(request, MavFtpErr.FILENOTFOUND) if missing else ack(request, bytes(4))

    serve(grounded, lacks_checksums)
    with pytest.raises(FileError, match="no such file"):
        await grounded.vehicle.files.write("/a", b"data")


@pytest.mark.parametrize("code", [MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND])
async def test_write_without_crc_support_is_trusted(grounded: Flight, code: MavFtpErr) -> None:
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield nak(request, code) if request.opcode == MavFtpOpcode.CALCFILECRC else ack(request)

    serve(grounded, answer)
    await grounded.vehicle.files.write("/APM/a.txt", b"written")
    assert MavFtpOpcode.CALCFILECRC in asked


async def test_session_of_lost_reply_is_closed_and_reopened(grounded: Flight) -> None:
    """The answer was lost, and the server has a single session without an owner."""
    asked: list[MavFtpOpcode] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        opcode = MavFtpOpcode(request.opcode)
        asked.append(opcode)
        is_open = MavFtpOpcode.TERMINATESESSION not in asked
        if opcode == MavFtpOpcode.OPENFILERO and is_open:
            if len(asked) > 1:
                yield nak(request, MavFtpErr.FAIL)
        elif opcode == MavFtpOpcode.OPENFILERO:
            yield ack(request, (3).to_bytes(4, "little"))
        elif opcode == MavFtpOpcode.BURSTREADFILE:
            yield ack(request, b"abc")
        else:
            yield ack(request)

    serve(grounded, answer)
    assert await grounded.vehicle.files.read("/a") == b"abc"
    opens = [at for at, opcode in enumerate(asked) if opcode == MavFtpOpcode.OPENFILERO]
    assert asked[opens[1] : opens[2]] == [MavFtpOpcode.OPENFILERO, MavFtpOpcode.TERMINATESESSION]


async def test_refused_open_closes_no_other_session(grounded: Flight) -> None:
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield nak(request, MavFtpErr.FAIL)

    serve(grounded, answer)
    with pytest.raises(FileError):
        await grounded.vehicle.files.read("/a")
    assert asked == [MavFtpOpcode.OPENFILERO]


@pytest.mark.parametrize("code", [MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND, MavFtpErr.FILENOTFOUND])
async def test_resume_without_crc_support_is_trusted(grounded: Flight, tmp_path: Path, code: MavFtpErr) -> None:
    content = b"x" * 500

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        if request.opcode == MavFtpOpcode.OPENFILERO:
            yield ack(request, len(content).to_bytes(4, "little"))
        elif request.opcode in (MavFtpOpcode.BURSTREADFILE, MavFtpOpcode.READFILE):
            data = content[request.offset : request.offset + DATA_SIZE]
            yield ack(request, data) if data else nak(request, MavFtpErr.EOF)
        elif request.opcode == MavFtpOpcode.CALCFILECRC:
            yield nak(request, code)
        else:
            yield ack(request)

    serve(grounded, answer)
    (tmp_path / "to.part").write_bytes(b"y" * DATA_SIZE)
    if code == MavFtpErr.FILENOTFOUND:
        with pytest.raises(FileError, match="no such file"):
            await grounded.vehicle.files.download("/a", tmp_path / "to", resume=True)
    else:
        await grounded.vehicle.files.download("/a", tmp_path / "to", resume=True)
        assert (tmp_path / "to").read_bytes() == b"y" * DATA_SIZE + content[DATA_SIZE:]


async def test_oversized_write_is_refused(grounded: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_FILE_SIZE", 10)
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield ack(request)

    serve(grounded, answer)
    with pytest.raises(InvalidArgument, match="data of 11 bytes is not allowed: it must have at most 10"):
        await grounded.vehicle.files.write("/a", bytes(11))
    assert asked == []
    await grounded.vehicle.files.write("/a", bytes(10), verify=False)
