"""``@PARAM/param.pck``: all parameters as one file that is packed when it is read and applied when it was written.

The layout is that of ArduPilot's libraries/AP_Filesystem/README.md.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavParamType
from aerokit.sim.file_tree import EINVAL, ENOENT, FileFault, Mount, OpenFile

if TYPE_CHECKING:
    from aerokit.sim.parameters import ParameterRow, Parameters

__all__ = ["FORMATS", "HEADER", "MAGIC", "ParameterPackMount", "packed_parameters"]

_NAME = "param.pck"
MAGIC, _MAGIC_WITH_DEFAULTS = 0x671B, 0x671C
HEADER = struct.Struct("<HHH")
_TYPES = {MavParamType.INT8: 1, MavParamType.INT16: 2, MavParamType.INT32: 3, MavParamType.REAL32: 4}
FORMATS = {1: "<b", 2: "<h", 3: "<i", 4: "<f"}
_GUESSED_ROW_SIZE = 12


class ParameterPackMount(Mount):
    """Mounted as ``@PARAM``.

    ``apply(name, value)`` is called for what was uploaded. ``block`` fixes the size of the blocks that no value
    lies across, and lets an open tell the exact size (PX4); without it the first read decides (ArduPilot).
    """

    def __init__(
        self, parameters: Parameters, apply: Callable[[str, float], None], *, block: int | None = None
    ) -> None:
        self._parameters = parameters
        self._apply = apply
        self._block = block

    def size(self, path: str) -> int:
        """12 bytes for each parameter, whatever is asked for; the true one with a fixed block size."""
        if self._block is not None:
            return len(_Reader(self._parameters, path, self._block).content)
        _query(path)
        return len(self._parameters) * _GUESSED_ROW_SIZE

    def open(self, path: str, *, writing: bool) -> OpenFile:
        """Read all, or those of ``?start=&count=``, with defaults where ``?withdefaults=1``; or write."""
        if writing:
            _query(path)
            return _Writer(self._parameters, self._apply)
        return _Reader(self._parameters, path, self._block)


class _Reader(OpenFile):
    """All reads have to be of one size: so a value is never torn when blocks come from different moments."""

    def __init__(self, parameters: Parameters, path: str, block: int | None) -> None:
        query = _query(path)
        self._parameters = parameters
        self._start, self._count = query.get("start", 0), query.get("count", 0)
        self._with_defaults = query.get("withdefaults", 0)
        if self._with_defaults > 1 or max(self._start, self._count) >= 0xFFFF:
            raise FileFault(EINVAL)
        self._block = block or 0
        self._whole_defaults = block is not None
        self._content: bytes | None = None

    @property
    def content(self) -> bytes:
        """The whole file, as it is at the first look."""
        if self._content is None:
            parameters = self._parameters
            if len(parameters) <= self._start:
                raise FileFault(EINVAL)
            end = self._start + self._count if self._count else None
            rows = [parameters.row(name) for name in parameters.names[self._start : end]]
            self._content = packed_parameters(
                rows,
                len(parameters),
                self._block,
                with_defaults=bool(self._with_defaults),
                whole_defaults=self._whole_defaults,
            )
        return self._content

    def read(self, offset: int, size: int) -> bytes:
        if size == 0:
            return b""
        self._block = self._block or size
        if self._block != size:
            raise FileFault(EINVAL)
        return self.content[offset : offset + size]


class _Writer(OpenFile):
    """Everything takes effect at the end; a file that is not whole has no effect, and nobody is told."""

    def __init__(self, parameters: Parameters, apply: Callable[[str, float], None]) -> None:
        self._parameters = parameters
        self._apply = apply
        self._content = bytearray()

    def read(self, offset: int, size: int) -> bytes:
        raise FileFault(EINVAL)

    def write(self, offset: int, data: bytes) -> None:
        content = self._content
        if offset == 0 and len(data) >= HEADER.size:
            magic, _, total = HEADER.unpack_from(data)
            if magic == MAGIC:
                content.extend(bytes(max(0, total - len(content))))
        content.extend(bytes(max(0, offset + len(data) - len(content))))
        content[offset : offset + len(data)] = data

    def close(self) -> None:
        content = bytes(self._content)
        if len(content) < HEADER.size:
            raise FileFault(EINVAL)
        magic, count, total = HEADER.unpack_from(content)
        if magic != MAGIC or total != len(content):
            raise FileFault(EINVAL)
        try:
            self._read_rows(content, count)
        except (struct.error, IndexError, UnicodeDecodeError):
            raise FileFault(EINVAL) from None

    def _read_rows(self, content: bytes, count: int) -> None:
        position, last = HEADER.size, b""
        for _ in range(count):
            kind, flags = content[position] & 0xF, content[position] >> 4
            common, length = content[position + 1] & 0xF, (content[position + 1] >> 4) + 1
            if flags or common + length > 16:
                raise FileFault(EINVAL)
            last = last[:common] + content[position + 2 : position + 2 + length]
            position += 2 + length
            format_ = FORMATS.get(kind, "<f")
            (value,) = struct.unpack_from(format_, content, position)
            position += struct.calcsize(format_)
            name = last.decode()
            if kind in FORMATS and name in self._parameters:
                self._apply(name, value)


def packed_parameters(
    rows: list[ParameterRow],
    total: int,
    block: int,
    *,
    with_defaults: bool = False,
    whole_defaults: bool = False,
) -> bytes:
    """The file: zeros are put in front of a parameter whose value would lie across two blocks of ``block`` bytes.

    With ``whole_defaults`` value and default together do not (PX4); else a default alone is looked at.
    """
    content = bytearray(HEADER.pack(_MAGIC_WITH_DEFAULTS if with_defaults else MAGIC, len(rows), total))
    last = b""
    for row in rows:
        packed, width, has_default = _packed_row(row, last, with_defaults=with_defaults)
        kept = 2 * width if has_default and whole_defaults else width
        over = (len(content) + len(packed)) % block
        if kept > 1 and 0 < over < kept:
            content.extend(bytes(kept - over))
        content.extend(packed)
        last = row.name.encode()
    return bytes(content)


def _packed_row(row: ParameterRow, last: bytes, *, with_defaults: bool) -> tuple[bytes, int, bool]:
    """The bytes, how many of them the value has, and whether a default follows it."""
    name, kind = row.name.encode(), _TYPES[MavParamType(row.type)]
    common = 0
    while common < len(name) - 1 and name[common : common + 1] == last[common : common + 1]:
        common += 1
    differs = with_defaults and row.default != row.value
    head = bytes([kind | differs << 4, common | (len(name) - common - 1) << 4]) + name[common:]
    value = _value(row.value, kind)
    return head + value + (_value(row.default, kind) if differs else b""), len(value), differs


def _value(value: float, kind: int) -> bytes:
    return struct.pack(FORMATS[kind], value if kind == _TYPES[MavParamType.REAL32] else int(value))


def _query(path: str) -> dict[str, int]:
    """The arguments behind the question mark; FileFault when it is not that file."""
    name, _, query = path.partition("?")
    if name != _NAME:
        raise FileFault(ENOENT)
    pairs = (part.partition("=") for part in query.split("&"))
    return {key: int(value) for key, _, value in pairs if value.isdecimal()}
