"""Conversion of pymavlink messages; tests/dronekit/test_dronekit_messages.py covers all messages."""

from __future__ import annotations

import copy
import math
import random
import subprocess
import sys
from decimal import Decimal
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v10 import ardupilotmega as version_1
from pymavlink.dialects.v20 import ardupilotmega, common, matrixpilot
from wire_samples import random_message

from aerokit.errors import InvalidArgument
from aerokit.mavlink import Frame, FrameEncoder, Message, messages
from aerokit.mavlink.pymavlink import from_pymavlink, to_pymavlink
from aerokit.mavlink.signing import Signing, SigningKey

ATTITUDE = Frame.parse(FrameEncoder(1, 1).encode(messages.Attitude(7, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0)))


def test_pymavlink_message_round_trip() -> None:
    theirs = to_pymavlink(ATTITUDE)
    assert isinstance(theirs, ardupilotmega.MAVLink_attitude_message)
    assert (theirs.get_srcSystem(), theirs.roll, theirs.get_msgbuf()) == (1, 0.5, bytearray(ATTITUDE.raw))
    assert from_pymavlink(theirs) == messages.Attitude(7, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0)


def test_to_pymavlink_timestamp_and_dialect() -> None:
    assert to_pymavlink(ATTITUDE)._timestamp == 0.0
    theirs = to_pymavlink(ATTITUDE, dialect=common, timestamp=12.5)
    assert theirs._timestamp == 12.5
    assert isinstance(theirs, common.MAVLink_attitude_message)


def test_from_pymavlink_error_names_field() -> None:
    with pytest.raises(InvalidArgument, match=r"COMMAND_LONG.command = 70000 .*0\.\.65535"):
        from_pymavlink(ardupilotmega.MAVLink_command_long_message(1, 1, 70000, 0, 0, 0, 0, 0, 0, 0, 0))


def test_pymavlink_is_imported_on_first_use() -> None:
    modules = "aerokit.mavlink.pymavlink, aerokit.mavlink.pymavlink"
    program = f"import sys, {modules}; print('pymavlink' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"


def test_unknown_message_is_verified_by_program_dialect() -> None:
    theirs = matrixpilot.MAVLink_serial_udb_extra_f21_message(1, 2, 3, 4, 5, 6)
    raw = bytearray(theirs.pack(matrixpilot.MAVLink(None, srcSystem=1, srcComponent=1)))
    assert to_pymavlink(Frame.parse(bytes(raw)), dialect=matrixpilot).get_type() == "SERIAL_UDB_EXTRA_F21"
    raw[-1] ^= 1
    assert to_pymavlink(Frame.parse(bytes(raw)), dialect=matrixpilot).get_type().startswith("UNKNOWN")


@pytest.mark.parametrize(
    "kind",
    [
        messages.BatteryStatus,
        messages.FileTransferProtocol,
        messages.ParamValue,
        messages.ParamExtValue,
        messages.Statustext,
        messages.GimbalDeviceAttitudeStatus,
        messages.Wind,
        messages.SystemTime,
    ],
)
def test_pymavlink_arrays_and_texts_round_trip(kind: type[Message]) -> None:
    """Arrays of numbers and bytes, texts, and messages without either keep all values; copies too."""
    for how in ("zeros", "extremes", "random"):
        message = random_message(kind, random.Random(7), how)
        frame = Frame.parse(FrameEncoder(1, 1).encode(message))
        theirs = to_pymavlink(frame)
        assert from_pymavlink(theirs).encode() == message.encode()
        whole: Any = ardupilotmega.MAVLink(None).parse_char(frame.raw)
        assert str(theirs) == str(whole)
        assert (theirs.get_payload(), theirs.get_crc()) == (whole.get_payload(), whole.get_crc())
        plain = copy.copy(theirs)
        assert (plain.get_msgbuf(), plain.get_seq()) == (whole.get_msgbuf(), whole.get_seq())
        assert not hasattr(plain, "_frame")


def test_pymavlink_payload_excludes_signature() -> None:
    encoder = FrameEncoder(1, 1)
    encoder.signing = Signing(SigningKey(bytes(range(32))))
    theirs = to_pymavlink(Frame.parse(encoder.encode(messages.Attitude(7, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0))))
    assert theirs.get_payload() == to_pymavlink(ATTITUDE).get_payload()


def test_pymavlink_missing_attribute_raises() -> None:
    with pytest.raises(AttributeError, match="'MAVLink_attitude_message' object has no attribute 'height'"):
        to_pymavlink(ATTITUDE).height  # noqa: B018


@pytest.mark.parametrize(("target", "expected"), [(9, 9), (0, 1), (None, 1)])
def test_from_pymavlink_sets_target_system(target: int | None, expected: int) -> None:
    theirs: Any = ardupilotmega.MAVLink_command_long_message(1, 2, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    copied: Any = from_pymavlink(theirs, target)
    assert (copied.target_system, copied.target_component, theirs.target_system) == (expected, 2, expected)
    ours = messages.CommandLong(1, 2, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    again: Any = from_pymavlink(ours, target)
    assert (again.target_system, ours.target_system) == (expected, 1)
    assert from_pymavlink(messages.SystemTime(1, 2), target) == messages.SystemTime(1, 2)
    plain: Any = ardupilotmega.MAVLink_system_time_message(1, 2)
    assert from_pymavlink(plain, target) == messages.SystemTime(1, 2)
    assert not hasattr(plain, "target_system")


def looks_like(name: str, **fields: Any) -> Any:
    return SimpleNamespace(get_type=lambda: name, **fields)


def test_from_pymavlink_accepts_any_object_with_fields() -> None:
    numbers = {
        "time_boot_ms": Decimal("6.6"),
        "roll": Decimal("0.5"),
        "pitch": True,
        "yaw": 3,
        "rollspeed": 0,
    }
    given = looks_like("ATTITUDE", **numbers, pitchspeed=0, yawspeed=0)
    assert from_pymavlink(given) == messages.Attitude(7, 0.5, 1.0, 3.0, 0.0, 0.0, 0.0)
    text = looks_like("STATUSTEXT", severity=3, text=b"ab\xff\0\0", id=7)
    assert from_pymavlink(text).encode()[1:6] == b"ab\xff\0\0"
    assert from_pymavlink(text).encode()[51:53] == b"\7\0"


def test_from_pymavlink_does_not_read_class_id() -> None:
    """Every pymavlink class has an attribute ``id``, and STATUSTEXT has an extension field of this name."""
    theirs = version_1.MAVLink_statustext_message(3, b"hello\0")
    assert from_pymavlink(theirs) == messages.Statustext(3, "hello")
    assert from_pymavlink(ardupilotmega.MAVLink_statustext_message(3, b"hello", 8, 1)) == messages.Statustext(
        3, "hello", 8, 1
    )


def test_from_pymavlink_reads_latest_text() -> None:
    theirs: Any = ardupilotmega.MAVLink_statustext_message(3, "gr\xfc\xdf".encode())
    assert from_pymavlink(theirs) == messages.Statustext(3, "gr\xfc\xdf")
    theirs.text = "changed\0"
    assert from_pymavlink(theirs) == messages.Statustext(3, "changed")


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (object(), "is not a MAVLink message"),
        (looks_like("ATTITUDE", time_boot_ms=1), "ATTITUDE cannot be sent: its field roll has no value"),
        (looks_like("PLAY_TUNE", target_system=1, target_component=1, tune=5), "PLAY_TUNE.tune = 5"),
        (
            looks_like("SYSTEM_TIME", time_unix_usec=math.nan, time_boot_ms=0),
            "SYSTEM_TIME.time_unix_usec = nan",
        ),
        (looks_like("SYSTEM_TIME", time_unix_usec="no", time_boot_ms=0), "SYSTEM_TIME.time_unix_usec = 'no'"),
        (
            looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data=[1, 256]),
            r"GPS_INJECT_DATA.data = \[1, 256\] cannot be sent: element 1 must be in 0..255",
        ),
        (
            looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data=[-1, 255]),
            r"element 0 must be in 0..255",
        ),
        (
            looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data=[0, 255, "x"]),
            r"element 2 must be in 0..255",
        ),
        (
            looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data=7),
            "GPS_INJECT_DATA.data = 7 cannot be sent: must be a sequence of at most 110 numbers",
        ),
        (
            looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data="ab"),
            "GPS_INJECT_DATA.data = 'ab' cannot be sent: must be a sequence",
        ),
        (ardupilotmega.MAVLink_unknown(60_000, b""), "MAVLink_unknown is not a message that can be sent"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_from_pymavlink_rejects_invalid_messages(given: Any, complaint: str) -> None:
    with pytest.raises(InvalidArgument, match=complaint):
        from_pymavlink(given)


@pytest.mark.parametrize("data", [[1, 2], b"\1\2", bytearray(b"\1\2"), memoryview(b"\1\2"), (1, Decimal(2))])
def test_from_pymavlink_accepts_bytes_in_any_form(data: Any) -> None:
    given = looks_like("GPS_INJECT_DATA", target_system=1, target_component=1, len=2, data=data)
    assert from_pymavlink(given) == messages.GpsInjectData(1, 1, 2, b"\1\2")


@pytest.mark.parametrize("value", [b"\0\x80\xff\0", "long text"])
def test_from_pymavlink_keeps_bytes_in_char_arrays(value: bytes | str) -> None:
    theirs: Any = ardupilotmega.MAVLink_param_ext_set_message(1, 100, b"CAM_EV", b"", 9)
    if isinstance(value, bytes):
        theirs = ardupilotmega.MAVLink_param_ext_set_message(1, 100, b"CAM_EV", value, 9)
    else:
        theirs.param_value = value
    ours: Any = from_pymavlink(theirs)
    wanted = value if isinstance(value, bytes) else value.encode()
    assert ours.encode() == messages.ParamExtSet(1, 100, "CAM_EV", wanted, 9).encode()
