"""The loop's thread: what many threads ask of it at once, what they cancel, its end, and children of the process."""

from __future__ import annotations

import asyncio
import concurrent.futures
import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from aerokit.errors import ConnectionClosed, LinkOpenError
from aerokit.sync.loop_thread import LoopThread

LIMIT_S = 10.0


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    thread = LoopThread()
    yield thread
    thread.close()


async def nothing() -> None:
    pass


def test_the_loop_may_ask_itself_while_others_ask_it(loop: LoopThread) -> None:
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
    for each in askers:
        each.start()
    asking = threading.Thread(target=loop.run, args=(ask_itself,), daemon=True)
    asking.start()
    for each in (*askers, asking):
        each.join(LIMIT_S)
        assert not each.is_alive()
    assert asked


def test_the_loop_may_close_itself_while_others_ask_it(loop: LoopThread) -> None:
    ends: list[type[BaseException]] = []

    def ask() -> None:
        try:
            while True:
                loop.run(nothing)
        except ConnectionClosed as error:
            ends.append(type(error))

    askers = [threading.Thread(target=ask, daemon=True) for _ in range(3)]
    for each in askers:
        each.start()
    loop.call_soon(loop.close)
    for each in askers:
        each.join(LIMIT_S)
    assert ends == [ConnectionClosed] * 3


def test_what_waits_ends_with_the_loop_and_cleans_up(loop: LoopThread) -> None:
    ended, started = [], threading.Event()

    async def wait() -> None:
        try:
            started.set()
            await asyncio.sleep(1000)
        finally:
            ended.append(1)

    future = loop._start(wait)
    assert started.wait(LIMIT_S)
    loop.close()
    assert (ended, future.cancelled()) == ([1], True)


def test_an_exit_of_the_program_in_a_coroutine_is_the_callers(loop: LoopThread) -> None:
    async def leave() -> None:
        sys.exit(3)

    with pytest.raises(SystemExit, match="3"):
        loop.run(leave)
    loop.run(nothing)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_child_of_the_process_neither_uses_nor_waits_for_it(loop: LoopThread) -> None:
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
from aerokit.sync.vehicle import connect

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
def test_a_loop_that_cannot_start_is_an_error() -> None:
    """It needs several descriptors; however many there are, connecting does not wait for what never begins."""
    done = subprocess.run(
        [sys.executable, "-c", NO_DESCRIPTORS], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.startswith(
        f"0 {errno.EMFILE} the event loop's thread cannot start: Too many open files"
    )
    assert done.returncode in (0, 1)


def test_a_thread_that_cannot_start_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(LinkOpenError, match="the event loop's thread cannot start: can't start new thread"):
        LoopThread()


def test_interrupted_while_it_starts_it_ends_again(monkeypatch: pytest.MonkeyPatch) -> None:
    result, interruptions = concurrent.futures.Future.result, [KeyboardInterrupt()]

    def interrupted_once(future: concurrent.futures.Future[object]) -> object:
        if interruptions:
            raise interruptions.pop()
        return result(future)

    before = threading.active_count()
    monkeypatch.setattr(concurrent.futures.Future, "result", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        LoopThread()
    threads = [each for each in threading.enumerate() if each.name == "aerokit loop"]
    for each in threads:
        each.join(LIMIT_S)
    assert threading.active_count() <= before
