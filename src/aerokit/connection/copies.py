"""`CopyFilter`: recognises the frames of commands and answers that a link has duplicated."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame

# A frame is a copy if an equal frame arrived at most this long before, and fewer than `COPY_WINDOW_FRAMES` frames of
# the sender arrived in between. Sequence numbers repeat after 256 frames, so a new frame may be equal by chance.
# `COPY_WINDOW_FRAMES` is below 256, because the frames of one read are counted before the first of them is delivered.
COPY_WINDOW_S = 1.0
COPY_WINDOW_FRAMES = 192
# If a HEARTBEAT of the last seconds has the sequence number of a frame, the sender does not count its frames.
HEARTBEAT_WINDOW_S = 2.0


class CopyFilter:
    """Remembers the last ``max_frames`` different frames."""

    def __init__(self, connection: Connection, max_frames: int) -> None:
        self._connection, self._max_frames = connection, max_frames
        # By body, in the order of arrival: the first of equal frames, and the number of the sender's frames by then.
        self._recent: dict[bytes, tuple[Frame, int]] = {}

    def is_copy(self, frame: Frame) -> bool:
        """Record a frame. Return True if an equal frame has just arrived, because the link duplicates frames."""
        received = self._connection.received_from(frame.system_id, frame.component_id)
        # If no equal frame is remembered, `earlier` is the frame itself.
        earlier, received_by_earlier = self._recent.get(frame.body, (frame, received))
        is_recent = (
            earlier is not frame
            and frame.received_at - earlier.received_at <= COPY_WINDOW_S
            and received - received_by_earlier < COPY_WINDOW_FRAMES
        )
        if is_recent and not self._has_constant_sequence(frame):
            return True  # A copy is not recorded, because it would prolong the time in which others count as copies.
        self._recent.pop(frame.body, None)
        self._recent[frame.body] = frame, received
        if len(self._recent) > self._max_frames:
            del self._recent[next(iter(self._recent))]
        return False

    def _has_constant_sequence(self, frame: Frame) -> bool:
        """Return True if the sender's sequence number is constant, so that its equal frames need not be copies."""
        heartbeat = self._connection.heartbeats.get((frame.system_id, frame.component_id))
        heartbeat_frame = None if heartbeat is None else heartbeat.received_frame
        if heartbeat_frame is None or frame.received_at - heartbeat_frame.received_at > HEARTBEAT_WINDOW_S:
            return False
        return heartbeat_frame.sequence == frame.sequence
