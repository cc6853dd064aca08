"""Which signals bring a vehicle down before the program ends."""

from __future__ import annotations

import signal
import sys

import anyio
import pytest

from aerokit.apps.cli.terminal import on_interrupt

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no signals of this kind")


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_it_is_told_and_what_was_before_comes_back(number: str) -> None:
    tests_own = signal.getsignal(signal.Signals[number])
    if tests_own is signal.SIG_IGN:  # pytest itself runs under nohup
        signal.signal(signal.Signals[number], signal.SIG_DFL)
    before = signal.getsignal(signal.Signals[number])

    async def wait() -> None:
        told = anyio.Event()
        with on_interrupt(told.set):
            signal.raise_signal(signal.Signals[number])
            with anyio.fail_after(100):
                await told.wait()

    try:
        anyio.run(wait)
        assert signal.getsignal(signal.Signals[number]) is before
    finally:
        signal.signal(signal.Signals[number], tests_own)


def test_under_nohup_the_end_of_the_terminal_is_nothing() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    told: list[None] = []

    async def go_on() -> None:
        with on_interrupt(lambda: told.append(None)):
            signal.raise_signal(signal.SIGHUP)
            await anyio.sleep(0.01)

    try:
        anyio.run(go_on)
        assert not told
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
