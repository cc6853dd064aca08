"""RTCM 3 corrections as GPS_RTCM_DATA messages."""

from __future__ import annotations

from collections.abc import Iterator

from aerokit.errors import InvalidArgument
from aerokit.mavlink.messages import GpsRtcmData

FRAGMENT_SIZE, MAX_FRAGMENTS = 180, 4

# An RTCM 3 message: preamble, 6 reserved bits, 10 bits of length, payload, CRC of 3 bytes.
RTCM_PREAMBLE, RTCM_OVERHEAD = 0xD3, 6


def rtcm_messages(data: bytes) -> Iterator[bytes]:
    """Split bytes into RTCM 3 messages. Bytes that are not RTCM 3 are returned unchanged."""
    while data:
        size = len(data)
        if len(data) > 3 and data[0] == RTCM_PREAMBLE:
            size = min(size, RTCM_OVERHEAD + ((data[1] & 0x03) << 8 | data[2]))
        yield data[:size]
        data = data[size:]


def fragments(data: bytes, sequence: int) -> list[GpsRtcmData]:
    """Return one RTCM message as GPS_RTCM_DATA messages.

    Flags: bit 0 is set for a fragment, bits 1 and 2 are the fragment number, bits 3 to 7 the sequence number. The
    receiver takes a message as complete after four fragments or after one that is not full. An empty fragment
    therefore follows a full last one.

    Raises:
        InvalidArgument: the message is empty, or longer than four fragments (720 bytes).
    """
    if not 0 < len(data) <= FRAGMENT_SIZE * MAX_FRAGMENTS:
        raise InvalidArgument(
            f"rtcm: a message of {len(data)} bytes is not allowed: 1 to {FRAGMENT_SIZE * MAX_FRAGMENTS}"
        )
    flags = (sequence & 0x1F) << 3
    if len(data) <= FRAGMENT_SIZE:
        return [GpsRtcmData(flags, len(data), data.ljust(FRAGMENT_SIZE, b"\0"))]
    pieces = [data[begin : begin + FRAGMENT_SIZE] for begin in range(0, len(data), FRAGMENT_SIZE)]
    if len(pieces) < MAX_FRAGMENTS and len(pieces[-1]) == FRAGMENT_SIZE:
        pieces.append(b"")
    return [
        GpsRtcmData(flags | number << 1 | 1, len(piece), piece.ljust(FRAGMENT_SIZE, b"\0"))
        for number, piece in enumerate(pieces)
    ]
