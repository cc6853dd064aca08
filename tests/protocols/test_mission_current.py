"""MISSION_SET_CURRENT: what of MISSION_CURRENT confirms it, and what does not."""

from __future__ import annotations

import pytest

from aerokit.errors import OperationTimeout
from aerokit.mavlink.messages import MissionCurrent
from aerokit.protocols.missions import MissionSetCurrent


def told(*seqs: int, wanted: int) -> bool:
    exchange = MissionSetCurrent(1, 1, wanted)
    exchange.start(0.0)
    for at, seq in enumerate(seqs, 1):
        exchange.receive(MissionCurrent(seq, 20, 3, 0), at * 0.1)
    return exchange.done


@pytest.mark.parametrize(
    ("seqs", "is_confirmed"),
    [
        ((2,), True),
        ((5, 2), True),
        ((5, 3), True),  # back, and through an item that is no place
        ((1, 3), True),  # forwards, through it
        ((5,), False),
        ((5, 6), False),  # it flies on from where it was: the message was lost
        ((5, 6, 7), False),
        ((0, 1), False),
    ],
)
def test_what_confirms_item_2(seqs: tuple[int, ...], is_confirmed: bool) -> None:
    assert told(*seqs, wanted=2) is is_confirmed


def test_a_vehicle_that_stood_at_the_item_already_may_have_flown_on() -> None:
    exchange = MissionSetCurrent(1, 1, 2, 2)
    exchange.start(0.0)
    exchange.receive(MissionCurrent(3, 20, 3, 0), 0.1)
    assert exchange.done
    assert len(exchange.take_outbox()) == 1


def test_it_is_sent_again_and_given_up() -> None:
    exchange = MissionSetCurrent(1, 1, 2, patience_s=3.0)
    exchange.start(0.0)
    sent = len(exchange.take_outbox())
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        sent += len(exchange.take_outbox())
    assert 2 <= sent <= 5
    with pytest.raises(OperationTimeout, match="told nothing"):
        exchange.result()
