"""Faults of a radio link (``FaultModel``), which ``FaultyPath`` applies to the frames of one direction, without I/O."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink.frame import MAGIC_V1, MAGIC_V2, SIGNATURE_LENGTH, SIGNED

_SHARES = ("loss", "duplication", "reordering", "corruption")
_SECONDS = ("delay_s", "jitter_s", "overtaken_s")
_MAX_SECONDS = 3600.0


class FaultModel(Snapshot):
    """Faults of one direction of a radio link. By default, there are no faults.

    Shares are probabilities from 0 to 1. Each fault is drawn for each frame, independently of other faults.

    Raises InvalidArgument for a value out of range.
    """

    loss: float = 0.0
    """Share of lost frames."""
    duplication: float = 0.0
    """Share of frames that arrive twice. The copy follows the frame at once."""
    reordering: float = 0.0
    """Share of frames that are delayed, so that later frames overtake them."""
    corruption: float = 0.0
    """Share of frames in which one to eight bits are flipped."""
    delay_s: float = 0.0
    """Latency in seconds."""
    jitter_s: float = 0.0
    """Maximum of a random delay in seconds, which is added to ``delay_s``. Frames keep their order, as in a queue."""
    overtaken_s: float = 0.05
    """Additional delay in seconds of the frames that are reordered."""
    bandwidth: float = math.inf
    """Bytes per second, for example 5,760 for a serial line of 57,600 baud. Frames wait in a queue until they fit."""
    queue_bytes: float = math.inf
    """Size of the queue in bytes. Frames that do not fit are dropped. Telemetry radios have about 4,000 bytes."""
    outages: tuple[tuple[float, float], ...] = ()
    """Intervals (begin, end), in seconds since the link was opened, in which all frames are lost."""
    per_frame: bool = True
    """True to apply the faults to each MAVLink frame, as a radio does; False to apply them to whole datagrams."""

    def _check(self) -> None:
        for name in _SHARES:
            _check_number(name, getattr(self, name), 1.0)
        for name in _SECONDS:
            _check_number(name, getattr(self, name), _MAX_SECONDS)
        for name in ("bandwidth", "queue_bytes"):
            if not getattr(self, name) > 0:
                raise InvalidArgument(f"{name} = {getattr(self, name)!r} is not allowed: it must be above 0")
        for begin, end in self.outages:
            if not begin <= end:
                raise InvalidArgument(
                    f"outages: ({begin!r}, {end!r}) is not allowed: an outage must not end before it begins"
                )


class Air:
    """A transmission medium that carries one frame at a time. A half-duplex link has one medium for both directions."""

    def __init__(self) -> None:
        self.busy_until: float = -math.inf


class FaultyPath:
    """Applies faults to one direction of a link. The same model, seed, frames and times produce the same faults.

    - ``frames``, ``bytes``: everything that was sent.
    - ``overflowed``: frames that did not fit into the queue of `FaultModel.queue_bytes`.
    - ``lost``: other frames that did not arrive, including those during outages.
    - ``duplicated``, ``reordered``, ``corrupted``: arriving frames with these faults.
    """

    def __init__(self, model: FaultModel, seed: object = 0, air: Air | None = None) -> None:
        self.model = model
        """Faults of this direction. The model may be replaced at any time."""
        self.frames: int = 0
        self.bytes: int = 0
        self.lost: int = 0
        self.overflowed: int = 0
        self.duplicated: int = 0
        self.reordered: int = 0
        self.corrupted: int = 0
        self._chance = random.Random(repr(seed)).random  # decides which frames have a fault
        self._bits = random.Random(repr((seed, "bits")))  # selects the bits to flip
        self._air = Air() if air is None else air
        self._started_at: float | None = None  # time 0 of the outages; None before `start`
        self._latest_due = -math.inf  # arrival of the last frame that was not reordered

    def start(self, now: float) -> None:
        """Start the clock of the outages. Without this call, it starts at the first frame."""
        self._started_at = now

    def carry(self, data: bytes, now: float) -> list[tuple[float, bytes]]:
        """Carry a write or datagram. Return what arrives as (arrival time, bytes), in the order of sending."""
        if self._started_at is None:
            self.start(now)
        arrivals: list[tuple[float, bytes]] = []
        for frame in split_frames(data) if self.model.per_frame else [data]:
            arrivals += self._carry_frame(bytes(frame), now)
        return arrivals

    def _carry_frame(self, frame: bytes, now: float) -> list[tuple[float, bytes]]:
        # Draw five random numbers for every frame, even for a lost frame. A change of one probability then leaves the
        # other faults at the same frames.
        model = self.model
        chance = self._chance
        is_lost = chance() < model.loss
        is_duplicated = chance() < model.duplication
        is_reordered = chance() < model.reordering
        is_corrupted = chance() < model.corruption
        jitter_s = chance() * model.jitter_s
        self.frames += 1
        self.bytes += len(frame)
        sent_at = self._transmit(len(frame), now)
        if sent_at is None:
            self.overflowed += 1
            return []
        if is_lost or self._is_outage(sent_at):
            self.lost += 1
            return []
        if is_corrupted:
            frame = self._corrupt(frame)
        due = sent_at + model.delay_s + jitter_s
        if is_reordered:
            self.reordered += 1
            due += model.overtaken_s
        else:  # Jitter alone must not change the order.
            due = max(due, self._latest_due)
            self._latest_due = due
        if is_duplicated:
            self.duplicated += 1
            return [(due, frame), (due, frame)]
        return [(due, frame)]

    def _transmit(self, size: int, now: float) -> float | None:
        """Return the time at which the last byte of a frame is sent; None if the queue is full."""
        model = self.model
        air = self._air
        begin = max(now, air.busy_until)
        if math.isinf(model.bandwidth):  # Sending takes no time.
            return begin
        queued_bytes = (begin - now) * model.bandwidth
        # An empty queue accepts every frame, even if the frame is larger than the queue.
        if queued_bytes > 0 and queued_bytes + size > model.queue_bytes:
            return None
        air.busy_until = begin + size / model.bandwidth
        return air.busy_until

    def _is_outage(self, time: float) -> bool:
        elapsed_s = time - (self._started_at or 0.0)
        return any(begin_s <= elapsed_s < end_s for begin_s, end_s in self.model.outages)

    def _corrupt(self, frame: bytes) -> bytes:
        self.corrupted += 1
        damaged = bytearray(frame)
        for _ in range(self._bits.randint(1, 8) if damaged else 0):
            bit = self._bits.randrange(len(damaged) * 8)
            damaged[bit // 8] ^= 1 << (bit % 8)
        return bytes(damaged)


def split_frames(data: bytes) -> Sequence[bytes]:
    """Split a write or datagram into MAVLink frames.

    The last piece may be an incomplete frame or other data. Checksums are not checked.
    """
    pieces: list[bytes] = []
    size = len(data)
    begin = 0
    while begin < size:
        end_of_frame = _end_of_frame(data, begin)
        # If no complete frame begins here, the piece extends to the end of the data.
        end = size if end_of_frame is None else min(end_of_frame, size)
        pieces.append(data[begin:end])
        begin = end
    return pieces or [data]


def _end_of_frame(data: bytes, begin: int) -> int | None:
    """Return the end of the frame that begins at ``begin``; None if no frame begins there."""
    # The header begins with the magic byte, the payload length and (in MAVLink 2) the flags.
    has_length = len(data) >= begin + 3
    if not has_length or data[begin] not in (MAGIC_V1, MAGIC_V2):
        return None
    magic, payload_length, flags = data[begin : begin + 3]
    if magic == MAGIC_V1:
        return begin + 6 + payload_length + 2  # 6 bytes of header and 2 bytes of checksum
    signature_length = SIGNATURE_LENGTH if flags & SIGNED else 0
    return begin + 10 + payload_length + 2 + signature_length  # 10 bytes of header and 2 bytes of checksum


def _check_number(name: str, value: float, high: float) -> None:
    if not 0.0 <= value <= high:
        raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be 0 to {high:g}")
