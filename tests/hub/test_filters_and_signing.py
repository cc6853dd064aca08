"""Filters of outgoing messages, and endpoints that sign."""

from __future__ import annotations

import pytest

from aerokit import Signing, SigningKey
from aerokit.errors import InvalidArgument
from aerokit.hub.message_rules import Filters
from aerokit.hub.port import FrameSigner
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude, CommandAck, GpsRawInt, Heartbeat, ParamRequestList
from aerokit.mavlink.signing import Refusal

KEY = SigningKey.from_passphrase("border")
NOW = 1_700_000_000.0


def test_everything_passes_without_filters() -> None:
    assert Filters(STANDARD).min_interval(Attitude.ID) == 0.0
    assert Filters(STANDARD).min_interval(51234) == 0.0


def test_only_block_and_rates() -> None:
    filters = Filters(STANDARD, only=["HEARTBEAT", "GPS_*"], block=["GPS_STATUS"], rates={"GPS_R*": 4, "*": 10})
    assert filters.min_interval(Heartbeat.ID) == pytest.approx(0.1)
    assert filters.min_interval(GpsRawInt.ID) == pytest.approx(0.25)
    assert filters.min_interval(25) is None
    assert filters.min_interval(Attitude.ID) is None
    assert filters.min_interval(51234) is None
    assert Filters(STANDARD, block=["GPS_*"]).min_interval(51234) == 0.0


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"only": ["ATITUDE"]}, r"only = 'ATITUDE' matches no message .*did you mean 'ATTITUDE'"),
        ({"block": ["X_*"]}, r"block = 'X_\*' matches no message"),
        ({"rates": {"ATTITUDE": 0}}, "rates: ATTITUDE = 0 Hz is not allowed: it must be above 0"),
        ({"rates": {"ATTITUDE": 1001}}, "at most 1000"),
        ({"rates": {"ATTITUDE": float("nan")}}, "above 0"),
    ],
)
def test_pattern_without_match_is_refused(fields: dict[str, object], text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        Filters(STANDARD, **fields)  # type: ignore[arg-type]


def border() -> tuple[FrameSigner, list[str]]:
    refused: list[str] = []
    return FrameSigner(Signing(KEY), STANDARD.extras, lambda frame, why: refused.append(why)), refused


MESSAGES = [Heartbeat(2, 3, 81, 0, 3), ParamRequestList(1, 0), CommandAck(400, 0, 0, 0, 255, 190)]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.NAME)
@pytest.mark.parametrize("version", [1, 2])
def test_signed_frame_keeps_sender_and_content(message: Heartbeat, version: int) -> None:
    own, _ = border()
    encoder = FrameEncoder(7, 9, version=version)
    encoder.sequence = 77
    signed = own.sign(encoder.encode(message), NOW)
    assert signed is not None
    (frame,) = Framer().receive(signed)
    assert (frame.system_id, frame.component_id, frame.sequence, frame.version) == (7, 9, 77, 2)
    expected = message if version == 2 else type(message).decode(Frame.parse(encoder.encode(message)).payload)
    assert STANDARD.decode(frame) == expected
    assert Signing(KEY).check(frame, NOW) is None
    other, _ = border()
    inside = other.verify(frame, NOW)
    assert inside is not None
    assert inside.incompat_flags == 0
    assert Framer().receive(inside.raw)[0].body == inside.body
    if version == 2:
        encoder.sequence = 77
        assert inside.raw == encoder.encode(message)


def test_unsigned_frame_is_refused() -> None:
    own, refused = border()
    raw = FrameEncoder(7, 9).encode(MESSAGES[0])
    assert own.verify(Frame.parse(raw), NOW) is None
    assert refused == [Refusal.UNSIGNED.value]
    signed = own.sign(raw, NOW)
    assert signed is not None
    again, refused = border()
    assert again.verify(Frame.parse(signed), NOW) is not None
    assert again.verify(Frame.parse(signed), NOW) is None
    assert refused == [Refusal.REPLAYED.value]


def test_allow_unsigned_admits_a_radio() -> None:
    signing = Signing(KEY, allow_unsigned=lambda frame: frame.system_id == 7)
    own = FrameSigner(signing, STANDARD.extras, lambda frame, why: None)
    frame = Frame.parse(FrameEncoder(7, 9).encode(MESSAGES[0]))
    assert own.verify(frame, NOW) is frame
    assert own.verify(Frame.parse(FrameEncoder(8, 9).encode(MESSAGES[0])), NOW) is None


def test_allow_unsigned_exception_refuses() -> None:
    refused: list[str] = []
    signing = Signing(KEY, allow_unsigned=lambda frame: 1 / 0 > 1)
    own = FrameSigner(signing, STANDARD.extras, lambda frame, why: refused.append(why))
    assert own.verify(Frame.parse(FrameEncoder(7, 9).encode(MESSAGES[0])), NOW) is None
    assert "ZeroDivisionError" in refused[0]


def test_unknown_messages_cannot_be_signed() -> None:
    unknown = bytes.fromhex("fd 04 00 00 07 01 01 22 c8 00") + b"mine" + b"\x12\x34"
    assert border()[0].sign(unknown, NOW) is None


def test_rate_for_all_excludes_answers() -> None:
    filters = Filters(STANDARD, rates={"*": 5, "LOG_DATA": 100})
    assert filters.min_interval(Attitude.ID) == pytest.approx(0.2)
    for name in ("PARAM_VALUE", "COMMAND_ACK", "LOG_ENTRY", "STATUSTEXT"):
        assert filters.min_interval(next(kind.ID for kind in STANDARD if name == kind.NAME)) == 0.0
    assert filters.min_interval(120) == pytest.approx(0.01)
