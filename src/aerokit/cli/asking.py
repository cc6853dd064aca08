"""A question at the terminal while the loop goes on: a vehicle minds when its ground station falls silent."""

from __future__ import annotations

import asyncio
import sys
import threading
from contextlib import suppress

__all__ = ["agrees", "is_somebody_there"]


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
