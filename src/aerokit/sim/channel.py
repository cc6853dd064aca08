"""One port of a simulated vehicle: its own frames in, its own stream rates and its own bytes out."""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.sim.fitting import fitted
from aerokit.sim.hearing import Hearing
from aerokit.sim.streams import Streams

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.signing import Signing

__all__ = ["Channel", "datagrams"]

_DATAGRAM_SIZE = 1200


class Channel:
    """As on a flight controller, rates belong to the port: all who listen to it share them."""

    def __init__(
        self, system_id: int, component_id: int, wanted: Container[int], *, version: int = 2
    ) -> None:
        self.version = version
        self.streams: Streams = Streams()
        self._wanted = wanted
        self._own = (system_id, component_id)
        self.hearing: Hearing = Hearing(wanted)
        """Reads what comes in; vehicles on one link may share it."""
        self._encoders: dict[tuple[int, int], FrameEncoder] = {}
        self._outbox: list[bytes] = []
        self.hangs_up: bool = False
        """Whether its clients are to be cut off, where it is a TCP port."""
        self.signing: Signing | None = None
        """What signs its frames and checks what it hears; see `sign_with`."""

    def sign_with(self, signing: Signing | None) -> None:
        """Sign and check with this from now on; None: neither."""
        self.signing = signing
        for encoder in self._encoders.values():
            encoder.signing = signing

    def messages(self, data: bytes, now: float, peer: Hashable = None) -> list[Message]:
        """What the bytes of one peer hold that the vehicle understands."""
        signing, wanted = self.signing, self._wanted
        heard = [each for each in self.hearing.messages(data, now, peer) if each.ID in wanted]
        if signing is None:
            return heard
        return [each for each in heard if each.received_frame and signing.accepts(each.received_frame)]

    def encode(self, message: Message, sender: tuple[int, int] | None = None) -> bytes:
        """A frame with the sending component's next sequence number; empty when MAVLink 1 has none."""
        if self.version == 1 and message.ID > 255:
            return b""
        sender = self._own if sender is None else sender
        encoder = self._encoders.get(sender)
        if encoder is None:
            encoder = self._encoders[sender] = FrameEncoder(*sender, version=self.version)
            encoder.signing = self.signing
        try:
            return encoder.encode(message)
        except InvalidArgument:
            # NaN of a parameter, a place beyond the world: whatever made it, vehicles go on
            return encoder.encode(fitted(message))

    def write(self, data: bytes) -> None:
        """Put a frame, or other bytes that belong together, into the outbox."""
        if data:
            self._outbox.append(data)

    @property
    def has_output(self) -> bool:
        """Whether something waits to be sent."""
        return bool(self._outbox)

    def take_outbox(self) -> bytes:
        """Everything that waits to be sent, in order; whole frames only."""
        if not self._outbox:
            return b""
        data = b"".join(self._outbox)
        self._outbox.clear()
        return data

    def take_pieces(self) -> list[bytes]:
        """The same in frames, and what else belongs together."""
        pieces, self._outbox = self._outbox, []
        return pieces

    def take_datagrams(self) -> list[bytes]:
        """The same in pieces that fit into a datagram each."""
        return datagrams(self.take_pieces())

    def reset(self) -> None:
        """Forget rates, half frames and sequence numbers, as a reboot does; what was said before is on its way."""
        self.streams = Streams()
        self.hearing = Hearing(self._wanted)
        self._encoders.clear()


def datagrams(pieces: Iterable[bytes]) -> list[bytes]:
    """As few as possible, each of whole pieces."""
    found: list[bytes] = []
    size = 0
    together: list[bytes] = []
    for data in pieces:
        if together and size + len(data) > _DATAGRAM_SIZE:
            found.append(b"".join(together))
            together, size = [], 0
        together.append(data)
        size += len(data)
    if together:
        found.append(b"".join(together))
    return found
