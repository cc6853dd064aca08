"""Conversion of flight logs to MCAP, CSV, Parquet, GPX and KML; see docs/convert.md."""

from __future__ import annotations

import os
import shutil
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.logs.convert.mcap import McapWriter
from aerokit.logs.convert.tables import CsvTable, FlightTableWriter, MessageTablesWriter, ParquetTable
from aerokit.logs.convert.tracks import GpxWriter, KmlWriter
from aerokit.logs.flights import check_log_name, progress_callback
from aerokit.logs.flights.flight_controllers import BinReader, UlogReader
from aerokit.logs.flights.records import TlogReader

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.logs.flights.records import LogReader, LogRecord
    from aerokit.protocols.exchange import OnProgress

__all__ = ["FORMATS", "Conversion", "convert"]


LOG_READERS: dict[str, type[LogReader]] = {".tlog": TlogReader, ".bin": BinReader, ".ulg": UlogReader}
"""Maps the suffix of a log to its reader."""


class _Writer(Protocol):
    written: int

    def write(self, record: LogRecord) -> None: ...
    def close(self) -> None: ...
    def discard(self) -> None: ...


FORMATS: dict[str, Callable[[Path, LogReader], _Writer]] = {
    ".mcap": McapWriter,
    ".csv": partial(FlightTableWriter, kind=CsvTable),
    ".parquet": partial(FlightTableWriter, kind=ParquetTable),
    ".gpx": GpxWriter,
    ".kml": KmlWriter,
}
"""Maps the suffix of a file to its writer."""
FOLDERS: dict[str, Callable[[Path, LogReader], _Writer]] = {
    "csv": partial(MessageTablesWriter, kind=CsvTable),
    "parquet": partial(MessageTablesWriter, kind=ParquetTable),
}
"""Maps the format of the tables in a folder to its writer."""


class Conversion(Snapshot):
    """The result of a conversion."""

    target: Path
    """The written file or folder."""
    entries: int
    """Number of records that were read from the log: its messages or rows."""
    written: int
    """Number of messages, rows or points that were written.

    In an ``.mcap``, each record becomes one message, plus one message for each state that the record changes. A flight
    table or track has rows or points for positions only.
    """
    bytes: int
    """Total size of the written files."""
    begins_at: float
    """UTC of the first record, in seconds since 1970."""
    ends_at: float
    """Latest UTC of a record, in seconds since 1970. It is not the last record's if the clock was set back."""
    notes: tuple[str, ...]
    """Problems of the log, and data that is missing because of them."""


def convert(
    log: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    tables: str = "csv",
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Conversion:
    """Convert a flight log. If the log is damaged, only its readable part is converted.

    The target gets its name only when it is complete. The function blocks; it needs no event loop.

    Args:
        log: a ``.tlog`` of a ground station, a ``.bin`` of ArduPilot, or a ``.ulg`` of PX4.
        target: a file with the suffix ``.mcap``, ``.csv``, ``.parquet``, ``.gpx`` or ``.kml``. A name without a suffix
            becomes a folder with one table for each message type.
        tables: format of the tables in a folder: ``"csv"`` or ``"parquet"``.
        force: replace existing files. Other files in a target folder stay.
        on_progress: called from time to time with the number of bytes read so far.

    Raises:
        InvalidArgument: the format is unknown, or the target exists.
        FileFormatError: the file is not a flight log, or nothing in it can be read.
        OSError: a file cannot be read or written.
        ModuleNotFoundError: a package of the extra ``convert`` is not installed.
    """
    source, target_path = Path(log), Path(target)
    make_writer = _writer_for(target_path, tables)
    is_folder = not target_path.suffix
    check_log_name(source)
    is_empty_folder = is_folder and target_path.is_dir() and not any(target_path.iterdir())
    if not force and target_path.exists() and not is_empty_folder:
        raise InvalidArgument(f"{target_path} exists; use force (--force) to replace it")
    if target_path.exists() and target_path.is_dir() != is_folder:
        existing, new = ("file", "folder") if is_folder else ("folder", "file")
        raise InvalidArgument(f"{target_path} is a {existing} and cannot be replaced by a {new}")
    on_bytes = progress_callback(source.stat().st_size, on_progress)
    # The temporary folder is in the target's directory, because renaming works only within one file system.
    with tempfile.TemporaryDirectory(dir=target_path.parent, prefix=f".{target_path.name}.") as folder:
        incomplete = Path(folder) / target_path.name
        if is_folder:
            incomplete.mkdir()
        log_reader = LOG_READERS[source.suffix.lower()](source)
        writer = make_writer(incomplete, log_reader)
        entries, begins_at, ends_at = _write_records(log_reader, writer, on_bytes)
        size = _move(incomplete, target_path)
    notes = tuple(log_reader.notes)
    return Conversion(
        target_path, entries, written=writer.written, bytes=size, begins_at=begins_at, ends_at=ends_at, notes=notes
    )


def _writer_for(target: Path, table_format: str) -> Callable[[Path, LogReader], _Writer]:
    formats: dict[str, Any] = FORMATS if target.suffix else FOLDERS
    key = target.suffix.lower() if target.suffix else table_format
    if key not in formats:
        raise InvalidArgument(
            f"unknown format {key!r}: expected {', '.join(FORMATS)} for a file,"
            f" or {' or '.join(FOLDERS)} for a folder of tables"
        )
    writer: Callable[[Path, LogReader], _Writer] = formats[key]
    return writer


def _write_records(log: LogReader, writer: _Writer, on_bytes: Callable[[int], object]) -> tuple[int, float, float]:
    """Write all records. Return their number, and the first and the latest time."""
    entries, begins_at, ends_at = 0, 0.0, 0.0
    try:
        for entry in log.entries(on_bytes):
            if not entries:
                begins_at = entry.unix_s
            entries += 1
            if entry.unix_s > ends_at:
                ends_at = entry.unix_s
            writer.write(entry)
        writer.close()
    except BaseException:
        writer.discard()
        raise
    return entries, begins_at, ends_at


def _move(complete: Path, target: Path) -> int:
    """Move complete files to their final names. Return their total size in bytes."""
    files = sorted(complete.iterdir()) if complete.is_dir() else [complete]
    for file in files:
        # Without fsync, a power failure could leave an empty file under the final name. Windows needs a writable file.
        with file.open("r+b") as opened:
            os.fsync(opened.fileno())
    size = sum(file.stat().st_size for file in files)
    if not complete.is_dir():
        complete.replace(target)
    elif not target.exists():
        shutil.move(complete, target)
    else:
        for file in files:
            file.replace(target / file.name)
    return size
