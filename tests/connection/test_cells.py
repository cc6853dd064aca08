"""State cells: reading, ages, waiting, following; all on virtual time."""

from __future__ import annotations

import asyncio
import gc
import math
import threading
from collections.abc import Callable
from typing import Any

import pytest
from late_loop import BEGINS_AT, since_the_beginning

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import OperationTimeout, StaleValueError, ValueUnknownError

HEARTBEAT = Source(1, 1, "HEARTBEAT")

pytestmark = pytest.mark.anyio


def make_cell(name: str = "altitude") -> StateCell[int]:
    return StateCell(name, asyncio.get_running_loop().time, "HEARTBEAT")


def later(delay: float, callback: Callable[..., object], *args: object) -> None:
    asyncio.get_running_loop().call_later(delay, callback, *args)


async def test_unknown_value_error_names_the_source_messages() -> None:
    cell = make_cell()
    with pytest.raises(ValueUnknownError, match="altitude is not known yet: no HEARTBEAT has been received"):
        _ = cell.value
    assert (cell.latest, cell.source, cell.is_known, cell.age) == (None, None, False, math.inf)


async def test_cell_as_condition_raises_type_error() -> None:
    armed: Any = make_cell("armed")
    with pytest.raises(TypeError) as caught:
        bool(armed)
    assert str(caught.value) == "a StateCell has no truth value: use armed.value or armed.latest"


async def test_cell_with_index_or_loop_raises_type_error() -> None:
    cameras: Any = make_cell("cameras")
    with pytest.raises(TypeError, match=r"^cameras is a StateCell.*: use cameras.value\[…\], or camera_at\(number\)"):
        _ = cameras[100]
    batteries: Any = make_cell("batteries")
    with pytest.raises(TypeError, match=r"^batteries is a StateCell.*: use batteries.value\[…\]$"):
        list(batteries)


async def test_value_age_and_source() -> None:
    cell = make_cell()
    await asyncio.sleep(1.5)
    cell.set(7, HEARTBEAT)
    await asyncio.sleep(2)
    assert (cell.value, cell.latest, cell.age, cell.updated_at) == (7, 7, 2.0, BEGINS_AT + 1.5)
    assert cell.source == Source(1, 1, "HEARTBEAT")


async def test_setting_equal_value_resets_the_age() -> None:
    cell = make_cell()
    cell.set(7, HEARTBEAT)
    await asyncio.sleep(2)
    cell.set(7, HEARTBEAT)
    assert cell.age == 0.0


async def test_fresh_raises_for_old_value() -> None:
    cell = make_cell()
    with pytest.raises(ValueUnknownError):
        cell.fresh(within=1)
    cell.set(7, HEARTBEAT)
    await asyncio.sleep(1)
    assert cell.fresh(within=1) == 7
    await asyncio.sleep(4.2)
    with pytest.raises(StaleValueError, match=r"altitude is 5\.2 s old, the limit is 1 s: no HEARTBEAT"):
        cell.fresh(within=1)


async def test_wait_until_returns_at_once_when_already_true() -> None:
    cell = make_cell()
    cell.set(7, HEARTBEAT)
    assert await cell.wait_until(lambda value: value == 7) == 7


async def test_wait_until_sees_value_of_one_message() -> None:
    cell = make_cell()

    def flicker() -> None:
        for value in (1, 99, 2):
            cell.set(value, HEARTBEAT)

    later(1, flicker)
    assert await cell.wait_until(lambda value: value == 99) == 99
    assert cell.value == 2


async def test_held_for_restarts_when_value_changes() -> None:
    cell = make_cell()
    for at, value in ((0, 5), (1, 0), (2, 5), (3, 6)):
        later(at, cell.set, value, HEARTBEAT)
    assert await cell.wait_until(lambda value: value >= 5, held_for=2) == 6
    assert since_the_beginning() == pytest.approx(4)


async def test_held_for_may_end_between_messages() -> None:
    cell = make_cell()
    cell.set(5, HEARTBEAT)
    await cell.wait_until(lambda value: value == 5, held_for=0.5)
    assert since_the_beginning() == pytest.approx(0.5)


async def test_forget_restarts_held_for() -> None:
    cell = make_cell()
    cell.set(5, HEARTBEAT)
    later(1, cell.forget)
    later(5, cell.set, 5, HEARTBEAT)
    await cell.wait_until(lambda value: value == 5, held_for=2)
    assert since_the_beginning() == pytest.approx(7)


async def test_timeout_lists_seen_values() -> None:
    cell = make_cell("mode")
    for at, value in enumerate((3, 3, 4, 5, 6)):
        later(at / 4, cell.set, value, HEARTBEAT)
    with pytest.raises(OperationTimeout) as caught:
        await cell.wait_until(lambda value: value == 99, timeout=2, description="mode GUIDED")
    assert str(caught.value) == (
        "mode GUIDED: not reached within 2 s; mode is 6, 1.0 s old; 5 values seen, last 4, 5, 6"
    )


async def test_timeout_lists_a_returning_value_again() -> None:
    cell = make_cell("mode")
    for at, value in enumerate((3, 4, 4, 3)):
        later(at / 4, cell.set, value, HEARTBEAT)
    with pytest.raises(OperationTimeout, match=r"4 values seen, last 3, 4, 3$"):
        await cell.wait_until(lambda value: value == 99, timeout=2)


async def test_timeout_lists_equal_values_once() -> None:
    cell = make_cell("mode")
    cell.set(3, HEARTBEAT)
    with pytest.raises(OperationTimeout) as caught:
        await cell.wait_until(lambda value: value == 99, timeout=2)
    assert str(caught.value) == "mode: not reached within 2 s; mode is 3, 2.0 s old"


async def test_timeout_of_unknown_value_says_so() -> None:
    with pytest.raises(OperationTimeout, match="not known yet: no HEARTBEAT has been received"):
        await make_cell().wait_until(lambda _: True, timeout=1)


async def test_timeout_names_held_for() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    with pytest.raises(OperationTimeout, match="the condition had to be true for 5 s without a break"):
        await cell.wait_until(lambda value: value == 1, held_for=5, timeout=1)


async def test_predicate_exception_is_raised_in_wait_until() -> None:
    cell = make_cell()
    waiting = asyncio.create_task(cell.wait_until(lambda value: 1 // value > 0))
    other = asyncio.create_task(cell.wait_until(lambda value: value == 0))
    await asyncio.sleep(0)
    cell.set(0, HEARTBEAT)
    with pytest.raises(ZeroDivisionError):
        await waiting
    assert await other == 0


async def test_close_reaches_current_and_later_waiters() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    waiting = asyncio.create_task(cell.wait_until(lambda value: value == 2, held_for=1, timeout=5))
    changes = cell.changes()
    assert await anext(changes) == 1
    following = asyncio.create_task(_next(changes))
    await asyncio.sleep(0)
    cell.close(ConnectionError("gone"))
    for task in (waiting, following):
        with pytest.raises(ConnectionError, match="gone"):
            await task
    with pytest.raises(ConnectionError):
        await cell.wait_until(lambda _: True)
    assert cell.value == 1


async def test_cancelled_wait_leaves_nothing_behind() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    tasks = [
        asyncio.create_task(cell.wait_until(lambda value: value == 1, held_for=100, timeout=200)),
        asyncio.create_task(_next(cell.changes(), skip=1)),
    ]
    await asyncio.sleep(0.1)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert not cell._listeners
    handles = [handle for handle in _timers() if not handle.cancelled()]
    assert handles == []


async def test_cancellation_at_failure_logs_nothing() -> None:
    reported: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context))
    cell = make_cell()
    task = asyncio.create_task(cell.wait_until(lambda _: False))
    await asyncio.sleep(0)
    cell.close(ConnectionError("gone"))
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    del task
    gc.collect()
    assert reported == []


async def test_slow_reader_gets_latest_value_and_missed_count() -> None:
    cell = make_cell()
    cell.set(0, HEARTBEAT)
    changes = cell.changes()
    assert await anext(changes) == 0
    for value in range(1, 6):
        cell.set(value, HEARTBEAT)
    assert await anext(changes) == 5
    assert changes.missed == 4


async def test_changes_skip_equal_values_and_updates_do_not() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    changes, updates = cell.changes(), cell.updates()
    assert (await anext(changes), await anext(updates)) == (1, 1)
    later(1, cell.set, 1, HEARTBEAT)
    later(2, cell.set, 2, HEARTBEAT)
    assert await anext(updates) == 1
    assert since_the_beginning() == pytest.approx(1)
    assert await anext(changes) == 2
    assert since_the_beginning() == pytest.approx(2)


async def test_changes_of_unknown_cell_start_with_first_value() -> None:
    cell = make_cell()
    later(1, cell.set, 4, HEARTBEAT)
    assert await anext(cell.changes()) == 4


async def test_loop_left_early_leaves_nothing_behind() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    async for value in cell.changes():
        assert value == 1
        break
    assert not cell._listeners


async def test_same_value_after_forget_is_a_change() -> None:
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    changes = cell.changes()
    await anext(changes)
    cell.forget()
    with pytest.raises(ValueUnknownError):
        _ = cell.value
    later(1, cell.set, 1, HEARTBEAT)
    assert await anext(changes) == 1


async def test_observers_get_previous_and_new_value() -> None:
    cell = make_cell()
    observed: list[tuple[int | None, int]] = []
    stop = cell.observe(lambda before, after: observed.append((before, after)))
    for value in (1, 1, 2):
        cell.set(value, HEARTBEAT)
    stop()
    stop()
    cell.set(3, HEARTBEAT)
    assert observed == [(None, 1), (1, 2)]


async def test_observer_exception_is_logged_and_others_are_called(
    caplog: pytest.LogCaptureFixture,
) -> None:
    cell, observed = make_cell(), list[int]()

    def fail(_: int | None, value: int) -> None:
        raise ZeroDivisionError

    cell.observe(fail)
    cell.observe(lambda _, value: observed.append(value))
    cell.set(1, HEARTBEAT)
    assert observed == [1]
    assert "an observer of altitude raised" in caplog.text
    assert "ZeroDivisionError" in caplog.text


class LazyFeed:
    """Decodes values on demand, and counts notifications about watchers."""

    pending: object = None

    def __init__(self) -> None:
        self.reported: list[bool] = []
        self.cell = make_cell()
        self.cell._feed_from(self)

    def catch_up(self) -> None:
        value, self.pending = self.pending, None
        self.cell.set(value, HEARTBEAT)  # type: ignore[arg-type]

    def watchers_changed(self) -> None:
        self.reported.append(self.cell._is_watched)


async def test_feed_is_notified_of_watchers_and_asked_by_readers() -> None:
    feed = LazyFeed()
    stop = feed.cell.observe(lambda _, __: None)
    stop()
    assert feed.reported == [True, False]
    feed.pending = 5
    assert feed.cell.value == 5
    feed.pending = 6
    feed.cell.changes()
    assert not feed.pending
    assert feed.cell._latest == 6
    feed.cell.changes()
    assert feed.reported == [True, False] * 3  # each was dropped at once


async def test_iterator_dropped_on_another_thread_reports_on_the_loop() -> None:
    feed = LazyFeed()
    iterators = [feed.cell.changes()]
    thread = threading.Thread(target=iterators.clear)
    thread.start()
    thread.join()
    assert feed.reported == [True]
    await asyncio.sleep(0.01)
    assert feed.reported == [True, False]


async def test_repr_is_readable() -> None:
    cell = make_cell()
    assert repr(cell) == "<StateCell altitude is not known yet: no HEARTBEAT has been received>"
    cell.set(3, HEARTBEAT)
    assert repr(cell) == "<StateCell altitude is 3, 0.0 s old>"


async def _next(changes: object, skip: int = 0) -> object:
    for _ in range(skip):
        await anext(changes)  # type: ignore[call-overload]
    return await anext(changes)  # type: ignore[call-overload]


def _timers() -> list[asyncio.TimerHandle]:
    loop = asyncio.get_running_loop()
    return list(loop._scheduled)  # type: ignore[attr-defined]


async def test_cell_without_iterators_is_not_watched() -> None:
    """A loop that was left by ``break`` costs nothing afterwards."""
    cell = make_cell()
    cell.set(1, HEARTBEAT)
    for follow in (cell.changes, cell.updates):
        async for _ in follow():
            assert cell._is_watched
            break
        assert not cell._is_watched
    one, other = cell.changes(), cell.changes()
    del one
    assert cell._is_watched
    del other
    assert not cell._is_watched
