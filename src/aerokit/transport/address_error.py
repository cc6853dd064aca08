"""``AddressError``: a connection string that is none, for programs that expect pyserial's error."""

from __future__ import annotations

from serial import SerialException

from aerokit.errors import InvalidArgument


class AddressError(SerialException, InvalidArgument):  # type: ignore[misc]  # pyserial has no types
    """It names no link. pymavlink takes it for a serial port, so it is an OSError; and it is a ValueError."""
