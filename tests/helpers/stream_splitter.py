"""A router on board that copies one stream of the autopilot onto several radios."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AsyncExitStack

from aerokit.errors import LinkLost
from aerokit.transport import MemoryLink, Peer, memory_link_pair


class Splitter:
    """One stream of the autopilot copied onto several radios, as a router on board does it."""

    def __init__(self, far: Sequence[MemoryLink]) -> None:
        self.port, self._inside = memory_link_pair()
        self._far = far
        self.keeps_peers = False

    async def open(self, stack: AsyncExitStack) -> None:
        """Begin to copy; everything is closed with the stack."""
        splitter = self

        class FromRadio:
            def bytes_received(self, data: bytes, peer: Peer) -> None:
                splitter._inside.write(data)

            def link_lost(self, error: LinkLost) -> None:
                pass

        for link in (*self._far, self._inside):
            stack.callback(link.close)
        for link in self._far:
            await link.open(FromRadio())
        await self._inside.open(self)

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        for link in self._far:
            link.write(data)

    def link_lost(self, error: LinkLost) -> None:
        pass
