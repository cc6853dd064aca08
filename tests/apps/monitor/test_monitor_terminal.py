"""``aerokit monitor`` in a pseudo-terminal that is closed: the process ends and frees its port."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from exhaustive import exhaustive

from aerokit.apps.cli.listening import EXIT_TIMEOUT_S
from aerokit.apps.cli.output import INTERRUPTED

if sys.platform == "win32":
    pytest.skip("there are no pseudo-terminals", allow_module_level=True)

SOURCES = Path(__file__).parents[3] / "src"
LIMIT_S = 200.0
MONITOR = "import sys; from aerokit.apps.cli.main import main; sys.exit(main(['monitor', {address!r}]))"
BLOCKED = f"""
import time
from aerokit.apps.monitor.app import Monitor
Monitor.update_view = lambda self: time.sleep(3600)
{MONITOR}
"""


def free_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return f"udpin:127.0.0.1:{found.getsockname()[1]}"


@contextmanager
def in_a_terminal(program: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """The process, and the other end of the terminal that controls it; the shell opens it first, so it is its own."""
    near, far = os.openpty()
    name = os.ttyname(far)
    process = subprocess.Popen(
        ["/bin/sh", "-c", 'exec "$@" <>"$0" >&0 2>&0', name, sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(SOURCES), "TERM": "xterm-256color"},
        start_new_session=True,
    )
    try:
        yield process, near
    finally:
        process.kill()
        process.wait()
        os.close(far)


def wait_until_drawn(terminal: int) -> None:
    seen, deadline = b"", time.monotonic() + LIMIT_S
    while b"waiting for the heartbeat" not in seen and b"\x1b[?1049h" not in seen:
        assert time.monotonic() < deadline, seen
        if select.select([terminal], [], [], 0.1)[0]:
            seen += os.read(terminal, 65536)


@pytest.mark.parametrize("later_s", [0.0, *map(exhaustive, [0.3, 0.7, 1.1])])
def test_closed_terminal_ends_monitor_and_frees_port(later_s: float) -> None:
    address = free_address()
    with in_a_terminal(MONITOR.format(address=address)) as (process, terminal):
        wait_until_drawn(terminal)
        end = time.monotonic() + later_s
        while (left := end - time.monotonic()) > 0:
            if select.select([terminal], [], [], left)[0]:
                os.read(terminal, 65536)
        os.close(terminal)
        process.wait(LIMIT_S)
    host, port = address.removeprefix("udpin:").split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind((host, int(port)))


@pytest.mark.parametrize("number", [signal.SIGTERM, exhaustive(signal.SIGHUP)])
def test_signal_ends_monitor_with_blocked_loop(number: signal.Signals) -> None:
    with in_a_terminal(BLOCKED.format(address=free_address())) as (process, terminal):
        wait_until_drawn(terminal)
        time.sleep(0.5)  # longer does no harm: it is blocked then
        began = time.monotonic()
        process.send_signal(number)
        assert process.wait(LIMIT_S) == INTERRUPTED
        assert time.monotonic() - began >= EXIT_TIMEOUT_S - 0.5
        os.close(terminal)
