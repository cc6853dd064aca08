"""Reads a `FlightLog` from a ``.bin`` of ArduPilot. pymavlink indexes the rows; only needed columns are unpacked."""

from __future__ import annotations

import math
import operator
import re
import struct
from collections import defaultdict
from itertools import compress
from typing import TYPE_CHECKING, Any

from aerokit.autopilots.ardupilot import ardupilot_for
from aerokit.errors import FileFormatError
from aerokit.logs.flights.codes import (
    ERRORS,
    MODE_REASONS,
    ardupilot_system_id,
    clean_text,
    error_text,
    skipped_rows_note,
)
from aerokit.logs.flights.flight import FailsafeEvidence, LoggedText, TangentPlane, TimeSeries, Waypoint
from aerokit.logs.flights.flight_controllers import close_bin, opened_bin
from aerokit.mavlink.enums import GpsFixType, MavType
from aerokit.missions.item import has_place

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from aerokit.logs.flights.flight import FlightLog

NAN = math.nan
_CHUNK_ROWS = 1 << 9  # rows that are unpacked at once; with more rows, garbage collection would take longer
_HEADER_SIZE = 3  # bytes before the fields of a row: A3 95 and the number of the table
# The percentage of an unknown charge: AP_BattMonitor_Logging.cpp writes -1 as an unsigned byte.
_NO_PERCENT = 255
_FIRMWARES = {
    "ArduCopter": MavType.QUADROTOR,
    "ArduPlane": MavType.FIXED_WING,
    "ArduRover": MavType.GROUND_ROVER,
    "Rover": MavType.GROUND_ROVER,
    "ArduSub": MavType.SUBMARINE,
    "AntennaTracker": MavType.ANTENNA_TRACKER,
    "Blimp": MavType.AIRSHIP,
}
_ARMED, _DISARMED = 10, 11  # events (EV) that old logs have instead of ARM
_HOME = 1
# A position within this distance of 0° N 0° E is not real: the estimator has no position yet.
_NULL_ISLAND_DEG = 0.01
# A row is damaged in two cases:
# - It is later than the next row of its table, or earlier than the previous one, by more than _MAX_DISORDER_S.
# - It is later than the second to last row of all tables by more than _MAX_LATE_S.
_MAX_DISORDER_S, _MAX_LATE_S = 1.0, 3600.0
_SAME_SETPOINT_S = 0.005  # PSCN and PSCE rows with times that differ by at most this are one set-point
_INDEXING_SHARE = 0.3  # the progress is 30 % when pymavlink has indexed the rows


def read_bin_flight(flight: FlightLog, system_id: int | None, on_bytes: Callable[[int], object]) -> None:
    """Fill a flight with the content of the file ``flight.path``. ``system_id`` is ignored: a .bin has one vehicle.

    Raises:
        FileFormatError: the file is not an ArduPilot log, or was written before 2015.
    """
    size = flight.path.stat().st_size

    def on_indexing(percent: float) -> None:
        on_bytes(round(size * _INDEXING_SHARE * percent / 100))

    def on_reading(share: float) -> None:
        on_bytes(round(size * (_INDEXING_SHARE + (1 - _INDEXING_SHARE) * share)))

    reader = opened_bin(flight.path, on_indexing)
    try:
        _Reader(flight, _Tables(reader)).read(on_reading)
    finally:
        close_bin(reader)


class _Tables:
    """Reads the tables of a log by means of pymavlink's index of their rows."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self.began_us = self._first_time()
        second_to_last_us = max((time_us for _, time_us in self._rows_at(-2)), default=math.inf)
        self._max_s = (second_to_last_us - self.began_us) / 1e6 + _MAX_LATE_S
        self.damaged: set[int] = set()
        """Offsets of the rows that were skipped because their time is impossible."""

    @property
    def unix_at_0(self) -> float:
        """UTC at power-on, in seconds since 1970; 0 without GNSS time."""
        return float(getattr(self._reader.clock, "timebase", 0.0) or 0.0)

    def has(self, table: str, *columns: str) -> bool:
        number = self._reader.name_to_id.get(table)
        if number is None or not len(self._reader.offsets[number]):
            return False
        return {"TimeUS", *columns} <= set(self._reader.formats[number].columns)

    def rows(self, table: str, *columns: str) -> Iterator[tuple[Any, ...]]:
        """Yield a tuple for each row: the seconds since the start of the log, then the values of these columns.

        Yields nothing if a column is missing. Texts are ``str``. Numbers are scaled as the log defines (FMTU, MULT).
        """
        for chunk in self._chunks(table, columns):
            yield from zip(*chunk, strict=True)

    def columns(self, table: str, *columns: str) -> list[list[Any]]:
        """Like :meth:`rows`, but return a list of the times, then one list for each column."""
        times_and_columns: list[list[Any]] = [[] for _ in range(len(columns) + 1)]
        for chunk in self._chunks(table, columns):
            for column, part in zip(times_and_columns, chunk, strict=True):
                column.extend(part)
        return times_and_columns

    def _chunks(self, table: str, columns: Sequence[str]) -> Iterator[list[list[Any]]]:
        """Yield the times and the columns of up to `_CHUNK_ROWS` rows at a time."""
        if not self.has(table, *columns):
            return
        reader = self._reader
        row_format = reader.formats[reader.name_to_id[table]]
        indices = [row_format.columns.index(name) for name in ("TimeUS", *columns)]
        unpack = struct.Struct(_struct_pattern(row_format, indices)).unpack_from
        # The columns of unpacked rows are in the order of the file. `positions` has the index of each requested column.
        positions = [sorted(indices).index(index) for index in indices]
        scales = [row_format.msg_mults[index] for index in indices]
        data, offsets = reader.data_map, reader.offsets[row_format.type]
        last_offset = len(data) - row_format.len  # a row after this offset is cut off by the end of the file
        for begin in range(0, len(offsets), _CHUNK_ROWS):
            chunk_offsets = offsets[begin : begin + _CHUNK_ROWS]
            rows = [unpack(data, offset + _HEADER_SIZE) for offset in chunk_offsets if offset <= last_offset]
            if not rows:
                continue
            unpacked = list(zip(*rows, strict=True))
            chunk = [_scaled(unpacked[position], scale) for position, scale in zip(positions, scales, strict=True)]
            times_us, *values = chunk
            times = [(time_us - self.began_us) / 1e6 for time_us in times_us]
            yield self._without_damaged_rows([times, *values], chunk_offsets)

    def _without_damaged_rows(self, times_and_columns: list[list[Any]], offsets: Sequence[int]) -> list[list[Any]]:
        """Drop rows whose time is not plausible, and record their offsets."""
        times = times_and_columns[0]
        increases = all(map(operator.le, times, times[1:]))
        if increases and times[-1] <= self._max_s:
            return times_and_columns
        kept = [self._is_plausible(times, row) for row in range(len(times))]
        self.damaged.update(offset for offset, is_kept in zip(offsets, kept, strict=False) if not is_kept)
        return [list(compress(column, kept)) for column in times_and_columns]

    def _is_plausible(self, times: Sequence[float], row: int) -> bool:
        # Rows have no checksum, so a time may be damaged. After a damaged late time, `TimeSeries.add` would give this
        # time to later rows, too.
        time_s = times[row]
        previous_s = times[row - 1] if row else time_s
        next_s = times[row + 1] if row + 1 < len(times) else time_s
        is_outlier = time_s > next_s + _MAX_DISORDER_S or time_s < previous_s - _MAX_DISORDER_S
        neighbours_agree = 0.0 <= previous_s <= next_s + _MAX_DISORDER_S  # otherwise one of them may be the outlier
        return time_s <= self._max_s and not (is_outlier and neighbours_agree)

    def _first_time(self) -> int:
        # Use the row that is first in the file. The row with the lowest time could be a damaged one.
        first_rows = list(self._rows_at(0))
        if not first_rows:
            raise FileFormatError(
                f"{self._reader.filehandle.name} has no row with a time (TimeUS): it is empty, or from before 2015"
            )
        _, time_us = min(first_rows)
        return time_us

    def _rows_at(self, index: int) -> Iterator[tuple[int, int]]:
        """Yield the offset and the time (µs) of row ``index`` of each table. Tables without this row are skipped."""
        reader = self._reader
        for number in reader.name_to_id.values():
            offsets, row_format = reader.offsets[number], reader.formats[number]
            if not -len(offsets) <= index < len(offsets) or "TimeUS" not in row_format.columns:
                continue
            column = row_format.columns.index("TimeUS")
            # "Q" is a 64-bit integer. A row at the end of the file may be incomplete.
            if row_format.format[column] == "Q" and offsets[index] + row_format.len <= len(reader.data_map):
                pattern = _struct_pattern(row_format, [column])
                (time_us,) = struct.unpack_from(pattern, reader.data_map, offsets[index] + _HEADER_SIZE)
                yield int(offsets[index]), int(time_us)


def _struct_pattern(row_format: Any, indices: Sequence[int]) -> str:
    """Return the struct layout of rows in which all columns except ``indices`` are padding."""
    _, *codes = re.findall(r"\d*\D", row_format.msg_struct)  # "<Qf64s" has the codes "Q", "f" and "64s"
    padded = [code if index in indices else f"{struct.calcsize('<' + code)}x" for index, code in enumerate(codes)]
    return "<" + "".join(padded)


def _scaled(values: Sequence[Any], scale: float | None) -> list[Any]:
    """Decode the strings of a column, or multiply its numbers by ``scale``."""
    if values and isinstance(values[0], bytes):
        return [value.split(b"\0", 1)[0].decode("utf-8", "replace") for value in values]
    if scale is None:
        return list(values)
    # Scales below 1 are powers of ten (MULT records). Dividing by 100 is more exact than multiplying by 0.01.
    if 0 < scale < 1:
        divisor = round(1 / scale)
        return [value / divisor for value in values]
    return [value * scale for value in values]


def _wrapped(angles: Sequence[float]) -> list[float]:
    return [(angle + 180) % 360 - 180 for angle in angles]


class _Reader:
    """Fills a flight with the content of the tables."""

    def __init__(self, flight: FlightLog, tables: _Tables) -> None:
        self._flight, self._tables = flight, tables

    def read(self, on_share: Callable[[float], object]) -> None:
        flight, tables = self._flight, self._tables
        flight.autopilot = "ArduPilot"
        flight.begins_at = tables.unix_at_0 + tables.began_us / 1e6
        steps = (
            self._read_texts, self._read_modes, self._read_armed, self._read_parameters, self._read_mission,
            self._read_home, self._read_track, self._read_velocity, self._read_attitude, self._read_targets,
            self._read_air, self._read_batteries, self._read_gps, self._read_vibration, self._read_estimator,
            self._read_radio, self._read_errors,
        )  # fmt: skip
        for steps_done, step in enumerate(steps, 1):
            step()
            on_share(steps_done / len(steps))
        all_series = (flight.track, flight.attitude, flight.vibration, *flight.batteries.values())
        ends = [series.times[-1] for series in all_series if len(series)]
        if flight.texts:
            ends.append(flight.texts[-1].time_s)
        flight.ends_at = flight.begins_at + max(ends, default=0.0)
        if tables.damaged:
            flight.notes.append(skipped_rows_note(len(tables.damaged)))
        if not tables.unix_at_0:
            flight.notes.append("no GNSS time in the log: times count from power-on")

    def _read_texts(self) -> None:
        flight = self._flight
        rows = self._tables.rows("MSG", "Message")
        flight.texts = [LoggedText(time, severity=None, text=clean_text(text)) for time, text in rows]
        banners = (text.text for text in flight.texts if text.text.split(" ")[0] in _FIRMWARES)
        banner = next(banners, "")  # such as "ArduCopter V4.5.7 (2a3dc4b7)"
        flight.vehicle = " ".join(banner.split(" ")[:2]) or "ArduPilot"

    def _read_modes(self) -> None:
        vehicle_type = _FIRMWARES.get(self._flight.vehicle.split(" ")[0], MavType.GENERIC)
        modes = ardupilot_for(vehicle_type).modes
        has_reason = self._tables.has("MODE", "ModeNum", "Rsn")
        columns = ("ModeNum", "Rsn") if has_reason else ("ModeNum",)
        for time_s, mode_number, *optional_reason in self._tables.rows("MODE", *columns):
            reason_number = optional_reason[0] if has_reason else None
            reason, failsafe, by_autopilot = MODE_REASONS.get(reason_number, ("", None, None))
            name = modes.name_of(mode_number)
            if self._flight.add_mode(time_s, name, reason, by_autopilot) and failsafe:
                text = f"mode {name}, reason: {reason} (MODE)"
                self._flight.failsafe_evidence.append(FailsafeEvidence(time_s, failsafe, text, is_action=True))

    def _read_armed(self) -> None:
        if self._tables.has("ARM", "ArmState"):
            for time, armed in self._tables.rows("ARM", "ArmState"):
                self._flight.set_armed(time, bool(armed))
            return
        for time, event in self._tables.rows("EV", "Id"):
            if event in (_ARMED, _DISARMED):
                self._flight.set_armed(time, event == _ARMED)

    def _read_parameters(self) -> None:
        for time, name, value in self._tables.rows("PARM", "Name", "Value"):
            self._flight.set_parameter(time, name, value)
        self._flight.system_id = ardupilot_system_id(self._flight.parameters)

    def _read_mission(self) -> None:
        items: dict[int, Waypoint] = {}
        total = 0  # number of items of the last mission; `items` may also have items of longer, earlier missions
        for row in self._tables.rows("CMD", "CTot", "CNum", "CId", "Lat", "Lng", "Alt", "Frame"):
            _, total, number, command, latitude, longitude, altitude, frame = row
            if not has_place(command) or not (latitude or longitude):
                latitude, longitude = NAN, NAN  # the item has no position
            items[number] = Waypoint(
                number, command, latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude, frame=frame
            )
        self._flight.mission = [items[number] for number in sorted(items) if number < total]

    def _read_home(self) -> None:
        for row in self._tables.rows("ORGN", "Type", "Lat", "Lng", "Alt"):
            time, kind, latitude, longitude, altitude = row
            if kind == _HOME:
                self._flight.set_home(time, latitude, longitude, altitude)

    def _read_track(self) -> None:
        track = self._flight.track
        for time, latitude, longitude, amsl, relative in self._tables.rows("POS", "Lat", "Lng", "Alt", "RelHomeAlt"):
            if abs(latitude) > _NULL_ISLAND_DEG or abs(longitude) > _NULL_ISLAND_DEG:
                track.add(time, latitude, longitude, amsl, relative)
        if len(track):
            return
        # If the estimator has no positions, use those of the first GPS receiver that has a 3D fix.
        number_column = ("I",) if self._tables.has("GPS", "I") else ()
        used_receiver: int | None = None
        for time, status, latitude, longitude, amsl, *optional_number in self._tables.rows(
            "GPS", "Status", "Lat", "Lng", "Alt", *number_column
        ):
            receiver = optional_number[0] if number_column else 0
            if status >= GpsFixType.TYPE_3D_FIX and used_receiver in (None, receiver):
                used_receiver = receiver
                track.add(time, latitude, longitude, amsl, NAN)

    def _read_velocity(self) -> None:
        table = "XKF1" if self._tables.has("XKF1", "VN", "VE", "VD") else "NKF1"  # old logs have NKF1
        core_columns = ("C",) if self._tables.has(table, "C") else ()
        for time_s, north, east, down, *core in self._tables.rows(table, "VN", "VE", "VD", *core_columns):
            if not core or core == [0]:  # one estimator, or the first of several
                self._flight.velocity.add(time_s, north, east, down)

    def _read_attitude(self) -> None:
        times, roll, pitch, yaw = self._tables.columns("ATT", "Roll", "Pitch", "Yaw")
        self._flight.attitude.extend(times, roll_deg=roll, pitch_deg=pitch, yaw_deg=_wrapped(yaw))
        times, roll, pitch, yaw = self._tables.columns("ATT", "DesRoll", "DesPitch", "DesYaw")
        self._flight.attitude_target.extend(times, roll_deg=roll, pitch_deg=pitch, yaw_deg=_wrapped(yaw))

    def _read_targets(self) -> None:
        # The set-points (PSCN, PSCE) are relative to the estimator's origin.
        origin = self._origin()
        plane = None if origin is None else TangentPlane(*origin)
        east = TimeSeries("m", "m_s")
        for row in self._tables.rows("PSCE", "TPE", "TVE"):
            east.add(*row)
        for time, north_m, north_m_s in self._tables.rows("PSCN", "TPN", "TVN"):
            # A set-point has a row in PSCN and one in PSCE, with almost the same time. One of the two may be lost.
            east_m, east_m_s = (east.at(name, time + _SAME_SETPOINT_S, max_age_s=2 * _SAME_SETPOINT_S) for name in east)
            if plane is not None and not math.isnan(east_m):
                latitude, longitude = plane.degrees(north_m, east_m)
                self._flight.position_target.add(time, latitude, longitude, NAN, NAN)  # _add_heights() adds altitudes
            self._flight.velocity_target.add(time, north_m_s, east_m_s, NAN)
        self._add_heights(self._tables.rows("CTUN", "DAlt"))

    def _add_heights(self, heights: Iterator[tuple[Any, ...]]) -> None:
        target = self._flight.position_target
        has_positions = len(target) > 0
        relative = target["altitude_relative_m"]
        for time, height in heights:
            # Positions and heights are logged at the same rate, so each height belongs to the latest position.
            if has_positions:
                row = max(target.index_at(time), 0)
                relative[row] = height
            else:
                target.add(time, NAN, NAN, NAN, height)

    def _origin(self) -> tuple[float, float] | None:
        for _, kind, latitude, longitude in self._tables.rows("ORGN", "Type", "Lat", "Lng"):
            if kind != _HOME and (latitude or longitude):
                return latitude, longitude
        return None

    def _read_air(self) -> None:
        for time, speed in self._tables.rows("ARSP", "Airspeed"):
            self._flight.air.add(time, speed, NAN)

    def _read_batteries(self) -> None:
        instance = "Inst" if self._tables.has("BAT", "Inst") else "Instance"
        has_percent = self._tables.has("BAT", "RemPct")
        columns = [instance, "Volt", "Curr", "CurrTot"]
        if has_percent:
            columns.append("RemPct")
        for time_s, number, voltage, current, used, *optional_percent in self._tables.rows("BAT", *columns):
            percent = optional_percent[0] if has_percent else _NO_PERCENT
            self._flight.battery(number).add(time_s, voltage, current, used, NAN if percent == _NO_PERCENT else percent)

    def _read_gps(self) -> None:
        # GPA has the accuracy for each row of GPS. Rows belong together if time and receiver are the same.
        accuracy: defaultdict[tuple[float, int], float] = defaultdict(lambda: NAN)
        for time, number, accuracy_m in self._tables.rows("GPA", "I", "HAcc"):
            accuracy[time, number] = accuracy_m
        for time, number, status, satellites, hdop in self._tables.rows("GPS", "I", "Status", "NSats", "HDop"):
            self._flight.receiver(number).add(time, status, satellites, hdop, accuracy[time, number])

    def _read_vibration(self) -> None:
        columns = ("VibeX", "VibeY", "VibeZ", "Clip", "IMU")
        for time, x, y, z, clips, number in self._tables.rows("VIBE", *columns):
            if number == 0:  # the first of several IMUs
                self._flight.vibration.add(time, x, y, z, clips)

    def _read_estimator(self) -> None:
        columns = ("SV", "SP", "SH", "SM", "SVT")
        table = "XKF4" if self._tables.has("XKF4", "SV") else "NKF4"
        if not self._tables.has("XKF4", "C", "PI"):
            for time_s, *ratios in self._tables.rows(table, *columns):
                self._flight.estimator.add(time_s, *ratios)
            return
        # Only rows of the primary estimator are used. C is the estimator of the row, PI the primary one. A negative PI
        # means 0.
        for time_s, *ratios, core, primary in self._tables.rows(table, *columns, "C", "PI"):
            if core == max(primary, 0):
                self._flight.estimator.add(time_s, *ratios)

    def _read_radio(self) -> None:
        for row in self._tables.rows("RAD", "RSSI", "RemRSSI", "Noise", "RemNoise"):
            self._flight.radio.add(*row)

    def _read_errors(self) -> None:
        for time, subsystem, code in self._tables.rows("ERR", "Subsys", "ECode"):
            kind, text = ERRORS.get(subsystem, ("general", f"subsystem {subsystem}"))
            if code:  # 0 means that the error is over
                description = f"{error_text(subsystem, code, text)} (ERR {subsystem}/{code})"
                self._flight.failsafe_evidence.append(FailsafeEvidence(time, kind, description))
