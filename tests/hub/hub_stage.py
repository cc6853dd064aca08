"""Helpers of the hub tests: programs that send and receive at the far ends of memory links."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Any

import anyio
import anyio.lowlevel

from aerokit.errors import LinkLost
from aerokit.hub import Endpoint
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.signing import Signing
from aerokit.transport import Link, MemoryLink, Peer, memory_link_pair

COPTER = Heartbeat(2, 3, 81, 0, 3)
STATION = Heartbeat(6, 8, 0, 0, 4, 3)


class Program(AbstractAsyncContextManager["Program"]):
    """One component behind a link; sends messages and records received frames."""

    def __init__(
        self,
        system_id: int = 1,
        component_id: int = 1,
        link: Link | None = None,
        *,
        version: int = 2,
        signing: Signing | None = None,
    ) -> None:
        self.near: MemoryLink | None = None
        if link is None:
            self.near, link = memory_link_pair()
        self.link = link
        self.encoder = FrameEncoder(system_id, component_id, version=version)
        self.encoder.signing = signing
        self.frames: list[Frame] = []
        self.pieces: list[bytes] = []
        self.is_lost = False
        self._framer = Framer()
        self._framer.keep_unknown = True

    def endpoint(self, name: str, **fields: Any) -> Endpoint:
        """The hub's end of the link."""
        assert self.near is not None
        return Endpoint(self.near, name=name, **fields)

    def send(self, *messages: Message) -> None:
        """Send the messages, one write each."""
        for message in messages:
            self.link.write(self.encoder.encode(message, time.time()))

    @property
    def received(self) -> list[str]:
        """Names of the received messages, in order."""
        return [STANDARD[frame.message_id].NAME for frame in self.frames]

    async def __aenter__(self) -> Program:
        await self.link.open(self)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.link.close()
        await self.link.wait_closed()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.pieces.append(data)
        self.frames += self._framer.receive(data)

    def link_lost(self, error: LinkLost) -> None:
        self.is_lost = True


class SlowLink(Link):
    """A link whose far end accepts bytes when a test allows it."""

    def __init__(self, address: str = "slow:1") -> None:
        self.address = address
        self.unsent = 0
        self.receiver: Any = None
        self.written: list[bytes] = []

    async def open(self, receiver: Any) -> None:
        self.receiver = receiver

    def write(self, data: bytes, peer: Peer = None) -> None:
        self.written.append(data)

    @property
    def unsent_bytes(self) -> int:
        return self.unsent

    def close(self) -> None:
        self.receiver = None

    async def wait_closed(self) -> None:
        pass

    def names(self) -> list[str]:
        """Written data."""
        frames = Framer().receive(b"".join(self.written))
        return [STANDARD[frame.message_id].NAME for frame in frames]


async def settle() -> None:
    """Deliver frames in transit; on virtual time this takes no time."""
    for _ in range(20):
        await anyio.lowlevel.checkpoint()


async def until(condition: Callable[[], object]) -> None:
    """Poll until the condition holds, with real sockets."""
    with anyio.fail_after(100):
        while not condition():  # noqa: ASYNC110
            await anyio.sleep(0.005)
