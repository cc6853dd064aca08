"""``param.pck``: all parameters in one small file, which vehicles serve and take by MAVFTP.

ArduPilot since 4.1, PX4 since August 2026 (PR 28435), at ``@PARAM/param.pck``; ``?withdefaults=1`` asks for defaults,
``?start=50&count=10`` for a part. A read must use one block size to the end of the file, because values are padded so
that none lies across two blocks. Downloaded and uploaded files differ in their header: see :func:`pack_parameters`.

https://mavlink.io/en/services/parameter_ftp.html
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from struct import Struct

from aerokit.errors import LocalProtocolError, RemoteProtocolError
from aerokit.parameters.parameter import NAME_LENGTH, Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable

__all__ = [
    "PACK_PATH",
    "PACK_PATH_WITH_DEFAULTS",
    "pack_parameters",
    "pack_served",
    "unpack_parameters",
    "unpack_upload",
]

PACK_PATH = "@PARAM/param.pck"
"""Where vehicles serve and take the file."""
PACK_PATH_WITH_DEFAULTS = "@PARAM/param.pck?withdefaults=1"
"""The same for reading, with the defaults of those parameters that have been changed."""

_MAGIC, _MAGIC_WITH_DEFAULTS = 0x671B, 0x671C
_HAS_DEFAULT = 0x10
_HEADER = Struct("<HHH")
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


def unpack_parameters(data: bytes, *, start: int = 0) -> ParameterTable:
    """The table in a downloaded file; ``start`` is the index of its first parameter, as asked for in its path.

    With defaults asked for, every parameter has its default: the file leaves out those that equal the value. Raises
    :class:`RemoteProtocolError` when the file is damaged, or has another number of parameters than its header says
    (ArduPilot does that once when its list has just changed: download it again).
    """
    magic, count, total = _header(data)
    if magic not in (_MAGIC, _MAGIC_WITH_DEFAULTS) or count > total:
        raise RemoteProtocolError(f"this is no param.pck: its header is {magic:#06x}, {count} of {total}")
    found = list(_entries(data, magic == _MAGIC_WITH_DEFAULTS, start))
    return ParameterTable(_checked(found, count))


def unpack_upload(data: bytes) -> ParameterTable:
    """The parameters of a file made for upload, as a vehicle reads it; RemoteProtocolError when it would not."""
    magic, count, length = _header(data)
    if magic != _MAGIC or length != len(data):
        raise RemoteProtocolError(
            f"no upload: header {magic:#06x}, {length} bytes announced, {len(data)} here"
        )
    found = [p.replace(index=None) for p in _entries(data, False, 0)]
    if any(p.default is not None for p in found):
        raise RemoteProtocolError("an upload has no defaults")
    return ParameterTable(_checked(found, count))


def pack_parameters(parameters: Mapping[str, Parameter] | Iterable[Parameter]) -> bytes:
    """A file to be written to ``@PARAM/param.pck``, in the order given.

    The vehicle puts the parameters in when the file is closed, and skips unknown and read-only ones without a word, so
    read back what you wrote. The third number of its header is the length of the file, which thus ends at 65,535
    bytes: :class:`LocalProtocolError` beyond, and for names and values that do not fit (INT32 is the widest type).
    """
    rows = list(_rows(parameters))
    body = bytearray()
    last = b""
    for parameter in rows:
        name, entry = _entry(parameter, last, False)
        body += entry
        last = name
    length = _HEADER.size + len(body)
    if length > _LONGEST:
        raise LocalProtocolError(
            f"{len(rows)} parameters make {length} bytes, at most {_LONGEST} are possible"
        )
    return _HEADER.pack(_MAGIC, len(rows), length) + bytes(body)


def pack_served(
    parameters: Mapping[str, Parameter] | Iterable[Parameter],
    *,
    start: int = 0,
    count: int = 0,
    with_defaults: bool = False,
    block_size: int = 239,
) -> bytes:
    """The file that a vehicle with these parameters serves when it is read in blocks of that size.

    ``count`` 0 means all from ``start``. LocalProtocolError when ``start`` is beyond the list.
    """
    rows = list(_rows(parameters))
    if not 0 <= start < len(rows):
        raise LocalProtocolError(f"start = {start!r} must be in 0..{len(rows) - 1}")
    chosen = rows[start : start + count if count else None]
    file = bytearray(_HEADER.pack(_MAGIC_WITH_DEFAULTS if with_defaults else _MAGIC, len(chosen), len(rows)))
    last = b""
    for parameter in chosen:
        shows_default = with_defaults and bool(parameter.is_changed)
        name, entry = _entry(parameter, last, shows_default)
        data_size = _CODES[_CODE_OF[parameter.type]][1].size * (1 + shows_default)
        beyond = (len(file) + len(entry)) % block_size
        file += bytes(data_size - beyond if 0 < beyond < data_size else 0) + entry
        last = name
    return bytes(file)


# --------------------------------------------------------------------------------------- reading


def _header(data: bytes) -> tuple[int, int, int]:
    if len(data) < _HEADER.size:
        raise RemoteProtocolError(f"param.pck has {len(data)} bytes, its header alone has {_HEADER.size}")
    return _HEADER.unpack_from(data)


def _entries(data: bytes, with_defaults: bool, index: int) -> Iterator[Parameter]:
    position, last = _HEADER.size, b""
    try:
        while True:
            while data[position] == 0:  # padding; no entry begins with a zero
                position += 1
            parameter, last, position = _read_entry(data, position, last, with_defaults, index)
            yield parameter
            index += 1
    except IndexError:
        return


def _read_entry(
    data: bytes, position: int, last: bytes, with_defaults: bool, index: int
) -> tuple[Parameter, bytes, int]:
    code, flags = data[position] & 0x0F, data[position] & 0xF0
    lengths = data[position + 1 : position + 2] or _damaged(position, "ends within an entry")
    common, own = lengths[0] & 0x0F, (lengths[0] >> 4) + 1
    if code not in _CODES or flags & ~_HAS_DEFAULT:
        _damaged(position, f"type {code}, flags {flags >> 4}")
    if common > len(last) or common + own > NAME_LENGTH:
        _damaged(position, f"a name of {common} + {own} characters after {last!r}")
    kind, format_ = _CODES[code]
    start = position + 2 + own
    end = start + format_.size * (2 if flags else 1)
    if end > len(data):
        _damaged(position, "ends within an entry")
    name = last[:common] + data[position + 2 : start]
    value = format_.unpack_from(data, start)[0]
    default = (
        format_.unpack_from(data, start + format_.size)[0] if flags else value if with_defaults else None
    )
    return Parameter(_text(name, position), value, kind, default, index), name, end


def _text(name: bytes, position: int) -> str:
    if not all(0x20 < byte < 0x7F for byte in name):
        _damaged(position, f"the name {name!r}")
    return name.decode("ascii")


def _damaged(position: int, what: str) -> bytes:
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


def _entry(parameter: Parameter, last: bytes, with_default: bool) -> tuple[bytes, bytes]:
    name = check_name(parameter.name).encode("ascii")
    if parameter.type not in _CODE_OF:
        raise LocalProtocolError(
            f"{parameter.name} is an {parameter.type.name}, which param.pck cannot carry"
        )
    code = _CODE_OF[parameter.type]
    kind, format_ = _CODES[code]
    data = format_.pack(checked_value(parameter.name, parameter.value, kind))
    if with_default and parameter.default is not None:
        data += format_.pack(checked_value(parameter.name, parameter.default, kind))
    common = _common_length(name, last)
    first = bytes((code | (_HAS_DEFAULT if with_default else 0), common | (len(name) - common - 1) << 4))
    return name, first + name[common:] + data


def _common_length(name: bytes, last: bytes) -> int:
    """Characters shared with the name before; at least one is left, because an entry cannot have none of its own."""
    common = 0
    for one, other in zip(name[:-1], last):  # noqa: B905 - the shorter one ends it
        if one != other:
            break
        common += 1
    return common
