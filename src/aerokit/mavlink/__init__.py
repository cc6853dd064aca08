"""The wire: framing, messages and enums of MAVLink, dialects, telemetry logs; knows no clock and no socket.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

from aerokit.mavlink import enums, messages
from aerokit.mavlink.message import Field, Message

__all__ = ["Field", "Message", "enums", "messages"]
