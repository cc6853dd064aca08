"""Tables: one of the flight in a file, or a folder with one for each kind of message; CSV or Parquet."""

from __future__ import annotations

import csv
import math
import re
from datetime import datetime, timezone
from importlib import import_module
from typing import TYPE_CHECKING, Any, TextIO

from aerokit.logs.flights.entries import Column

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from aerokit.logs.flights.entries import Entry, Log

_ROWS = 1 << 15
_SENDER = (Column("time_utc", "", "time"), Column("system_id", "", "int"), Column("component_id", "", "int"))

FLIGHT = (
    Column("latitude_deg", "position.latitude_deg", "float"),
    Column("longitude_deg", "position.longitude_deg", "float"),
    Column("altitude_amsl_m", "position.altitude_amsl_m", "float"),
    Column("altitude_relative_m", "position.altitude_relative_m", "float"),
    Column("north_m_s", "velocity.north_m_s", "float"),
    Column("east_m_s", "velocity.east_m_s", "float"),
    Column("down_m_s", "velocity.down_m_s", "float"),
    Column("roll_deg", "attitude.roll_deg", "float"),
    Column("pitch_deg", "attitude.pitch_deg", "float"),
    Column("yaw_deg", "attitude.yaw_deg", "float"),
    Column("heading_deg", "heading_deg", "float"),
    Column("ground_speed_m_s", "ground_speed_m_s", "float"),
    Column("air_speed_m_s", "air_speed_m_s", "float"),
    Column("climb_m_s", "climb_m_s", "float"),
    Column("throttle_percent", "throttle_percent", "float"),
    Column("battery_voltage_v", "batteries.0.voltage_v", "float"),
    Column("battery_current_a", "batteries.0.current_a", "float"),
    Column("battery_remaining_percent", "batteries.0.remaining_percent", "float"),
    Column("satellites", "gps.0.satellites", "int"),
    Column("mode", "mode.name", "str"),
    Column("armed", "armed", "bool"),
)
"""The columns of the table of a flight, behind time and system: what was known at each position."""


class _UnixLines:
    """Rows that end in CR LF, written with LF."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, row: str) -> None:
        self._file.write(row[:-2] + "\n")


class CsvTable:
    """A CSV file: UTF-8, commas, a line of names; what is not known is empty."""

    SUFFIX = ".csv"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        # What ends a line for csv is put into quotes by it: a text of a vehicle with "\r" begins no row.
        self._writer = csv.writer(_UnixLines(self._file), lineterminator="\r\n")
        self._writer.writerow([column.name for column in columns])

    def add(self, unix_s: float, values: Sequence[Any]) -> None:
        """Add a row; the time is written in ISO 8601 with microseconds, UTC."""
        shown = ["" if value != value else value for value in values]  # NaN
        self._writer.writerow([_utc(unix_s).isoformat(timespec="microseconds"), *shown])

    def close(self) -> None:
        """End the file."""
        self._file.close()

    abandon = close


class ParquetTable:
    """A Parquet file; times are timestamps in UTC, what is not known is null."""

    SUFFIX = ".parquet"

    def __init__(self, path: Path, columns: Sequence[Column]) -> None:
        self._arrow = arrow = import_module("pyarrow")
        types = {
            "time": arrow.timestamp("us", tz="UTC"),
            "float": arrow.float64(),
            "int": arrow.int64(),
            "uint": arrow.uint64(),
            "bool": arrow.bool_(),
            "str": arrow.string(),
        }
        self._schema = arrow.schema([(column.name, types[column.kind]) for column in columns])
        self._writer = import_module("pyarrow.parquet").ParquetWriter(path, self._schema, compression="zstd")
        self._rows: list[tuple[Any, ...]] = []

    def add(self, unix_s: float, values: Sequence[Any]) -> None:
        """Add a row."""
        self._rows.append((round(unix_s * 1e6), *values))
        if len(self._rows) >= _ROWS:
            self._flush()

    def close(self) -> None:
        """End the file."""
        self._flush()
        self._writer.close()

    def abandon(self) -> None:
        """Close it as it is: nobody will read it."""
        self._writer.close()

    def _flush(self) -> None:
        if self._rows:
            columns = zip(*self._rows, strict=True)
            arrays = [
                self._arrow.array(column, type=field.type)
                for column, field in zip(columns, self._schema, strict=True)
            ]
            self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))
            self._rows.clear()


Table = CsvTable | ParquetTable


class FlightTable:
    """One table: a row for each position of each vehicle, with what else was known of it then."""

    def __init__(self, path: Path, log: Log, kind: type[Table]) -> None:
        self._table = kind(path, (*_SENDER[:2], *FLIGHT))
        self._latest: dict[int, dict[str, Any]] = {}
        self._readers = [_reader(column.field) for column in FLIGHT]
        self.written: int = 0
        self._log = log

    def take(self, entry: Entry) -> None:
        """Add a row when an entry tells a position."""
        if not entry.states:
            return
        latest = self._latest.setdefault(entry.system_id, {})
        latest.update(entry.states)
        if any(state == "position" for state, _ in entry.states):
            self._table.add(entry.unix_s, (entry.system_id, *(read(latest) for read in self._readers)))
            self.written += 1

    def close(self) -> None:
        """End the file."""
        if not self.written:
            self._log.notes.append("no position is in this log: the table is empty")
        self._table.close()

    def abandon(self) -> None:
        """Close it as it is."""
        self._table.abandon()


class MessageTables:
    """A folder: a table for each kind of message, with all fields as they are in the log."""

    def __init__(self, path: Path, log: Log, kind: type[Table]) -> None:
        self._path, self._log, self._kind = path, log, kind
        self._tables: dict[str, tuple[Table, Callable[[Entry], list[Any]]]] = {}
        self.written: int = 0

    def take(self, entry: Entry) -> None:
        """Add a row to the table of an entry."""
        found = self._tables.get(entry.table)
        if found is None:
            columns = self._log.columns(entry)
            # The names are the log's own, and a log may come from anybody.
            name = re.sub(r"[^\w-]", "_", entry.table) + self._kind.SUFFIX
            if (self._path / name).exists():
                name = f"{len(self._tables)}_{name}"
            table = self._kind(self._path / name, (*_SENDER, *columns))
            found = self._tables[entry.table] = table, _row_of(columns, entry)
        found[0].add(entry.unix_s, (entry.system_id, entry.component_id, *found[1](entry)))
        self.written += 1

    def close(self) -> None:
        """End all files."""
        for table, _ in self._tables.values():
            table.close()

    def abandon(self) -> None:
        """Close them as they are."""
        for table, _ in self._tables.values():
            table.abandon()


def _utc(unix_s: float) -> datetime:
    return datetime.fromtimestamp(unix_s, timezone.utc)


def _row_of(columns: Sequence[Column], entry: Entry) -> Callable[[Entry], list[Any]]:
    """What makes the rows of a table out of entries like this one."""
    if entry.message is None:
        names = [column.field for column in columns]
        return lambda entry: [_cell(entry.fields.get(name)) for name in names]
    parts = [column.field.partition(".") for column in columns]
    places = [(name, int(index) if index else None) for name, _, index in parts]

    def row(entry: Entry) -> list[Any]:
        values = ((getattr(entry.message, name), index) for name, index in places)
        return [_cell(value) if index is None else value[index] for value, index in values]

    return row


def _cell(value: Any) -> Any:
    """What a table takes: bytes as hexadecimal digits, lists as text."""
    if isinstance(value, bytes):
        return value.hex()
    return str(list(value)) if isinstance(value, (list, tuple)) or hasattr(value, "typecode") else value


def _reader(path: str) -> Callable[[dict[str, Any]], Any]:
    first, *rest = path.split(".")

    def read(latest: dict[str, Any]) -> Any:
        value = latest.get(first)
        for step in rest:
            if value is None:
                return None
            value = (value[0] if value else None) if step == "0" else getattr(value, step)
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return read
