from __future__ import annotations

import asyncio
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

    # An earlier test may have left a thread of another package.
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with pytest.raises(DeadlockError, match="nothing left to wait for") as caught:
        run_virtual(wait_forever())
    assert "locks.py" in str(caught.value)
    assert "Event.wait" in str(caught.value)


def test_silent_socket_raises_after_deadlock_timeout() -> None:
    async def receive_without_sender() -> None:
        left, right = socket.socketpair()
        with left, right:
            left.setblocking(False)
            await asyncio.get_running_loop().sock_recv(left, 1)

    loop = VirtualClockLoop(deadlock_timeout_s=0.01)
    task = loop.create_task(receive_without_sender())
    with pytest.raises(DeadlockError, match="no socket or thread woke the loop"):
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


async def _jumps(prepare: Callable[[VirtualClockLoop], object] = lambda _: None) -> bool:
    """Return True if a jump of one second succeeds inside a callback; the clock has advanced only then."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualClockLoop)
    found: asyncio.Future[bool] = loop.create_future()

    def jump() -> None:
        kept = prepare(loop)
        before = loop.time()
        has_jumped = loop.jump(before + 1.0)
        assert loop.time() - before == pytest.approx(1.0 if has_jumped else 0.0)
        del kept
        found.set_result(has_jumped)

    loop.call_soon(jump)
    return await found


@pytest.mark.anyio
async def test_callback_may_jump_while_idle() -> None:
    assert await _jumps()
    assert await _jumps(lambda loop: loop.call_later(1.5, lambda: None))


@pytest.mark.anyio
@pytest.mark.parametrize("delay", [0.5, 1.0], ids=["before", "at the same instant"])
async def test_earlier_timer_prevents_jump(delay: float) -> None:
    assert not await _jumps(lambda loop: loop.call_later(delay, lambda: None))


@pytest.mark.anyio
async def test_cancelled_timer_allows_jump() -> None:
    assert await _jumps(lambda loop: loop.call_later(0.5, lambda: None).cancel())
    assert asyncio.get_running_loop().time() == pytest.approx(1.0)
    await asyncio.sleep(1.0)


@pytest.mark.anyio
async def test_ready_callback_prevents_jump() -> None:
    assert not await _jumps(lambda loop: loop.call_soon(lambda: None))


@pytest.mark.anyio
async def test_foreign_socket_prevents_jump() -> None:
    near, far = socket.socketpair()
    loop = asyncio.get_running_loop()
    with near, far:
        near.setblocking(False)
        loop.add_reader(near, lambda: None)
        assert not await _jumps()
        loop.remove_reader(near)
        assert await _jumps()


@pytest.mark.anyio
async def test_running_executor_prevents_jump() -> None:
    go_on = threading.Event()
    work = asyncio.get_running_loop().run_in_executor(None, go_on.wait, 10.0)
    assert not await _jumps()
    go_on.set()
    await work
    assert await _jumps()
