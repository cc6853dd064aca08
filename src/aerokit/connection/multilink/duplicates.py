"""``MergedStreams``: of what comes over several links from the same vehicles, what is taken.

Sans-IO: frames come in with their time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.routes import boot_time_ms
from aerokit.mavlink import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.multilink.link_choice import Candidate, LinkChoice
    from aerokit.mavlink.frame import Frame

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


ANSWERS_WITHIN_S = 3.0
"""After a change what was asked over the former link is still answered over it."""

LIVES_S = 10.0
"""A component is taken for one behind a link for so long after something of it came there."""

MOST_SOURCES = 1024

ANSWERS = frozenset(
    each.ID
    for each in (
        m.CommandAck, m.ParamValue, m.ParamExtValue, m.ParamExtAck, m.MissionCount, m.MissionItem, m.MissionItemInt,
        m.MissionRequest, m.MissionRequestInt, m.MissionAck, m.FileTransferProtocol, m.LogEntry, m.LogData,
    )
)  # fmt: skip
"""What is no state of the vehicle: it does not grow old on its way."""

ACKNOWLEDGEMENTS = frozenset(each.ID for each in (m.CommandAck, m.MissionAck, m.ParamExtAck))
"""Of these PX4 sends one over each port where it has seen us: the second one would answer the next order."""


class _Stream:
    """The frames of one component."""

    __slots__ = ("acknowledgements", "heard_at", "newest")

    def __init__(self, links: int) -> None:
        self.heard_at = [-math.inf] * links
        self.newest = -1  # number of the newest frame that was taken; -1: none
        # Which have come how often over each link since the change, as long as the former one is listened to.
        self.acknowledgements: dict[bytes, list[int]] = {}

    def has_come(self, payload: bytes, link: int) -> bool:
        """Whether this acknowledgement came over another link as often as it has come over this one, by now."""
        counts = self.acknowledgements.setdefault(payload, [0] * len(self.heard_at))
        counts[link] += 1
        return counts[link] <= max(count for other, count in enumerate(counts) if other != link)


class MergedStreams:
    """Exactly the same frame is taken once, whichever copy comes first.

    Where two links carry streams of their own (two ports of an autopilot number their frames apart), only what comes
    over the link in use is taken: what came over the other one may be older. ``choices`` has the links to each system.
    """

    def __init__(self, links: int, choices: Mapping[int, LinkChoice]) -> None:
        self._count, self._choices = links, choices
        self._streams: dict[int, _Stream] = {}
        self.copies: Copies = Copies()

    def begin_anew(self, system_id: int) -> None:
        """Another link is used for this system: nothing is known of what comes over it."""
        self._streams = {key: each for key, each in self._streams.items() if key & 0xFF != system_id}

    def was_taken(self, frame: Frame, link: int) -> bool:
        """Whether this frame has come over another link already, and was taken."""
        if not self.copies.is_copy(frame, link):
            return False
        choice = self._choices.get(frame.system_id)
        # A heartbeat is like another one, also of another vehicle.
        if choice is not None and boot_time_ms(frame):
            for each in {link, -1 if choice.used is None else choice.used.link}:
                if (candidate := choice.candidates.get(each)) is not None:
                    candidate.note_copy(frame.received_at)
        if not self.copies.was_taken:
            return False
        self._stream(frame).heard_at[link] = frame.received_at
        return True

    def takes(self, frame: Frame, link: int) -> bool:
        """Whether a frame that was not taken yet is to be delivered."""
        stream = self._stream(frame)
        stream.heard_at[link] = frame.received_at
        choice = self._choices.get(frame.system_id)
        if choice is None or choice.used is None:
            self.copies.take()
            return True  # of somebody who sends no heartbeats: a radio
        candidate = choice.candidates.get(link)
        if candidate is not None and not choice.may_be_used(candidate):
            return False
        if frame.received_at <= choice.fresh_after and frame.message_id not in ANSWERS:
            return False
        if self.copies.is_late and not _may_be_alike(frame, link, choice):
            return False
        if link != choice.used.link and not _is_taken_beside(frame, candidate, choice, stream):
            return False
        is_soon = frame.received_at - choice.changed_at <= ANSWERS_WITHIN_S
        if is_soon and frame.message_id in ACKNOWLEDGEMENTS:
            has_come = stream.has_come(frame.payload, link)
            if has_come and link != choice.used.link:
                return False
        stream.newest = frame.sequence
        self.copies.take()
        return True

    def _stream(self, frame: Frame) -> _Stream:
        key = frame.component_id << 8 | frame.system_id
        stream = self._streams.get(key)
        if stream is None:
            if len(self._streams) >= MOST_SOURCES:
                del self._streams[next(iter(self._streams))]
            stream = self._streams[key] = _Stream(self._count)
        return stream


def _is_taken_beside(frame: Frame, candidate: Candidate | None, choice: LinkChoice, stream: _Stream) -> bool:
    """Whether it is taken although it came over a link that is not in use."""
    if candidate is None or choice.used is None:
        return False
    is_answer = frame.message_id in ANSWERS
    if choice.is_shared(candidate, frame.received_at):
        is_late = stream.newest >= 0 and (frame.sequence - stream.newest) & 0xFF >= 128
        return is_answer or not is_late
    lives_there = frame.received_at - stream.heard_at[choice.used.link] <= LIVES_S
    is_soon = frame.received_at - choice.changed_at <= ANSWERS_WITHIN_S
    return not lives_there or (is_answer and candidate is choice.former and is_soon)


def _may_be_alike(frame: Frame, link: int, choice: LinkChoice) -> bool:
    """Whether it is another frame than the one with the same bytes: of streams apart, heartbeats are."""
    candidate = choice.used
    if candidate is None or candidate.link != link or frame.message_id != m.Heartbeat.ID:
        return False
    return not choice.is_shared(candidate, frame.received_at)
