"""Two links joined in memory: for tests and for a simulated vehicle in the same program."""

from __future__ import annotations

import asyncio
from collections import deque

from aerokit.transport.link import BaseLink, Peer


def memory_link_pair(*, latency_s: float = 0.0) -> tuple[MemoryLink, MemoryLink]:
    """Two links, each the other's only peer; both are to be opened on the same event loop.

    Each write arrives as one piece, in order, ``latency_s`` seconds later and never before `Link.write` has
    returned. What arrives at an end that is not open is dropped, as with UDP. When one end closes, the other
    is lost after it has received what was written before.
    """
    near, far = MemoryLink("memory:near", latency_s), MemoryLink("memory:far", latency_s)
    near._far, far._far = far, near
    return near, far


class MemoryLink(BaseLink):
    """One end of `memory_link_pair`."""

    def __init__(self, address: str, latency_s: float = 0.0) -> None:
        super().__init__(address)
        self._latency_s = latency_s
        self._far: MemoryLink | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._inbox: deque[tuple[float, bytes | None]] = deque()  # (due, data); None: the far end has closed
        self._wake_up: asyncio.Handle | None = None

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; the far end hears it on a later turn of the loop."""
        if self._receiver is not None and self._far is not None:
            self._far._post(bytes(data), self)

    async def _connect(self) -> None:
        self._loop = asyncio.get_running_loop()

    def _release(self) -> None:
        if self._wake_up is not None:
            self._wake_up.cancel()
        self._wake_up = None
        self._inbox.clear()
        opened, self._loop = self._loop is not None, None
        if opened and self._far is not None:
            self._far._post(None, self)

    def _post(self, data: bytes | None, sender: MemoryLink) -> None:
        if self._loop is None or self._receiver is None:
            sender.dropped_writes += data is not None
            return
        self._inbox.append((self._loop.time() + self._latency_s, data))
        if self._wake_up is None:
            self._schedule(self._loop)

    def _schedule(self, loop: asyncio.AbstractEventLoop) -> None:
        if not loop.is_closed():
            due = self._inbox[0][0]
            self._wake_up = (
                loop.call_at(due, self._arrive) if self._latency_s else loop.call_soon(self._arrive)
            )

    def _arrive(self) -> None:
        """Hands over what is due; what is written meanwhile waits for the next turn of the loop."""
        self._wake_up = None
        if self._loop is None or not self._inbox:
            return
        now = max(self._loop.time(), self._inbox[0][0])  # a timer may fire a hair early
        due = 1 if len(self._inbox) == 1 else sum(when <= now for when, _ in self._inbox)
        for _ in range(due):
            if not self._inbox:  # closed by the receiver
                return
            _, data = self._inbox.popleft()
            if data is None:
                self._lose("the other end was closed")
            else:
                self._deliver(data)
        if self._inbox and self._wake_up is None:
            self._schedule(self._loop)
