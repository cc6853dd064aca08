"""One run: a vehicle process, a client process with one of the libraries, and the client's result."""

from __future__ import annotations

import compileall
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["LIBRARIES", "Library", "compile_aerokit", "installed", "run"]

HERE = Path(__file__).resolve().parent
LIMIT_S = 180.0


@dataclass(frozen=True)
class Library:
    """A library to measure: its name, the module to import, and the interpreter that has it."""

    name: str
    title: str
    module: str
    python: str


LIBRARIES = (
    Library("aerokit", "aerokit", "aerokit.dronekit", sys.executable),
    Library("dronekit", "DroneKit 2.9.2", "dronekit", os.environ.get("AEROKIT_DRONEKIT_PYTHON", sys.executable)),
    Library("dronekit2", "dronekit2 3.0", "dronekit", os.environ.get("AEROKIT_DRONEKIT2_PYTHON", sys.executable)),
)


def compile_aerokit() -> None:
    """Compile aerokit to byte code, as installers do for the other libraries, so that no measurement includes this."""
    import aerokit

    compileall.compile_dir(Path(aerokit.__file__).parent, quiet=1)


def installed(library: Library) -> bool:
    """Return True if the distribution is installed. Both peers have the same import name, so importing is no test."""
    if library.name == "aerokit":
        return True
    code = f"import importlib.metadata; importlib.metadata.version({library.name!r})"
    return subprocess.run([library.python, "-c", code], capture_output=True).returncode == 0


def run(
    library: Library,
    vehicle: dict[str, Any] | None,
    task: dict[str, Any],
    *,
    rate: str | None = None,
) -> dict[str, Any]:
    """Run a task with a library and a vehicle with these options.

    ``rate`` is the message rate of the vehicle once the client is connected. Returns the client's result, with the
    ``stamps`` of the vehicle if it streamed. Raises RuntimeError if the client failed.
    """
    if vehicle is None:
        with _client(library, task) as client:
            return _wait_for_result(client, None, None)
    port = _free_port()
    scheme = "udpin" if vehicle.get("transport", "udp") == "udp" else "tcp"
    with _vehicle({**vehicle, "port": port}) as server:
        with _client(library, {**task, "address": f"{scheme}:127.0.0.1:{port}"}) as client:
            result = _wait_for_result(client, server, rate)
        if task["task"] == "latency":
            _write_line(server, "stamps")
            result["stamps"] = json.loads(_read_line(server))
        return result


def _wait_for_result(
    client: subprocess.Popen[str], server: subprocess.Popen[str] | None, rate: str | None
) -> dict[str, Any]:
    """Return the client's result. Meanwhile, start the vehicle and set its rate as the client makes progress."""
    while True:
        line = _read_line(client).strip()
        if line == "connecting" and server is not None:
            _write_line(server, "go")
        elif line == "connected" and server is not None and rate is not None:
            _write_line(server, f"rate {rate}")
        elif line.startswith("{"):
            result: dict[str, Any] = json.loads(line)
            return result


@contextmanager
def _client(library: Library, task: dict[str, Any]) -> Iterator[subprocess.Popen[str]]:
    command = [library.python, str(HERE / "client_classic.py"), library.module, json.dumps(task)]
    with _process(command) as process:
        yield process


@contextmanager
def _vehicle(options: dict[str, Any]) -> Iterator[subprocess.Popen[str]]:
    with _process([sys.executable, str(HERE / "dronekit_vehicle.py"), json.dumps(options)]) as process:
        if _read_line(process).strip() != "ready":
            raise RuntimeError("the scripted vehicle did not start")
        yield process


@contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def _write_line(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


def _read_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{process.args!r} ended without a result")
    return line


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        _, port = probe.getsockname()
        return int(port)
