"""Simulation of an onboard router that copies one stream of the autopilot to several radios."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AsyncExitStack

from aerokit.errors import LinkLost
from aerokit.transport import MemoryLink, Peer, memory_link_pair


class Splitter:
    """Copies one stream of the autopilot to several radios."""

    def __init__(self, far: Sequence[MemoryLink]) -> None:
        self.port, self._inside = memory_link_pair()
        self._far = far
        self.keeps_peers = False

    async def open(self, stack: AsyncExitStack) -> None:
        """Start copying. The exit stack closes all links."""
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
