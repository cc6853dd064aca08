"""``convert``: a flight log in another format, whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.logs.convert.mcap import McapFile
from aerokit.logs.convert.tables import CsvTable, FlightTable, MessageTables, ParquetTable
from aerokit.logs.convert.tracks import GpxFile, KmlFile
from aerokit.logs.flights.entries import TlogFile
from aerokit.logs.flights.flight_controllers import BinFile, UlogFile
from aerokit.protocols.exchange import Progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.logs.flights.entries import Entry, Log
    from aerokit.protocols.exchange import OnProgress

LOGS: dict[str, type[Log]] = {".tlog": TlogFile, ".bin": BinFile, ".ulg": UlogFile}
"""Suffix of a log → what reads it."""


class _Writer(Protocol):
    written: int

    def take(self, entry: Entry) -> None: ...
    def close(self) -> None: ...
    def abandon(self) -> None: ...


FORMATS: dict[str, Callable[[Path, Log], _Writer]] = {
    ".mcap": McapFile,
    ".csv": partial(FlightTable, kind=CsvTable),
    ".parquet": partial(FlightTable, kind=ParquetTable),
    ".gpx": GpxFile,
    ".kml": KmlFile,
}
"""Suffix of a file → what writes it."""
FOLDERS: dict[str, Callable[[Path, Log], _Writer]] = {
    "csv": partial(MessageTables, kind=CsvTable),
    "parquet": partial(MessageTables, kind=ParquetTable),
}
"""What a folder can have: a file for each kind of message."""


class Conversion(Snapshot):
    """What came of a conversion."""

    target: Path
    """The file or folder."""
    entries: int
    """Entries of the log that were read: messages, or rows."""
    written: int
    """Messages, rows or points that were written. Of one entry an ``.mcap`` gets several messages: itself, and each
    state that it changed; a table of the flight or a track has rows or points only for positions."""
    bytes: int
    """Bytes of all files that were written."""
    begins_at: float
    """UTC of the first entry, seconds since 1970."""
    ends_at: float
    """UTC of the last entry, seconds since 1970."""
    notes: tuple[str, ...]
    """What was wrong with the log, and what is missing therefore."""


def convert(
    log: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    tables: str = "csv",
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Conversion:
    """Write a flight log in another format; a damaged log as far as it can be read.

    The target appears under its name when it is whole. Blocks until then; no event loop is needed.

    Args:
        log: a ``.tlog`` of a ground station, a ``.bin`` of ArduPilot, a ``.ulg`` of PX4.
        target: a file, ``.mcap``, ``.csv``, ``.parquet``, ``.gpx`` or ``.kml``; a name without a suffix is a folder
            with a table for each kind of message.
        tables: of a folder: ``"csv"`` or ``"parquet"``.
        force: whether files that are there already are replaced; other files of a folder stay.
        on_progress: called now and then with the bytes that were read.

    Raises:
        InvalidArgument: there is no such format, or the target is there already.
        FileFormatError: the log is none, or has nothing that can be read.
        OSError: a file cannot be read or written.
        ModuleNotFoundError: a package of the extra ``convert`` is not installed.
    """
    source, to = Path(log), Path(target)
    make = _maker(to, tables)
    reader = LOGS.get(source.suffix.lower())
    if reader is None:
        raise FileFormatError(f"{source} is no flight log by its name: {', '.join(LOGS)}")
    if not force and to.exists() and not (to.is_dir() and not to.suffix and not any(to.iterdir())):
        raise InvalidArgument(f"{to} is there already: it is replaced with force (--force) only")
    if to.exists() and to.is_dir() != (not to.suffix):
        raise InvalidArgument(f"{to} is a {'folder' if to.is_dir() else 'file'}: it is not replaced")
    show = _shower(source, on_progress)
    # Beside the target, so that it can be renamed; nobody takes it for the target meanwhile.
    with tempfile.TemporaryDirectory(dir=to.parent, prefix=f".{to.name}.") as folder:
        part = Path(folder) / to.name
        if not to.suffix:
            part.mkdir()
        made = reader(source)
        entries, begins_at, ends_at, written = _copy(made, make(part, made), show)
        size = _move(part, to)
    return Conversion(to, entries, written, size, begins_at, ends_at, tuple(made.notes))


def _maker(to: Path, tables: str) -> Callable[[Path, Log], _Writer]:
    table: dict[str, Any] = FORMATS if to.suffix else FOLDERS
    key = to.suffix.lower() if to.suffix else tables
    if key not in table:
        raise InvalidArgument(
            f"no format is called {key!r}: a file is {', '.join(FORMATS)}, a folder has {' or '.join(FOLDERS)}"
        )
    made: Callable[[Path, Log], _Writer] = table[key]
    return made


def _copy(log: Log, writer: _Writer, show: Callable[[int], object]) -> tuple[int, float, float, int]:
    entries, begins_at, ends_at = 0, 0.0, 0.0
    try:
        for entry in log.entries(show):
            if not entries:
                begins_at = ends_at = entry.unix_s
            entries += 1
            ends_at = max(ends_at, entry.unix_s)
            writer.take(entry)
        writer.close()
    except BaseException:
        writer.abandon()
        raise
    return entries, begins_at, ends_at, writer.written


def _shower(source: Path, on_progress: OnProgress | None) -> Callable[[int], object]:
    total, begun = source.stat().st_size, time.monotonic()
    if on_progress is None:
        return lambda done: None
    return lambda done: on_progress(Progress(min(done, total), total, time.monotonic() - begun))


def _move(part: Path, to: Path) -> int:
    """Give it its name, on the disk; bytes that it has."""
    files = sorted(part.iterdir()) if part.is_dir() else [part]
    for file in files:
        with file.open("rb") as opened:
            os.fsync(opened.fileno())  # else a power cut may leave the new name with nothing in it
    size = sum(file.stat().st_size for file in files)
    if not part.is_dir():
        part.replace(to)
    elif not to.exists():
        shutil.move(part, to)
    else:
        for file in files:
            file.replace(to / file.name)
    return size
