"""Flight logs of a vehicle for programs without ``async``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.protocols.transfer import PATIENCE_S
from aerokit.vehicle.logs import ERASE_PATIENCE_S

if TYPE_CHECKING:
    import os

    from aerokit.protocols.transfer import OnProgress
    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.logs import LogEntry, LogMethod
    from aerokit.vehicle.logs import Logs as AsyncLogs

__all__ = ["Logs"]


class Logs:
    """Lists, downloads and erases flight logs; arguments and errors are those of :class:`aerokit.vehicle.logs.Logs`.

    ``on_progress`` is called on the loop's thread.
    """

    def __init__(self, loop: LoopThread, logs: AsyncLogs) -> None:
        self._loop, self._logs = loop, logs

    def list(self, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> tuple[LogEntry, ...]:
        """Return the logs that the vehicle has, the oldest first."""
        return self._loop.run(self._logs.list, patience_s=patience_s, timeout=timeout)

    def download(
        self,
        log: LogEntry | int,
        to: str | os.PathLike[str],
        *,
        resume: bool = True,
        method: LogMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Copy a log to the disk of this computer, by default from where an earlier download was interrupted."""
        self._loop.run(
            self._logs.download,
            log,
            to,
            resume=resume,
            method=method,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def read(
        self,
        log: LogEntry | int,
        *,
        method: LogMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> bytes:
        """Return the content of a log."""
        return self._loop.run(
            self._logs.read,
            log,
            method=method,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def erase(self, *, patience_s: float = ERASE_PATIENCE_S, timeout: float | None = None) -> None:
        """Erase all logs, and wait until they are gone."""
        self._loop.run(self._logs.erase, patience_s=patience_s, timeout=timeout)
