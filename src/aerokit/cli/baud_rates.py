"""Which baud rate gives MAVLink on a serial port: each is listened to for a moment, and nothing is sent."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import anyio

from aerokit.links import SerialLink
from aerokit.mavlink.framer import Framer

if TYPE_CHECKING:
    from aerokit.errors import LinkLost
    from aerokit.links.link import Peer

__all__ = ["BAUD_RATES", "Heard", "listen_at"]

BAUD_RATES = (57600, 115200, 921600, 460800, 230400, 500000, 38400, 19200, 9600)
"""The most usual first."""
ENOUGH_FRAMES = 2
"""One good checksum in noise may be luck."""


class Heard:
    """What came at one baud rate."""

    def __init__(self, baud: int) -> None:
        self.baud: int = baud
        self.bytes: int = 0
        self.frames: int = 0
        self._framer = Framer()
        self._ended = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self.error: LinkLost | None = None

    @property
    def is_mavlink(self) -> bool:
        """Whether there was enough of it."""
        return self.frames >= ENOUGH_FRAMES

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Called by the link."""
        self.bytes += len(data)
        self._framer.receive(data, self._loop.time())
        self.frames = self._framer.statistics.frames
        if self.is_mavlink:
            self._ended.set()

    def link_lost(self, error: LinkLost) -> None:
        """Called by the link."""
        self.error = error
        self._ended.set()

    async def wait(self, seconds: float) -> None:
        """Until it is MAVLink, the port has gone, or so many seconds have passed."""
        with anyio.move_on_after(seconds):
            await self._ended.wait()


async def listen_at(device: str, baud: int, seconds: float) -> Heard:
    """Listen to a port at one rate; raises LinkOpenError when it cannot be opened, LinkLost when it has gone."""
    heard = Heard(baud)
    link = SerialLink(device, baud)
    await link.open(heard)
    try:
        await heard.wait(seconds)
    finally:
        link.close()
        await link.wait_closed()
    if heard.error is not None:
        raise heard.error
    return heard
