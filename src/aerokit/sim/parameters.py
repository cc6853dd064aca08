"""Parameters of a simulated vehicle, and the ``@PARAM`` files that transfer them."""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.mavlink.enums import MavParamType
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.parameters.pack import HEADER, MAGIC, pack_for_download, read_entry, read_header
from aerokit.protocols.servers.files import EINVAL, ENOENT, FileFault, FileHandle, Mount, UploadedFile

_VOLATILE = "v"

_RANGES = {
    MavParamType.UINT8: (0, (1 << 8) - 1),
    MavParamType.INT8: (-(1 << 7), (1 << 7) - 1),
    MavParamType.UINT16: (0, (1 << 16) - 1),
    MavParamType.INT16: (-(1 << 15), (1 << 15) - 1),
    MavParamType.UINT32: (0, (1 << 32) - 1),
    MavParamType.INT32: (-(1 << 31), (1 << 31) - 1),
}


@dataclass
class SimParameter:
    """A parameter with its type and default."""

    name: str
    type: int
    """MAV_PARAM_TYPE."""
    value: float
    default: float
    is_volatile: bool = False
    """True if the parameter is excluded from PX4's hash, because the vehicle changes its value."""

    def as_parameter(self, index: int | None = None) -> Parameter:
        """Convert to the client's class. Values of integer types become int."""
        type_ = ParameterType(self.type)
        if type_.is_integer:
            return Parameter(self.name, int(self.value), type_, int(self.default), index)
        return Parameter(self.name, self.value, type_, self.default, index)


class SimParameters:
    """Parameters by name, in the vehicle's order. They survive a reboot.

    A value is stored in the type of the parameter: as a 32-bit float, or as an integer, which is truncated and limited
    to the range of the type.

    ``text`` has lines of ``name,type,value[,default[,switch]]``. The switch is the name of the parameter that enables
    this one, or ``v`` for a volatile parameter. While the enabling parameter is 0, ArduPilot omits this parameter from
    lists and counts, but answers reads by name. ``count`` is the number of parameters to list. The others can only be
    read and set by name.
    """

    def __init__(self, text: str, count: int | None = None) -> None:
        # `_unlisted` contains the names of the parameters that are not among the first `count`.
        lines, switches, self._unlisted = _lines_and_switches(text, count)
        self._rows: dict[str, SimParameter | str] = dict(lines)
        # Maps the name of a parameter to the name of the parameter that enables it.
        self._switches: dict[str, str] = dict(switches)
        self._names: tuple[str, ...] | None = None  # None if they must be computed at the next access
        self._indices: dict[str, int] = {}

    def __getitem__(self, name: str) -> float:
        try:
            return self._rows[name].value  # type: ignore[union-attr]
        except AttributeError:  # The row is a line of text that `row` has not parsed yet.
            return self.row(name).value

    def get(self, name: str, default: float) -> float:
        return self[name] if name in self else default  # noqa: SIM401 - this is `get`

    def __setitem__(self, name: str, value: float) -> None:
        row = self.row(name)
        row.value = stored_value(value, row.type)
        if name in self._switches.values():
            self._names = None  # Compute `names` again, because the switch may show or hide parameters.

    def change(self, values: Mapping[str, float]) -> None:
        """Set several parameters.

        Raises InvalidArgument if a name is unknown. No parameter is set then.
        """
        for name in values:
            if name not in self:
                similar = ", ".join(get_close_matches(name, self._rows)) or "none"
                raise InvalidArgument(f"the simulated vehicle has no parameter {name!r}; similar names: {similar}")
        for name, value in values.items():
            self[name] = value

    def __contains__(self, name: object) -> bool:
        return name in self._rows

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the listed (not hidden) parameters, in order. The position of a name is its ``param_index``."""
        if self._names is None:
            hidden = self._unlisted.union(name for name, switch in self._switches.items() if not self[switch])
            self._names = tuple(name for name in self._rows if name not in hidden)
            self._indices = {name: index for index, name in enumerate(self._names)}
        return self._names

    def index(self, name: str) -> int:
        """Return the position of a name in ``names``, or 65535 if it is hidden."""
        _ = self.names  # Reading the property updates `_indices`.
        return self._indices.get(name, UNKNOWN_INDEX)

    def type(self, name: str) -> int:
        return self.row(name).type

    def default(self, name: str) -> float:
        return self.row(name).default

    def row(self, name: str) -> SimParameter:
        """Return the parameter. The first access parses its line."""
        row = self._rows[name]
        if isinstance(row, str):
            row = self._rows[name] = _row(row.split(","))
        return row

    def add(self, name: str, value: float, type: int = MavParamType.REAL32) -> None:  # noqa: A002
        self._rows[name] = SimParameter(name, type, stored_value(value, type), stored_value(value, type))
        self._names = None

    def remove(self, name: str) -> None:
        del self._rows[name]
        self._switches.pop(name, None)
        self._names = None


def stored_value(value: float, type_: int) -> float:
    """Return the value that a parameter of this MAV_PARAM_TYPE stores."""
    integer_range = _RANGES.get(MavParamType(type_))
    if integer_range is None:
        return float(struct.unpack("<f", struct.pack("<f", value))[0]) if math.isfinite(value) else value
    low, high = integer_range
    return float(max(low, min(high, int(value))))


def _row(fields: list[str]) -> SimParameter:
    """Parse the columns of one line. The default and the last column may be missing."""
    name, type_text, value_text = fields[:3]
    type_, value = int(type_text), float(value_text)
    default = float(fields[3]) if len(fields) > 3 else value
    is_volatile = fields[4:] == [_VOLATILE]
    return SimParameter(name, type_, stored_value(value, type_), stored_value(default, type_), is_volatile)


def _switch_of(line: str) -> str | None:
    """Return the name of the enabling parameter (last column), or None without one."""
    if line.count(",") < 4 or line.endswith("," + _VOLATILE):
        return None
    return line.rpartition(",")[2]


@functools.lru_cache(maxsize=16)  # A test may create thousands of vehicles with the same table.
def _lines_and_switches(
    text: str, count: int | None
) -> tuple[dict[str, SimParameter | str], dict[str, str], frozenset[str]]:
    """Return the lines and their switches (see `SimParameters`), both by name, and the names that are not listed."""
    lines: dict[str, SimParameter | str] = {line.partition(",")[0]: line for line in text.split()}
    all_switches = {name: _switch_of(str(line)) for name, line in lines.items()}
    switches = {name: switch for name, switch in all_switches.items() if switch is not None}
    if count is None:
        return lines, switches, frozenset()
    # Parameters with a switch are never listed, so the returned switches are empty.
    listed = [name for name in lines if name not in switches][:count]
    return lines, {}, frozenset(lines).difference(listed)


_NAME = "param.pck"
_GUESSED_ROW_SIZE = 12


class ParameterPackMount(Mount):
    """Files mounted as ``@PARAM``.

    ``apply(name, value)`` is called for each uploaded parameter. A download is padded, so that no value extends over
    the end of a block. ``block`` is the fixed block size of PX4, which reports the exact size of a file when the file
    is opened. For ArduPilot, ``block`` is None, and the first read of the client sets the block size.
    """

    def __init__(
        self, parameters: SimParameters, apply: Callable[[str, float], None], *, block: int | None = None
    ) -> None:
        self._parameters = parameters
        self._apply = apply
        self._block = block

    def size(self, path: str) -> int:
        if self._block is not None:
            return len(_Reader(self._parameters, path, self._block).content)
        _query(path)
        return len(self._parameters) * _GUESSED_ROW_SIZE

    def open(self, path: str, *, writing: bool) -> FileHandle:
        if writing:
            _query(path)
            return _Writer(self._parameters, self._apply)
        return _Reader(self._parameters, path, self._block)


class _Reader(FileHandle):
    """Download of parameters. All reads must have the same size, because the file is padded to blocks of this size."""

    def __init__(self, parameters: SimParameters, path: str, block: int | None) -> None:
        query = _query(path)
        self._parameters = parameters
        self._start, self._count = query.get("start", 0), query.get("count", 0)
        self._with_defaults = query.get("withdefaults", 0)
        if self._with_defaults > 1 or max(self._start, self._count) >= 0xFFFF:
            raise FileFault(EINVAL)
        self._block = block or 0  # The block size; 0 means that the first read determines the size.
        is_px4 = block is not None
        self._keeps_default_in_block = is_px4  # PX4 keeps a value and its default in the same block.
        self._content: bytes | None = None  # the whole file; None before the first read

    @property
    def content(self) -> bytes:
        if self._content is None:
            self._content = self._packed()
        return self._content

    def _packed(self) -> bytes:
        try:
            return pack_for_download(
                (self._parameters.row(name).as_parameter() for name in self._parameters.names),
                start=self._start,
                count=self._count,
                with_defaults=bool(self._with_defaults),
                block_size=self._block,
                whole_defaults=self._keeps_default_in_block,
            )
        except InvalidArgument:
            raise FileFault(EINVAL) from None

    def read(self, offset: int, size: int) -> bytes:
        if size == 0:
            return b""
        if self._block == 0:
            self._block = size
        if self._block != size:
            raise FileFault(EINVAL)
        return self.content[offset : offset + size]


class _Writer(UploadedFile):
    """Upload of parameters, which are applied on close, up to the first invalid entry. No text reports the failure."""

    def __init__(self, parameters: SimParameters, apply: Callable[[str, float], None]) -> None:
        super().__init__()
        self._parameters = parameters
        self._apply = apply

    def announced_size(self, data: bytes) -> int:
        with suppress(RemoteProtocolError):
            magic, _, length = read_header(data)
            return length if magic == MAGIC else 0
        return 0

    def close(self) -> None:
        content = bytes(self.content)
        try:
            magic, count, length = read_header(content)
            if magic != MAGIC or length != len(content):
                raise FileFault(EINVAL)
            self._read_rows(content, count)
        except RemoteProtocolError:
            raise FileFault(EINVAL) from None

    def _read_rows(self, content: bytes, count: int) -> None:
        # An entry omits the first letters that its name shares with the previous name. `read_entry` adds them again.
        position, previous_name = HEADER.size, b""
        for _ in range(count):
            entry = read_entry(content, position, previous_name) if position < len(content) else None
            if entry is None or entry.default is not None:  # An upload must not contain default values.
                raise FileFault(EINVAL)
            name = entry.name.decode("ascii", "replace")
            if name in self._parameters:
                self._apply(name, entry.value)
            position, previous_name = entry.end, entry.name


def _query(path: str) -> dict[str, int]:
    """Parse the query string of a path. Raises FileFault for a file name other than param.pck."""
    name, _, query = path.partition("?")
    if name != _NAME:
        raise FileFault(ENOENT)
    pairs = (part.partition("=") for part in query.split("&"))
    return {key: int(value) for key, _, value in pairs if value.isdecimal()}
