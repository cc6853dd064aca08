"""How long to wait before a link is tried again."""

from __future__ import annotations

from aerokit.transport.reconnecting import Delays


def test_twice_as_long_each_time_until_it_was_there() -> None:
    delays = Delays()
    assert [delays.take() for _ in range(7)] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    delays.begin_anew()
    assert delays.take() == 0.2
    short = Delays(1.0, 1.0)
    assert [short.take(), short.take()] == [1.0, 1.0]
