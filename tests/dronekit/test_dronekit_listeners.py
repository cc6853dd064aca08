"""Listeners: order, thread and allowed calls."""

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
    listener_thread = ListenerThread("test listeners")
    yield listener_thread
    listener_thread.stop()
    listener_thread.join()


def wait_until_empty(thread: ListenerThread) -> None:
    """Wait until all calls posted so far have run."""
    done = threading.Event()
    thread.post(done.set)
    assert done.wait(LIMIT_S)


def notified(observed: HasObservers, thread: ListenerThread, *values: Any, name: str = "x", **more: Any) -> None:
    for value in values:
        observed._dk_listeners.notify(name, value, **more)
    wait_until_empty(thread)


def test_listener_thread_starts_with_first_call_and_keeps_order() -> None:
    thread = ListenerThread("late")
    assert all(thread.name != "late" for thread in threading.enumerate())
    observed: list[int] = []
    for number in range(100):
        thread.post(observed.append, number)
    wait_until_empty(thread)
    assert observed == list(range(100))
    thread.stop()
    thread.join()
    assert all(thread.name != "late" for thread in threading.enumerate())
    thread.post(observed.append, -1)
    assert -1 not in observed


def test_listener_thread_logs_exception_and_continues(thread: ListenerThread, caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise SystemExit(3)

    thread.post(fail)
    wait_until_empty(thread)
    assert "Exception in a callback" in caplog.text


def test_listener_thread_stop_in_call_does_not_deadlock(thread: ListenerThread) -> None:
    ended = threading.Event()

    def stop() -> None:
        thread.stop()
        thread.join()
        ended.set()

    thread.post(stop)
    assert ended.wait(LIMIT_S)


def test_listener_thread_call_waits_or_is_direct(thread: ListenerThread) -> None:
    observed: list[object] = []
    thread.call(lambda: thread.call(lambda: observed.append(threading.current_thread().name)))
    assert observed == ["test listeners"]
    thread.stop()
    thread.call(lambda: observed.append("after"))
    assert observed[-1] == "after"


def test_queue_behind_blocked_listener_is_bounded(
    thread: ListenerThread, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener_thread, "MAX_QUEUED_CALLS", 5)
    may_go_on, observed = threading.Event(), list[object]()
    is_stuck = threading.Event()

    def block_thread() -> None:
        is_stuck.set()
        may_go_on.wait(LIMIT_S)

    thread.post(block_thread)
    assert is_stuck.wait(LIMIT_S)
    for number in range(20):
        thread.post_or_drop(observed.append, number)
    thread.post(observed.append, "state")
    may_go_on.set()
    wait_until_empty(thread)
    assert observed[-1] == "state"
    assert observed[:-1] == list(range(len(observed) - 1))
    assert len(observed) == 6
    assert thread.dropped == 20 - (len(observed) - 1)
    assert caplog.text.count("blocks the callback thread") == 1


def test_listeners_of_name_run_before_wildcard(thread: ListenerThread) -> None:
    observed, results = HasObservers(thread), list[Any]()

    def every(*call: Any) -> None:
        results.append(("*", *call))

    def first(*call: Any) -> None:
        results.append(("first", *call))

    def second(*call: Any) -> None:
        results.append(("second", *call))

    observed.add_attribute_listener("*", every)
    observed.add_attribute_listener("x", first)
    observed.add_attribute_listener("x", second)
    observed.add_attribute_listener("x", first)
    notified(observed, thread, 7)
    notified(observed, thread, 8, name="y")
    assert results == [
        ("first", observed, "x", 7),
        ("second", observed, "x", 7),
        ("*", observed, "x", 7),
        ("*", observed, "y", 8),
    ]


def test_listener_that_removes_itself_does_not_affect_next(thread: ListenerThread) -> None:
    observed, results = HasObservers(thread), list[Any]()

    def once(_: Any, name: str, value: Any) -> None:
        results.append(("once", value))
        observed.remove_attribute_listener(name, once)

    observed.add_attribute_listener("x", once)
    observed.add_attribute_listener("x", lambda _, name, value: results.append(("always", value)))
    notified(observed, thread, 1, 2)
    assert results == [("once", 1), ("always", 1), ("always", 2)]


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1), KeyboardInterrupt()])
def test_raising_listener_is_logged_and_others_run(
    thread: ListenerThread, caplog: pytest.LogCaptureFixture, error: BaseException
) -> None:
    observed, results = HasObservers(thread), list[Any]()

    def fail(*_: Any) -> None:
        raise error

    observed.add_attribute_listener("heading", fail)
    observed.add_attribute_listener("heading", lambda _, name, value: results.append(value))
    notified(observed, thread, 1, 2, name="heading")
    assert results == [1, 2]
    records = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert [(record.name, record.message) for record in records] == [
        ("dronekit", "Exception in attribute handler for heading")
    ] * 2
    assert records[0].exc_info is not None


def test_cached_attributes_notify_on_change(thread: ListenerThread) -> None:
    observed, results = HasObservers(thread), list[Any]()
    observed.add_attribute_listener("x", lambda _, name, value: results.append(value))
    notified(observed, thread, False, False, True, True, False, cache=True)
    assert results == [False, True, False]
    notified(observed, thread, False, False)
    assert results == [False, True, False, False, False]


def test_listeners_can_be_removed(thread: ListenerThread) -> None:
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


def test_listener_decorators_accept_name_or_list(thread: ListenerThread) -> None:
    observed, results = HasObservers(thread), list[Any]()

    @observed.on_attribute(["x", "y"])
    def listener(_: Any, name: str, value: Any) -> None:
        results.append((name, value))

    assert callable(listener)
    notified(observed, thread, 1)
    notified(observed, thread, 2, name="y")
    assert results == [("x", 1), ("y", 2)]


def test_notify_waits_for_listeners_and_works_inside_one(thread: ListenerThread) -> None:
    observed, results = HasObservers(thread), list[Any]()

    def outer(_: Any, name: str, value: Any) -> None:
        observed.notify_attribute_listeners("inner", value + 1)
        results.append((name, value, threading.current_thread().name))

    observed.add_attribute_listener("outer", outer)
    observed.add_attribute_listener("inner", lambda _, name, value: results.append((name, value)))
    observed.notify_attribute_listeners("outer", 1)
    assert results == [("inner", 2), ("outer", 1, "test listeners")]
    observed.notify_attribute_listeners("inner", 5, cache=True)
    observed.notify_attribute_listeners("inner", 5, True)
    assert results[2:] == [("inner", 5)]


def test_listeners_without_thread_run_on_notifying_thread() -> None:
    observed, results = HasObservers(), list[Any]()
    observed.add_attribute_listener("x", lambda *_: results.append(threading.current_thread()))
    observed.notify_attribute_listeners("x", 1)
    observed._dk_listeners.notify("x", 1)
    assert results == [threading.current_thread()] * 2


def test_notify_without_listeners_starts_no_thread() -> None:
    thread = ListenerThread("unused")
    HasObservers(thread)._dk_listeners.notify("x", 1)
    assert all(thread.name != "unused" for thread in threading.enumerate())


def test_blocked_listener_does_not_block_notify(thread: ListenerThread) -> None:
    observed, may_go_on, results = HasObservers(thread), threading.Event(), list[Any]()

    def block(_: Any, name: str, value: Any) -> None:
        may_go_on.wait(LIMIT_S)
        results.append(value)

    observed.add_attribute_listener("x", block)
    for number in range(10):
        observed._dk_listeners.notify("x", number)
    assert not results
    may_go_on.set()
    wait_until_empty(thread)
    assert results == list(range(10))


def test_notify_does_not_deadlock() -> None:
    threads, met = (ListenerThread("one"), ListenerThread("two")), threading.Barrier(2)
    ended: list[str] = []

    def meet_and_call(other: ListenerThread) -> None:
        met.wait(LIMIT_S)
        other.call(ended.append, "called")  # both wait for the other one, if they wait

    one, two = threads
    callers = [
        threading.Thread(target=first.call, args=(meet_and_call, second)) for first, second in ((one, two), (two, one))
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(LIMIT_S)
        assert not caller.is_alive()

    async def notify() -> None:
        one.call(ended.append, "from a coroutine")

    one.post(time.sleep, 0.05)
    asyncio.run(notify())
    for thread in threads:
        thread.call(lambda: None)
        thread.stop()
        thread.join()
    assert ended == ["called", "called", "from a coroutine"]


def test_listeners_added_from_many_threads_are_all_kept() -> None:
    observed = HasObservers()
    start = threading.Barrier(4)

    def add() -> None:
        start.wait(LIMIT_S)
        for _ in range(200):
            observed.add_attribute_listener("x", lambda *_: None)

    adders = [threading.Thread(target=add) for _ in range(4)]
    for adder in adders:
        adder.start()
    for started in adders:
        started.join(LIMIT_S)
    assert len(observed._attribute_listeners["x"]) == 800
