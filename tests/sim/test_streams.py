from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from aerokit.sim.channel import Streams


def test_nothing_is_streamed_at_first() -> None:
    streams = Streams()
    assert streams.next_due == math.inf
    assert streams.take_due(100.0) == []
    assert streams.interval(30) == 0.0


def test_stream_starts_now_and_repeats() -> None:
    streams = Streams()
    streams.set_interval(30, 0.25, 10.0)
    assert streams.next_due == 10.0
    assert streams.take_due(10.0) == [30]
    assert streams.next_due == 10.25
    assert streams.take_due(10.2) == []
    assert streams.take_due(10.25) == [30]


def test_new_interval_replaces_the_old_one() -> None:
    streams = Streams()
    streams.set_interval(30, 1.0, 0.0)
    streams.set_interval(30, 0.5, 0.0)
    assert streams.take_due(0.0) == [30]
    assert streams.next_due == 0.5
    streams.set_interval(30, 0.0, 0.6)
    assert streams.next_due == math.inf
    assert streams.ids() == frozenset()


def test_late_stream_skips_messages() -> None:
    streams = Streams()
    streams.set_interval(30, 0.1, 0.0)
    assert streams.take_due(5.0) == [30]
    assert streams.next_due == 5.1


@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from([0.1, 0.25, 1.0])), min_size=1, max_size=6))
def test_streams_have_their_own_rates(requests: list[tuple[int, float]]) -> None:
    streams = Streams()
    for message_id, interval in requests:
        streams.set_interval(message_id, interval, 0.0)
    sent: list[int] = []
    while streams.next_due < 10.0:
        sent += streams.take_due(streams.next_due)
    for message_id, interval in dict(requests).items():
        assert abs(sent.count(message_id) - 10.0 / interval) <= 1


@given(st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0.0, 0.25, 0.5]), st.sampled_from([0.0, 0.125, 0.75]))))
def test_changed_streams_are_sent_at_the_times_of_separate_streams(
    requests: list[tuple[int, float, float]],
) -> None:
    """Streams that started together are one entry of the schedule; a change of one must not affect the others."""
    streams, now = Streams(), 0.0
    intervals: dict[int, float] = {}
    dues: dict[int, float] = {}
    for message_id, interval, delay in [*requests, (9, 0.5, 5.0)]:
        streams.set_interval(message_id, interval, now)
        intervals[message_id], dues[message_id] = interval, now if interval else math.inf
        until = now + delay
        while (due := streams.next_due) <= until:
            expected = [id_ for id_, next_due in dues.items() if next_due == due]
            assert sorted(streams.take_due(due)) == sorted(expected)
            dues.update({id_: due + intervals[id_] for id_ in expected})
        assert min(dues.values()) > until
        now = until
    assert streams.ids() == {id_ for id_, interval in intervals.items() if interval}


def test_streams_of_different_rates_share_their_instants() -> None:
    """Sums of 0.1 and of 0.2 differ in their last bits; these do not."""
    streams, instants, start = Streams(), 0, 12.34
    for message_id, rate in enumerate((10.0, 5.0, 2.0, 1.0)):
        streams.set_interval(message_id, 1.0 / rate, start)
    while streams.next_due < start + 99.95:
        instants += 1
        ids = streams.take_due(streams.next_due)
        assert (2 in ids) == ((instants - 1) % 5 == 0)
        assert len(ids) == 4 or (instants - 1) % 10
    assert instants == 1000
