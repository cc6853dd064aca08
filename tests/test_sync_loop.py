"""The loop's thread: what many threads ask of it at once, what they cancel, its end, and children of the process."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from aerokit.errors import ConnectionClosed
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
