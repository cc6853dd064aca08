from __future__ import annotations

import asyncio
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable

import anyio
import pytest

from aerokit.testing import VIRTUAL_BACKEND, DeadlockError, VirtualClockLoop, run_virtual


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


@pytest.mark.anyio
async def test_anyio_tests_run_on_virtual_time() -> None:
    assert isinstance(asyncio.get_running_loop(), VirtualClockLoop)
    before = anyio.current_time()
    await anyio.sleep(24 * 3600)
    assert anyio.current_time() - before == pytest.approx(24 * 3600)


@pytest.mark.anyio
async def test_timers_fire_in_order_at_their_exact_times() -> None:
    loop, fired = asyncio.get_running_loop(), list[tuple[str, float]]()
    start = loop.time()

    def note(name: str) -> None:
        fired.append((name, loop.time() - start))

    for name, delay in [("c", 0.3), ("a", 0.1), ("b", 0.2)]:
        loop.call_later(delay, note, name)
    await asyncio.sleep(1.0)
    assert [name for name, _ in fired] == ["a", "b", "c"]
    assert [when for _, when in fired] == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.anyio
async def test_timeouts_end_on_virtual_time() -> None:
    before = anyio.current_time()
    with anyio.move_on_after(30.0) as scope:
        await asyncio.Event().wait()
    assert scope.cancelled_caught
    assert anyio.current_time() - before == pytest.approx(30.0)


@pytest.mark.anyio
async def test_the_clock_stands_still_while_an_executor_works() -> None:
    before = anyio.current_time()
    go_on = threading.Event()
    work = asyncio.get_running_loop().run_in_executor(None, go_on.wait, 10.0)
    asyncio.get_running_loop().call_soon(go_on.set)
    assert await asyncio.wait_for(work, timeout=0.001)
    assert anyio.current_time() == before


@pytest.mark.anyio
async def test_real_sockets_are_polled() -> None:
    left, right = socket.socketpair()
    with left, right:
        left.setblocking(False)
        right.send(b"x")
        assert await asyncio.get_running_loop().sock_recv(left, 10) == b"x"


@pytest.mark.anyio
async def test_another_thread_can_wake_the_loop() -> None:
    loop, event = asyncio.get_running_loop(), asyncio.Event()
    thread = threading.Thread(target=lambda: loop.call_soon_threadsafe(event.set))
    thread.start()
    await event.wait()
    thread.join()


def test_time_starts_at_zero_and_result_is_returned() -> None:
    async def clock_after(seconds: float) -> float:
        begin = asyncio.get_running_loop().time()
        await asyncio.sleep(seconds)
        return asyncio.get_running_loop().time() - begin

    assert run_virtual(clock_after(12.5)) == 12.5


def test_virtual_hour_takes_no_real_time() -> None:
    spent = time.process_time()
    run_virtual(asyncio.sleep(1e6))
    assert time.process_time() - spent < 1e4


def test_run_virtual_refuses_a_function() -> None:
    with pytest.raises(TypeError, match=r"requires a coroutine, such as main\(\)"):
        run_virtual(test_run_virtual_refuses_a_function)  # type: ignore[arg-type]


def test_deadlock_error_names_the_waiting_task(monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait_forever() -> None:
        await asyncio.Event().wait()

    # Threads that another package has left after an earlier test must not count.
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with pytest.raises(DeadlockError, match="nothing left to wait for") as caught:
        run_virtual(wait_forever())
    assert "locks.py" in str(caught.value)
    assert "Event.wait" in str(caught.value)


def test_call_of_a_thread_that_has_ended_is_no_deadlock(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread calls the loop after the poll, and ends before the loop counts the threads."""

    async def main() -> None:
        loop, done = asyncio.get_running_loop(), asyncio.Event()

        def count_threads(_: VirtualClockLoop) -> bool:
            loop.call_soon_threadsafe(done.set)
            return False

        monkeypatch.setattr(VirtualClockLoop, "_may_be_woken", count_threads)
        await done.wait()

    run_virtual(main())


def test_silent_socket_raises_after_deadlock_timeout() -> None:
    async def receive_without_sender() -> None:
        left, right = socket.socketpair()
        with left, right:
            left.setblocking(False)
            await asyncio.get_running_loop().sock_recv(left, 1)

    loop = VirtualClockLoop(deadlock_timeout_s=0.01)
    task = loop.create_task(receive_without_sender())
    with pytest.raises(DeadlockError, match="no socket or thread has woken the loop"):
        loop.run_until_complete(task)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        loop.run_until_complete(task)
    loop.close()


def test_leftover_tasks_are_cancelled() -> None:
    ends: list[str] = []

    async def linger() -> None:
        try:
            await asyncio.sleep(1e9)
        finally:
            ends.append("cancelled")

    async def main() -> None:
        task = asyncio.create_task(linger())
        await asyncio.sleep(1.0)
        assert not task.done()

    run_virtual(main())
    assert ends == ["cancelled"]


def test_errors_and_executor_shutdown() -> None:
    async def fail() -> None:
        await asyncio.to_thread(int, "1")
        raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        run_virtual(fail())


class Metronome:
    """Event source that is due every half second; it notes times and calls a function."""

    def __init__(self, action: Callable[[], object] = lambda: None) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualClockLoop)
        self.loop, self.action, self.start = loop, action, loop.time()
        self.ran: list[float] = []
        self.end = loop.add_event_source(lambda: self.start + 0.5 * (len(self.ran) + 1), self._run)

    def _run(self) -> None:
        self.ran.append(self.loop.time() - self.start)
        self.action()


@pytest.mark.anyio
async def test_event_sources_run_at_their_times_until_ended() -> None:
    source = Metronome()
    await asyncio.sleep(1.75)
    assert source.ran == pytest.approx([0.5, 1.0, 1.5])
    source.end()
    source.end()
    await asyncio.sleep(1.0)
    assert len(source.ran) == 3


@pytest.mark.anyio
async def test_earliest_of_several_event_sources_runs_first() -> None:
    order: list[str] = []
    one = Metronome(lambda: order.append("one"))
    await asyncio.sleep(0.25)
    other = Metronome(lambda: order.append("other"))
    await asyncio.sleep(1.1)
    assert order == ["one", "other", "one", "other"]
    one.end()
    other.end()


@pytest.mark.anyio
async def test_event_source_runs_before_timer_of_same_instant() -> None:
    order: list[str] = []
    source = Metronome(lambda: order.append("source"))
    source.loop.call_later(0.5, order.append, "timer")
    await asyncio.sleep(0.6)
    assert order == ["source", "timer"]
    source.end()


@pytest.mark.anyio
@pytest.mark.parametrize("has_socket", [False, True])
async def test_event_source_runs_first_at_each_instant(has_socket: bool) -> None:
    """An open socket, or every 64th iteration, leads to asyncio's own iteration."""
    order: list[str] = []
    source = Metronome(lambda: order.append("source"))
    near, far = socket.socketpair()
    with near, far:
        near.setblocking(False)
        if has_socket:
            source.loop.add_reader(near, lambda: None)
        for number in range(1, 201):
            source.loop.call_at(source.start + 0.5 * number, order.append, "timer")
        await asyncio.sleep(100.2)
        source.loop.remove_reader(near)
    source.end()
    assert order == ["source", "timer"] * 200


@pytest.mark.anyio
async def test_clock_stays_finite_after_the_last_event() -> None:
    loop, dues = asyncio.get_running_loop(), [1.0]
    assert isinstance(loop, VirtualClockLoop)
    start, done, is_due = loop.time(), asyncio.Event(), threading.Event()
    thread = threading.Thread(target=lambda: is_due.wait(10.0) and loop.call_soon_threadsafe(done.set))

    def run() -> None:
        dues[0] = math.inf
        is_due.set()

    end = loop.add_event_source(lambda: start + dues[0], run)
    thread.start()
    await done.wait()
    assert loop.time() == start + 1.0
    thread.join()
    end()


@pytest.mark.anyio
async def test_ready_callbacks_run_before_the_next_event() -> None:
    order: list[str] = []

    def act() -> None:
        order.append("source")
        source.loop.call_soon(order.append, "callback")

    source = Metronome(act)
    await asyncio.sleep(1.1)
    assert order == ["source", "callback"] * 2
    source.end()


@pytest.mark.anyio
async def test_cancelled_timers_do_not_move_the_clock() -> None:
    source = Metronome()
    for _ in range(300):
        source.loop.call_later(0.1, source.ran.clear).cancel()
    await asyncio.sleep(0.75)
    assert source.ran == pytest.approx([0.5])
    source.end()


@pytest.mark.anyio
async def test_sockets_are_read_between_events() -> None:
    near, far = socket.socketpair()
    received: list[int] = []
    with near, far:
        near.setblocking(False)
        source = Metronome(lambda: far.send(b"x"))
        source.loop.add_reader(near, lambda: received.append(len(near.recv(10))))
        await asyncio.sleep(1.6)
        source.loop.remove_reader(near)
        source.end()
    assert received == [1, 1, 1]


@pytest.mark.anyio
async def test_event_sources_wait_for_a_running_executor() -> None:
    source, go_on = Metronome(), threading.Event()
    work = asyncio.get_running_loop().run_in_executor(None, go_on.wait, 10.0)
    for _ in range(100):
        await asyncio.sleep(0)
    assert not source.ran
    go_on.set()
    await work
    await asyncio.sleep(0.6)
    assert source.ran == pytest.approx([0.5])
    source.end()


@pytest.mark.anyio
async def test_error_of_an_event_source_is_reported() -> None:
    errors: list[dict[str, object]] = []
    source = Metronome(lambda: 1 / 0)
    source.loop.set_exception_handler(lambda _, context: errors.append(context))
    await asyncio.sleep(0.6)
    source.end()
    assert isinstance(errors[0]["exception"], ZeroDivisionError)


@pytest.mark.anyio
async def test_signals_arrive_while_events_run() -> None:
    source, arrived = Metronome(lambda: source.loop.call_soon(lambda: None)), asyncio.Event()
    source.loop.add_signal_handler(signal.SIGUSR1, arrived.set)
    os.kill(os.getpid(), signal.SIGUSR1)
    await asyncio.wait_for(arrived.wait(), 3600.0)
    source.loop.remove_signal_handler(signal.SIGUSR1)
    source.end()


@pytest.mark.anyio
async def test_signals_arrive_while_only_event_sources_run() -> None:
    def act() -> None:
        if len(source.ran) == 1:
            os.kill(os.getpid(), signal.SIGUSR1)
        if len(source.ran) == 1000:
            source.end()  # else a lost signal would never end the test

    source, arrived = Metronome(act), asyncio.Event()
    source.loop.add_signal_handler(signal.SIGUSR1, arrived.set)
    await arrived.wait()
    source.loop.remove_signal_handler(signal.SIGUSR1)
    assert len(source.ran) < 200
    source.end()
