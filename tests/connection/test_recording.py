"""Recording all traffic, and running the same program on the recording."""

from __future__ import annotations

import logging
import os
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio
import pytest
from pymavlink import mavutil

from aerokit import Vehicle, connect, open_connection
from aerokit.connection.frame_observers import Recording
from aerokit.errors import BusyError, ConnectFailed, InvalidArgument, LinkLost, LinkOpenError
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude, Heartbeat
from aerokit.mavlink.tlog import read_tlog
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.transport import Peer, create_link, memory_link_pair

pytestmark = pytest.mark.anyio

HEARTBEAT = Heartbeat(2, 3, 81, 0, 3)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


async def fly(path: Path) -> None:
    """A short flight, recorded."""
    async with simulated_link(SimulatedCopter(boot_time_s=1)) as link, connect(link, record=path) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(5)
        await vehicle.land()


def senders(path: Path) -> Counter[int]:
    framer = Framer()
    return Counter(frame.system_id for _, raw in read_tlog(path) for frame in framer.receive(raw))


async def test_pymavlink_reads_every_frame_of_both_directions(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    await fly(path)
    ours = senders(path)
    assert ours[1] > 500
    assert ours[255] > 50
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    theirs: Counter[int] = Counter()
    while (message := log.recv_msg()) is not None:
        assert message.get_type() != "BAD_DATA"
        if not message.get_type().startswith("UNKNOWN"):
            theirs[message.get_srcSystem()] += 1
    log.close()
    assert theirs[255] == ours[255]
    assert ours[1] - theirs[1] < 60  # pymavlink's dialect does not have AVAILABLE_MODES and CURRENT_MODE.


async def test_late_recording_has_frames_without_subscribers(tmp_path: Path) -> None:
    near, _ = memory_link_pair()
    async with open_connection(near) as connection:
        encoder = FrameEncoder(1, 1)
        connection.bytes_received(encoder.encode(ATTITUDE), None)
        connection.record(tmp_path / "late.tlog")
        connection.bytes_received(encoder.encode(ATTITUDE), None)
    assert senders(tmp_path / "late.tlog")[1] == 1


async def test_recording_without_reception_keeps_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "last.tlog"
    await fly(path)
    before = path.read_bytes()
    near, _ = memory_link_pair()
    with pytest.raises(ConnectFailed):
        async with connect(near, record=path, timeout=3):
            pytest.fail("there is no vehicle")
    assert path.read_bytes() == before
    with pytest.raises(LinkOpenError):
        async with connect("/dev/no-such-device", record=path):
            pytest.fail("it is not there")
    assert path.read_bytes() == before


async def test_recording_replaces_older_file_with_earlier_sent_frames(
    tmp_path: Path,
) -> None:
    path = tmp_path / "last.tlog"
    await fly(path)
    near, _ = memory_link_pair()
    async with open_connection(near, record=path) as connection:
        await anyio.sleep(2.5)
        connection.bytes_received(FrameEncoder(7, 1).encode(ATTITUDE), None)
    assert senders(path) == {255: 3, 7: 1}


async def test_frames_without_subscribers_are_recorded(tmp_path: Path) -> None:
    path = tmp_path / "all.tlog"
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0)) as link,
        connect(link, record=path, rates={Attitude: 10}) as vehicle,
    ):
        await anyio.sleep(3)
        received, _ = vehicle.connection.counts(1)
    assert received <= senders(path)[1] <= received + 5  # some may come while it closes
    assert received > 50


async def test_earlier_recordings_are_kept_under_numbered_names(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "twice.tlog"
    path.write_bytes(b"second day")
    (tmp_path / "twice.1.tlog").write_bytes(b"first day")
    near, _ = memory_link_pair()
    async with open_connection(near, record=path) as connection:
        connection.bytes_received(FrameEncoder(7, 1).encode(ATTITUDE), None)
    assert senders(path)[7] == 1
    assert [(tmp_path / f"twice.{number}.tlog").read_bytes() for number in (1, 2)] == [b"first day", b"second day"]
    assert f"{path} existed and was kept as {tmp_path / 'twice.2.tlog'}" in caplog.text


def test_recordings_begun_at_once_destroy_no_file(tmp_path: Path) -> None:
    path = tmp_path / "busy.tlog"
    path.write_bytes(b"first")
    barrier, count = threading.Barrier(8), 8

    def record(number: int) -> None:
        recording = Recording(path, 0.0)
        barrier.wait(timeout=30)
        recording.write(FrameEncoder(number + 1, 1).encode(ATTITUDE), 0.0)
        recording.close()

    with ThreadPoolExecutor(count) as threads:
        list(threads.map(record, range(count)))
    files = list(tmp_path.iterdir())
    assert len(files) == count + 1
    found = sorted(b"first" if (data := file.read_bytes()) == b"first" else data[13:14] for file in files)
    assert found == sorted([b"first", *(bytes([number + 1]) for number in range(count))])


@pytest.mark.parametrize("speed", ["1", "10", "inf"])
async def test_program_runs_on_a_recorded_flight(tmp_path: Path, speed: str) -> None:
    path = tmp_path / "flight.tlog"
    await fly(path)
    highest, modes, armed = 0.0, list[str](), list[bool]()

    def note(_: object, position: object) -> None:
        nonlocal highest
        highest = max(highest, getattr(position, "altitude_relative_m", 0.0) or 0.0)

    started = anyio.current_time()
    with pytest.raises(LinkLost, match="end of"):
        async with connect(create_link(f"replay:{path}?speed={speed}"), rates={}) as vehicle:
            assert vehicle.autopilot.firmware == "ArduCopter"
            vehicle.position.observe(note)
            vehicle.mode.observe(lambda _, mode: modes.append(mode.name))
            vehicle.armed.observe(lambda _, is_armed: armed.append(is_armed))
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER", timeout=1000)
    seconds = anyio.current_time() - started
    assert highest == pytest.approx(5, abs=0.6)
    assert modes[-2:] == ["GUIDED", "LAND"]
    assert armed[0] is True
    recorded = [at for at, _ in read_tlog(path)]
    assert recorded == sorted(recorded)
    assert recorded[-1] - recorded[0] > 10
    assert seconds == pytest.approx((recorded[-1] - recorded[0]) / float(speed), abs=0.01)


async def test_unknown_messages_are_recorded(tmp_path: Path) -> None:
    """Frames are recorded in order of arrival, byte for byte."""
    path = tmp_path / "private.tlog"
    known, private = FrameEncoder(9, 1), UnknownMessageSender(9, 7)
    near, far = memory_link_pair()
    await far.open(IgnoringReceiver())
    frames = [
        known.encode(HEARTBEAT),
        private.frame(),
        known.encode(ATTITUDE),
        private.frame(),
        private.frame(),
    ]
    async with open_connection(near, record=path) as connection:
        await anyio.sleep(0.1)
        far.write(b"".join(frames))
        await anyio.sleep(0.1)
        assert connection.counts(9) == (2, 0)
    far.close()
    assert [raw for _, raw in read_tlog(path) if raw[5] == 9] == frames


async def test_recording_starts_on_request(tmp_path: Path) -> None:
    path = tmp_path / "later.tlog"
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link) as vehicle:
        await anyio.sleep(2)
        before, _ = vehicle.connection.counts(1)
        vehicle.connection.record(path)
        with pytest.raises(BusyError, match="already"):
            vehicle.connection.record(tmp_path / "second.tlog")
        await anyio.sleep(2)
        vehicle.connection.close()
        assert senders(path)[1] == vehicle.connection.counts(1)[0] - before > 50
    assert not (tmp_path / "second.tlog").exists()


async def test_crash_loses_at_most_a_second(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link, record=path):
        await anyio.sleep(5.5)
        assert senders(path)[1] > 50  # it is in the file before anything is closed


async def test_lost_link_leaves_whole_recording_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    near, far = memory_link_pair()
    async with open_connection(near, record=path) as connection, open_connection(far, heartbeat=None) as other:
        await anyio.sleep(1.5)
        for _ in range(20):
            other.send(ATTITUDE)
        await anyio.sleep(0.1)
        other.close()
        await anyio.sleep(0.1)
        assert not connection.is_open
        assert senders(path)[255] >= 20  # although the block has not been left


async def test_unwritable_file_is_refused_before_opening(tmp_path: Path) -> None:
    near, far = memory_link_pair()
    with pytest.raises(LinkOpenError, match=r"cannot record to .*No such file or directory"):
        async with connect(near, record=tmp_path / "no such folder" / "flight.tlog"):
            pytest.fail("not open")
    await far.open(IgnoringReceiver())
    far.write(b"nobody is there")
    assert far.dropped_writes == 1
    far.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
async def test_full_disk_ends_recording_but_not_flight(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.CRITICAL, "aerokit"):
        await fly(Path("/dev/full"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("end", ["flush", "close", "write"])
def test_full_disk_is_reported_once(caplog: pytest.LogCaptureFixture, end: str) -> None:
    recording, frame = Recording("/dev/full", 0.0), FrameEncoder(1, 1).encode(HEARTBEAT)
    for _ in range(100_000 if end == "write" else 1):
        recording.write(frame, 1.0)
    if end == "flush":
        recording.flush()
    recording.close()
    recording.write(frame, 2.0)
    recording.flush()
    recording.close()
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert errors == ["recording to /dev/full has ended: No space left on device"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipe_without_reader_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LinkOpenError, match="no program reads this pipe yet"):
        Recording(tmp_path / "pipe", 0.0)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipe_with_slow_reader_ends_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, frame = tmp_path / "pipe", FrameEncoder(1, 1).encode(HEARTBEAT)
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    recording = Recording(path, 0.0)
    recording.write(frame, 1.0)
    recording.flush()
    assert os.read(reader, 1000)[8:] == frame
    for _ in range(100_000):
        recording.write(frame, 1.0)
    recording.close()
    os.close(reader)
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == [
        f"recording to {path} has ended: write could not complete without blocking"
    ]


async def test_open_connection_has_its_own_recording(tmp_path: Path) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, open_connection(link) as connection:
        with pytest.raises(InvalidArgument, match="record"):
            async with connect(connection, record=tmp_path / "flight.tlog"):
                pytest.fail("nothing would be recorded")


@pytest.mark.parametrize("speed", ["1", "7", "inf"])
async def test_replay_ends_in_final_state_of_flight(tmp_path: Path, speed: str) -> None:
    path = tmp_path / "flight.tlog"
    async with simulated_link(SimulatedCopter(boot_time_s=0)) as link, connect(link, record=path) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(5)
        flown = state(vehicle)
        vehicle.connection.close()
    with pytest.raises(LinkLost, match="end of recording"):
        async with connect(f"replay:{path}?speed={speed}", rates={}) as vehicle:
            await vehicle.mode.wait_until(lambda _: False)
    replayed = state(vehicle)
    assert replayed == flown
    assert len(flown) > 25


def state(vehicle: Vehicle) -> dict[str, Any]:
    """Return all known values; the last text without its time, which is on the receiving program's clock."""
    known = {name: cell.value for name, cell in vehicle.telemetry.cells.items() if cell.is_known}
    return known | {"status_text": vehicle.status_text.value.text}


class UnknownMessageSender:
    """Sends messages that are in no dialect."""

    def __init__(self, system_id: int, component_id: int) -> None:
        self._source, self._sequence = (system_id, component_id), 0

    def frame(self) -> bytes:
        self._sequence += 1
        number = (51_234).to_bytes(3, "little")
        return bytes([0xFD, 4, 0, 0, self._sequence, *self._source, *number]) + b"mine" + b"\x12\x34"


class IgnoringReceiver:
    """The far end of a link that ignores all data."""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Ignore it."""

    def link_lost(self, error: LinkLost) -> None:
        """Ignore it."""
