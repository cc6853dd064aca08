"""Measures real time and the processor time of this process."""

from __future__ import annotations

import time

__all__ = ["Stopwatch"]


class Stopwatch:
    """Starts when it is created."""

    def __init__(self) -> None:
        self._started_at = time.perf_counter()
        self._cpu_at_start_s = time.process_time()

    @property
    def real_s(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._started_at

    @property
    def cpu_s(self) -> float:
        """Processor time since the start, in seconds, of all threads."""
        return time.process_time() - self._cpu_at_start_s
