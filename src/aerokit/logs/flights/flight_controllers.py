"""The logs that flight controllers write themselves: ``.bin`` of ArduPilot, ``.ulg`` of PX4."""

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
from aerokit.logs.flights.codes import readable
from aerokit.logs.flights.entries import Column, Entry, Log, unit_suffix
from aerokit.position import Position
from aerokit.vehicle.state.condition import StatusText
from aerokit.vehicle.state.equipment import Battery
from aerokit.vehicle.state.movement import Attitude, Velocity

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

_MAGIC = b"\xa3\x95"


def opened_bin(path: Path, on_percent: Callable[[float], object] | None = None) -> Any:
    """A ``DFReader_binary``, to be closed by :func:`close_bin`.

    Raises:
        FileFormatError: it is no log of ArduPilot, or its formats are damaged.
    """
    with path.open("rb") as file:
        if file.read(2) != _MAGIC:
            raise FileFormatError(f"{path} is no log of ArduPilot: it does not begin like one")
    kind = import_module("pymavlink.DFReader").DFReader_binary
    reader = kind.__new__(kind)  # so that its file can be closed when it raises on damage
    try:
        with redirect_stdout(sys.stderr):  # it prints what is damaged, where our answers may go to
            reader.__init__(str(path), progress_callback=on_percent)
    except Exception as error:  # whatever it raises
        close_bin(reader)
        raise FileFormatError(f"{path} cannot be read: {error}") from None
    return reader


def close_bin(reader: Any) -> None:
    """Close its file."""
    for name in ("data_map", "filehandle"):
        with suppress(AttributeError, BufferError):  # opened never, or still looked at by a traceback
            getattr(reader, name).close()


States = tuple[tuple[str, Any], ...]

_TAIL = 4096  # the last row is cut off where the power was

_NO_UTC = "no satellite receiver told the time: times count from the start, as if that were 1970"

_A_YEAR_S = 365 * 86_400.0

_LATEST_S = 4_102_444_800.0
"""The year 2100, as for a ``.tlog``."""


class _OwnLog(Log):
    """Rows with names: their columns are those of the first row of a table."""

    def columns(self, entry: Entry) -> list[Column]:
        """The fields, with their units where the log tells them."""
        return [
            Column(unit_suffix(name, self._unit(entry.table, name)), name, _kind(value))
            for name, value in entry.fields.items()
        ]

    def _unit(self, table: str, field: str) -> str:
        return ""

    _left_out = 0

    def _is_time(self, unix_s: float) -> bool:
        """Whether a row may be that old or new; the time of a damaged one may be any number."""
        is_time = 0 <= unix_s < _LATEST_S
        self._left_out += not is_time
        return is_time

    def _note_left_out(self) -> None:
        if self._left_out:
            self.notes.append(f"{self._left_out} damaged rows with a time that cannot be were left out")

    def _note_time(self, unix_s: float) -> None:
        if unix_s < _A_YEAR_S and _NO_UTC not in self.notes:
            self.notes.append(_NO_UTC)


def _kind(value: object) -> str:
    if isinstance(value, (float, int)):
        return "float" if isinstance(value, float) else "int"
    return "str"  # texts, bytes, arrays


def _place(latitude: float, longitude: float, amsl_m: float, relative_m: float | None) -> Position | None:
    """None where a filter has diverged, or has not begun: such numbers are no place."""
    try:
        check_place(latitude, longitude)
        place = Position(latitude, longitude, float(amsl_m), relative_m)
    except ValueError:
        return None
    return None if latitude == longitude == 0 else place


def _said(name: str, value: object) -> States:
    return () if value is None else ((name, value),)


class BinFile(_OwnLog):
    """A ``.bin`` of ArduPilot, read by pymavlink; system 1, for such a log does not tell it."""

    _reader: Any = None

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[Entry]:
        """All messages of the log but the formats; multipliers are applied."""
        reader = self._reader = opened_bin(self.path)
        try:
            yield from self._rows(reader, on_bytes)
        finally:
            close_bin(reader)

    def _rows(self, reader: Any, on_bytes: Callable[[int], object]) -> Iterator[Entry]:
        count = 0
        while (message := self._next(reader)) is not None:
            count += 1
            if not count & 0x3FF:
                on_bytes(reader.offset)
            table, fields = message.get_type(), message.to_dict()
            fields.pop("mavpackettype", None)
            if table not in ("FMT", "FMTU") and self._is_time(message._timestamp):
                self._note_time(message._timestamp)
                yield Entry(message._timestamp, 1, 1, table, fields, _of_ardupilot(table, fields, reader))
        if not count:
            raise FileFormatError(f"{self.path} is no log of ArduPilot: it has no message")
        if reader.data_len - reader.offset > _TAIL:
            self.notes.append(f"nothing can be read behind byte {reader.offset} of {reader.data_len}")
        self._note_left_out()
        on_bytes(reader.data_len)

    def _next(self, reader: Any) -> Any:
        try:
            with redirect_stdout(sys.stderr):  # it prints what is damaged, where our answers may go to
                return reader.recv_msg()
        except Exception as error:  # whatever it raises on a damaged row
            self.notes.append(f"damaged at byte {reader.offset}, and not read on: {error}")
            return None

    def _unit(self, table: str, field: str) -> str:
        number = self._reader.name_to_id.get(table)
        found = self._reader.formats.get(number)
        return str(found.get_unit(field) or "") if found is not None and found.units is not None else ""


def _of_ardupilot(table: str, fields: Mapping[str, Any], reader: Any) -> States:
    """What a message of the log says of the states of a vehicle."""
    tell = _ARDUPILOT.get(table)
    try:
        return () if tell is None else tell(fields, reader)
    except KeyError:  # an old log without that field
        return ()


def _ardupilot_attitude(fields: Mapping[str, Any], _: Any) -> States:
    yaw = (fields["Yaw"] + 180) % 360 - 180
    return (
        ("attitude", Attitude(fields["Roll"], fields["Pitch"], yaw)),
        ("heading_deg", fields["Yaw"] % 360),
    )


def _known(value: float) -> float | None:
    """None instead of NaN, which a battery without a sensor for it has."""
    return value if math.isfinite(value) else None


def _ardupilot_battery(fields: Mapping[str, Any]) -> States:
    number = fields.get("Instance", fields.get("Inst", 0))
    if number != 0:  # the state begins with the first battery, and a row tells of one alone
        return ()
    return (("batteries", (Battery(number, _known(fields["Volt"]), _known(fields["Curr"])),)),)


_ARDUPILOT: dict[str, Callable[[Mapping[str, Any], Any], States]] = {
    "POS": lambda f, _: _said("position", _place(f["Lat"], f["Lng"], f["Alt"], f["RelHomeAlt"])),
    "ATT": _ardupilot_attitude,
    "MSG": lambda f, _: _said("status_text", _TextOfBin(text=readable(f["Message"]))),
    "BAT": lambda f, _: _ardupilot_battery(f),
    "ARM": lambda f, _: _said("armed", bool(f["ArmState"])),
    "MODE": lambda f, reader: _said("mode", _Mode(reader.flightmode, f["ModeNum"])),
}


class _TextOfBin(Snapshot):
    """A `StatusText` without its severity, which a ``.bin`` does not keep."""

    severity: int | None = None
    text: str = ""
    at: float = 0.0


class _Mode:
    """A mode as such a log tells it."""

    def __init__(self, name: str, number: int) -> None:
        self.name, self.custom_mode = str(name), int(number)

    def to_dict(self) -> dict[str, Any]:
        return {"name": self.name, "custom_mode": self.custom_mode}


class UlogFile(_OwnLog):
    """A ``.ulg`` of PX4, read by pyulog as a whole."""

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[Entry]:
        """All rows of all topics in the order of their times."""
        try:
            with self.path.open("rb") as file, redirect_stdout(sys.stderr):  # as above
                log = import_module("pyulog").ULog(file)
        except Exception as error:  # whatever it raises on a file that is none
            raise FileFormatError(f"{self.path} is no log of PX4: {error}") from error
        if log.file_corruption:
            self.notes.append("the log is damaged: what could be read was converted")
        if not log.data_list:
            raise FileFormatError(f"{self.path} holds no data")
        self._log = log
        begins_s = _utc_of_start(log)
        self._note_time(begins_s)
        system_id = int(log.initial_parameters.get("MAV_SYS_ID", 1))
        decoder = _Px4States()
        rows = heapq.merge(*(_rows(data) for data in log.data_list), _texts(log), key=lambda row: row[0])
        size, total = self.path.stat().st_size, sum(len(data.data["timestamp"]) for data in log.data_list)
        for count, (at, table, fields) in enumerate(rows):
            if not count & 0x3FF:
                on_bytes(size * count // max(total, 1))
            if self._is_time(begins_s + at / 1e6):
                yield Entry(begins_s + at / 1e6, system_id, 1, table, fields, decoder.states(table, fields))
        self._note_left_out()
        on_bytes(size)


def _utc_of_start(log: Any) -> float:
    """UTC when PX4's clock was 0; 0 when no receiver told the time."""
    for data in log.data_list:
        if data.name in ("vehicle_gps_position", "sensor_gps") and "time_utc_usec" in data.data:
            pairs = zip(data.data["time_utc_usec"].tolist(), data.data["timestamp"].tolist(), strict=True)
            found = next(((utc - at) / 1e6 for utc, at in pairs if utc), None)
            if found is not None:
                return float(found)
    return 0.0


def _rows(data: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    name = f"{data.name}_{data.multi_id}" if data.multi_id else data.name
    fields = list(data.data)
    for row in zip(*(data.data[field].tolist() for field in fields), strict=True):
        found = dict(zip(fields, row, strict=True))
        yield found["timestamp"], name, found


def _texts(log: Any) -> Iterator[tuple[int, str, dict[str, Any]]]:
    for text in log.logged_messages:
        # The level is the kernel's, as a character: "6" is information. MAVLink's severities have the same numbers.
        severity = max(0, min(7, int(text.log_level) - 48))
        yield text.timestamp, "logged_messages", {"severity": severity, "message": text.message}


class _Px4States:
    def __init__(self) -> None:
        self._home_amsl_m: float | None = None

    def states(self, table: str, row: Mapping[str, Any]) -> States:
        try:
            return self._states(table, row)
        except KeyError:  # a version of PX4 that calls it otherwise
            return ()

    def _states(self, table: str, row: Mapping[str, Any]) -> States:
        if table == "home_position" and row.get("valid_alt", 1):
            self._home_amsl_m = row["alt"]
        elif table == "vehicle_global_position" and row.get("lat_lon_valid", 1):
            home = self._home_amsl_m
            relative = None if home is None else row["alt"] - home
            return _said("position", _place(row["lat"], row["lon"], row["alt"], relative))
        elif table == "vehicle_attitude":
            quaternion = (row["q[0]"], row["q[1]"], row["q[2]"], row["q[3]"])
            return (("attitude", Attitude.from_quaternion(*quaternion, (None, None, None))),)
        elif table == "vehicle_local_position" and row.get("v_xy_valid", 1):
            return (("velocity", Velocity(row["vx"], row["vy"], row["vz"])),)
        elif table == "vehicle_status":
            return (("armed", row["arming_state"] == 2),)
        elif table == "battery_status":
            remaining = row["remaining"]
            percent = round(remaining * 100) if math.isfinite(remaining) and remaining >= 0 else None
            current_a = _known(row["current_a"]) if row["current_a"] >= 0 else None  # -1: not known
            voltage_v = _known(row["voltage_v"]) if row["voltage_v"] > 0 else None  # 0: not known
            return (("batteries", (Battery(0, voltage_v, current_a, percent),)),)
        elif table == "logged_messages":
            return (("status_text", StatusText(row["severity"], readable(row["message"]))),)
        return ()
