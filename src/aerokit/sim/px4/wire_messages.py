"""Messages that PX4 sends and the generated set does not have; a client without them passes over them.

They are written only: whoever wants to read them loads the dialect's XML (`Dialect.from_xml`).
https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, ClassVar

from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "ComponentInformation",
    "ComponentMetadata",
    "CurrentEventSequence",
    "Event",
    "LinkNodeStatus",
    "ProtocolVersion",
    "TimeEstimateToTarget",
]


class _Written(Message):
    """Made by `of` from its values in the order of the wire."""

    _payload: bytes
    _LAYOUT: ClassVar[struct.Struct]

    def __init__(self, _payload: bytes) -> None:
        object.__setattr__(self, "_payload", _payload)
        object.__setattr__(self, "received_frame", None)

    @classmethod
    def of(cls, *values: Any) -> Self:
        """The message with these values."""
        return cls(cls._LAYOUT.pack(*values))

    def encode(self) -> bytes:
        """The payload, untrimmed."""
        return self._payload


class LinkNodeStatus(_Written):
    """LINK_NODE_STATUS: what was sent and heard on a link."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 8, "LINK_NODE_STATUS", 117, 36, 36
    _LAYOUT = struct.Struct("<QIIIIIHHHBB")


class ProtocolVersion(_Written):
    """PROTOCOL_VERSION: MAVLink 2.0, from 1.0 on."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 300, "PROTOCOL_VERSION", 217, 22, 22
    _LAYOUT = struct.Struct("<HHH8s8s")


class TimeEstimateToTarget(_Written):
    """TIME_ESTIMATE_TO_TARGET: seconds to a safe return, a landing, the next item, the end, what was commanded."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 380, "TIME_ESTIMATE_TO_TARGET", 232, 20, 20
    _LAYOUT = struct.Struct("<5i")


class ComponentInformation(_Written):
    """COMPONENT_INFORMATION: where a description of the component is, as it was called before COMPONENT_METADATA."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 395, "COMPONENT_INFORMATION", 0, 212, 212
    _LAYOUT = struct.Struct("<III100s100s")


class ComponentMetadata(_Written):
    """COMPONENT_METADATA: where a description of the component is."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 397, "COMPONENT_METADATA", 182, 108, 108
    _LAYOUT = struct.Struct("<II100s")


class Event(_Written):
    """EVENT: something happened; its text is in the description of the component."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 410, "EVENT", 160, 53, 53
    _LAYOUT = struct.Struct("<IIHBBB40s")


class CurrentEventSequence(_Written):
    """CURRENT_EVENT_SEQUENCE: the number of the latest event."""

    ID, NAME, CRC_EXTRA, LENGTH, BASE_LENGTH = 411, "CURRENT_EVENT_SEQUENCE", 106, 3, 3
    _LAYOUT = struct.Struct("<HB")
