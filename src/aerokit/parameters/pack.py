"""``param.pck``: all parameters in one small file, which vehicles serve and take by MAVFTP.

ArduPilot since 4.1, PX4 since August 2026 (PR 28435), at ``@PARAM/param.pck``; ``?withdefaults=1`` asks for defaults,
``?start=50&count=10`` for a part. A read must use one block size to the end of the file, because values are padded so
that none lies across two blocks. Downloaded and uploaded files differ in their header: see :func:`pack_parameters`.

https://mavlink.io/en/services/parameter_ftp.html
"""

from __future__ import annotations

import zlib
from collections.abc import Container, Iterable, Iterator, Mapping
from struct import Struct
from typing import NamedTuple, NoReturn

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.parameters.encoding import to_bits
from aerokit.parameters.parameter import NAME_LENGTH, Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable

PACK_PATH = "@PARAM/param.pck"
"""Where vehicles serve and take the file."""

PACK_PATH_WITH_DEFAULTS = "@PARAM/param.pck?withdefaults=1"
"""The same for reading, with the defaults of those parameters that have been changed."""

MAGIC, _MAGIC_WITH_DEFAULTS = 0x671B, 0x671C

HEADER = Struct("<HHH")

_HAS_DEFAULT = 0x10

_LONGEST = 0xFFFF

# The file has codes of its own, those of ArduPilot's variables, not of MAV_PARAM_TYPE.
_CODES = {
    1: (ParameterType.INT8, Struct("<b")),
    2: (ParameterType.INT16, Struct("<h")),
    3: (ParameterType.INT32, Struct("<i")),
    4: (ParameterType.REAL32, Struct("<f")),
}

_CODE_OF = {
    ParameterType.INT8: 1,
    ParameterType.UINT8: 2,
    ParameterType.INT16: 2,
    ParameterType.UINT16: 3,
    ParameterType.INT32: 3,
    ParameterType.UINT32: 3,
    ParameterType.REAL32: 4,
}


class PackHeader(NamedTuple):
    """The first six bytes; ``total`` is the number of the vehicle's parameters, in an upload the length in bytes."""

    magic: int
    parameters: int
    total: int


class PackEntry(NamedTuple):
    """One parameter as the file has it; ``default`` is None where it is not there."""

    name: bytes
    type: ParameterType
    value: int | float
    default: int | float | None
    end: int


def unpack_parameters(data: bytes, *, start: int = 0) -> ParameterTable:
    """The table in a downloaded file; ``start`` is the index of its first parameter, as asked for in its path.

    With defaults asked for, every parameter has its default: the file leaves out those that equal the value. Raises
    :class:`RemoteProtocolError` when the file is damaged, or has another number of parameters than its header says
    (ArduPilot does that once when its list has just changed: download it again).
    """
    magic, count, total = read_header(data)
    if magic not in (MAGIC, _MAGIC_WITH_DEFAULTS) or count > total:
        raise RemoteProtocolError(f"this is no param.pck: its header is {magic:#06x}, {count} of {total}")
    found = list(_parameters(data, magic == _MAGIC_WITH_DEFAULTS, start))
    return ParameterTable(_checked(found, count))


def pack_parameters(parameters: Mapping[str, Parameter] | Iterable[Parameter]) -> bytes:
    """A file to be written to ``@PARAM/param.pck``, in the order given.

    The vehicle puts the parameters in when the file is closed, and skips unknown and read-only ones without a word, so
    read back what you wrote. The third number of its header is the length of the file, which thus ends at 65,535
    bytes: :class:`InvalidArgument` beyond, and for names and values that do not fit (INT32 is the widest type).
    """
    rows = list(_rows(parameters))
    body = bytearray()
    last = b""
    for parameter in rows:
        name, code = check_name(parameter.name).encode("ascii"), _code_of(parameter)
        body += _entry(name, last, code, checked_value(parameter.name, parameter.value, _CODES[code][0]))
        last = name
    length = HEADER.size + len(body)
    if length > _LONGEST:
        raise InvalidArgument(f"{len(rows)} parameters make {length} bytes, at most {_LONGEST} are possible")
    return HEADER.pack(MAGIC, len(rows), length) + bytes(body)


def pack_served(
    parameters: Mapping[str, Parameter] | Iterable[Parameter],
    *,
    start: int = 0,
    count: int = 0,
    with_defaults: bool = False,
    block_size: int = 239,
    whole_defaults: bool = True,
) -> bytes:
    """The file that a vehicle with these parameters serves when it is read in blocks of that size; nothing is checked.

    ``count`` 0 means all from ``start``. A value and its default lie in one block (PX4), or, without
    ``whole_defaults``, the default alone (ArduPilot). InvalidArgument when ``start`` is beyond the list.
    """
    rows = list(_rows(parameters))
    if not 0 <= start < len(rows):
        raise InvalidArgument(f"start = {start!r} must be in 0..{len(rows) - 1}")
    chosen = rows[start : start + count if count else None]
    file = bytearray(HEADER.pack(_MAGIC_WITH_DEFAULTS if with_defaults else MAGIC, len(chosen), len(rows)))
    last = b""
    for parameter in chosen:
        values = [parameter.value]
        if with_defaults and parameter.is_changed and parameter.default is not None:
            values.append(parameter.default)
        name, code = parameter.name.encode(), _code_of(parameter)
        entry = _entry(name, last, code, *values)
        kept = _CODES[code][1].size * (len(values) if whole_defaults else 1)
        beyond = (len(file) + len(entry)) % block_size
        file += bytes(kept - beyond if 0 < beyond < kept else 0) + entry
        last = name
    return bytes(file)


# --------------------------------------------------------------------------------------- reading
def read_header(data: bytes) -> PackHeader:
    """The header of any file; RemoteProtocolError when it is shorter than that."""
    if len(data) < HEADER.size:
        raise RemoteProtocolError(f"param.pck has {len(data)} bytes, its header alone has {HEADER.size}")
    return PackHeader(*HEADER.unpack_from(data))


def read_entry(data: bytes, position: int, last: bytes) -> PackEntry | None:
    """The entry at a position, behind the padding; ``last`` is the name before. None when the data end within it.

    RemoteProtocolError when there is none: a type or flags that do not exist, a name that is too long.
    """
    code, flags = data[position] & 0x0F, data[position] & 0xF0
    if code not in _CODES or flags & ~_HAS_DEFAULT:
        _damaged(position, f"type {code}, flags {flags >> 4}")
    if position + 1 == len(data):
        return None
    common, own = data[position + 1] & 0x0F, (data[position + 1] >> 4) + 1
    if common > len(last) or common + own > NAME_LENGTH:
        _damaged(position, f"a name of {common} + {own} characters after {last!r}")
    kind, format_ = _CODES[code]
    start = position + 2 + own
    end = start + format_.size * (2 if flags else 1)
    if end > len(data):
        return None
    value = format_.unpack_from(data, start)[0]
    default = format_.unpack_from(data, start + format_.size)[0] if flags else None
    return PackEntry(last[:common] + data[position + 2 : start], kind, value, default, end)


def _parameters(data: bytes, with_defaults: bool, index: int) -> Iterator[Parameter]:
    position, last = HEADER.size, b""
    while (position := _behind_padding(data, position)) < len(data):
        entry = read_entry(data, position, last)
        if entry is None:
            _damaged(position, "ends within an entry")
        default = entry.value if entry.default is None and with_defaults else entry.default
        yield Parameter(_text(entry.name, position), entry.value, entry.type, default, index)
        position, last, index = entry.end, entry.name, index + 1


def _behind_padding(data: bytes, position: int) -> int:
    """No entry begins with a zero."""
    while position < len(data) and data[position] == 0:
        position += 1
    return position


def _text(name: bytes, position: int) -> str:
    if not all(0x20 < byte < 0x7F for byte in name):
        _damaged(position, f"the name {name!r}")
    return name.decode("ascii")


def _damaged(position: int, what: str) -> NoReturn:
    raise RemoteProtocolError(f"param.pck is damaged at byte {position}: {what}")


def _checked(found: list[Parameter], count: int) -> list[Parameter]:
    if len(found) != count:
        raise RemoteProtocolError(f"param.pck has {len(found)} parameters, its header says {count}")
    if len({parameter.name for parameter in found}) != count:
        raise RemoteProtocolError("param.pck has a name twice")
    return found


# --------------------------------------------------------------------------------------- writing
def _rows(parameters: Mapping[str, Parameter] | Iterable[Parameter]) -> Iterator[Parameter]:
    return iter(parameters.values() if isinstance(parameters, Mapping) else parameters)


def _code_of(parameter: Parameter) -> int:
    if parameter.type not in _CODE_OF:
        raise InvalidArgument(f"{parameter.name} is an {parameter.type.name}, which param.pck cannot carry")
    return _CODE_OF[parameter.type]


def _entry(name: bytes, last: bytes, code: int, *values: float) -> bytes:
    common, pack = _common_length(name, last), _CODES[code][1].pack
    first = (code | (_HAS_DEFAULT if len(values) > 1 else 0), common | (len(name) - common - 1) << 4)
    return bytes(first) + name[common:] + b"".join(map(pack, values))


def _common_length(name: bytes, last: bytes) -> int:
    """Characters shared with the name before; at least one is left, because an entry cannot have none of its own."""
    common = 0
    for one, other in zip(name[:-1], last):  # noqa: B905 - the shorter one ends it
        if one != other:
            break
        common += 1
    return common


HASH_NAME = "_HASH_CHECK"
"""The name under which PX4 gives it, as a UINT32 with index 65535; asking for it by name costs one message."""

_ALL_ONES = 0xFFFFFFFF


def px4_hash(table: ParameterTable, volatile: Container[str] = ()) -> int:
    """What ``_HASH_CHECK`` would be for this table, sorted by name as PX4 has it.

    CRC-32 (without the usual inversions) over each name and the four bytes of its value. PX4 leaves out *volatile*
    parameters, those that it changes by itself; ``volatile`` are their names
    (:attr:`ParameterMetadata.volatile <aerokit.parameters.ParameterMetadata>`). Without them the result differs, so a
    cache keeps the vehicle's own number beside its table.
    """
    counted = (table[name] for name in sorted(table) if name not in volatile)
    data = b"".join(p.name.encode() + to_bits(p.value, p.type, bytewise=True) for p in counted)
    return zlib.crc32(data, _ALL_ONES) ^ _ALL_ONES
