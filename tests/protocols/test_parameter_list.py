"""The parameter list: gaps, changes during the download, and any degree of loss."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from parameter_channel import Channel, FakeVehicle, table_of

from aerokit.errors import InvalidArgument, ParameterTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.message import Message
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.protocols.exchange import RoundTrip, TransferProgress
from aerokit.protocols.parameter_list import ParameterList

RTT_S = 0.1


def listing(bytewise: bool = False, **options: Any) -> ParameterList:
    options.setdefault("round_trip", RoundTrip(RTT_S))
    return ParameterList(1, 1, bytewise=bytewise, **options)


def is_value(message: Message, *indices: int) -> bool:
    return isinstance(message, m.ParamValue) and message.param_index in indices


def lose_once(channel: Channel, *indices: int) -> None:
    """Loses these values of the list, and sends them when requested again."""
    left = set(indices)

    def is_lost(message: Message) -> bool:
        lost = isinstance(message, m.ParamValue) and message.param_index in left
        if lost:
            assert isinstance(message, m.ParamValue)
            left.discard(message.param_index)
        return lost

    channel.is_lost = is_lost


def repeated_requests(channel: Channel) -> list[int]:
    return [request.param_index for request in channel.all(m.ParamRequestRead)]


# ---------------------------------------------------------------------------------- a good link


@pytest.mark.parametrize("bytewise", [False, True])
def test_parameter_list_needs_one_request(bytewise: bool) -> None:
    table = table_of(300)
    channel = Channel(FakeVehicle(table, bytewise=bytewise))
    assert list(channel.run(listing(bytewise)).values()) == table
    assert channel.kinds() == {"PARAM_REQUEST_LIST": 1}


def test_parameter_list_ends_with_last_value() -> None:
    channel = Channel(FakeVehicle(table_of(300)))
    channel.run(listing())
    assert channel.now == pytest.approx(2 * channel.delay_s + FakeVehicle.tick_s * 59)


def test_parameter_list_measures_round_trip_by_one_read() -> None:
    channel = Channel(FakeVehicle(table_of(20)))
    round_trip = RoundTrip()
    channel.run(listing(round_trip=round_trip))
    assert repeated_requests(channel) == [0]
    assert round_trip.smoothed_s == pytest.approx(RTT_S)


def test_parameter_list_ignores_hash() -> None:
    vehicle = FakeVehicle(table_of(50), bytewise=True)
    vehicle.hash_first = True
    assert list(Channel(vehicle).run(listing(True)).values()) == table_of(50)


def test_parameter_list_reports_progress() -> None:
    observed: list[TransferProgress] = []
    Channel(FakeVehicle(table_of(30))).run(listing(on_progress=observed.append))
    assert [progress.done for progress in observed] == list(range(1, 31))
    assert {progress.total for progress in observed} == {30}
    assert observed[-1].fraction == 1.0


def test_idle_timeout_must_be_positive() -> None:
    with pytest.raises(InvalidArgument, match="idle_timeout_s"):
        listing(idle_timeout_s=0.0)


# ----------------------------------------------------------------------------------------- gaps


def test_parameter_list_requests_gaps_at_once() -> None:
    channel = Channel(FakeVehicle(table_of(300)))
    lose_once(channel, 20, 21, 150)
    channel.run(listing())
    assert repeated_requests(channel) == [20, 21, 150]
    times = [at for at, message in channel.sent if isinstance(message, m.ParamRequestRead)]
    assert times[0] == pytest.approx(2 * channel.delay_s + FakeVehicle.tick_s * 4)  # with the value behind it


def test_parameter_list_waits_for_answer_before_retry() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    lost = {50: 2}

    def is_lost(message: Message) -> bool:
        if is_value(message, 50) and lost[50]:
            lost[50] -= 1
            return True
        return False

    channel.is_lost = is_lost
    channel.run(listing())
    times = [at for at, message in channel.sent if isinstance(message, m.ParamRequestRead)]
    assert len(times) == 2
    assert times[1] - times[0] >= RTT_S


def test_parameter_list_requests_lost_end() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    lose_once(channel, 97, 98, 99)
    assert len(channel.run(listing())) == 100
    assert repeated_requests(channel) == [97, 98, 99]
    assert channel.now < 2.0


def test_parameter_list_reads_rest_of_stopped_stream() -> None:
    class Stopping(FakeVehicle):
        def on_list(self) -> None:
            for index, name in enumerate(list(self.parameters)[:200]):
                self.say(self.value(name, index), self.tick_s * (index // self.burst))

    channel = Channel(Stopping(table_of(500)))
    assert list(channel.run(listing()).values()) == table_of(500)
    assert sorted(repeated_requests(channel)) == list(range(200, 500))
    assert channel.kinds()["PARAM_REQUEST_LIST"] == 1


def test_parameter_list_waits_for_paused_stream() -> None:
    class Pausing(FakeVehicle):
        tick_s = 1.0
        burst = 100

    channel = Channel(Pausing(table_of(400)))
    channel.run(listing())
    assert repeated_requests(channel) == []


def test_parameter_list_is_not_delayed_by_answers_to_others() -> None:
    """The request for the list is lost. PX4's answers to reads by name have an index, and look like parts of it."""
    vehicle = FakeVehicle(table_of(100))
    channel = Channel(vehicle)
    channel.is_lost = lambda message: isinstance(message, m.ParamRequestList)
    for number, index in enumerate([40, 50, *[60] * 28]):
        channel.at(2.0 * number, partial(vehicle.say, vehicle.value(f"PARAM_{index:04}", index)))
    assert len(channel.run(listing())) == 100
    assert channel.now < 25.0


def test_parameter_list_repeats_lost_request() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    lost = [True, True]
    channel.is_lost = lambda message: isinstance(message, m.ParamRequestList) and bool(lost and lost.pop())
    assert len(channel.run(listing())) == 100
    assert channel.kinds()["PARAM_REQUEST_LIST"] == 3


def test_parameter_list_limits_requests_in_flight() -> None:
    class SendsTwoValues(FakeVehicle):
        def on_list(self) -> None:
            self.say(self.value("PARAM_0000", 0))
            self.say(self.value("PARAM_0001", 1))

        def on_read(self, request: m.ParamRequestRead) -> None:
            pass

    channel = Channel(SendsTwoValues(table_of(1000)))
    with pytest.raises(ParameterTimeout) as timeout:
        channel.run(listing(idle_timeout_s=3.0))
    assert set(repeated_requests(channel)) == set(range(2, 22))
    assert len(channel.sent) < 200
    assert timeout.value.missing == tuple(range(2, 1000))


# ----------------------------------------------------------------- other messages and duplicates


def test_parameter_list_ignores_other_components() -> None:
    vehicle = FakeVehicle(table_of(30))
    channel = Channel(vehicle)
    stranger = m.ParamValue("CAM_MODE", 1.0, 9, 3, 2)
    channel.at(0.06, lambda: channel.from_vehicle(stranger, component_id=100))
    assert list(channel.run(listing()).values()) == table_of(30)


def test_parameter_list_handles_repeated_and_reordered_values() -> None:
    class SendsTwice(FakeVehicle):
        def say(self, message: Message, after: float = 0.0) -> None:
            super().say(message, after)
            super().say(message, after)

    channel = Channel(SendsTwice(table_of(200)), jitter_s=0.05, seed=3)
    assert list(channel.run(listing()).values()) == table_of(200)


def test_parameter_list_has_value_set_meanwhile() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    news = m.ParamValue("PARAM_0001", 42.0, 9, 100, 0xFFFF)
    channel.at(0.15, lambda: channel.from_vehicle(news))
    assert channel.run(listing())["PARAM_0001"].value == 42.0


def test_parameter_list_index_beyond_count_sends_nothing() -> None:
    channel = Channel(FakeVehicle(table_of(60)))
    channel.at(0.06, lambda: channel.from_vehicle(m.ParamValue("PARAM_0003", 3.0, 2, 60, 65_000)))
    assert len(channel.run(listing())) == 60
    assert len(channel.sent) < 100


# --------------------------------------------------------- the count changes during the download


class Growing(FakeVehicle):
    """A vehicle like ArduPilot: a group appears after ``shown_at`` values, while the stream keeps the old count."""

    shown_at = 60
    place = 80

    def on_list(self) -> None:
        old = list(self.parameters)
        new = [Parameter(f"GROUP_{i}", i, ParameterType.INT8) for i in range(3)]
        for index, name in enumerate(old[: self.shown_at]):
            self.say(self.value(name, index), self.tick_s * (index // self.burst))
        begin = self.tick_s * (self.shown_at // self.burst + 1)

        def continue_stream() -> None:
            rows = list(self.parameters.values())
            rows[self.place : self.place] = new
            count = len(rows)
            self.parameters = {row.name: row for row in rows}
            self.say(m.ParamValue("GROUP_0", 0.0, 2, count, 0xFFFF))
            names = [row.name for row in rows]
            shift = 3 if self.place < self.shown_at else 0
            for place, name in enumerate(names[self.shown_at + shift :]):
                message = self.value(name, self.shown_at + place)
                message = m.ParamValue(
                    message.param_id, message.param_value, message.param_type, len(old), message.param_index
                )
                self.say(message, self.tick_s * (place // self.burst))

        assert self.channel is not None
        self.channel.at(self.channel.now + begin, continue_stream)


@pytest.mark.parametrize("place", [80, 20])
def test_parameter_list_includes_group_enabled_meanwhile(place: int) -> None:
    vehicle = Growing(table_of(100))
    vehicle.place = place
    table = Channel(vehicle).run(listing())
    assert set(table) == set(vehicle.parameters)
    assert table["PARAM_0099"].value == 99


class Px4Growing(FakeVehicle):
    """A vehicle like PX4: count and indices are current; values inserted before the stream's position are skipped."""

    def on_list(self) -> None:
        names = list(self.parameters)
        for place, name in enumerate(names):
            assert self.channel is not None
            self.channel.at(self.channel.now + self.tick_s * (place // 5), partial(self.report_value, name))

    def report_value(self, name: str) -> None:
        if name == "PARAM_0050" and "INSERTED" not in self.parameters:
            rows = list(self.parameters.values())
            rows.insert(10, Parameter("INSERTED", 1, ParameterType.INT32))
            self.parameters = {row.name: row for row in rows}
        self.say(self.value(name, list(self.parameters).index(name)))


def test_parameter_list_finds_inserted_parameter() -> None:
    vehicle = Px4Growing(table_of(100), bytewise=True)
    table = Channel(vehicle).run(listing(True))
    assert list(table) == list(vehicle.parameters)


@pytest.mark.parametrize(
    ("count", "names", "asked"),
    [
        (3, ["SAME"], [2, 0, 1, 0, 1, 2]),
        (4, ["SAME", "PARAM_0002", "PARAM_0003"], [2, 0, 1, 0, 1, 2]),
        (5, ["SAME", "PARAM_0002", "PARAM_0003"], [2, 0, 1, 3, 1, 2, 1]),
    ],
)
def test_parameter_list_accepts_unstable_list_after_retries(count: int, names: list[str], asked: list[int]) -> None:
    """Two of its parameters have the same name, and each answer reports a different count."""

    class ChangesCount(FakeVehicle):
        answers = 0

        def value(self, name: str, index: int | None) -> m.ParamValue:
            answer = super().value(name, index)
            name = "SAME" if index in (0, 1) else answer.param_id
            number = answer.param_count - self.answers % 2
            return m.ParamValue(name, answer.param_value, answer.param_type, number, answer.param_index)

        def on_read(self, request: m.ParamRequestRead) -> None:
            self.answers += 1
            super().on_read(request)

    channel = Channel(ChangesCount(table_of(count)))
    lose_once(channel, 2)
    table: ParameterTable = channel.run(listing())
    assert list(table) == names
    assert [parameter.index for parameter in table.values()] == [0, 2, 3][: len(names)]
    assert repeated_requests(channel) == asked


def test_parameter_list_requests_parameter_added_late() -> None:
    """The answer to the repeated request reports the new count."""

    class AddsOnRead(FakeVehicle):
        def on_read(self, request: m.ParamRequestRead) -> None:
            self.parameters.setdefault("SHOWN", Parameter("SHOWN", 1, ParameterType.INT8))
            super().on_read(request)

    channel = Channel(AddsOnRead(table_of(20)))
    lose_once(channel, 19)
    table: ParameterTable = channel.run(listing())
    assert list(table)[-1] == "SHOWN"
    assert repeated_requests(channel)[:2] == [19, 20]
    assert channel.now < 2.0


def test_parameter_list_that_shrinks_ends() -> None:
    class Shrinking(FakeVehicle):
        refuses = True

        def on_list(self) -> None:
            super().on_list()
            self.parameters.popitem()

        def on_read(self, request: m.ParamRequestRead) -> None:
            if request.param_index >= len(self.parameters):
                self.say(m.ParamError(255, 190, "rubbish", request.param_index, 1))
            else:
                super().on_read(request)

    channel = Channel(Shrinking(table_of(100)))
    lose_once(channel, 99)
    assert list(channel.run(listing()).values()) == table_of(99)


# ----------------------------------------------------------------------------------------- loss


def test_parameter_list_silence_times_out() -> None:
    channel = Channel(FakeVehicle(table_of(10)), loss=1.0)
    with pytest.raises(ParameterTimeout, match="PARAM_REQUEST_LIST was not answered") as timeout:
        channel.run(listing())
    assert timeout.value.missing == ()
    assert channel.now == pytest.approx(10.0)
    assert len(channel.sent) < 30


def test_parameter_list_timeout_names_missing() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    channel.is_lost = lambda message: is_value(message, 7, 8, 9, 41)
    with pytest.raises(ParameterTimeout, match=r"4 of 100 .* missing 7–9, 41") as timeout:
        channel.run(listing())
    assert timeout.value.missing == (7, 8, 9, 41)


def complete(count: int, loss: float, seed: int, **options: Any) -> tuple[ParameterTable, Channel]:
    channel = Channel(FakeVehicle(table_of(count)), loss=loss, seed=seed, **options)
    return channel.run(listing()), channel


@given(seed=st.integers(0, 10**6), loss=st.sampled_from([0.05, 0.1, 0.2, 0.3]), count=st.integers(1, 150))
def test_parameter_list_is_exact_despite_losses(seed: int, loss: float, count: int) -> None:
    table, channel = complete(count, loss, seed, jitter_s=0.002)
    assert list(table.values()) == table_of(count)
    assert len(channel.sent) < 50 + 4 * count  # at most 3.5 of 150 seeds with a loss of 30 %; the median is 2.1


@pytest.mark.parametrize("seed", range(4))
def test_parameter_list_loses_little_time_at_low_loss(seed: int) -> None:
    _, channel = complete(1000, 0.05, seed)
    clean = 2 * channel.delay_s + FakeVehicle.tick_s * 199
    assert channel.now < clean + 1.0


@pytest.mark.parametrize("seed", range(3))
def test_parameter_list_survives_outage(seed: int) -> None:
    channel = Channel(FakeVehicle(table_of(400)), seed=seed)
    channel.is_lost = lambda message: 0.3 < channel.now < 5.0
    assert list(channel.run(listing()).values()) == table_of(400)
