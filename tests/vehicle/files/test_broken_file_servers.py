"""MAVFTP servers that break the standard: every call ends, with an error that says what was wrong."""

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
    """The answers to everything but reads."""
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
async def test_a_file_that_ends_before_its_size_is_not_whole(grounded: Flight, answer: Answer) -> None:
    serve(grounded, answer)
    with pytest.raises(RemoteProtocolError, match=f"of the {SIZE} bytes"):
        await grounded.vehicle.files.read("/a")


async def test_a_block_far_beyond_the_others_is_not_waited_up_to(grounded: Flight) -> None:
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
    with pytest.raises(Exception, match="0 bytes are there"):
        await grounded.vehicle.files.read("/a", patience_s=2.0)


async def test_a_file_that_is_shorter_when_it_is_opened_again(grounded: Flight) -> None:
    """What the vehicle makes up as it is read may be: its size says nothing."""
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


@pytest.mark.parametrize(("patience_s", "waited_s"), [(2.0, 2.0), (10.0, 3.0)])
async def test_closing_is_not_waited_for_longer_than_three_seconds_when_there_is_an_error_to_tell(
    grounded: Flight, patience_s: float, waited_s: float
) -> None:
    def never_closes(request: FtpMessage) -> Iterator[FtpMessage]:
        if request.opcode != MavFtpOpcode.TERMINATESESSION:
            yield opened(request) or nak(request, MavFtpErr.FAIL)

    serve(grounded, never_closes)
    with pytest.raises(FileError, match="read /any"):
        await grounded.vehicle.files.read("/any", patience_s=patience_s)
    closings = [
        at
        for at, message in grounded.wire.sent
        if isinstance(message, FileTransferProtocol)
        and FtpMessage.decode(message.payload).opcode == MavFtpOpcode.TERMINATESESSION
    ]
    assert now() - closings[0] == pytest.approx(waited_s, abs=0.01)


@pytest.mark.parametrize("data", [b"Fa\t1\0", b""])
async def test_a_listing_without_an_end_is_an_error(grounded: Flight, data: bytes) -> None:
    serve(grounded, lambda request: iter([ack(request, data)]))
    with pytest.raises(RemoteProtocolError, match="does not end"):
        await grounded.vehicle.files.list("/")


async def test_a_size_that_is_no_number_is_not_known(grounded: Flight) -> None:
    def listing(request: FtpMessage) -> Iterator[FtpMessage]:
        yield ack(request, "Fa\t²\0".encode()) if request.offset == 0 else nak(request, MavFtpErr.EOF)

    serve(grounded, listing)
    (entry,) = await grounded.vehicle.files.list("/")
    assert (entry.name, entry.size) == ("a", None)


async def test_a_file_that_is_not_there_after_writing_is_told(grounded: Flight) -> None:
    def forgetful(request: FtpMessage) -> Iterator[FtpMessage]:
        missing = request.opcode == MavFtpOpcode.CALCFILECRC
        yield nak(request, MavFtpErr.FILENOTFOUND) if missing else ack(request, bytes(4))

    serve(grounded, forgetful)
    with pytest.raises(FileError, match="no such file"):
        await grounded.vehicle.files.write("/a", b"data")


@pytest.mark.parametrize("code", [MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND])
async def test_a_server_without_checksums_is_believed(grounded: Flight, code: MavFtpErr) -> None:
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield nak(request, code) if request.opcode == MavFtpOpcode.CALCFILECRC else ack(request)

    serve(grounded, answer)
    await grounded.vehicle.files.write("/APM/a.txt", b"written")
    assert MavFtpOpcode.CALCFILECRC in asked


async def test_what_the_first_sending_has_opened_is_closed_and_opened_anew(grounded: Flight) -> None:
    """Its answer was lost, and the server has one session and no memory of who opened it."""
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


async def test_a_refusal_of_the_first_sending_closes_nothing_of_others(grounded: Flight) -> None:
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield nak(request, MavFtpErr.FAIL)

    serve(grounded, answer)
    with pytest.raises(FileError):
        await grounded.vehicle.files.read("/a")
    assert asked == [MavFtpOpcode.OPENFILERO]


@pytest.mark.parametrize("code", [MavFtpErr.FAIL, MavFtpErr.UNKNOWNCOMMAND, MavFtpErr.FILENOTFOUND])
async def test_without_checksums_the_beginning_of_a_file_is_believed_too(
    grounded: Flight, tmp_path: Path, code: MavFtpErr
) -> None:
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


async def test_more_than_a_file_holds_is_refused_before_anything_is_sent(
    grounded: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "LARGEST", 10)
    asked: list[int] = []

    def answer(request: FtpMessage) -> Iterator[FtpMessage]:
        asked.append(request.opcode)
        yield ack(request)

    serve(grounded, answer)
    with pytest.raises(InvalidArgument, match="data of 11 bytes is not allowed: at most 10"):
        await grounded.vehicle.files.write("/a", bytes(11))
    assert asked == []
    await grounded.vehicle.files.write("/a", bytes(10), verify=False)
