"""Missions, fences and rally points of a simulated vehicle: what every kind of vehicle shares.

The protocol and what a vehicle makes of an item differ so much between autopilots that each has a server of its own
(`sim.ardupilot.mission_server`, `sim.px4.mission_server`). https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.mavlink.messages import MissionItemInt
from aerokit.missions import MissionItem
from aerokit.missions.pack import NO_CLEAR, pack_items, read_header, unpack_items
from aerokit.sim.file_tree import EINVAL, ENFILE, ENOENT, FileFault, Mount, OpenFile

INVALID_INDEX = 0xFFFF
"""No item, where a message wants a number."""

AnyItem = m.MissionItemInt | m.MissionItem
AnyRequest = m.MissionRequestInt | m.MissionRequest


class MissionStore(Protocol):
    """What other servers of the vehicle (files) need of its missions.

    ``mission_type`` is a MAV_MISSION_TYPE: 0 mission, 1 fence, 2 rally points.
    """

    @property
    def transfer_is_open(self) -> bool:
        """Whether somebody's upload or download is going on."""
        ...

    def items(self, mission_type: int) -> list[MissionItem]:
        """What the vehicle has, as it gives it back: ArduPilot's home, item 0, included."""
        ...

    def replace(
        self, mission_type: int, items: Sequence[MissionItem], *, start: int = 0, clear: bool = True
    ) -> int:
        """Store items at once, as a file does; the MAV_MISSION_RESULT."""
        ...


def float32(value: float) -> float:
    """As the wire and the vehicle's memory round it; infinity beyond the range."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def item_from(message: AnyItem) -> MissionItem:
    """The item in a MISSION_ITEM_INT, or in a MISSION_ITEM with ``x`` and ``y`` as they are there."""
    return MissionItem(
        message.command,
        message.frame,
        message.param1,
        message.param2,
        message.param3,
        message.param4,
        message.x,
        message.y,
        message.z,
        bool(message.autocontinue),
    )


def item_message_float(
    item: MissionItem,
    place: tuple[float, float],
    seq: int,
    to: tuple[int, int],
    mission_type: int,
    current: int = 0,
) -> m.MissionItem:
    """MISSION_ITEM for somebody; ``place`` is what goes into ``x`` and ``y``."""
    return m.MissionItem(
        *to,
        seq,
        item.frame,
        item.command,
        current,
        int(item.autocontinue),
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        *place,
        item.z,
        mission_type,
    )


_FILES = {
    "mission.dat": MavMissionType.MISSION,
    "fence.dat": MavMissionType.FENCE,
    "rally.dat": MavMissionType.RALLY,
}
_EMPTY = MissionItem(0, 0, autocontinue=False)
"""What is where nothing was written."""
_PLACEHOLDER_SIZE = 1 << 20


class MissionMount(Mount):
    """Mounted as ``@MISSION``; one upload at a time. An open tells one mebibyte, whatever there is."""

    def __init__(self, store: MissionStore) -> None:
        self._store = store
        self._writer: _Writer | None = None

    def size(self, path: str) -> int:
        _type_of(path)
        return _PLACEHOLDER_SIZE

    def open(self, path: str, *, writing: bool) -> OpenFile:
        """Read what the vehicle has, or write what it shall have."""
        type_ = _type_of(path)
        if not writing:
            return _Reader(_packed(self._store.items(type_), type_))
        if self._writer is not None and not self._writer.is_closed:
            raise FileFault(ENFILE)
        self._writer = _Writer(self._store, type_)
        return self._writer


class _Reader(OpenFile):
    def __init__(self, content: bytes) -> None:
        self._content = content

    def read(self, offset: int, size: int) -> bytes:
        return self._content[offset : offset + size]


class _Writer(OpenFile):
    """A file that is not whole, or that the vehicle does not like, has no effect, and nobody is told."""

    def __init__(self, store: MissionStore, type_: int) -> None:
        self.is_closed = False
        self._store = store
        self._type = type_
        self._content = bytearray()

    def read(self, offset: int, size: int) -> bytes:
        raise FileFault(EINVAL)

    def write(self, offset: int, data: bytes) -> None:
        content = self._content
        if offset == 0:
            with suppress(RemoteProtocolError):
                header = read_header(data)
                if header.items < INVALID_INDEX:
                    content.extend(bytes(max(0, header.length - len(content))))
        content.extend(bytes(max(0, offset + len(data) - len(content))))
        content[offset : offset + len(data)] = data

    def close(self) -> None:
        self.is_closed = True
        try:
            header = read_header(bytes(self._content))
            items = unpack_items(bytes(self._content[: header.length]))
        except (RemoteProtocolError, InvalidArgument):
            raise FileFault(EINVAL) from None
        if len(self._content) >= header.length + MissionItemInt.LENGTH or _EMPTY in items:
            raise FileFault(EINVAL)
        clear = not header.options & NO_CLEAR
        result = self._store.replace(self._type, items, start=header.first, clear=clear)
        if result != MavMissionResult.ACCEPTED:
            raise FileFault(EINVAL)


def _packed(items: list[MissionItem], type_: int) -> bytes:
    return pack_items([item.replace(x=int(item.x), y=int(item.y)) for item in items], type_)


def _type_of(path: str) -> int:
    if path not in _FILES:
        raise FileFault(ENOENT)
    return _FILES[path]
