"""The encoder: invalid values are refused with field, value and range; valid messages are numbered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from aerokit.errors import InvalidArgument
from aerokit.mavlink import Frame, FrameEncoder, Framer, Message, enums, messages
from aerokit.mavlink.frame import x25, x25_in_python


def attitude(**changes: Any) -> Message:
    fields = {
        "time_boot_ms": 0,
        "roll": 0,
        "pitch": 0,
        "yaw": 0,
        "rollspeed": 0,
        "pitchspeed": 0,
        "yawspeed": 0,
    }
    return messages.Attitude(**{**fields, **changes})


def battery(voltages: Any) -> Message:
    return messages.BatteryStatus(0, 0, 0, 0, voltages, 0, 0, 0, 0)


def text(value: Any) -> Message:
    return messages.Statustext(6, value)


def injected(value: Any) -> Message:
    return messages.GpsInjectData(1, 1, 2, value)


WRONG: list[tuple[Callable[[], Message], str]] = [
    (
        lambda: attitude(time_boot_ms=-1),
        "ATTITUDE.time_boot_ms = -1 cannot be sent: must be in 0..4294967295",
    ),
    (
        lambda: attitude(time_boot_ms=1 << 32),
        "= 4294967296 cannot be sent: must be in 0..4294967295 (uint32_t)",
    ),
    (
        lambda: attitude(time_boot_ms=1.5),
        "= 1.5 cannot be sent: must be an integer in 0..4294967295 (uint32_t)",
    ),
    (
        lambda: attitude(time_boot_ms="1"),
        "= '1' cannot be sent: must be an integer in 0..4294967295 (uint32_t)",
    ),
    (lambda: attitude(roll="up"), "ATTITUDE.roll = 'up' cannot be sent: must be a number"),
    (lambda: attitude(roll=None), "ATTITUDE.roll = None cannot be sent: must be a number"),
    (lambda: attitude(roll=1e39), "ATTITUDE.roll = 1e+39 cannot be sent: does not fit into a float"),
    (
        lambda: messages.Heartbeat(256, 0, 0, 0, 0),
        "HEARTBEAT.type = 256 cannot be sent: must be in 0..255 (uint8_t)",
    ),
    (
        lambda: messages.ManualControl(1, 40000, 0, 0, 0, 0),
        "MANUAL_CONTROL.x = 40000 cannot be sent: must be in -32768",
    ),
    (lambda: messages.Timesync(1 << 63, 0), "must be in -9223372036854775808..9223372036854775807 (int64_t)"),
    (lambda: messages.SystemTime(-1, 0), "must be in 0..18446744073709551615 (uint64_t)"),
    (lambda: text("x" * 51), "cannot be sent: has 51 bytes, at most 50 fit"),
    (lambda: text("µ" * 26), "cannot be sent: has 52 bytes, at most 50 fit"),
    (lambda: text(b"bytes"), "STATUSTEXT.text = b'bytes' cannot be sent: must be a str of at most 50 bytes"),
    (lambda: text("\ud800"), "cannot be sent: has characters that cannot be encoded"),
    (lambda: injected(b"x" * 111), "cannot be sent: has 111 elements, at most 110 fit"),
    (lambda: injected("text"), "GPS_INJECT_DATA.data = 'text' cannot be sent: must be bytes, at most 110"),
    (lambda: injected([1, 2]), "GPS_INJECT_DATA.data = [1, 2] cannot be sent: must be bytes, at most 110"),
    (lambda: battery((1,) * 11), "cannot be sent: has 11 elements, at most 10 fit"),
    (
        lambda: battery((1, 70000)),
        "voltages = (1, 70000) cannot be sent: must be in 0..65535 (uint16_t)",
    ),
    (lambda: battery((1.5,)), "cannot be sent: must be an integer in 0..65535 (uint16_t)"),
]


@pytest.mark.parametrize(("make", "complaint"), WRONG, ids=[complaint for _, complaint in WRONG])
def test_encode_error_names_field(make: Callable[[], Message], complaint: str) -> None:
    encoder = FrameEncoder(1, 1)
    with pytest.raises(InvalidArgument) as caught:
        encoder.encode(make())
    assert complaint in str(caught.value)
    assert encoder.sequence == 0, "the sequence number does not advance"
    assert caught.value.__cause__ is None


@pytest.mark.parametrize(
    "message",
    [
        attitude(roll=3),
        attitude(time_boot_ms=True),
        messages.Heartbeat(enums.MavType.QUADROTOR, enums.MavAutopilot.PX4, enums.MavModeFlag.SAFETY_ARMED, 0, 0),
        battery([1]),
        battery(()),
        injected(bytearray(b"ab")),
        text(""),
        text("x" * 50),
    ],
    ids=repr,
)
def test_encode_accepts_compatible_types(message: Message) -> None:
    assert len(message.encode()) == message.LENGTH


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((0, 1), "system_id = 0 must be in 1..255"),
        ((256, 1), "system_id = 256 must be in 1..255"),
        ((1, 256), "component_id = 256 must be in 0..255"),
        ((1, -1), "component_id = -1 must be in 0..255"),
    ],
)
def test_encoder_rejects_invalid_ids(arguments: tuple[int, int], complaint: str) -> None:
    with pytest.raises(InvalidArgument, match=complaint):
        FrameEncoder(*arguments)


def test_encoder_accepts_component_zero() -> None:
    (frame,) = Framer().receive(FrameEncoder(255, 0).encode(attitude()))
    assert (frame.system_id, frame.component_id) == (255, 0)


def test_encoder_rejects_invalid_version() -> None:
    with pytest.raises(InvalidArgument, match="version = 3 must be 1 or 2"):
        FrameEncoder(1, 1, version=3)
    encoder = FrameEncoder(1, 1)
    with pytest.raises(InvalidArgument, match="version = 0 must be 1 or 2"):
        encoder.version = 0
    assert encoder.version == 2


def test_encoder_version_may_change() -> None:
    encoder = FrameEncoder(1, 1)
    data = encoder.encode(attitude())
    encoder.version = 1
    data += encoder.encode(attitude())
    frames = Framer().receive(data)
    assert [(frame.version, frame.sequence) for frame in frames] == [(2, 0), (1, 1)]


def test_encoder_version_1_rejects_large_ids() -> None:
    encoder = FrameEncoder(1, 1, version=1)
    with pytest.raises(InvalidArgument, match="PLAY_TUNE has id 258, but MAVLink 1 has no ids above 255"):
        encoder.encode(messages.PlayTune(1, 1, "A"))
    assert encoder.sequence == 0


def test_encoder_sequence_wraps() -> None:
    encoder = FrameEncoder(1, 1)
    raws = [encoder.encode(messages.Heartbeat(6, 8, 0, 0, 4)) for _ in range(300)]
    assert [raw[4] for raw in raws] == [number % 256 for number in range(300)]
    framer = Framer()
    framer.receive(b"".join(raws))
    assert framer.statistics.sources[1, 1].lost == 0


def test_encoder_trims_trailing_zeros() -> None:
    encoder = FrameEncoder(1, 1)
    assert encoder.encode(messages.CommandAck(0, 0))[1] == 1
    assert encoder.encode(messages.CommandAck(400, 0))[1] == 2
    assert encoder.encode(messages.CommandAck(400, 0, target_component=7))[1] == 10


def test_python_checksum_matches_library() -> None:
    slow = x25_in_python()
    for size in (0, 1, 2, 9, 50, 280):
        data = bytes((number * 37 + size) & 0xFF for number in range(size))
        assert slow(data) == x25(data)
    assert slow(b"123456789") == 0x6F91  # the check value of CRC-16/MCRF4XX


@pytest.mark.parametrize("version", [1, 2])
def test_parsed_frame_has_checksum(version: int) -> None:
    raw = FrameEncoder(1, 1, version=version).encode(attitude())
    frame = Frame.parse(raw)
    assert frame.checksum == int.from_bytes(raw[-2:], "little")
    assert frame.raw == raw
