"""`FrameEncoder`: encodes messages to frames."""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, Any

from aerokit._internal.wire import wire
from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNED, x25
from aerokit.mavlink.message import Message, layout_of

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing

_HEADER_V2 = Struct("<BBBBBBHB").pack  # without the magic byte
_MAGIC_V1, _MAGIC_V2 = bytes((MAGIC_V1,)), bytes((MAGIC_V2,))
_BYTES = tuple(bytes((byte,)) for byte in range(256))


class FrameEncoder:
    """Adds ids, sequence number, checksum and signature of one component to its messages.

    Use a separate encoder for each link, so that the peer can detect losses.
    """

    _encode_frame: Any = None if wire is None else wire.encode_frame

    def __init__(self, system_id: int, component_id: int, *, version: int = 2) -> None:
        """Create an encoder. ``system_id`` is 1..255, ``component_id`` 0..255, ``version`` 1 or 2.

        Component 0 is the broadcast address, but is allowed because old ground stations use it.
        """
        if not 1 <= system_id <= 255:
            raise InvalidArgument(f"system_id = {system_id!r} must be in 1..255 (0 is the broadcast address)")
        if not 0 <= component_id <= 255:
            raise InvalidArgument(f"component_id = {component_id!r} must be in 0..255")
        self.system_id: int = int(system_id)
        self.component_id: int = int(component_id)
        self.sequence: int = 0
        """Sequence number of the next frame, 0..255."""
        self.signing: Signing | None = None
        """Signs MAVLink 2 frames; None to send them unsigned. MAVLink 1 has no signatures."""
        self._version = 2
        self.version = version

    @property
    def version(self) -> int:
        """MAVLink version of the next frames, 1 or 2."""
        return self._version

    @version.setter
    def version(self, version: int) -> None:
        if version not in (1, 2):
            raise InvalidArgument(f"version = {version!r} must be 1 or 2")
        self._version = int(version)

    def encode(self, message: Message, now: float = 0.0) -> bytes:
        """Encode a whole frame.

        In MAVLink 2, trailing zeros of the payload are truncated. In MAVLink 1, extension fields are omitted.
        ``now`` is in seconds since 1970, for the timestamp of the signature.

        Raises:
            InvalidArgument: a field has an invalid value, the id is above 255 in MAVLink 1, or the timestamps of the
                key are exhausted. The sequence number is not increased.
        """
        signing = self.signing if self._version == 2 else None
        flags = 0 if signing is None else SIGNED
        source = self.system_id, self.component_id
        if self._encode_frame is not None:
            compiled: bytes | None = self._encode_frame(message, self._version, flags, self.sequence, *source)
            if compiled is not None:
                signed = compiled if signing is None else compiled + signing.sign(compiled, now)
                self.sequence = (self.sequence + 1) & 0xFF
                return signed
            # Compiled code cannot encode this type yet. Make its layout, for the next message.
            layout_of(type(message))
        payload = message.encode()
        message_id = message.ID
        if self._version == 2:
            payload = payload.rstrip(b"\0") or payload[:1]  # MAVLink 2 never truncates the first byte.
            compat_flags = 0
            low_id, high_id = message_id & 0xFFFF, message_id >> 16
            header = _HEADER_V2(len(payload), flags, compat_flags, self.sequence, *source, low_id, high_id)
            magic = _MAGIC_V2
        else:
            if message_id > 255:
                raise InvalidArgument(f"{message.NAME} has id {message_id}, but MAVLink 1 has no ids above 255")
            payload = payload[: message.BASE_LENGTH]
            header = bytes((len(payload), self.sequence, *source, message_id))
            magic = _MAGIC_V1
        body = header + payload
        frame = magic + body + x25(body + _BYTES[message.CRC_EXTRA]).to_bytes(2, "little")
        signed = frame if signing is None else frame + signing.sign(frame, now)
        self.sequence = (self.sequence + 1) & 0xFF
        return signed
