"""For whom a frame is, read from its bytes: the same as the decoded message says, for every message there is."""

from __future__ import annotations

import pytest

from aerokit.hub.targets import Targets
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

TARGETS = Targets(STANDARD)


def frame_of(message: Message, version: int = 2) -> Frame:
    return Frame.parse(FrameEncoder(1, 1, version=version).encode(message))


def test_the_table_is_what_the_definitions_say() -> None:
    from_definitions = Targets(Dialect("all", STANDARD))
    for message_id in STANDARD.rows:
        assert TARGETS.places[message_id] == from_definitions.look_up(message_id), STANDARD[message_id].NAME


def test_every_message_that_names_a_target_is_in_it() -> None:
    for message_type in STANDARD:
        names = {field.name for field in message_type.FIELDS}
        is_for_one = "target_system" in names or message_type.NAME == "MANUAL_CONTROL"
        assert (TARGETS.places[message_type.ID] is not None) == is_for_one, message_type.NAME


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
def test_the_target_of_a_frame(message: Message, target: tuple[int, int]) -> None:
    assert TARGETS.of(frame_of(message)) == target


def test_version_1_has_no_extensions() -> None:
    assert TARGETS.of(frame_of(CommandAck(400, 0, target_system=255, target_component=190), 1)) == (0, 0)
    assert TARGETS.of(frame_of(ParamRequestList(7, 9), 1)) == (7, 9)


def test_unknown_messages_are_for_everybody_and_not_remembered() -> None:
    targets = Targets(STANDARD)
    unknown = Frame.parse(bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34")
    assert targets.of(unknown) == (0, 0)
    assert unknown.message_id not in targets.places
    assert targets.is_unknown(unknown.message_id)
