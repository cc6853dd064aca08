"""Files on both autopilots: all operations, all kinds of end, no session left open."""

from __future__ import annotations

import asyncio
import errno
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest
from flight_harness import open_flight, open_px4

import aerokit
from aerokit import messages as m
from aerokit.errors import (
    ConnectionClosed,
    FileError,
    FileTimeout,
    InvalidArgument,
    VerificationFailed,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.exchange import TransferProgress
from aerokit.protocols.ftp import FtpMessage
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink, run_virtual
from aerokit.vehicle.files.files import FileEntry

pytestmark = pytest.mark.anyio

DATA = random.Random(5).randbytes(20_000)
Op = MavFtpOpcode


class Bench:
    """A simulated vehicle with files, and a connection to it."""

    def __init__(self, simulated: Any, vehicle: aerokit.Vehicle, wire: Any, root: str) -> None:
        self.simulated, self.vehicle, self.wire, self.root = simulated, vehicle, wire, root
        self.files = vehicle.files

    def put(self, name: str, data: bytes) -> str:
        """Create a file on the vehicle and return its path."""
        path = f"{self.root}/{name}"
        file = self.simulated.ftp.files.open(path, writing=True, create=True)
        file.write(0, data)
        file.close()
        return path

    def get(self, name: str) -> bytes:
        file = self.simulated.ftp.files.open(f"{self.root}/{name}")
        return bytes(file.read(0, 10_000_000))

    def sent(self) -> list[FtpMessage]:
        return [FtpMessage.decode(message.payload) for message in self.wire.all(m.FileTransferProtocol)]

    async def all_closed(self) -> None:
        """Check that within seconds the vehicle has no open session, and no task waits here."""
        for _ in range(200):
            if not self.simulated.ftp.open_sessions:
                return
            await anyio.sleep(0.05)
        raise AssertionError("a session is still open")


@asynccontextmanager
async def open_bench(kind: str) -> AsyncIterator[Bench]:
    if kind == "ardupilot":
        async with open_flight(latency_s=0.02, rates={}) as flight:
            await flight.vehicle.version.wait_until(lambda _: True)
            yield Bench(flight.copter, flight.vehicle, flight.wire, "/APM")
    else:
        async with open_px4(rates={}) as flight_px4:
            await flight_px4.vehicle.version.wait_until(lambda _: True)
            yield Bench(flight_px4.px4, flight_px4.vehicle, flight_px4.wire, "/fs/microsd")


@pytest.fixture(params=["ardupilot", "px4"])
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    async with open_bench(request.param) as bench:
        yield bench


@pytest.fixture
async def ardupilot() -> AsyncIterator[Bench]:
    async with open_bench("ardupilot") as bench:
        yield bench


@pytest.fixture
async def px4() -> AsyncIterator[Bench]:
    async with open_bench("px4") as bench:
        yield bench


# --------------------------------------------------------------------------------- operations


@pytest.mark.parametrize("size", [0, 5, 238, 239, 240, 478, 20_000])
async def test_write_read_round_trip(bench: Bench, size: int) -> None:
    path = f"{bench.root}/new.bin"
    await bench.files.write(path, DATA[:size])
    assert bench.get("new.bin") == DATA[:size]
    assert await bench.files.read(path) == DATA[:size]
    await bench.all_closed()


async def test_list_returns_entries(bench: Bench) -> None:
    before = await bench.files.list(bench.root)
    for number in range(40):
        bench.put(f"file-{number:02}.bin", DATA[:number])
    await bench.files.make_directory(f"{bench.root}/more")
    entries = set(await bench.files.list(bench.root)) - set(before)
    assert entries == {
        *(FileEntry(f"file-{number:02}.bin", number, False) for number in range(40)),
        FileEntry("more", None, True),
    }
    assert await bench.files.list(f"{bench.root}/more") == ()


async def test_rename_and_remove(bench: Bench) -> None:
    path, files = bench.put("a.bin", b"a"), bench.files
    await files.make_directory(f"{bench.root}/d")
    await files.rename(path, f"{bench.root}/d/b")
    assert await files.read(f"{bench.root}/d/b") == b"a"
    with pytest.raises(FileError):
        await files.remove_directory(f"{bench.root}/d")
    await files.remove(f"{bench.root}/d/b")
    await files.remove_directory(f"{bench.root}/d")
    with pytest.raises(FileError, match="no such file") as refused:
        await files.read(path)
    assert (refused.value.code, refused.value.path) == (MavFtpErr.FILENOTFOUND, path)


async def test_crc32_of_the_vehicle(bench: Bench) -> None:
    # The CRC-32 of "123456789" without the usual inversions.
    assert await bench.files.crc32(bench.put("check", b"123456789")) == 0x2DFD2D88


async def test_truncate(px4: Bench, ardupilot: Bench) -> None:
    path = px4.put("long", DATA)
    await px4.files.truncate(path, 100)
    assert await px4.files.read(path) == DATA[:100]
    with pytest.raises(FileError, match="truncate"):
        await ardupilot.files.truncate(ardupilot.put("long", DATA), 100)


async def test_file_system_errors(bench: Bench) -> None:
    with pytest.raises(FileError) as exists:
        await bench.files.make_directory(bench.root)
    assert exists.value.code == MavFtpErr.FILEEXISTS
    await bench.files.make_directory(f"{bench.root}/full")
    bench.put("full/x", b"x")
    with pytest.raises(FileError) as raised:
        await bench.files.remove_directory(f"{bench.root}/full")
    assert raised.value.errno in (None, errno.ENOTEMPTY, errno.EISDIR)
    await bench.all_closed()


async def test_virtual_files_are_read_to_their_end(ardupilot: Bench) -> None:
    packed = await ardupilot.files.read("@PARAM/param.pck")
    assert packed[:2] == b"\x1b\x67"
    assert len(packed) > 1000


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 239, "\ud800", 5])
async def test_invalid_paths_are_refused(ardupilot: Bench, path: Any) -> None:
    files = ardupilot.files
    calls: list[Callable[[], Any]] = [
        lambda: files.read(path),
        lambda: files.write(path, b""),
        lambda: files.list(path),
        lambda: files.remove(path),
        lambda: files.remove_directory(path),
        lambda: files.make_directory(path),
        lambda: files.rename(path, "/a"),
        lambda: files.rename("/a", path),
        lambda: files.truncate(path, 0),
        lambda: files.crc32(path),
        lambda: files.download(path, "/nowhere/at/all"),
    ]
    for call in calls:
        with pytest.raises(InvalidArgument, match="path"):
            await call()
    assert ardupilot.sent() == []


async def test_invalid_arguments_are_refused(ardupilot: Bench) -> None:
    files = ardupilot.files
    with pytest.raises(InvalidArgument, match="together"):
        await files.rename("/" + "a" * 150, "/" + "b" * 150)
    for size in (-1, 2**32):
        with pytest.raises(InvalidArgument, match="size"):
            await files.truncate("/a", size)
    for seconds in (0.0, -1.0, float("nan")):
        with pytest.raises(InvalidArgument, match="timeout"):
            await files.read("/a", timeout=seconds)
        with pytest.raises(InvalidArgument, match="idle_timeout_s"):
            await files.read("/a", idle_timeout_s=seconds)
    assert ardupilot.sent() == []


async def test_is_supported(bench: Bench) -> None:
    assert await bench.files.is_supported()


# ------------------------------------------------------------------------------- local disk


async def test_download_and_upload_copy_files(bench: Bench, tmp_path: Path) -> None:
    source, to = tmp_path / "source", tmp_path / "to"
    source.write_bytes(DATA)
    reported: list[TransferProgress] = []
    await bench.files.upload(source, f"{bench.root}/copy", on_progress=reported.append)
    assert bench.get("copy") == DATA
    assert (reported[-1].done, reported[-1].total, reported[-1].fraction) == (len(DATA), len(DATA), 1.0)
    reported.clear()
    await bench.files.download(f"{bench.root}/copy", to, on_progress=reported.append)
    assert to.read_bytes() == DATA
    assert (reported[-1].done, reported[-1].total) == (len(DATA), len(DATA))
    assert reported[-1].rate > 0
    assert names_in(tmp_path) == ["source", "to"]


async def test_download_resumes(bench: Bench, tmp_path: Path) -> None:
    path, to, part = bench.put("long", DATA), tmp_path / "to", tmp_path / "to.part"

    def stop(progress: TransferProgress) -> None:
        if progress.done > 5000:
            scope.cancel()

    with anyio.CancelScope() as scope:
        await bench.files.download(path, to, on_progress=stop)
    kept = part.read_bytes()
    assert DATA.startswith(kept)
    assert len(kept) > 5000
    assert not to.exists()
    await bench.all_closed()
    reported: list[TransferProgress] = []
    await bench.files.download(path, to, resume=True, on_progress=reported.append)
    assert to.read_bytes() == DATA
    assert reported[0].done > len(kept)


async def test_resume_detects_another_file(bench: Bench, tmp_path: Path) -> None:
    path, to = bench.put("long", DATA), tmp_path / "to"
    for wrong in (b"x" * 1000, b"x" * len(DATA), b"x" * (len(DATA) + 5)):
        (tmp_path / "to.part").write_bytes(wrong)
        await bench.files.download(path, to, resume=True)
        assert to.read_bytes() == DATA


async def test_download_without_resume_discards_the_part(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "to.part").write_bytes(b"x" * 1000)
    await bench.files.download(bench.put("long", DATA), tmp_path / "to")
    assert (tmp_path / "to").read_bytes() == DATA


async def test_local_disk_errors_propagate(ardupilot: Bench, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        await ardupilot.files.download("/APM/a", tmp_path / "nowhere" / "to")
    with pytest.raises(OSError, match="nothing"):
        await ardupilot.files.upload(tmp_path / "nothing", "/APM/a")
    assert ardupilot.sent() == []
    with pytest.raises(FileError):
        await ardupilot.files.download("/APM/none", tmp_path / "to")
    assert names_in(tmp_path) == []


# ------------------------------------------------------------------ errors and cancellation


@pytest.mark.exhaustive
async def test_cancellation_at_any_time_closes_the_session(bench: Bench) -> None:
    path = bench.put("long", DATA)
    for milliseconds in range(0, 400, 23):
        for call in (bench.files.read(path), bench.files.write(f"{bench.root}/w", DATA)):
            with anyio.move_on_after(milliseconds / 1000):
                await call
        await bench.all_closed()
    assert await bench.files.read(path) == DATA


async def test_cancelled_transfer_closes_immediately(ardupilot: Bench) -> None:
    path = ardupilot.put("long", DATA)
    with anyio.move_on_after(0.06):
        await ardupilot.files.read(path)
    assert ardupilot.sent()[-1].opcode == Op.TERMINATESESSION


async def test_timeout_limits_the_whole_call(bench: Bench) -> None:
    path = bench.put("long", DATA)
    bench.simulated.faults.loss = 0.0
    with pytest.raises(FileTimeout, match=r"not done within 0\.015 s") as raised:
        await bench.files.read(path, timeout=0.015)
    assert raised.value.missing
    await bench.all_closed()


async def test_silent_vehicle_times_out(bench: Bench) -> None:
    bench.simulated.faults.no_ftp = True
    for call in (bench.files.read("/a", idle_timeout_s=2.0), bench.files.list("/a", idle_timeout_s=2.0)):
        with pytest.raises(FileTimeout, match="no answer"):
            await call
    assert len(bench.sent()) < 80
    bench.simulated.faults.no_ftp = False
    assert await bench.files.read(bench.put("a", b"a")) == b"a"


async def test_operations_are_serialized(bench: Bench) -> None:
    paths = [bench.put(f"f{number}", DATA[: 1000 * number]) for number in range(5)]
    read: dict[int, bytes] = {}

    async def fetch(number: int) -> None:
        read[number] = await bench.files.read(paths[number])

    async with anyio.create_task_group() as tasks:
        for number in range(5):
            tasks.start_soon(fetch, number)
    assert read == {number: DATA[: 1000 * number] for number in range(5)}
    assert list(read) == sorted(read)


async def test_block_exit_ends_operations() -> None:
    async with open_flight(latency_s=0.02, rates={}) as flight:
        reading = asyncio.ensure_future(flight.vehicle.files.read("@PARAM/param.pck"))
        await anyio.sleep(0.05)
    with pytest.raises(ConnectionClosed):
        await reading
    with pytest.raises(ConnectionClosed):
        await flight.vehicle.files.read("/a")


async def test_session_closed_by_vehicle_is_reopened(bench: Bench) -> None:
    path = bench.put("long", DATA)
    rest = iter([True])

    def restart(progress: TransferProgress) -> None:
        if progress.done > 4000 and next(rest, False):
            bench.simulated.ftp.restart()

    assert await bench.files.read(path, on_progress=restart) == DATA
    rest = iter([True])
    await bench.files.write(f"{bench.root}/w", DATA, on_progress=restart)
    assert bench.get("w") == DATA
    await bench.all_closed()


async def test_session_of_another_program_is_awaited(bench: Bench) -> None:
    """The other program has died with a file open: the vehicle closes it after a time-out."""
    path = bench.put("long", DATA)
    request = FtpMessage(77, Op.OPENFILERO, 200, len(path), data=path.encode())
    bench.wire.write(frame_of(m.FileTransferProtocol(0, bench.vehicle.system_id, 1, request.encode())))
    await anyio.sleep(0.2)
    assert bench.simulated.ftp.open_sessions == 1
    started = asyncio.get_running_loop().time()
    assert await bench.files.read(path) == DATA
    assert asyncio.get_running_loop().time() - started > 2.0
    await bench.all_closed()


async def test_active_session_of_another_program_is_not_closed(px4: Bench) -> None:
    path = px4.put("long", DATA)
    request = FtpMessage(77, Op.OPENFILERO, 0, len(path), data=path.encode())
    frame = frame_of(m.FileTransferProtocol(0, px4.vehicle.system_id, 1, request.encode()))
    px4.wire.write(frame)
    await anyio.sleep(0.2)
    with pytest.raises(FileError, match="another program") as refused:
        await px4.files.read(path, idle_timeout_s=3.0)
    assert refused.value.code == MavFtpErr.NOSESSIONSAVAILABLE
    assert px4.simulated.ftp.open_sessions == 1


async def test_write_is_verified(ardupilot: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    path = "/APM/new.bin"
    tree = ardupilot.simulated.ftp.files
    opened = tree.open

    def damaging(*args: Any, **options: Any) -> Any:
        file = opened(*args, **options)
        write = file.write
        if options.get("writing"):
            monkeypatch.setattr(file, "write", lambda offset, data: write(offset, b"?" + data[1:]))
        return file

    monkeypatch.setattr(tree, "open", damaging)
    with pytest.raises(VerificationFailed, match="CRC-32") as raised:
        await ardupilot.files.write(path, DATA)
    assert raised.value.differences
    await ardupilot.files.write(path, DATA, verify=False)


def names_in(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def frame_of(message: m.FileTransferProtocol) -> bytes:
    """The request as sent by another ground station."""
    return FrameEncoder(250, 190).encode(message)


# ------------------------------------------------------------------------------------ bad radio


@pytest.mark.sampled(5)
@pytest.mark.parametrize("make", [SimulatedCopter, SimulatedPx4])
@pytest.mark.parametrize("loss", [0.05, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_transfer_over_bad_radio(make: Any, loss: float, seed: int) -> None:
    async def main() -> None:
        simulated = make(boot_time_s=0.0)
        async with simulated_link(simulated) as link:
            radio = FaultyLink(link, FaultModel(delay_s=0.05), seed=seed)
            async with aerokit.connect(radio, rates={}) as vehicle:
                await vehicle.version.wait_until(lambda _: True)
                model = FaultModel(delay_s=0.05, loss=loss, duplication=0.1, jitter_s=0.02, corruption=0.02)
                radio.outgoing.model = radio.incoming.model = model
                root = "/APM" if make is SimulatedCopter else "/fs/microsd"
                await vehicle.files.write(f"{root}/x", DATA[:8000])
                assert await vehicle.files.read(f"{root}/x") == DATA[:8000]
                await vehicle.files.make_directory(f"{root}/d")
                await vehicle.files.rename(f"{root}/x", f"{root}/d/x")
                assert [entry.name for entry in await vehicle.files.list(f"{root}/d")] == ["x"]
                await vehicle.files.remove(f"{root}/d/x")
                await vehicle.files.remove_directory(f"{root}/d")
                radio.outgoing.model = radio.incoming.model = FaultModel(delay_s=0.05)
                await anyio.sleep(5.0)
                assert simulated.ftp.open_sessions == 0

    run_virtual(main())
