"""``Signing(key, keep=path)``: after a restart, old frames cannot be replayed."""

from __future__ import annotations

from pathlib import Path

import pytest

from aerokit._internal.files import write_atomically
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink import Frame, FrameEncoder, Framer
from aerokit.mavlink import signing as timestamp_file
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.signing import ONE_MINUTE, Refusal, Signing, SigningKey

KEY = SigningKey.from_passphrase("ours")
NO_CLOCK = 0.0


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "stamp"


def frame_of(signing: Signing, now: float = NO_CLOCK) -> Frame:
    encoder = FrameEncoder(1, 1)
    encoder.signing = signing
    (frame,) = Framer().receive(encoder.encode(Heartbeat(2, 3, 0, 0, 3), now))
    return frame


def keep_errno(signing: Signing) -> int | None:
    return None if signing.keep_error is None else signing.keep_error.errno


def test_frames_before_restart_are_rejected(path: Path) -> None:
    vehicle = Signing(KEY, timestamp=30 * ONE_MINUTE)
    old = frame_of(vehicle)
    assert Signing(KEY, keep=path).accepts(old)
    vehicle.timestamp += 2 * ONE_MINUTE
    again = Signing(KEY, keep=path)
    assert again.accepts(frame_of(vehicle))
    for _ in range(2):
        again = Signing(KEY, keep=path)
        assert again.check(old) is Refusal.TOO_OLD


def test_timestamps_increase_across_restart(path: Path) -> None:
    ear = Signing(KEY)
    for _ in range(5):
        signing = Signing(KEY, keep=path)
        for _ in range(50):
            assert ear.accepts(frame_of(signing))


def test_timestamp_file_is_ahead_and_rarely_written(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writes: list[str] = []
    write = write_atomically

    def counting(target: Path, text: str) -> None:
        writes.append(text)
        write(target, text)

    monkeypatch.setattr(timestamp_file, "write_atomically", counting)
    signing, now = Signing(KEY, keep=path), 1_700_000_000.0
    for count in range(600):
        frame = frame_of(signing, now + count / 10)
        stamp = int.from_bytes(frame.signature[1:7], "little")
        assert stamp < int(path.read_text())
    assert len(writes) <= 1 + 3
    assert int(path.read_text()) - signing.timestamp <= ONE_MINUTE // 2


def test_links_with_same_key_share_timestamp_file(path: Path) -> None:
    other = Signing(KEY, keep=path).for_link(1)
    frame_of(other, 1_700_000_000.0)
    assert Signing(KEY, keep=path).timestamp > other.timestamp - 1


@pytest.mark.parametrize("text", ["", "abc", "-5", "1.5", str(1 << 48), "9" * 5000, "\u0661"])
def test_other_file_is_rejected_as_timestamp_file(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match="does not contain a signing timestamp"):
        Signing(KEY, keep=path)


def test_timestamp_must_fit_48_bits(path: Path) -> None:
    last = (1 << 48) - 1
    assert Signing(KEY, timestamp=last).timestamp == last
    for wrong in (-1, 1 << 48):
        with pytest.raises(InvalidArgument, match=rf"timestamp = {wrong} must be in 0\.\.{last}"):
            Signing(KEY, timestamp=wrong)
    path.write_text(str(last))
    assert Signing(KEY, keep=path).timestamp == last


def test_unwritable_timestamp_file_raises(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="stamp"):
        Signing(KEY, keep=tmp_path / "missing" / "stamp")
    with pytest.raises(OSError):  # noqa: PT011
        Signing(KEY, keep=tmp_path)


def test_timestamp_write_error_is_stored(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    signing = Signing(KEY, keep=path)

    def full(target: Path, text: str) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(timestamp_file, "write_atomically", full)
        frame_of(signing, 1_700_000_000.0)
        assert keep_errno(signing) == 28
    frame_of(signing, 1_700_000_100.0)
    assert keep_errno(signing) is None
    assert Signing(KEY).keep_error is None


def test_sender_table_is_bounded() -> None:
    signing, now = Signing(KEY), 1_700_000_000.0
    for link_id in range(8):
        for system_id in range(1, 256):
            encoder = FrameEncoder(system_id, 1)
            encoder.signing = Signing(KEY, link_id=link_id)
            (frame,) = Framer().receive(encoder.encode(Heartbeat(2, 3, 0, 0, 3), now))
            assert signing.accepts(frame, now)
    assert len(signing.streams) == 1024
