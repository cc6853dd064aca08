"""Telemetry logs: writing, reading, and damaged files."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from framer_harness import good_frames, noise, some_frames, unknown
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from recorded import recording

from aerokit.errors import InvalidArgument
from aerokit.mavlink import FrameEncoder, Framer, TlogWriter, read_tlog
from aerokit.mavlink.messages import V2Extension

START = 1_700_000_000.0
Records = list[tuple[float, bytes]]


def written(records: Records) -> bytes:
    file = io.BytesIO()
    with TlogWriter(file) as writer:
        for when, raw in records:
            writer.write(raw, when)
    return file.getvalue()


def stamped(frames: list[bytes]) -> Records:
    return [(START + number / 64, raw) for number, raw in enumerate(frames)]


def read(data: bytes) -> Records:
    return list(read_tlog(io.BytesIO(data)))


@given(good_frames)
def test_tlog_round_trip(frames: list[bytes]) -> None:
    assert read(written(stamped(frames))) == stamped(frames)


def test_tlog_golden_bytes() -> None:
    raw = some_frames(1)[0]
    assert written([(1.5, raw)]) == (1_500_000).to_bytes(8, "big") + raw


def test_tlog_keeps_microseconds() -> None:
    raw = some_frames(1)[0]
    assert read(written([(1_700_000_000.123456, raw)])) == [(1_700_000_000.123456, raw)]


def test_tlog_with_unset_clock() -> None:
    records = [(number / 8, raw) for number, raw in enumerate(some_frames(5))]
    assert read(written(records)) == records


def test_tlog_zeros_in_truncated_frame_are_not_timestamp() -> None:
    # The bytes 0xFE and 46 look like a MAVLink 1 frame, and the eight bytes before them like a time near 0.
    raw = FrameEncoder(1, 1).encode(V2Extension(0, 85, 0, 0x2EFE, bytes(range(1, 250))))
    assert read(written(stamped([raw]))[:72]) == []


def test_tlog_keeps_unknown_and_signed_frames() -> None:
    frames = [unknown(), *some_frames(2)]
    assert read(written(stamped(frames))) == stamped(frames)


def test_tlog_empty_file() -> None:
    assert read(b"") == []
    assert read(b"\0" * 7) == []


@given(good_frames, st.integers(0, 4000))
def test_tlog_truncated_file(frames: list[bytes], left: int) -> None:
    records = stamped(frames)
    data = written(records)
    left %= len(data)
    whole, size = 0, 0
    for _, raw in records:
        size += 8 + len(raw)
        whole += size <= left
    assert read(data[:left]) == records[:whole]


@given(st.lists(st.tuples(good_frames, noise), min_size=1, max_size=3))
def test_tlog_skips_noise_between_records(parts: list[tuple[list[bytes], bytes]]) -> None:
    """A recorder stopped in the middle of a record continues the same file."""
    records: Records = []
    data = b""
    for frames, garbage in parts:
        new = stamped(frames)
        data += garbage + written(new)
        records += new
    found = read(data)
    framer = Framer()
    good = [raw for _, raw in found if framer.receive(raw)]
    assert set(good) <= {raw for _, raw in records}
    missing = len(records) - sum(record in found for record in records)
    assert missing <= 2 * len(parts), "noise loses at most the adjacent frames"


def test_tlog_concatenated_files() -> None:
    first, second = stamped(some_frames(5)), stamped(some_frames(7, seed=2))
    assert read(written(first)[:-5] + written(second)) in (first[:-1] + second, first[:-1] + second[1:])
    assert read(written(first) + written(second)) == first + second


def test_tlog_append_to_open_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    first, second = stamped(some_frames(3)), stamped(some_frames(3, seed=2))
    path.write_bytes(written(first))
    with path.open("ab") as file:
        writer = TlogWriter(file)
        for when, raw in second:
            writer.write(raw, when)
        writer.close()
        writer.close()
        assert not file.closed, "the caller closes its own file"
    assert list(read_tlog(path)) == first + second


def test_tlog_writer_replaces_and_closes_own_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"old")
    with TlogWriter(str(path)) as writer:
        writer.write(some_frames(1)[0], START)
        writer.flush()
        assert len(path.read_bytes()) > 8
    assert list(read_tlog(str(path))) == stamped(some_frames(1))
    with pytest.raises(ValueError, match="closed"):
        writer.write(b"x", 1.0)


def test_tlog_reader_closes_file_early(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(written(stamped(some_frames(5))))
    records = read_tlog(path)
    assert next(records) == stamped(some_frames(1))[0]
    records.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("when", [-1.0, 1.9e13, 1e14, float("nan"), float("inf")])
def test_tlog_rejects_invalid_timestamp(when: float) -> None:
    with pytest.raises(InvalidArgument, match=r"timestamp_s = .* must be seconds since 1970"):
        TlogWriter(io.BytesIO()).write(b"", when)


def test_tlog_accepts_largest_timestamp() -> None:
    file = io.BytesIO()
    TlogWriter(file).write(b"x", 1.8e13)
    assert file.getvalue() == int(1.8e19).to_bytes(8, "big") + b"x"


def test_tlog_missing_file_raises_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        next(read_tlog(tmp_path / "no.tlog"))


@pytest.mark.parametrize("flight", ["ardupilot-copter", "px4-quad"])
def test_tlog_rewritten_recording_is_identical(flight: str) -> None:
    path = recording(f"{flight}.tlog")
    assert written(list(read_tlog(path))) == path.read_bytes()


def test_pymavlink_reads_our_tlog(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    frames = some_frames(20, versions=(2,))
    path.write_bytes(written(stamped(frames)))
    log = mavutil.mavlink_connection(str(path), dialect="development")
    found = []
    while (message := log.recv_match()) is not None:
        found.append((message._timestamp, bytes(message.get_msgbuf())))
    log.close()
    assert [raw for _, raw in found] == [raw for raw in frames if raw in {raw for _, raw in found}]
    assert len(found) > 10
    times = {raw: when for when, raw in stamped(frames)}
    assert [when for when, _ in found] == pytest.approx([times[raw] for _, raw in found])
