"""A port of a simulated vehicle: decodes incoming frames, schedules streams, queues outgoing bytes."""

from __future__ import annotations

import copy
import math
from collections.abc import Container, Hashable, Sequence
from heapq import heappop, heappush, heapreplace
from typing import Any, TypeVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import INTEGER_RANGES, Field, Message
from aerokit.mavlink.signing import Signing

MessageT = TypeVar("MessageT", bound=Message)
_MAX_FLOAT32 = 3.4028234663852886e38
NS_PER_S = 1e9
"""Due times in seconds are rounded to nanoseconds, so that events with different intervals can be due at one instant.

``round(seconds * NS_PER_S) / NS_PER_S`` takes half the time of ``round(seconds, 9)``.
"""


def fitted(message: MessageT) -> MessageT:
    """Return a copy of the message whose values fit their fields."""
    fitting = copy.copy(message)
    for field in fitting.FIELDS:
        value = getattr(fitting, field.name)
        if field.problem(value) is not None:
            setattr(fitting, field.name, _fit_field(field, value))
    return fitting


def _fit_field(field: Field, value: Any) -> Any:
    # Values of a wrong type are not changed, so that encoding them reveals the bug.
    if field.type == "char":
        if isinstance(value, str) and field.is_text:
            max_bytes = field.array_length or 1
            return value.encode(errors="replace")[:max_bytes].decode(errors="ignore")
        if isinstance(value, bytes) and not field.is_text:
            return value[: field.array_length]
        return value  # The value has a wrong type.
    if isinstance(value, tuple):
        return tuple(_fit_number(field.type, element) for element in value)
    return _fit_number(field.type, value)


def _fit_number(type_: str, value: Any) -> Any:
    if type_ in INTEGER_RANGES:
        low, high = INTEGER_RANGES[type_]
        return max(low, min(high, value)) if isinstance(value, int) else value
    if type_ == "float" and abs(value) > _MAX_FLOAT32:
        return math.copysign(math.inf, value)
    return value


MAX_PEERS = 256
"""Maximum number of peers whose partial frames a `MessageReader` keeps. A further peer replaces the oldest one."""


class MessageReader:
    """Decodes the bytes of several peers. ``wanted`` contains the message ids to decode; None decodes all."""

    def __init__(self, wanted: Container[int] | None) -> None:
        self._wanted = wanted
        self._framers: dict[Hashable, Framer] = {}

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        """Return the messages whose last bytes are in ``data``, each with its ``received_frame``."""
        framer = self._framers.get(peer)
        if framer is None:
            if len(self._framers) >= MAX_PEERS:  # The first key is the oldest peer.
                del self._framers[next(iter(self._framers))]
            framer = self._framers[peer] = Framer()
            framer.wanted = self._wanted
        decode = STANDARD.decode
        return [decode(frame) for frame in framer.receive(data, now)]


class SharedMessageReader(MessageReader):
    """Decodes the same bytes only once for several vehicles. The result is cached until `forget` is called."""

    def __init__(self) -> None:
        super().__init__(None)
        self._cached: list[Message] | None = None  # messages of the last datagram, which several vehicles read

    def messages(self, data: bytes, now: float, peer: Hashable) -> list[Message]:
        if self._cached is None:
            self._cached = super().messages(data, now, peer)
        return self._cached

    def forget(self) -> None:
        self._cached = None


class _StreamGroup:
    """Streams that were started at the same time with the same interval."""

    __slots__ = ("count", "ids", "interval_s", "start")

    def __init__(self, interval_s: float, start: float) -> None:
        self.interval_s = interval_s
        self.start = start
        self.count = 0  # number of messages that each stream has sent
        self.ids: list[int] = []


class Streams:
    """Schedule of the messages that a port streams. A late stream skips messages instead of sending a burst."""

    __slots__ = ("_group_count", "_groups", "_heap", "next_due")

    def __init__(self) -> None:
        self.next_due: float = math.inf
        """Time of the next message; infinity if no message is streamed."""
        self._groups: dict[int, _StreamGroup] = {}  # by message id
        # Heap entries: (due time, number of the group, group).
        self._heap: list[tuple[float, int, _StreamGroup]] = []
        self._group_count = 0

    def set_interval(self, message_id: int, interval_s: float, now: float) -> None:
        """Stream a message every ``interval_s`` seconds from the time ``now`` on. 0 stops the stream."""
        previous = self._groups.pop(message_id, None)
        if previous is not None:
            previous.ids.remove(message_id)
        if interval_s > 0.0:
            self._groups[message_id] = group = self._group_starting_now(interval_s, now)
            group.ids.append(message_id)
        self._update_next_due()

    def _group_starting_now(self, interval_s: float, now: float) -> _StreamGroup:
        for group in self._groups.values():
            if group.start == now and group.interval_s == interval_s and group.count == 0:
                return group
        group = _StreamGroup(interval_s, now)
        self._group_count += 1
        heappush(self._heap, (now, self._group_count, group))
        return group

    def interval(self, message_id: int) -> float:
        """Return the interval in seconds, or 0 if the message is not streamed."""
        group = self._groups.get(message_id)
        return 0.0 if group is None else group.interval_s

    def ids(self) -> frozenset[int]:
        return frozenset(self._groups)

    def postpone(self, seconds: float) -> None:
        for _, _, group in self._heap:
            group.start += seconds
        self._heap = [(due + seconds, number, group) for due, number, group in self._heap]
        self._update_next_due()

    def _update_next_due(self) -> None:
        self.take_due(-math.inf)  # No message is due at -inf, so the call only updates `next_due`.

    def take_due(self, now: float) -> list[int]:
        """Return the ids of the messages that are due, and schedule the next message of each stream."""
        ids: list[int] = []
        heap = self._heap
        while heap:
            due, number, group = heap[0]
            if not group.ids:  # All streams of the group were stopped or replaced.
                heappop(heap)
                continue
            if due > now:
                self.next_due = due
                return ids
            ids += group.ids
            group.count += 1
            next_due = round((group.start + group.count * group.interval_s) * NS_PER_S) / NS_PER_S
            if next_due <= now:  # The next message is late, too, so the streams start again now.
                group.start = now
                group.count = 1
                next_due = now + group.interval_s
            heapreplace(heap, (next_due, number, group))
        self.next_due = math.inf
        return ids


_DATAGRAM_SIZE = 1200


class Channel:
    """A port of a vehicle. As on a flight controller, all clients of a port share its stream rates."""

    def __init__(self, system_id: int, component_id: int, wanted: Container[int], *, version: int = 2) -> None:
        self.version = version
        self.streams: Streams = Streams()
        self._wanted = wanted
        self._own_ids = (system_id, component_id)
        self.reader: MessageReader = MessageReader(wanted)
        """Decodes incoming bytes. Several vehicles on one link may share a reader."""
        self._encoders: dict[tuple[int, int], FrameEncoder] = {}
        self.outbox: list[bytes] = []
        """Frames, and other pieces that must not be divided."""
        self.closes_clients: bool = False
        """True if the vehicle wants the server to disconnect the clients of this (TCP) port."""
        self.signing: Signing | None = None
        """Signs and checks frames; see `sign_with`."""

    def sign_with(self, signing: Signing | None) -> None:
        """Sign and check frames with ``signing`` from now on. None turns signing off."""
        self.signing = signing
        for encoder in self._encoders.values():
            encoder.signing = signing

    def messages(self, data: bytes, now: float, peer: Hashable = None) -> list[Message]:
        """Return the accepted messages in the bytes of one peer."""
        signing, wanted = self.signing, self._wanted
        messages = [message for message in self.reader.messages(data, now, peer) if message.ID in wanted]
        if signing is None:
            return messages
        return [message for message in messages if message.received_frame and signing.accepts(message.received_frame)]

    def encode(self, message: Message, sender: tuple[int, int] | None = None) -> bytes:
        """Return a frame, or nothing if a MAVLink 1 port cannot send the message."""
        if self.version == 1 and message.ID > 255:  # The id of a MAVLink 1 message has one byte.
            return b""
        sender = self._own_ids if sender is None else sender
        encoder = self._encoders.get(sender)
        if encoder is None:
            encoder = self._encoders[sender] = FrameEncoder(*sender, version=self.version)
            encoder.signing = self.signing
        try:
            return encoder.encode(message)
        except InvalidArgument:
            # A value that does not fit its field, such as NaN or a distant position, must not stop a vehicle.
            return encoder.encode(fitted(message))

    def write(self, data: bytes) -> None:
        """Append a frame to the outbox, or other bytes that must not be divided."""
        if data:
            self.outbox.append(data)

    def take_outbox(self) -> bytes:
        """Return and clear the outbox."""
        return b"".join(self.take_pieces())

    def take_pieces(self) -> list[bytes]:
        """Return and clear the outbox, with one element for each call of `write`."""
        pieces = self.outbox
        self.outbox = []
        return pieces

    def reset(self) -> None:
        """Reset stream rates, partial frames and sequence numbers. The outbox is kept."""
        self.streams = Streams()
        self.reader = MessageReader(self._wanted)
        self._encoders.clear()


def datagrams(pieces: Sequence[bytes]) -> list[bytes]:
    """Join the pieces, in their order, into as few datagrams as possible."""
    joined: list[bytes] = []
    datagram = b""
    for piece in pieces:
        if datagram and len(datagram) + len(piece) > _DATAGRAM_SIZE:
            joined.append(datagram)
            datagram = b""
        datagram += piece
    if datagram:
        joined.append(datagram)
    return joined
