"""Flight logs on both autopilots: by MAVFTP and by LOG_*, all kinds of end, no transfer left running."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import anyio
import pytest
from flight_harness import open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import ConnectionClosed, FileError, FileTimeout, InvalidArgument
from aerokit.protocols.exchange import TransferProgress
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink, run_virtual
from aerokit.vehicle.files.files import FileEntry
from aerokit.vehicle.files.logs import LogEntry, log_path

pytestmark = pytest.mark.anyio


class Bench:
    """A simulated vehicle with flight logs, and a connection to it."""

    def __init__(self, simulated: Any, vehicle: aerokit.Vehicle, wire: Any) -> None:
        self.simulated, self.vehicle, self.wire = simulated, vehicle, wire
        self.logs = vehicle.logs
        self.server = simulated.storage.logs

    def content(self, number: int) -> bytes:
        return bytes(self.server.logs[number].make())

    def sent(self) -> int:
        kinds = (m.LogRequestList, m.LogRequestData, m.LogRequestEnd, m.LogErase, m.FileTransferProtocol)
        return sum(len(self.wire.all(kind)) for kind in kinds)

    async def wait_idle(self) -> None:
        for _ in range(100):
            if not self.server.is_busy and not self.simulated.ftp.open_sessions:
                return
            await anyio.sleep(0.05)
        raise AssertionError("the vehicle is still sending")


@asynccontextmanager
async def open_bench(kind: str) -> AsyncIterator[Bench]:
    if kind == "ardupilot":
        async with open_flight(latency_s=0.02, rates={}) as flight:
            await flight.vehicle.version.wait_until(lambda _: True)
            yield Bench(flight.copter, flight.vehicle, flight.wire)
    else:
        async with open_px4(rates={}) as flight_px4:
            await flight_px4.vehicle.version.wait_until(lambda _: True)
            yield Bench(flight_px4.px4, flight_px4.vehicle, flight_px4.wire)


@pytest.fixture(params=["ardupilot", "px4"])
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    async with open_bench(request.param) as bench:
        yield bench


@pytest.fixture
async def ardupilot() -> AsyncIterator[Bench]:
    async with open_bench("ardupilot") as bench:
        yield bench


async def test_list_returns_logs(bench: Bench) -> None:
    entries = await bench.logs.list()
    assert [entry.size for entry in entries] == [log.size for log in bench.server.logs]
    assert entries[0].id == bench.vehicle.autopilot.first_log_id
    assert entries[0].time_utc == datetime.fromtimestamp(bench.server.logs[0].time_utc, tz=timezone.utc)


async def test_read_by_messages_and_mavftp(bench: Bench) -> None:
    for number, entry in enumerate(await bench.logs.list()):
        for method in ("auto", "log"):
            assert await bench.logs.read(entry, method=method) == bench.content(number)
        assert await bench.logs.read(entry.id) == bench.content(number)
    await bench.wait_idle()


async def test_read_by_mavftp(ardupilot: Bench) -> None:
    entries = await ardupilot.logs.list()
    ardupilot.wire.clear()
    assert await ardupilot.logs.read(entries[0], method="ftp") == ardupilot.content(0)
    assert not ardupilot.wire.all(m.LogRequestData)


async def test_in_flight_only_mavftp_works(ardupilot: Bench) -> None:
    """ArduPilot ignores LOG_* messages while it is armed."""
    entries = await ardupilot.logs.list()
    await ardupilot.vehicle.wait_ready()
    await ardupilot.vehicle.arm()
    assert await ardupilot.logs.read(entries[0]) == ardupilot.content(0)
    ardupilot.wire.clear()
    with pytest.raises(FileTimeout, match="does not answer"):
        await ardupilot.logs.read(entries[0], method="log", idle_timeout_s=2.0)
    assert not ardupilot.wire.all(m.FileTransferProtocol)
    with pytest.raises(FileTimeout, match="does not answer"):
        await ardupilot.logs.list(idle_timeout_s=2.0)


async def test_download_resumes(bench: Bench, tmp_path: Path) -> None:
    entry, to = (await bench.logs.list())[0], tmp_path / "flight.bin"

    def stop(progress: TransferProgress) -> None:
        assert progress.total == entry.size
        if progress.done > 20_000:
            scope.cancel()

    with anyio.CancelScope() as scope:
        await bench.logs.download(entry, to, method="log", on_progress=stop)
    await bench.wait_idle()
    (part,) = names_in(tmp_path)
    assert part.startswith("flight.bin.log")
    reported: list[TransferProgress] = []
    await bench.logs.download(entry, to, method="log", on_progress=reported.append)
    assert reported[0].done > 20_000
    assert to.read_bytes() == bench.content(0)
    assert names_in(tmp_path) == ["flight.bin"]


async def test_download_by_mavftp(ardupilot: Bench, tmp_path: Path) -> None:
    entry = (await ardupilot.logs.list())[1]
    await ardupilot.logs.download(entry, tmp_path / "b.bin", method="ftp")
    assert (tmp_path / "b.bin").read_bytes() == ardupilot.content(1)


async def test_two_downloads_to_one_file_do_not_mix(ardupilot: Bench, tmp_path: Path) -> None:
    first, second = await ardupilot.logs.list()
    to = tmp_path / "b.bin"
    calls = (ardupilot.logs.download(entry, to, method="ftp") for entry in (first, second))
    _, refused = await asyncio.gather(*calls, return_exceptions=True)
    assert isinstance(refused, OSError)
    assert to.read_bytes() == ardupilot.content(0)
    await ardupilot.logs.download(second, to, method="ftp")
    assert to.read_bytes() == ardupilot.content(1)


async def test_missing_log_is_file_error(bench: Bench) -> None:
    with pytest.raises(FileError, match="log 77: there is no such log"):
        await bench.logs.read(77)
    entry = (await bench.logs.list())[0]
    larger = entry.replace(size=entry.size + 1)
    with pytest.raises(FileError, match=r"call list\(\) again"):
        await bench.logs.read(larger)


MORE = 30_001


@pytest.mark.sampled(4)
@pytest.mark.parametrize("clock_s", [-100, 0, 100])
@pytest.mark.parametrize(
    ("kind", "method"),
    [("ardupilot", "auto"), ("ardupilot", "log"), ("ardupilot", "ftp"), ("px4", "auto"), ("px4", "log")],
)
async def test_growing_log_is_read_to_its_current_end(
    kind: str, method: Any, clock_s: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """ArduPilot reports its clock while it writes, and afterwards the time of the file, which may be earlier."""
    async with open_bench(kind) as bench:
        entry = (await bench.logs.list())[-1]
        assert entry.time_utc is not None
        time_utc, server = int(entry.time_utc.timestamp()) + clock_s, bench.server
        server.write_on(MORE, time_utc)
        for tenths in range(1, 6):  # during the download
            bench.simulated.call_later(tenths / 10, lambda: server.write_on(100, time_utc))
        with caplog.at_level("INFO", "aerokit"):
            content = await bench.logs.read(entry, method=method)
            assert len(content) >= entry.size + MORE
            await bench.logs.download(entry, tmp_path / "flight.bin", method=method)
        assert bench.content(-1).startswith(content)
        assert bench.content(-1).startswith((tmp_path / "flight.bin").read_bytes())
        texts = [record.getMessage() for record in caplog.records]
        assert f"log {entry.id} was still being written: listed with {entry.size} byt" in texts[0]
        assert f"downloaded with {len(content)}" in texts[0]
        await bench.wait_idle()


async def test_complete_log_is_not_reported_as_growing(ardupilot: Bench, caplog: pytest.LogCaptureFixture) -> None:
    entry = (await ardupilot.logs.list())[-1]
    with caplog.at_level("INFO", "aerokit"):
        await ardupilot.logs.read(entry, method="log")
        await ardupilot.logs.read(entry, method="ftp")
    assert not [record for record in caplog.records if "being written" in record.getMessage()]


async def test_log_ended_since_listing_is_read_in_flight(ardupilot: Bench) -> None:
    """Reading a log by LOG_* ends the current one, and arming starts another."""
    older, entry = await ardupilot.logs.list()
    ardupilot.server.write_on(MORE, 1_789_996_000)
    content = ardupilot.content(-1)
    ardupilot.simulated.storage.files.put("/APM/LOGS/00000003.BIN", b"the next one")
    ardupilot.simulated.storage.files.put("/APM/LOGS/LASTLOG.TXT", b"3\r\n")
    await ardupilot.vehicle.wait_ready()
    await ardupilot.vehicle.arm()
    assert await ardupilot.logs.read(entry) == content
    with pytest.raises(FileTimeout, match="does not answer"):
        await ardupilot.logs.read(older.replace(size=older.size - 1), idle_timeout_s=2.0)


async def test_log_with_another_time_is_another_log(bench: Bench) -> None:
    entry = (await bench.logs.list())[-1]
    assert entry.time_utc is not None
    bench.server.write_on(MORE, int(entry.time_utc.timestamp()) - 100_000)
    with pytest.raises(FileError, match=r"call list\(\) again"):
        await bench.logs.read(entry, method="log")


async def test_resumed_download_of_growing_log_is_complete(ardupilot: Bench, tmp_path: Path) -> None:
    """The CRC covers more than was received, so the download restarts."""
    entry, to = (await ardupilot.logs.list())[-1], tmp_path / "flight.bin"

    def stop(progress: TransferProgress) -> None:
        if progress.done > 20_000:
            scope.cancel()

    with anyio.CancelScope() as scope:
        await ardupilot.logs.download(entry, to, method="ftp", on_progress=stop)
    assert names_in(tmp_path) == ["flight.bin.part"]
    assert entry.time_utc is not None
    time_utc = int(entry.time_utc.timestamp())
    more = [lambda: ardupilot.server.write_on(1000, time_utc)] * 3
    for number, write in enumerate(more):
        ardupilot.simulated.call_later(0.1 * number, write)
    await ardupilot.logs.download(entry, to, method="ftp")
    content = to.read_bytes()
    assert len(content) > entry.size
    assert ardupilot.content(-1).startswith(content)
    assert names_in(tmp_path) == ["flight.bin"]


async def test_invalid_log_arguments_are_refused(bench: Bench) -> None:
    bench.wire.clear()
    logs: Any = bench.logs
    for log in (-1, 65536, "1"):
        with pytest.raises(InvalidArgument, match="log"):
            await logs.read(log)
    with pytest.raises(InvalidArgument, match="method"):
        await logs.download(1, "to", method="carrier pigeon")
    with pytest.raises(InvalidArgument, match="timeout"):
        await logs.list(timeout=-1.0)
    assert bench.sent() == 0


@pytest.mark.parametrize("log_id", [0, 65535])
async def test_all_log_ids_are_accepted(bench: Bench, log_id: int) -> None:
    with suppress(FileError):
        assert await bench.logs.read(log_id) == bench.content(log_id)
    assert bench.sent() > 0


async def test_erase_removes_logs(bench: Bench) -> None:
    await bench.logs.erase()
    assert await bench.logs.list() == ()


async def test_erase_continues_while_logs_disappear(ardupilot: Bench) -> None:
    """Each LOG_ERASE removes one log, and together this takes longer than idle_timeout_s."""
    assert len(ardupilot.server.logs) > 1
    ardupilot.simulated.on(m.LogErase, lambda *_: ardupilot.server.logs.pop())
    await ardupilot.logs.erase(idle_timeout_s=1.0)
    assert await ardupilot.logs.list() == ()


async def test_erase_without_effect_times_out(ardupilot: Bench) -> None:
    ardupilot.simulated.on(m.LogErase, lambda *_: None)
    with pytest.raises(FileTimeout, match=r"logs still exist; none was erased in the last 3 s"):
        await ardupilot.logs.erase(idle_timeout_s=3.0)


async def test_erase_lost_while_log_grows_is_repeated(ardupilot: Bench) -> None:
    server, requests = ardupilot.server, []
    del server.logs[:-1]

    def lose_first(*_: object) -> None:
        requests.append(len(server.logs))
        if len(requests) == 1:
            server.write_on(500, server.logs[-1].time_utc + 1)
        else:
            server.logs.clear()

    ardupilot.simulated.on(m.LogErase, lose_first)
    await ardupilot.logs.erase()
    assert requests == [1, 1]


async def test_erase_waits_for_board_that_does_not_answer_meanwhile(ardupilot: Bench) -> None:
    faults = ardupilot.simulated.faults

    def erase(*_: object) -> None:
        ardupilot.server.logs.clear()
        faults.frozen = True
        asyncio.get_running_loop().call_later(20.0, setattr, faults, "frozen", False)

    ardupilot.simulated.on(m.LogErase, erase)
    await ardupilot.logs.erase()
    assert await ardupilot.logs.list() == ()


async def test_timeout_error_of_disk_is_raised_unchanged(ardupilot: Bench) -> None:
    by_log = ardupilot.logs._channel.operation("read", None)
    by_ftp = ardupilot.vehicle.files._channel.operation("read", timeout=None, idle_timeout_s=1.0)
    for operation in (by_log, by_ftp):
        with pytest.raises(TimeoutError, match="the disk does not answer") as raised:
            async with operation:
                raise TimeoutError("the disk does not answer")
        assert type(raised.value) is TimeoutError


@pytest.mark.parametrize("is_cancelled", [True, False])
@pytest.mark.parametrize("method", ["log", "ftp"])
async def test_waiting_read_ends_with_vehicle_block(method: Any, is_cancelled: bool) -> None:
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0.0)) as link,
        aerokit.open_connection(link) as connection,
    ):
        async with aerokit.connect(connection) as vehicle:
            await vehicle.wait_ready()
            entry = (await vehicle.logs.list())[0]
            tasks = [asyncio.create_task(vehicle.logs.read(entry, method=method)) for _ in range(2)]
            await anyio.sleep(0.02)
            if is_cancelled:
                tasks[0].cancel()
                await asyncio.sleep(0)  # The file or the transfer is now being closed in the background.
        with anyio.fail_after(30):
            results = await asyncio.gather(*tasks, return_exceptions=True)
        assert isinstance(results[1], ConnectionClosed)


@pytest.mark.exhaustive
async def test_cancellation_at_any_time_ends_the_transfer(bench: Bench) -> None:
    entry = (await bench.logs.list())[0]
    for milliseconds in range(0, 300, 37):
        with anyio.move_on_after(milliseconds / 1000):
            await bench.logs.read(entry, method="log")
        await bench.wait_idle()
    assert await bench.logs.read(entry, method="log") == bench.content(0)


async def test_timeout_limits_the_whole_call(bench: Bench) -> None:
    entry = (await bench.logs.list())[0]
    with pytest.raises(FileTimeout, match=r"not done within 0\.1 s") as raised:
        await bench.logs.read(entry, method="log", timeout=0.1)
    assert raised.value.missing
    await bench.wait_idle()


async def test_log_path_identifies_files() -> None:
    class Listing:
        """Files of a PX4 that has written its list."""

        async def list(self, path: str, *, idle_timeout_s: float) -> tuple[FileEntry, ...]:
            if path != "/fs/microsd/log":
                raise FileError("no", path=path, code=10)
            return (FileEntry("2026-11-21", None, True),)

        async def read(self, path: str, *, idle_timeout_s: float) -> bytes:
            assert path == "/fs/microsd/logdata.txt"
            return b"1795 10 /fs/microsd/log/2026-11-21/a.ulg\n1796 20 /fs/microsd/log/2026-11-21/b.ulg\n"

    files: Any = Listing()
    directories = ("/nowhere", "/fs/microsd/log")
    found = await log_path(files, directories, LogEntry(1, 20, None), 1.0)
    assert found == "/fs/microsd/log/2026-11-21/b.ulg"
    assert await log_path(files, directories, LogEntry(0, 20, None), 1.0) is None
    assert await log_path(files, directories, LogEntry(2, 20, None), 1.0) is None


@pytest.mark.parametrize(("last", "found"), [(b"3\r\n", "/logs/00000003.BIN"), (b"1\r\n", None)])
async def test_log_path_is_unknown_after_numbers_have_wrapped(last: bytes, found: str | None) -> None:
    class Listing:
        """Files of ArduPilot. The file with the highest number is the newest one only if ``last`` is its number."""

        async def list(self, path: str, *, idle_timeout_s: float) -> tuple[FileEntry, ...]:
            return tuple(FileEntry(f"{number:08}.BIN", 20, False) for number in (1, 2, 3))

        async def read(self, path: str, *, idle_timeout_s: float) -> bytes:
            assert path == "/logs/LASTLOG.TXT"
            return last

    files: Any = Listing()
    assert await log_path(files, ("/logs",), LogEntry(3, 10, None), 1.0) == found


def names_in(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


@pytest.mark.sampled(3)
@pytest.mark.parametrize("make", [SimulatedCopter, SimulatedPx4])
@pytest.mark.parametrize("loss", [0.05, 0.3])
@pytest.mark.parametrize("seed", range(2))
def test_transfer_over_bad_radio(make: Any, loss: float, seed: int) -> None:
    async def main() -> None:
        simulated = make(boot_time_s=0.0)
        async with simulated_link(simulated) as link:
            radio = FaultyLink(link, FaultModel(delay_s=0.05), seed=random.Random(seed).randrange(1000))
            async with aerokit.connect(radio, rates={}) as vehicle:
                await vehicle.version.wait_until(lambda _: True)
                model = FaultModel(delay_s=0.05, loss=loss, duplication=0.1, jitter_s=0.02)
                radio.outgoing.model = radio.incoming.model = model
                logs = simulated.storage.logs
                entries = await vehicle.logs.list()
                assert [entry.size for entry in entries] == [log.size for log in logs.logs]
                assert await vehicle.logs.read(entries[-1], method="log") == logs.logs[-1].make()
                radio.outgoing.model = radio.incoming.model = FaultModel(delay_s=0.05)
                await anyio.sleep(5.0)
                assert not logs.is_busy

    run_virtual(main())
