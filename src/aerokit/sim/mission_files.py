"""``@MISSION/mission.dat``, ``fence.dat`` and ``rally.dat``: missions as files, applied when they were written.

The layout is that of ArduPilot's libraries/AP_Filesystem/README.md: ten bytes, then MISSION_ITEM_INTs.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from aerokit.errors import LocalProtocolError
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.mavlink.messages import MissionItemInt
from aerokit.sim.file_tree import EINVAL, ENFILE, ENOENT, FileFault, Mount, OpenFile
from aerokit.sim.missions import item_from

if TYPE_CHECKING:
    from aerokit.missions import MissionItem
    from aerokit.sim.missions import MissionStore

__all__ = ["MissionMount"]

_FILES = {
    "mission.dat": MavMissionType.MISSION,
    "fence.dat": MavMissionType.FENCE,
    "rally.dat": MavMissionType.RALLY,
}
_MAGIC = 0x763D
_HEADER = struct.Struct("<HHHHH")
_NO_CLEAR = 1
_PLACEHOLDER_SIZE = 1 << 20


class MissionMount(Mount):
    """Mounted as ``@MISSION``; one upload at a time. An open tells one mebibyte, whatever there is."""

    def __init__(self, store: MissionStore) -> None:
        self._store = store
        self._writer: _Writer | None = None

    def size(self, path: str) -> int:
        """A placeholder."""
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
        if offset == 0 and len(data) >= _HEADER.size:
            count = _HEADER.unpack_from(data)[4]
            whole = _HEADER.size + count * MissionItemInt.LENGTH
            if count < 0xFFFF:
                content.extend(bytes(max(0, whole - len(content))))
        content.extend(bytes(max(0, offset + len(data) - len(content))))
        content[offset : offset + len(data)] = data

    def close(self) -> None:
        self.is_closed = True
        content, step = bytes(self._content), MissionItemInt.LENGTH
        if len(content) < _HEADER.size:
            raise FileFault(EINVAL)
        magic, _, options, start, count = _HEADER.unpack_from(content)
        pieces = [content[at : at + step] for at in range(_HEADER.size, len(content) - step + 1, step)]
        if magic != _MAGIC or count != len(pieces) or not all(any(piece) for piece in pieces):
            raise FileFault(EINVAL)
        items = _unpacked(pieces)
        clear = not options & _NO_CLEAR
        if self._store.replace(self._type, items, start=start, clear=clear) != MavMissionResult.ACCEPTED:
            raise FileFault(EINVAL)


def _packed(items: list[MissionItem], type_: int) -> bytes:
    content = bytearray(_HEADER.pack(_MAGIC, type_, 0, 0, len(items)))
    for seq, item in enumerate(items):
        params = (item.param1, item.param2, item.param3, item.param4)
        place = (int(item.x), int(item.y), item.z)
        head = (0, 0, seq, item.frame, item.command, 0, int(item.autocontinue))
        content.extend(MissionItemInt(*head, *params, *place, type_).encode())
    return bytes(content)


def _unpacked(pieces: list[bytes]) -> list[MissionItem]:
    try:
        return [item_from(MissionItemInt.decode(piece)) for piece in pieces]
    except LocalProtocolError:  # no value of ours, such as one of a command 0
        raise FileFault(EINVAL) from None


def _type_of(path: str) -> int:
    if path not in _FILES:
        raise FileFault(ENOENT)
    return _FILES[path]
