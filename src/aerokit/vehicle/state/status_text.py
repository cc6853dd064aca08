"""STATUSTEXT: joins chunks, removes padding, and keeps recent texts to explain failures."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from aerokit.vehicle.state.condition import StatusText

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.mavlink.messages import Statustext

__all__ = ["StatusTextAssembler"]

CHUNK_LENGTH = 50
"""Bytes of text in one STATUSTEXT."""
CHUNK_TIMEOUT_S = 2.0
MAX_RECENT_TEXTS = 64
# Maximum chunks of one text; a longer text is invalid and passed on in parts.
MAX_CHUNKS = 20
# Maximum number of incomplete texts of all components.
MAX_OPEN = 16
ELLIPSIS = "…"

_Sender = tuple[int, int]


class StatusTextAssembler:
    """Joins the chunks of long texts (https://mavlink.io/en/messages/common.html#STATUSTEXT).

    A text ends with the first chunk that is not full. If a chunk is missing, or the end does not arrive within two
    seconds, the text is passed on with "…" in place of the missing part. Trailing tabs and spaces are removed.
    """

    def __init__(self) -> None:
        self._open: dict[tuple[_Sender, int], _OpenText] = {}
        self._recent: deque[StatusText] = deque(maxlen=MAX_RECENT_TEXTS)

    def receive(self, message: Statustext, now: float) -> list[StatusText]:
        """Process one message and return the texts that are complete now."""
        late = self.expire(now)
        chunk = _bytes_of(message)
        if message.id == 0:
            texts = [StatusText(message.severity, _text(chunk), now)]
        else:
            texts = list(self._take_chunk(message, chunk, now))
        self._recent.extend(texts)
        return late + texts

    def expire(self, now: float) -> list[StatusText]:
        """Return the incomplete texts whose next chunk has not arrived for two seconds."""
        late = [key for key, text in self._open.items() if now - text.touched_at > CHUNK_TIMEOUT_S]
        texts = [self._open.pop(key).cut(now) for key in late]
        self._recent.extend(texts)
        return texts

    def recent(self, since: float = float("-inf")) -> tuple[StatusText, ...]:
        """Return the last texts (64 at most) received at or after ``since``, oldest first."""
        return tuple(text for text in self._recent if text.at >= since)

    def clear(self) -> None:
        """Discard incomplete and recent texts."""
        self._open.clear()
        self._recent.clear()

    def _take_chunk(self, message: Statustext, chunk: bytes, now: float) -> Iterator[StatusText]:
        key = (_sender(message), message.id)
        text = self._open.get(key)
        if text is not None and message.chunk_seq < text.next_seq:
            if message.chunk_seq == text.next_seq - 1 and text.last_chunk == chunk:
                return  # The same frame, received by another link.
            yield self._open.pop(key).cut(now)
            text = None
        if text is None:
            text = self._open_text(key, message.severity)
        text.add(message.chunk_seq, chunk, now)
        if len(chunk) < CHUNK_LENGTH or text.next_seq >= MAX_CHUNKS:
            yield self._open.pop(key).whole(now)

    def _open_text(self, key: tuple[_Sender, int], severity: int) -> _OpenText:
        while len(self._open) >= MAX_OPEN:
            del self._open[next(iter(self._open))]
        text = self._open[key] = _OpenText(severity)
        return text


class _OpenText:
    """The chunks received of one text, at least one."""

    last_chunk: bytes
    touched_at: float

    def __init__(self, severity: int) -> None:
        self.severity = severity
        self.next_seq = 0
        self._parts: list[bytes] = []

    def add(self, seq: int, chunk: bytes, now: float) -> None:
        if seq > self.next_seq:
            self._parts.append(ELLIPSIS.encode())
        self._parts.append(chunk)
        self.next_seq, self.last_chunk, self.touched_at = seq + 1, chunk, now

    def whole(self, now: float) -> StatusText:
        return StatusText(self.severity, _text(b"".join(self._parts)), now)

    def cut(self, now: float) -> StatusText:
        return StatusText(self.severity, _text(b"".join(self._parts)) + ELLIPSIS, now)


def _sender(message: Statustext) -> _Sender:
    frame = message.received_frame
    return (0, 0) if frame is None else (frame.system_id, frame.component_id)


def _bytes_of(message: Statustext) -> bytes:
    """Return the text as sent: a multi-byte character may be split between two chunks."""
    frame = message.received_frame
    data = message.text.encode() if frame is None else frame.payload[1 : 1 + CHUNK_LENGTH]
    return data.split(b"\0")[0]


def _text(data: bytes) -> str:
    return data.decode(errors="replace").rstrip()
