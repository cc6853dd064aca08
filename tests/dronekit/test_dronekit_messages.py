"""Frames become pymavlink's messages, and pymavlink's messages are sent: the same as pymavlink itself does it."""

from __future__ import annotations

import copy
import decimal
import math
import os
import pickle
import random
import struct
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil

from aerokit import messages
from aerokit.dronekit.observers import message_of
from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame, x25
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.pymavlink import from_pymavlink

v10: Any = import_module("pymavlink.dialects.v10.ardupilotmega")
v10_common: Any = import_module("pymavlink.dialects.v10.common")
v20: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
common: Any = import_module("pymavlink.dialects.v20.common")
development: Any = import_module("pymavlink.dialects.v20.development")
matrixpilot: Any = import_module("pymavlink.dialects.v20.matrixpilot")
storm32: Any = import_module("pymavlink.dialects.v20.storm32")

SYSTEM, COMPONENT = 42, 7
CLASSES: dict[int, Any] = {**development.mavlink_map, **v20.mavlink_map}
IDS = sorted(message_id for message_id in CLASSES if message_id >= 0)


@pytest.fixture(autouse=True)
def program_dialect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any call of ``mavutil.mavlink_connection`` in this process changes the program's dialect for all tests."""
    monkeypatch.setattr(mavutil, "mavlink", v20)


def raw_frame(message_id: int, payload: bytes, *, version: int = 2, sequence: int = 5, signature: bytes = b"") -> bytes:
    source = bytes((sequence, SYSTEM, COMPONENT))
    if version == 1:
        head = b"\xfe" + bytes((len(payload),)) + source + bytes((message_id,))
    else:
        flags = bytes((len(payload), 1 if signature else 0, 0))
        head = b"\xfd" + flags + source + message_id.to_bytes(3, "little")
    crc_extra = CLASSES[message_id].crc_extra if message_id in CLASSES else 0
    crc = x25(head[1:] + payload + bytes((crc_extra,)))
    return head + payload + crc.to_bytes(2, "little") + signature


def decoded(raw: bytes) -> Any:
    """Reference result from pymavlink."""
    message_id = raw[5] if raw[0] == 0xFE else int.from_bytes(raw[7:10], "little")
    module: Any = v20 if message_id in v20.mavlink_map else development
    return module.MAVLink(None).decode(bytearray(raw))


def contents_of(message: Any) -> dict[str, Any]:
    """Return all public attributes of a message, with comparable NaN."""
    fields = message.get_fieldnames()
    return {
        "fields": repr([(name, getattr(message, name)) for name in fields]),
        "raw texts": [getattr(message, f"_{name}_raw", None) for name in fields],
        "header": vars(message.get_header()),
        "packed header": message.get_header().pack(),
        "buffers": (message.get_msgbuf(), message.get_payload(), message.get_crc()),
        "types": (type(message.get_msgbuf()), type(message.get_payload())),
        "source": (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()),
        "kind": (message.get_type(), message.get_msgId(), message.id, message.msgname, message.crc_extra),
        "signed": (message.get_signed(), message.get_link_id()),
        "texts": (str(message), message.to_json(), repr(message.to_dict())),
        "instances": (message._instances, message._instance_field, message._instance_offset),
    }


def payloads(message_class: Any, randomness: random.Random) -> Iterator[bytes]:
    """Payloads: full, trimmed, as empty as possible, and longer than the message."""
    size = message_class.unpacker.size
    full = randomness.randbytes(size)
    yield full
    yield bytes(randomness.choice((0, 65, 66)) for _ in range(size)).rstrip(b"\0") or b"\0"
    yield full[: randomness.randint(1, size)]
    yield (full + randomness.randbytes(3))[:255]


# -------------------------------------------------------------------------------------- received


@pytest.mark.parametrize("version", [1, 2])
def test_message_of_every_message_matches_pymavlink(version: int) -> None:
    randomness = random.Random(version)
    for message_id in IDS:
        if version == 1 and message_id > 255:
            continue
        for payload in payloads(CLASSES[message_id], randomness):
            raw = raw_frame(message_id, payload, version=version)
            expected = decoded(raw)
            message = message_of(Frame.parse(raw))
            assert contents_of(message) == contents_of(expected)
            assert isinstance(message, type(expected))


@given(st.sampled_from(IDS), st.binary(min_size=1, max_size=255), st.binary(min_size=13, max_size=13))
def test_message_of_any_payload_matches_pymavlink(message_id: int, payload: bytes, signature: bytes) -> None:
    for raw in (raw_frame(message_id, payload), raw_frame(message_id, payload, signature=signature)):
        assert contents_of(message_of(Frame.parse(raw))) == contents_of(decoded(raw))


def test_message_of_frame_from_framer() -> None:
    raw = raw_frame(30, random.Random(3).randbytes(27))
    (frame,) = Framer().receive(raw)
    message = message_of(frame)
    assert contents_of(message) == contents_of(decoded(raw))
    assert message.get_type() == "ATTITUDE"
    assert type(message).__name__ == "MAVLink_attitude_message"
    assert message._timestamp > 1e9


def test_message_missing_attribute_raises() -> None:
    message = message_of(Frame.parse(raw_frame(30, b"\1")))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = message.nonsense
    with pytest.raises(IndexError):
        message["instance"]
    message.roll = 3.0
    assert message.roll == 3.0


def test_messages_can_be_copied_and_pickled() -> None:
    raw = raw_frame(253, b"\6landing")
    message = message_of(Frame.parse(raw))
    message.extra = "kept"
    for copied in (copy.copy(message), copy.deepcopy(message), pickle.loads(pickle.dumps(message))):
        assert type(copied) is v20.MAVLink_statustext_message
        assert contents_of(copied) == contents_of(message) == contents_of(decoded(raw))
        assert copied.extra == "kept"
    assert message == decoded(raw)
    assert decoded(raw) == message


@pytest.mark.parametrize("version", [1, 2])
def test_message_of_unknown_message(version: int) -> None:
    message_id = 212 if version == 1 else 70_000
    raw = raw_frame(message_id, b"\1\2\3", version=version)
    message = message_of(Frame.parse(raw))
    expected = decoded(raw)
    assert isinstance(message, v20.MAVLink_unknown)
    assert (message.get_type(), message.data) == (expected.get_type(), expected.data)
    assert message.get_type() == f"UNKNOWN_{message_id}"
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (SYSTEM, COMPONENT, 5)


# -------------------------------------------------------------------------------------- dialects


@pytest.mark.parametrize("dialect", [v10, v10_common, v20])
def test_message_classes_are_ardupilotmega_mavlink_2(monkeypatch: pytest.MonkeyPatch, dialect: ModuleType) -> None:
    environment = dict(os.environ)
    monkeypatch.setattr(mavutil, "mavlink", dialect)
    message = message_of(Frame.parse(raw_frame(30, b"\1")))
    assert isinstance(message, v20.MAVLink_attitude_message)
    assert mavutil.mavlink is dialect
    assert os.environ == environment


def test_message_classes_follow_programs_dialect(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = Frame.parse(raw_frame(30, b"\1"))
    monkeypatch.setattr(mavutil, "mavlink", common)
    assert isinstance(message_of(frame), common.MAVLink_attitude_message)
    assert isinstance(message_of(frame).get_header(), common.MAVLink_header)
    rangefinder = message_of(Frame.parse(raw_frame(173, b"\1")))
    assert isinstance(rangefinder, v20.MAVLink_rangefinder_message), "common has none"


def test_message_of_programs_dialect_only(monkeypatch: pytest.MonkeyPatch) -> None:
    message_id = foreign(storm32)[0]
    message_class = storm32.mavlink_map[message_id]
    monkeypatch.setitem(CLASSES, message_id, message_class)
    right = Frame.parse(raw_frame(message_id, b"\1"))
    monkeypatch.setitem(CLASSES, message_id, v20.MAVLink_attitude_message)
    wrong = Frame.parse(raw_frame(message_id, b"\1"))
    assert message_of(right).get_type() == f"UNKNOWN_{message_id}"
    monkeypatch.setattr(mavutil, "mavlink", storm32)
    assert isinstance(message_of(right), message_class)
    assert message_of(wrong).get_type() == f"UNKNOWN_{message_id}", "its checksum is not that of the message"


# ------------------------------------------------------------------------------------------ sent


def packed(message: Any, module: Any = v20) -> bytes:
    """Reference result from pymavlink."""
    data: bytes = message.pack(module.MAVLink(None, SYSTEM, COMPONENT))
    return data


def encoded(message: Any, *, version: int = 2, target_system: int | None = None) -> bytes:
    return FrameEncoder(SYSTEM, COMPONENT, version=version).encode(from_pymavlink(message, target_system))


def arguments(message: Any) -> list[Any]:
    """Return source code that creates this message."""
    return [getattr(message, f"_{name}_raw", getattr(message, name)) for name in message.fieldnames]


def test_send_mavlink_every_message_matches_pymavlink() -> None:
    randomness = random.Random(4)
    for message_id in IDS:
        module = v20 if message_id in v20.mavlink_map else development
        for payload in payloads(CLASSES[message_id], randomness):
            raw = raw_frame(message_id, payload)
            message = decoded(raw)
            expected = packed(message, module)
            assert encoded(message) == expected
            assert encoded(message_of(Frame.parse(raw))) == expected, "received messages can be forwarded"
            assert isinstance(from_pymavlink(message), STANDARD[message_id])


def test_send_mavlink_mavlink_1_classes_with_both_versions() -> None:
    randomness = random.Random(5)
    for message_id, message_class in sorted(v10.mavlink_map.items()):
        raw = raw_frame(message_id, randomness.randbytes(message_class.unpacker.size), version=1)
        old = v10.MAVLink(None).decode(bytearray(raw))
        new = v20.mavlink_map[message_id](*arguments(old))
        assert encoded(old, version=1) == packed(old, v10)
        assert encoded(old, version=2) == packed(new)
        assert encoded(decoded(raw), version=1) == packed(old, v10)


def foreign(dialect: Any) -> list[int]:
    """Return messages that only this dialect has, or that differ from the standard."""
    rows = STANDARD.rows
    return [
        message_id
        for message_id, message_class in sorted(dialect.mavlink_map.items())
        if message_id >= 0 and (message_id not in rows or rows[message_id][0] != message_class.crc_extra)
    ]


@pytest.mark.parametrize("dialect", [storm32, matrixpilot])
def test_send_mavlink_other_dialects(monkeypatch: pytest.MonkeyPatch, dialect: Any) -> None:
    randomness = random.Random(6)
    assert foreign(dialect)
    for message_id in foreign(dialect):
        message_class = dialect.mavlink_map[message_id]
        monkeypatch.setitem(CLASSES, message_id, message_class)
        raw = raw_frame(message_id, randomness.randbytes(message_class.unpacker.size))
        message = dialect.MAVLink(None).decode(bytearray(raw))
        assert encoded(message) == packed(message, dialect)


def test_send_mavlink_sets_target_in_message() -> None:
    message = v20.MAVLink_command_long_message(0, 17, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    sent = from_pymavlink(message, 9)
    assert (type(sent), sent.ID) == (messages.CommandLong, 76)
    assert sent.to_dict() == {**sent.to_dict(), "target_system": 9, "target_component": 17, "param1": 1}
    assert (message.target_system, message.target_component) == (9, 17)
    assert from_pymavlink(message, 0) == from_pymavlink(message) == sent
    message.param1 = 0
    assert sent.to_dict()["param1"] == 1, "changed after it was sent"


def test_send_mavlink_without_target_field() -> None:
    message = v20.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    from_pymavlink(message, 9)
    assert not hasattr(message, "target_system")


def test_send_mavlink_accepts_aerokit_messages() -> None:
    message = messages.CommandLong(0, 1, 400, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    sent = from_pymavlink(message, 9)
    assert (sent, message.target_system) == (messages.CommandLong(9, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0), 0)
    assert encoded(messages.Heartbeat(6, 8, 0, 0, 0, 3)) == packed(v20.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))


def test_send_mavlink_accepts_subclass() -> None:
    class Item(v10.MAVLink_mission_item_message):  # type: ignore[misc]
        def __init__(self, x: float, y: float, z: float) -> None:
            super().__init__(0, 0, 1, 3, 16, 0, 1, 0, 0, 0, 0, x, y, z)

    sent = from_pymavlink(Item(-35.5, 149.25, 30), 1)
    assert isinstance(sent, messages.MissionItem)
    assert (sent.x, sent.y, sent.z, sent.mission_type) == (-35.5, 149.25, 30, 0)


def test_send_mavlink_accepts_objects_with_fields() -> None:
    class Ping:
        time_usec, seq, target_system, target_component = 1, 2, 0, 0

        def get_type(self) -> str:
            return "PING"

    assert from_pymavlink(Ping(), 3) == messages.Ping(1, 2, 3, 0)


# ---------------------------------------------------------------------------------------- values


class Number:
    """A number like numpy's: not a subclass of float."""

    def __float__(self) -> float:
        return 2.6


@pytest.mark.parametrize(
    ("given", "expected"),
    [(3, 3), (3.0, 3), (2.6, 3), (-0.4, 0), (True, 1), (Number(), 3), (decimal.Decimal("2.7"), 3)],
)
def test_send_mavlink_rounds_integer_fields(given: Any, expected: int) -> None:
    sent = from_pymavlink(v20.MAVLink_mission_set_current_message(1, 1, given))
    assert isinstance(sent, messages.MissionSetCurrent)
    assert sent.seq == expected
    assert type(sent.seq) is int


def test_send_mavlink_real_fields() -> None:
    message = v20.MAVLink_command_long_message(1, 1, 22, 0, True, Number(), decimal.Decimal("1.5"), 3, math.nan, 0, 0)
    sent = from_pymavlink(message)
    assert isinstance(sent, messages.CommandLong)
    assert (sent.param1, sent.param2, sent.param3, sent.param4) == (1, 2.6, 1.5, 3)
    assert math.isnan(sent.param5)


@pytest.mark.parametrize("text", ["MFT240", b"MFT240", bytearray(b"MFT240\0\0"), "MFT240\0"])
def test_send_mavlink_accepts_str_and_bytes(text: Any) -> None:
    message = v20.MAVLink_play_tune_message(1, 1, b"")
    message.tune = text
    assert from_pymavlink(message) == messages.PlayTune(1, 1, "MFT240")


def test_send_mavlink_keeps_non_utf_8_texts() -> None:
    message = v20.MAVLink_play_tune_message(1, 1, b"\xff\xfe")
    assert encoded(message) == packed(message)
    message.tune = "é"
    assert from_pymavlink(message) == messages.PlayTune(1, 1, "é")


def test_send_mavlink_pads_arrays() -> None:
    for data in ([1, 2.0], (1, 2), b"\1\2", bytearray(b"\1\2"), range(1, 3), [True, 2.4]):
        message = v20.MAVLink_file_transfer_protocol_message(0, 1, 1, data)
        assert from_pymavlink(message) == messages.FileTransferProtocol(0, 1, 1, b"\1\2")
    q = v20.MAVLink_set_attitude_target_message(0, 1, 1, 0, (1, 0, Number()), 0, 0, 0, 0.5)
    assert from_pymavlink(q).to_dict()["q"] == (1, 0, 2.6)
    assert from_pymavlink(q).encode()[4:20] == struct.pack("<4f", 1, 0, 2.6, 0), "missing elements are 0"


def command(**wrong: Any) -> Any:
    message = v20.MAVLink_command_long_message(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 0)
    for name, value in wrong.items():
        setattr(message, name, value)
    return message


def tune(text: Any) -> Any:
    message = v20.MAVLink_play_tune_message(1, 1, b"")
    message.tune = text
    return message


@pytest.mark.parametrize(
    ("message", "pattern"),
    [
        (command(command=None), "COMMAND_LONG.command = None .*0..65535"),
        (command(command=math.nan), "COMMAND_LONG.command = nan .*0..65535"),
        (command(command=math.inf), "COMMAND_LONG.command = inf .*0..65535"),
        (command(command=65536), "COMMAND_LONG.command = 65536 .*0..65535"),
        (command(command="22"), "COMMAND_LONG.command = '22' .*0..65535"),
        (command(confirmation=-1), "COMMAND_LONG.confirmation = -1 .*0..255"),
        (command(param1=None), "COMMAND_LONG.param1 = None .*number"),
        (command(param1="1"), "COMMAND_LONG.param1 = '1' .*number"),
        (command(param1=1e39), "COMMAND_LONG.param1 = 1e.39 .*float"),
        (tune("x" * 31), "PLAY_TUNE.tune = .*31 bytes, at most 30"),
        (tune(b"\xff" * 31), "PLAY_TUNE.tune = .*31 bytes, at most 30"),
        (tune(None), "PLAY_TUNE.tune = None .*30"),
        (v20.MAVLink_file_transfer_protocol_message(0, 1, 1, [0] * 252), "payload.*252 elements|at most 251"),
        (v20.MAVLink_file_transfer_protocol_message(0, 1, 1, [0, 256]), "payload.*element 1 .*0..255"),
        (v20.MAVLink_file_transfer_protocol_message(0, 1, 1, [0, None]), "payload.*element 1 .*0..255"),
        (v20.MAVLink_file_transfer_protocol_message(0, 1, 1, "text"), "payload.*251 numbers"),
        (
            v20.MAVLink_set_attitude_target_message(0, 1, 1, 0, [1] * 5, 0, 0, 0, 0),
            "q = .*5 elements, at most 4",
        ),
        (v20.MAVLink_set_attitude_target_message(0, 1, 1, 0, None, 0, 0, 0, 0), "q = None .*4 numbers"),
        (v20.MAVLink_bad_data(b"\1", "noise"), "not a message that can be sent"),
        (v20.MAVLink_unknown(70_000, b"\1"), "not a message that can be sent"),
        ("COMMAND_LONG", "not a MAVLink message"),
        (None, "not a MAVLink message"),
    ],
)
def test_send_mavlink_rejects_invalid_values(message: Any, pattern: str) -> None:
    with pytest.raises(InvalidArgument, match=pattern) as caught:
        from_pymavlink(message, 1)
    assert isinstance(caught.value, ValueError)


def test_send_mavlink_names_missing_field() -> None:
    message = command()
    del message.param3
    with pytest.raises(InvalidArgument, match=r"COMMAND_LONG .*field param3 has no value"):
        from_pymavlink(message)
