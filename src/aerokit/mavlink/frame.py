"""`Frame`: one checked frame off the wire, payload not decoded.

https://mavlink.io/en/guide/serialization.html#packet_format

https://mavlink.io/en/guide/serialization.html#checksum
"""

from __future__ import annotations

from collections.abc import Callable

MAGIC_V1 = 0xFE
"""First byte of a MAVLink 1 frame."""

MAGIC_V2 = 0xFD
"""First byte of a MAVLink 2 frame."""

SIGNED = 0x01
"""The one incompatibility flag that exists: the frame ends with 13 bytes of signature."""

HEADER_LENGTH = 9  # without the magic byte

SIGNATURE_LENGTH = 13


class Frame:
    """One frame whose checksum was right. Treat it as immutable: it is shared by everyone who listens."""

    # No constructor: the framer fills in what it has at hand, the rest is worked out when somebody asks.
    __slots__ = ("_raw", "body", "checksum", "component_id", "message_id", "received_at", "system_id")

    body: bytes
    """What the checksum covers: nine bytes of header, then the payload; of MAVLink 1 too, as MAVLink 2 has it."""
    checksum: int
    """As on the wire, 0..65535."""
    message_id: int
    """The standard's number of the message, 0..16777215."""
    system_id: int
    """Who sent it: the system, 0..255 (0 is nobody's)."""
    component_id: int
    """Who sent it: the component, 0..255."""
    _raw: bytes  # only where `raw` cannot be put together again: MAVLink 1, signed, or parsed
    received_at: float
    """The ``now`` that the framer was given with its bytes, in seconds."""

    @classmethod
    def parse(cls, raw: bytes, received_at: float = 0.0) -> Frame:
        """Take a frame that is known to be whole and right, out of a log for example, apart."""
        frame = cls()
        frame._raw = raw
        frame.received_at = received_at
        upto = raw[1] + (6 if raw[0] == MAGIC_V1 else 10)
        frame.checksum = int.from_bytes(raw[upto : upto + 2], "little")
        if raw[0] == MAGIC_V1:
            frame.body = bytes((raw[1], 0, 0, *raw[2:6], 0, 0)) + raw[6:upto]
        else:
            frame.body = raw[1:upto]
        frame.system_id, frame.component_id = frame.body[4:6]
        frame.message_id = int.from_bytes(frame.body[6:9], "little")
        return frame

    @property
    def raw(self) -> bytes:
        """The whole frame, from the magic byte to the end of checksum or signature."""
        raw: bytes | None = getattr(self, "_raw", None)  # half the time of an AttributeError that is caught
        return b"\xfd" + self.body + self.checksum.to_bytes(2, "little") if raw is None else raw

    @property
    def payload(self) -> bytes:
        """The payload as on the wire: MAVLink 2 cuts zeros off its end."""
        return self.body[HEADER_LENGTH:]

    @property
    def sequence(self) -> int:
        """The sender's counter, 0..255, then from 0 again."""
        return self.body[3]

    @property
    def version(self) -> int:
        """1 or 2."""
        return 1 if self.raw[0] == MAGIC_V1 else 2

    @property
    def incompat_flags(self) -> int:
        """What a receiver must understand to read it: 0, or `SIGNED`."""
        return self.body[1]

    @property
    def compat_flags(self) -> int:
        """What a receiver may ignore."""
        return self.body[2]

    @property
    def signature(self) -> bytes:
        """Link id, time stamp and signature, 13 bytes, not verified; empty when it is not signed."""
        return self.raw[-SIGNATURE_LENGTH:] if self.incompat_flags & SIGNED else b""

    def __repr__(self) -> str:
        source = f"{self.system_id}/{self.component_id}"
        return f"<Frame v{self.version} id={self.message_id} from={source} seq={self.sequence}>"


def is_whole_frame(data: bytes) -> bool:
    """Whether these bytes have the form of exactly one frame; its checksum is not looked at."""
    if len(data) < 8 or data[0] not in (MAGIC_V1, MAGIC_V2):
        return False
    if data[0] == MAGIC_V1:
        return len(data) == data[1] + 8
    return data[2] <= SIGNED and len(data) == data[1] + 12 + SIGNATURE_LENGTH * data[2]


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
