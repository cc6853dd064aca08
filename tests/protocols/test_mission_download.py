"""Mission downloads return all items or name the missing ones; clearing; setting the current item."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mission_vehicles import GCS, ArduPilotModel, Px4Model, Radio, Store, items, run

from aerokit import messages as m
from aerokit.errors import MissionRejected, MissionTimeout, OperationTimeout
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.missions import MissionItem
from aerokit.missions.wire import to_wire, to_wire_float
from aerokit.protocols.exchange import RoundTrip, TransferProgress
from aerokit.protocols.mission_download import MissionDownload
from aerokit.protocols.missions import MissionClear, SetCurrentItem

MAX_RESTARTS = 8

HELD = items(50)
WINDOWS: list[tuple[type[Store], int]] = [(ArduPilotModel, 10), (ArduPilotModel, 1), (Px4Model, 1)]


def download(window: int = 10, **options: Any) -> MissionDownload:
    return MissionDownload(1, 1, window=window, **options)


@pytest.mark.parametrize(("model", "window"), WINDOWS)
def test_mission_download_requests_once(model: type[Store], window: int) -> None:
    vehicle, exchange = model(HELD), download(window)
    result = run(exchange, vehicle, Radio())
    assert list(exchange.result().items) == HELD
    assert sum(isinstance(message, m.MissionRequestInt) for message in result.sent) == len(HELD)
    assert result.seconds <= (2 + len(HELD) / window) * 0.1 + 0.01
    assert isinstance(result.sent[-1], m.MissionAck)


def test_mission_download_restarts_eight_times() -> None:
    exchange, now = download(window=1, round_trip=RoundTrip(0.1)), 0.0
    exchange.start(now)
    lists = 0
    while not exchange.done:
        lists += sum(isinstance(message, m.MissionRequestList) for message in exchange.take_outbox())
        exchange.receive(m.MissionCount(*GCS, 3), now + 0.1)
        exchange.receive(m.MissionAck(*GCS, Result.ERROR), now + 0.2)
        now += 1.0
        exchange.expire(now)
    assert lists == 1 + MAX_RESTARTS == 9
    with pytest.raises(MissionRejected):
        exchange.result()


def test_mission_download_ignores_errors_for_late_items_of_upload() -> None:
    """ArduPilot answers each copy of an item that arrives after the upload with ERROR, and answers the requests."""
    exchange = download(round_trip=RoundTrip(0.1))
    exchange.start(0.0)
    exchange.receive(m.MissionCount(*GCS, 20), 0.1)
    for seq, item in enumerate(HELD[:20]):
        exchange.receive(m.MissionAck(*GCS, Result.ERROR), 0.2 + 0.1 * seq)
        message = to_wire(item, seq, target_system=GCS[0], target_component=GCS[1], mission_type=0)
        exchange.receive(message, 0.2 + 0.1 * seq)
    assert list(exchange.result().items) == HELD[:20]
    assert sum(isinstance(message, m.MissionRequestList) for message in exchange.take_outbox()) == 1


def test_mission_download_on_slow_link_ignores_errors_for_late_items() -> None:
    """The round trip was measured on a faster link, so ERRORs arrive after each time-out and before the answer."""
    exchange = download(round_trip=RoundTrip(0.1))
    exchange.start(0.0)
    for number in range(1, 20):
        exchange.receive(m.MissionAck(*GCS, Result.ERROR), 0.1 * number)
        exchange.expire(0.1 * number)
    exchange.receive(m.MissionCount(*GCS, 0), 2.0)
    assert exchange.result().count == 0


def test_mission_download_error_until_timeout_is_rejected() -> None:
    exchange = download(round_trip=RoundTrip(0.1), idle_timeout_s=2.0)
    exchange.start(0.0)
    exchange.receive(m.MissionAck(*GCS, Result.ERROR), 0.1)
    exchange.expire(2.1)
    with pytest.raises(MissionRejected):
        exchange.result()


@pytest.mark.parametrize(
    ("window", "opaque_id", "asked"),
    [(1, 7, [0]), (1, 8, [0])],
)
def test_mission_download_restart_keeps_items(window: int, opaque_id: int, asked: list[int]) -> None:
    """PX4's items are requested one by one and in sequence; another opaque_id means another mission."""
    reported: list[TransferProgress] = []
    exchange, held = download(window, round_trip=RoundTrip(0.1), on_progress=reported.append), HELD[:3]

    def answer(message: m.MissionCount | m.MissionItemInt | m.MissionAck, now: float) -> list[int]:
        exchange.take_outbox()
        exchange.receive(message, now)
        return [message.seq for message in exchange.take_outbox() if isinstance(message, m.MissionRequestInt)]

    exchange.start(100.0)
    answer(m.MissionCount(*GCS, 3, 0, 7 if opaque_id else 0), 101.0)
    answer(to_wire(held[0], 0, target_system=GCS[0], target_component=GCS[1], mission_type=0), 102.0)
    assert answer(m.MissionAck(*GCS, Result.ERROR), 103.0) == []
    exchange.expire(103.5)
    kept = int(opaque_id == 7)
    assert answer(m.MissionCount(*GCS, 3, 0, opaque_id), 104.0) == asked
    assert [event.done for event in reported] == [0, 1, kept]
    for seq in range(3):
        answer(to_wire(held[seq], seq, target_system=GCS[0], target_component=GCS[1], mission_type=0), 105.0)
    if opaque_id:  # The id is requested again.
        answer(m.MissionCount(*GCS, 3, 0, opaque_id), 106.0)
    assert list(exchange.result().items) == held
    assert exchange.result().opaque_id == opaque_id


def test_mission_download_of_replaced_plan_has_only_new_items() -> None:
    """Another station replaces PX4's plan over another link. From then on, PX4 sends the items of the new plan."""
    old, new = HELD[:3], HELD[10:13]
    exchange = download(window=1, round_trip=RoundTrip(0.1))

    def answer(items_on_vehicle: list[MissionItem], opaque_id: int, now: float) -> None:
        for message in exchange.take_outbox():
            if isinstance(message, m.MissionRequestList):
                exchange.receive(m.MissionCount(*GCS, 3, 0, opaque_id), now)
            elif isinstance(message, m.MissionRequestInt):
                item = to_wire(
                    items_on_vehicle[message.seq], message.seq, target_system=GCS[0], target_component=GCS[1]
                )
                exchange.receive(item, now)

    exchange.start(0.0)
    for number in range(2):  # The count and the first item of the old plan.
        answer(old, 7, 0.1 + 0.1 * number)
    for number in range(20):
        answer(new, 8, 0.3 + 0.1 * number)
    assert list(exchange.result().items) == new
    assert exchange.result().opaque_id == 8


def test_mission_download_timeout_before_id_was_received_again() -> None:
    exchange = download(round_trip=RoundTrip(0.1), idle_timeout_s=2.0)
    exchange.start(0.0)
    exchange.receive(m.MissionCount(*GCS, 1, 0, 7), 0.1)
    exchange.receive(to_wire(HELD[0], 0, target_system=GCS[0], target_component=GCS[1]), 0.2)
    exchange.expire(2.3)
    with pytest.raises(MissionTimeout, match="whether another station has replaced the plan") as caught:
        exchange.result()
    assert caught.value.missing == ()


@given(
    model_and_window=st.sampled_from(WINDOWS),
    seed=st.integers(0, 1 << 30),
    loss=st.sampled_from([0.0, 0.05, 0.1, 0.2, 0.3]),
    doubling=st.sampled_from([0.0, 0.2]),
    jitter_s=st.sampled_from([0.0, 0.03, 0.2]),
    number=st.integers(0, 40),
)
def test_mission_download_is_exact_despite_losses(
    model_and_window: tuple[type[Store], int],
    seed: int,
    loss: float,
    doubling: float,
    jitter_s: float,
    number: int,
) -> None:
    model, window = model_and_window
    held = items(number)
    vehicle, exchange = model(held), download(window)
    result = run(exchange, vehicle, Radio(seed, loss, doubling, jitter_s=jitter_s))
    if result.error is None:
        assert list(exchange.result().items) == held
    else:  # PX4 aborts when requests are reordered
        assert jitter_s or doubling
        assert isinstance(result.error, (MissionTimeout, MissionRejected))
    assert len(result.sent) <= 60 + 30 * number


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("model", "window"), WINDOWS)
@pytest.mark.parametrize(("loss", "times"), [(0.05, 2.0), (0.2, 4.0)])
def test_mission_download_time_over_bad_radio(model: type[Store], window: int, loss: float, times: float) -> None:
    """Compared with the time this vehicle needs without loss."""
    for seed in range(8):
        exchange = download(window, round_trip=RoundTrip(0.1))
        result = run(exchange, model(HELD), Radio(seed, loss))
        assert result.error is None
        assert result.seconds < times * max(0.1 * (2 + len(HELD) / window), 0.8)


def test_mission_download_of_some_items() -> None:
    exchange = download(only=(3, 4, 20, 77))
    result = run(exchange, ArduPilotModel(HELD), Radio(seed=5, loss=0.2))
    assert result.error is None
    assert list(exchange.result().items) == [HELD[3], HELD[4], HELD[20]]
    assert exchange.result().count == 50


def test_mission_download_timeout_names_missing() -> None:
    exchange = download(window=1, offset=1)
    result = run(exchange, ArduPilotModel(HELD), Radio(silences=[(1.05, 100.0)]))
    assert isinstance(result.error, MissionTimeout)
    assert result.error.missing == tuple(range(result.error.missing[0], 49))
    assert f"missing: {result.error.missing[0]}–48;" in str(result.error)
    assert result.seconds < 14.0


def test_mission_download_timeout_names_missing_home() -> None:
    exchange = download(only=(0,), offset=1)
    exchange.start(0.0)
    exchange.receive(m.MissionCount(*GCS, 3), 0.1)
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
    with pytest.raises(MissionTimeout, match="missing: home;") as caught:
        exchange.result()
    assert caught.value.missing == ()


def test_mission_download_restarts_after_change() -> None:
    vehicle, exchange = ArduPilotModel(HELD), download(window=1)
    others = [(0.5, m.MissionClearAll(1, 1), (254, 190))]
    run(exchange, vehicle, Radio(), others=others)
    assert exchange.result().items == ()


def test_mission_download_waits_for_abandoned_upload() -> None:
    """ArduPilot sends nothing for 8 s."""
    vehicle, exchange = ArduPilotModel(HELD), download()
    vehicle.receive(m.MissionCount(1, 1, 50), 0.0)
    vehicle.out.clear()
    result = run(exchange, vehicle, Radio())
    assert list(exchange.result().items) == HELD
    assert 8.0 < result.seconds < 10.0


def test_mission_download_of_unsupported_type() -> None:
    exchange = download(mission_type=2)
    exchange.start(0.0)
    exchange.receive(m.MissionAck(*GCS, Result.UNSUPPORTED, 2), 0.1)
    with pytest.raises(MissionRejected, match=r"rally points: .* not supported"):
        exchange.result()


def test_mission_download_in_float_form() -> None:
    exchange = download(supports_int=False)
    exchange.start(0.0)
    exchange.receive(m.MissionCount(*GCS, 1), 0.1)
    assert isinstance(exchange.take_outbox()[-1], m.MissionRequest)
    item = MissionItem(16, 3, x=470_000_000, y=80_000_000, z=7.0)
    exchange.receive(to_wire_float(item, 0, target_system=255, target_component=190), 0.2)
    assert exchange.result().items[0].x == pytest.approx(item.x, abs=50)


@pytest.mark.parametrize("model", [ArduPilotModel, Px4Model])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1 << 30))
def test_mission_clear(model: type[Store], seed: int) -> None:
    vehicle, exchange = model(HELD), MissionClear(1, 1)
    result = run(exchange, vehicle, Radio(seed, 0.3))
    assert result.error is None
    assert vehicle.stored == []
    assert len(result.sent) < 20


def test_mission_clear_refused() -> None:
    exchange = MissionClear(1, 1)
    exchange.start(0.0)
    exchange.receive(m.MissionAck(*GCS, Result.ERROR), 0.1)
    assert exchange.take_outbox() == [m.MissionClearAll(1, 1)] * 2
    exchange.expire(1.4)
    exchange.receive(m.MissionAck(*GCS, Result.ERROR), 1.6)
    with pytest.raises(MissionRejected):
        exchange.result()


def test_mission_clear_errors_for_late_items_are_no_refusal() -> None:
    exchange = MissionClear(1, 1, round_trip=RoundTrip(0.5))
    exchange.start(0.0)
    for now in (0.1, 0.2, 0.5, 0.6):
        exchange.receive(m.MissionAck(*GCS, Result.ERROR), now)
    exchange.receive(m.MissionAck(*GCS, Result.ACCEPTED), 0.7)
    assert exchange.done
    exchange.result()


def test_mission_clear_unanswered() -> None:
    result = run(MissionClear(1, 1), ArduPilotModel(HELD), Radio(loss=1.0))
    assert isinstance(result.error, MissionTimeout)
    assert "the vehicle may have cleared it" in str(result.error)


def test_set_current_item() -> None:
    exchange = SetCurrentItem(1, 1, 4, idle_timeout_s=5.0)
    exchange.start(0.0)
    assert exchange.take_outbox() == [m.MissionSetCurrent(1, 1, 4)]
    exchange.receive(m.MissionCurrent(2), 0.1)
    exchange.receive(m.MissionCurrent(3), 0.2)
    assert not exchange.done
    exchange.expire(1.1)
    assert exchange.take_outbox() == [m.MissionSetCurrent(1, 1, 4)]
    exchange.receive(m.MissionCurrent(4), 1.2)
    exchange.result()


def test_set_current_of_item_passed_at_once() -> None:
    exchange = SetCurrentItem(1, 1, 4)
    exchange.start(0.0)
    exchange.receive(m.MissionCurrent(2), 0.1)
    exchange.receive(m.MissionCurrent(5), 0.2)
    exchange.result()


def test_set_current_not_accepted_times_out() -> None:
    exchange = SetCurrentItem(1, 1, 4, idle_timeout_s=3.0)
    exchange.start(0.0)
    exchange.receive(m.MissionCurrent(2), 0.1)
    for at in (1.0, 2.0, 3.0):
        exchange.expire(at)
    with pytest.raises(OperationTimeout, match="reported item 2"):
        exchange.result()
