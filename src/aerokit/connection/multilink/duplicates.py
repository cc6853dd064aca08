"""``MergedStreams``: merges the frames of the same vehicles that arrive over several links. Sans-IO."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.routes import boot_time_ms
from aerokit.mavlink import messages as m

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.connection.multilink.link_choice import Candidate, LinkChoice
    from aerokit.mavlink.frame import Frame

MAX_REMEMBERED = 4096  # number of remembered frames, enough for 10 s at 400 frames per second

# An equal frame over another link is a copy if it arrives within this time after the first.
COPY_WINDOW_S = 3.0

# Over a slow link, a copy of an accepted frame may arrive this late.
LATE_COPY_WINDOW_S = 10.0

# An equal frame counts as a new frame, not as a copy, if the sender has sent at least this many frames in between.
# Sequence numbers repeat after 256 frames, so the frames may be equal by chance.
COPY_WINDOW_FRAMES = 128


class ReceivedFrame:
    """Record of a frame and its copies."""

    __slots__ = ("_links", "_route_peer_links", "at", "count", "is_admitted", "is_delivered")

    def __init__(self, at: float, count: int, link: int, *, is_other_peer: bool) -> None:
        self.at: float = at
        """Receive time of the first copy."""
        self.count: int = count
        """Number of frames received from the sender up to and including this one. Copies are not counted."""
        self.is_admitted: bool = False
        """True if a copy has passed the signature check."""
        self.is_delivered: bool = False
        # Bit sets of the links over which copies arrived. `_route_peer_links` has only those from the peer to which the
        # sender's route leads, because another peer may be a second sender with the same ids.
        self._links = 1 << link
        self._route_peer_links = 0 if is_other_peer else self._links

    def add(self, link: int, *, is_other_peer: bool) -> None:
        self._links |= 1 << link
        if not is_other_peer:
            self._route_peer_links |= 1 << link

    def has_arrived_over(self, link: int) -> bool:
        return bool(self._links & 1 << link)

    def has_arrived_from_route_peer_over(self, link: int) -> bool:
        return bool(self._route_peer_links & 1 << link)


class Copies:
    """Remembers which frame arrived over which link, and detects copies: equal frames over different links.

    An equal frame over the same link is not a copy. It is a new frame that is equal by chance, because sequence numbers
    wrap around.
    """

    def __init__(self) -> None:
        # The key has body, checksum and signature of the frame.
        self._seen: dict[tuple[bytes, int, bytes], ReceivedFrame] = {}
        self._counts: dict[int, int] = {}  # sender → number of its frames that were not copies
        self.current: ReceivedFrame = ReceivedFrame(-math.inf, 0, 0, is_other_peer=True)
        """Record of the last frame that was passed to :meth:`record`."""
        self.may_be_late_copy: bool = False
        """True if the last frame may be a copy of a frame that was delivered over another link some seconds ago."""

    def record(self, frame: Frame, link: int, *, is_other_peer: bool = False) -> bool:
        """Record a frame. Return True if it is a copy: an equal frame arrived recently, but only over other links.

        ``is_other_peer`` is True if a second sender with the same ids sent the frame.
        """
        sender = frame.component_id << 8 | frame.system_id
        key = frame.body, frame.checksum, frame.signature
        count = self._counts.get(sender, 0)
        earlier = self._seen.get(key)
        self.may_be_late_copy = False
        if earlier is not None:
            age_s = frame.received_at - earlier.at
            is_other_link = not earlier.has_arrived_over(link)
            is_recent = age_s <= COPY_WINDOW_S and count - earlier.count < COPY_WINDOW_FRAMES
            if is_recent and is_other_link:
                earlier.add(link, is_other_peer=is_other_peer)
                self.current = earlier
                return True
            self.may_be_late_copy = is_other_link and earlier.is_delivered and age_s <= LATE_COPY_WINDOW_S
            del self._seen[key]  # The new frame, which is not a copy, takes the place of the earlier one.
        self._counts[sender] = count + 1
        self.current = ReceivedFrame(frame.received_at, count + 1, link, is_other_peer=is_other_peer)
        self._seen[key] = self.current
        if len(self._seen) > MAX_REMEMBERED:
            # Many frames are forgotten at once, because building the list takes time.
            for oldest_key in list(self._seen)[: MAX_REMEMBERED // 4]:
                del self._seen[oldest_key]
        return False


# For this time after a switch to another link, answers to earlier requests may arrive over the previous link.
ANSWER_TIMEOUT_S = 3.0

# A component counts as reachable over a link for this time after its last frame over this link.
COMPONENT_TTL_S = 10.0

MAX_STREAMS = 1024

# Answers to requests. Unlike telemetry, a delayed answer is still valid.
ANSWERS = frozenset(
    message_type.ID
    for message_type in (
        m.CommandAck, m.ParamValue, m.ParamExtValue, m.ParamExtAck, m.MissionCount, m.MissionItem, m.MissionItemInt,
        m.MissionRequest, m.MissionRequestInt, m.MissionAck, m.FileTransferProtocol, m.LogEntry, m.LogData,
    )
)  # fmt: skip

# PX4 sends an acknowledgement over every port on which it received our frames. The second one must not be taken for the
# answer to the next command, so repetitions of these messages are counted.
ACKNOWLEDGEMENTS = frozenset(message_type.ID for message_type in (m.CommandAck, m.MissionAck, m.ParamExtAck))


class _Stream:
    """State of the frames that one component sends over all links."""

    __slots__ = ("acknowledgements", "newest_sequence", "received_at")

    def __init__(self, link_count: int) -> None:
        self.received_at = [-math.inf] * link_count  # time of the last frame over each link
        self.newest_sequence = -1  # sequence number of the newest accepted frame; -1 if there is none
        # Acknowledgement's payload → how often each link delivered it since the last switch to another link.
        self.acknowledgements: dict[bytes, list[int]] = {}

    def has_newer(self, frame: Frame) -> bool:
        """Return True if a frame with a newer sequence number was already accepted."""
        ahead_by = (frame.sequence - self.newest_sequence) & 0xFF
        return self.newest_sequence >= 0 and ahead_by >= 128  # Ahead by half of the 256 numbers or more means behind.

    def count_acknowledgement(self, payload: bytes, link: int) -> bool:
        """Count the arrival of an acknowledgement. Return True if it repeats one that arrived over another link.

        The n-th arrival over this link is a repetition if an equal acknowledgement has arrived over another link at
        least n times since the last switch.
        """
        counts = self.acknowledgements.setdefault(payload, [0] * len(self.received_at))
        counts[link] += 1
        return counts[link] <= max(count for index, count in enumerate(counts) if index != link)


class MergedStreams:
    """Accepts each frame once, whichever copy arrives first.

    If the links lead to different ports of an autopilot, their sequence numbers cannot be compared, because each port
    has its own. Only frames over the link in use are then accepted, apart from late answers and components that this
    link does not reach. ``choices`` has the links to each system.
    """

    def __init__(self, link_count: int, choices: Mapping[int, LinkChoice]) -> None:
        self._link_count, self._choices = link_count, choices
        self._streams: dict[int, _Stream] = {}  # the key is component id << 8 | system id
        self.copies: Copies = Copies()

    def reset(self, system_id: int) -> None:
        self._streams = {key: stream for key, stream in self._streams.items() if key & 0xFF != system_id}

    def is_duplicate(self, frame: Frame, link: int, *, is_other_peer: bool) -> bool:
        """Return True if this frame is a copy of a frame that was delivered over another link."""
        if not self.copies.record(frame, link, is_other_peer=is_other_peer):
            return False
        choice = self._choices.get(frame.system_id)
        # Equal frames with a time since boot prove that their links lead to one vehicle. Other frames, such as
        # heartbeats, may be equal although they come from two vehicles. Frames that the signature check refused do not
        # count, because any sender can send them over two links.
        if choice is not None and boot_time_ms(frame) and self.copies.current.is_admitted:
            self._record_copy(choice, link, frame.received_at)
        if not self.copies.current.is_delivered:
            return False
        self._stream(frame).received_at[link] = frame.received_at
        return True

    def _record_copy(self, choice: LinkChoice, link: int, now: float) -> None:
        """Count the copies of a frame as evidence that their links lead to one vehicle."""
        used, frame = choice.used, self.copies.current
        # Without a copy over the link in use, the frame may come from another vehicle.
        if used is None or used.is_other_hardware or not frame.has_arrived_from_route_peer_over(used.link):
            return
        for candidate in choice.candidates.values():
            # A copy over another link is evidence about that link and the link in use. A copy over the link in use is
            # evidence about each link with an earlier copy.
            may_count = link == used.link or candidate.link in (link, used.link)
            if may_count and frame.has_arrived_from_route_peer_over(candidate.link):
                candidate.record_copy(now)

    def accepts(self, frame: Frame, link: int) -> bool:
        """Return True if this frame, which is not a copy, is to be delivered."""
        stream = self._stream(frame)
        stream.received_at[link] = frame.received_at
        choice = self._choices.get(frame.system_id)
        # No link is chosen for a sender without heartbeats, e.g. a radio. All its frames are accepted.
        if choice is not None and choice.used is not None:
            is_used_link = link == choice.used.link
            if not self._fits_choice(frame, link, choice, stream, is_used_link=is_used_link):
                return False
            # A late answer over an unused link must not lower `newest_sequence`, or older telemetry would be accepted.
            # The link in use always sets it, because a rebooted vehicle begins with any number.
            if is_used_link or not stream.has_newer(frame):
                stream.newest_sequence = frame.sequence
        self.copies.current.is_delivered = True
        return True

    def _fits_choice(self, frame: Frame, link: int, choice: LinkChoice, stream: _Stream, *, is_used_link: bool) -> bool:
        candidate = choice.candidates.get(link)
        if candidate is not None and not choice.may_be_used(candidate):
            return False
        if frame.received_at <= choice.fresh_after and frame.message_id not in ANSWERS:
            return False  # This telemetry may be older than the last telemetry that the previous link delivered.
        # A late frame that equals an accepted one is probably a delayed copy.
        if self.copies.may_be_late_copy and not _may_be_different_frame(frame, link, choice):
            return False
        if not is_used_link and not _accepts_over_unused_link(frame, candidate, choice, stream):
            return False
        is_after_switch = frame.received_at - choice.switched_at <= ANSWER_TIMEOUT_S
        if is_after_switch and frame.message_id in ACKNOWLEDGEMENTS:
            is_repetition = stream.count_acknowledgement(frame.payload, link)
            return is_used_link or not is_repetition
        return True

    def _stream(self, frame: Frame) -> _Stream:
        key = frame.component_id << 8 | frame.system_id
        stream = self._streams.get(key)
        if stream is None:
            if len(self._streams) >= MAX_STREAMS:
                del self._streams[next(iter(self._streams))]
            stream = self._streams[key] = _Stream(self._link_count)
        return stream


def _accepts_over_unused_link(frame: Frame, candidate: Candidate | None, choice: LinkChoice, stream: _Stream) -> bool:
    if candidate is None or choice.used is None:
        return False
    is_answer = frame.message_id in ANSWERS
    if choice.carries_same_stream(candidate, frame.received_at):
        # Both links carry the same stream. The link in use has lost this frame, or delivers it later. Telemetry is
        # refused if a newer frame was already accepted; an answer is valid in any case.
        return is_answer or not stream.has_newer(frame)
    # The links carry separate streams. This frame is needed in two cases: only this link reaches the component, or the
    # frame answers a request from before the switch to the link in use.
    is_on_used_link = frame.received_at - stream.received_at[choice.used.link] <= COMPONENT_TTL_S
    is_after_switch = frame.received_at - choice.switched_at <= ANSWER_TIMEOUT_S
    return not is_on_used_link or (is_answer and candidate is choice.previous and is_after_switch)


def _may_be_different_frame(frame: Frame, link: int, choice: LinkChoice) -> bool:
    """Return True if a frame may be new, although it equals a frame that was accepted earlier."""
    used = choice.used
    if used is None or used.link != link or frame.message_id != m.Heartbeat.ID:
        return False
    # The content of heartbeats rarely changes. If no other link carries the same frames, each link has its own stream
    # of heartbeats, and two of them can be equal by chance.
    return not choice.carries_same_stream(used, frame.received_at)
