from __future__ import annotations

import pytest
from ftp_client import FtpClient, Op
from simulated_client import Client, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.sim import SimulatedCopter, SimulatedLog, SimulatedPx4

LOGS = (SimulatedLog(1000, 111), SimulatedLog(180, 222), SimulatedLog(5000, 333))
ALL = 0xFFFF
EVERYTHING = 0xFFFFFFFF
Vehicle = SimulatedCopter | SimulatedPx4


def vehicle_with(kind: str, logs: tuple[SimulatedLog, ...] = LOGS) -> tuple[Vehicle, Client]:
    vehicle: Vehicle
    if kind == "copter":
        vehicle = SimulatedCopter(boot_time_s=0.0, parameter_count=80, logs=logs)
    else:
        vehicle = SimulatedPx4(boot_time_s=0.0, parameter_count=70, fast_rate_hz=1.0, logs=logs)
    client = Client(vehicle)
    client.run(1.0)
    client.clear()
    return vehicle, client


def entries(client: Client, start: int = 0, end: int = ALL) -> list[m.LogEntry]:
    client.clear()
    client.send(m.LogRequestList(1, 1, start, end))
    client.run(0.2)
    return client.all(m.LogEntry)


def data(client: Client, log_id: int, offset: int = 0, count: int = EVERYTHING) -> list[m.LogData]:
    client.clear()
    client.send(m.LogRequestData(1, 1, log_id, offset, count))
    client.run(0.5)
    return client.all(m.LogData)


def content(blocks: list[m.LogData]) -> bytes:
    return b"".join(block.data[: block.count] for block in blocks)


both = pytest.mark.parametrize("kind", ["copter", "px4"])


@both
def test_logs_are_listed_and_downloaded(kind: str) -> None:
    vehicle, client = vehicle_with(kind)
    listed = entries(client)
    first = 1 if kind == "copter" else 0
    assert [(entry.id, entry.size, entry.time_utc) for entry in listed] == [
        (first + number, log.size, log.time_utc) for number, log in enumerate(LOGS)
    ]
    for entry, log in zip(listed, LOGS, strict=True):
        assert content(data(client, entry.id)) == log.make()
    assert not vehicle.storage.logs.is_busy


@both
def test_log_files_exist_until_erased(kind: str) -> None:
    vehicle, client = vehicle_with(kind)
    folder = "/APM/LOGS" if kind == "copter" else "/fs/microsd/log"
    path = f"{folder}/00000003.BIN" if kind == "copter" else f"{folder}/2026-11-21/12_00_00.ulg"
    assert FtpClient(client).download(path) == LOGS[2].make()
    client.send(m.LogErase(1, 1))
    assert path not in vehicle.files
    assert len(entries(client)) == (1 if kind == "copter" else 0)


@both
def test_erasing_logs_removes_files_and_folders_of_clients(kind: str) -> None:
    vehicle, client = vehicle_with(kind)
    folder = "/APM/LOGS" if kind == "copter" else "/fs/microsd/log"
    vehicle.files.put(f"{folder}/own/deep/file", b"1").put(f"{folder}/file", b"2")
    client.send(m.LogErase(1, 1))
    assert vehicle.files.entries(folder) == []


@both
def test_part_of_a_log_is_downloaded(kind: str) -> None:
    _, client = vehicle_with(kind)
    log_id = entries(client)[2].id
    blocks = data(client, log_id, 900, 100)
    whole = LOGS[2].make()
    assert [(block.ofs, block.count) for block in blocks] == (
        [(900, 90), (990, 10)] if kind == "copter" else [(900, 90), (990, 90)]
    )
    assert content(blocks)[:100] == whole[900:1000]


@both
def test_end_request_stops_the_transfer(kind: str) -> None:
    vehicle, client = vehicle_with(kind)
    log_id = entries(client)[2].id
    client.send(m.LogRequestData(1, 1, log_id, 0, EVERYTHING))
    assert vehicle.storage.logs.is_busy
    client.send(m.LogRequestEnd(1, 1))
    assert not vehicle.storage.logs.is_busy


def test_ardupilot_answers_list_request_without_logs() -> None:
    _, client = vehicle_with("copter", ())
    (entry,) = entries(client)
    assert (entry.id, entry.num_logs, entry.last_log_num, entry.size) == (0, 0, 0, 0)


def test_px4_ignores_list_request_without_logs() -> None:
    _, client = vehicle_with("px4", ())
    assert entries(client) == []
    assert FtpClient(client).data(Op.LISTDIRECTORY, "/fs/microsd/log") == b"S\0S\0"


def test_ardupilot_lists_a_range_and_px4_to_the_end() -> None:
    assert [entry.id for entry in entries(vehicle_with("copter")[1], 2, 2)] == [2]
    assert [entry.id for entry in entries(vehicle_with("px4")[1], 1, 1)] == [1, 2]


def test_ardupilot_sends_empty_block_beyond_the_end() -> None:
    _, client = vehicle_with("copter")
    assert [(block.ofs, block.count) for block in data(client, 2, 180)] == [(180, 0)]
    assert [(block.ofs, block.count) for block in data(client, 2)] == [(0, 90), (90, 90)]
    assert data(client, 9) == []


def test_ardupilot_ignores_requests_during_a_transfer() -> None:
    _, client = vehicle_with("copter")
    client.send(m.LogRequestData(1, 1, 3, 0, EVERYTHING))
    client.send(m.LogRequestData(1, 1, 1, 0, EVERYTHING))
    client.send(m.LogRequestList(1, 1, 0, ALL))
    client.run(0.5)
    assert {block.id for block in client.all(m.LogData)} == {3}
    assert "Log download in progress" in client.texts


def test_px4_needs_list_first_and_replaces_transfers() -> None:
    _, client = vehicle_with("px4")
    assert data(client, 0) == []
    entries(client)
    client.clear()
    client.send(m.LogRequestData(1, 1, 2, 0, EVERYTHING))
    client.send(m.LogRequestData(1, 1, 0, 0, EVERYTHING))
    client.run(0.5)
    last = [block for block in client.all(m.LogData) if block.id == 0]
    assert content(last) == LOGS[0].make()
    assert len([block for block in client.all(m.LogData) if block.id == 2]) < 56
    assert data(client, 0, 1000) == []


def test_armed_ardupilot_sends_no_logs() -> None:
    _, client = ready_copter(parameter_count=80, logs=LOGS, parameters={"DISARM_DELAY": 0})
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == 0
    assert entries(client) == []
    assert data(client, 1) == []
    assert "Disarm for log download" not in client.texts, "reported once"
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 0) == 0
    assert len(entries(client)) == 3
