"""A connection string that is none: an error by itself, because pyserial is imported for it."""

from __future__ import annotations

from serial import SerialException

from aerokit.errors import LocalProtocolError

__all__ = ["AddressError"]


class AddressError(SerialException, LocalProtocolError):  # type: ignore[misc]  # pyserial has no types
    """It names no link. DroneKit takes what it does not know for a serial port: an OSError; and it is a ValueError."""
