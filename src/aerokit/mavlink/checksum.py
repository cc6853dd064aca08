"""The checksum of a MAVLink frame: CRC-16/MCRF4XX ("X.25" in the standard), in C where it is there.

https://mavlink.io/en/guide/serialization.html#checksum
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["TABLE", "x25"]


def _table() -> tuple[int, ...]:
    table: list[int] = []
    for crc in range(256):
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8408 if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


TABLE = _table()
"""``crc = (crc >> 8) ^ TABLE[(crc ^ byte) & 0xFF]`` adds one byte."""


def x25_in_python(data: bytes, initial: int = 0xFFFF) -> int:
    """The checksum without any library, about fifty times slower."""
    crc = initial
    for byte in data:
        crc = (crc >> 8) ^ TABLE[(crc ^ byte) & 0xFF]
    return crc


def _fastest() -> Callable[[bytes, int], int]:
    try:
        from fastcrc.crc16 import mcrf4xx  # noqa: PLC0415 - pymavlink brings it, but not on every platform
    except ImportError:
        return x25_in_python
    return mcrf4xx


_fast = _fastest()


def x25(data: bytes, initial: int = 0xFFFF) -> int:
    """The checksum of ``data``, 0..65535; ``initial`` goes on from an earlier one."""
    return _fast(data, initial)
