"""Statistics of one sender, including a second sender with the same ids."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest

from aerokit.mavlink.statistics import IN_ORDER, LATE, OTHER_SENDER, SourceStatistics

Frames = Iterable[tuple[float, int]]
"""Time and sequence number."""


def verdicts_of(source: SourceStatistics, frames: Frames) -> list[int]:
    """Return the verdicts, as a framer does."""
    verdicts = []
    for at, sequence in frames:
        if source.expected & 0xFF == sequence:
            source.expected += 1
            verdicts.append(IN_ORDER)
        else:
            verdicts.append(source.out_of_order(sequence, at))
    return verdicts


def numbers(begin: int, end: int, at: float = 0.0, step_s: float = 0.01) -> list[tuple[float, int]]:
    return [(at + step_s * i, number & 0xFF) for i, number in enumerate(range(begin, end))]


@pytest.fixture
def source() -> SourceStatistics:
    """Fifty frames, then three of another sender whose last number is 100, then the first sender again."""
    source = SourceStatistics(1, 1, 0)
    verdicts_of(source, [*numbers(0, 50), (0.6, 97), (0.61, 98), (0.62, 99), *numbers(50, 53, 0.7)])
    assert (source.received, source.lost, source.expected & 0xFF) == (56, 0, 53)
    return source


def test_frame_of_other_sender_does_not_fill_gap(source: SourceStatistics) -> None:
    """The other sender reaches a number that the first one lost."""
    verdicts_of(source, numbers(53, 110, 0.8))
    verdicts_of(source, numbers(111, 130, 1.4))
    assert source.lost == 1
    assert verdicts_of(source, [(1.6, number) for number in (100, 103, 106, 109, 110)]) == [OTHER_SENDER] * 5
    assert source.lost == 1


@pytest.mark.parametrize(("after_s", "verdict"), [(1.5, OTHER_SENDER), (1.6, IN_ORDER)])
def test_other_stream_takes_over_after_timeout(source: SourceStatistics, after_s: float, verdict: int) -> None:
    assert verdicts_of(source, [(1.0, 100), (1.0 + after_s, 101)]) == [OTHER_SENDER, verdict]


class _Sender:
    def __init__(self, chance: random.Random) -> None:
        self._chance, self.number = chance, chance.randrange(256)
        self._loss = chance.choice((0.0, 0.05, 0.3))

    def next_numbers(self) -> list[int]:
        """Append frames: one or several, lost, doubled, reordered, after a reboot, or in a burst."""
        chance, begin = self._chance, self.number
        self.number += chance.choice((1, 1, 1, 2, 3, 8))
        frames = [number & 0xFF for number in range(begin, self.number) if chance.random() >= self._loss]
        if chance.random() < 0.05:
            chance.shuffle(frames)
        if chance.random() < 0.05:
            frames += frames[-2:]
        if chance.random() < 0.01:
            self.number = chance.choice((0, begin - 100, begin - 10, begin + 200))
        return frames


def random_summary(seed: int) -> str:
    """Return the number of verdicts of each kind, the lost frames, and how long two senders were reported."""
    chance = random.Random(seed)
    senders = [_Sender(chance) for _ in range(chance.choice((1, 2, 2, 3)))]
    source, now, verdicts, doubles = SourceStatistics(1, 1, senders[0].number), 0.0, [0, 0, 0], 0
    for _ in range(400):
        now += chance.choice((0.01, 0.01, 0.1, 0.4, 2.0 if chance.random() < 0.1 else 0.02))
        for verdict in verdicts_of(source, [(now, number) for number in chance.choice(senders).next_numbers()]):
            verdicts[verdict] += 1
        doubles += source.has_duplicates(now)
    return " ".join(map(str, (*verdicts, source.received, source.lost, doubles)))


@pytest.mark.parametrize(
    ("seed", "summary"),
    [
        (0, "415 341 153 909 427 75"),
        (1, "495 79 430 1004 15 203"),
        (2, "1061 62 0 1123 124 0"),
        (3, "493 92 341 926 146 205"),
        (4, "593 122 357 1072 0 190"),
        (5, "481 137 312 930 197 209"),
        (6, "992 56 0 1048 76 0"),
        (7, "617 134 303 1054 20 171"),
        (8, "530 106 425 1061 30 168"),
        (9, "448 360 208 1016 692 90"),
        (10, "1025 40 0 1065 73 0"),
        (11, "421 255 155 831 1486 84"),
        (12, "505 221 215 941 447 91"),
        (13, "385 61 234 680 164 236"),
        (14, "977 59 0 1036 54 0"),
        (15, "520 110 287 917 38 179"),
        (16, "542 67 350 959 24 248"),
        (17, "612 257 161 1030 902 66"),
        (18, "541 94 279 914 66 206"),
        (19, "710 37 14 761 293 14"),
        (20, "494 104 273 871 309 182"),
        (21, "422 83 287 792 167 152"),
        (22, "639 76 388 1103 147 293"),
        (23, "575 85 405 1065 48 285"),
    ],
)
def test_random_traffic_statistics_are_unchanged(seed: int, summary: str) -> None:
    """Recorded counts (IN_ORDER, LATE, OTHER_SENDER, received, lost, duplicates) show any change of the rules."""
    assert random_summary(seed) == summary


def test_late_frames_are_subtracted_once() -> None:
    source = SourceStatistics(1, 1, 0)
    verdicts_of(source, numbers(0, 50))
    frames = (100, 60, 61, 50, 51, 52, 53)
    assert verdicts_of(source, [(0.6, frame) for frame in frames]) == [
        IN_ORDER,
        *[LATE] * 4,
        IN_ORDER,
        IN_ORDER,
    ]
    assert (source.lost, source.loss) == (0, 0.0)
