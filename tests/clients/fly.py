"""Flies the simulated vehicles with other client libraries, each in a process of its own; prints a table.

``python fly.py [--speedup 3] [--client pymavlink …] [--kind copter …]``; exit code 1 if one of them failed.
"""

# ruff: noqa: T201
from __future__ import annotations

import argparse
import importlib.metadata
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from steps import STEPS

HERE = Path(__file__).parent
CLIENTS = {"pymavlink": "pymavlink", "mavsdk": "mavsdk", "mavproxy": "MAVProxy"}
KINDS = ("copter", "px4")
MAX_DURATION_S = 300


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def served(kind: str, port: int, speedup: float) -> Iterator[None]:
    command = [sys.executable, str(HERE / "serve.py"), kind, str(port), "--speedup", str(speedup)]
    with subprocess.Popen(command) as server:
        try:
            yield
        finally:
            server.terminate()


def play(client: str, kind: str, speedup: float) -> tuple[list[str], str]:
    """The lines that a client printed, and the error when it did not do everything."""
    port = free_port()
    command = [sys.executable, str(HERE / f"with_{client}.py"), kind, str(port)]
    with served(kind, port, speedup), tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                command, cwd=folder, timeout=MAX_DURATION_S, check=False, text=True, stdin=subprocess.DEVNULL,
                capture_output=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            output = error.stdout or b""
            return _steps(output.decode() if isinstance(output, bytes) else output), f"over {MAX_DURATION_S} s"
    return _steps(done.stdout), "" if done.returncode == 0 else done.stderr[-2000:] or f"exit {done.returncode}"


def _steps(output: str) -> list[str]:
    return [line for line in output.splitlines() if line.split("\t")[0] in STEPS]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speedup", type=float, default=3.0)
    parser.add_argument("--client", action="append", choices=CLIENTS)
    parser.add_argument("--kind", action="append", choices=KINDS)
    arguments = parser.parse_args()
    failed = 0
    print("client\tvehicle\tresult\ttime\tsteps")
    for client in arguments.client or CLIENTS:
        for kind in arguments.kind or KINDS:
            began = time.monotonic()
            steps, error = play(client, kind, arguments.speedup)
            is_good = not error and len(steps) == len(STEPS)
            failed += not is_good
            name = f"{CLIENTS[client]} {importlib.metadata.version(client)}"
            words = ", ".join(" ".join(step.split("\t")).strip() for step in steps)
            took = time.monotonic() - began
            print(f"{name}\t{kind}\t{'passed' if is_good else 'FAILED'}\t{took:.0f} s\t{words}", flush=True)
            if not is_good:
                print(error or "not every step was done", flush=True)
    print(f"{len(arguments.client or CLIENTS) * len(arguments.kind or KINDS) - failed} passed, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
