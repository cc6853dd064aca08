"""`Frame`: one received frame with a valid checksum and an undecoded payload.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit._internal.wire import FrameFields, wire

MAGIC_V1 = 0xFE
"""First byte of a MAVLink 1 frame."""

MAGIC_V2 = 0xFD
"""First byte of a MAVLink 2 frame."""

SIGNED = 0x01
"""The only defined incompatibility flag: the frame has a signature of 13 bytes."""

RADIO_MESSAGE_IDS = frozenset((109, 166))
"""Ids of RADIO_STATUS and RADIO. Telemetry radios send them without a signature, because they have no key."""

HEADER_LENGTH = 9  # without the magic byte

SIGNATURE_LENGTH = 13


class Frame(FrameFields):
    """One frame with a valid checksum. Treat it as immutable, because all receivers share it."""

    # For speed, there is no constructor: the framer sets the attributes directly. Properties compute all other values.
    if not TYPE_CHECKING:  # Type checkers would reject the annotations below, which empty slots do not contain.
        __slots__ = ()

    body: bytes
    """The data covered by the checksum: a header of nine bytes, in the layout of MAVLink 2, and the payload."""
    checksum: int
    """Checksum of the frame, 0..65535."""
    message_id: int
    """Message id, 0..16777215."""
    system_id: int
    """System id of the sender, 0..255 (0 is invalid)."""
    component_id: int
    """Component id of the sender, 0..255."""
    # At least one of these is set. `raw` or `body` computes the other: MAVLink 1 and signed frames have `_raw`.
    _body: bytes
    _raw: bytes
    received_at: float
    """Time in seconds that was passed to the framer with the data."""

    @classmethod
    def parse(cls, raw: bytes, received_at: float = 0.0) -> Frame:
        """Create a frame from bytes that are known to be valid, for example from a log."""
        frame = cls()
        frame._raw = raw
        frame.received_at = received_at
        if raw[0] == MAGIC_V1:
            length, _, frame.system_id, frame.component_id, frame.message_id = raw[1:6]
            payload_end = 6 + length
            # `body` always has the header layout of MAVLink 2: the flags and the upper bytes of the message id are 0.
            frame._body = bytes((length, 0, 0, *raw[2:6], 0, 0)) + raw[6:payload_end]
        else:
            payload_end = 10 + raw[1]
            frame.system_id, frame.component_id = raw[5], raw[6]
            frame.message_id = raw[7] | raw[8] << 8 | raw[9] << 16
            frame._body = raw[1:payload_end]
        frame.checksum = int.from_bytes(raw[payload_end : payload_end + 2], "little")
        return frame

    @property
    def raw(self) -> bytes:
        """The whole frame, from the magic byte to the checksum or signature."""
        raw: bytes | None = getattr(self, "_raw", None)  # getattr() is twice as fast as catching AttributeError.
        return b"\xfd" + self.body + self.checksum.to_bytes(2, "little") if raw is None else raw

    @property
    def payload(self) -> bytes:
        """The payload as received. MAVLink 2 truncates trailing zeros."""
        return self.body[HEADER_LENGTH:]

    @property
    def sequence(self) -> int:
        """Sequence number, 0..255."""
        return self.body[3]

    @property
    def version(self) -> int:
        """MAVLink version, 1 or 2."""
        return 1 if self.raw[0] == MAGIC_V1 else 2

    @property
    def incompat_flags(self) -> int:
        """Flags that a receiver must support: 0 or `SIGNED`."""
        return self.body[1]

    @property
    def compat_flags(self) -> int:
        """Flags that a receiver may ignore."""
        return self.body[2]

    @property
    def signature(self) -> bytes:
        """Link id, timestamp and signature, 13 bytes, not verified; empty if the frame is not signed."""
        return self.raw[-SIGNATURE_LENGTH:] if self.incompat_flags & SIGNED else b""

    def __repr__(self) -> str:
        source = f"{self.system_id}/{self.component_id}"
        return f"<Frame v{self.version} id={self.message_id} from={source} seq={self.sequence}>"


if wire is not None:
    wire.register(0, Frame)


def is_whole_frame(data: bytes) -> bool:
    """Return True if the bytes are one frame. The checksum is not verified."""
    if len(data) < 8 or data[0] not in (MAGIC_V1, MAGIC_V2):
        return False
    magic, payload_length, flags = data[:3]
    if magic == MAGIC_V1:
        return len(data) == 6 + payload_length + 2  # header, payload and checksum
    signature_length = SIGNATURE_LENGTH if flags == SIGNED else 0
    return flags <= SIGNED and len(data) == 10 + payload_length + 2 + signature_length


def x25_in_python() -> Callable[[bytes], int]:
    """Create a checksum function in Python."""
    table: list[int] = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0x8408 if crc & 1 else crc >> 1  # 0x8408: reversed polynomial of CRC-16/MCRF4XX
        table.append(crc)

    def x25(data: bytes) -> int:
        crc = 0xFFFF
        for byte in data:
            crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
        return crc

    return x25


def _fastest_x25() -> Callable[[bytes], int]:
    if wire is not None:
        compiled: Callable[[bytes], int] = wire.x25
        return compiled
    try:
        from fastcrc.crc16 import mcrf4xx
    except ImportError:
        # pymavlink does not install fastcrc on this platform.
        return x25_in_python()
    return mcrf4xx


x25: Callable[[bytes], int] = _fastest_x25()
"""Computes the checksum of bytes (CRC-16/MCRF4XX), 0..65535."""
