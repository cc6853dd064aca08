"""Signals that end a flight safely before the program exits."""

from __future__ import annotations

import signal
import sys

import anyio
import anyio.lowlevel
import pytest

from aerokit.apps.cli.terminal import on_interrupt

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no signals of this kind")


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_on_interrupt_calls_callback_and_restores_handlers(number: str) -> None:
    tests_own = signal.getsignal(signal.Signals[number])
    if tests_own is signal.SIG_IGN:  # pytest itself runs under nohup
        signal.signal(signal.Signals[number], signal.SIG_DFL)
    before = signal.getsignal(signal.Signals[number])

    async def wait() -> None:
        printed = anyio.Event()
        with on_interrupt(printed.set):
            signal.raise_signal(signal.Signals[number])
            with anyio.fail_after(100):
                await printed.wait()

    try:
        anyio.run(wait)
        assert signal.getsignal(signal.Signals[number]) is before
    finally:
        signal.signal(signal.Signals[number], tests_own)


def test_on_interrupt_under_nohup_ignores_sighup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    printed: list[None] = []

    async def go_on() -> None:
        with on_interrupt(lambda: printed.append(None)):
            signal.raise_signal(signal.SIGHUP)
            await anyio.sleep(0.01)

    try:
        anyio.run(go_on)
        assert not printed
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_hang_up_sent_by_shell_and_kernel_interrupts_once() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    calls: list[None] = []

    async def hang_up_twice() -> None:
        with on_interrupt(lambda: calls.append(None)):
            for _ in range(2):
                signal.raise_signal(signal.SIGHUP)
                await anyio.lowlevel.checkpoint()
                await anyio.lowlevel.checkpoint()
            assert len(calls) == 1
            signal.raise_signal(signal.SIGINT)
            await anyio.lowlevel.checkpoint()
            await anyio.lowlevel.checkpoint()
            assert len(calls) == 2

    try:
        anyio.run(hang_up_twice)
    finally:
        signal.signal(signal.SIGHUP, before)
