"""Encoding and decoding of every standard message, compared with pymavlink in both protocol versions."""

from __future__ import annotations

from typing import Any

import pytest
from added_peer import NAMED
from for_each import for_each
from wire_samples import PEERS, dialect_module, peer_class, peer_fields, peer_message, same, samples

from aerokit.mavlink import STANDARD, FrameEncoder, Framer, Message
from aerokit.mavlink.frame import MAGIC_V1

EVERY = list(STANDARD)
SMALL = [message_class for message_class in STANDARD if message_class.ID < 256]
SYSTEM, COMPONENT = 7, 42


def our_bytes(message: Message, version: int, sequence: int) -> bytes:
    encoder = FrameEncoder(SYSTEM, COMPONENT, version=version)
    encoder.sequence = sequence
    return encoder.encode(message)


def peer_bytes(message: Message, version: int, sequence: int) -> bytes:
    module, theirs = peer_message(message, version)
    mavlink = module.MAVLink(None, SYSTEM, COMPONENT)
    mavlink.seq = sequence
    return bytes(theirs.pack(mavlink))


def peer_decoded(raw: bytes, message_class: type[Message], version: int) -> Any:
    module, _ = peer_class(message_class, version)
    (theirs,) = module.MAVLink(None).parse_buffer(raw)
    assert theirs.get_msgId() == message_class.ID
    return theirs


def check(message_class: type[Message], version: int) -> None:
    for sequence, message in enumerate(samples(message_class), start=250):
        sequence &= 0xFF
        raw = peer_bytes(message, version, sequence)
        assert our_bytes(message, version, sequence) == raw
        (frame,) = Framer().receive(raw)
        assert (frame.version, frame.sequence) == (version, sequence)
        assert (frame.system_id, frame.component_id, frame.message_id) == (
            SYSTEM,
            COMPONENT,
            message_class.ID,
        )
        decoded = STANDARD.decode(frame)
        theirs = peer_fields(peer_decoded(raw, message_class, version))
        assert same({name: value for name, value in decoded.to_dict().items() if name in theirs}, theirs)
        if version == 2:
            assert decoded == message


@for_each("message_class", EVERY)
def test_version_2_matches_pymavlink(message_class: type[Message]) -> None:
    check(message_class, 2)


@pytest.mark.exhaustive
@for_each("message_class", SMALL)
def test_version_1_matches_pymavlink(message_class: type[Message]) -> None:
    check(message_class, 1)


@for_each("message_class", SMALL)
def test_version_1_omits_extensions(message_class: type[Message]) -> None:
    for message in samples(message_class, 3):
        raw = our_bytes(message, 1, 0)
        assert (raw[0], raw[1]) == (MAGIC_V1, message_class.BASE_LENGTH)
        (frame,) = Framer().receive(raw)
        base = {f.name: getattr(message, f.name) for f in message_class.FIELDS if not f.extension}
        assert STANDARD.decode(frame) == message_class(**base)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", PEERS)
def test_all_pymavlink_messages_are_known(name: str, version: int) -> None:
    theirs = dialect_module(name, version).mavlink_map
    assert {message_id: cls.crc_extra for message_id, cls in theirs.items()} == {
        message_id: STANDARD[message_id].CRC_EXTRA for message_id in theirs
    }
    assert {message_id: cls.msgname for message_id, cls in theirs.items()} == {
        message_id: STANDARD[message_id].NAME for message_id in theirs
    }


@pytest.mark.parametrize("name", PEERS)
def test_field_units_and_enums_match_pymavlink(name: str) -> None:
    for message_id, cls in dialect_module(name, 2).mavlink_map.items():
        fields = STANDARD[message_id].FIELDS
        assert [field.name for field in fields][: len(cls.fieldnames)] == cls.fieldnames
        same = [field for field in fields if (message_id, field.name) not in NAMED]
        assert {f.name: f.units for f in same if f.units} == without(cls.fieldunits_by_name, message_id)
        assert {f.name: f.enum for f in same if f.enum} == without(cls.fieldenums_by_name, message_id)


def without(facts: dict[str, str], message_id: int) -> dict[str, str]:
    """Metadata of fields that the additions do not change."""
    return {field: fact for field, fact in facts.items() if (message_id, field) not in NAMED}


@pytest.mark.parametrize("name", PEERS)
def test_enums_match_pymavlink(name: str) -> None:
    for enum_name, entries in dialect_module(name, 2).enums.items():
        values = {value for value, entry in entries.items() if entry.name != f"{enum_name}_ENUM_END"}
        assert values <= {int(member) for member in STANDARD.enum(enum_name).__members__.values()}
