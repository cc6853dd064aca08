"""RTCM 3 messages (RTCM 10403): framing with CRC-24Q, and fragmentation into GPS_RTCM_DATA."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from aerokit.mavlink.messages import GpsRtcmData

PREAMBLE, HEADER_SIZE, CRC_SIZE = 0xD3, 3, 3
FRAGMENT_SIZE, MAX_FRAGMENTS = 180, 4
MAX_MESSAGE_SIZE = FRAGMENT_SIZE * MAX_FRAGMENTS
"""Maximum bytes of an RTCM message that GPS_RTCM_DATA can carry. RTCM 3 itself allows 1029 bytes."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (0x1864CFB if crc & 0x800000 else 0)  # 0x1864CFB: polynomial of CRC-24Q
        table.append(crc)
    return tuple(table)


_TABLE = _crc_table()


def crc24q(data: bytes) -> int:
    """Return the CRC-24Q of RTCM 3, which is 0 for a complete frame including its CRC."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFFFF) ^ _TABLE[crc >> 16 ^ byte]
    return crc


def message_number(frame: bytes) -> int | None:
    """Return the RTCM message number, e.g. 1005 or 1077.

    The result is None for an empty message, which RTCM allows as a filler.
    """
    body = frame[HEADER_SIZE:-CRC_SIZE]
    return None if len(body) < 2 else body[0] << 4 | body[1] >> 4  # the first 12 bits of the body


def _frame_size(data: bytes, begin: int) -> int | None:
    """Return the size of the frame at ``begin``, or None if no frame begins there. Reads up to three bytes."""
    # After the preamble, six reserved bits must be zero. The length follows in ten bits.
    if data[begin] != PREAMBLE or data[begin + 1] & 0xFC:
        return None
    return HEADER_SIZE + (data[begin + 1] << 8 | data[begin + 2]) + CRC_SIZE


def rtcm_messages(data: bytes) -> list[bytes]:
    """Split bytes that consist of complete RTCM 3 messages into these messages.

    Raises:
        InvalidArgument: ``data`` is empty, or a message is incomplete, damaged, or longer than 720 bytes.
    """
    messages: list[bytes] = []
    begin = 0
    while True:  # `while begin < len(data)` would accept empty data.
        remaining = len(data) - begin
        subject = f"rtcm (byte {begin} of {len(data)})"
        if 0 < remaining <= HEADER_SIZE and data[begin] == PREAMBLE:
            raise InvalidArgument(
                f"{subject} is not allowed: a message has at least {HEADER_SIZE + CRC_SIZE} bytes, but only"
                f" {remaining} were given"
            )
        size = _frame_size(data, begin) if remaining > HEADER_SIZE else None
        if size is None:
            raise InvalidArgument(
                f"{subject} is not allowed: no RTCM 3 message begins there (all begin with 0xD3 and six zero bits)"
            )
        frame = data[begin : begin + size]
        if len(frame) < size:
            raise InvalidArgument(
                f"{subject} is not allowed: the message has {size} bytes, but only {len(frame)} were given"
            )
        if crc24q(frame):
            raise InvalidArgument(f"{subject} is not allowed: the CRC-24Q of the message is wrong")
        if size > MAX_MESSAGE_SIZE:
            raise InvalidArgument(
                f"{subject} is not allowed: the message has {size} bytes, but GPS_RTCM_DATA carries at most"
                f" {MAX_MESSAGE_SIZE}"
            )
        messages.append(frame)
        begin += size
        if begin == len(data):
            return messages


class RtcmReader:
    """Finds RTCM 3 messages in a stream of bytes, which may be split anywhere and contain other bytes.

    ``skipped_bytes`` counts bytes that belong to no message.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.skipped_bytes: int = 0

    def feed(self, data: bytes) -> list[bytes]:
        messages: list[bytes] = []
        buffer = self._buffer + data
        begin = 0
        while True:
            preamble_at = buffer.find(PREAMBLE, begin)
            if preamble_at < 0:
                preamble_at = len(buffer)
            self.skipped_bytes += preamble_at - begin
            begin = preamble_at
            if len(buffer) - begin < HEADER_SIZE:
                break
            size = _frame_size(buffer, begin)
            if size is not None and len(buffer) - begin < size:  # The rest of the message has not arrived yet.
                break
            # If no valid message begins here, the search continues at the next byte.
            if size is None or crc24q(buffer[begin : begin + size]):
                begin += 1
                self.skipped_bytes += 1
                continue
            messages.append(buffer[begin : begin + size])
            begin += size
        self._buffer = buffer[begin:]
        return messages


def fragments(message: bytes, sequence: int) -> list[GpsRtcmData]:
    """Return one RTCM message of 1 to 720 bytes as GPS_RTCM_DATA messages."""
    from aerokit.mavlink.messages import GpsRtcmData

    pieces = [message[begin : begin + FRAGMENT_SIZE] for begin in range(0, len(message), FRAGMENT_SIZE)]
    is_split = len(pieces) > 1
    # A receiver considers a split message complete after four fragments, or after a fragment that is not full.
    if is_split and len(pieces) < MAX_FRAGMENTS and len(pieces[-1]) == FRAGMENT_SIZE:
        pieces.append(b"")
    # Bit 0 is set if the message is split. Bits 1 and 2 are the number of the fragment, bits 3 to 7 the sequence.
    flags = (sequence & 0x1F) << 3 | is_split
    return [
        GpsRtcmData(flags=flags | number << 1, len=len(piece), data=piece.ljust(FRAGMENT_SIZE, b"\0"))
        for number, piece in enumerate(pieces)
    ]
