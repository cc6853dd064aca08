"""One port of a simulated vehicle: its own frames in, its own stream rates and its own bytes out."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Container, Hashable, Iterable
from heapq import heappop, heappush, heapreplace
from typing import Any, TypeVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import INTEGER_RANGES, Field, Message
from aerokit.mavlink.signing import Signing

MessageT = TypeVar("MessageT", bound=Message)
_LARGEST_FLOAT = 3.4028234663852886e38


def fitted(message: MessageT) -> MessageT:
    """The message with what does not fit cut off: whole numbers at their range, floats to infinity, texts at their end.

    What is of a wrong type stays, as it is a mistake of the simulation and no consequence of what a vehicle heard.
    """
    found = copy.copy(message)
    for field in found.FIELDS:
        value = getattr(found, field.name)
        if field.complaint(value) is not None:
            setattr(found, field.name, _fitting(field, value))
    return found


def _fitting(field: Field, value: Any) -> Any:
    if field.type == "char":
        if not field.is_text:
            return value[: field.array_length] if isinstance(value, bytes) else value
        is_text = isinstance(value, str)
        return (
            value.encode(errors="replace")[: field.array_length or 1].decode(errors="ignore")
            if is_text
            else value
        )
    fit = _fit_of(field.type)
    return tuple(map(fit, value)) if isinstance(value, tuple) else fit(value)


def _fit_of(kind: str) -> Callable[[Any], Any]:
    if kind in INTEGER_RANGES:
        low, high = INTEGER_RANGES[kind]
        return lambda value: max(low, min(high, value)) if isinstance(value, int) else value
    return lambda value: (
        math.copysign(math.inf, value) if kind == "float" and abs(value) > _LARGEST_FLOAT else value
    )


MOST_PEERS = 256


class Hearing:
    """Frames of any number of peers, each with a framer of its own; ``wanted`` are ids of messages, None is all."""

    def __init__(self, wanted: Container[int] | None) -> None:
        self._wanted = wanted
        self._framers: dict[Hashable, Framer] = {}

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        """What is complete with these bytes, each with its ``received_frame``."""
        framer = self._framers.get(peer)
        if framer is None:
            if len(self._framers) >= MOST_PEERS:
                del self._framers[next(iter(self._framers))]
            framer = self._framers[peer] = Framer()
            framer.wanted = self._wanted
        decode = STANDARD.decode
        return [decode(frame) for frame in framer.receive(data, now)]


class SharedHearing(Hearing):
    """Of several vehicles: what the first of them asks for is kept for the others, until `forget`."""

    def __init__(self) -> None:
        super().__init__(None)
        self._read: list[Message] | None = None

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        if self._read is None:
            self._read = super().messages(data, now, peer)
        return self._read

    def forget(self) -> None:
        self._read = None


class Streams:
    """Intervals per message id, and what is due. A stream that fell behind skips; it never bursts."""

    __slots__ = ("_heap", "_intervals", "_token", "next_due")

    def __init__(self) -> None:
        self.next_due: float = math.inf
        """When something is due; infinity when nothing is streamed."""
        self._intervals: dict[int, tuple[float, int]] = {}
        self._heap: list[tuple[float, int, int]] = []
        self._token = 0

    def set_interval(self, message_id: int, interval_s: float, now: float) -> None:
        """Send a message every ``interval_s`` seconds, for the first time now; 0 stops it."""
        self._token += 1
        if interval_s <= 0.0:
            self._intervals.pop(message_id, None)
        else:
            self._intervals[message_id] = (interval_s, self._token)
            heappush(self._heap, (now, self._token, message_id))
        self._look()

    def interval(self, message_id: int) -> float:
        """Seconds between two of these messages; 0 when it is not streamed."""
        return self._intervals.get(message_id, (0.0, 0))[0]

    def ids(self) -> frozenset[int]:
        """What is streamed at present."""
        return frozenset(self._intervals)

    def postpone(self, seconds: float) -> None:
        """Make everything this much later."""
        self._heap = [(due + seconds, token, message_id) for due, token, message_id in self._heap]
        self._look()

    def take_due(self, now: float) -> list[int]:
        """The message ids that are due, each scheduled anew."""
        ids: list[int] = []
        heap, intervals = self._heap, self._intervals
        while self.next_due <= now:
            due, token, message_id = heap[0]
            interval = intervals[message_id][0]
            following = due + interval
            heapreplace(heap, (following if following > now else now + interval, token, message_id))
            ids.append(message_id)
            self._look()
        return ids

    def _look(self) -> None:
        """Find out what is due next; what was stopped or replaced is dropped on the way."""
        heap, intervals = self._heap, self._intervals
        while heap:
            due, token, message_id = heap[0]
            current = intervals.get(message_id)
            if current is not None and current[1] == token:
                self.next_due = due
                return
            heappop(heap)
        self.next_due = math.inf


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
