"""Listeners: their order, their thread, and what they may do."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from aerokit.dronekit import listener_thread
from aerokit.dronekit.listener_thread import ListenerThread
from aerokit.dronekit.observers import HasObservers

LIMIT_S = 100.0


@pytest.fixture
def thread() -> Iterator[ListenerThread]:
    each = ListenerThread("test listeners")
    yield each
    each.stop()
    each.join()


def emptied(thread: ListenerThread) -> None:
    """Everything posted so far has been called."""
    done = threading.Event()
    thread.post(done.set)
    assert done.wait(LIMIT_S)


def told(observed: HasObservers, thread: ListenerThread, *values: Any, name: str = "x", **more: Any) -> None:
    for value in values:
        observed._dk_listeners.tell(name, value, **more)
    emptied(thread)


def test_calls_come_in_order_and_the_thread_starts_with_the_first() -> None:
    thread = ListenerThread("late")
    assert all(each.name != "late" for each in threading.enumerate())
    seen: list[int] = []
    for number in range(100):
        thread.post(seen.append, number)
    emptied(thread)
    assert seen == list(range(100))
    thread.stop()
    thread.join()
    assert all(each.name != "late" for each in threading.enumerate())
    thread.post(seen.append, -1)
    assert -1 not in seen


def test_a_raising_call_is_logged_and_the_next_one_runs(
    thread: ListenerThread, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise SystemExit(3)

    thread.post(fail)
    emptied(thread)
    assert "Exception in a callback" in caplog.text


def test_stopping_from_a_call_does_not_wait_for_itself(thread: ListenerThread) -> None:
    ended = threading.Event()

    def stop() -> None:
        thread.stop()
        thread.join()
        ended.set()

    thread.post(stop)
    assert ended.wait(LIMIT_S)


def test_call_waits_and_is_direct_on_the_thread_itself(thread: ListenerThread) -> None:
    seen: list[object] = []
    thread.call(lambda: thread.call(lambda: seen.append(threading.current_thread().name)))
    assert seen == ["test listeners"]
    thread.stop()
    thread.call(lambda: seen.append("after"))
    assert seen[-1] == "after"


def test_what_waits_behind_a_stuck_listener_is_bounded(
    thread: ListenerThread, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener_thread, "MOST_WAITING", 5)
    may_go_on, seen = threading.Event(), list[object]()
    is_stuck = threading.Event()

    def be_stuck() -> None:
        is_stuck.set()
        may_go_on.wait(LIMIT_S)

    thread.post(be_stuck)
    assert is_stuck.wait(LIMIT_S)
    for number in range(20):
        thread.offer(seen.append, number)
    thread.post(seen.append, "state")
    may_go_on.set()
    emptied(thread)
    assert seen[-1] == "state"
    assert seen[:-1] == list(range(len(seen) - 1))
    assert len(seen) == 6
    assert thread.dropped == 20 - (len(seen) - 1)
    assert caplog.text.count("does not come back") == 1


def test_listeners_of_a_name_come_before_those_of_every_name(thread: ListenerThread) -> None:
    observed, seen = HasObservers(thread), list[Any]()

    def every(*call: Any) -> None:
        seen.append(("*", *call))

    def first(*call: Any) -> None:
        seen.append(("first", *call))

    def second(*call: Any) -> None:
        seen.append(("second", *call))

    observed.add_attribute_listener("*", every)
    observed.add_attribute_listener("x", first)
    observed.add_attribute_listener("x", second)
    observed.add_attribute_listener("x", first)
    told(observed, thread, 7)
    told(observed, thread, 8, name="y")
    assert seen == [
        ("first", observed, "x", 7),
        ("second", observed, "x", 7),
        ("*", observed, "x", 7),
        ("*", observed, "y", 8),
    ]


def test_a_listener_that_removes_itself_does_not_cost_the_next_one(thread: ListenerThread) -> None:
    observed, seen = HasObservers(thread), list[Any]()

    def once(_: Any, name: str, value: Any) -> None:
        seen.append(("once", value))
        observed.remove_attribute_listener(name, once)

    observed.add_attribute_listener("x", once)
    observed.add_attribute_listener("x", lambda _, name, value: seen.append(("always", value)))
    told(observed, thread, 1, 2)
    assert seen == [("once", 1), ("always", 1), ("always", 2)]


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1), KeyboardInterrupt()])
def test_a_raising_listener_is_logged_and_the_others_run(
    thread: ListenerThread, caplog: pytest.LogCaptureFixture, error: BaseException
) -> None:
    observed, seen = HasObservers(thread), list[Any]()

    def fail(*_: Any) -> None:
        raise error

    observed.add_attribute_listener("heading", fail)
    observed.add_attribute_listener("heading", lambda _, name, value: seen.append(value))
    told(observed, thread, 1, 2, name="heading")
    assert seen == [1, 2]
    records = [each for each in caplog.records if each.levelno == logging.ERROR]
    assert [(each.name, each.message) for each in records] == [
        ("dronekit", "Exception in attribute handler for heading")
    ] * 2
    assert records[0].exc_info is not None


def test_cached_attributes_are_told_when_they_change(thread: ListenerThread) -> None:
    observed, seen = HasObservers(thread), list[Any]()
    observed.add_attribute_listener("x", lambda _, name, value: seen.append(value))
    told(observed, thread, False, False, True, True, False, cache=True)
    assert seen == [False, True, False]
    told(observed, thread, False, False)
    assert seen == [False, True, False, False, False]


def test_removing(thread: ListenerThread) -> None:
    observed = HasObservers(thread)

    def listener(*_: Any) -> None:
        pass

    def other(*_: Any) -> None:
        pass

    observed.remove_attribute_listener("x", listener)
    observed.add_attribute_listener("x", listener)
    with pytest.raises(ValueError, match="does not listen"):
        observed.remove_attribute_listener("x", other)
    observed.remove_attribute_listener("x", listener)
    observed.remove_attribute_listener("x", listener)


def test_decorators_take_a_name_or_a_list(thread: ListenerThread) -> None:
    observed, seen = HasObservers(thread), list[Any]()

    @observed.on_attribute(["x", "y"])
    def listener(_: Any, name: str, value: Any) -> None:
        seen.append((name, value))

    assert callable(listener)
    told(observed, thread, 1)
    told(observed, thread, 2, name="y")
    assert seen == [("x", 1), ("y", 2)]


def test_notifying_waits_for_the_listeners_and_works_inside_one(thread: ListenerThread) -> None:
    observed, seen = HasObservers(thread), list[Any]()

    def outer(_: Any, name: str, value: Any) -> None:
        observed.notify_attribute_listeners("inner", value + 1)
        seen.append((name, value, threading.current_thread().name))

    observed.add_attribute_listener("outer", outer)
    observed.add_attribute_listener("inner", lambda _, name, value: seen.append((name, value)))
    observed.notify_attribute_listeners("outer", 1)
    assert seen == [("inner", 2), ("outer", 1, "test listeners")]
    observed.notify_attribute_listeners("inner", 5, cache=True)
    observed.notify_attribute_listeners("inner", 5, True)
    assert seen[2:] == [("inner", 5)]


def test_without_a_thread_listeners_run_where_they_are_told() -> None:
    observed, seen = HasObservers(), list[Any]()
    observed.add_attribute_listener("x", lambda *_: seen.append(threading.current_thread()))
    observed.notify_attribute_listeners("x", 1)
    observed._dk_listeners.tell("x", 1)
    assert seen == [threading.current_thread()] * 2


def test_telling_nobody_does_not_start_the_thread() -> None:
    thread = ListenerThread("unused")
    HasObservers(thread)._dk_listeners.tell("x", 1)
    assert all(each.name != "unused" for each in threading.enumerate())


def test_a_blocked_listener_keeps_nobody_from_telling(thread: ListenerThread) -> None:
    observed, may_go_on, seen = HasObservers(thread), threading.Event(), list[Any]()

    def block(_: Any, name: str, value: Any) -> None:
        may_go_on.wait(LIMIT_S)
        seen.append(value)

    observed.add_attribute_listener("x", block)
    for number in range(10):
        observed._dk_listeners.tell("x", number)
    assert not seen
    may_go_on.set()
    emptied(thread)
    assert seen == list(range(10))


def test_telling_listeners_never_waits_for_what_waits_for_it() -> None:
    threads, met = (ListenerThread("one"), ListenerThread("two")), threading.Barrier(2)
    ended: list[str] = []

    def meet_and_call(other: ListenerThread) -> None:
        met.wait(LIMIT_S)
        other.call(ended.append, "called")  # both wait for the other one, if they wait

    one, two = threads
    callers = [
        threading.Thread(target=each.call, args=(meet_and_call, other))
        for each, other in ((one, two), (two, one))
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(LIMIT_S)
        assert not caller.is_alive()

    async def tell() -> None:
        one.call(ended.append, "from a coroutine")

    one.post(time.sleep, 0.05)
    asyncio.run(tell())
    for each in threads:
        each.call(lambda: None)
        each.stop()
        each.join()
    assert ended == ["called", "called", "from a coroutine"]


def test_listeners_added_from_many_threads_are_all_there() -> None:
    observed = HasObservers()
    start = threading.Barrier(4)

    def add() -> None:
        start.wait(LIMIT_S)
        for _ in range(200):
            observed.add_attribute_listener("x", lambda *_: None)

    adders = [threading.Thread(target=add) for _ in range(4)]
    for each in adders:
        each.start()
    for each in adders:
        each.join(LIMIT_S)
    assert len(observed._attribute_listeners["x"]) == 800
