"""``GrowthWatch``: tells when more of a log was read than its entry says."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.protocols.transfer import OnProgress, Progress
    from aerokit.vehicle.files.log_entry import LogEntry

__all__ = ["GrowthWatch"]

logger: logging.Logger = logging.getLogger("aerokit")


class GrowthWatch:
    """Passes progress on, and tells in the log when there is more of a log than its entry says."""

    def __init__(self, entry: LogEntry, on_progress: OnProgress | None) -> None:
        self._entry, self._on_progress = entry, on_progress
        self._size = entry.size

    def __call__(self, progress: Progress) -> None:
        """As an OnProgress."""
        self._size = progress.total or self._size
        if self._on_progress is not None:
            self._on_progress(progress)

    def tell(self) -> None:
        """The end has come."""
        if self._size > self._entry.size:
            logger.info(
                "log %d was still being written when it was listed with %d bytes: it had %d when it was asked for, and"
                " they were read",
                self._entry.id,
                self._entry.size,
                self._size,
            )
