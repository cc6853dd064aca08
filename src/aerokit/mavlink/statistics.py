"""What a framer counts: `FramerStatistics`, and per sender `SourceStatistics` with the frames that were lost."""

from __future__ import annotations

__all__ = ["FramerStatistics", "SourceStatistics"]

_MOST_UNKNOWN = 64
_HALF = 128  # a counter that is more than this behind is late, not lost


class SourceStatistics:
    """One sender, (system, component): how many of its frames came, and how many did not."""

    __slots__ = (
        "_late_at",
        "_late_sequence",
        "_missing",
        "_without",
        "component_id",
        "expected",
        "lost",
        "system_id",
    )

    def __init__(self, system_id: int, component_id: int, sequence: int) -> None:
        self.system_id = system_id
        self.component_id = component_id
        self.lost = 0
        """Frames missing in the sequence; one that comes late after all is taken off again."""
        self.expected = sequence
        """The sequence number of the next frame; its low byte is what is on the wire, it counts on beyond 255."""
        # How far `expected` has come without a frame: then a frame costs one addition.
        self._without = sequence
        self._missing: dict[int, int] = {}  # sequence number → value of `received` when it was missed
        self._late_sequence = self._late_at = -1

    @property
    def received(self) -> int:
        """Frames that came, whether anyone wanted them or not."""
        return self.expected - self._without

    @property
    def loss(self) -> float:
        """Share of frames lost, 0..1."""
        total = self.received + self.lost
        return self.lost / total if total else 0.0

    def out_of_order(self, sequence: int) -> None:
        """A frame came whose sequence number is not `expected`: a gap, a late one, a double or a reboot."""
        ahead = (sequence - self.expected) & 0xFF
        if ahead < _HALF:
            self._gap(ahead)
            return
        self._without -= 1
        if self._was_missing(sequence):
            self.lost -= 1
        elif sequence == (self._late_sequence + 1) & 0xFF and self._late_at == self.received - 1:
            self.skip((sequence + 1 - self.expected) & 0xFF)  # two in a row: it counts anew after a reboot
            self._missing.clear()
        else:
            self._late_sequence, self._late_at = sequence, self.received

    def skip(self, count: int) -> None:
        """Let ``count`` numbers pass that are neither received nor lost: of messages that cannot be checked."""
        self.expected += count
        self._without += count

    def _gap(self, ahead: int) -> None:
        self.lost += ahead
        for missed in range(self.expected, self.expected + ahead):
            self._missing[missed & 0xFF] = self.received
        self.skip(ahead)
        self.expected += 1

    def _was_missing(self, sequence: int) -> bool:
        missed_at = self._missing.pop(sequence, None)
        return missed_at is not None and self.received - missed_at < _HALF

    def __repr__(self) -> str:
        return f"<{self.system_id}/{self.component_id}: {self.received} received, {self.lost} lost>"


class FramerStatistics:
    """Counters of one framer since it was made; every byte is in a frame, in an unknown one, bad, or still waiting."""

    __slots__ = ("bad_bytes", "bad_crcs", "bytes", "sources", "unknown_ids", "unknown_messages")

    def __init__(self) -> None:
        self.bytes = 0
        """Bytes taken in."""
        self.bad_bytes = 0
        """Bytes that belong to no frame: text, noise, damaged frames."""
        self.bad_crcs = 0
        """Places that looked like a frame of a known message, but for the checksum."""
        self.unknown_ids = 0
        """Frames, as far as one can tell, of messages this dialect does not know; their checksum cannot be checked."""
        self.unknown_messages: dict[int, int] = {}
        """Message id → how many of these frames; of the first 64 ids, because noise could name any number."""
        self.sources: dict[tuple[int, int], SourceStatistics] = {}
        """(system id, component id) → what came from there."""

    @property
    def frames(self) -> int:
        """Frames whose checksum was right, wanted or not."""
        return sum(source.received for source in self.sources.values())

    def unknown(self, message_id: int) -> None:
        """Count a frame of an unknown message."""
        self.unknown_ids += 1
        seen = self.unknown_messages
        if message_id in seen or len(seen) < _MOST_UNKNOWN:
            seen[message_id] = seen.get(message_id, 0) + 1

    def __repr__(self) -> str:
        names = ("bytes", "frames", "bad_bytes", "bad_crcs", "unknown_ids")
        return f"<FramerStatistics {', '.join(f'{name}={getattr(self, name)}' for name in names)}>"
