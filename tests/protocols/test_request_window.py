"""Request windows: outstanding names, indices and blocks, and when they are repeated."""

from __future__ import annotations

import pytest

from aerokit.protocols.blocks import BlockRequests, CongestionWindow
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.request_window import FEW_LEFT, MAX_TIMEOUT_S, RequestWindow


def window_of(count: int, round_trip: RoundTrip) -> RequestWindow[int]:
    """Return a window with that many requests, all sent at 0."""
    window: RequestWindow[int] = RequestWindow(round_trip)
    for key in range(count):
        window.request(key)
    assert window.take_due(0.0) == list(range(count))
    return window


def test_answered_request_is_not_in_flight() -> None:
    window = window_of(2, RoundTrip(0.2))
    window.on_answer(0, 0.2)
    assert (len(window), 0 in window, 1 in window) == (1, False, True)
    assert window.take_due(10.0) == [1]


def test_discarded_request_is_not_in_flight() -> None:
    window = window_of(2, RoundTrip(0.2))
    window.request(2)
    for key in (0, 2):
        window.discard(key)
    assert (len(window), 0 in window, 2 in window) == (1, False, False)
    assert window.take_due(10.0) == [1]


def test_answer_faster_than_link_is_not_measured() -> None:
    round_trip = RoundTrip(link_s=lambda: 0.6)
    for seconds in (0.7, 0.01, 0.7, 0.02):
        round_trip.add_sample(seconds)
    assert (round_trip.smoothed_s, round_trip.fastest_s) == (0.7, 0.7)


def test_request_timeout_is_capped() -> None:
    round_trip = RoundTrip(3.0)
    assert round_trip.timeout_s() > MAX_TIMEOUT_S
    assert window_of(FEW_LEFT + 1, round_trip).deadline == 2.0


def test_request_timeout_grows_after_silence() -> None:
    round_trip = RoundTrip(0.2)
    timeout_s = round_trip.timeout_s()
    window = window_of(FEW_LEFT + 3, round_trip)
    silent = window.take_due(timeout_s)  # nothing has arrived at all
    assert len(silent) == FEW_LEFT + 3
    assert window.deadline == pytest.approx(timeout_s + round_trip.timeout_s(3))


def test_spaced_block_requests_have_own_deadline() -> None:
    round_trip = RoundTrip(0.1)
    requests = BlockRequests(round_trip, batch_size=1, spacing_s=0.005)
    assert BlockRequests(round_trip).deadline is None
    for offset in (0, 239, 478):
        requests.request(offset)
    assert requests.take_due(0.0) == [0, 239]
    assert requests.deadline == 0.005
    assert requests.take_due(0.005) == [478]
    assert requests.deadline == pytest.approx(round_trip.timeout_s())


def test_single_block_request_is_not_delayed() -> None:
    requests = BlockRequests(RoundTrip(0.1), batch_size=1, spacing_s=0.005)
    for offset in (0, 239):
        requests.request(offset)
        assert requests.take_due(0.001) == [offset]
        requests.on_answer(offset, 0.001)


def test_block_requests_back_off_after_five_timeouts() -> None:
    round_trip = RoundTrip(0.1)
    requests = BlockRequests(round_trip)
    requests.request(0)
    now, waits = 0.0, list[float]()
    for _ in range(8):
        assert requests.take_due(now) == [0]
        assert requests.deadline is not None
        waits.append(requests.deadline - now)
        now = requests.deadline
    assert waits == pytest.approx([round_trip.timeout_s(attempt) for attempt in (1, 1, 1, 1, 1, 2, 3, 4)])
    assert waits[6] > 1.4 * waits[5]


# ---------------------------------------------------------------------------- adaptation to the link


def test_window_grows_while_answers_are_fast() -> None:
    window, sizes = CongestionWindow(start=4, min_size=2, max_size=6), list[int]()
    for _ in range(6):
        window.on_answer(1.0)
        sizes.append(window.size)
    assert sizes == [4, 5, 5, 6, 6, 6]


@pytest.mark.parametrize(("seconds", "size"), [(1.26, 5.0), (1.27, 4.5), (2.05, 4.5), (2.06, 4.25), (None, 4.5)])
def test_window_shrinks_when_answers_are_slow(seconds: float | None, size: float) -> None:
    window = CongestionWindow(start=4)
    window.on_answer(1.0)
    window.on_answer(seconds)
    assert window._size == size


def test_window_halves_at_high_loss() -> None:
    """The average loss (1/16 for each message) exceeds 3/4 after 22 losses from 0, and after 11 losses from 1/2."""
    window, sizes = CongestionWindow(start=40, min_size=8), list[int]()
    for _ in range(60):
        window.on_loss()
        sizes.append(window.size)
    assert [sizes.count(size) for size in (40, 20, 10, 8)] == [21, 11, 11, 17]


def test_window_keeps_size_at_moderate_loss() -> None:
    window = CongestionWindow(start=40)
    for _ in range(500):
        for _ in range(2):
            window.on_loss()
        window.on_answer(None)
    assert window.size == 40


@pytest.mark.parametrize(("fit", "size"), [(3.0, 4), (4.0, 4), (9.0, 9), (32.0, 32), (33.0, 32)])
def test_window_widens_up_to_half_maximum(fit: float, size: int) -> None:
    window = CongestionWindow()
    window.widen(fit)
    assert window.size == size
