"""Subscriptions: latest item wins, missed items are counted, and the end is raised."""

from __future__ import annotations

import anyio
import pytest

from aerokit.connection.bus import Detach, Overflow, Sink, Subscription
from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, OperationTimeout, SubscriptionOverflow

pytestmark = pytest.mark.anyio


class Source:
    """Something that one can attach to."""

    def __init__(self) -> None:
        self.sinks: list[Sink] = []

    def attach(self, sink: Sink) -> list[Detach]:
        self.sinks.append(sink)
        return [lambda: self.sinks.remove(sink)]

    def give(self, *items: int) -> None:
        for item in items:
            for sink in list(self.sinks):
                sink(item)

    def subscribe(self, capacity: int = 1, overflow: Overflow = "drop_oldest") -> Subscription[int]:
        return Subscription(self.attach, capacity=capacity, overflow=overflow)


async def test_slow_reader_gets_latest_item_and_missed_count() -> None:
    source = Source()
    with source.subscribe() as numbers:
        source.give(*range(100))
        assert await numbers.get() == 99
        assert numbers.missed == 99


async def test_drop_newest_keeps_the_first_items() -> None:
    source = Source()
    with source.subscribe(3, "drop_newest") as numbers:
        source.give(*range(10))
        assert [numbers.get_nowait() for _ in range(4)] == [0, 1, 2, None]
        assert numbers.missed == 7


async def test_error_policy_ends_the_subscription() -> None:
    source = Source()
    with source.subscribe(2, "error") as numbers:
        source.give(1, 2, 3)
        assert source.sinks == []
        assert [await numbers.get(), await numbers.get()] == [1, 2]
        with pytest.raises(SubscriptionOverflow):
            await numbers.get()


async def test_subscription_is_active_inside_its_block() -> None:
    source = Source()
    numbers = source.subscribe()
    source.give(1)
    with numbers:
        source.give(2)
        assert await numbers.get() == 2
    assert source.sinks == []
    with pytest.raises(InvalidArgument, match="closed"):
        await numbers.get()


async def test_waiting_reader_is_woken() -> None:
    source, observed = Source(), list[int]()
    with source.subscribe(10) as numbers:

        async def read() -> None:
            async for number in numbers:
                observed.append(number)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            await anyio.sleep(1)
            source.give(1, 2)
            await anyio.sleep(1)
            numbers.close()
    assert observed == [1, 2]


async def test_get_timeout_keeps_the_subscription_usable() -> None:
    source = Source()
    with source.subscribe() as numbers:
        with pytest.raises(OperationTimeout, match=r"within 0\.5 s"):
            await numbers.get(timeout=0.5)
        source.give(7)
        assert await numbers.get(timeout=0.5) == 7


async def test_cancelled_reader_loses_nothing() -> None:
    source = Source()
    with source.subscribe() as numbers:
        with anyio.move_on_after(1):
            await numbers.get()
        source.give(1)
        assert await numbers.get() == 1


async def test_end_of_connection_is_raised_after_queued_items() -> None:
    source = Source()
    with source.subscribe(5) as numbers:
        source.give(1)
        numbers.close(ConnectionClosed("gone"))
        assert await numbers.get() == 1
        with pytest.raises(ConnectionClosed, match="gone"):
            async for _ in numbers:
                pass


async def test_second_reader_is_refused() -> None:
    with Source().subscribe() as numbers:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(numbers.get)
            await anyio.sleep(1)
            with pytest.raises(BusyError, match="another task already reads this subscription"):
                await numbers.get()
            tasks.cancel_scope.cancel()


@pytest.mark.parametrize(("capacity", "overflow"), [(0, "drop_oldest"), (1, "block")])
async def test_invalid_arguments_are_refused(capacity: int, overflow: Overflow) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed"):
        Source().subscribe(capacity, overflow)
