"""Frames as pymavlink's message objects, for listeners and for who reads ``vehicle._master``."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from pymavlink import mavutil

from aerokit.mavlink.to_pymavlink import to_pymavlink

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame

__all__ = ["message_of"]


def message_of(frame: Frame) -> Any:
    """The frame's message in the program's dialect, ``mavutil.mavlink``, if that is one of MAVLink 2; never raises.

    ``_timestamp`` is the time of this call.
    """
    return to_pymavlink(frame, dialect=mavutil.mavlink, timestamp=time.time())
