"""``FlightLog``: the content of a flight log, independent of its format."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from aerokit._internal import geo
from aerokit._internal.values import Snapshot
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_NAN = math.nan
_HOME_AFTER_ARMING_S = 2.0


class TimeSeries:
    """A table of numbers with a time for each row, the oldest row first. NaN means unknown.

    ``series["roll_deg"]`` returns a column. The names contain the units. ``len(series)`` is the number of rows.
    """

    def __init__(self, *names: str) -> None:
        self.names: tuple[str, ...] = names
        """Names of the columns."""
        self.times: array[float] = array("d")
        """Seconds since the start of the log."""
        self._values = {name: array("d") for name in names}
        self._column_arrays = tuple(self._values.values())

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, name: str) -> array[float]:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __repr__(self) -> str:
        return f"<TimeSeries {', '.join(self.names)}: {len(self)} rows>"

    def add(self, time_s: float, *values: float) -> None:
        """Add a row with one value for each column. If the time is before the last row, the last row's time is used."""
        times = self.times
        if times and time_s < times[-1]:
            time_s = times[-1]
        times.append(time_s)
        for column, value in zip(self._column_arrays, values):  # noqa: B905 - equal lengths; strict= is slow, and this runs millions of times
            column.append(value)

    def extend(self, times: Sequence[float], **columns: Sequence[float]) -> None:
        """Add many rows. Columns without values become NaN."""
        self.times.extend(times)
        unknown_values = array("d", [_NAN]) * len(times)
        for name, column in self._values.items():
            column.extend(columns.get(name, unknown_values))

    def has_values(self, *names: str) -> bool:
        """Return True if one of these columns has a known value. Without names, all columns are searched."""
        # `value == value` is False for NaN. Calling math.isnan for each of millions of values would be slow.
        return any(value == value for name in names or self.names for value in self._values[name])

    def index_at(self, time_s: float) -> int:
        """Return the index of the last row at or before this time; -1 if there is none."""
        return bisect_right(self.times, time_s) - 1

    def at(self, name: str, time_s: float, *, max_age_s: float = 10.0) -> float:
        """Return the last known value at or before a time; NaN if there is none in the ``max_age_s`` before it."""
        column, index = self._values[name], self.index_at(time_s)
        while index >= 0 and self.times[index] >= time_s - max_age_s:
            if not math.isnan(column[index]):
                return column[index]
            index -= 1
        return _NAN

    def known(self, name: str) -> array[float]:
        """Return the values of a column without NaN."""
        return array("d", (value for value in self._values[name] if value == value))  # False for NaN

    def between(self, name: str, start_s: float, end_s: float) -> array[float]:
        """Return the values of a column in a time span, both ends included, without NaN."""
        values = self._values[name][bisect_left(self.times, start_s) : self.index_at(end_s) + 1]
        return array("d", (value for value in values if value == value))  # False for NaN


class TangentPlane:
    """A plane that touches the earth's ellipsoid at a position. Accurate to a metre within some kilometres."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self.latitude_deg: float = latitude_deg
        self.longitude_deg: float = longitude_deg
        latitude = max(-89.9, min(89.9, latitude_deg))  # so that the points 0.005° north and south are valid
        north_m = geo.distance_m(latitude - 0.005, longitude_deg, latitude + 0.005, longitude_deg)
        east_m = geo.distance_m(latitude, longitude_deg - 0.005, latitude, longitude_deg + 0.005)
        self.north_m_per_deg: float = north_m * 100  # `north_m` and `east_m` are the lengths of 0.01 degrees
        self.east_m_per_deg: float = east_m * 100

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Convert a position to metres north and east of the origin. NaN stays NaN."""
        east_deg = longitude_deg - self.longitude_deg
        if not -180.0 <= east_deg < 180.0 and math.isfinite(east_deg):
            east_deg = geo.wrap_longitude(east_deg)
        return (latitude_deg - self.latitude_deg) * self.north_m_per_deg, east_deg * self.east_m_per_deg

    def degrees(self, north_m: float, east_m: float) -> tuple[float, float]:
        return (self.latitude_deg + north_m / self.north_m_per_deg, self.longitude_deg + east_m / self.east_m_per_deg)


def battery_name(number: int) -> str:
    # Names count from 1, as ArduPilot's status texts and parameters do.
    return f"battery {number + 1}"


class ModeChange(Snapshot):
    """The vehicle's mode changed."""

    time_s: float
    name: str
    reason: str = ""
    """Reason for the change, such as ``"battery failsafe"``; empty if the log does not contain the reason."""
    by_autopilot: bool | None = None
    """True if the autopilot itself changed the mode; None if the log does not show who changed it."""


class LoggedText(Snapshot):
    """A status text of the vehicle."""

    time_s: float
    severity: int | None
    """MAV_SEVERITY, from 0 (emergency) to 7 (debug); None if unknown, as in a ``.bin``."""
    text: str


class ParameterChange(Snapshot):
    """A parameter changed during the log."""

    time_s: float
    name: str
    before: float
    after: float


class Silence(Snapshot):
    """A time in which nothing was received from the vehicle."""

    begins_s: float
    """Time of the last message before the silence."""
    ends_s: float
    """Time of the first message after the silence, or the end of the log."""
    is_recorded: bool
    """True if other systems' messages show that the recording ran for at least 3 s of the silence."""


class Waypoint(Snapshot):
    """A mission item."""

    number: int
    """Number in the vehicle's own count, in which ArduPilot's item 0 is home."""
    command: int
    """Number of the command (MAV_CMD)."""
    latitude_deg: float
    """NaN for items without a position."""
    longitude_deg: float
    altitude_m: float
    frame: int
    """MAV_FRAME, which defines the reference of the altitude."""


class FailsafeEvidence(Snapshot):
    """A log entry that indicates a failsafe or a problem."""

    time_s: float
    kind: str
    """A key of `aerokit.logs.flights.failsafes.KINDS`: ``"battery"``, ``"fence"`` …"""
    text: str
    """Description of the evidence, from the log."""
    is_action: bool = False
    """True if the entry shows that the autopilot acted."""


@dataclass(slots=True)
class FlightLog:
    """One flight: time series and lists. Times are seconds since ``begins_at``.

    An empty series, list or string means that the log does not contain the data.
    """

    path: Path
    """Path of the log file."""
    begins_at: float = 0.0
    """UTC of the first entry, in seconds since 1970. If the value is less than a year, the clock was not set."""
    ends_at: float = 0.0
    """UTC of the last entry, in seconds since 1970."""
    speed: float = 1.0
    """Simulated seconds for each recorded second. It differs from 1 only in a ``.tlog`` of a simulation that did not
    run in real time. All times of the flight are then in simulated seconds.
    """
    vehicle: str = ""
    """Firmware and its version, if known: ``"ArduCopter V4.5.7"``."""
    autopilot: str = ""
    """Name of the autopilot: ``"ArduPilot"`` or ``"PX4"``."""
    system_id: int = 1
    home: Position | None = None
    """Home of the first flight in the log or, if home was not logged, the position at the first arming."""
    track: TimeSeries = field(
        default_factory=lambda: TimeSeries("latitude_deg", "longitude_deg", "altitude_amsl_m", "altitude_relative_m")
    )
    velocity: TimeSeries = field(default_factory=lambda: TimeSeries("north_m_s", "east_m_s", "down_m_s"))
    attitude: TimeSeries = field(default_factory=lambda: TimeSeries("roll_deg", "pitch_deg", "yaw_deg"))
    air: TimeSeries = field(default_factory=lambda: TimeSeries("air_speed_m_s", "throttle_percent"))
    position_target: TimeSeries = field(
        default_factory=lambda: TimeSeries("latitude_deg", "longitude_deg", "altitude_amsl_m", "altitude_relative_m")
    )
    """Position set-points."""
    velocity_target: TimeSeries = field(default_factory=lambda: TimeSeries("north_m_s", "east_m_s", "down_m_s"))
    attitude_target: TimeSeries = field(default_factory=lambda: TimeSeries("roll_deg", "pitch_deg", "yaw_deg"))
    batteries: dict[int, TimeSeries] = field(default_factory=dict)
    """Time series by battery number, from 0: ``voltage_v``, ``current_a``, ``used_mah``, ``remaining_percent``."""
    gps: dict[int, TimeSeries] = field(default_factory=dict)
    """Time series by receiver number: ``fix_type`` (GPS_FIX_TYPE), ``satellites``, ``hdop``, ``accuracy_m``."""
    vibration: TimeSeries = field(default_factory=lambda: TimeSeries("x_m_s2", "y_m_s2", "z_m_s2", "clips"))
    """Vibration levels, and how often an accelerometer reached its limit. PX4 logs one level, which is ``x_m_s2``."""
    estimator: TimeSeries = field(
        default_factory=lambda: TimeSeries(
            "velocity", "horizontal_position", "vertical_position", "compass", "height_or_airspeed"
        )
    )
    """Innovation test ratios. If a ratio is above 1, the estimator rejects the measurement."""
    link: TimeSeries = field(default_factory=lambda: TimeSeries("lost_percent", "received_hz"))
    """Percentage of lost messages, and number of received messages per second. One row for each second."""
    radio: TimeSeries = field(default_factory=lambda: TimeSeries("rssi", "remote_rssi", "noise", "remote_noise"))
    """Signal values of a telemetry radio, in the units of the radio."""
    outputs: TimeSeries = field(default_factory=lambda: TimeSeries(*(f"output_{number}_us" for number in range(1, 9))))
    """Pulse lengths of the first eight outputs (SERVO_OUTPUT_RAW); only in a ``.tlog``."""
    gcs_heartbeats: array[float] = field(default_factory=lambda: array("d"))
    """Times of ground station heartbeats; only in a ``.tlog`` that includes sent messages."""
    modes: list[ModeChange] = field(default_factory=list)
    armed: list[tuple[float, float]] = field(default_factory=list)
    """Start and end of each span in which the vehicle was armed."""
    silences: list[Silence] = field(default_factory=list)
    """Times in which no message of the vehicle arrived; only from a ``.tlog``."""
    texts: list[LoggedText] = field(default_factory=list)
    failsafe_evidence: list[FailsafeEvidence] = field(default_factory=list)
    """Evidence that `aerokit.logs.flights.failsafes.failsafes` evaluates."""
    parameters: dict[str, float] = field(default_factory=dict)
    """The first logged value of each parameter."""
    parameter_changes: list[ParameterChange] = field(default_factory=list)
    mission: list[Waypoint] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Problems of the log, and known reasons for missing data."""
    _latest_parameters: dict[str, float] = field(default_factory=dict, repr=False)

    @property
    def duration_s(self) -> float:
        """Seconds from the first entry to the last; simulated seconds if `speed` is not 1."""
        return max(self.ends_at - self.begins_at, 0.0) * self.speed

    def battery(self, number: int) -> TimeSeries:
        """Return the time series of a battery. The first call creates it."""
        if number not in self.batteries:
            self.batteries[number] = TimeSeries("voltage_v", "current_a", "used_mah", "remaining_percent")
        return self.batteries[number]

    def receiver(self, number: int) -> TimeSeries:
        """Return the time series of a GNSS receiver. The first call creates it."""
        if number not in self.gps:
            self.gps[number] = TimeSeries("fix_type", "satellites", "hdop", "accuracy_m")
        return self.gps[number]

    def mode_at(self, time_s: float) -> str:
        """Return the mode at this time; empty if unknown."""
        index = bisect_right(self.modes, time_s, key=lambda change: change.time_s)
        return self.modes[index - 1].name if index else ""

    def item_label(self, item: Waypoint) -> str:
        """Return the label of a mission item: its number without home. ArduPilot's item 0 is "home", its item 1 "0"."""
        if self.autopilot != "ArduPilot":
            return str(item.number)
        return str(item.number - 1) if item.number else "home"

    def mode_spans(self) -> list[tuple[ModeChange, float]]:
        """Return a pair for each mode of the flight: its mode change, and the time in seconds at which the mode ends.

        The last mode ends at ``duration_s``.
        """
        ends = [change.time_s for change in self.modes[1:]] + [self.duration_s]
        return list(zip(self.modes, ends))  # noqa: B905 - without modes, there is one end too many

    def parameter_at(self, name: str, time_s: float) -> float:
        """Return the value of a parameter at this time; NaN if unknown."""
        value = self.parameters.get(name, math.nan)
        for change in self.parameter_changes:
            if change.name == name and change.time_s <= time_s:
                value = change.after
        return value

    def add_mode(self, time_s: float, name: str, reason: str = "", by_autopilot: bool | None = None) -> bool:
        """Record the mode at a time. Return False if this is already the flight's mode."""
        if self.modes and self.modes[-1].name == name:
            return False
        self.modes.append(ModeChange(time_s, name, reason, by_autopilot))
        return True

    def set_armed(self, time_s: float, armed: bool) -> None:
        """Record the arming state. A span ends at infinity until the vehicle is disarmed."""
        begin_s, end_s = self.armed[-1] if self.armed else (0.0, 0.0)
        is_open = math.isinf(end_s)
        if armed and not is_open:
            self.armed.append((time_s, math.inf))
        elif not armed and is_open:
            self.armed[-1] = (begin_s, time_s)

    def set_home(self, time_s: float, latitude_deg: float, longitude_deg: float, amsl_m: float) -> None:
        """Record home, if it is valid.

        Until the first arming, ArduPilot moves home with the vehicle. From two seconds after the first arming on, a
        known home is kept.
        """
        is_valid = abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180 and (latitude_deg or longitude_deg)
        if not is_valid:  # NaN fails the comparisons; 0, 0 means that home is not set
            return
        home = Position(latitude_deg, longitude_deg, amsl_m if math.isfinite(amsl_m) else None)
        first_armed_s, _ = self.armed[0] if self.armed else (math.inf, math.inf)
        if self.home is None or time_s <= first_armed_s + _HOME_AFTER_ARMING_S:
            self.home = home

    def set_parameter(self, time_s: float, name: str, value: float) -> None:
        """Record a parameter's value: its first value, or a change."""
        first_value = self.parameters.setdefault(name, value)
        old_value = self._latest_parameters.get(name, first_value)
        self._latest_parameters[name] = value
        is_unchanged = value == old_value or (math.isnan(value) and math.isnan(old_value))
        if not is_unchanged:
            self.parameter_changes.append(ParameterChange(time_s, name, old_value, value))
