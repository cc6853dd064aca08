"""RTCM corrections as GPS_RTCM_DATA messages. Without IO.

https://mavlink.io/en/messages/common.html#GPS_RTCM_DATA
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.mavlink.messages import GpsRtcmData

__all__ = ["fragments", "rtcm_messages"]

PIECE, PIECES = 180, 4
PREAMBLE, AROUND = 0xD3, 6
"""An RTCM 3 message: preamble, ten bits of length, as many bytes, and a CRC of three."""


def rtcm_messages(data: bytes) -> Iterator[bytes]:
    """The RTCM 3 messages in these bytes, one by one; bytes that are none of them as they are."""
    while data:
        size = len(data)
        if len(data) > 3 and data[0] == PREAMBLE:
            size = min(size, AROUND + ((data[1] & 0x03) << 8 | data[2]))
        yield data[:size]
        data = data[size:]


def fragments(data: bytes, sequence: int) -> list[GpsRtcmData]:
    """One RTCM message as GPS_RTCM_DATA: flags are "is a fragment", two bits of its number, five of the sequence.

    A message is whole when four fragments are there, or all before the first that is not full: so an empty one
    follows where the last is full.

    Raises:
        InvalidArgument: it is empty, or longer than the 720 bytes that fit into four.
    """
    from aerokit.mavlink.messages import GpsRtcmData

    if not 0 < len(data) <= PIECE * PIECES:
        raise InvalidArgument(
            f"rtcm: {len(data)} bytes are not allowed: 1 to {PIECE * PIECES} in one message"
        )
    flags = (sequence & 0x1F) << 3
    if len(data) <= PIECE:
        return [GpsRtcmData(flags, len(data), data.ljust(PIECE, b"\0"))]
    pieces = [data[begin : begin + PIECE] for begin in range(0, len(data), PIECE)]
    if len(pieces) < PIECES and len(pieces[-1]) == PIECE:
        pieces.append(b"")
    return [
        GpsRtcmData(flags | number << 1 | 1, len(piece), piece.ljust(PIECE, b"\0"))
        for number, piece in enumerate(pieces)
    ]
