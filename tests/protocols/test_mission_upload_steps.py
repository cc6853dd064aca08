"""Uploads answer by answer: what is believed at once, what is asked again first, and what is sent then."""

from __future__ import annotations

from typing import Any

import pytest
from mission_vehicles import GCS, items

from aerokit import messages as m
from aerokit.errors import MissionRejected
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.mission_upload import MissionUpload, UploadEnd
from aerokit.protocols.missions import BUSY_AGAIN_S, BUSY_S

RTT_S = 0.1


def upload(count: int = 4, **options: Any) -> MissionUpload:
    exchange = MissionUpload(1, 1, items(count), **{"window": 1, "round_trip": RoundTrip(RTT_S), **options})
    exchange.start(0.0)
    return exchange


def told(exchange: MissionUpload) -> list[int | str]:
    """What it sent since: items by their numbers, other messages by their names."""
    return [each.seq if isinstance(each, m.MissionItemInt) else each.NAME for each in exchange.take_outbox()]


def ask(exchange: MissionUpload, seq: int, now: float) -> list[int | str]:
    exchange.receive(m.MissionRequestInt(*GCS, seq), now)
    return told(exchange)


def acknowledge(exchange: MissionUpload, result: Result, now: float) -> list[int | str]:
    exchange.receive(m.MissionAck(*GCS, result), now)
    return told(exchange)


def rejected(exchange: MissionUpload) -> MissionRejected:
    with pytest.raises(MissionRejected) as caught:
        exchange.result()
    return caught.value


def test_an_item_measures_the_round_trip_when_it_was_sent_once() -> None:
    exchange = upload(round_trip=RoundTrip())
    told(exchange)
    assert ask(exchange, 0, 1.0) == [0]
    assert ask(exchange, 1, 1.3) == [1]
    assert exchange.round_trip.smoothed_s == pytest.approx(0.3)
    assert ask(exchange, 1, 3.0) == [1]  # lost on the way: which of the two is answered nobody knows
    assert ask(exchange, 2, 3.1) == [2]
    assert exchange.round_trip.smoothed_s == pytest.approx(0.3)


# -------------------------------------------------------------------------------- an ERROR


def test_an_error_is_believed_when_it_comes_again_after_a_round_trip() -> None:
    exchange = upload()
    assert told(exchange) == ["MISSION_COUNT"]
    assert ask(exchange, 0, 1.0) == [0]
    assert ask(exchange, 1, 1.1) == [1]
    assert acknowledge(exchange, Result.ERROR, 1.15) == []  # item 1 is under way
    assert acknowledge(exchange, Result.ERROR, 1.2) == []  # may be the same doubt's
    assert not exchange.done
    assert acknowledge(exchange, Result.ERROR, 1.25) == []
    assert (rejected(exchange).result, rejected(exchange).item) == (Result.ERROR, 1)
    assert str(rejected(exchange)).startswith("mission: the vehicle refused item 1: ")


def test_an_error_that_a_request_follows_was_none() -> None:
    exchange = upload()
    ask(exchange, 0, 1.0)
    told(exchange)
    assert acknowledge(exchange, Result.ERROR, 1.1) == [0]  # long enough ago to ask again
    assert ask(exchange, 1, 1.2) == [1]
    assert acknowledge(exchange, Result.ERROR, 1.3) == [1]  # a doubt of its own
    assert not exchange.done


def test_an_error_after_everything_was_sent_is_an_end_that_is_not_sure() -> None:
    exchange = upload(2)
    for seq in (0, 1):
        ask(exchange, seq, 1.0 + seq / 10)
    assert acknowledge(exchange, Result.ERROR, 1.3) == [1]
    acknowledge(exchange, Result.ERROR, 1.4)
    assert exchange.result() == UploadEnd(False, 0, 1)


def test_an_end_that_is_not_sure_names_an_item_as_the_program_counts() -> None:
    exchange = upload(3, offset=1)
    for seq in (0, 1, 2):
        ask(exchange, seq, 1.0 + seq / 10)
    for now in (1.4, 1.5):
        acknowledge(exchange, Result.ERROR, now)
    assert exchange.result() == UploadEnd(False, 0, 1)


def test_a_busy_vehicle_is_asked_every_second_and_given_up_after_nine() -> None:
    exchange = upload()
    told(exchange)
    now, announced = 0.0, 0
    while True:
        acknowledge(exchange, Result.ERROR, now)
        if exchange.done:
            break
        now += BUSY_AGAIN_S
        assert exchange.deadline == now
        exchange.expire(now)
        assert told(exchange) == ["MISSION_ACK", "MISSION_COUNT"]
        announced += 1
    assert now == BUSY_S
    assert announced == 9
    assert (rejected(exchange).result, rejected(exchange).item) == (Result.ERROR, None)


def test_a_part_that_is_refused_at_once_is_refused() -> None:
    exchange = upload(2, first=3)
    assert told(exchange) == ["MISSION_WRITE_PARTIAL_LIST"]
    acknowledge(exchange, Result.ERROR, 0.1)
    assert rejected(exchange).result == Result.ERROR
    assert str(rejected(exchange)).startswith("mission: the vehicle refused: ")
    assert not exchange.was_begun


# ------------------------------------------------------------------------------ begun anew


def test_a_vehicle_that_cancels_is_begun_anew_with_three_times() -> None:
    exchange = upload()
    told(exchange)
    for attempt in range(3):
        assert ask(exchange, 0, attempt + 0.1) == [0]
        assert acknowledge(exchange, Result.OPERATION_CANCELLED, attempt + 0.2) == ["MISSION_COUNT"]
    assert ask(exchange, 0, 4.1) == [0]
    assert acknowledge(exchange, Result.OPERATION_CANCELLED, 4.2) == []
    assert rejected(exchange).result == Result.OPERATION_CANCELLED


def test_a_part_is_not_begun_anew() -> None:
    exchange = upload(2, first=3)
    told(exchange)
    assert ask(exchange, 3, 0.1) == [3]
    assert acknowledge(exchange, Result.OPERATION_CANCELLED, 0.2) == []
    assert rejected(exchange).result == Result.OPERATION_CANCELLED


@pytest.mark.parametrize(("silence_s", "answer"), [(4.4, [0]), (4.5, ["MISSION_COUNT"])])
def test_an_error_after_a_silence_is_of_a_vehicle_that_has_forgotten(
    silence_s: float, answer: list[int | str]
) -> None:
    exchange = upload()
    told(exchange)
    ask(exchange, 0, 1.0)
    assert acknowledge(exchange, Result.ERROR, 1.0 + silence_s) == answer


# --------------------------------------------------------------------------------- items


def test_an_item_that_was_asked_for_again_is_sent_again_unless_it_is_under_way() -> None:
    exchange = upload()
    told(exchange)
    assert ask(exchange, 0, 1.0) == [0]
    assert ask(exchange, 0, 1.07) == []
    assert ask(exchange, 0, 1.08) == [0]
    assert ask(exchange, 1, 1.2) == [1]
    assert ask(exchange, 0, 1.21) == [0]  # an old request, or it has begun anew


def test_items_are_sent_ahead_up_to_the_window_and_the_end() -> None:
    exchange = upload(5, window=3)
    told(exchange)
    assert ask(exchange, 0, 1.0) == [0, 1, 2]
    assert ask(exchange, 2, 1.1) == [3, 4]
    assert exchange.was_sent_whole
    assert ask(exchange, 5, 1.2) == []  # there is none
    assert acknowledge(exchange, Result.ACCEPTED, 1.2) == []
    assert exchange.result() == UploadEnd(True, 0, 2)


def test_out_of_sequence_everything_under_way_is_sent_again_and_one_more() -> None:
    exchange = upload(9, window=3)
    told(exchange)
    assert ask(exchange, 0, 1.0) == [0, 1, 2]
    assert acknowledge(exchange, Result.INVALID_SEQUENCE, 1.05) == [3]
    assert acknowledge(exchange, Result.INVALID_SEQUENCE, 1.2) == [0, 1, 2, 3]


def test_into_a_silence_the_last_item_and_everything_under_way_are_sent_in_turn() -> None:
    exchange = upload(3, window=3)
    told(exchange)
    assert ask(exchange, 0, 1.0) == [0, 1, 2]
    for again in ([2], [0, 1, 2], [2]):
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        assert told(exchange) == again


def test_acceptance_before_everything_was_sent_is_not_ours() -> None:
    exchange = upload(2)
    ask(exchange, 0, 1.0)
    acknowledge(exchange, Result.ACCEPTED, 1.1)
    assert not exchange.done
    ask(exchange, 1, 1.2)
    acknowledge(exchange, Result.ACCEPTED, 1.3)
    assert exchange.result().is_sure


def test_acceptance_after_the_tail_was_repeated_is_not_sure() -> None:
    """PX4 takes a repeated item for the last one."""
    exchange = upload(2, window=6)
    ask(exchange, 0, 1.0)
    acknowledge(exchange, Result.INVALID_SEQUENCE, 1.5)
    acknowledge(exchange, Result.ACCEPTED, 1.6)
    assert not exchange.result().is_sure


def test_what_was_under_way_alone_is_what_was_refused() -> None:
    for window, vague in ((1, False), (2, True)):
        exchange = upload(window=window)
        ask(exchange, 0, 1.0)
        acknowledge(exchange, Result.INVALID_PARAM1, 1.1)
        assert rejected(exchange).item == 0
        assert exchange.was_vague is vague


def test_a_part_changes_what_is_there_with_its_second_item() -> None:
    exchange = upload(3, first=5)
    for seq, state in ((None, (False, False)), (5, (True, False)), (6, (True, True))):
        if seq is not None:
            ask(exchange, seq, 1.0 + seq / 10)
        assert (exchange.was_begun, exchange.was_changing) == state
    assert not exchange.was_sent_whole


@pytest.mark.parametrize("seq", [4, 8])
def test_items_that_are_not_of_the_part_are_not_sent(seq: int) -> None:
    exchange = upload(3, first=5)
    told(exchange)
    assert ask(exchange, seq, 0.1) == []
    assert not exchange.was_begun
