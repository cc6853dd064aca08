"""``Copies``: a frame that came over another link already is not taken again."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame

__all__ = ["Copies"]

MOST = 4096
"""So many frames are remembered: 10 s of 400 frames a second."""
WINDOW_S = 3.0
"""A copy comes no later than this."""
LATE_S = 10.0
"""Nor does what is later than that, by time or by number, and is the same: a link that began to be slow brings it."""
SAME_NUMBER_AFTER = 128
"""Numbers come again after 256 frames: after half of them a frame with the same bytes is another one."""


class _Seen:
    __slots__ = ("at", "count", "is_admitted", "is_taken", "links")

    def __init__(self, at: float, links: int, count: int) -> None:
        self.at, self.links = at, links  # a bit for each link
        self.count = count  # how many frames of the sender there were then
        self.is_admitted = self.is_taken = False


class Copies:
    """Remembers what came over which link.

    What came twice over the same link is no copy: the sender sent it twice, or its numbers have come round.
    """

    def __init__(self) -> None:
        self._seen: dict[tuple[bytes, int, bytes], _Seen] = {}
        self._counts: dict[int, int] = {}  # of each sender: its frames that were no copies
        self._present: _Seen | None = None
        self.is_late: bool = False
        """Whether the frame last asked about, which is no copy, was taken seconds ago, when it came over another link;
        or one with the same bytes."""

    def is_copy(self, frame: Frame, link: int) -> bool:
        """Whether exactly this frame came over another link within the last seconds, and not over this one."""
        sender = frame.component_id << 8 | frame.system_id
        key = frame.body, frame.checksum, frame.signature
        count = self._counts.get(sender, 0)
        before, bit = self._seen.get(key), 1 << link
        self.is_late = False
        if before is not None:
            age_s, is_elsewhere = frame.received_at - before.at, not before.links & bit
            is_near = age_s <= WINDOW_S and count - before.count < SAME_NUMBER_AFTER
            if is_near and is_elsewhere:
                before.links |= bit
                self._present = before
                return True
            self.is_late = is_elsewhere and before.is_taken and age_s <= LATE_S
            del self._seen[key]
        self._counts[sender] = count + 1
        self._present = self._seen[key] = _Seen(frame.received_at, bit, count + 1)
        if len(self._seen) > MOST:
            for old in list(self._seen)[: MOST // 4]:
                del self._seen[old]
        return False

    @property
    def was_taken(self) -> bool:
        """Whether the frame last asked about was taken when it came the first time."""
        return self._present is not None and self._present.is_taken

    @property
    def was_admitted(self) -> bool:
        """Whether the signature of the frame last asked about was found good when it came the first time."""
        return self._present is not None and self._present.is_admitted

    def admit(self) -> None:
        """The signature of the frame last asked about is good: a copy of it is not played again."""
        if self._present is not None:
            self._present.is_admitted = True

    def take(self) -> None:
        """The frame last asked about is taken."""
        if self._present is not None:
            self._present.is_taken = True
