"""Limits on what any station can request from a component."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from onboard_peers import payload_and_station

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavFtpOpcode, MavMissionResult, MavResult
from aerokit.onboard import CommandRequest
from aerokit.protocols.servers.commands import MAX_RUNNING_COMMANDS
from aerokit.protocols.servers.ftp_packets import FtpPacket

pytestmark = pytest.mark.anyio


async def test_commands_beyond_sixteen_are_rejected() -> None:
    async with payload_and_station() as (payload, station):

        async def wait(_: CommandRequest) -> None:
            await asyncio.sleep(60.0)

        for number in range(MAX_RUNNING_COMMANDS + 1):
            payload.command(31_010 + number)(wait)
        with station.collecting(m.CommandAck) as acks:
            for number in range(MAX_RUNNING_COMMANDS + 1):
                station.connection.send(station.command_long(31_010 + number))
            await asyncio.sleep(0.05)
    assert [(ack.command, ack.result) for ack in acks] == [(31_026, MavResult.TEMPORARILY_REJECTED)]


async def test_streams_beyond_sixty_four_are_rejected() -> None:
    async with payload_and_station() as (payload, station):

        @payload.message(m.RawRpm)
        def rpm() -> m.RawRpm:
            return m.RawRpm(0, 1.0)

        results = []
        with station.collecting(m.CommandAck) as acks:
            for component in range(1, 67):
                encoder = FrameEncoder(200, component)
                command = station.command_long(MavCmd.SET_MESSAGE_INTERVAL, m.RawRpm.ID, 10_000_000)
                station.connection.send_as(encoder, command)
            await asyncio.sleep(0.1)
            results = [ack.result for ack in acks]
    assert results.count(MavResult.ACCEPTED) == 64
    assert results.count(MavResult.TEMPORARILY_REJECTED) == 2


async def test_fifth_file_of_a_client_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    answers = []
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path)
        for number in range(5):
            request = FtpPacket(number * 2, MavFtpOpcode.OPENFILERO, 0, 2, data=b"/a", client=station.target)
            answers.append(FtpPacket.parse(await station.ask(request.message(), m.FileTransferProtocol)))
    assert [answer.session for answer in answers[:4]] == [0, 1, 2, 3]
    assert answers[4].data[0] == MavFtpErr.NOSESSIONSAVAILABLE


async def test_file_is_opened_with_session_and_number_of_mavproxy(tmp_path: Path) -> None:
    """MAVProxy closes a session that is not open, then opens a file, both with number 0 and its own session."""
    (tmp_path / "a").write_bytes(b"1")
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path)
        answers = []
        for opcode, size in ((MavFtpOpcode.TERMINATESESSION, 0), (MavFtpOpcode.OPENFILERO, 2)):
            request = FtpPacket(0, opcode, 131, size, data=b"/a", client=station.target)
            answers.append(FtpPacket.parse(await station.ask(request.message(), m.FileTransferProtocol)))
    assert [answer.opcode for answer in answers] == [MavFtpOpcode.NAK, MavFtpOpcode.ACK]
    assert answers[1].session == 131


async def test_checksum_of_missing_file_is_refused_each_time(tmp_path: Path) -> None:
    """MAVProxy begins each operation with number 0."""
    (tmp_path / "a").write_bytes(b"1")
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path)
        codes = []
        for number, opcode in ((0, MavFtpOpcode.CALCFILECRC), (2, MavFtpOpcode.NONE), (0, MavFtpOpcode.CALCFILECRC)):
            request = FtpPacket(number, opcode, 0, 5, data=b"/none", client=station.target)
            codes.append(FtpPacket.parse(await station.ask(request.message(), m.FileTransferProtocol)).data[0])
    assert codes == [MavFtpErr.FILENOTFOUND, ord("/"), MavFtpErr.FILENOTFOUND]


async def test_item_of_unknown_mission_type_is_unsupported() -> None:
    async with payload_and_station() as (payload, station):
        assert payload.missions.items() == ()
        ack = await station.ask(m.MissionRequestInt(*station.target, 0, 7), m.MissionAck)
    assert (ack.type, ack.mission_type) == (MavMissionResult.UNSUPPORTED, 7)


async def test_second_upload_is_denied_and_silent_one_is_cancelled() -> None:
    async with payload_and_station() as (payload, station):
        _ = payload.missions
        await station.ask(m.MissionCount(*station.target, 3), m.MissionRequestInt)
        with station.collecting(m.MissionAck, m.MissionRequestInt) as received:
            station.connection.send_as(FrameEncoder(200, 1), m.MissionCount(*station.target, 3))
            await asyncio.sleep(8.0)
    acks = [message.type for message in received if isinstance(message, m.MissionAck)]
    assert acks == [MavMissionResult.DENIED, MavMissionResult.OPERATION_CANCELLED]
    assert len(received) - len(acks) == 9
    assert payload.missions.items() == ()


@pytest.mark.parametrize(("count", "kind", "result"), [(2001, 0, 4), (1, 77, 3)])
async def test_impossible_upload_is_refused(count: int, kind: int, result: int) -> None:
    async with payload_and_station() as (payload, station):
        _ = payload.missions
        ack = await station.ask(m.MissionCount(*station.target, count, kind), m.MissionAck)
    assert ack.type == result


async def test_errors_of_the_program_do_not_end_the_component() -> None:
    async with payload_and_station() as (payload, station):

        @payload.message(m.RawRpm, hz=5)
        def rpm() -> m.RawRpm:
            raise RuntimeError("no sensor")

        @payload.command(MavCmd.USER_1)
        def fail(_: CommandRequest) -> None:
            raise KeyError("x")

        ack = await station.command(MavCmd.USER_1)
        ping = await station.ask(m.Ping(1, 1, 0, 0), m.Ping)
    assert (ack.result, ping.seq) == (MavResult.FAILED, 1)
