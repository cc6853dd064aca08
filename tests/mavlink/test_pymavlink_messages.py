"""Messages of pymavlink as ours, and back; tests/dronekit/test_dronekit_messages.py goes through all of them."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pymavlink.dialects.v20 import ardupilotmega, common, matrixpilot

from aerokit.errors import LocalProtocolError
from aerokit.mavlink import Frame, FrameEncoder, messages
from aerokit.mavlink.from_pymavlink import from_pymavlink
from aerokit.mavlink.to_pymavlink import to_pymavlink

ATTITUDE = Frame.parse(FrameEncoder(1, 1).encode(messages.Attitude(7, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0)))


def test_there_and_back() -> None:
    theirs = to_pymavlink(ATTITUDE)
    assert isinstance(theirs, ardupilotmega.MAVLink_attitude_message)
    assert (theirs.get_srcSystem(), theirs.roll, theirs.get_msgbuf()) == (1, 0.5, bytearray(ATTITUDE.raw))
    assert from_pymavlink(theirs) == messages.Attitude(7, 0.5, 0.25, 1.0, 0.0, 0.0, 0.0)


def test_its_time_and_dialect_are_the_programs() -> None:
    assert to_pymavlink(ATTITUDE)._timestamp == 0.0
    theirs = to_pymavlink(ATTITUDE, dialect=common, timestamp=12.5)
    assert theirs._timestamp == 12.5
    assert isinstance(theirs, common.MAVLink_attitude_message)


def test_what_is_wrong_is_named() -> None:
    with pytest.raises(LocalProtocolError, match=r"COMMAND_LONG.command = 70000 .*0\.\.65535"):
        from_pymavlink(ardupilotmega.MAVLink_command_long_message(1, 1, 70000, 0, 0, 0, 0, 0, 0, 0, 0))


def test_pymavlink_is_imported_when_it_is_used() -> None:
    modules = "aerokit.mavlink.to_pymavlink, aerokit.mavlink.from_pymavlink"
    program = f"import sys, {modules}; print('pymavlink' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"


def test_what_the_standard_has_not_is_checked_by_the_programs_dialect() -> None:
    theirs = matrixpilot.MAVLink_serial_udb_extra_f21_message(1, 2, 3, 4, 5, 6)
    raw = bytearray(theirs.pack(matrixpilot.MAVLink(None, srcSystem=1, srcComponent=1)))
    assert to_pymavlink(Frame.parse(bytes(raw)), dialect=matrixpilot).get_type() == "SERIAL_UDB_EXTRA_F21"
    raw[-1] ^= 1
    assert to_pymavlink(Frame.parse(bytes(raw)), dialect=matrixpilot).get_type().startswith("UNKNOWN")
