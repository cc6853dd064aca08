"""Mission messages with the extension fields that PX4 fills in and the generated classes do not have yet.

They are appended to the payload, where a client that does not know them passes over them.
"""

from __future__ import annotations

import struct

from aerokit.mavlink import messages as m

__all__ = ["AckWithId", "CountWithId", "CurrentWithIds"]


class AckWithId(m.MissionAck):
    """MISSION_ACK with ``opaque_id``, which names the list that is now in the vehicle."""

    __slots__ = ("_ids",)
    _ids: bytes

    def __init__(self, to: tuple[int, int], type_: int, mission_type: int, opaque_id: int) -> None:
        super().__init__(*to, type_, mission_type)
        object.__setattr__(self, "_ids", struct.pack("<I", opaque_id))

    def encode(self) -> bytes:
        """With the id behind the other fields."""
        return super().encode() + self._ids


class CountWithId(m.MissionCount):
    """MISSION_COUNT with ``opaque_id``."""

    __slots__ = ("_ids",)
    _ids: bytes

    def __init__(self, to: tuple[int, int], count: int, mission_type: int, opaque_id: int) -> None:
        super().__init__(*to, count, mission_type)
        object.__setattr__(self, "_ids", struct.pack("<I", opaque_id))

    def encode(self) -> bytes:
        """With the id behind the other fields."""
        return super().encode() + self._ids


class CurrentWithIds(m.MissionCurrent):
    """MISSION_CURRENT with the ids of mission, fence and rally points."""

    __slots__ = ("_ids",)
    _ids: bytes

    def __init__(self, seq: int, total: int, state: int, mode: int, ids: tuple[int, int, int]) -> None:
        super().__init__(seq, total, state, mode)
        object.__setattr__(self, "_ids", struct.pack("<III", *ids))

    def encode(self) -> bytes:
        """With the ids behind the other fields."""
        return super().encode() + self._ids
