"""``@PARAM/param.pck``: all parameters as one file that is packed when it is read and applied when it was written.

The layout is in `parameters.pack`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.parameters.pack import HEADER, MAGIC, pack_served, read_entry, read_header
from aerokit.sim.file_tree import EINVAL, ENOENT, FileFault, Mount, OpenFile

if TYPE_CHECKING:
    from aerokit.sim.parameters import Parameters

__all__ = ["ParameterPackMount"]

_NAME = "param.pck"
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
            self._content = self._packed()
        return self._content

    def _packed(self) -> bytes:
        try:
            return pack_served(
                (self._parameters.row(name).as_parameter() for name in self._parameters.names),
                start=self._start,
                count=self._count,
                with_defaults=bool(self._with_defaults),
                block_size=self._block,
                whole_defaults=self._whole_defaults,
            )
        except InvalidArgument:
            raise FileFault(EINVAL) from None

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
        if offset == 0:
            with suppress(RemoteProtocolError):
                magic, _, length = read_header(data)
                content.extend(bytes(max(0, length - len(content)) if magic == MAGIC else 0))
        content.extend(bytes(max(0, offset + len(data) - len(content))))
        content[offset : offset + len(data)] = data

    def close(self) -> None:
        content = bytes(self._content)
        try:
            magic, count, length = read_header(content)
            if magic != MAGIC or length != len(content):
                raise FileFault(EINVAL)
            self._read_rows(content, count)
        except RemoteProtocolError:
            raise FileFault(EINVAL) from None

    def _read_rows(self, content: bytes, count: int) -> None:
        position, last = HEADER.size, b""
        for _ in range(count):
            entry = read_entry(content, position, last) if position < len(content) else None
            if entry is None or entry.default is not None:
                raise FileFault(EINVAL)
            name = entry.name.decode("ascii", "replace")
            if name in self._parameters:
                self._apply(name, entry.value)
            position, last = entry.end, entry.name


def _query(path: str) -> dict[str, int]:
    """The arguments behind the question mark; FileFault when it is not that file."""
    name, _, query = path.partition("?")
    if name != _NAME:
        raise FileFault(ENOENT)
    pairs = (part.partition("=") for part in query.split("&"))
    return {key: int(value) for key, _, value in pairs if value.isdecimal()}
