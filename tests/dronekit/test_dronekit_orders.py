"""BackgroundCalls given without waiting: the order on the wire, replacement, failures, the end."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Iterator

import pytest

from aerokit.dronekit.classic_connection import BackgroundCalls
from aerokit.errors import ConnectionClosed
from aerokit.sync.loop_thread import LoopThread

LIMIT_S = 100.0


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    thread = LoopThread()
    yield thread
    thread.close()


def test_background_calls_send_in_call_order(loop: LoopThread) -> None:
    orders, sent = BackgroundCalls(loop), []

    async def send_and_wait(name: str) -> None:
        sent.append(name)
        await asyncio.sleep(0)

    for number in range(50):
        orders.start(f"kind {number % 7}", send_and_wait, f"order {number}") if number % 3 else orders.post(
            sent.append, f"message {number}"
        )
    orders.wait(LIMIT_S)
    loop.call(lambda: None)
    replaced = {number for number in range(50) if number % 3 and f"order {number}" not in sent}
    expected = [f"order {n}" if n % 3 else f"message {n}" for n in range(50) if n not in replaced]
    assert sent == expected
    assert not replaced or all(any(later % 7 == n % 7 for later in range(n + 1, 50)) for n in replaced)


def test_background_call_replaces_older_of_same_kind(loop: LoopThread) -> None:
    orders, ended = BackgroundCalls(loop), []

    async def for_ever(name: str) -> None:
        try:
            await asyncio.sleep(1000)
        finally:
            ended.append(name)

    async def soon() -> None:
        pass

    first = orders.start("mode", for_ever, "mode")
    other = orders.start("home", for_ever, "home")
    second = orders.start("mode", soon)
    second.result(LIMIT_S)
    with pytest.raises(ConnectionClosed, match="mode: the order was cancelled or replaced"):
        first.result(LIMIT_S)
    assert not other.done()
    assert "home" not in ended


def test_background_call_failure_is_logged_and_in_future(loop: LoopThread, caplog: pytest.LogCaptureFixture) -> None:
    async def fail() -> None:
        raise ValueError("the vehicle said no")

    future = BackgroundCalls(loop).start("arm", fail)
    with pytest.raises(ValueError, match="said no"):
        future.result(LIMIT_S)
    assert [(record.name, record.levelname, record.message) for record in caplog.records] == [
        ("dronekit", "WARNING", "arm: the vehicle said no")
    ]


def test_background_calls_end_with_loop(loop: LoopThread) -> None:
    async def for_ever() -> None:
        await asyncio.sleep(1000)

    orders = BackgroundCalls(loop)
    future = orders.start("mode", for_ever)
    loop.close()
    done, _ = concurrent.futures.wait([future], LIMIT_S)
    assert done
    assert isinstance(future.exception(), ConnectionClosed)
    with pytest.raises(ConnectionClosed):
        orders.start("mode", for_ever)
    with pytest.raises(ConnectionClosed):
        orders.post(print)
    orders.wait(0.0)


def test_background_calls_wait_is_bounded(loop: LoopThread) -> None:
    async def for_ever() -> None:
        await asyncio.sleep(1000)

    orders = BackgroundCalls(loop)
    future = orders.start("mode", for_ever)
    orders.wait(0.01)
    assert not future.done()
