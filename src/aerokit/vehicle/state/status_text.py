"""Assembles status texts from STATUSTEXT messages, and keeps recent texts to explain failures."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from aerokit.autopilots.failsafes import failsafe_kind
from aerokit.vehicle.state.condition import StatusText

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.mavlink.messages import Statustext

__all__ = ["StatusTextAssembler"]

CHUNK_LENGTH = 50
"""Number of bytes of text in one STATUSTEXT."""
CHUNK_TIMEOUT_S = 2.0
"""Seconds to wait for the next chunk of a text."""
MAX_RECENT_TEXTS = 64
# Maximum number of chunks of one text. A text with more chunks is invalid, and becomes several texts.
MAX_CHUNKS = 20
# Maximum number of incomplete texts of all components together. Beyond it, the oldest text is discarded.
MAX_OPEN = 16
ELLIPSIS = "…"

_Sender = tuple[int, int]
"""System id and component id."""


class StatusTextAssembler:
    """Joins the chunks of long texts (https://mavlink.io/en/messages/common.html#STATUSTEXT).

    A text ends with the first chunk that is not full. If a chunk is missing, or the next chunk does not arrive within
    two seconds, the text has "…" in place of the missing part. Trailing whitespace is removed.
    """

    def __init__(self) -> None:
        # Maps the sender and the id of a text to the chunks received so far.
        self._incomplete: dict[tuple[_Sender, int], _IncompleteText] = {}
        self._recent: deque[StatusText] = deque(maxlen=MAX_RECENT_TEXTS)
        # Texts about failsafes, which other texts must not displace while the failsafe is active.
        self._failsafes: deque[StatusText] = deque(maxlen=MAX_RECENT_TEXTS)

    def receive(self, message: Statustext, now: float, *, joins_id_0: bool = False) -> list[StatusText]:
        """Add one message. Return the texts that are complete or truncated now.

        By the standard, a text with the id 0 has a single chunk. ``joins_id_0`` is True if the autopilot also splits
        texts with this id.
        """
        truncated_texts = self.expire(now)
        chunk = _bytes_of(message)
        if message.id == 0 and not joins_id_0:
            texts = [StatusText(message.severity, _text(chunk), now)]
        else:
            texts = self._add_chunk(message, chunk, now)
        self._store(texts)
        return truncated_texts + texts

    def expire(self, now: float) -> list[StatusText]:
        """Remove and return incomplete texts, if their next chunk is overdue."""
        overdue = [key for key, text in self._incomplete.items() if now - text.last_chunk_at > CHUNK_TIMEOUT_S]
        texts = [self._incomplete.pop(key).truncated(now) for key in overdue]
        self._store(texts)
        return texts

    def recent(self, since: float = float("-inf")) -> tuple[StatusText, ...]:
        """Return the last texts (64 at most) received at or after ``since``, oldest first."""
        return tuple(text for text in self._recent if text.at >= since)

    def about_failsafes(self) -> tuple[StatusText, ...]:
        """Return the last texts (64 at most) about failsafes and problems, received since the last failsafe ended."""
        return tuple(self._failsafes)

    def clear_failsafes(self) -> None:
        self._failsafes.clear()

    def clear(self) -> None:
        self._incomplete.clear()
        self._recent.clear()
        self.clear_failsafes()

    def _store(self, texts: Iterable[StatusText]) -> None:
        for text in texts:
            self._recent.append(text)
            if failsafe_kind(text.text):
                self._failsafes.append(text)

    def _add_chunk(self, message: Statustext, chunk: bytes, now: float) -> list[StatusText]:
        """Add a chunk, and return the texts that are complete or truncated now."""
        ended_texts: list[StatusText] = []
        key = (_sender(message), message.id)
        text = self._incomplete.get(key)
        if text is not None and message.chunk_seq < text.next_seq:
            if message.chunk_seq == text.next_seq - 1 and text.last_chunk == chunk:
                # A router has forwarded this chunk twice. Copies that arrive over another link are dropped earlier, by
                # `MergedStreams`.
                return []
            # A new text with the same id begins, so the end of the previous text was lost.
            ended_texts.append(self._incomplete.pop(key).truncated(now))
            text = None
        if text is None:
            text = self._begin_text(key, message.severity)
        text.add(message.chunk_seq, chunk, now)
        if len(chunk) < CHUNK_LENGTH or text.next_seq >= MAX_CHUNKS:
            ended_texts.append(self._incomplete.pop(key).complete(now))
        return ended_texts

    def _begin_text(self, key: tuple[_Sender, int], severity: int) -> _IncompleteText:
        while len(self._incomplete) >= MAX_OPEN:
            del self._incomplete[next(iter(self._incomplete))]  # the oldest
        text = self._incomplete[key] = _IncompleteText(severity)
        return text


class _IncompleteText:
    """A text whose end has not arrived yet, made of the chunks received so far."""

    last_chunk: bytes
    last_chunk_at: float

    def __init__(self, severity: int) -> None:
        self.severity = severity
        self.next_seq = 0  # the expected number of the next chunk
        self._parts: list[bytes] = []

    def add(self, seq: int, chunk: bytes, now: float) -> None:
        if seq > self.next_seq:
            # Chunks before this one are missing.
            self._parts.append(ELLIPSIS.encode())
        self._parts.append(chunk)
        self.next_seq = seq + 1
        self.last_chunk = chunk
        self.last_chunk_at = now

    def complete(self, now: float) -> StatusText:
        return StatusText(self.severity, _text(b"".join(self._parts)), now)

    def truncated(self, now: float) -> StatusText:
        return StatusText(self.severity, _text(b"".join(self._parts)) + ELLIPSIS, now)


def _sender(message: Statustext) -> _Sender:
    frame = message.received_frame
    return (0, 0) if frame is None else (frame.system_id, frame.component_id)


def _bytes_of(message: Statustext) -> bytes:
    # A multi-byte character may be split between two chunks, so a chunk cannot be decoded alone.
    frame = message.received_frame
    # In the payload, the text follows one byte for the severity.
    data = message.text.encode() if frame is None else frame.payload[1 : 1 + CHUNK_LENGTH]
    return data.split(b"\0")[0]


def _text(data: bytes) -> str:
    return data.decode(errors="replace").rstrip()
