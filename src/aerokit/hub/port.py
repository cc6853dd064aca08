"""``Port``: one peer of one endpoint, with the queue of frames that wait for its link, and its signing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from aerokit.hub.message_rules import ORDER_MAX_AGE_S, MessageKind, kind_of
from aerokit.mavlink.frame import HEADER_LENGTH, MAGIC_V2, SIGNED, Frame, x25

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Mapping

    from aerokit.hub.routing import ForwardingPlan, Ingress
    from aerokit.hub.senders import IdentityGuard
    from aerokit.hub.values import HubEventKind
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Link, Peer

MAX_QUEUED_FRAMES = 1024

MAX_QUEUED_BYTES = 128 * 1024
"""Maximum size of a queue: a few seconds of a mission or parameter transfer on a slow radio."""


class QueuedFrame(NamedTuple):
    """A frame that waits for a link."""

    raw: bytes
    kind: MessageKind
    message_id: int
    target: tuple[int, int]  # system id and component id
    waiting_since: float  # loop time


class DroppedFrame(NamedTuple):
    """A frame that was removed from a queue. ``reason`` is a key of `EndpointStatistics.dropped`."""

    reason: str
    frame: QueuedFrame


class FrameQueue:
    """Queue in which newer telemetry replaces older telemetry with the same message id and sender.

    When the queue is full, the oldest telemetry is dropped. If there is none, the new frame is dropped.
    """

    def __init__(self) -> None:
        # The frames in the order of sending. The key of telemetry identifies its sender and message. All other frames
        # have unique negative keys.
        self._frames: dict[int, QueuedFrame] = {}
        self._bytes = 0
        self._last_key = 0  # the negative key that was used last
        # Counts of queued frames that expire, and of telemetry. If a count is 0, the queue need not be searched.
        self._expiring_count = 0
        self._telemetry_count = 0

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: QueuedFrame, key: int) -> list[DroppedFrame]:
        """Add a frame. Return the frames that were dropped for it. ``key`` identifies the sender and the message."""
        dropped: list[DroppedFrame] = []
        if frame.kind is MessageKind.TELEMETRY:
            replaced = self._frames.get(key)
            if replaced is not None:
                self._bytes += len(frame.raw) - len(replaced.raw)
                self._frames[key] = frame
                return [DroppedFrame("superseded", replaced)]
        else:
            self._last_key -= 1  # The key is unique, so that no other frame replaces this one.
            key = self._last_key
        while self._is_full(len(frame.raw)):
            if not self._telemetry_count:
                return [*dropped, DroppedFrame("queue_full", frame)]
            oldest_telemetry = next(
                queued_key for queued_key, queued in self._frames.items() if queued.kind is MessageKind.TELEMETRY
            )
            dropped.append(DroppedFrame("queue_full", self._remove(oldest_telemetry)))
        self._frames[key] = frame
        self._count(frame, 1)
        return dropped

    def expire(self, now: float) -> list[DroppedFrame]:
        """Remove and return the commands and measurements that have waited too long."""
        if not self._expiring_count:
            return []
        late = [
            key
            for key, queued in self._frames.items()
            if queued.kind.expires and now - queued.waiting_since > ORDER_MAX_AGE_S
        ]
        return [DroppedFrame("late", self._remove(key)) for key in late]

    def pop(self) -> bytes | None:
        """Remove and return the first frame. Call :meth:`expire` before."""
        if not self._frames:
            return None
        first_key = next(iter(self._frames))
        return self._remove(first_key).raw

    def clear(self) -> list[DroppedFrame]:
        dropped = [DroppedFrame("link_lost", frame) for frame in self._frames.values()]
        self._frames.clear()
        self._bytes = self._expiring_count = self._telemetry_count = 0
        return dropped

    def _is_full(self, size: int) -> bool:
        return len(self._frames) >= MAX_QUEUED_FRAMES or self._bytes + size > MAX_QUEUED_BYTES

    def _remove(self, key: int) -> QueuedFrame:
        frame = self._frames.pop(key)
        self._count(frame, -1)
        return frame

    def _count(self, frame: QueuedFrame, change: int) -> None:
        self._bytes += change * len(frame.raw)
        if frame.kind.expires:
            self._expiring_count += change
        elif frame.kind is MessageKind.TELEMETRY:
            self._telemetry_count += change


def _to_mavlink2(frame: Frame, crc_extra: bytes, *, flags: int) -> bytes:
    """Return the frame as MAVLink 2 with these incompatibility flags.

    With the flag SIGNED, the caller must append the signature.
    """
    # MAVLink 2 truncates trailing zeros, but keeps at least one byte. MAVLink 1 does not truncate.
    payload = frame.payload.rstrip(b"\0") or frame.payload[:1]
    header = bytes((len(payload), flags)) + frame.body[2:HEADER_LENGTH]  # Only these two bytes change.
    body = header + payload
    return bytes((MAGIC_V2,)) + body + x25(body + crc_extra).to_bytes(2, "little")


class FrameSigner:
    """Signs frames that leave an endpoint; verifies and removes the signatures of received frames.

    ``unix_time`` is in seconds since 1970. MAVLink 1 frames are sent as MAVLink 2, and refused on reception unless
    ``allow_unsigned`` of the `Signing` accepts them. Messages outside the dialect cannot be signed, because their
    checksum cannot be calculated. ``on_refused(frame, reason)`` is called for each refused frame.
    """

    def __init__(
        self, signing: Signing, crc_extras: Mapping[int, bytes], on_refused: Callable[[Frame, str], object]
    ) -> None:
        self.signing = signing
        self._extras, self._on_refused = crc_extras, on_refused

    def verify(self, frame: Frame, unix_time: float) -> Frame | None:
        """Return a received frame without its signature; None if the frame is refused."""
        try:
            refusal = self.signing.check(frame, unix_time)
        except Exception as error:  # `check` calls the program's function `allow_unsigned`.
            self._on_refused(frame, f"allow_unsigned raised {error!r}")
            return None
        if refusal is not None:
            self._on_refused(frame, refusal.value)
            return None
        return self.strip_signature(frame)

    def strip_signature(self, frame: Frame) -> Frame:
        extra = self._extras.get(frame.message_id)
        if not frame.incompat_flags & SIGNED or extra is None:
            return frame
        return Frame.parse(_to_mavlink2(frame, extra, flags=0), frame.received_at)

    def sign(self, raw: bytes, unix_time: float) -> bytes | None:
        """Return a frame with a signature; None if the dialect does not have the message."""
        frame = Frame.parse(raw)
        extra = self._extras.get(frame.message_id)
        if extra is None:
            return None
        data = _to_mavlink2(frame, extra, flags=SIGNED)
        return data + self.signing.sign(data, unix_time)


MAX_JOINED_BYTES = 1200
"""Frames sent together are joined up to this size, because IP splits larger datagrams into fragments."""
UNLIMITED = 1 << 62  # more bytes than any link can have unsent
MAX_RATE_LIMITS = 4096
"""Maximum number of (sender, message) pairs whose rate is tracked."""


class EndpointCounters:
    """Counters of an endpoint, shared by its ports."""

    def __init__(self, dropped: Counter[str]) -> None:
        self.dropped: Counter[str] = dropped
        self.frames_out = 0
        self.bytes_out = 0


class Port:
    """One peer of one endpoint.

    While the link accepts data, frames are collected in ``batch``, and `Switch` writes them. While more than
    ``queue_above_bytes`` bytes are unsent, frames wait in a `FrameQueue`. If the limit is `UNLIMITED`, they never wait.

    ``endpoint`` is the endpoint's name, and ``min_interval`` its `Filters.min_interval`. ``report(kind, text)``
    publishes an event of the endpoint. ``on_drop(reason, frame)`` is called for each frame dropped from the queue.
    """

    link: Link
    peer: Peer

    def __init__(
        self,
        link: Link,
        peer: Peer,
        counters: EndpointCounters,
        *,
        endpoint: str,
        dialect: Dialect,
        queue_above_bytes: int,
        min_interval: Callable[[int], float | None],
        report: Callable[[HubEventKind, str], object],
        on_drop: Callable[[str, QueuedFrame], object],
        signer: FrameSigner | None = None,
        guard: IdentityGuard | None = None,
        is_read_only: bool = False,
    ) -> None:
        self.link, self.peer = link, peer
        self.counters = counters
        self.endpoint: str = endpoint
        self.min_interval: Callable[[int], float | None] = min_interval
        self.report: Callable[[HubEventKind, str], object] = report
        self.reports_bursts: bool = link.reports_bursts
        self.signer: FrameSigner | None = signer
        self.guard: IdentityGuard | None = guard
        self.is_read_only: bool = is_read_only
        """True if no received frame is forwarded."""
        self.writes_single_frames = False
        """True to write each frame separately, because autopilots read datagrams into small buffers."""
        self.batch: list[bytes] = []
        """Data to write: each element is one frame, or several frames joined."""
        self.ingress: Ingress[Port] | None = None
        self._dialect = dialect
        self._queue_above_bytes = queue_above_bytes
        self._may_queue = queue_above_bytes < UNLIMITED  # False if frames never wait
        self._on_drop = on_drop
        self._queue = FrameQueue()  # frames that wait until the link drains
        self._due: dict[int, float] = {}  # maps keys of rate-limited streams to the time of their next frame

    @property
    def waiting(self) -> int:
        return len(self._queue)

    @property
    def joins_frames(self) -> bool:
        return self.signer is None and not self.writes_single_frames

    def must_queue(self) -> bool:
        return self._may_queue and (bool(self._queue) or self._is_full())

    def enqueue(self, raw: bytes, plan: ForwardingPlan[Port], now: float) -> None:
        kind = self._kind_of(plan.message_id, plan.target)
        self._drop(self._queue.put(QueuedFrame(raw, kind, plan.message_id, plan.target, now), plan.key))

    def _kind_of(self, message_id: int, target: tuple[int, int]) -> MessageKind:
        message_type = self._dialect.get(message_id)
        if message_type is None:  # An unknown message may be part of a transfer, so it is never replaced.
            return MessageKind.TRANSFER
        system_id, _ = target
        return kind_of(message_type.NAME, has_target=system_id != 0)

    def passes_rate_limit(self, key: int, interval_s: float, now: float) -> bool:
        """Return True if the rate limit allows a frame now. Otherwise count the frame as dropped.

        ``key`` identifies the sender and the message.
        """
        due_at = self._due.get(key)
        if due_at is not None and now < due_at:
            self.counters.dropped["rate_limited"] += 1
            return False
        if due_at is None:
            if len(self._due) >= MAX_RATE_LIMITS:
                self._due.clear()  # This bounds the memory. Each message may then be sent once too early.
            self._due[key] = now + interval_s
        else:
            # The next due time is counted from the previous one, so that irregular messages reach the allowed average
            # rate. It is never before now, so that no burst follows a pause.
            self._due[key] = max(due_at, now - interval_s) + interval_s
        return True

    def flush(self, unix_time: float) -> None:
        batch, self.batch = self.batch, []
        if self.signer is not None:
            batch = self._signed(batch, unix_time)
        counters, write, peer = self.counters, self.link.write, self.peer
        counters.frames_out += len(batch)  # `Switch` has counted the further frames of joined pieces.
        is_joined = len(batch) > 1 and not self.writes_single_frames
        for piece in joined(batch) if is_joined else batch:
            counters.bytes_out += len(piece)
            write(piece, peer)

    def drain(self, now: float, unix_time: float) -> None:
        self._drop(self._queue.expire(now))
        while self._queue and not self._is_full():
            raw = self._queue.pop()
            assert raw is not None
            self.batch.append(raw)
            self.flush(unix_time)

    def drop_orders(self) -> None:
        self._drop(self._queue.expire(now=math.inf))

    def drop_late(self, frame: Frame, target: tuple[int, int], arrived_at: float) -> None:
        kind = self._kind_of(frame.message_id, target)
        queued = QueuedFrame(frame.raw, kind, frame.message_id, target, arrived_at)
        self._drop([DroppedFrame("late", queued)])

    def close(self) -> None:
        self._drop(self._queue.clear())
        self.batch.clear()
        self._due.clear()

    def _is_full(self) -> bool:
        return self.link.unsent_bytes_to(self.peer) > self._queue_above_bytes

    def _signed(self, batch: list[bytes], unix_time: float) -> list[bytes]:
        assert self.signer is not None
        signed = [self.signer.sign(raw, unix_time) for raw in batch]
        self.counters.dropped["unsignable"] += signed.count(None)
        return [raw for raw in signed if raw is not None]

    def _drop(self, dropped: list[DroppedFrame]) -> None:
        for reason, frame in dropped:
            self.counters.dropped[reason] += 1
            self._on_drop(reason, frame)


def joined(batch: list[bytes]) -> list[bytes]:
    """Join small pieces to pieces of at most `MAX_JOINED_BYTES`."""
    whole = b"".join(batch)
    if len(whole) <= MAX_JOINED_BYTES:
        return [whole] if whole else []
    chunks: list[bytes] = []
    chunk: list[bytes] = []
    size = 0
    for raw in batch:
        if size + len(raw) > MAX_JOINED_BYTES and chunk:
            chunks.append(b"".join(chunk))
            chunk, size = [], 0
        chunk.append(raw)
        size += len(raw)
    chunks.append(b"".join(chunk))
    return chunks
