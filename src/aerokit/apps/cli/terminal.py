"""A question at the terminal while the loop goes on: a vehicle minds when its ground station falls silent."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import threading
from contextlib import asynccontextmanager, contextmanager, suppress
from typing import TYPE_CHECKING

import anyio
from tqdm import tqdm

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

    from aerokit.protocols.exchange import OnProgress, Progress


def is_somebody_there() -> bool:
    """Whether questions can be asked at all."""
    return sys.stdin is not None and sys.stdin.isatty()


async def agrees(question: str) -> bool:
    """Whether somebody at the terminal says yes; the end of the input, and anything else, means no."""
    _forget_typed()
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    answer = await _line()
    return answer.strip().lower() in ("y", "yes")


def _forget_typed() -> None:
    """What was typed before the question was there is no answer to it."""
    try:
        import termios
    except ImportError:  # Windows
        return
    with suppress(termios.error, OSError, ValueError):  # no terminal
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


async def _line() -> str:
    loop = asyncio.get_running_loop()
    line: asyncio.Future[str] = loop.create_future()

    def answer(text: str) -> None:
        if not line.done():
            line.set_result(text)

    def read() -> None:
        text = sys.stdin.readline()
        loop.call_soon_threadsafe(answer, text)

    try:
        loop.add_reader(sys.stdin, read)
    except NotImplementedError:  # Windows
        threading.Thread(target=read, daemon=True).start()
        return await line
    try:
        return await line
    finally:
        loop.remove_reader(sys.stdin)


def _signals() -> tuple[signal.Signals, ...]:
    """SIGHUP, the end of the terminal, where there is one and nobody (nohup) has switched it off."""
    hang_up: signal.Signals | None = getattr(signal, "SIGHUP", None)
    if hang_up is None or signal.getsignal(hang_up) is signal.SIG_IGN:
        return signal.SIGINT, signal.SIGTERM
    return signal.SIGINT, signal.SIGTERM, hang_up


@contextmanager
def on_interrupt(
    callback: Callable[[], None], at_once: Callable[[int], object] = lambda number: None
) -> Iterator[None]:
    """While the block lasts, Ctrl-C, SIGTERM and SIGHUP call ``callback`` on the running loop and do nothing else.

    ``at_once(number)`` is called by the signal's handler before, also while something blocks the loop.
    """
    loop = asyncio.get_running_loop()
    signals = _signals()
    before = [signal.getsignal(number) for number in signals]

    def handle(number: int, _: object) -> None:
        at_once(number)
        loop.call_soon_threadsafe(callback)

    try:
        for number in signals:
            signal.signal(number, handle)
    except ValueError:  # not on the main thread, where alone signals can be handled
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


class Interruptible:
    """Runs functions that Ctrl-C ends; each Ctrl-C ends the innermost one only."""

    def __init__(self) -> None:
        self._scopes: list[anyio.CancelScope] = []

    def interrupt(self) -> None:
        """End the innermost one that runs."""
        if self._scopes:
            self._scopes[-1].cancel()

    async def run(self, function: Callable[[], Awaitable[int]]) -> int | None:
        """What the function gives, None when it was interrupted."""
        scope = anyio.CancelScope()
        with scope:
            self._scopes.append(scope)
            try:
                return await function()
            finally:
                self._scopes.remove(scope)
        return None


AFTER_S = 1.0
"""What is heard sooner is not worth a line."""

CLEAR_LINE = "\r\x1b[K"


@asynccontextmanager
async def waiting(
    options: argparse.Namespace, address: str, seconds: float, what: str = "a heartbeat"
) -> AsyncIterator[None]:
    """While the block lasts, say on stderr how many of these seconds are left: on a terminal, and not with --json."""
    if options.json or not sys.stderr.isatty():
        yield
        return
    task = asyncio.create_task(_count_down(f"waiting for {what} on {address}", seconds))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def _count_down(text: str, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    await asyncio.sleep(AFTER_S)
    try:
        while (left := until - loop.time()) > 0:
            print(f"{CLEAR_LINE}{text} … {left:.0f} s", end="", file=sys.stderr, flush=True)
            await asyncio.sleep(1.0)
    finally:
        print(CLEAR_LINE, end="", file=sys.stderr, flush=True)


class _Bar(tqdm):  # type: ignore[misc]  # it has no types
    monitor_interval = 0  # else a thread stays behind, which looks after bars that are rarely updated


@contextmanager
def progress_bar(what: str, unit: str) -> Iterator[OnProgress]:
    """Give the callback for ``on_progress``; ``unit`` is ``"B"`` for bytes, else the name of one thing."""
    is_bytes = unit == "B"
    with _Bar(
        desc=what,
        unit=unit if is_bytes else f" {unit}",
        unit_scale=is_bytes,
        unit_divisor=1024 if is_bytes else 1000,
        file=sys.stderr,
        disable=None,  # where standard error is no terminal
        leave=False,
        dynamic_ncols=True,
    ) as bar:

        def show(progress: Progress) -> None:
            if progress.total is not None:
                bar.total = progress.total
            bar.update(progress.done - bar.n)
            if progress.done == progress.total:
                bar.refresh()  # whatever was shown last, and however short ago

        yield show


def file_size(path: str | os.PathLike[str]) -> int:
    """Bytes in a file on this computer; OSError when it is not there."""
    return os.path.getsize(path)
