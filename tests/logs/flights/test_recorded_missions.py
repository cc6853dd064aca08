"""Missions in recordings: transferred item by item, or as ArduPilot's file by MAVFTP."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

import aerokit
from aerokit.logs.flights import read_flight
from aerokit.logs.flights.tlog_missions import RecordedMission
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFtpOpcode
from aerokit.missions import Mission, MissionItem, take_off, waypoint
from aerokit.missions.wire import NO_CLEAR, pack_items
from aerokit.protocols.ftp import FtpMessage
from aerokit.testing import open_flight, run_virtual

PATH = b"@MISSION/mission.dat"


@pytest.mark.parametrize("method", ["ftp", "items"])
def test_recording_has_the_uploaded_mission(method: Any, tmp_path: Path) -> None:
    log = tmp_path / "flight.tlog"

    async def upload() -> None:
        async with (
            open_flight("copter", connect=False) as flight,
            aerokit.connect(flight.link, record=log) as vehicle,
        ):
            await vehicle.wait_ready()
            there = vehicle.position.value.offset(north_m=50)
            mission = Mission([take_off(12), waypoint(there, altitude_relative_m=15)])
            await vehicle.mission.upload(mission, method=method)

    run_virtual(upload())
    items = read_flight(log).mission[1:]
    assert [(item.number, item.command, item.altitude_m) for item in items] == [(1, 22, 12.0), (2, 16, 15.0)]


def ftp(opcode: int, **fields: Any) -> m.FileTransferProtocol:
    return m.FileTransferProtocol(0, 1, 1, FtpMessage(0, opcode, **fields).encode())


def recorded(messages: list[m.FileTransferProtocol]) -> list[tuple[int, int]]:
    mission = RecordedMission(1)
    for message in messages:
        mission.on_message(0.0, message)
    return [(item.number, item.command) for item in mission.waypoints]


def written(items: list[MissionItem], *, first: int = 0, options: int = 0) -> list[m.FileTransferProtocol]:
    data = pack_items(items, first=first, options=options)
    blocks = [data[start : start + 100] for start in range(0, len(data), 100)]
    return [
        ftp(MavFtpOpcode.CREATEFILE, size=len(PATH), data=PATH),
        *(ftp(MavFtpOpcode.WRITEFILE, size=len(b), offset=100 * n, data=b) for n, b in enumerate(blocks)),
    ]


def items(*commands: int) -> list[MissionItem]:
    return [MissionItem(command, 6, x=10 * number, y=20, z=5.0) for number, command in enumerate(commands, 1)]


def test_blocks_in_any_order_make_the_mission() -> None:
    opening, *blocks = written(items(16, 22, 16, 16, 21))
    for seed in range(20):
        shuffled = [*blocks, *blocks]
        random.Random(seed).shuffle(shuffled)
        assert recorded([opening, *shuffled]) == [(0, 16), (1, 22), (2, 16), (3, 16), (4, 21)]


def test_missing_block_leaves_the_mission_before() -> None:
    before, (opening, _, *rest) = written(items(16, 22)), written(items(16, 16, 16, 16, 16))
    assert recorded([*before, opening, *rest]) == [(0, 16), (1, 22)]


def test_partial_file_replaces_its_items_only() -> None:
    assert recorded([*written(items(16, 22, 16)), *written(items(21), first=2, options=NO_CLEAR)]) == [
        (0, 16),
        (1, 22),
        (2, 21),
    ]


def test_other_files_and_damaged_files_are_no_mission() -> None:
    opening, *blocks = written(items(16, 22))
    other = ftp(MavFtpOpcode.CREATEFILE, size=9, data=b"/logs/1.x")
    assert recorded([other, *blocks]) == []
    assert recorded([opening, ftp(MavFtpOpcode.WRITEFILE, size=40, data=b"x" * 40), *blocks]) == []


def test_file_that_is_read_is_the_mission() -> None:
    data = pack_items(items(16, 22))
    opening = ftp(MavFtpOpcode.OPENFILERO, size=len(PATH), data=PATH)
    blocks = [
        ftp(MavFtpOpcode.ACK, request_opcode=opcode, size=43, offset=start, data=data[start : start + 43])
        for start, opcode in ((0, MavFtpOpcode.READFILE), (43, MavFtpOpcode.BURSTREADFILE))
    ]
    assert recorded([opening, *blocks]) == [(0, 16), (1, 22)]
