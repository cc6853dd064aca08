"""One client sends commands; the others only read, and receive notices."""

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
    ClientFilter,
    ControlLease,
    is_read_only,
    rejection_frames,
)
from aerokit.vehicle.commanding.order import CHANGED_BY_COMMAND, CHANGED_BY_MESSAGE, REQUEST_COMMANDS

LEASE_TIMEOUT_S = 5.0

ARM = CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
REQUEST = CommandLong(1, 1, MavCmd.REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0)
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
READS: list[Message] = [HEARTBEAT, REQUEST, ParamRequestList(1, 1), MissionRequestList(1, 1), ftp(4), ftp(15)]


def send(message: Message, *, system: int = 255) -> bytes:
    return FrameEncoder(system, 190).encode(message)


def reads(message: Message) -> bool:
    (frame,) = Framer().receive(send(message))
    return is_read_only(frame)


def answer_of(data: bytes) -> Message:
    text, frame = Framer().receive(data)
    assert (frame.system_id, frame.component_id) == (text.system_id, text.component_id) == (1, 1)
    assert rejection_frames(data) == (text.raw, frame.raw)
    said = STANDARD.decode(text)
    assert isinstance(said, Statustext)
    assert said.text == "network: one has control"
    return STANDARD.decode(frame)


@pytest.mark.parametrize("order", ORDERS, ids=lambda message: message.NAME)
def test_orders(order: Message) -> None:
    assert not reads(order)


@pytest.mark.parametrize("read", READS, ids=lambda message: message.NAME)
def test_reads(read: Message) -> None:
    assert reads(read)


def test_reads_change_nothing() -> None:
    assert REQUEST_COMMANDS <= READ_COMMANDS  # what this library itself takes for questions
    assert not READ_COMMANDS & CHANGED_BY_COMMAND.keys()
    names = {row[0] for row in messages.INDEX.values()}
    assert names >= READ_MESSAGES
    assert not {STANDARD.by_name(name).__name__ for name in CHANGED_BY_MESSAGE} & READ_MESSAGES


def test_first_order_acquires_lease_and_others_are_notified() -> None:
    lease = ControlLease()
    first, second = ClientFilter("one", lease), ClientFilter("two", lease)
    assert second.receive(send(REQUEST), "free", 0.0) == (send(REQUEST), [])
    assert lease.holder(0.0) is None  # reading does not acquire the lease
    assert first.receive(send(ARM), "free", 0.1) == (send(ARM), [])
    assert lease.holder(0.1) == "one"
    passed, (notice,) = second.receive(send(REQUEST) + send(ARM) + send(HEARTBEAT), "free", 0.2)
    assert passed == send(REQUEST) + send(HEARTBEAT)
    assert (notice.message, notice.lease_holder, notice.reason) == ("COMMAND_LONG", "one", "one has control")
    answer = answer_of(notice.answer)
    assert isinstance(answer, CommandAck)
    assert (answer.command, answer.result, answer.target_system) == (400, 1, 255)
    assert second.refused == 1


def test_refused_mission_gets_an_answer() -> None:
    lease = ControlLease()
    lease.take("one", 0.0)
    _, (notice,) = ClientFilter("two", lease).receive(send(MissionCount(1, 1, 3, 1)), "free", 0.0)
    answer = answer_of(notice.answer)
    assert isinstance(answer, MissionAck)
    assert (answer.type, answer.mission_type, answer.target_system) == (14, 1, 255)


def test_lease_is_free_after_holder_is_silent_or_gone() -> None:
    lease = ControlLease()
    first, second = ClientFilter("one", lease), ClientFilter("two", lease)
    first.receive(send(ARM), "free", 0.0)
    first.receive(send(HEARTBEAT), "free", 4.0)
    assert second.receive(send(ARM), "free", 4.0 + LEASE_TIMEOUT_S - 0.1)[0] == b""
    assert second.receive(send(ARM), "free", 4.0 + LEASE_TIMEOUT_S + 0.1)[0] == send(ARM)
    assert first.receive(send(ARM), "free", 9.2)[0] == b""  # back, but another client has it
    lease.release("one")
    assert lease.holder(9.3) == "two"
    lease.release("two")
    assert first.receive(send(ARM), "free", 9.4)[0] == send(ARM)


def test_take_acquires_the_lease() -> None:
    lease = ControlLease()
    lease.take("one", 0.0)
    lease.take("two", 0.1)
    assert not lease.acquire("one", 0.2)
    assert lease.acquire("two", 0.2)


def test_read_only_client_gets_no_free_lease() -> None:
    lease = ControlLease()
    passed, (notice,) = ClientFilter("one", lease).receive(send(ARM), "never", 0.0)
    assert (passed, notice.lease_holder) == (b"", None)
    assert lease.holder(0.0) is None


def test_setpoint_notices_are_limited_and_counted() -> None:
    lease = ControlLease()
    lease.take("one", 0.0)
    client = ClientFilter("two", lease)
    events = [message for n in range(40) for message in client.receive(send(SET_POINT), "free", n * 0.05)[1]]
    assert 3 <= len(events) <= 5
    assert sum(event.count for event in events) <= 40
    assert events[1].count == 10
    assert client.refused == 40
    assert all(event.answer == b"" for event in events)


def test_late_orders_are_refused_without_answer() -> None:
    client = ClientFilter("one", ControlLease())
    (notice,) = client.refuse_late(send(ARM) + send(HEARTBEAT), 0.0)
    assert (notice.message, notice.reason, notice.answer) == ("COMMAND_LONG", "it arrived too late", b"")
    assert client.refused == 2


def test_unknown_messages_are_orders() -> None:
    unknown = b"\xfd\x01\x00\x00\x00\xff\xbe\xff\xff\xfe\x07\x12\x34"
    lease = ControlLease()
    assert ClientFilter("one", lease).receive(unknown + send(HEARTBEAT), "free", 0.0)[0] == unknown + send(HEARTBEAT)
    assert lease.holder(0.0) == "one"
    passed, events = ClientFilter("two", lease).receive(unknown + send(HEARTBEAT), "free", 0.0)
    assert passed == send(HEARTBEAT)
    assert [event.message for event in events] == ["message 16777214"] or events[0].message.startswith("message ")


@given(st.lists(st.sampled_from([*ORDERS, *READS]), max_size=20), st.binary(max_size=40))
def test_client_without_lease_passes_only_reads(several: list[Message], noise: bytes) -> None:
    lease = ControlLease()
    lease.take("one", 0.0)
    client = ClientFilter("two", lease)
    encoder = FrameEncoder(255, 190)
    data = noise.join(encoder.encode(message) for message in several)
    passed, _ = client.receive(data, "free", 0.0)
    framer = Framer()
    framer.keep_unknown = True
    for frame in framer.receive(passed):
        assert is_read_only(frame)


@pytest.mark.parametrize(
    "answer", [b"", b"noise", send(HEARTBEAT), send(CommandAck(400, 0)), send(Statustext(6, "hello"))]
)
def test_other_frames_are_no_refusals(answer: bytes) -> None:
    assert rejection_frames(answer) == ()


def test_one_of_two_programs_with_same_name_gets_control() -> None:
    client = ClientFilter("ground-1", ControlLease())
    assert client.receive(send(ARM), "free", 0.0, 1) == (send(ARM), [])
    passed, (notice,) = client.receive(send(REQUEST) + send(ARM), "free", 1.0, 2)
    assert passed == send(REQUEST)
    assert notice.reason == "another program uses the client name ground-1"
    assert client.receive(send(ARM), "take", 2.0, 2) == (send(ARM), [])
    assert client.receive(send(ARM), "free", 3.0, 1)[0] == b""
    later = 2.0 + LEASE_TIMEOUT_S + 0.1
    assert client.receive(send(ARM), "free", later, 1) == (send(ARM), [])
