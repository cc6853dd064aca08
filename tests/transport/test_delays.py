"""Delays between attempts to reopen a link."""

from __future__ import annotations

from aerokit.transport.reconnecting import Backoff


def test_backoff_doubles_until_reset() -> None:
    delays = Backoff()
    assert [delays.next_delay() for _ in range(7)] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    delays.reset()
    assert delays.next_delay() == 0.2
    short = Backoff(1.0, 1.0)
    assert [short.next_delay(), short.next_delay()] == [1.0, 1.0]
