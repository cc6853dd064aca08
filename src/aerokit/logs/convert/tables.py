"""Writes tables in CSV or Parquet: one table of the flight, or a folder with a table for each message type."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from aerokit.logs.flights.records import TableColumn

if TYPE_CHECKING:
    from pathlib import Path

    from aerokit.logs.flights.records import LogReader, LogRecord

_ROWS_PER_FLUSH, _LINES_PER_FLUSH = 1 << 15, 1 << 8
_SENDER_COLUMNS = (
    TableColumn("time_utc", "", "time"),
    TableColumn("system_id", "", "int"),
    TableColumn("component_id", "", "int"),
)

FLIGHT = (
    TableColumn("latitude_deg", "position.latitude_deg", "float"),
    TableColumn("longitude_deg", "position.longitude_deg", "float"),
    TableColumn("altitude_amsl_m", "position.altitude_amsl_m", "float"),
    TableColumn("altitude_relative_m", "position.altitude_relative_m", "float"),
    TableColumn("north_m_s", "velocity.north_m_s", "float"),
    TableColumn("east_m_s", "velocity.east_m_s", "float"),
    TableColumn("down_m_s", "velocity.down_m_s", "float"),
    TableColumn("roll_deg", "attitude.roll_deg", "float"),
    TableColumn("pitch_deg", "attitude.pitch_deg", "float"),
    TableColumn("yaw_deg", "attitude.yaw_deg", "float"),
    TableColumn("heading_deg", "heading_deg", "float"),
    TableColumn("ground_speed_m_s", "ground_speed_m_s", "float"),
    TableColumn("air_speed_m_s", "air_speed_m_s", "float"),
    TableColumn("climb_m_s", "climb_m_s", "float"),
    TableColumn("throttle_percent", "throttle_percent", "float"),
    TableColumn("battery_voltage_v", "batteries.0.voltage_v", "float"),
    TableColumn("battery_current_a", "batteries.0.current_a", "float"),
    TableColumn("battery_remaining_percent", "batteries.0.remaining_percent", "float"),
    TableColumn("satellites", "gps.0.satellites", "int"),
    TableColumn("mode", "mode.name", "str"),
    TableColumn("armed", "armed", "bool"),
)
"""Columns of the flight table after the time and the system id. A row has the newest values at one position."""


# Matches the places where spreadsheets may recognise a formula (owasp.org/www-community/attacks/CSV_Injection):
# - before an operator at the beginning of the text, or after ";" or a tab, which are separators in some locales;
# - before a control character at the beginning of the text.
_FORMULA = re.compile(r"(^|[;\t])(?=[\s\0]*[=+\-@\uff1d\uff0b\uff0d\uff20])|^(?=[\t\r\n\0])")


_NUMBER_TYPES = (float, int)


def _csv_cell(value: Any) -> Any:
    if isinstance(value, str):
        return _FORMULA.sub(r"\1'", value)
    return "" if value != value else value  # a value that is not equal to itself is NaN, which becomes an empty cell


class CsvTable:
    """A CSV file: UTF-8, comma-separated, with a header; unknown values are empty.

    Texts that spreadsheets would execute as formulas get an apostrophe. Numbers stay as they are.
    """

    SUFFIX = ".csv"

    def __init__(self, path: Path, columns: Sequence[TableColumn]) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._lines: list[str] = []
        line_collector: Any = SimpleNamespace(write=self._add_line)
        # The csv module quotes values with "\r" and "\n" only if the line terminator contains both.
        self._writer = csv.writer(line_collector, lineterminator="\r\n")
        self._writer.writerow([_csv_cell(column.name) for column in columns])
        self._number_format = ",".join(["%s", *["%r"] * (len(columns) - 1)]) + "\n"

    def add(self, unix_s: float, values: Sequence[Any]) -> None:
        # Most values are numbers, for which a call of _csv_cell would be slow. `value == value` is False for NaN.
        cells = [value if type(value) in _NUMBER_TYPES and value == value else _csv_cell(value) for value in values]
        self._writer.writerow([_iso_time(unix_s), *cells])
        if len(self._lines) >= _LINES_PER_FLUSH:
            self._flush()

    def add_numbers(self, unix_s: float, numbers: Sequence[float]) -> None:
        """Like :meth:`add` for ints and floats, but twice as fast."""
        line = self._number_format % (_iso_time(unix_s), *numbers)
        if "nan" in line:  # A number is NaN, which becomes an empty cell.
            self.add(unix_s, numbers)
            return
        self._lines.append(line)
        if len(self._lines) >= _LINES_PER_FLUSH:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._file.close()

    def discard(self) -> None:
        self._file.close()

    def _add_line(self, line: str) -> None:
        self._lines.append(line.removesuffix("\r\n") + "\n")

    def _flush(self) -> None:
        self._file.write("".join(self._lines))
        self._lines.clear()


class ParquetTable:
    """A Parquet file, in which times are UTC timestamps and unknown values are null."""

    SUFFIX = ".parquet"

    def __init__(self, path: Path, columns: Sequence[TableColumn]) -> None:
        arrow = import_module("pyarrow")
        self._arrow = arrow
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
        self._rows.append((round(unix_s * 1e6), *values))
        if len(self._rows) >= _ROWS_PER_FLUSH:
            self._flush()

    add_numbers = add

    def close(self) -> None:
        self._flush()
        self._writer.close()

    def discard(self) -> None:
        self._writer.close()

    def _flush(self) -> None:
        if self._rows:
            columns = zip(*self._rows, strict=True)
            arrays = [
                self._arrow.array(column, type=field.type) for column, field in zip(columns, self._schema, strict=True)
            ]
            self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))
            self._rows.clear()


Table = CsvTable | ParquetTable
_AddRow = Callable[[float, Sequence[Any]], None]
"""Adds a row to a table: its time, and the values of its other columns."""
_MakeRow = Callable[["LogRecord"], Sequence[Any]]
"""Converts a log record to a row: the values of all columns except the time."""


class FlightTableWriter:
    """Writes one table, with a row for each position of each vehicle, and the values of other states at that time."""

    def __init__(self, path: Path, log: LogReader, kind: type[Table]) -> None:
        self._table = kind(path, (*_SENDER_COLUMNS[:2], *FLIGHT))  # without the component id
        self._latest: dict[int, dict[str, Any]] = {}
        self._value_getters = [_value_getter(column.field) for column in FLIGHT]
        self.written: int = 0
        self._log = log

    def write(self, record: LogRecord) -> None:
        if not record.states:
            return
        latest = self._latest.setdefault(record.system_id, {})
        latest.update(record.states)
        if any(state == "position" for state, _ in record.states):
            values = [get_value(latest) for get_value in self._value_getters]
            self._table.add(record.unix_s, (record.system_id, *values))
            self.written += 1

    def close(self) -> None:
        if not self.written:
            self._log.notes.append("the log contains no position; the table is empty")
        self._table.close()

    def discard(self) -> None:
        self._table.discard()


class MessageTablesWriter:
    """Writes a folder of tables, one for each message type, with all its fields as they were logged."""

    def __init__(self, path: Path, log: LogReader, kind: type[Table]) -> None:
        self._path, self._log, self._kind = path, log, kind
        log.needs_states = False
        self._tables: list[Table] = []
        # For each record type: a function that adds a row to its table, and one that converts a record to a row.
        self._converters: dict[str, tuple[_AddRow, _MakeRow]] = {}
        self.written: int = 0

    def write(self, record: LogRecord) -> None:
        add_row, make_row = self._converters.get(record.table) or self._open_table(record)
        add_row(record.unix_s, make_row(record))
        self.written += 1

    def _open_table(self, record: LogRecord) -> tuple[_AddRow, _MakeRow]:
        columns = self._log.columns(record)
        # The log is untrusted input, so all but letters, digits, "_" and "-" are replaced in the file name.
        name = re.sub(r"[^\w-]", "_", record.table) + self._kind.SUFFIX
        while (self._path / name).exists():
            name = f"{len(self._tables)}_{name}"
        table = self._kind(self._path / name, (*_SENDER_COLUMNS, *columns))
        self._tables.append(table)
        # add_numbers() needs Python's numbers. Rows from a flight controller's log, which have no message, may contain
        # NumPy's numbers.
        has_only_numbers = record.message is not None and all(column.kind != "str" for column in columns)
        add_row = table.add_numbers if has_only_numbers else table.add
        self._converters[record.table] = add_row, _row_maker(columns, record)
        return self._converters[record.table]

    def close(self) -> None:
        for table in self._tables:
            table.close()

    def discard(self) -> None:
        for table in self._tables:
            table.discard()


def _iso_time(unix_s: float) -> str:
    microseconds = round(unix_s % 1 * 1e6)
    if microseconds == 1_000_000:  # rounded up to a full second
        return f"{_iso_second(unix_s // 1 + 1)}.000000+00:00"
    return f"{_iso_second(unix_s // 1)}.{microseconds:06}+00:00"


@lru_cache(maxsize=1)
def _iso_second(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, timezone.utc).isoformat()[:19]


def _row_maker(columns: Sequence[TableColumn], first_record: LogRecord) -> _MakeRow:
    """Return a function that converts records of the same type as ``first_record`` to table rows."""
    if first_record.message is None:
        names = [column.field for column in columns]
        return lambda record: [
            record.system_id,
            record.component_id,
            *[_cell(record.fields.get(name)) for name in names],
        ]
    parts = [column.field.partition(".") for column in columns]
    # attrgetter returns a tuple only for two or more names, so the unused NAME is added, and removed from each row.
    # A row begins with record[1:3], the system id and the component id.
    get_fields = attrgetter("NAME", *(name for name, _, _ in parts))
    array_elements = [(position, int(index)) for position, (_, _, index) in enumerate(parts) if index]
    text_positions = [position for position, column in enumerate(columns) if column.kind == "str"]
    if not array_elements and not text_positions:
        return lambda record: record[1:3] + get_fields(record.message)[1:]

    def make_row(record: LogRecord) -> list[Any]:
        _, *values = get_fields(record.message)
        for position, index in array_elements:
            values[position] = values[position][index]
        for position in text_positions:
            values[position] = _cell(values[position])
        return [*record[1:3], *values]

    return make_row


def _cell(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    is_array = hasattr(value, "typecode")
    return str(list(value)) if isinstance(value, (list, tuple)) or is_array else value


def _first(values: Sequence[Any]) -> Any:
    return values[0] if values else None


def _value_getter(path: str) -> Callable[[dict[str, Any]], Any]:
    """Return a function that looks up a path such as ``batteries.0.voltage_v``. It returns None for unknown values."""
    state, *steps = path.split(".")

    def get_value(latest: dict[str, Any]) -> Any:
        value = latest.get(state)
        for step in steps:
            if value is None:
                return None
            value = _first(value) if step == "0" else getattr(value, step)
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return get_value
