"""Mission uploads answer by answer: answers accepted at once, answers verified first, and the reactions."""

from __future__ import annotations

from typing import Any

import pytest
from mission_vehicles import GCS, items

from aerokit import messages as m
from aerokit.errors import MissionRejected
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.mission_upload import MissionUpload, UploadResult
from aerokit.protocols.missions import BUSY_RETRY_INTERVAL_S, BUSY_TIMEOUT_S

RTT_S = 0.1


def upload(count: int = 4, **options: Any) -> MissionUpload:
    exchange = MissionUpload(1, 1, items(count), **{"window": 1, "round_trip": RoundTrip(RTT_S), **options})
    exchange.start(0.0)
    return exchange


def sent_since(exchange: MissionUpload) -> list[int | str]:
    """Return the messages sent since then: numbers of items, names of other messages."""
    return [
        message.seq if isinstance(message, m.MissionItemInt) else message.NAME for message in exchange.take_outbox()
    ]


def request_item(exchange: MissionUpload, seq: int, now: float) -> list[int | str]:
    exchange.receive(m.MissionRequestInt(*GCS, seq), now)
    return sent_since(exchange)


def acknowledge(exchange: MissionUpload, result: Result, now: float) -> list[int | str]:
    exchange.receive(m.MissionAck(*GCS, result), now)
    return sent_since(exchange)


def rejected(exchange: MissionUpload) -> MissionRejected:
    with pytest.raises(MissionRejected) as caught:
        exchange.result()
    return caught.value


def test_upload_measures_round_trip_of_single_sending() -> None:
    exchange = upload(round_trip=RoundTrip())
    sent_since(exchange)
    assert request_item(exchange, 0, 1.0) == [0]
    assert request_item(exchange, 1, 1.3) == [1]
    assert exchange.round_trip.smoothed_s == pytest.approx(0.3)
    assert request_item(exchange, 1, 3.0) == [1]  # lost on the way: unknown which of the two is answered
    assert request_item(exchange, 2, 3.1) == [2]
    assert exchange.round_trip.smoothed_s == pytest.approx(0.3)


# --------------------------------------------------------------------------- ERROR answers


def test_upload_error_repeated_after_round_trip_fails() -> None:
    exchange = upload()
    assert sent_since(exchange) == ["MISSION_COUNT"]
    assert request_item(exchange, 0, 1.0) == [0]
    assert request_item(exchange, 1, 1.1) == [1]
    assert acknowledge(exchange, Result.ERROR, 1.15) == []  # item 1 is in transit
    assert acknowledge(exchange, Result.ERROR, 1.2) == []  # may have the same cause
    assert not exchange.done
    assert acknowledge(exchange, Result.ERROR, 1.25) == []
    assert (rejected(exchange).result, rejected(exchange).item) == (Result.ERROR, 1)
    assert str(rejected(exchange)).startswith("mission: the vehicle refused item 1: ")


def test_upload_repeated_error_before_first_round_trip_is_ignored() -> None:
    exchange = upload(round_trip=RoundTrip())
    request_item(exchange, 0, 1.0)
    acknowledge(exchange, Result.ERROR, 1.1)
    acknowledge(exchange, Result.ERROR, 1.15)
    assert not exchange.done


def test_upload_error_followed_by_request_is_ignored() -> None:
    exchange = upload()
    request_item(exchange, 0, 1.0)
    sent_since(exchange)
    assert acknowledge(exchange, Result.ERROR, 1.1) == [0]  # long enough ago to ask again
    assert request_item(exchange, 1, 1.2) == [1]
    assert acknowledge(exchange, Result.ERROR, 1.3) == [1]  # a separate case
    assert not exchange.done


def test_upload_error_after_last_item_is_unconfirmed_end() -> None:
    exchange = upload(2)
    for seq in (0, 1):
        request_item(exchange, seq, 1.0 + seq / 10)
    assert acknowledge(exchange, Result.ERROR, 1.3) == [1]
    acknowledge(exchange, Result.ERROR, 1.4)
    assert exchange.result() == UploadResult(False, 0, 1)


def test_unconfirmed_end_names_item_without_home() -> None:
    exchange = upload(3, offset=1)
    for seq in (0, 1, 2):
        request_item(exchange, seq, 1.0 + seq / 10)
    for now in (1.4, 1.5):
        acknowledge(exchange, Result.ERROR, now)
    assert exchange.result() == UploadResult(False, 0, 1)


def test_busy_vehicle_is_retried_for_nine_seconds() -> None:
    exchange = upload()
    sent_since(exchange)
    now, announced = 0.0, 0
    while True:
        acknowledge(exchange, Result.ERROR, now)
        if exchange.done:
            break
        now += BUSY_RETRY_INTERVAL_S
        assert exchange.deadline == now
        exchange.expire(now)
        assert sent_since(exchange) == ["MISSION_ACK", "MISSION_COUNT"]
        announced += 1
    assert now == BUSY_TIMEOUT_S
    assert announced == 9
    assert (rejected(exchange).result, rejected(exchange).item) == (Result.ERROR, None)


def test_partial_upload_refused_at_once_fails() -> None:
    exchange = upload(2, first=3)
    assert sent_since(exchange) == ["MISSION_WRITE_PARTIAL_LIST"]
    acknowledge(exchange, Result.ERROR, 0.1)
    assert rejected(exchange).result == Result.ERROR
    assert str(rejected(exchange)).startswith("mission: the vehicle refused: ")
    assert not exchange.was_started


# ------------------------------------------------------------------- restart of the upload


def test_cancelled_upload_restarts_three_times() -> None:
    exchange = upload()
    sent_since(exchange)
    for attempt in range(3):
        assert request_item(exchange, 0, attempt + 0.1) == [0]
        assert acknowledge(exchange, Result.OPERATION_CANCELLED, attempt + 0.2) == ["MISSION_COUNT"]
    assert request_item(exchange, 0, 4.1) == [0]
    assert acknowledge(exchange, Result.OPERATION_CANCELLED, 4.2) == []
    assert rejected(exchange).result == Result.OPERATION_CANCELLED


def test_partial_upload_is_not_restarted() -> None:
    exchange = upload(2, first=3)
    sent_since(exchange)
    assert request_item(exchange, 3, 0.1) == [3]
    assert acknowledge(exchange, Result.OPERATION_CANCELLED, 0.2) == []
    assert rejected(exchange).result == Result.OPERATION_CANCELLED
    assert exchange.was_dropped
    assert exchange.may_have_changed_items


@pytest.mark.parametrize(("silence_s", "is_ignored"), [(4.4, True), (4.6, False)])
def test_partial_upload_goes_on_after_denial_of_copied_request(silence_s: float, is_ignored: bool) -> None:
    exchange = upload(2, first=3)
    sent_since(exchange)
    assert request_item(exchange, 3, 0.1) == [3]
    assert acknowledge(exchange, Result.DENIED, 0.1 + silence_s) == []
    assert exchange.done != is_ignored
    assert exchange.may_have_changed_items  # item 3 may have arrived


def test_expired_upload_without_restarts_reports_error() -> None:
    exchange = upload(idle_timeout_s=100.0)
    for number in range(4):
        request_item(exchange, 0, 10.0 * number)
        acknowledge(exchange, Result.ERROR, 10.0 * number + 5.0)
    assert rejected(exchange).result == Result.ERROR


@pytest.mark.parametrize(("silence_s", "answer"), [(4.4, [0]), (4.5, ["MISSION_COUNT"])])
def test_upload_error_after_silence_restarts(silence_s: float, answer: list[int | str]) -> None:
    exchange = upload()
    sent_since(exchange)
    request_item(exchange, 0, 1.0)
    assert acknowledge(exchange, Result.ERROR, 1.0 + silence_s) == answer


def test_upload_error_after_lost_items_restarts() -> None:
    """The vehicle repeats its request until its transfer expires, because it receives nothing."""
    exchange = upload()
    sent_since(exchange)
    for number in range(19):
        request_item(exchange, 0, 1.0 + 0.25 * number)
    assert acknowledge(exchange, Result.ERROR, 5.6) == ["MISSION_COUNT"]


@pytest.mark.parametrize(("has_rebooted", "answer"), [(True, "MISSION_COUNT"), (False, 0)])
def test_upload_restarts_after_reboot_without_progress(has_rebooted: bool, answer: int | str) -> None:
    exchange = upload()
    request_item(exchange, 0, 1.0)
    sent_since(exchange)
    if has_rebooted:
        exchange.vehicle_rebooted(2.0)
    exchange.expire(5.4)
    assert sent_since(exchange) == [0]  # ArduPilot refuses new uploads so soon after its start.
    exchange.expire(5.5)
    assert sent_since(exchange) == [answer]


# --------------------------------------------------------------------------------- items


def test_repeated_request_resends_item_unless_in_flight() -> None:
    exchange = upload()
    sent_since(exchange)
    assert request_item(exchange, 0, 1.0) == [0]
    assert request_item(exchange, 0, 1.07) == []
    assert request_item(exchange, 0, 1.08) == [0]
    assert request_item(exchange, 1, 1.2) == [1]
    assert request_item(exchange, 0, 1.21) == [0]  # an old request, or the vehicle has restarted the upload


def test_items_are_sent_ahead_within_window() -> None:
    exchange = upload(5, window=3)
    sent_since(exchange)
    assert request_item(exchange, 0, 1.0) == [0, 1, 2]
    assert request_item(exchange, 2, 1.1) == [3, 4]
    assert exchange.was_sent_completely
    assert request_item(exchange, 6, 1.2) == []  # no such item
    assert request_item(exchange, 4, 1.2) == []
    assert acknowledge(exchange, Result.ACCEPTED, 1.2) == []
    assert exchange.result() == UploadResult(True, 0, 4)


def test_invalid_sequence_resends_window_and_next_item() -> None:
    exchange = upload(9, window=3)
    sent_since(exchange)
    assert request_item(exchange, 0, 1.0) == [0, 1, 2]
    assert acknowledge(exchange, Result.INVALID_SEQUENCE, 1.05) == [3]
    assert acknowledge(exchange, Result.INVALID_SEQUENCE, 1.2) == [0, 1, 2, 3]


def test_silence_resends_last_item_and_window_alternately() -> None:
    exchange = upload(3, window=3)
    sent_since(exchange)
    assert request_item(exchange, 0, 1.0) == [0, 1, 2]
    for again in ([2], [0, 1, 2], [2]):
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        assert sent_since(exchange) == again


def test_early_acceptance_is_ignored() -> None:
    exchange = upload(2)
    request_item(exchange, 0, 1.0)
    acknowledge(exchange, Result.ACCEPTED, 1.1)
    assert not exchange.done
    request_item(exchange, 1, 1.2)
    acknowledge(exchange, Result.ACCEPTED, 1.3)
    assert exchange.result().is_confirmed


def test_acceptance_before_request_of_last_item_is_unconfirmed() -> None:
    """The delayed answer to an earlier upload looks the same."""
    exchange = upload(3, window=6)
    request_item(exchange, 0, 1.0)
    assert exchange.was_sent_completely
    acknowledge(exchange, Result.ACCEPTED, 1.1)
    assert exchange.result() == UploadResult(False, 0, 0)


def test_acceptance_after_repeated_tail_is_unconfirmed() -> None:
    """PX4 takes a repeated item as the last one."""
    exchange = upload(2, window=6)
    request_item(exchange, 0, 1.0)
    acknowledge(exchange, Result.INVALID_SEQUENCE, 1.5)
    acknowledge(exchange, Result.ACCEPTED, 1.6)
    assert not exchange.result().is_confirmed


def test_refusal_of_single_item_in_flight_is_unambiguous() -> None:
    for window, vague in ((1, False), (2, True)):
        exchange = upload(window=window)
        request_item(exchange, 0, 1.0)
        acknowledge(exchange, Result.INVALID_PARAM1, 1.1)
        assert rejected(exchange).item == 0
        assert exchange.is_refusal_ambiguous is vague


def test_partial_upload_changes_nothing_if_first_item_is_refused() -> None:
    exchange = upload(3, first=5)
    states = [exchange.may_have_changed_items]
    request_item(exchange, 5, 1.0)
    states.append(exchange.may_have_changed_items)
    assert not exchange.was_sent_completely
    acknowledge(exchange, Result.INVALID, 1.1)
    assert [*states, exchange.may_have_changed_items] == [False, True, False]


@pytest.mark.parametrize("seq", [4, 8])
def test_partial_upload_sends_only_own_items(seq: int) -> None:
    exchange = upload(3, first=5)
    sent_since(exchange)
    assert request_item(exchange, seq, 0.1) == []
    assert not exchange.was_started
