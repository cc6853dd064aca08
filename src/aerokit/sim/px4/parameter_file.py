"""``@PARAM/param.pck`` as PX4 has it since August 2026: sizes are exact, and what is written has to come in order."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

from aerokit.errors import RemoteProtocolError
from aerokit.parameters.pack import HEADER, MAGIC, read_entry, read_header
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.sim.file_tree import EINVAL, FileFault, OpenFile
from aerokit.sim.parameter_pack_file import ParameterPackMount

if TYPE_CHECKING:
    from aerokit.sim.parameters import Parameters

__all__ = ["Px4ParameterMount"]


class Px4ParameterMount(ParameterPackMount):
    """As ArduPilot's, but: an open tells the exact size, neither a value nor its default lies across two blocks of
    239 bytes, and what is uploaded takes effect parameter by parameter.
    """

    def __init__(self, parameters: Parameters, apply: Callable[[str, float], None]) -> None:
        super().__init__(parameters, apply, block=DATA_SIZE)

    def open(self, path: str, *, writing: bool) -> OpenFile:
        """Read or write."""
        reader = super().open(path, writing=False)
        return _Writer(self._parameters, self._apply) if writing else reader


class _Writer(OpenFile):
    """Bytes that came before are acknowledged again; a gap spoils the upload. The end is refused when it was not whole:
    the parameters before stay changed.
    """

    def __init__(self, parameters: Parameters, apply: Callable[[str, float], None]) -> None:
        self._parameters = parameters
        self._apply = apply
        self._pending = b""
        self._written = 0
        self._header: tuple[int, int] | None = None
        self._count = 0
        self._last = b""
        self._is_spoilt = False

    def read(self, offset: int, size: int) -> bytes:
        raise FileFault(EINVAL)

    def write(self, offset: int, data: bytes) -> None:
        new = data[max(0, self._written - offset) :]
        self._is_spoilt = self._is_spoilt or offset > self._written
        if self._is_spoilt:
            raise FileFault(EINVAL)
        self._pending += new
        self._written += len(new)
        self._take()
        if self._header is not None and self._written > self._header[1]:
            self._spoil()

    def close(self) -> None:
        if self._is_spoilt or self._pending or self._header != (self._count, self._written):
            raise FileFault(EINVAL)

    def _spoil(self) -> NoReturn:
        self._is_spoilt = True
        raise FileFault(EINVAL)

    def _take(self) -> None:
        """Apply all that has come as a whole."""
        if self._header is None:
            if len(self._pending) < HEADER.size:
                return
            magic, count, size = read_header(self._pending)
            if magic != MAGIC or size < HEADER.size:
                self._spoil()
            self._header, self._pending = (count, size), self._pending[HEADER.size :]
        while self._take_one():
            pass

    def _take_one(self) -> bool:
        pending = self._pending = self._pending.lstrip(b"\0")
        try:
            entry = read_entry(pending, 0, self._last) if pending else None
        except RemoteProtocolError:
            self._spoil()
        if entry is None:
            return False
        if entry.default is not None:
            self._spoil()
        name = entry.name.decode("ascii", "replace")
        if name in self._parameters:
            self._apply(name, entry.value)
        self._pending, self._last, self._count = pending[entry.end :], entry.name, self._count + 1
        return True
