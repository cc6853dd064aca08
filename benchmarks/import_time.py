"""Import time, with each import in a new process, in turns.

    python benchmarks/import_time.py

The time in milliseconds does not include the start of the interpreter. Byte code is on disk, as in every run of a
program but the first.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from tempfile import TemporaryDirectory

from table import Row, faster_is_better

__all__ = ["rows"]

AEROKIT = "import aerokit"
AEROKIT_READY = "import aerokit; aerokit.connect"
DIALECT = "import pymavlink.dialects.v20.ardupilotmega"
MAVUTIL = "import pymavlink.mavutil"
STATEMENTS = (AEROKIT, DIALECT, AEROKIT_READY, MAVUTIL)


def rows(rounds: int = 25, *, fresh_byte_code: bool = True) -> list[Row]:
    """Measure ``import``, and ``import_ready`` with all modules needed to connect, including asyncio and mavutil."""
    durations_ms: dict[str, list[float]] = {statement: [] for statement in STATEMENTS}
    with TemporaryDirectory() as folder:
        byte_code_folder = folder if fresh_byte_code else None
        if byte_code_folder:
            for statement in STATEMENTS:  # compiles the modules
                _import_ms(statement, byte_code_folder)
        for _ in range(rounds):
            for statement, series in durations_ms.items():
                series.append(_import_ms(statement, byte_code_folder))
    return [
        _row("import", durations_ms[AEROKIT], durations_ms[DIALECT], DIALECT, aim=1 / 1.5),
        _row("import_ready", durations_ms[AEROKIT_READY], durations_ms[MAVUTIL], MAVUTIL, aim=1 / 2),
    ]


def _row(name: str, own: list[float], peer: list[float], statement: str, *, aim: float) -> Row:
    return faster_is_better(name, own, peer, statement, unit="ms", aim=aim)


def _import_ms(statement: str, byte_code_folder: str | None) -> float:
    program = f"from time import perf_counter as now; started = now(); {statement}; print(now() - started)"
    environment = {**os.environ, "MAVLINK20": "1"}  # makes mavutil import the dialect of MAVLink 2
    if byte_code_folder:
        environment["PYTHONPYCACHEPREFIX"] = byte_code_folder
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-c", program]
    completed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(completed.stdout) * 1000


if __name__ == "__main__":
    sys.stdout.write(json.dumps(rows(), indent=2) + "\n")
