"""Limits on what any station can request from a component."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest
from onboard_peers import payload_and_station

from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavFtpOpcode, MavMissionResult, MavResult
from aerokit.missions import MissionItem
from aerokit.onboard import CommandRequest
from aerokit.protocols.ftp import crc32
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


async def test_changed_intervals_leave_no_timers() -> None:
    async with payload_and_station() as (payload, station):

        @payload.message(m.RawRpm)
        def rpm() -> m.RawRpm:
            return m.RawRpm(0, 1.0)

        before = len(payload.connection.deadlines._deadlines)
        for number in range(300):
            await station.command(MavCmd.SET_MESSAGE_INTERVAL, m.RawRpm.ID, 2e9 + 1000 * number)
        await asyncio.sleep(20.0)
        assert len(payload.connection.deadlines._deadlines) <= before + 1


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


async def test_other_request_with_same_number_is_executed(tmp_path: Path) -> None:
    names = ("a", "b", "b")
    for name in names:
        (tmp_path / name).write_bytes(b"1")
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path, writable=True)
        answers = []
        for name in names:
            request = FtpPacket(0xFFFF, MavFtpOpcode.REMOVEFILE, 0, 2, data=f"/{name}".encode(), client=station.target)
            answers.append(FtpPacket.parse(await station.ask(request.message(), m.FileTransferProtocol)))
    assert not os.listdir(tmp_path)
    assert [answer.opcode for answer in answers] == [MavFtpOpcode.ACK] * 3  # the last request is a repetition


async def test_checksum_of_other_file_replaces_the_running_one(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(name.encode() * 2_000_000)
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path)
        with station.collecting(m.FileTransferProtocol) as replies:
            for name in ("a", "b", "b"):
                request = FtpPacket(0, MavFtpOpcode.CALCFILECRC, 0, 2, data=f"/{name}".encode(), client=station.target)
                station.connection.send(request.message())
            await asyncio.sleep(1.0)
    expected = crc32((tmp_path / "b").read_bytes()).to_bytes(4, "little")
    assert [FtpPacket.parse(reply).data[:4] for reply in replies] == [expected]


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


@pytest.mark.parametrize("result", [MavMissionResult.ACCEPTED, MavMissionResult.INVALID])
async def test_repeated_last_item_of_upload_is_answered_again(result: int) -> None:
    """The first answer was lost."""
    async with payload_and_station() as (payload, station):
        payload.missions.on_upload(lambda kind, items: result)
        await station.ask(m.MissionCount(*station.target, 1), m.MissionRequestInt)
        item = m.MissionItemInt(*station.target, 0, 6, 16, 0, 1, 0, 0, 0, 0, 1, 1, 1)
        with station.collecting(m.MissionAck) as acks:
            station.connection.send(item)
            await asyncio.sleep(2.0)
            station.connection.send(item)
            station.connection.send_as(FrameEncoder(200, 1), item)  # not its upload
            await asyncio.sleep(2.0)
    assert [(ack.target_system, ack.type) for ack in acks] == [(255, result)] * 2


async def test_download_during_upload_of_other_client_gets_one_plan() -> None:
    def items(z: float) -> list[MissionItem]:
        return [MissionItem(MavCmd.NAV_WAYPOINT, 6, x=1, y=1, z=z) for _ in range(2)]

    async with payload_and_station() as (payload, station):
        payload.missions.replace(items(10.0))
        await station.ask(m.MissionRequestList(*station.target), m.MissionCount)
        heights = []
        for seq in range(2):
            item = await station.ask(m.MissionRequestInt(*station.target, seq), m.MissionItemInt)
            heights.append(item.z)
            payload.missions.replace(items(20.0))
        station.connection.send(m.MissionAck(*station.target, 0))
        await asyncio.sleep(0.1)
        after = await station.ask(m.MissionRequestInt(*station.target, 1), m.MissionItemInt)
    assert (heights, after.z) == ([10.0, 10.0], 20.0)


async def test_clear_that_is_judged_occupies_the_server() -> None:
    async with payload_and_station() as (payload, station):
        judged: list[tuple[str, int]] = []

        @payload.missions.on_upload
        async def check(kind: str, items: tuple[MissionItem, ...]) -> None:
            judged.append((kind, len(items)))
            await asyncio.sleep(2.0)

        payload.missions.replace([MissionItem(16, 6, x=1, y=1)])
        clear, denied = m.MissionClearAll(*station.target), MavMissionResult.DENIED
        with station.collecting(m.MissionAck, m.MissionRequestInt) as answers:
            station.connection.send(clear)
            station.connection.send(m.MissionCount(*station.target, 2))
            station.connection.send(clear)
            station.connection.send_as(FrameEncoder(200, 1), clear)
            await asyncio.sleep(1.0)
            assert [answer.type for answer in answers] == [denied, denied]
            await asyncio.sleep(2.0)
            assert [answer.type for answer in answers[2:]] == [MavMissionResult.ACCEPTED]
        assert (payload.missions.items(), judged) == ((), [("mission", 0)])
        await station.ask(m.MissionCount(*station.target, 2), m.MissionRequestInt)


async def test_clear_is_denied_while_an_upload_is_judged() -> None:
    async with payload_and_station() as (payload, station):

        @payload.missions.on_upload
        async def check(kind: str, items: tuple[MissionItem, ...]) -> None:
            await asyncio.sleep(2.0)

        with station.collecting(m.MissionAck) as acks:
            station.connection.send(m.MissionCount(*station.target, 1))
            item = m.MissionItemInt(*station.target, 0, 6, 16, 0, 1, 0, 0, 0, 0, 1, 1, 1)
            station.connection.send(item)
            await asyncio.sleep(0.5)
            station.connection.send(m.MissionClearAll(*station.target))
            await asyncio.sleep(3.0)
        assert [ack.type for ack in acks] == [MavMissionResult.DENIED, MavMissionResult.ACCEPTED]
        assert len(payload.missions.items()) == 1


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
