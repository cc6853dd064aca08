"""Reading and writing parameters by name: unknown names, confirmation, rounding, refusals, loss."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from parameter_channel import Channel, FakeVehicle, framed, table_of

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.message import Message
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import value_message
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.parameter_requests import ParameterAnswer, ParameterReads, ParameterWrites, rejection

RTT_S = 0.1
INT32, INT8, REAL32 = ParameterType.INT32, ParameterType.INT8, ParameterType.REAL32


def reads(*names: str, bytewise: bool = False, **options: Any) -> ParameterReads:
    options.setdefault("round_trip", RoundTrip(RTT_S))
    return ParameterReads(1, 1, names, bytewise=bytewise, own_system=255, **options)


def writes(*wanted: Parameter, bytewise: bool = False, **options: Any) -> ParameterWrites:
    options.setdefault("round_trip", RoundTrip(RTT_S))
    return ParameterWrites(1, 1, wanted, bytewise=bytewise, own_system=255, **options)


def value(answer: ParameterAnswer) -> float:
    assert isinstance(answer, Parameter)
    return answer.value


# -------------------------------------------------------------------------------------- reading


def test_parameter_read_needs_one_request() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    answers = channel.run(reads("PARAM_0004"))
    assert answers == {"PARAM_0004": Parameter("PARAM_0004", 2.0, REAL32)}
    assert channel.kinds() == {"PARAM_REQUEST_READ": 1}


def test_parameter_reads_use_window_and_keep_order() -> None:
    channel = Channel(FakeVehicle(table_of(100)))
    names = [f"PARAM_{i:04}" for i in range(99, -1, -1)]
    answers = channel.run(reads(*names))
    assert list(answers) == names
    assert sum(at == 0.0 for at, _ in channel.sent) == 20
    assert channel.kinds() == {"PARAM_REQUEST_READ": 100}


def test_parameter_reads_of_nothing() -> None:
    answers: dict[str, ParameterAnswer] = Channel(FakeVehicle(table_of(1))).run(reads())
    assert not answers


def test_unknown_parameter_is_rejected_by_param_error() -> None:
    vehicle = FakeVehicle(table_of(10))
    vehicle.refuses = True
    answer = Channel(vehicle).run(reads("NOPE"))["NOPE"]
    assert isinstance(answer, ParameterRejected)
    assert (answer.name, answer.code) == ("NOPE", 1)
    assert "no such parameter" in str(answer)


def test_single_param_error_is_retried() -> None:
    """PX4 answers DOES_NOT_EXIST also when its buffer is full."""

    class BufferFull(FakeVehicle):
        refused = 0

        def on_read(self, request: m.ParamRequestRead) -> None:
            self.refused += 1
            if self.refused == 1:
                self.say(m.ParamError(255, 190, request.param_id, 0, 1))
            else:
                super().on_read(request)

    assert value(Channel(BufferFull(table_of(10))).run(reads("PARAM_0004"))["PARAM_0004"]) == 2.0


def test_param_error_for_other_station_is_ignored() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    for at in (0.01, 0.02):
        channel.at(at, lambda: channel.from_vehicle(m.ParamError(254, 190, "PARAM_0004", -1, 1)))
    assert value(channel.run(reads("PARAM_0004"))["PARAM_0004"]) == 2.0


def test_unanswered_name_is_rejected_by_probe() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    answers = channel.run(reads("NOPE", "PARAM_0004", probe=True))
    answer = answers["NOPE"]
    assert isinstance(answer, ParameterRejected)
    assert answer.code is None
    assert "it answers requests for other names" in str(answer)
    assert value(answers["PARAM_0004"]) == 2.0
    assert channel.now < 1.5


@pytest.mark.parametrize("link_s", [RTT_S, None])
def test_answers_to_earlier_probes_reject_no_name(link_s: float | None) -> None:
    """After a pause of the link, the answers to the probes of earlier reads arrive together."""
    exchange = reads("PARAM_0004", probe=True, round_trip=RoundTrip(RTT_S, link_s=lambda: link_s))
    exchange.start(0.0)
    for _ in range(20):
        exchange.receive(framed(m.ParamValue("PARAM_0000", 1.0, REAL32, 10, 0)), RTT_S)
    assert not exchange.done


def test_many_unknown_names_need_few_messages() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    answers = channel.run(reads(*(f"NOPE_{i}" for i in range(100)), probe=True))
    assert all(isinstance(answer, ParameterRejected) for answer in answers.values())
    assert len(channel.sent) < 600


def test_parameter_reads_of_silent_vehicle_time_out() -> None:
    channel = Channel(FakeVehicle(table_of(10)), loss=1.0)
    answer = channel.run(reads("PARAM_0004", idle_timeout_s=5.0))["PARAM_0004"]
    assert isinstance(answer, ParameterTimeout)
    assert answer.missing == ("PARAM_0004",)
    assert channel.now == pytest.approx(5.0)
    assert len(channel.sent) < 60


def test_possibly_stale_value_is_accepted_second_time() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    answers = channel.run(reads("PARAM_0004", possibly_stale={"PARAM_0004": 2.0}))
    assert value(answers["PARAM_0004"]) == 2.0
    assert channel.kinds() == {"PARAM_REQUEST_READ": 2}


@given(seed=st.integers(0, 10**6), loss=st.sampled_from([0.05, 0.1, 0.2, 0.3]), count=st.integers(1, 60))
def test_parameter_reads_are_exact_despite_losses(seed: int, loss: float, count: int) -> None:
    table = table_of(60)
    channel = Channel(FakeVehicle(table), loss=loss, seed=seed)
    answers = channel.run(reads(*(parameter.name for parameter in table[:count]), probe=True))
    assert [value(answer) for answer in answers.values()] == [parameter.value for parameter in table[:count]]
    assert len(channel.sent) < 100 + 6 * count


# -------------------------------------------------------------------------------------- writing


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize(
    ("number", "type_"),
    [
        (5, INT32),
        (-5_000_000, INT32),
        (0.1, REAL32),
        (-3, INT8),
        (1e-30, REAL32),
        (2_139_095_041 // 128 * 128, INT32),
    ],
)
def test_parameter_write_is_confirmed_by_value_and_type(bytewise: bool, number: float, type_: ParameterType) -> None:
    """The bytes of -5,000,000 are a signalling NaN as a float."""
    vehicle = FakeVehicle([Parameter("A", 0, type_)], bytewise=bytewise)
    channel = Channel(vehicle)
    answer = channel.run(writes(Parameter("A", number, type_), bytewise=bytewise))["A"]
    assert value(answer) == pytest.approx(number, rel=1e-6)
    assert isinstance(answer, Parameter)
    assert answer.type == type_
    assert isinstance(answer.value, int) == type_.is_integer
    assert channel.kinds() == {"PARAM_SET": 1}


def test_parameter_writes_use_window() -> None:
    table = table_of(50)
    channel = Channel(FakeVehicle(table))
    answers = channel.run(writes(*(name.replace(value=1) for name in table)))
    assert {value(answer) for answer in answers.values()} == {1}
    assert channel.kinds() == {"PARAM_SET": 50}
    assert channel.now < 0.6


class Clamping(FakeVehicle):
    def store(self, name: str, value: float) -> None:
        super().store(name, min(value, 10))


def test_parameter_writes_in_flight_fit_into_queue_of_ardupilot() -> None:
    exchange = writes(*(Parameter(f"P{number}", 1.0, REAL32) for number in range(400)))
    exchange.start(0.0)
    now, most = 0.0, 0
    while not exchange.done:
        names = [message.param_id for message in exchange.take_outbox() if isinstance(message, m.ParamSet)]
        most, now = max(most, len(names)), now + RTT_S
        for name in names:
            exchange.receive(m.ParamValue(name, 1.0, REAL32, 400, 0), now)
    assert 20 < most <= 25


def test_clamped_value_is_accepted() -> None:
    channel = Channel(Clamping([Parameter("A", 0, INT32)]))
    assert value(channel.run(writes(Parameter("A", 50, INT32), before={"A": 0}))["A"]) == 10
    assert len(channel.sent) < 6


class ReadOnly(FakeVehicle):
    def store(self, name: str, value: float) -> None:
        pass


def test_unchanged_value_is_reported() -> None:
    channel = Channel(ReadOnly([Parameter("A", 7, INT32)]))
    assert value(channel.run(writes(Parameter("A", 50, INT32), before={"A": 7}))["A"]) == 7
    assert len(channel.sent) < 25


def test_old_value_in_flight_is_ignored() -> None:
    vehicle = FakeVehicle([Parameter("A", 1, INT32)])
    channel = Channel(vehicle)
    channel.is_lost = lambda message: isinstance(message, m.ParamSet) and channel.now < 0.01
    for at in (0.0, 0.01, 0.02):
        channel.at(at, lambda: channel.from_vehicle(m.ParamValue("A", 1.0, 6, 1, 0xFFFF)))
    assert value(channel.run(writes(Parameter("A", 2, INT32), before={"A": 1}))["A"]) == 2
    assert vehicle.parameters["A"].value == 2


def test_late_answers_with_old_value_are_no_refusal() -> None:
    """The round trip seems short, and answers to many earlier requests arrive before those to the write."""
    vehicle = FakeVehicle([Parameter("A", 1, INT32)])
    channel = Channel(vehicle, delay_s=0.3)
    for number in range(12):
        channel.at(number * 0.02, lambda: channel._arrive(framed(m.ParamValue("A", 1.0, 6, 1, 0xFFFF))))
    exchange = writes(Parameter("A", 2, INT32), before={"A": 1}, round_trip=RoundTrip(0.01))
    assert value(channel.run(exchange)["A"]) == 2


def test_value_before_write_does_not_confirm() -> None:
    table = [Parameter(f"P{i}", 0, INT32) for i in range(30)]
    vehicle = FakeVehicle(table)
    channel = Channel(vehicle, delay_s=0.05)
    channel.at(0.0, lambda: channel.from_vehicle(m.ParamValue("P29", 1.0, 6, 30, 0xFFFF)))
    channel.run(writes(*(name.replace(value=1) for name in table)))
    assert {parameter.value for parameter in vehicle.parameters.values()} == {1}


def test_integer_reported_as_float_is_confirmed() -> None:
    class DefaultAsFloat(FakeVehicle):
        def value(self, name: str, index: int | None) -> m.ParamValue:
            reported = self.parameters[name]
            return m.ParamValue(name, float(reported.value), 9, 1, 0xFFFF)

    channel = Channel(DefaultAsFloat([Parameter("A", 0, INT8)]))
    answer = channel.run(writes(Parameter("A", 3, INT8)))["A"]
    assert answer == Parameter("A", 3, INT8)
    assert channel.kinds() == {"PARAM_SET": 1}


def test_other_type_is_reported_after_read() -> None:
    class OtherType(FakeVehicle):
        def value(self, name: str, index: int | None) -> m.ParamValue:
            return m.ParamValue(name, 5.0, 9, 1, 0xFFFF)

    channel = Channel(OtherType([Parameter("A", 5.0, REAL32)], bytewise=True))
    answer = channel.run(writes(Parameter("A", 5, INT32), bytewise=True))["A"]
    assert answer == Parameter("A", 5.0, REAL32)
    assert len(channel.sent) < 6


@pytest.mark.parametrize(("before", "asked"), [([], 1), ([(4, 6)], 2), ([(4, 9)], 2), ([(5, 6)], 0), ([(5, 9)], 1)])
def test_other_type_is_accepted_when_repeated(before: list[tuple[int, int]], asked: int) -> None:
    """An int of type 6 is requested, a float of type 9 arrives; ``asked`` counts the read-backs."""
    exchange = writes(Parameter("A", 5, INT32), bytewise=True, before={"A": 0.0})
    exchange.start(0.0)
    exchange.take_outbox()
    for number, (value_, type_) in enumerate([*before, (5, 9)]):
        if not exchange.done:
            reported = Parameter("A", value_, ParameterType(type_))
            exchange.receive(value_message(reported, 1, bytewise=True), 1.0 + number)
    assert len(exchange.take_outbox()) == asked


def test_other_value_is_accepted_when_repeated_consecutively() -> None:
    """An echo of a preceding write arrives while the same name is read."""
    exchange = writes(Parameter("A", 5, INT32), bytewise=True, before={"A": 0.0}, recent=["A"])
    exchange.start(0.0)
    done = []
    for number, reported in enumerate((4, 5, 4, 4)):
        exchange.take_outbox()
        exchange.receive(value_message(Parameter("A", reported, INT32), 1, bytewise=True), 1.0 + number)
        done.append(exchange.done)
    assert done == [False, False, False, True]
    assert value(exchange.result()["A"]) == 4


def test_copies_of_late_answer_do_not_confirm_restored_value() -> None:
    """A block that restored SERVO8_MAX of an ArduCopter took two answers to its earlier reads for the confirmation."""
    exchange = writes(Parameter("A", 5, INT32), recent=["A"], round_trip=RoundTrip(2.0))
    exchange.start(0.0)
    for now in (0.4, 0.4, 0.5):
        exchange.receive(value_message(Parameter("A", 5, INT32), 1, bytewise=False), now)
    assert not exchange.done
    exchange.receive(value_message(Parameter("A", 5, INT32), 1, bytewise=False), 2.4)
    assert value(exchange.result()["A"]) == 5


def test_parameter_refusal_has_text() -> None:
    vehicle = FakeVehicle([])
    vehicle.refuses = True
    answer = Channel(vehicle).run(writes(Parameter("A", 5, INT32)))["A"]
    assert isinstance(answer, ParameterRejected)
    assert answer.code == 1


@pytest.mark.parametrize(("code", "words"), [(2, "this value"), (5, "read-only"), (7, "another type"), (99, "99")])
def test_param_error_texts(code: int, words: str) -> None:
    assert words in str(rejection("A", code))


def test_unconfirmed_parameter_write_times_out() -> None:
    channel = Channel(FakeVehicle([]))
    answer = channel.run(writes(Parameter("A", 5, INT32), idle_timeout_s=2.0))["A"]
    assert isinstance(answer, ParameterTimeout)
    assert "not confirmed" in str(answer)
    assert len(channel.sent) < 30


def test_write_ignores_values_of_other_components() -> None:
    vehicle = FakeVehicle([])
    channel = Channel(vehicle)
    channel.at(0.01, lambda: channel.from_vehicle(m.ParamValue("A", 5.0, 6, 1, 0xFFFF), component_id=100))
    answer = channel.run(writes(Parameter("A", 5, INT32), idle_timeout_s=1.0))["A"]
    assert isinstance(answer, ParameterTimeout)


@given(seed=st.integers(0, 10**6), loss=st.sampled_from([0.05, 0.1, 0.2, 0.3]), count=st.integers(1, 40))
def test_parameter_writes_arrive_despite_losses(seed: int, loss: float, count: int) -> None:
    table = table_of(count)
    vehicle = FakeVehicle(table)
    channel = Channel(vehicle, loss=loss, seed=seed)
    before = {parameter.name: parameter.value for parameter in table}
    answers = channel.run(writes(*(name.replace(value=101) for name in table), before=before))
    assert {value(answer) for answer in answers.values()} == {101}
    assert {parameter.value for parameter in vehicle.parameters.values()} == {101}
    assert len(channel.sent) < 50 + 6 * count


@given(seed=st.integers(0, 10**6), loss=st.sampled_from([0.1, 0.3]))
def test_clamping_is_reported_despite_losses(seed: int, loss: float) -> None:
    channel = Channel(Clamping([Parameter("A", 0, INT32)]), loss=loss, seed=seed)
    assert value(channel.run(writes(Parameter("A", 50, INT32), before={"A": 0}))["A"]) == 10
    assert len(channel.sent) < 80


def test_parameter_requests_ignore_unrequested_messages() -> None:
    exchange = reads("A")
    exchange.start(0.0)
    others: list[Message] = [m.ParamValue("B", 1.0, 6, 1, 0), m.Heartbeat(2, 3, 0, 0, 3, 3)]
    for message in others:
        exchange.receive(framed(message), 0.01)
    assert not exchange.done


def test_alternative_name_is_rejected_by_answer() -> None:
    channel = Channel(FakeVehicle(table_of(10)))
    alternatives = {"PARAM_0004": ("OLD_NAME",), "OLD_NAME": ("PARAM_0004",)}
    answers = channel.run(reads("OLD_NAME", "PARAM_0004", probe=True, alternatives=alternatives))
    assert value(answers["PARAM_0004"]) == 2.0
    assert isinstance(answers["OLD_NAME"], ParameterRejected)
    assert channel.now == pytest.approx(RTT_S)


# --------------------------------------------------------------- number of PARAM_SET messages


class LosesAnswers(FakeVehicle):
    """Applies writes, and loses the first answers, or all."""

    lost = 10**9

    def receive(self, message: Message) -> None:
        before, self.lost = self.lost, self.lost - 1
        if before > 0 and not isinstance(message, m.ParamSet):
            return
        super().receive(message)

    def on_set(self, request: m.ParamSet) -> None:
        pass


def test_parameter_write_is_not_repeated_in_silence() -> None:
    channel = Channel(LosesAnswers(table_of(1)))
    answers = channel.run(writes(Parameter("PARAM_0000", 7, INT8), idle_timeout_s=3.0))
    assert isinstance(answers["PARAM_0000"], ParameterTimeout)
    assert channel.kinds()["PARAM_SET"] == 1
    assert channel.kinds()["PARAM_REQUEST_READ"] > 1


def test_old_value_repeats_parameter_write() -> None:
    class LosesSets(FakeVehicle):
        lost = 3

        def on_set(self, request: m.ParamSet) -> None:
            self.lost -= 1
            if self.lost < 0:
                super().on_set(request)

    channel = Channel(LosesSets(table_of(1)))
    answers = channel.run(writes(Parameter("PARAM_0000", 7, INT8), before={"PARAM_0000": 0}))
    assert value(answers["PARAM_0000"]) == 7
    assert channel.kinds()["PARAM_SET"] == 4


def test_parameter_write_keeps_value_of_other_station() -> None:
    """The echo is lost and another value reported: it is read back and returned."""

    class SetByAnother(FakeVehicle):
        def on_set(self, request: m.ParamSet) -> None:
            self.parameters["PARAM_0000"] = Parameter("PARAM_0000", 3, INT8)

    channel = Channel(SetByAnother(table_of(1)))
    answers = channel.run(writes(Parameter("PARAM_0000", 7, INT8), before={"PARAM_0000": 0}))
    assert value(answers["PARAM_0000"]) == 3
    assert channel.kinds()["PARAM_SET"] == 1


def test_parameter_write_accepts_faster_vehicle() -> None:
    """The round trip was measured on a busy vehicle, and the first writes were lost: answers seem too early."""
    vehicle = FakeVehicle(table_of(1))
    channel = Channel(vehicle, delay_s=0.005)
    channel.is_lost = lambda message: channel.now < 3.0
    asked = Parameter("PARAM_0000", 5, INT8)
    answer = channel.run(writes(asked, before={"PARAM_0000": 0}))["PARAM_0000"]
    assert value(answer) == vehicle.parameters["PARAM_0000"].value == 5
    assert channel.now < 5.0
