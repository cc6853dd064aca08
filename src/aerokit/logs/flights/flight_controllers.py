"""Readers of flight controllers' own logs: ``.bin`` of ArduPilot, ``.ulg`` of PX4."""

from __future__ import annotations

import heapq
import math
import sys
from contextlib import redirect_stdout, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit._internal.geo import check_place
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError
from aerokit.logs.flights.codes import ardupilot_system_id, clean_text, skipped_rows_note
from aerokit.logs.flights.from_ulog import load_ulog, severity_of, utc_at_boot
from aerokit.logs.flights.records import LogReader, LogRecord, TableColumn, name_with_unit
from aerokit.position import Position
from aerokit.vehicle.state.condition import StatusText
from aerokit.vehicle.state.equipment import Battery
from aerokit.vehicle.state.movement import Attitude, Velocity

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

_MAGIC = b"\xa3\x95"
_MAX_UNREADABLE_TAIL = 4096  # bytes ignored at the end, because power-off may cut off rows
_NO_UTC = "no GNSS time in the log: times count from power-on, which is shown as 1970-01-01"
_A_YEAR_S = 365 * 86_400.0
_MAX_UNIX_S = 4_102_444_800.0  # the year 2100; `aerokit.mavlink.tlog` has the same limit

SIMULATED_LOG = b"aerokit simulator: sample log"
"""The first bytes of the logs that `aerokit.sim` offers for download. They contain no flight."""


def opened_bin(path: Path, on_percent: Callable[[float], object] | None = None) -> Any:
    """Open a ``.bin`` as pymavlink's ``DFReader_binary``; close it with :func:`close_bin`.

    Raises:
        FileFormatError: the file is not an ArduPilot log, or its formats are damaged.
    """
    with path.open("rb") as file:
        head = file.read(len(SIMULATED_LOG))
        if head == SIMULATED_LOG:
            raise FileFormatError(
                f"{path} is a sample of aerokit's simulator and contains no flight; record a simulated flight with"
                " `--record FILE.tlog`"
            )
        if not head.startswith(_MAGIC):
            raise FileFormatError(f"{path} is not an ArduPilot log: it does not begin with A3 95")
    reader_class = import_module("pymavlink.DFReader").DFReader_binary
    reader = reader_class.__new__(reader_class)  # without __init__, which may raise: `close_bin` needs the object
    try:
        with redirect_stdout(sys.stderr):  # pymavlink prints about damage, but stdout may be for JSON
            reader.__init__(str(path), progress_callback=on_percent)
    except Exception as error:  # pymavlink raises arbitrary errors
        close_bin(reader)
        raise FileFormatError(f"{path} cannot be read: {error}") from None
    return reader


def close_bin(reader: Any) -> None:
    """Close the files of a ``DFReader_binary``, even if its constructor has failed."""
    for name in ("data_map", "filehandle"):
        with suppress(AttributeError, BufferError):  # the file was never opened, or a traceback still uses it
            getattr(reader, name).close()


StateValues = tuple[tuple[str, Any], ...]


class _RowReader(LogReader):
    """Base class of readers whose records have named fields."""

    _skipped = 0  # the number of damaged rows

    def columns(self, entry: LogRecord) -> list[TableColumn]:
        return [
            TableColumn(
                name_with_unit(name, self._unit(entry.table, name)),
                name,
                "uint" if type(value) is int and self._is_uint64(entry.table, name) else _column_kind(value),
            )
            for name, value in entry.fields.items()
        ]

    def _is_uint64(self, table: str, field: str) -> bool:
        raise NotImplementedError

    def _unit(self, table: str, field: str) -> str:
        return ""

    def _accept_time(self, unix_s: float) -> bool:
        """Return True if a row's time is possible. Otherwise, count the row as damaged."""
        is_plausible = 0 <= unix_s < _MAX_UNIX_S
        if not is_plausible:
            self._skipped += 1
        return is_plausible

    def _note_skipped(self) -> None:
        if self._skipped:
            self.notes.append(skipped_rows_note(self._skipped))

    def _note_missing_utc(self, unix_s: float) -> None:
        if unix_s < _A_YEAR_S and _NO_UTC not in self.notes:
            self.notes.append(_NO_UTC)


def _column_kind(value: object) -> str:
    if isinstance(value, float):
        return "float"
    return "int" if isinstance(value, int) else "str"  # bytes and arrays are also converted to "str"


def _position(latitude: float, longitude: float, amsl_m: float | None, relative_m: float | None) -> Position | None:
    # Estimators report impossible positions before they work, and when they fail.
    try:
        check_place(latitude, longitude)
        position = Position(latitude, longitude, amsl_m, relative_m)
    except ValueError:
        return None
    return None if latitude == longitude == 0 else position


def _optional_state(name: str, value: object) -> StateValues:
    return () if value is None else ((name, value),)


class BinReader(_RowReader):
    """Reads a ``.bin`` of ArduPilot with pymavlink. The system id is that of the logged parameters, or else 1."""

    _reader: Any = None

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[LogRecord]:
        self._reader = opened_bin(self.path)
        try:
            yield from self._rows(self._reader, on_bytes)
        finally:
            close_bin(self._reader)

    def _rows(self, reader: Any, on_bytes: Callable[[int], object]) -> Iterator[LogRecord]:
        count = 0
        system_id = _bin_system_id(reader)
        while (message := self._next(reader)) is not None:
            count += 1
            if count % 16_384 == 0:
                on_bytes(reader.offset)
            table, fields = message.get_type(), message.to_dict()
            fields.pop("mavpackettype", None)
            if table in ("FMT", "FMTU"):  # descriptions of the other tables
                continue
            if self._accept_time(message._timestamp):
                self._note_missing_utc(message._timestamp)
                states = _ardupilot_states(table, fields, reader)
                yield LogRecord(
                    message._timestamp, system_id, component_id=1, table=table, fields=fields, states=states
                )
        if not count:
            raise FileFormatError(f"{self.path} is not an ArduPilot log: it contains no message")
        if reader.data_len - reader.offset > _MAX_UNREADABLE_TAIL:
            self.notes.append(f"unreadable after byte {reader.offset} of {reader.data_len}")
        self._note_skipped()
        on_bytes(reader.data_len)

    def _next(self, reader: Any) -> Any:
        try:
            with redirect_stdout(sys.stderr):  # pymavlink prints to stdout, which may be for JSON
                return reader.recv_msg()
        except Exception as error:  # pymavlink raises arbitrary errors for a damaged row
            self.notes.append(f"damaged at byte {reader.offset}; the rest was skipped: {error}")
            return None

    def _unit(self, table: str, field: str) -> str:
        row_format = self._reader.formats.get(self._reader.name_to_id.get(table))
        if row_format is None or row_format.units is None:
            return ""
        return str(row_format.get_unit(field) or "")

    def _is_uint64(self, table: str, field: str) -> bool:
        row_format = self._reader.formats[self._reader.name_to_id[table]]
        return bool(row_format.format[row_format.columns.index(field)] == "Q")


def _bin_system_id(reader: Any) -> int:
    """Return the system id among the logged parameters, and rewind the reader."""
    parameters: dict[str, float] = {}
    with suppress(Exception), redirect_stdout(sys.stderr):  # `_next` reports damage later
        while (row := reader.recv_match(type=["PARM"])) is not None:
            parameters.setdefault(row.Name, row.Value)
    reader.rewind()
    return ardupilot_system_id(parameters)


def _ardupilot_states(table: str, fields: Mapping[str, Any], reader: Any) -> StateValues:
    decode = _ARDUPILOT.get(table)
    try:
        return () if decode is None else decode(fields, reader)
    except KeyError:  # the log is old and does not have the field
        return ()


def _ardupilot_attitude(fields: Mapping[str, Any], _: Any) -> StateValues:
    yaw = (fields["Yaw"] + 180) % 360 - 180
    return (("attitude", Attitude(fields["Roll"], fields["Pitch"], yaw)), ("heading_deg", fields["Yaw"] % 360))


def _finite_or_none(value: float) -> float | None:
    # Batteries without a sensor have NaN.
    return value if math.isfinite(value) else None


def _px4_battery(row: Mapping[str, Any]) -> Battery:
    remaining = row["remaining"]
    percent = round(remaining * 100) if math.isfinite(remaining) and remaining >= 0 else None
    current_a = _finite_or_none(row["current_a"]) if row["current_a"] >= 0 else None  # -1 means unknown
    voltage_v = _finite_or_none(row["voltage_v"]) if row["voltage_v"] > 0 else None  # 0 means unknown
    return Battery(id=0, voltage_v=voltage_v, current_a=current_a, remaining_percent=percent)


def _ardupilot_battery(fields: Mapping[str, Any]) -> StateValues:
    number = fields.get("Instance", fields.get("Inst", 0))
    if number != 0:  # the state lists all batteries, but a row has only one, so only the first is used
        return ()
    return (("batteries", (Battery(number, _finite_or_none(fields["Volt"]), _finite_or_none(fields["Curr"])),)),)


_ARDUPILOT: dict[str, Callable[[Mapping[str, Any], Any], StateValues]] = {
    "POS": lambda f, _: _optional_state("position", _position(f["Lat"], f["Lng"], f["Alt"], f["RelHomeAlt"])),
    "ATT": _ardupilot_attitude,
    "MSG": lambda f, _: _optional_state("status_text", _BinText(text=clean_text(f["Message"]))),
    "BAT": lambda f, _: _ardupilot_battery(f),
    "ARM": lambda f, _: _optional_state("armed", bool(f["ArmState"])),
    "MODE": lambda f, reader: _optional_state("mode", _Mode(reader.flightmode, f["ModeNum"])),
}


class _BinText(Snapshot):
    """A `StatusText` without a severity, because a ``.bin`` does not contain severities."""

    severity: int | None = None
    text: str = ""
    at: float = 0.0


class _Mode:
    """Flight mode in a ``.bin``, which has the names and numbers of modes, but no base_mode."""

    def __init__(self, name: str, number: int) -> None:
        self.name, self.custom_mode = str(name), int(number)

    def to_dict(self) -> dict[str, Any]:
        return {"name": self.name, "custom_mode": self.custom_mode}


class UlogReader(_RowReader):
    """Reads a ``.ulg`` of PX4 with pyulog, which loads the whole log into memory."""

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[LogRecord]:
        with self.path.open("rb") as file:
            log = load_ulog(file, self.path)
        if log.file_corruption:
            self.notes.append("the log is damaged: the readable part was converted")
        if not log.data_list:
            raise FileFormatError(f"{self.path} contains no data")
        self._topics = {_table_of(data): data for data in log.data_list}
        begins_s = utc_at_boot(log)
        self._note_missing_utc(begins_s)
        system_id = int(log.initial_parameters.get("MAV_SYS_ID", 1))
        decoder = _Px4States()
        rows = heapq.merge(*(_rows(data) for data in log.data_list), _texts(log), key=_time_of)
        size = self.path.stat().st_size
        total = sum(len(data.data["timestamp"]) for data in log.data_list)
        for count, (time_us, table, fields) in enumerate(rows):
            if count % 1024 == 0:
                on_bytes(size * count // max(total, 1))
            unix_s = begins_s + time_us / 1e6
            if self._accept_time(unix_s):
                states = decoder.states(table, fields)
                yield LogRecord(unix_s, system_id, component_id=1, table=table, fields=fields, states=states)
        self._note_skipped()
        on_bytes(size)

    def _is_uint64(self, table: str, field: str) -> bool:
        return table in self._topics and bool(self._topics[table].data[field].dtype == "uint64")


def _time_of(row: tuple[int, str, dict[str, Any]]) -> int:
    time_us, _, _ = row
    return time_us


def _table_of(data: Any) -> str:
    return f"{data.name}_{data.multi_id}" if data.multi_id else str(data.name)


def _rows(data: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield the time in microseconds, the table and the fields of each row of a topic."""
    table = _table_of(data)
    names = list(data.data)
    for values in zip(*(data.data[name].tolist() for name in names), strict=True):
        fields = dict(zip(names, values, strict=True))
        yield fields["timestamp"], table, fields


def _texts(log: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    for text in log.logged_messages:
        yield text.timestamp, "logged_messages", {"severity": severity_of(text), "message": text.message}


class _Px4States:
    """Derives aerokit's states from the rows of PX4's topics."""

    def __init__(self) -> None:
        self._home_amsl_m: float | None = None

    def states(self, table: str, row: Mapping[str, Any]) -> StateValues:
        try:
            return self._states(table, row)
        except KeyError:  # the field has another name in this version of PX4
            return ()

    def _states(self, table: str, row: Mapping[str, Any]) -> StateValues:
        # Old versions of PX4 do not have all flags. Without its flag, a value counts as valid.
        if table == "home_position" and row.get("valid_alt", 1):
            self._home_amsl_m = row["alt"]
        elif table == "vehicle_global_position" and row.get("lat_lon_valid", 1):
            home_amsl_m = self._home_amsl_m
            amsl_m = row["alt"] if row.get("alt_valid", 1) else None
            relative_m = None if home_amsl_m is None or amsl_m is None else amsl_m - home_amsl_m
            return _optional_state("position", _position(row["lat"], row["lon"], amsl_m, relative_m))
        elif table == "vehicle_attitude":
            quaternion = (row["q[0]"], row["q[1]"], row["q[2]"], row["q[3]"])
            return (("attitude", Attitude.from_quaternion(*quaternion, rates_deg_s=(None, None, None))),)
        elif table == "vehicle_local_position":
            north, east = (row["vx"], row["vy"]) if row.get("v_xy_valid", 1) else (math.nan, math.nan)
            return (("velocity", Velocity(north, east, row["vz"] if row.get("v_z_valid", 1) else math.nan)),)
        elif table == "vehicle_status":
            return (("armed", row["arming_state"] == 2),)  # ARMING_STATE_ARMED
        elif table == "battery_status":
            return (("batteries", (_px4_battery(row),)),)
        elif table == "logged_messages":
            return (("status_text", StatusText(row["severity"], clean_text(row["message"]))),)
        return ()
