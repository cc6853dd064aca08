"""Hostile bytes: their processing costs, and the distinction of senders behind one peer."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

import pytest
from framer_harness import some_frames, unknown

from aerokit.mavlink import Frame, FrameEncoder, Framer, framer
from aerokit.mavlink.frame import x25
from aerokit.mavlink.messages import Attitude, Heartbeat
from aerokit.mavlink.statistics import SourceLimit

HEARTBEAT = Heartbeat(2, 3, 81, 0, 3)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

NOISE = {
    "fd": b"\xfd" * 2400,
    "fe": b"\xfe" * 2400,
    "headers in headers": b"\xfd\xfd\0\0" * 600,
    "attitudes without end": (b"\xfd\x1c\0\0\1\1\x1e\0\0") * 260,
    "long claims": b"\xfd\xff\0\0\1\1\xff\xff\xff" * 260,
    "heartbeats of version 1": b"\xfe\x09\0\0\0\0" * 400,
    "bad frames": b"".join(frame[:-1] + b"\0" for frame in some_frames(60)),
    "unknown frames cut": b"".join(unknown(255)[:90] for _ in range(26)),
}


class Work:
    """A framer that counts examined offsets and bytes run through the checksum."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.places = self.checked_bytes = 0
        examine = Framer._examine

        def counting_examine(self_: Framer, data: bytes, begin: int) -> object:
            self.places += 1
            return examine(self_, data, begin)

        def counting_x25(data: bytes) -> int:
            self.checked_bytes += len(data)
            return x25(data)

        monkeypatch.setattr(Framer, "_examine", counting_examine)
        monkeypatch.setattr(framer, "x25", counting_x25)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("size", [1, 7, 1200])
@pytest.mark.parametrize("noise", NOISE.values(), ids=NOISE)
def test_framer_work_per_byte_is_bounded(noise: bytes, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each offset is examined a few times only, not again with every following byte, however the bytes are split."""
    work, subject = Work(monkeypatch), Framer()
    for begin in range(0, len(noise), size):
        subject.receive(noise[begin : begin + size])
    assert work.places <= 5 * len(noise)
    assert work.checked_bytes <= 280 * len(noise)
    work.places = 0
    (frame,) = subject.receive(bytes(300) + FrameEncoder(1, 1).encode(HEARTBEAT))
    assert frame.message_id == 0


def test_framer_skips_row_of_magic_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    work, subject = Work(monkeypatch), Framer()
    subject.receive(b"\xfd" * 1200)
    assert work.places <= 4
    assert work.checked_bytes == 0


# ---------------------------------------------------------------------------- number of senders


def heartbeats_of_all_ids(rounds: int = 1) -> Iterable[bytes]:
    encoder = FrameEncoder(1, 1)
    for _ in range(rounds):
        for system_id in range(1, 256):
            for component_id in range(0, 256, 8):
                encoder.system_id, encoder.component_id = system_id, component_id
                yield encoder.encode(HEARTBEAT)


def test_sender_count_is_limited() -> None:
    subject, count = Framer(), 0
    for frame in heartbeats_of_all_ids():
        count += len(subject.receive(frame))
    assert count == 255 * 32
    assert len(subject.statistics.sources) == len(subject.statistics.by_key) == framer.MAX_SOURCES
    assert subject.statistics.frames == count


def test_framers_share_and_release_sender_limit() -> None:
    limit = SourceLimit(10)
    one, two = Framer(limit=limit), Framer(limit=limit)
    for system_id in range(1, 9):
        for sender in (one, two):
            sender.receive(FrameEncoder(system_id, 1).encode(HEARTBEAT))
    assert len(one.statistics.sources) + len(two.statistics.sources) == 10
    assert one.statistics.frames == two.statistics.frames == 8
    one.close()
    assert limit.free == 5


def test_silent_senders_are_dropped_for_new_ones() -> None:
    subject = Framer(limit=SourceLimit(10))
    vehicle = FrameEncoder(100, 1)
    for second in range(60):
        subject.receive(vehicle.encode(HEARTBEAT), float(second))
        subject.receive(FrameEncoder(second + 1, 1).encode(HEARTBEAT), float(second))
    assert subject.statistics.sources[100, 1].received == 60
    assert (60, 1) in subject.statistics.sources or (55, 1) in subject.statistics.sources
    assert len(subject.statistics.sources) <= 10


# ------------------------------------------------------------------- late frames and two senders


class Sender:
    """One vehicle that sends frames, starting from any sequence number."""

    def __init__(self, first: int) -> None:
        self._encoder = FrameEncoder(1, 1)
        self._encoder.sequence = first & 0xFF

    def frame(self) -> bytes:
        return self._encoder.encode(ATTITUDE)

    def frames(self, count: int) -> list[bytes]:
        return [self.frame() for _ in range(count)]


class Judge:
    """A framer and its verdict on each frame: "" (in order), "late" or "foreign"."""

    def __init__(self) -> None:
        self.framer, self.now = Framer(), 100.0

    def receive(self, *frames: bytes, every_s: float = 0.02) -> list[str]:
        verdicts: list[str] = []
        for raw in frames:
            self.now += every_s
            verdicts += [self._verdict(frame) for frame in self.framer.receive(raw, self.now)]
        return verdicts

    def _verdict(self, frame: Frame) -> str:
        if frame in self.framer.late:
            return "late"
        return "foreign" if frame in self.framer.foreign else ""

    @property
    def has_duplicates(self) -> bool:
        return self.framer.statistics.sources[1, 1].has_duplicates(self.now)


def test_overtaken_frames_are_late() -> None:
    judge, frames = Judge(), Sender(0).frames(20)
    assert judge.receive(*frames[:3], frames[4], frames[3], *frames[5:9]) == [
        "",
        "",
        "",
        "",
        "late",
        *[""] * 4,
    ]
    assert judge.receive(frames[8]) == ["late"]
    assert judge.receive(frames[12], frames[9], frames[10], frames[11], frames[13]) == ["", *["late"] * 3, ""]
    assert not judge.has_duplicates


def test_late_frames_are_reported_once() -> None:
    judge, frames = Judge(), Sender(0).frames(9)
    judge.receive(*frames[:3], frames[4], frames[3])
    assert len(judge.framer.late) == 1
    judge.receive(frames[5])
    assert judge.framer.late == []


def test_overtaken_frames_in_one_datagram_are_late() -> None:
    judge, frames = Judge(), Sender(250).frames(20)
    assert judge.receive(b"".join((*frames[:3], frames[5], frames[3], frames[4], frames[6]))) == [
        *[""] * 4,
        "late",
        "late",
        "",
    ]


def test_frame_late_by_many_numbers() -> None:
    judge, frames = Judge(), Sender(7).frames(130)
    judge.receive(*frames[:10], *frames[11:120])
    assert judge.receive(frames[10]) == ["late"]
    assert judge.framer.statistics.sources[1, 1].lost == 0


@pytest.mark.parametrize("first", [0, 60, 128, 200, 250])
def test_reboot_is_accepted_within_two_frames(first: int) -> None:
    judge = Judge()
    judge.receive(*Sender(100).frames(50))
    verdicts = judge.receive(*Sender(first).frames(30))
    assert verdicts[1:] == [""] * 29
    assert not judge.has_duplicates


def interleaved(ours: Sender, theirs: Sender, burst: int, count: int) -> Iterable[tuple[bool, bytes]]:
    for _ in range(count):
        yield from ((True, frame) for frame in ours.frames(burst))
        yield from ((False, frame) for frame in theirs.frames(burst))


@pytest.mark.parametrize("burst", [1, 3, 6])
@pytest.mark.parametrize("distance", [30, 90, 128, 150, 220])
def test_first_of_two_senders_is_accepted(distance: int, burst: int) -> None:
    judge, ours = Judge(), Sender(10)
    judge.receive(*ours.frames(60))
    theirs = Sender(70 + distance)
    verdicts = [
        (is_ours, verdict)
        for is_ours, frame in interleaved(ours, theirs, burst, 60)
        for verdict in judge.receive(frame)
    ]
    assert judge.has_duplicates
    late = verdicts[len(verdicts) // 4 :]
    assert {verdict for is_ours, verdict in late if is_ours} == {""}
    assert {verdict for is_ours, verdict in late if not is_ours} == {"foreign"}


@pytest.mark.parametrize("distance", [-8, -1, 0])
def test_senders_with_similar_sequences_are_detected(distance: int) -> None:
    judge, ours = Judge(), Sender(10)
    judge.receive(*ours.frames(60))
    theirs = Sender(70 + distance)
    for _, frame in interleaved(ours, theirs, 1, 60):
        judge.receive(frame)
    assert judge.has_duplicates


def test_second_sender_is_accepted_after_first_stops() -> None:
    judge, ours, theirs = Judge(), Sender(10), Sender(150)
    judge.receive(*ours.frames(60))
    for _, frame in interleaved(ours, theirs, 2, 30):
        judge.receive(frame)
    verdicts = judge.receive(*theirs.frames(200))
    assert verdicts[0] == "foreign"
    assert set(verdicts[100:]) == {""}
    judge.receive(*theirs.frames(300))
    assert not judge.has_duplicates


def test_returning_first_sender_is_accepted_after_three_frames() -> None:
    judge, ours, theirs = Judge(), Sender(10), Sender(150)
    judge.receive(*ours.frames(60))
    for _, frame in interleaved(ours, theirs, 2, 5):
        judge.receive(frame)
    judge.now += 2.0
    assert judge.receive(*theirs.frames(10)) == [""] * 10
    assert judge.receive(*ours.frames(5)) == ["late", "late", "", "", ""]


Disorder = Callable[[random.Random, list[bytes]], list[bytes]]


def held_back(share: float, by: int) -> Disorder:
    def disorder(chance: random.Random, frames: list[bytes]) -> list[bytes]:
        places = sorted(range(len(frames)), key=lambda place: place + (by + 0.5 if chance.random() < share else 0))
        return [frames[place] for place in places]

    return disorder


def repeated(share: float) -> Disorder:
    def disorder(chance: random.Random, frames: list[bytes]) -> list[bytes]:
        return [copied for frame in frames for copied in (frame, frame)[: 1 + (chance.random() < share)]]

    return disorder


@pytest.mark.parametrize(
    "disorder",
    [held_back(0.1, 1), held_back(0.3, 3), held_back(0.3, 10), held_back(0.05, 100), repeated(0.3)],
)
def test_bad_radio_is_not_second_sender(disorder: Disorder) -> None:
    for seed in range(5):
        judge, chance = Judge(), random.Random(seed)
        frames = [frame for frame in Sender(0).frames(3000) if chance.random() > 0.1]
        for frame in disorder(chance, frames):
            assert judge.receive(frame) != ["foreign"]
            assert not judge.has_duplicates
