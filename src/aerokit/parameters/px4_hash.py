"""PX4's ``_HASH_CHECK``: one number over all parameters, by which a list kept on disk is known to be current."""

from __future__ import annotations

import zlib
from collections.abc import Container

from aerokit.parameters.encoding import to_bits
from aerokit.parameters.table import ParameterTable

__all__ = ["HASH_NAME", "px4_hash"]

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
