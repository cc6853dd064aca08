"""The loop thread: concurrent calls, cancellation, closing, forked processes."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import linecache
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import anyio
import pytest

from aerokit.errors import ConnectionClosed, LinkOpenError
from aerokit.sync.blocks import BlockTwin
from aerokit.sync.loop_thread import LoopThread

LIMIT_S = 100.0


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    thread = LoopThread()
    yield thread
    thread.close()


async def nothing() -> None:
    pass


def test_call_soon_on_loop_during_calls_of_other_threads(loop: LoopThread) -> None:
    end = time.monotonic() + 0.3
    asked: list[int] = []

    async def ask_itself() -> None:
        while time.monotonic() < end:
            loop.call_soon(asked.append, 1)
            await asyncio.sleep(0)

    def ask() -> None:
        while time.monotonic() < end:
            loop.run(nothing)

    askers = [threading.Thread(target=ask, daemon=True) for _ in range(3)]
    for asker in askers:
        asker.start()
    asking = threading.Thread(target=loop.run, args=(ask_itself,), daemon=True)
    asking.start()
    for thread in (*askers, asking):
        thread.join(LIMIT_S)
        assert not thread.is_alive()
    assert asked


def test_close_on_loop_during_calls_of_other_threads(loop: LoopThread) -> None:
    ends: list[type[BaseException]] = []

    def ask() -> None:
        try:
            while True:
                loop.run(nothing)
        except ConnectionClosed as error:
            ends.append(type(error))

    askers = [threading.Thread(target=ask, daemon=True) for _ in range(3)]
    for asker in askers:
        asker.start()
    loop.call_soon(loop.close)
    for thread in askers:
        thread.join(LIMIT_S)
    assert ends == [ConnectionClosed] * 3


def test_waiting_calls_clean_up_when_loop_closes(loop: LoopThread) -> None:
    ended, started = [], threading.Event()

    async def wait() -> None:
        try:
            started.set()
            await asyncio.sleep(1000)
        finally:
            ended.append(1)

    errors: list[type[BaseException]] = []

    def ask() -> None:
        try:
            loop.run(wait)
        except ConnectionClosed as error:
            errors.append(type(error))

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    assert started.wait(LIMIT_S)
    loop.close()
    asking.join(LIMIT_S)
    assert (ended, errors) == ([1], [ConnectionClosed])


def test_system_exit_in_coroutine_is_raised_in_caller(loop: LoopThread) -> None:
    async def leave() -> None:
        sys.exit(3)

    with pytest.raises(SystemExit, match="3"):
        loop.run(leave)
    loop.run(nothing)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_forked_child_does_not_use_the_loop(loop: LoopThread) -> None:
    child = os.fork()
    if child == 0:  # pragma: no cover - another process
        errors = 0
        uses: tuple[Callable[[], None], ...] = (lambda: loop.run(nothing), lambda: loop.call_soon(print))
        for use in uses:
            try:
                use()
            except ConnectionClosed:
                errors += 1
        loop.close()
        os._exit(errors)
    deadline = time.monotonic() + LIMIT_S
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
        if time.monotonic() > deadline:
            os.kill(child, 9)
        time.sleep(0.01)
    assert os.waitstatus_to_exitcode(ended[1]) == 2
    loop.run(nothing)


NO_DESCRIPTORS = """
import os
import subprocess
import resource
import aerokit.sync
from aerokit.errors import LinkOpenError
from aerokit.sync.twins import connect

resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
taken = []
try:
    while True:
        taken.append(os.dup(0))
except OSError:
    pass
for spare in range(4):
    try:
        connect("udpin:127.0.0.1:0", timeout=0.01)
    except LinkOpenError as error:
        print(spare, error.errno, error)
    os.close(taken.pop())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of descriptors to set")
def test_loop_start_failure_raises() -> None:
    """The loop needs several file descriptors; connecting fails at once with any smaller number."""
    done = subprocess.run(
        [sys.executable, "-c", NO_DESCRIPTORS], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout.startswith(f"0 {errno.EMFILE} the event loop's thread cannot start: Too many open files")
    assert done.returncode in (0, 1)


def test_thread_start_failure_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(LinkOpenError, match="the event loop's thread cannot start: can't start new thread"):
        LoopThread()


def uses_of_the_loop(loops: list[LoopThread]) -> None:
    """A short blocking program."""
    loop = LoopThread()
    loops.append(loop)
    try:
        held = loop.open_context(contextlib.AsyncExitStack())
        loop.run(nothing)
        loop.call(len, "")
        with pytest.raises(ConnectionClosed):
            loop.run(fail)
        held.close()
    finally:
        loop.close()


async def fail() -> None:
    await asyncio.sleep(0)
    raise ConnectionClosed("as asked for")


Place = tuple[str, int]


def interrupted_at(place: Place | None, use: Callable[[list[LoopThread]], object] = uses_of_the_loop) -> set[Place]:
    """Raise KeyboardInterrupt when the main thread first reaches this place; return the places it has visited."""
    observed: set[Place] = set()

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        here = (frame.f_code.co_filename, frame.f_lineno)
        if event != "line" or here in observed:
            return trace
        observed.add(here)
        if here == place:
            raise KeyboardInterrupt
        return trace

    before, loops = sys.gettrace(), list[LoopThread]()
    sys.settrace(trace)
    try:
        use(loops)
    finally:
        sys.settrace(before)
        for loop in loops:  # where closing was interrupted, it can be closed again
            loop.close()
    return observed


@pytest.mark.parametrize(
    ("method", "flags"), [("run_shielded", "is_shielded=True, must_start=True"), ("run_exit", "must_start=True")]
)
def test_clean_up_completes_wherever_ctrl_c_arrives(method: str, flags: str) -> None:
    """Interrupt at every line of aerokit except the calls themselves, where it cannot be noticed yet."""
    done: list[int] = []

    async def work() -> None:
        with anyio.CancelScope(shield=True):  # like code that restores values
            await asyncio.sleep(0)
            done.append(1)

    def use(loops: list[LoopThread]) -> None:
        getattr(loops[0], method)(work)

    def interrupted(place: Place | None) -> set[Place]:
        loop = LoopThread()
        try:
            return interrupted_at(place, lambda _: use([loop]))
        finally:
            loop.close()

    places = {place for place in interrupted(None) if place[0].endswith(("loop_thread.py", "thread_future.py"))}
    assert len(places) > 20
    left_undone, was_come_to = set(), set()
    for place in places:
        done.clear()
        try:
            interrupted(place)  # this time it may not come there: which thread is quicker decides
        except KeyboardInterrupt:
            was_come_to.add(place)
            if not done:
                left_undone.add(linecache.getline(*place).strip())
    assert len(was_come_to) > 20
    assert left_undone == {
        f"return self._run_call(function, args, kwargs, {flags})",
        "call: _Call[T] | None = None",
        "try:",
    }


def test_ctrl_c_is_never_lost_and_leaves_no_threads() -> None:
    """Interrupt at every line that the main thread runs in aerokit and threading, but not in contextlib and pytest."""
    ours = ("loop_thread.py", "thread_future.py", "threading.py")
    # Interrupted at these lines of Condition.__init__, CPython keeps the AttributeError as context of later exceptions.
    handled = ("except AttributeError:", "pass")
    places = sorted(
        place
        for place in interrupted_at(None)
        if place[0].endswith(ours) and linecache.getline(*place).strip() not in handled
    )
    assert len(places) > 80
    lost = []
    for place in places:
        try:
            interrupted_at(place)
        except KeyboardInterrupt:
            continue
        except BaseException as error:
            lost.append((place, error))
    for thread in threading.enumerate():
        if thread.ident is None:  # CPython still lists a thread whose start was interrupted.
            threading._limbo.pop(thread, None)  # type: ignore[attr-defined]
        elif thread.name == "aerokit loop":
            thread.join(LIMIT_S)
            assert not thread.is_alive()
    assert lost == []


def test_block_is_left_if_ctrl_c_comes_before_its_exit(monkeypatch: pytest.MonkeyPatch) -> None:
    class Block:
        is_left = False

        async def __aenter__(self) -> Block:
            return self

        async def __aexit__(self, *_: object) -> None:
            self.is_left = True

    start, interruptions = LoopThread._start, [KeyboardInterrupt]

    def interrupted_start(loop: LoopThread, call: Any) -> None:
        if interruptions:
            raise interruptions.pop()
        start(loop, call)

    loop, block = LoopThread(), Block()
    twin: BlockTwin[Any] = BlockTwin(loop, block)
    try:
        twin.__enter__()
        monkeypatch.setattr(LoopThread, "_start", interrupted_start)
        with pytest.raises(KeyboardInterrupt):
            twin.__exit__(None, None, None)
    finally:
        loop.close()
    assert block.is_left
