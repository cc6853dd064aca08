"""MISSION_SET_CURRENT: which MISSION_CURRENT messages confirm it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from aerokit.errors import OperationTimeout
from aerokit.mavlink.messages import MissionCurrent
from aerokit.protocols.missions import SetCurrentItem


def confirms(*seqs: int, wanted: int) -> bool:
    exchange = SetCurrentItem(1, 1, wanted)
    exchange.start(0.0)
    for at, seq in enumerate(seqs, 1):
        exchange.receive(MissionCurrent(seq, 20, 3, 0), at * 0.1)
    return exchange.done


@pytest.mark.parametrize(
    ("seqs", "is_confirmed"),
    [
        ((2,), True),
        ((5, 2), True),
        ((5, 3), True),  # back, then past an item without a position
        ((1, 3), True),  # forwards, past it
        ((5,), False),
        ((5, 6), False),  # it continues from where it was: the message was lost
        ((5, 6, 7), False),
        ((0, 1), False),
    ],
)
def test_set_current_confirmation(seqs: tuple[int, ...], is_confirmed: bool) -> None:
    assert confirms(*seqs, wanted=2) is is_confirmed


def test_set_current_of_current_item_accepts_next() -> None:
    exchange = SetCurrentItem(1, 1, 2, 2)
    exchange.start(0.0)
    exchange.receive(MissionCurrent(3, 20, 3, 0), 0.1)
    assert exchange.done
    assert len(exchange.take_outbox()) == 1


def test_set_current_retries_then_times_out() -> None:
    exchange = SetCurrentItem(1, 1, 2, idle_timeout_s=3.0)
    exchange.start(0.0)
    sent = len(exchange.take_outbox())
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        sent += len(exchange.take_outbox())
    assert 2 <= sent <= 5
    with pytest.raises(OperationTimeout, match="reported nothing"):
        exchange.result()


@pytest.mark.parametrize(("now", "attempts"), [(3.0, 2), (9.0, 1)])
def test_item_is_not_set_again_after_old_heartbeat(now: float, attempts: int) -> None:
    """The event loop was blocked, and the HEARTBEAT arrived at its beginning."""
    status: Any = SimpleNamespace(end="", heartbeat_at=0.8)
    exchange = SetCurrentItem(1, 1, 2, order_status=status, idle_timeout_s=20.0)
    exchange.start(0.0)
    exchange.expire(now)
    assert len(exchange.take_outbox()) == attempts
