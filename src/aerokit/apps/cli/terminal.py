"""Terminal interaction that does not block the event loop: questions, Ctrl-C, countdowns and progress bars.

The loop must run during a question, because a vehicle starts a failsafe when the ground station's heartbeats stop.
"""

from __future__ import annotations

import asyncio
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

    from aerokit.protocols.exchange import OnProgress, TransferProgress

# The countdown is shown only after this time, because a vehicle usually answers sooner.
COUNTDOWN_DELAY_S = 1.0
CLEAR_LINE = "\r\x1b[K"


def is_interactive() -> bool:
    return sys.stdin is not None and sys.stdin.isatty()


async def confirm(question: str) -> bool:
    """Ask a yes/no question. At the end of the input, the answer is no."""
    _discard_typed_input()
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    try:
        answer = await _read_line()
    except asyncio.CancelledError:  # Ctrl-C was pressed: end the line of the question
        print(file=sys.stderr, flush=True)
        raise
    return answer.strip().lower() in ("y", "yes")


async def wait_for_enter() -> bool:
    """Wait for a line of input. Return False at the end of the input."""
    _discard_typed_input()
    print("  press Enter when done (Ctrl-C cancels) ", end="", file=sys.stderr, flush=True)
    return bool(await _read_line())


def _discard_typed_input() -> None:
    """Discard earlier input, because it cannot answer a question that is asked only now."""
    try:
        import termios
    except ImportError:  # on Windows
        return
    with suppress(termios.error, OSError, ValueError):  # raised if stdin is not a terminal
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


async def _read_line() -> str:
    """Read a line from stdin without blocking the loop. At the end of the input, it is empty."""
    loop = asyncio.get_running_loop()
    line: asyncio.Future[str] = loop.create_future()

    def set_line(text: str) -> None:
        if not line.done():
            line.set_result(text)

    def read() -> None:
        try:
            text = sys.stdin.readline()
        except (OSError, ValueError):  # the terminal has gone, or the input is not text
            text = ""
        loop.call_soon_threadsafe(set_line, text)

    try:
        loop.add_reader(sys.stdin, read)
    except (NotImplementedError, PermissionError):  # on Windows; and on Linux, if stdin is a file or /dev/null
        threading.Thread(target=read, daemon=True).start()
        return await line
    try:
        return await line
    finally:
        loop.remove_reader(sys.stdin)


def _signals() -> tuple[signal.Signals, ...]:
    hang_up: signal.Signals | None = getattr(signal, "SIGHUP", None)  # Windows has no SIGHUP
    if hang_up is None or signal.getsignal(hang_up) is signal.SIG_IGN:  # nohup sets SIG_IGN
        return signal.SIGINT, signal.SIGTERM
    return signal.SIGINT, signal.SIGTERM, hang_up


@contextmanager
def on_interrupt(
    callback: Callable[[], None], in_handler: Callable[[int], object] = lambda number: None
) -> Iterator[None]:
    """Within the block, SIGINT, SIGTERM and SIGHUP only call ``callback`` on the running loop.

    The signal handler itself calls ``in_handler(signal number)``, even while the loop is blocked.
    """
    loop = asyncio.get_running_loop()
    signals = _signals()
    previous_handlers = [signal.getsignal(number) for number in signals]
    has_hung_up = False

    def handle(number: int, _: object) -> None:
        nonlocal has_hung_up
        # When a terminal or an SSH session ends, both the shell and the kernel send a SIGHUP, a moment apart. The
        # second SIGHUP is ignored. Like a second Ctrl-C, it would cancel the action that makes the vehicle safe.
        if number not in (signal.SIGINT, signal.SIGTERM):
            if has_hung_up:
                return
            has_hung_up = True
        in_handler(number)
        loop.call_soon_threadsafe(callback)

    try:
        for number in signals:
            signal.signal(number, handle)
    except ValueError:  # signal handlers can be set only in the main thread
        yield
        return
    try:
        yield
    finally:
        for number, handler in zip(signals, previous_handlers, strict=True):
            signal.signal(number, handler)


class InterruptStack:
    """A stack of running functions. An interrupt cancels only the innermost function."""

    def __init__(self) -> None:
        self._scopes: list[anyio.CancelScope] = []

    def interrupt(self) -> None:
        if self._scopes:
            self._scopes[-1].cancel()

    async def run(self, function: Callable[[], Awaitable[int]]) -> int | None:
        """Run a function and return its result; None if it was interrupted."""
        scope = anyio.CancelScope()
        with scope:
            self._scopes.append(scope)
            try:
                return await function()
            finally:
                self._scopes.remove(scope)
        return None


@asynccontextmanager
async def showing_countdown(
    options: argparse.Namespace, address: str, seconds: float, what: str = "a heartbeat"
) -> AsyncIterator[None]:
    """Within the block, show a countdown of ``seconds`` on stderr, such as "waiting for a heartbeat on COM3 … 9 s".

    Nothing is shown with ``--json`` or without a terminal.
    """
    if options.json or not sys.stderr.isatty():
        yield
        return
    task = asyncio.create_task(_count_down(f"waiting for {what} on {address}", seconds))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})


async def _count_down(text: str, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    deadline = loop.time() + seconds
    await asyncio.sleep(COUNTDOWN_DELAY_S)
    try:
        while (remaining_s := deadline - loop.time()) > 0:
            print(f"{CLEAR_LINE}{text} … {remaining_s:.0f} s", end="", file=sys.stderr, flush=True)
            await asyncio.sleep(1.0)
    finally:
        print(CLEAR_LINE, end="", file=sys.stderr, flush=True)


class _Bar(tqdm):  # type: ignore[misc]  # tqdm has no annotations
    monitor_interval = 0  # without this, tqdm starts a monitor thread that never ends


@contextmanager
def progress_bar(what: str, *, unit: str | None) -> Iterator[OnProgress]:
    """Show a progress bar within the block, and yield the ``on_progress`` callback.

    ``unit`` is ``"B"`` for bytes or a singular noun. With None, the bar shows only a percentage.
    """
    is_bytes = unit == "B"
    with _Bar(
        desc=what,
        unit=unit if is_bytes else f" {unit}",
        bar_format=None if unit else "{desc}: {percentage:3.0f} %|{bar}| {elapsed}",
        unit_scale=is_bytes,
        unit_divisor=1024 if is_bytes else 1000,
        file=sys.stderr,
        disable=None,  # None hides the bar if stderr is not a terminal
        leave=False,
        dynamic_ncols=True,
    ) as bar:

        def show(progress: TransferProgress) -> None:
            if progress.total is not None:
                bar.total = progress.total
            bar.update(progress.done - bar.n)
            if progress.done == progress.total:
                bar.refresh()  # at once, regardless of tqdm's minimum interval

        yield show
