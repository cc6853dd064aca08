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


def test_loss_at_number_of_earlier_outage_shows_no_second_sender() -> None:
    """Sequence numbers wrap, so the stream comes by the number at which it was interrupted."""
    source = SourceStatistics(1, 1, 0)
    verdicts_of(source, [*numbers(0, 50), *numbers(70, 306, 0.7)])
    assert verdicts_of(source, numbers(307, 340, 3.1)) == [IN_ORDER] * 33
    assert source.lost == 20 + 1


@pytest.mark.parametrize("loss", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("rate_hz", [50, 100, 200])
def test_lossy_link_with_outages_has_one_sender(loss: float, rate_hz: int) -> None:
    chance, source = random.Random(repr((loss, rate_hz))), SourceStatistics(1, 1, 0)
    for number in range(100 * rate_hz):
        now = number / rate_hz
        is_outage = now % 10 > 9.5
        if not is_outage and chance.random() >= loss:
            assert verdicts_of(source, [(now, number & 0xFF)]) == [IN_ORDER]
    assert not source.has_duplicates(100.0)


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
        (0, "415 340 154 909 427 75"),
        (1, "520 105 379 1004 21 193"),
        (2, "1061 62 0 1123 124 0"),
        (3, "493 92 341 926 146 205"),
        (4, "600 155 317 1072 2 181"),
        (5, "520 128 282 930 330 169"),
        (6, "992 56 0 1048 76 0"),
        (7, "606 182 266 1054 14 153"),
        (8, "530 106 425 1061 30 168"),
        (9, "449 359 208 1016 694 90"),
        (10, "1025 40 0 1065 73 0"),
        (11, "412 266 153 831 1477 82"),
        (12, "538 249 154 941 624 78"),
        (13, "430 78 172 680 170 188"),
        (14, "977 59 0 1036 54 0"),
        (15, "494 97 326 917 64 188"),
        (16, "531 124 304 959 25 192"),
        (17, "599 326 105 1030 915 44"),
        (18, "541 94 279 914 66 206"),
        (19, "719 42 0 761 295 0"),
        (20, "488 107 276 871 312 182"),
        (21, "435 88 269 792 179 165"),
        (22, "613 92 398 1103 139 220"),
        (23, "561 104 400 1065 93 279"),
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
