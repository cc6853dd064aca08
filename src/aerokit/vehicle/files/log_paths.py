"""Which file by MAVFTP is the log with this id: the two protocols name them differently."""

from __future__ import annotations

import logging
import re
from datetime import datetime
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.errors import FileError

if TYPE_CHECKING:
    from aerokit.protocols.exchange import OnProgress, Progress
    from aerokit.vehicle.files.files import FileEntry, Files

__all__ = ["GrowthWatch", "ListedLog", "LogEntry", "listed_logs", "log_path"]

ARDUPILOT_NAME = re.compile(r"(\d{8})\.BIN", re.IGNORECASE)

PX4_LIST = "logdata.txt"

PX4_LINE = re.compile(r"(\d+) (\d+) (\S+)")


class ListedLog(NamedTuple):
    """A line of the list that PX4 writes when it is asked for its logs; the line's number is the id."""

    time_utc: int
    size: int
    path: str


async def log_path(
    files: Files,
    directories: tuple[str, ...],
    log: LogEntry,
    patience_s: float,
    *,
    has_grown: bool = False,
) -> str | None:
    """The path of a log for MAVFTP; None when it is not certain.

    ArduPilot's log 1 is the oldest of its ``00000001.BIN``, and the others follow in the order of their numbers. PX4
    writes its list to a file when it is asked for it, in the order of the ids, with the paths. In both cases the size
    must be that of the entry, or larger for a log that still grows, or (``has_grown``) may have been growing.
    """
    for directory in directories:
        try:
            entries = await files.list(directory, patience_s=patience_s)
        except FileError:
            continue
        numbered = {
            int(match[1]): entry for entry in entries if (match := ARDUPILOT_NAME.fullmatch(entry.name))
        }
        if numbered:
            return _numbered_path(directory, numbered, log, has_grown)
        if any(entry.is_directory for entry in entries):
            logs = await _list_in(files, directory, patience_s)
            is_there = log.id < len(logs) and logs[log.id].size == log.size
            return logs[log.id].path if is_there else None
    return None


async def listed_logs(
    files: Files, directories: tuple[str, ...], patience_s: float
) -> tuple[ListedLog, ...] | None:
    """The logs by PX4's list, which must have been asked for; None when there are logs and no list."""
    for directory in directories:
        try:
            entries = await files.list(directory, patience_s=patience_s)
        except FileError:
            continue
        logs = await _list_in(files, directory, patience_s)
        return None if entries and not logs else logs
    return ()


async def _list_in(files: Files, directory: str, patience_s: float) -> tuple[ListedLog, ...]:
    """The list beside the directory of the logs; an empty tuple when there is none."""
    root = directory.rpartition("/")[0]
    try:
        text = await files.read(f"{root}/{PX4_LIST}", patience_s=patience_s)
    except FileError:
        return ()
    matches = [PX4_LINE.fullmatch(line) for line in text.decode("utf-8", "replace").splitlines()]
    logs = [
        ListedLog(int(match[1]), int(match[2]), f"{directory}/{match[3].partition('/log/')[2]}")
        for match in matches
        if match is not None
    ]
    return tuple(logs) if len(logs) == len(matches) else ()


def _numbered_path(
    directory: str, entries: dict[int, FileEntry], log: LogEntry, has_grown: bool
) -> str | None:
    number = min(entries) + log.id - 1
    entry = entries.get(number)
    if entry is None or entry.size is None:
        return None
    may_be_larger = has_grown or number == max(entries)
    is_it = entry.size >= log.size if may_be_larger else entry.size == log.size
    return f"{directory}/{entry.name}" if is_it else None


class LogEntry(Snapshot):
    """One flight log: its id for :meth:`Logs.download`, its size in bytes, and when it was last written.

    The time is None when the vehicle did not know it; the size of a log that is being written is that of the moment.
    """

    id: int
    size: int
    time_utc: datetime | None


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
