"""The checksum of a MAVLink frame: CRC-16/MCRF4XX ("X.25" in the standard), in C where it is there.

https://mavlink.io/en/guide/serialization.html#checksum
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["x25", "x25_in_python"]


def x25_in_python() -> Callable[[bytes], int]:
    """Make the function without any library, for platforms where pymavlink comes without ``fastcrc``."""
    table: list[int] = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ 0x8408 if byte & 1 else byte >> 1
        table.append(byte)

    def x25(data: bytes) -> int:
        crc = 0xFFFF
        for byte in data:
            crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
        return crc

    return x25


def _fastest() -> Callable[[bytes], int]:
    try:
        from fastcrc.crc16 import mcrf4xx
    except ImportError:
        return x25_in_python()
    return mcrf4xx


x25: Callable[[bytes], int] = _fastest()
"""The checksum of some bytes, 0..65535."""
