"""Helpers of the link tests: event loops, a receiver that records everything, and a table of links."""

from __future__ import annotations

import asyncio
import importlib.util
import math
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import anyio
import pytest

from aerokit.errors import LinkLost
from aerokit.testing import VirtualClockLoop
from aerokit.transport import Peer

AsyncTest = TypeVar("AsyncTest", bound=Callable[..., Awaitable[None]])

LOOPS: list[Any] = [
    pytest.param(("asyncio", {}), id="asyncio"),
    pytest.param(
        ("asyncio", {"use_uvloop": True}),
        id="uvloop",
        marks=pytest.mark.skipif(importlib.util.find_spec("uvloop") is None, reason="uvloop is not installed"),
    ),
]


def on_loops(loops: list[Any]) -> Callable[[AsyncTest], AsyncTest]:
    """A decorator that runs an async test on each of these loops."""

    def decorate(test: AsyncTest) -> AsyncTest:
        return pytest.mark.anyio(pytest.mark.parametrize("anyio_backend", loops)(test))  # type: ignore[no-any-return]

    return decorate


each_loop = on_loops(LOOPS)
"""Runs an async test on stock asyncio and on uvloop."""

TRAFFIC: list[list[bytes]] = [
    [b"\xfd\x09\x00\x00\x00\x01\x01\x00\x00\x00"],
    [b"one", b"two", b"three"],
    [bytes(range(256)), b"\x00" * 280, b"\n\r\x11\x13\x7f\x03\x04\x1a"],
    [bytes([n % 256]) * (1 + n % 280) for n in range(200)],
]
"""Writes that every transport must bring over unharmed: control characters, long runs, many in one go."""

each_traffic = pytest.mark.parametrize("pieces", TRAFFIC, ids=["frame", "words", "all bytes", "burst"])


class Recorder:
    """A receiver that records all callbacks and can wait for them."""

    def __init__(self) -> None:
        self.pieces: list[tuple[bytes, Peer]] = []
        self.losses: list[LinkLost] = []
        self.at_each_piece: Callable[[bytes, Peer], None] = lambda data, peer: None
        self._changed = asyncio.Event()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.pieces.append((data, peer))
        self._changed.set()
        self.at_each_piece(data, peer)

    def link_lost(self, error: LinkLost) -> None:
        self.losses.append(error)
        self._changed.set()

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.pieces)

    @property
    def peers(self) -> list[Peer]:
        return list(dict.fromkeys(peer for _, peer in self.pieces))

    async def until(self, condition: Callable[[], bool]) -> None:
        """Waits until something that arrived has made the condition true; bounded for hung tests only."""
        virtual = isinstance(asyncio.get_running_loop(), VirtualClockLoop)
        with anyio.fail_after(math.inf if virtual else 100.0):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    async def until_data(self, data: bytes) -> None:
        await self.until(lambda: len(self.data) >= len(data))
        assert self.data == data

    async def until_lost(self) -> LinkLost:
        await self.until(lambda: bool(self.losses))
        return self.losses[0]


async def eventually(condition: Callable[[], bool]) -> None:
    """Poll the loop until a condition holds that has no event; only hung tests take 100 s."""
    with anyio.fail_after(100):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0)
