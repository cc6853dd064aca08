"""Message classes: metadata, equality, copies, and decoding of arbitrary payloads."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
from for_each import for_each
from hypothesis import given
from hypothesis import strategies as st
from wire_samples import samples

from aerokit.errors import InvalidArgument
from aerokit.mavlink import STANDARD, Field, FrameEncoder, Framer, Message, messages
from aerokit.mavlink.message import INTEGER_RANGES

EVERY = list(STANDARD)
ATTITUDE = messages.Attitude(1000, 0.25, 0.5, 0.75, -1.25, -1.5, -1.75)


def received(message: Message) -> Message:
    (frame,) = Framer().receive(FrameEncoder(1, 1).encode(message), 3.0)
    return STANDARD.decode(frame)


@for_each("message_class", EVERY)
def test_message_class_attributes(message_class: type[Message]) -> None:
    names = tuple(field.name for field in message_class.FIELDS)
    assert vars(message_class)["__match_args__"] == names
    assert message_class.FIELDS is message_class.FIELDS
    assert message_class.BASE_LENGTH <= message_class.LENGTH <= 255
    assert getattr(messages, message_class.__name__) is message_class
    assert STANDARD.by_name(message_class.NAME) is message_class
    assert STANDARD[message_class.ID] is message_class
    assert message_class.NAME.replace("_", "").lower() == message_class.__name__.lower()
    doc = message_class.__doc__ or ""
    assert doc.startswith(f"{message_class.NAME} ({message_class.ID}): ")
    assert f".html#{message_class.NAME}" in doc
    assert [field.extension for field in message_class.FIELDS] == sorted(f.extension for f in message_class.FIELDS)


@for_each("message_class", EVERY)
def test_message_copies_are_equal(message_class: type[Message]) -> None:
    *_, message = samples(message_class, 3)
    for again in (copy.copy(message), copy.deepcopy(message), pickle.loads(pickle.dumps(message))):
        assert again == message
        assert type(again) is message_class


def test_generated_source_has_units() -> None:
    import inspect

    source = inspect.getsource(messages.GlobalPositionInt)
    assert "relative_alt: int" in source
    assert "Altitude above home. Type: int32_t. Unit: mm." in " ".join(source.split())
    (field,) = [field for field in messages.GlobalPositionInt.FIELDS if field.name == "hdg"]
    assert (field.type, field.units, field.invalid, field.array_length) == (
        "uint16_t",
        "cdeg",
        "UINT16_MAX",
        0,
    )
    assert not field.extension
    assert field.description.startswith("Vehicle heading")
    assert repr(field) == "<Field uint16_t hdg [cdeg]>"
    assert repr(messages.BatteryStatus.FIELDS[4]) == "<Field uint16_t[10] voltages [mV]>"


def test_message_constructor_arguments() -> None:
    message = messages.CommandAck(400, 0)
    assert (message.command, message.result) == (400, 0)
    assert (message.progress, message.result_param2, message.target_system, message.target_component) == (0,) * 4
    assert messages.Heartbeat(2, 3, 81, 4, 3).mavlink_version == 3
    with pytest.raises(TypeError, match="system_status"):
        messages.Heartbeat(2, 3, 81, 4)  # type: ignore[call-arg]


def test_message_equality() -> None:
    same = messages.Attitude(1000, 0.25, 0.5, 0.75, -1.25, -1.5, -1.75)
    assert same == ATTITUDE
    assert messages.Attitude(1001, 0.25, 0.5, 0.75, -1.25, -1.5, -1.75) != ATTITUDE
    assert messages.Ahrs2(0, 0, 0, 0, 0, 0) != messages.Simstate(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    assert ATTITUDE != "ATTITUDE"
    nan = messages.Attitude(0, math.nan, 0, 0, 0, 0, 0)
    assert nan == messages.Attitude(0, math.nan, 0, 0, 0, 0, 0)
    assert nan != messages.Attitude(0, 0, 0, 0, 0, 0, 0)


def test_message_equality_of_tuples_with_nan() -> None:
    first, *others = (
        messages.AttitudeQuaternionCov(0, (1.0, math.nan, 0.0, last), 0, 0, 0, (0.0,) * 9) for last in (0.0, 0.0, 1.0)
    )
    assert [first == other for other in others] == [True, False]


def test_message_equality_ignores_frame() -> None:
    other = received(ATTITUDE)
    assert other == ATTITUDE
    assert ATTITUDE.received_frame is None
    frame = other.received_frame
    assert frame is not None
    assert (frame.system_id, frame.component_id, frame.received_at) == (1, 1, 3.0)


def test_message_copies_keep_frame() -> None:
    for other in (copy.copy(received(ATTITUDE)), pickle.loads(pickle.dumps(received(ATTITUDE)))):
        assert other.received_frame is not None
        assert other.received_frame.raw == FrameEncoder(1, 1).encode(ATTITUDE)


def test_messages_are_not_hashable() -> None:
    with pytest.raises(TypeError, match="unhashable"):
        hash(ATTITUDE)


def test_messages_have_no_other_attributes() -> None:
    with pytest.raises(AttributeError):
        ATTITUDE.rolll = 1.0  # type: ignore[attr-defined]


def test_message_repr_can_be_evaluated() -> None:
    message = messages.Statustext(6, "it's\n", 1, 2)
    assert repr(message) == 'Statustext(severity=6, text="it\'s\\n", id=1, chunk_seq=2)'
    assert eval(repr(message), vars(messages) | {"Statustext": messages.Statustext}) == message


def test_message_repr_hides_keys() -> None:
    key = bytes(range(32))
    message = messages.SetupSigning(1, 1, key, 5)
    assert repr(message) == (
        "SetupSigning(target_system=1, target_component=1, secret_key=<not shown>, initial_timestamp=5)"
    )
    with pytest.raises(InvalidArgument) as raised:
        messages.SetupSigning(1, 1, key * 2, 5).encode()
    assert "secret_key = <not shown>" in str(raised.value)


def test_message_to_dict_order() -> None:
    assert messages.Statustext(6, "hello").to_dict() == {
        "severity": 6,
        "text": "hello",
        "id": 0,
        "chunk_seq": 0,
    }
    assert list(messages.Statustext(6, "hello").to_dict()) == ["severity", "text", "id", "chunk_seq"]


def test_message_pattern_matching() -> None:
    match received(messages.CommandAck(400, 4)):
        case messages.CommandAck(command, result=result):
            assert (command, result) == (400, 4)
        case _:
            pytest.fail("no match")


def test_received_sequences_are_tuples() -> None:
    message = messages.BatteryStatus(0, 0, 0, 0, [3700, 3600], 0, 0, 0, 0)
    assert message.voltages == (3700, 3600)
    decoded = received(message)
    assert isinstance(decoded, messages.BatteryStatus)
    assert decoded.voltages == (3700, 3600, *(0,) * 8)
    assert decoded.voltages_ext == (0, 0, 0, 0)


def test_text_field_ends_at_nul() -> None:
    payload = messages.Statustext(6, "PreArm: ok").encode()
    garbage = payload[:15] + b"garbage"
    assert messages.Statustext.decode(garbage).text == "PreArm: ok"
    assert messages.Statustext.decode(b"\x06" + b"x" * 50).text == "x" * 50
    assert messages.Statustext.decode(b"\x06\xff\xfeabc").text == "\ufffd\ufffdabc"
    assert messages.Statustext.decode(b"\x06" + "grün".encode()).text == "grün"


@given(st.binary(max_size=300), st.sampled_from(list(STANDARD)))
def test_message_decodes_any_payload(payload: bytes, message_class: type[Message]) -> None:
    message = message_class.decode(payload)
    assert message.received_frame is None
    full = payload[: message_class.LENGTH].ljust(message_class.LENGTH, b"\0")
    assert message_class.decode(full) == message
    assert message_class.decode(full.rstrip(b"\0")) == message


def test_field_class_is_public() -> None:
    assert all(isinstance(field, Field) for message_class in STANDARD for field in message_class.FIELDS)


def test_encode_error_names_only_invalid_field() -> None:
    for value in (0, 255):
        with pytest.raises(InvalidArgument, match=r"target_component = 300"):
            messages.CommandLong(value, 300, 400, 0, 0, 0, 0, 0, 0, 0, 0).encode()


def test_integer_field_ranges() -> None:
    assert INTEGER_RANGES == {
        "int8_t": (-128, 127),
        "uint8_t": (0, 255),
        "int16_t": (-32768, 32767),
        "uint16_t": (0, 65535),
        "int32_t": (-2147483648, 2147483647),
        "uint32_t": (0, 4294967295),
        "int64_t": (-9223372036854775808, 9223372036854775807),
        "uint64_t": (0, 18446744073709551615),
    }


@pytest.mark.parametrize("kind", [messages.ParamExtValue, messages.ParamExtSet, messages.ParamExtAck])
def test_char_arrays_with_bytes_keep_zeros(kind: type[Message]) -> None:
    (field,) = (field for field in kind.FIELDS if field.name == "param_value")
    assert (field.type, field.array_length, field.is_text) == ("char", 128, False)
    number = (1000).to_bytes(8, "little", signed=True)
    values = {field.name: "A" if field.is_text else 1 for field in kind.FIELDS} | {"param_value": number}
    decoded = received(kind(**values))
    assert decoded.to_dict()["param_value"] == number.ljust(128, b"\0")
    assert decoded.to_dict()["param_id"] == "A"
    for wrong in ("text", bytes(129), 5):
        with pytest.raises(InvalidArgument, match=r"\.param_value = .* cannot be sent"):
            kind(**values | {"param_value": wrong}).encode()
