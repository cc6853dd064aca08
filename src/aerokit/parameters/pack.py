"""``param.pck``: all parameters in one compact file, read and written by MAVFTP.

Vehicles serve it at ``@PARAM/param.pck``: ArduPilot since 4.1, PX4 since August 2026 (PR 28435). ``?withdefaults=1`` at
the end of the path requests defaults, ``?start=50&count=10`` requests a part of the file. Use a single block size for
the whole file: the file is padded so that no value crosses a block boundary. Downloaded and uploaded files have
different headers, see :func:`pack_parameters`.

https://mavlink.io/en/services/parameter_ftp.html
"""

from __future__ import annotations

import zlib
from collections.abc import Container, Iterable, Iterator, Mapping
from struct import Struct
from typing import NamedTuple

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.parameters.encoding import to_bits
from aerokit.parameters.parameter import NAME_LENGTH, Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable

PACK_PATH = "@PARAM/param.pck"
"""Path of the file on the vehicle, for reading and writing."""

PACK_PATH_WITH_DEFAULTS = "@PARAM/param.pck?withdefaults=1"
"""Path for reading the file with the defaults of changed parameters."""

MAGIC, _MAGIC_WITH_DEFAULTS = 0x671B, 0x671C

HEADER = Struct("<HHH")

_HAS_DEFAULT = 0x10

_MAX_SIZE = 0xFFFF

# The type codes in the file are those of ArduPilot's AP_Param, not MAV_PARAM_TYPE.
_STORED_TYPES = {1: ParameterType.INT8, 2: ParameterType.INT16, 3: ParameterType.INT32, 4: ParameterType.REAL32}

_FORMATS = {1: Struct("<b"), 2: Struct("<h"), 3: Struct("<i"), 4: Struct("<f")}

_CODE_BY_TYPE = {
    ParameterType.INT8: 1,
    ParameterType.UINT8: 2,
    ParameterType.INT16: 2,
    ParameterType.UINT16: 3,
    ParameterType.INT32: 3,
    ParameterType.UINT32: 3,
    ParameterType.REAL32: 4,
}


class PackHeader(NamedTuple):
    """Header of a ``param.pck`` file.

    ``total`` is the number of the vehicle's parameters in a downloaded file, and the file size in bytes in an upload.
    """

    magic: int
    parameters: int
    total: int


class PackEntry(NamedTuple):
    """One parameter in a ``param.pck`` file.

    ``default`` is None if the file does not include it; ``end`` is the position after the entry.
    """

    name: bytes
    type: ParameterType
    value: int | float
    default: int | float | None
    end: int


def unpack_parameters(data: bytes, *, start: int = 0) -> ParameterTable:
    """Decode a downloaded ``param.pck``. ``start`` is the index of its first parameter, as requested in the path.

    If defaults were requested, every returned parameter has a default, although the file omits defaults that equal the
    value.

    Raises:
        RemoteProtocolError: the file is damaged, or its number of parameters differs from that in its header. ArduPilot
            sends a wrong number once, after its list has changed; download the file again.
    """
    magic, count, total = read_header(data)  # `total` also counts the parameters before `start`.
    if magic not in (MAGIC, _MAGIC_WITH_DEFAULTS):
        expected = f"{MAGIC:#06x} or {_MAGIC_WITH_DEFAULTS:#06x}"
        raise RemoteProtocolError(f"the file is not a param.pck: it begins with {magic:#06x} instead of {expected}")
    if count > total:
        raise RemoteProtocolError(
            f"the param.pck is damaged: its header says that it has {count} of {total} parameters"
        )
    parameters = list(_parameters(data, start, with_defaults=magic == _MAGIC_WITH_DEFAULTS))
    if len(parameters) != count:
        raise RemoteProtocolError(f"param.pck has {len(parameters)} parameters, but its header says {count}")
    if len({parameter.name for parameter in parameters}) != count:
        raise RemoteProtocolError("param.pck contains the same name twice")
    return ParameterTable(parameters)


def pack_parameters(parameters: Mapping[str, Parameter] | Iterable[Parameter]) -> bytes:
    """Encode a file to write to ``@PARAM/param.pck``, in the given order.

    The vehicle applies the parameters when the file is closed. The vehicle silently skips unknown and read-only
    parameters, so read back the values that you have written.

    Raises:
        InvalidArgument: a name or value does not fit (INT32 is the widest type), or the file exceeds 65,535 bytes,
            the maximum in its header.
    """
    rows = list(_rows(parameters))
    body = bytearray()
    previous_name = b""
    for parameter in rows:
        name = check_name(parameter.name).encode("ascii")
        code = _code_of(parameter)
        value = checked_value(parameter.name, parameter.value, _STORED_TYPES[code])
        body += _encode_entry(name, previous_name, code, value)
        previous_name = name
    length = HEADER.size + len(body)
    if length > _MAX_SIZE:
        raise InvalidArgument(f"{len(rows)} parameters need {length} bytes; the file can hold {_MAX_SIZE} bytes")
    # In an upload, the last field of the header is the size of the file.
    return HEADER.pack(MAGIC, len(rows), length) + bytes(body)


def pack_for_download(
    parameters: Mapping[str, Parameter] | Iterable[Parameter],
    *,
    start: int = 0,
    count: int = 0,
    with_defaults: bool = False,
    block_size: int = 239,
    whole_defaults: bool = True,
) -> bytes:
    """Encode ``@PARAM/param.pck`` for these parameters, without validating their values.

    ``count`` 0 means all parameters from ``start`` on. ``block_size`` is the number of data bytes per read. With
    ``whole_defaults``, a value and its default are in the same block. InvalidArgument is raised if ``start`` is beyond
    the list.
    """
    rows = list(_rows(parameters))
    if not 0 <= start < len(rows):
        raise InvalidArgument(f"start = {start!r} must be in 0..{len(rows) - 1}")
    selected = rows[start : start + count if count else None]
    file = bytearray(HEADER.pack(_MAGIC_WITH_DEFAULTS if with_defaults else MAGIC, len(selected), len(rows)))
    previous_name = b""
    for parameter in selected:
        values = [parameter.value]
        if with_defaults and parameter.is_changed and parameter.default is not None:
            values.append(parameter.default)
        name, code = parameter.name.encode(), _code_of(parameter)
        entry = _encode_entry(name, previous_name, code, *values)
        # The last `unsplit_size` bytes of an entry must not be divided between two blocks: on PX4 the value and its
        # default, on ArduPilot (``whole_defaults=False``) only the last number (AP_Filesystem_Param.cpp).
        unsplit_size = _FORMATS[code].size * (len(values) if whole_defaults else 1)
        size_in_next_block = (len(file) + len(entry)) % block_size
        if 0 < size_in_next_block < unsplit_size:
            file += bytes(unsplit_size - size_in_next_block)  # These zeros move the value into the next block.
        file += entry
        previous_name = name
    return bytes(file)


# --------------------------------------------------------------------------------------- reading
def read_header(data: bytes) -> PackHeader:
    if len(data) < HEADER.size:
        raise RemoteProtocolError(f"param.pck has {len(data)} bytes, fewer than the {HEADER.size} of its header")
    return PackHeader(*HEADER.unpack_from(data))


def read_entry(data: bytes, position: int, previous_name: bytes) -> PackEntry | None:
    """Decode the entry at ``position``. Return None if the data ends inside the entry.

    ``previous_name`` is the name in the previous entry, empty for the first entry. Raises RemoteProtocolError if the
    data is not an entry.
    """
    code, flags = data[position] & 0x0F, data[position] & 0xF0
    has_default = bool(flags & _HAS_DEFAULT)
    if code not in _FORMATS or flags & ~_HAS_DEFAULT:
        raise _damaged(position, f"invalid type {code} or flags {flags >> 4}")
    if position + 1 == len(data):
        return None
    # The name begins with characters of the previous name, which the file does not repeat. 1 to 16 more follow.
    common_length = data[position + 1] & 0x0F
    own_length = (data[position + 1] >> 4) + 1
    if common_length > len(previous_name) or common_length + own_length > NAME_LENGTH:
        raise _damaged(position, f"invalid name length {common_length} + {own_length} after {previous_name!r}")
    format_ = _FORMATS[code]
    name_start = position + 2  # after the byte with the type and flags, and the byte with the lengths
    value_start = name_start + own_length
    end = value_start + format_.size * (2 if has_default else 1)
    if end > len(data):
        return None
    (value,) = format_.unpack_from(data, value_start)
    default = None
    if has_default:
        (default,) = format_.unpack_from(data, value_start + format_.size)
    name = previous_name[:common_length] + data[name_start:value_start]
    return PackEntry(name, _STORED_TYPES[code], value, default, end)


def _parameters(data: bytes, index: int, *, with_defaults: bool) -> Iterator[Parameter]:
    """Yield the parameters in a downloaded file. ``index`` is the index of the first one."""
    position = _skip_padding(data, HEADER.size)
    previous_name = b""
    while position < len(data):
        entry = read_entry(data, position, previous_name)
        if entry is None:
            raise _damaged(position, "it ends inside an entry")
        # A file with defaults omits each default that equals the value.
        default = entry.value if entry.default is None and with_defaults else entry.default
        yield Parameter(_text(entry.name, position), entry.value, entry.type, default, index)
        position = _skip_padding(data, entry.end)
        previous_name = entry.name
        index += 1


def _skip_padding(data: bytes, position: int) -> int:
    while position < len(data) and data[position] == 0:
        position += 1
    return position


def _text(name: bytes, position: int) -> str:
    if not all(0x20 < byte < 0x7F for byte in name):
        raise _damaged(position, f"invalid name {name!r}")
    return name.decode("ascii")


def _damaged(position: int, problem: str) -> RemoteProtocolError:
    return RemoteProtocolError(f"param.pck is damaged at byte {position}: {problem}")


# --------------------------------------------------------------------------------------- writing
def _rows(parameters: Mapping[str, Parameter] | Iterable[Parameter]) -> Iterator[Parameter]:
    return iter(parameters.values() if isinstance(parameters, Mapping) else parameters)


def _code_of(parameter: Parameter) -> int:
    if parameter.type not in _CODE_BY_TYPE:
        raise InvalidArgument(f"{parameter.name} has the type {parameter.type.name}, which param.pck cannot store")
    return _CODE_BY_TYPE[parameter.type]


def _encode_entry(name: bytes, previous_name: bytes, code: int, *values: float) -> bytes:
    common = _common_length(name, previous_name)
    type_and_flags = code | (_HAS_DEFAULT if len(values) > 1 else 0)
    # Four bits for the number of shared characters, and four for the number of own characters minus 1.
    lengths = common | (len(name) - common - 1) << 4
    return bytes((type_and_flags, lengths)) + name[common:] + b"".join(map(_FORMATS[code].pack, values))


def _common_length(name: bytes, previous_name: bytes) -> int:
    """Return the length of the prefix that a name shares with the previous name."""
    # The last character of the name is never shared, because the format requires at least one own character.
    common = 0
    for char, previous_char in zip(name[:-1], previous_name):  # noqa: B905 - the lengths may differ
        if char != previous_char:
            break
        common += 1
    return common


HASH_NAME = "_HASH_CHECK"
"""Name of PX4's hash over all parameters, a UINT32 with index 65535."""

_ALL_ONES = 0xFFFFFFFF


def px4_hash(table: ParameterTable, volatile: Container[str] = ()) -> int:
    """Compute the ``_HASH_CHECK`` that PX4 would report for this table.

    PX4 ignores volatile parameters. Pass their names as ``volatile`` (:attr:`ParameterMetadata.volatile
    <aerokit.parameters.ParameterMetadata>`). If these names are unknown, use the hash that the vehicle has reported.
    """
    # The hash is a CRC-32 without inversions over the name and the four value bytes of each parameter, sorted by name.
    data = bytearray()
    for name in sorted(table):
        if name not in volatile:
            data += name.encode() + to_bits(table[name].value, table[name].type, bytewise=True)
    # zlib inverts the CRC before and after the computation; both inversions are undone here.
    return zlib.crc32(data, _ALL_ONES) ^ _ALL_ONES
