"""Both sides of a name on a zenoh network, with receivers that record all data."""

from __future__ import annotations

import contextlib
import re
from collections.abc import AsyncIterator

import pytest
from link_harness import Recorder

from aerokit.errors import LinkOpenError
from aerokit.transport import ReconnectingLink, ZenohConnect, ZenohListen, create_link

__all__ = ["RefusalRecorder", "client", "reconnecting", "serving", "until_open_error"]


class RefusalRecorder(Recorder):
    """A receiver that records refused orders and interruptions."""

    def __init__(self) -> None:
        super().__init__()
        self.refused: list[tuple[str, str, str | None]] = []
        self.answers: list[tuple[bytes, ...]] = []
        self.interruptions = 0
        self.restored = 0

    def order_refused(self, message: str, reason: str, lease_holder: str | None, answers: tuple[bytes, ...]) -> None:
        self.refused.append((message, reason, lease_holder))
        self.answers.append(answers)

    def link_interrupted(self, error: Exception) -> None:
        self.interruptions += 1

    def link_restored(self, away_s: float) -> None:
        self.restored += 1


@contextlib.asynccontextmanager
async def serving(port: int, name: str = "alpha", how: str = "listen") -> AsyncIterator[tuple[ZenohListen, Recorder]]:
    """A server that listens on a port, or connects to it."""
    link = create_link(f"zenohin://north/{name}?{how}=tcp/127.0.0.1:{port}")
    assert isinstance(link, ZenohListen)
    recorder = Recorder()
    await link.open(recorder)
    try:
        yield link, recorder
    finally:
        link.close()
        await link.wait_closed()


@contextlib.asynccontextmanager
async def client(
    port: int, more: str = "", *, name: str = "alpha"
) -> AsyncIterator[tuple[ZenohConnect, RefusalRecorder]]:
    """A client that connects to a port."""
    link = create_link(f"zenoh://north/{name}?connect=tcp/127.0.0.1:{port}&timeout=100{more}")
    assert isinstance(link, ZenohConnect)
    answered = RefusalRecorder()
    await link.open(answered)
    try:
        yield link, answered
    finally:
        link.close()
        await link.wait_closed()


@contextlib.asynccontextmanager
async def reconnecting(port: int) -> AsyncIterator[tuple[ReconnectingLink, RefusalRecorder]]:
    """The same, opened again when it is lost."""
    address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{port}&timeout=100"
    link, answered = ReconnectingLink(lambda: create_link(address), max_delay_s=0.4), RefusalRecorder()
    await link.open(answered)
    try:
        yield link, answered
    finally:
        link.close()
        await link.wait_closed()


async def until_open_error(address: str, pattern: str) -> None:
    """Open an address with longer time-outs until the error text matches: the network may need long to answer."""
    for timeout_s in (0.3, 3, 30):
        with pytest.raises(LinkOpenError) as error:
            await create_link(f"{address}&timeout={timeout_s}").open(RefusalRecorder())
        if re.search(pattern, str(error.value)):
            return
    raise AssertionError(str(error.value))
