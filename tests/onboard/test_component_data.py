"""Parameters, files and missions of a component, with aerokit's own client as peer."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from onboard_peers import autopilot_and_client, device_and_client, payload_and_station

import aerokit
from aerokit._internal.files import write_atomically
from aerokit.errors import AerokitError, FileError, InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    MavCmd,
    MavFtpOpcode,
    MavMissionResult,
    MavMissionType,
    MavParamError,
    MavParamExtType,
    MavType,
    ParamAck,
)
from aerokit.missions import Mission, MissionItem, waypoint
from aerokit.onboard import CommandRequest
from aerokit.onboard.files import DirectoryFiles
from aerokit.position import Position
from aerokit.protocols.servers.files import FileFault, FileTree
from aerokit.protocols.servers.ftp_packets import FtpPacket

pytestmark = pytest.mark.anyio


async def test_parameters_are_listed_read_and_set() -> None:
    async with autopilot_and_client() as (node, vehicle):
        node.parameters.add("WINCH_SPEED", 1.5, minimum=0.1, maximum=3.0, unit="m/s")
        node.parameters.add("WINCH_MODE", -5_000_000)
        node.parameters.add("WINCH_NAME", "north")
        table = await vehicle.parameters.download()
        assert {name: table[name].value for name in table} == {"WINCH_SPEED": 1.5, "WINCH_MODE": -5_000_000}
        await vehicle.parameters.set("WINCH_SPEED", 3.0)
        assert node.parameters["WINCH_SPEED"] == 3.0


@pytest.mark.parametrize("has_version", [True, False])
async def test_parameters_of_a_companion_are_downloaded_at_once(has_version: bool) -> None:
    async with device_and_client(191, MavType.ONBOARD_CONTROLLER) as (companion, vehicle):
        companion.parameters.add("WINCH_SPEED", 1.5)
        if not has_version:
            companion._streams.builders.pop(m.AutopilotVersion.ID)  # The companion answers REQUEST_MESSAGE by DENIED.
        asked: list[m.CommandLong] = []
        detach = companion.connection.attach((m.CommandLong,), asked.append)
        before = anyio.current_time()
        for _ in range(2):
            table = await vehicle.component(191).parameters.download(refresh=True)
            assert table["WINCH_SPEED"].value == 1.5
        assert anyio.current_time() - before < 1.0
        assert [c.param1 for c in asked if c.target_component == 191] == [m.AutopilotVersion.ID]
        for function in detach:
            function()


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize("is_announced", [False, True])
async def test_client_encodes_first_integer_as_component_expects(bytewise: bool, is_announced: bool) -> None:
    """Until the capabilities are known, the client does not know how the component encodes integers."""
    async with autopilot_and_client() as (node, vehicle):
        device = aerokit.component(connection=node.connection, component_id=191, bytewise=bytewise)
        async with device as component:
            component.parameters.add("SPOOL", 7)
            await anyio.sleep(2)
            parameters = vehicle.component(191).parameters
            if is_announced:
                component.parameters.set("SPOOL", 8)
                await anyio.sleep(0.1)
            result = await parameters.set("SPOOL", -5)
            assert component.parameters["SPOOL"] == -5
    assert (result.before, result.outcome) == (8 if is_announced else 7, "set")


async def test_parameter_out_of_range_is_refused() -> None:
    async with autopilot_and_client() as (node, vehicle):
        node.parameters.add("WINCH_SPEED", 1.5, minimum=0.1, maximum=3.0, unit="m/s")
        await vehicle.parameters.download()
        with pytest.raises(AerokitError, match="WINCH_SPEED"):
            await vehicle.parameters.set("WINCH_SPEED", 3.5)
        assert node.parameters["WINCH_SPEED"] == 1.5


@pytest.mark.parametrize(("bytewise", "expected"), [(False, 7), (True, 1)])
async def test_integer_sent_as_float_is_accepted_only_if_cast(bytewise: bool, expected: int) -> None:
    async with payload_and_station(bytewise=bytewise) as (payload, station):
        payload.parameters.add("SPOOL", 1)
        value = await station.ask(m.ParamSet(*station.target, "SPOOL", 7.0, 9), m.ParamValue)
    assert payload.parameters["SPOOL"] == expected
    assert type(payload.parameters["SPOOL"]) is int
    assert value.param_type == 6


async def test_parameter_is_refused_by_on_set() -> None:
    def check(value: object) -> None:
        raise InvalidArgument("not while the line is out")

    async with payload_and_station() as (payload, station):
        payload.parameters.add("SPOOL", 1, on_set=check)
        request = m.ParamSet(*station.target, "SPOOL", 2e-45, 6)
        error = await station.ask(request, m.ParamError)
    assert error.error == MavParamError.VALUE_OUT_OF_RANGE
    assert payload.parameters["SPOOL"] == 1


@pytest.mark.parametrize(
    ("name", "value", "kind", "result"),
    [
        ("NAME", b"south", MavParamExtType.CUSTOM, ParamAck.ACCEPTED),
        ("NAME", b"\x01\x00\x00\x00", MavParamExtType.INT32, ParamAck.VALUE_UNSUPPORTED),
        ("SERIAL", b"x", MavParamExtType.CUSTOM, ParamAck.FAILED),
        ("OTHER", b"x", MavParamExtType.CUSTOM, ParamAck.VALUE_UNSUPPORTED),
    ],
)
async def test_extended_parameter_set_is_acknowledged(name: str, value: bytes, kind: int, result: int) -> None:
    async with payload_and_station() as (payload, station):
        payload.parameters.add("NAME", "north")
        payload.parameters.add("SERIAL", "4711", read_only=True)
        ack = await station.ask(m.ParamExtSet(*station.target, name, value, kind), m.ParamExtAck)
    assert ack.param_result == result
    assert payload.parameters["NAME"] == ("south" if result == ParamAck.ACCEPTED else "north")


async def test_parameters_survive_in_file(tmp_path: Path) -> None:
    path = tmp_path / "payload.json"
    async with payload_and_station(parameters_file=path) as (payload, station):
        payload.parameters.add("SPEED", 1.0)
        await station.ask(m.ParamSet(*station.target, "SPEED", 2.5, 9), m.ParamValue)
    assert json.loads(path.read_text()) == {"SPEED": 2.5}
    async with payload_and_station(parameters_file=path) as (payload, _):
        payload.parameters.add("SPEED", 1.0)
        assert payload.parameters["SPEED"] == 2.5


async def test_failed_write_of_parameters_is_repeated_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "payload.json"
    failures = [OSError(28, "No space left on device")]

    def write(*arguments: Any) -> None:
        if failures:
            raise failures.pop()
        write_atomically(*arguments)

    monkeypatch.setattr("aerokit.onboard.parameters.write_atomically", write)
    async with payload_and_station(parameters_file=path) as (payload, station):
        payload.parameters.add("SPEED", 1.0)
        text = await station.ask(m.ParamSet(*station.target, "SPEED", 2.5, 9), m.Statustext)
    assert text.text.startswith("parameters could not be saved: No space")
    assert json.loads(path.read_text()) == {"SPEED": 2.5}


async def test_cancelled_program_saves_its_parameters(tmp_path: Path) -> None:
    path = tmp_path / "payload.json"
    is_closing = asyncio.Event()

    async def program() -> None:
        async with payload_and_station(parameters_file=path) as (payload, station):
            payload.parameters.add("SPEED", 1.0)

            @payload.command(MavCmd.USER_1)
            async def clean_up(_: CommandRequest) -> None:
                try:
                    await asyncio.sleep(60.0)
                finally:
                    is_closing.set()
                    await asyncio.sleep(1.0)
                    payload.parameters.set("SPEED", 2.5)

            await station.command(MavCmd.USER_1)

    task = asyncio.create_task(program())
    await is_closing.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert json.loads(path.read_text()) == {"SPEED": 2.5}


async def test_on_set_that_is_a_coroutine_function_is_refused() -> None:
    async def check(value: float) -> None:
        pass

    async with payload_and_station() as (payload, _):
        with pytest.raises(InvalidArgument, match="plain function"):
            payload.parameters.add("SPEED", 1.0, on_set=check)
        with pytest.raises(InvalidArgument, match="plain function"):
            payload.missions.on_set_current(check)


async def test_text_of_refused_value_has_all_digits() -> None:
    async with payload_and_station() as (payload, _):
        with pytest.raises(InvalidArgument, match="ID = 12345678 is not allowed"):
            payload.parameters.add("ID", 12345678, values={12345679: "left"})


async def test_metadata_describes_parameters() -> None:
    async with autopilot_and_client() as (node, vehicle):
        node.parameters.add("SPEED", 1.0, minimum=0.0, maximum=3.0, unit="m/s", description="Speed of the line")
        metadata = await vehicle.component(1).metadata("parameter")
    assert metadata["parameters"] == [
        {
            "name": "SPEED",
            "type": "Float",
            "default": 1.0,
            "shortDesc": "Speed of the line",
            "units": "m/s",
            "min": 0.0,
            "max": 3.0,
            "rebootRequired": False,
        }
    ]


async def test_files_are_listed_read_and_written(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.txt").write_bytes(b"0123456789" * 5000)
    async with autopilot_and_client() as (node, vehicle):
        node.serve_files(tmp_path, writable=True)
        assert await vehicle.files.read("/logs/a.txt") == b"0123456789" * 5000
        await vehicle.files.write("/logs/b.bin", bytes(range(256)) * 10)
        await vehicle.files.rename("/logs/b.bin", "/logs/c.bin")
        names = [entry.name for entry in await vehicle.files.list("/logs")]
    assert names == ["a.txt", "c.bin"]
    assert (tmp_path / "logs" / "c.bin").read_bytes() == bytes(range(256)) * 10


async def test_too_long_name_does_not_end_listing(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    for name in ("a", "b" * 240, "c"):
        (tmp_path / "logs" / name).write_bytes(b"1")
    async with autopilot_and_client() as (node, vehicle):
        node.serve_files(tmp_path)
        assert [entry.name for entry in await vehicle.files.list("/logs")] == ["a", "c"]


@pytest.mark.skipif(os.name == "nt", reason="needs links and pipes")
@pytest.mark.parametrize("path", ["/../secret", "/link", "/folder/secret", "/pipe", "/logs/../../secret"])
async def test_nothing_outside_the_directory_is_read(tmp_path: Path, path: str) -> None:
    root = tmp_path / "root"
    (root / "logs").mkdir(parents=True)
    (tmp_path / "secret").write_text("key")
    (root / "link").symlink_to(tmp_path / "secret")
    (root / "folder").symlink_to(tmp_path)
    os.mkfifo(root / "pipe")
    async with autopilot_and_client() as (node, vehicle):
        node.serve_files(root, writable=True)
        with pytest.raises(FileError):
            await vehicle.files.read(path)
        with pytest.raises(FileError):
            await vehicle.files.write(path, b"overwritten")
        assert [entry.name for entry in await vehicle.files.list("/")] == ["general.json", "logs", "parameter.json"]
    assert (tmp_path / "secret").read_text() == "key"


async def test_directory_is_read_only_by_default(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    async with autopilot_and_client() as (node, vehicle):
        node.serve_files(tmp_path)
        with pytest.raises(FileError):
            await vehicle.files.write("/b", b"2")
        with pytest.raises(FileError):
            await vehicle.files.remove("/a")
    assert os.listdir(tmp_path) == ["a"]


MISSION = Mission([waypoint(Position(47.3977, 8.5456, altitude_relative_m=20.0)) for _ in range(30)])


async def test_mission_is_uploaded_and_downloaded() -> None:
    uploads: list[tuple[str, int]] = []
    async with autopilot_and_client() as (node, vehicle):

        @node.missions.on_upload
        async def check(kind: str, items: tuple[MissionItem, ...]) -> None:
            uploads.append((kind, len(items)))

        await vehicle.mission.upload(MISSION)
        assert (await vehicle.mission.download()).matches(MISSION)
        assert len(node.missions.items()) == 30
        await vehicle.mission.clear()
        assert node.missions.items() == ()
    assert uploads == [("mission", 30), ("mission", 0)]


async def test_mission_id_stays_while_the_current_item_changes() -> None:
    async with payload_and_station() as (payload, station):
        payload.missions.replace([MissionItem(16, 6, x=number, y=number) for number in range(3)])
        count = await station.ask(m.MissionRequestList(*station.target), m.MissionCount)
        for index in (1, 2):
            with station.connection.subscribe(m.MissionCurrent) as stream:
                payload.missions.set_current(index)
                assert (await stream.get(5.0)).mission_id == count.opaque_id != 0
        payload.missions.replace([MissionItem(16, 6, x=1, y=1)])
        assert (await station.ask(m.MissionRequestList(*station.target), m.MissionCount)).opaque_id != count.opaque_id


@pytest.mark.parametrize("raises", [True, False])
async def test_mission_refused_by_program_is_not_stored(raises: bool) -> None:
    async with autopilot_and_client() as (node, vehicle):

        @node.missions.on_upload
        def check(kind: str, items: tuple[MissionItem, ...]) -> bool:
            if raises:
                raise InvalidArgument("no missions today")
            return False

        with pytest.raises(AerokitError):
            await vehicle.mission.upload(MISSION)
        assert node.missions.items() == ()


@pytest.mark.parametrize("is_coroutine", [True, False])
async def test_impossible_mission_result_is_error_and_connection_stays_open(is_coroutine: bool) -> None:
    async with payload_and_station() as (payload, station):

        async def check_later(kind: str, items: tuple[MissionItem, ...]) -> int:
            return 300

        payload.missions.on_upload(check_later if is_coroutine else lambda kind, items: 300)
        ack = await station.ask(m.MissionCount(*station.target, 0, MavMissionType.MISSION), m.MissionAck)
        assert payload.connection.is_open
    assert ack.type == MavMissionResult.ERROR


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of file sizes")
def test_block_that_is_written_in_part_is_refused(tmp_path: Path) -> None:
    import resource

    file = DirectoryFiles(tmp_path, FileTree(), is_writable=True).open("/a", writing=True, create=True)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(FileFault):
            file.write(0, bytes(200))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        file.close()


async def test_file_of_unfinished_checksum_is_closed_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(bytes(2_000_000))
    opened: list[Any] = []
    open_file = DirectoryFiles.open

    def open_and_keep(files: DirectoryFiles, path: str, **options: bool) -> Any:
        opened.append(open_file(files, path, **options))
        return opened[-1]

    monkeypatch.setattr(DirectoryFiles, "open", open_and_keep)
    async with payload_and_station() as (payload, station):
        payload.serve_files(tmp_path)
        request = FtpPacket(1, MavFtpOpcode.CALCFILECRC, 0, 2, data=b"/a", client=station.target)
        station.connection.send(request.message())
        await asyncio.sleep(0.001)
        assert not opened[0]._file.closed
    assert opened[0]._file.closed
