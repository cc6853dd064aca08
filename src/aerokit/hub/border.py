"""``Border``: an endpoint that signs. What comes in is checked and loses its signature, what goes out gets one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.checksum import x25
from aerokit.mavlink.frame import MAGIC_V2, SIGNED, Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aerokit.mavlink.signing import Signing

__all__ = ["Border", "reframed"]


def reframed(frame: Frame, crc_extra: bytes, *, flags: int) -> bytes:
    """The frame with these incompatibility flags and without a signature, as MAVLink 2; sender and number stay.

    The checksum covers the flags: it is made anew.
    """
    body = frame.body
    payload = body[9:].rstrip(b"\0") or body[9:10]  # of MAVLink 1 too: version 2 has no zeros at its end
    body = bytes((len(payload), flags)) + body[2:9] + payload
    return bytes((MAGIC_V2,)) + body + x25(body + crc_extra).to_bytes(2, "little")


class Border:
    """Signs what goes out of one endpoint with its key, and lets in what is signed with it.

    ``unix_time`` is seconds since 1970. Frames of MAVLink 1 cannot be signed: they go out as MAVLink 2, and do not come
    in unless the ``allow_unsigned`` of the `Signing` lets them. Nor can frames of messages that the dialect does not
    know: their checksum cannot be made.
    """

    def __init__(
        self, signing: Signing, crc_extras: Mapping[int, bytes], refused: Callable[[Frame, str], object]
    ) -> None:
        """``refused(frame, why)`` is called for each frame that is not let in."""
        self.signing = signing
        self._extras, self._refused = crc_extras, refused

    def admitted(self, frame: Frame, unix_time: float) -> Frame | None:
        """The frame without its signature; None: it is not let in."""
        try:
            refusal = self.signing.check(frame, unix_time)
        except Exception as error:  # of the program's allow_unsigned
            self._refused(frame, f"allow_unsigned raised {error!r}")
            return None
        if refusal is not None:
            self._refused(frame, refusal.value)
            return None
        return self.unsigned(frame)

    def unsigned(self, frame: Frame) -> Frame:
        """The frame without its signature."""
        extra = self._extras.get(frame.message_id)
        if not frame.incompat_flags & SIGNED or extra is None:
            return frame
        return Frame.parse(reframed(frame, extra, flags=0), frame.received_at)

    def signed(self, raw: bytes, unix_time: float) -> bytes | None:
        """A whole frame, signed; None when it cannot be, because the dialect does not know the message."""
        frame = Frame.parse(raw)
        extra = self._extras.get(frame.message_id)
        if extra is None:
            return None
        data = reframed(frame, extra, flags=SIGNED)
        return data + self.signing.sign(data, unix_time)
