"""The checksum of a MAVLink frame: CRC-16/MCRF4XX ("X.25" in the standard), in C where it is there.

https://mavlink.io/en/guide/serialization.html#checksum
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["fast_x25", "x25"]


def _in_python() -> Callable[[bytes, int], int]:
    table: list[int] = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ 0x8408 if byte & 1 else byte >> 1
        table.append(byte)

    def x25_in_python(data: bytes, initial: int) -> int:
        crc = initial
        for byte in data:
            crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
        return crc

    return x25_in_python


def _fastest() -> Callable[[bytes, int], int]:
    try:
        from fastcrc.crc16 import mcrf4xx
    except ImportError:
        return _in_python()
    return mcrf4xx


fast_x25 = _fastest()
"""The same as `x25` without its default: always ``(data, 0xFFFF)``, for places that run per frame."""


def x25(data: bytes, initial: int = 0xFFFF) -> int:
    """The checksum of ``data``, 0..65535; ``initial`` goes on from an earlier one."""
    return fast_x25(data, initial)
