"""Which requests are under way, and when they are sent again: windows of names and indices, and of blocks."""

from __future__ import annotations

import pytest

from aerokit.protocols.blocks import AdaptiveWindow, BlockRequests
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.request_window import FEW, LONGEST_S, RequestWindow


def window_of(count: int, round_trip: RoundTrip) -> RequestWindow[int]:
    """So many requests, all sent at 0."""
    window: RequestWindow[int] = RequestWindow(round_trip)
    for key in range(count):
        window.ask(key)
    assert window.take_due(0.0) == list(range(count))
    return window


def test_what_was_answered_is_neither_under_way_nor_sent_again() -> None:
    window = window_of(2, RoundTrip(0.2))
    window.answered(0, 0.2)
    assert (len(window), 0 in window, 1 in window) == (1, False, True)
    assert window.take_due(10.0) == [1]


def test_what_is_not_wanted_any_longer_is_neither_under_way_nor_sent_again() -> None:
    window = window_of(2, RoundTrip(0.2))
    window.ask(2)
    for key in (0, 2):
        window.forget(key)
    assert (len(window), 0 in window, 2 in window) == (1, False, False)
    assert window.take_due(10.0) == [1]


def test_nothing_is_waited_for_longer_than_two_seconds() -> None:
    round_trip = RoundTrip(3.0)
    assert round_trip.timeout_s() > LONGEST_S
    assert window_of(FEW + 1, round_trip).deadline == 2.0


def test_after_a_silence_it_is_waited_longer() -> None:
    round_trip = RoundTrip(0.2)
    timeout_s = round_trip.timeout_s()
    window = window_of(FEW + 3, round_trip)
    silent = window.take_due(timeout_s)  # nothing has come at all
    assert len(silent) == FEW + 3
    assert window.deadline == pytest.approx(timeout_s + round_trip.timeout_s(3))


def test_blocks_that_are_held_back_for_a_moment_are_not_waited_for_once_they_are_sent() -> None:
    round_trip = RoundTrip(0.1)
    requests = BlockRequests(round_trip, at_once=1, spacing_s=0.005)
    assert BlockRequests(round_trip).deadline is None
    for offset in (0, 239, 478):
        requests.ask(offset)
    assert requests.take_due(0.0) == [0, 239]
    assert requests.deadline == 0.005
    assert requests.take_due(0.005) == [478]
    assert requests.deadline == pytest.approx(round_trip.timeout_s())


def test_a_request_that_is_alone_is_not_held_back() -> None:
    requests = BlockRequests(RoundTrip(0.1), at_once=1, spacing_s=0.005)
    for offset in (0, 239):
        requests.ask(offset)
        assert requests.take_due(0.001) == [offset]
        requests.answered(offset, 0.001)


def test_blocks_in_vain_are_asked_for_as_often_five_times_and_then_more_rarely() -> None:
    round_trip = RoundTrip(0.1)
    requests = BlockRequests(round_trip)
    requests.ask(0)
    now, waits = 0.0, list[float]()
    for _ in range(8):
        assert requests.take_due(now) == [0]
        assert requests.deadline is not None
        waits.append(requests.deadline - now)
        now = requests.deadline
    assert waits == pytest.approx([round_trip.timeout_s(attempt) for attempt in (1, 1, 1, 1, 1, 2, 3, 4)])
    assert waits[6] > 1.4 * waits[5]


# ----------------------------------------------------------------------- as many as the link carries


def test_it_grows_by_a_half_while_answers_take_as_long_as_the_fastest() -> None:
    window, sizes = AdaptiveWindow(start=4, lowest=2, highest=6), list[int]()
    for _ in range(6):
        window.answered(1.0)
        sizes.append(window.size)
    assert sizes == [4, 5, 5, 6, 6, 6]


@pytest.mark.parametrize(
    ("seconds", "size"), [(1.26, 5.0), (1.27, 4.5), (2.05, 4.5), (2.06, 4.25), (None, 4.5)]
)
def test_answers_that_take_twice_as_long_make_it_smaller(seconds: float | None, size: float) -> None:
    window = AdaptiveWindow(start=4)
    window.answered(1.0)
    window.answered(seconds)
    assert window._size == size


def test_only_when_most_is_lost_it_is_halved_and_then_waits_for_more() -> None:
    """By sixteenths: of 22 in a row three quarters count as lost, of a half 11 more do."""
    window, sizes = AdaptiveWindow(start=40, lowest=8), list[int]()
    for _ in range(60):
        window.lost()
        sizes.append(window.size)
    assert [sizes.count(size) for size in (40, 20, 10, 8)] == [21, 11, 11, 17]


def test_what_is_answered_makes_up_for_what_is_lost() -> None:
    window = AdaptiveWindow(start=40)
    for _ in range(500):
        for _ in range(2):
            window.lost()
        window.answered(None)
    assert window.size == 40


@pytest.mark.parametrize(("fit", "size"), [(3.0, 4), (4.0, 4), (9.0, 9), (32.0, 32), (33.0, 32)])
def test_it_begins_with_what_is_known_to_fit_up_to_half_of_what_may_be(fit: float, size: int) -> None:
    window = AdaptiveWindow()
    window.widen(fit)
    assert window.size == size
