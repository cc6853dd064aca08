"""Targets read from bytes equal those of decoded messages, for every message."""

from __future__ import annotations

import pytest

from aerokit.hub.message_rules import TargetFields
from aerokit.mavlink.dialect import STANDARD, Dialect
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import (
    CommandAck,
    FileTransferProtocol,
    Heartbeat,
    ManualControl,
    ParamRequestList,
    SetMode,
)

TARGETS = TargetFields(STANDARD)


def frame_of(message: Message, version: int = 2) -> Frame:
    return Frame.parse(FrameEncoder(1, 1, version=version).encode(message))


def test_table_matches_the_definitions() -> None:
    from_definitions = TargetFields(Dialect("all", STANDARD))
    for message_id in STANDARD.rows:
        assert TARGETS.offsets[message_id] == from_definitions.look_up(message_id), STANDARD[message_id].NAME


def test_every_message_with_a_target_is_in_the_table() -> None:
    for message_type in STANDARD:
        names = {field.name for field in message_type.FIELDS}
        is_for_one = "target_system" in names or message_type.NAME == "MANUAL_CONTROL"
        assert (TARGETS.offsets[message_type.ID] is not None) == is_for_one, message_type.NAME


@pytest.mark.parametrize(
    ("message", "target"),
    [
        (Heartbeat(2, 3, 0, 0, 3), (0, 0)),
        (ParamRequestList(7, 9), (7, 9)),
        (ParamRequestList(7, 0), (7, 0)),  # the last byte is cut off
        (ParamRequestList(0, 0), (0, 0)),
        (SetMode(5, 1, 4), (5, 0)),
        (ManualControl(3, 0, 0, 0, 0, 0), (3, 0)),
        (CommandAck(400, 0, target_system=255, target_component=190), (255, 190)),
        (FileTransferProtocol(0, 2, 3, b"x"), (2, 3)),
    ],
    ids=lambda value: getattr(value, "NAME", str(value)),
)
def test_target_of_a_frame(message: Message, target: tuple[int, int]) -> None:
    assert TARGETS.target_of(frame_of(message)) == target


def test_version_1_has_no_extensions() -> None:
    assert TARGETS.target_of(frame_of(CommandAck(400, 0, target_system=255, target_component=190), 1)) == (
        0,
        0,
    )
    assert TARGETS.target_of(frame_of(ParamRequestList(7, 9), 1)) == (7, 9)


def test_unknown_messages_have_no_target_and_are_not_cached() -> None:
    targets = TargetFields(STANDARD)
    unknown = Frame.parse(bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34")
    assert targets.target_of(unknown) == (0, 0)
    assert unknown.message_id not in targets.offsets
    assert targets.is_unknown(unknown.message_id)
