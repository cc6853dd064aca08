"""Mission uploads with any vehicle and link: the reported result is true."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mission_vehicles import GCS, ArduPilotModel, Px4Model, Radio, Run, Store, items, run

from aerokit import messages as m
from aerokit.errors import MissionRejected, MissionTimeout
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.mavlink.message import Message
from aerokit.protocols.exchange import RoundTrip, TransferProgress
from aerokit.protocols.mission_upload import MissionUpload

MODELS = [ArduPilotModel, Px4Model]
OLD = items(30, seed=7)
NEW = items(40)


def upload(new: list[Any], **options: Any) -> MissionUpload:
    return MissionUpload(1, 1, new, **{"window": 6, **options})


def sent(result: Run, kind: type[Message]) -> int:
    return sum(isinstance(message, kind) for message in result.sent)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("window", [1, 6])
def test_mission_upload_sends_once(model: type[Store], window: int) -> None:
    vehicle, exchange = model(OLD), upload(NEW, window=window)
    result = run(exchange, vehicle, Radio())
    assert exchange.result().is_confirmed
    assert vehicle.stored == NEW
    assert sent(result, m.MissionCount) == 1
    assert sent(result, m.MissionItemInt) == len(NEW)
    assert result.seconds <= (2 + len(NEW) / window) * 0.1 + 0.01


@given(
    model=st.sampled_from(MODELS),
    window=st.sampled_from([1, 6]),
    seed=st.integers(0, 1 << 30),
    loss=st.sampled_from([0.0, 0.05, 0.1, 0.2, 0.3]),
    doubling=st.sampled_from([0.0, 0.2]),
    jitter_s=st.sampled_from([0.0, 0.03, 0.3]),
    number=st.integers(1, 40),
)
@example(model=ArduPilotModel, window=1, seed=4, loss=0.3, doubling=0.2, jitter_s=0.0, number=4)
def test_confirmed_upload_is_stored(
    model: type[Store], window: int, seed: int, loss: float, doubling: float, jitter_s: float, number: int
) -> None:
    new, vehicle = items(number), model(OLD)
    exchange = upload(new, window=window)
    result = run(exchange, vehicle, Radio(seed, loss, doubling, jitter_s=jitter_s))
    if result.error is not None:  # With 30 % loss, all three attempts may be lost, as in the @example.
        assert loss == 0.3
        assert isinstance(result.error, MissionTimeout)
    elif exchange.result().is_confirmed:
        assert vehicle.stored == new
    assert len(result.sent) <= 60 + 25 * number


@given(
    model=st.sampled_from(MODELS),
    seed=st.integers(0, 1 << 30),
    loss=st.sampled_from([0.0, 0.1, 0.3]),
    refuses=st.integers(0, 39),
)
def test_refused_mission_upload_is_never_success(model: type[Store], seed: int, loss: float, refuses: int) -> None:
    vehicle = model(OLD, refuses=refuses)
    exchange = upload(NEW)
    result = run(exchange, vehicle, Radio(seed, loss))
    if result.error is None:
        assert not exchange.result().is_confirmed
    elif isinstance(result.error, MissionRejected):
        assert result.error.item == refuses or exchange.is_refusal_ambiguous or result.error.item is None
    if model is Px4Model:
        assert vehicle.stored == OLD


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("loss", "times"), [(0.05, 2.0), (0.2, 4.0)])
def test_mission_upload_time_over_bad_radio(model: type[Store], loss: float, times: float) -> None:
    """Compared with the standard's one-by-one requests without loss."""
    seconds = []
    for seed in range(12):
        vehicle, exchange = model(OLD), upload(items(100), round_trip=RoundTrip(0.1))
        seconds.append(run(exchange, vehicle, Radio(seed, loss)).seconds)
    assert max(seconds) < times * 101 * 0.1 * 0.5
    assert sum(seconds) / len(seconds) < 101 * 0.1


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("refuses", [0, 7, 39])
def test_mission_upload_refusal_names_reason_and_item(model: type[Store], refuses: int) -> None:
    vehicle, exchange = model(OLD, refuses=refuses), upload(NEW, window=1, offset=1)
    error = run(exchange, vehicle, Radio()).error
    assert isinstance(error, MissionRejected)
    assert error.item == (refuses - 1 if refuses else None)
    assert not exchange.is_refusal_ambiguous
    assert error.result in (Result.INVALID_PARAM1, Result.UNSUPPORTED)


def test_mission_upload_refusal_with_window_is_ambiguous() -> None:
    exchange = upload(NEW)
    error = run(exchange, ArduPilotModel(OLD, refuses=7), Radio()).error
    assert isinstance(error, MissionRejected)
    assert exchange.is_refusal_ambiguous
    assert exchange.may_have_changed_items


@pytest.mark.parametrize("model", MODELS)
def test_mission_upload_recovers_lost_ack(model: type[Store]) -> None:
    """PX4 repeats its answer; ArduPilot answers ERROR to a late item, so the mission is downloaded to compare."""
    lost = iter([True])
    radio = Radio(drops=lambda message: isinstance(message, m.MissionAck) and next(lost, False))
    vehicle, exchange = model(OLD), upload(NEW)
    run(exchange, vehicle, radio)
    assert exchange.result().is_confirmed == (model is Px4Model)
    assert vehicle.stored == NEW


@pytest.mark.parametrize("model", MODELS)
def test_mission_upload_does_not_wait_for_lost_requests(model: type[Store]) -> None:
    """The vehicle itself repeats a request after 0.25 or 1 s."""
    lost = iter([True] * 3)
    radio = Radio(
        drops=lambda message: isinstance(message, m.MissionRequest) and message.seq == 3 and next(lost, False)
    )
    vehicle, exchange = model(OLD), upload(NEW)
    assert run(exchange, vehicle, radio).seconds < 2.0
    assert vehicle.stored == NEW


def test_mission_upload_ignores_end_of_older_transfer() -> None:
    exchange = upload(NEW)
    exchange.start(0.0)
    for result in (Result.ACCEPTED, Result.OPERATION_CANCELLED, Result.INVALID_SEQUENCE):
        exchange.receive(m.MissionAck(*GCS, result), 0.01)
    assert not exchange.done


@pytest.mark.parametrize(
    "ack",
    [m.MissionAck(254, 190, Result.DENIED), m.MissionAck(*GCS, Result.DENIED, 1), m.MissionAck(255, 1, 5)],
)
def test_mission_upload_ignores_messages_to_others(ack: m.MissionAck) -> None:
    exchange = upload(NEW)
    exchange.start(0.0)
    exchange.receive(m.MissionRequest(*GCS, 0), 0.1)
    exchange.take_outbox()
    exchange.receive(ack, 0.1)
    exchange.receive(m.MissionRequestInt(254, 190, 5), 0.1)
    exchange.receive(m.MissionRequestInt(*GCS, 39), 0.1)  # not needed before the preceding item
    assert not exchange.done
    assert exchange.take_outbox() == []


def test_mission_upload_while_other_station_uploads() -> None:
    vehicle = ArduPilotModel(OLD)
    count = m.MissionCount(1, 1, 3)
    error = run(upload(NEW), vehicle, Radio(), others=[(0.0, count, (254, 190))]).error
    assert isinstance(error, MissionRejected)
    assert error.result == Result.DENIED
    assert vehicle.stored == OLD[:3]


def test_mission_upload_waits_while_px4_is_busy() -> None:
    vehicle, exchange = Px4Model(OLD), upload(NEW)
    others: list[tuple[float, Message, tuple[int, int]]] = [(0.0, m.MissionRequestList(1, 1), (254, 190))]
    radio = Radio(drops=lambda message: isinstance(message, m.MissionAck) and message.target_system == 1)
    result = run(exchange, vehicle, radio, others=others)
    assert vehicle.stored == NEW
    assert 5.0 < result.seconds < 9.0


def test_mission_upload_after_unfinished_download() -> None:
    vehicle, exchange = Px4Model(OLD), upload(NEW)
    vehicle.receive(m.MissionRequestList(1, 1), 0.0)
    vehicle.out.clear()
    assert run(exchange, vehicle, Radio()).seconds < 3.0
    assert vehicle.stored == NEW


@pytest.mark.parametrize("older_count", [41, 100])
def test_mission_upload_after_px4_missed_cancellation_of_longer_one(older_count: int) -> None:
    vehicle, exchange = Px4Model(OLD), upload(NEW)
    vehicle.receive(m.MissionCount(1, 1, older_count), 0.0)
    vehicle.out.clear()
    assert run(exchange, vehicle, Radio()).seconds < 6.0
    assert vehicle.stored == NEW
    assert exchange.result().is_confirmed


def test_mission_upload_restarts_after_cancellation() -> None:
    vehicle, exchange = ArduPilotModel(OLD), upload(NEW, idle_timeout_s=30.0)
    run(exchange, vehicle, Radio(silences=[(0.3, 10.0)]))
    assert vehicle.stored == NEW


def test_mission_upload_timeout_after_restart_remembers_requests() -> None:
    exchange = upload(NEW)
    exchange.start(0.0)
    exchange.receive(m.MissionRequestInt(*GCS, 0), 0.1)
    exchange.receive(m.MissionAck(*GCS, Result.OPERATION_CANCELLED), 0.2)
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
    with pytest.raises(MissionTimeout, match=f"items not confirmed: 0–{len(NEW) - 1};"):
        exchange.result()


@pytest.mark.parametrize("model", MODELS)
def test_mission_upload_timeout_names_unconfirmed(model: type[Store]) -> None:
    vehicle, exchange = model(OLD), upload(NEW, window=1, offset=1)
    result = run(exchange, vehicle, Radio(silences=[(1.0, 100.0)]))
    assert isinstance(result.error, MissionTimeout)
    assert result.error.missing == tuple(range(result.error.missing[0], 39))
    assert f"items not confirmed: {result.error.missing[0]}–38;" in str(result.error)
    assert 5 <= result.error.missing[0] <= 10
    assert 10.0 <= result.seconds < 14.0
    assert result.sent[-1] == m.MissionAck(1, 1, Result.OPERATION_CANCELLED)
    assert len(result.sent) < 40


def test_mission_upload_without_answer_times_out() -> None:
    result = run(upload(NEW), ArduPilotModel(OLD), Radio(loss=1.0))
    assert isinstance(result.error, MissionTimeout)
    assert "no item was requested" in str(result.error)
    assert len(result.sent) < 14


def test_partial_upload_replaces_items() -> None:
    vehicle, exchange = ArduPilotModel(OLD), upload(NEW[4:6], first=4, window=1)
    result = run(exchange, vehicle, Radio(seed=3, loss=0.3))
    assert result.error is None
    assert vehicle.stored == [*OLD[:4], *NEW[4:6], *OLD[6:]]


def test_partial_upload_of_missing_items_is_refused() -> None:
    vehicle, exchange = ArduPilotModel(OLD[:2]), upload(NEW[4:6], first=4, window=1)
    error = run(exchange, vehicle, Radio()).error
    assert isinstance(error, MissionRejected)
    assert not exchange.was_started


def test_mission_upload_uses_float_form_if_needed() -> None:
    for supports_int, request, kind in (
        (True, m.MissionRequest, m.MissionItemInt),
        (False, m.MissionRequest, m.MissionItem),
        (False, m.MissionRequestInt, m.MissionItemInt),
    ):
        exchange = upload(NEW, window=1, supports_int=supports_int)
        exchange.start(0.0)
        exchange.take_outbox()
        exchange.receive(request(*GCS, 0), 0.1)
        assert [type(message) for message in exchange.take_outbox()] == [kind]


def test_mission_upload_reports_progress() -> None:
    reported: list[TransferProgress] = []
    run(upload(NEW, on_progress=reported.append), ArduPilotModel(), Radio())
    assert [(event.done, event.total) for event in reported] == [(count, 40) for count in range(41)]


def test_mission_upload_progress_has_elapsed_time() -> None:
    reported: list[TransferProgress] = []
    exchange = upload(NEW[:2], window=1, on_progress=reported.append)
    exchange.start(100.0)
    for message, at in ((m.MissionRequestInt(*GCS, 0), 100.5), (m.MissionRequestInt(*GCS, 1), 101.0)):
        exchange.receive(message, at)
    exchange.receive(m.MissionAck(*GCS, Result.ACCEPTED), 102.0)
    assert [(event.done, event.elapsed_s, event.rate) for event in reported] == [
        (0, 0.5, 0.0),
        (1, 1.0, 1.0),
        (2, 2.0, 1.0),
    ]


def test_partial_upload_progress_counts_own_items() -> None:
    reported: list[TransferProgress] = []
    run(upload(NEW[4:7], first=4, window=1, on_progress=reported.append), ArduPilotModel(OLD), Radio())
    assert [(event.done, event.total) for event in reported] == [(count, 3) for count in range(4)]
