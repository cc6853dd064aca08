"""`LogEntry`: one flight log that a vehicle has."""

from __future__ import annotations

from datetime import datetime

from aerokit.snapshot import Snapshot

__all__ = ["LogEntry"]


class LogEntry(Snapshot):
    """One flight log: its id for :meth:`Logs.download`, its size in bytes, and when it was last written.

    The time is None when the vehicle did not know it; the size of a log that is being written is that of the moment.
    """

    id: int
    size: int
    time_utc: datetime | None
