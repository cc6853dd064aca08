"""MAVLink on the wire: framing, messages, enums, dialects, signing and telemetry logs. Sans-IO, without clocks.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

from aerokit.mavlink import enums, messages
from aerokit.mavlink.dialect import STANDARD, Dialect
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Field, Message
from aerokit.mavlink.statistics import FramerStatistics, SourceStatistics
from aerokit.mavlink.tlog import TlogWriter, read_tlog

__all__ = [
    "STANDARD",
    "Dialect",
    "Field",
    "Frame",
    "FrameEncoder",
    "Framer",
    "FramerStatistics",
    "Message",
    "SourceStatistics",
    "TlogWriter",
    "enums",
    "messages",
    "read_tlog",
]
