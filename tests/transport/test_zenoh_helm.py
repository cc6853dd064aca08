"""One client orders; the others read, and are told."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.mavlink import messages
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import (
    CommandAck,
    CommandInt,
    CommandLong,
    FileTransferProtocol,
    Heartbeat,
    ManualControl,
    MissionAck,
    MissionClearAll,
    MissionCount,
    MissionRequestList,
    ParamRequestList,
    ParamSet,
    SetMode,
    SetPositionTargetLocalNed,
    Statustext,
)
from aerokit.transport.zenoh.control_lease import (
    READ_COMMANDS,
    READ_MESSAGES,
    Gate,
    Helm,
    is_read,
    refusals_in,
)
from aerokit.vehicle.commanding.order import CHANGED_BY_COMMAND, CHANGED_BY_MESSAGE, QUESTIONS

HELM_KEPT_S = 5.0

ARM = CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
ASK = CommandLong(1, 1, MavCmd.REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0)
SET_POINT = SetPositionTargetLocalNed(0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0)
HEARTBEAT = Heartbeat(6, 8, 0, 0, 4, 3)


def ftp(opcode: int) -> FileTransferProtocol:
    return FileTransferProtocol(0, 1, 1, bytes([0, 0, 0, opcode]) + bytes(247))


ORDERS: list[Message] = [
    ARM,
    CommandInt(1, 1, 6, MavCmd.DO_REPOSITION, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    SET_POINT,
    SetMode(1, 1, 4),
    ManualControl(1, 0, 0, 0, 0, 0),
    ParamSet(1, 1, "RTL_ALT", 10.0, 9),
    MissionCount(1, 1, 3),
    MissionClearAll(1, 1),
    ftp(6),
    ftp(8),
]
READS: list[Message] = [HEARTBEAT, ASK, ParamRequestList(1, 1), MissionRequestList(1, 1), ftp(4), ftp(15)]


def send(message: Message, *, system: int = 255) -> bytes:
    return FrameEncoder(system, 190).encode(message)


def reads(message: Message) -> bool:
    (frame,) = Framer().receive(send(message))
    return is_read(frame)


def answer_of(data: bytes) -> Message:
    text, frame = Framer().receive(data)
    assert (frame.system_id, frame.component_id) == (text.system_id, text.component_id) == (1, 1)
    assert refusals_in(data) == (text.raw, frame.raw)
    said = STANDARD.decode(text)
    assert isinstance(said, Statustext)
    assert said.text == "network: one has the helm"
    return STANDARD.decode(frame)


@pytest.mark.parametrize("order", ORDERS, ids=lambda message: message.NAME)
def test_orders(order: Message) -> None:
    assert not reads(order)


@pytest.mark.parametrize("read", READS, ids=lambda message: message.NAME)
def test_reads(read: Message) -> None:
    assert reads(read)


def test_what_is_known_to_change_something_is_no_read() -> None:
    assert QUESTIONS <= READ_COMMANDS  # what this library itself takes for questions
    assert not READ_COMMANDS & CHANGED_BY_COMMAND.keys()
    names = {row[0] for row in messages.INDEX.values()}
    assert names >= READ_MESSAGES
    assert not {STANDARD.by_name(name).__name__ for name in CHANGED_BY_MESSAGE} & READ_MESSAGES


def test_who_orders_first_has_the_helm_and_the_other_is_told() -> None:
    helm = Helm()
    first, second = Gate("one", helm), Gate("two", helm)
    assert second.receive(send(ASK), "free", 0.0) == (send(ASK), [])
    assert helm.holder(0.0) is None  # reading takes no helm
    assert first.receive(send(ARM), "free", 0.1) == (send(ARM), [])
    assert helm.holder(0.1) == "one"
    passed, (told,) = second.receive(send(ASK) + send(ARM) + send(HEARTBEAT), "free", 0.2)
    assert passed == send(ASK) + send(HEARTBEAT)
    assert (told.message, told.helm, told.reason) == ("COMMAND_LONG", "one", "one has the helm")
    answer = answer_of(told.answer)
    assert isinstance(answer, CommandAck)
    assert (answer.command, answer.result, answer.target_system) == (400, 1, 255)
    assert second.refused == 1


def test_a_plan_is_refused_by_an_answer_too() -> None:
    helm = Helm()
    helm.take("one", 0.0)
    _, (told,) = Gate("two", helm).receive(send(MissionCount(1, 1, 3, 1)), "free", 0.0)
    answer = answer_of(told.answer)
    assert isinstance(answer, MissionAck)
    assert (answer.type, answer.mission_type, answer.target_system) == (14, 1, 255)


def test_the_helm_is_free_again_when_its_holder_is_silent_or_has_gone() -> None:
    helm = Helm()
    first, second = Gate("one", helm), Gate("two", helm)
    first.receive(send(ARM), "free", 0.0)
    first.receive(send(HEARTBEAT), "free", 4.0)
    assert second.receive(send(ARM), "free", 4.0 + HELM_KEPT_S - 0.1)[0] == b""
    assert second.receive(send(ARM), "free", 4.0 + HELM_KEPT_S + 0.1)[0] == send(ARM)
    assert first.receive(send(ARM), "free", 9.2)[0] == b""  # back, and somebody else has it
    helm.leave("one")
    assert helm.holder(9.3) == "two"
    helm.leave("two")
    assert first.receive(send(ARM), "free", 9.4)[0] == send(ARM)


def test_who_takes_it_has_it() -> None:
    helm = Helm()
    helm.take("one", 0.0)
    helm.take("two", 0.1)
    assert not helm.may_order("one", 0.2)
    assert helm.may_order("two", 0.2)


def test_who_never_orders_gets_no_free_helm() -> None:
    helm = Helm()
    passed, (told,) = Gate("one", helm).receive(send(ARM), "never", 0.0)
    assert (passed, told.helm) == (b"", None)
    assert helm.holder(0.0) is None


def test_set_points_are_told_twice_a_second_with_their_number() -> None:
    helm = Helm()
    helm.take("one", 0.0)
    gate = Gate("two", helm)
    told = [each for n in range(40) for each in gate.receive(send(SET_POINT), "free", n * 0.05)[1]]
    assert 3 <= len(told) <= 5
    assert sum(each.count for each in told) <= 40
    assert told[1].count == 10
    assert gate.refused == 40
    assert all(each.answer == b"" for each in told)


def test_late_orders_are_told_without_an_answer() -> None:
    gate = Gate("one", Helm())
    (told,) = gate.refuse_late(send(ARM) + send(HEARTBEAT), 0.0)
    assert (told.message, told.reason, told.answer) == ("COMMAND_LONG", "it came too late", b"")
    assert gate.refused == 2


def test_what_the_dialect_does_not_know_is_an_order() -> None:
    unknown = b"\xfd\x01\x00\x00\x00\xff\xbe\xff\xff\xfe\x07\x12\x34"
    helm = Helm()
    assert Gate("one", helm).receive(unknown + send(HEARTBEAT), "free", 0.0)[0] == unknown + send(HEARTBEAT)
    assert helm.holder(0.0) == "one"
    passed, told = Gate("two", helm).receive(unknown + send(HEARTBEAT), "free", 0.0)
    assert passed == send(HEARTBEAT)
    assert [each.message for each in told] == ["message 16777214"] or told[0].message.startswith("message ")


@given(st.lists(st.sampled_from([*ORDERS, *READS]), max_size=20), st.binary(max_size=40))
def test_a_client_without_the_helm_gets_only_reads_through(several: list[Message], noise: bytes) -> None:
    helm = Helm()
    helm.take("one", 0.0)
    gate = Gate("two", helm)
    encoder = FrameEncoder(255, 190)
    data = noise.join(encoder.encode(message) for message in several)
    passed, _ = gate.receive(data, "free", 0.0)
    framer = Framer()
    framer.keep_unknown = True
    for frame in framer.receive(passed):
        assert is_read(frame)


@pytest.mark.parametrize(
    "answer", [b"", b"noise", send(HEARTBEAT), send(CommandAck(400, 0)), send(Statustext(6, "hello"))]
)
def test_what_is_no_refusal_is_no_answer(answer: bytes) -> None:
    assert refusals_in(answer) == ()


def test_of_two_programs_with_one_name_one_orders() -> None:
    gate = Gate("ground-1", Helm())
    assert gate.receive(send(ARM), "free", 0.0, 1) == (send(ARM), [])
    passed, (told,) = gate.receive(send(ASK) + send(ARM), "free", 1.0, 2)
    assert passed == send(ASK)
    assert told.reason == "another program is called ground-1, too"
    assert gate.receive(send(ARM), "take", 2.0, 2) == (send(ARM), [])
    assert gate.receive(send(ARM), "free", 3.0, 1)[0] == b""
    later = 2.0 + HELM_KEPT_S + 0.1
    assert gate.receive(send(ARM), "free", later, 1) == (send(ARM), [])
