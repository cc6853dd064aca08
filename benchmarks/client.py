"""Shared code of the clients of ``transfers.py``: runs and times one task, and prints the result as JSON.

    python benchmarks/client_….py TASK METHOD PORT SIZE FOLDER

``METHOD`` is a transfer method of the library. Downloads are written to FOLDER (``out.json``, ``out.bin``); uploads
are read from there (``in.bin``).
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["Task", "run"]


class Task:
    """One task and its duration."""

    def __init__(self, name: str, method: str, port: int, size: int, folder: Path) -> None:
        self.name = name
        self.method = method
        self.port = port
        self.size = size
        self.folder = folder
        self.address = f"udpin:127.0.0.1:{port}"
        self._began_at = time.perf_counter()
        self._seconds: float | None = None

    @property
    def seconds(self) -> float:
        """Seconds from `begin` to `end`, or to now if the task has not ended."""
        return time.perf_counter() - self._began_at if self._seconds is None else self._seconds

    def begin(self) -> None:
        """Start the time, when the client is connected."""
        self._began_at = time.perf_counter()

    def end(self) -> None:
        """Stop the time, when the transfer is complete. Disconnecting is not measured."""
        self._seconds = self.seconds


def run(perform: Callable[[Task], Any]) -> None:
    """Run the task of the command line with one library. The last line of standard output is the result."""
    name, method, port, size, folder = sys.argv[1:]
    task = Task(name, method, int(port), int(size), Path(folder))
    outcome: dict[str, Any] = {}
    try:
        content = perform(task)
        task.end()
        if content is not None:
            (task.folder / "out.json").write_text(json.dumps(content))
    except Exception as error:
        task.end()
        outcome["error"] = f"{type(error).__name__}: {error}".partition("\n")[0][:200]
    print("\n" + json.dumps({"seconds": task.seconds, **outcome}), flush=True)
    os._exit(0)  # threads of some libraries would keep the process alive
