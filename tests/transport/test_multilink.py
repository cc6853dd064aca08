"""``MultiLink`` without a connection: its retries, and cancelled openings."""

from __future__ import annotations

import asyncio
import logging
from functools import partial

import anyio
import pytest
from link_harness import Recorder

from aerokit.errors import ConnectionClosed
from aerokit.testing import VIRTUAL_BACKEND
from aerokit.transport import Link, MemoryLink, MultiLink, memory_link_pair

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


class OpensLater(MemoryLink):
    """Cannot be opened the first time."""

    has_failed = False

    async def _connect(self) -> None:
        if not self.has_failed:
            self.has_failed = True
            raise OSError(111, "refused")
        await super()._connect()


def both_of(near: Link, away: Link) -> MultiLink:
    both = near, away
    return MultiLink([partial(both.__getitem__, index) for index in range(2)])


async def test_link_opened_by_another_connection_is_given_up(caplog: pytest.LogCaptureFixture) -> None:
    near, _far = memory_link_pair()
    away = OpensLater("memory:away")
    together = both_of(near, away)
    with caplog.at_level(logging.WARNING, "aerokit"):
        await together.open(Recorder())
        await away.open(Recorder())
        await anyio.sleep(30)
    assert not together.is_available(1)
    assert "one of several links is given up: memory:away is open" in caplog.text
    together.close()


async def test_retries_end_with_final_loss_of_all_links() -> None:
    near, far = memory_link_pair()
    together, recorder = both_of(near, OpensLater("memory:away")), Recorder()
    await far.open(Recorder())
    await together.open(recorder)
    far.close()
    await recorder.until_lost()
    await anyio.sleep(30)
    assert not together.is_available(1)
    together.close()
    await together.wait_closed()


class OpensNever(MemoryLink):
    """Takes long to open, and a second to end after a cancellation."""

    async def _connect(self) -> None:
        try:
            await asyncio.sleep(1000)
        finally:
            await asyncio.sleep(1)


async def test_opening_cancelled_by_scope_closes_open_links() -> None:
    made: list[Link] = []

    def make_link(never: bool) -> Link:
        made.append(OpensNever("memory:never") if never else memory_link_pair()[0])
        return made[-1]

    together = MultiLink([partial(make_link, never) for never in (False, True)])
    with anyio.move_on_after(1) as scope:  # anyio cancels at each await
        await together.open(Recorder())
    assert scope.cancelled_caught
    opened, _, *_ = made
    with pytest.raises(ConnectionClosed):
        await opened.open(Recorder())
    assert len(made) == 4  # new ones, for the next attempt
    assert not together.is_available(0)
    together.close()
