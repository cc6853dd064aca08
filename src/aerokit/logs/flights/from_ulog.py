"""Reads a `FlightLog` from a ``.ulg`` of PX4; pyulog loads the needed topics."""

from __future__ import annotations

import io
import math
import sys
from array import array
from contextlib import redirect_stdout
from importlib import import_module
from typing import TYPE_CHECKING, Any, BinaryIO

from aerokit.autopilots.px4 import Px4
from aerokit.errors import FileFormatError
from aerokit.logs.flights.codes import clean_text, skipped_rows_note
from aerokit.logs.flights.flight import FailsafeEvidence, LoggedText, TangentPlane
from aerokit.mavlink.enums import GpsFixType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from aerokit.logs.flights.flight import FlightLog, TimeSeries

NAN = math.nan
_TOPICS = (
    *("vehicle_status", "failsafe_flags", "vehicle_global_position", "vehicle_local_position"),
    *("vehicle_attitude", "vehicle_attitude_setpoint", "vehicle_local_position_setpoint", "battery_status"),
    *("vehicle_gps_position", "sensor_gps", "estimator_status", "vehicle_imu_status", "telemetry_status"),
    *("home_position", "airspeed_validated", "radio_status"),
)
_ARMING_STATE_ARMED = 2
# Maps ``nav_state`` of vehicle_status to names of modes (VehicleStatus.msg).
_NAV_STATES = {
    0: "MANUAL",
    1: "ALTCTL",
    2: "POSCTL",
    3: "MISSION",
    4: "LOITER",
    5: "RTL",
    6: "POSITION_SLOW",
    10: "ACRO",
    12: "DESCEND",
    13: "TERMINATION",
    14: "OFFBOARD",
    15: "STABILIZED",
    17: "TAKEOFF",
    18: "LAND",
    19: "FOLLOWME",
    20: "PRECLAND",
    21: "ORBIT",
    22: "VTOL_TAKEOFF",
    **{22 + number: f"EXTERNAL{number}" for number in range(1, 9)},
}
# Maps flags of failsafe_flags to the kind of failsafe and a description (FailsafeFlags.msg).
_FAILSAFE_FLAGS = {
    "manual_control_signal_lost": ("radio", "RC signal lost"),
    "gcs_connection_lost": ("ground station", "ground station connection lost"),
    "offboard_control_signal_lost": ("offboard", "no offboard set-points"),
    "geofence_breached": ("fence", "outside the fence"),
    "battery_unhealthy": ("battery", "battery unhealthy"),
    "battery_low_remaining_time": ("battery", "low remaining battery time"),
    "global_position_invalid": ("estimator", "global position invalid"),
    "local_position_invalid": ("estimator", "local position invalid"),
    "attitude_invalid": ("estimator", "attitude invalid"),
    "mission_failure": ("mission", "mission failed"),
    "wind_limit_exceeded": ("wind", "wind limit exceeded"),
    "flight_time_limit_exceeded": ("time", "flight time limit exceeded"),
    "navigator_failure": ("general", "navigator failed"),
    "fd_critical_failure": ("crash", "attitude or altitude limit exceeded"),
    "fd_motor_failure": ("motor", "motor failed"),
    "vtol_fixed_wing_system_failure": ("transition", "fixed-wing system failure"),
}
_BATTERY_WARNINGS = {1: "low", 2: "critical", 3: "emergency", 4: "failed"}
_LOADING_SHARE = 0.9  # the progress is 90 % when pyulog has loaded the file
_BUFFER = 1 << 20
_MAX_DISORDER_US, _MAX_LATE_US, _MAX_TIME_US = 10**6, 3600 * 10**6, 1 << 62


def read_ulog_flight(flight: FlightLog, system_id: int | None, on_bytes: Callable[[int], object]) -> None:
    """Fill a flight with the content of the file ``flight.path``. ``system_id`` is ignored: a .ulg has one vehicle.

    Raises:
        FileFormatError: the file is not a PX4 log.
        ModuleNotFoundError: pyulog is not installed.
    """
    with io.BufferedReader(_ProgressFile(flight.path, on_bytes), _BUFFER) as file:
        log = load_ulog(file, flight.path, list(_TOPICS))
    if not log.data_list and not log.logged_messages:
        raise FileFormatError(f"{flight.path} contains no data of a flight")
    if log.file_corruption:
        flight.notes.append("the log is damaged: only the readable part is shown")
    if log.dropouts:
        lost_s = sum(dropout.duration for dropout in log.dropouts) / 1e3
        flight.notes.append(f"{len(log.dropouts)} logging dropouts, {lost_s:.1f} s in total")
    _Reader(flight, log).read()


def load_ulog(file: BinaryIO, path: Path, topics: list[str] | None = None) -> Any:
    """Load these topics of a log with pyulog, or all topics."""
    pyulog = import_module("pyulog")
    try:
        with redirect_stdout(sys.stderr):  # pyulog prints about damage, but stdout may be for JSON
            return pyulog.ULog(file, topics)
    except Exception as error:  # pyulog raises arbitrary errors for other files
        raise FileFormatError(f"{path} is not a PX4 log: {error}") from error


def severity_of(text: Any) -> int:
    # `log_level` is the character code of a digit: 54, the code of "6", is info. The Linux kernel's levels and
    # MAV_SEVERITY have the same numbers.
    return max(0, min(7, int(text.log_level) - ord("0")))


class _ProgressFile(io.FileIO):
    """An unbuffered file that reports its progress: the number of bytes read so far."""

    def __init__(self, path: Path, on_bytes: Callable[[int], object]) -> None:
        super().__init__(path)
        self._on_bytes = on_bytes

    def readinto(self, buffer: Any) -> int | None:
        count = super().readinto(buffer)
        self._on_bytes(round(_LOADING_SHARE * self.tell()))
        return count


class _Topic:
    """The rows of one instance of a topic. Times are in seconds since the start of the log."""

    def __init__(self, data: dict[str, Any], began_us: int) -> None:
        self._data = data
        self.times: list[float] = ((data["timestamp"].astype("int64") - began_us) / 1e6).tolist()

    def __contains__(self, field: str) -> bool:
        return field in self._data

    def array(self, *fields: str) -> Any:
        """Return the first of these columns that exists, as a numpy array; an array of NaN if none exists."""
        for field in fields:
            if field in self._data:
                return self._data[field].astype("float64")
        return self._data["timestamp"] * NAN

    def valid_array(self, field: str, flag: str) -> Any:
        """Return a column with NaN where its flag is 0."""
        values = self.array(field)
        # Old versions of PX4 do not have all flags.
        if flag in self:
            values[self.array(flag) == 0] = NAN
        return values

    def rows(self, *fields: str) -> Iterator[tuple[Any, ...]]:
        """Yield the time and the values of each row. Fields that the topic does not have are NaN."""
        yield from zip(self.times, *(self.array(field).tolist() for field in fields), strict=True)

    def changes(self, field: str) -> Iterator[tuple[float, float]]:
        previous = None
        for time_s, value in self.rows(field):
            if value != previous:
                yield time_s, value
                previous = value


class _Reader:
    """Fills a flight with the content of a log that pyulog has loaded."""

    def __init__(self, flight: FlightLog, log: Any) -> None:
        self._flight, self._log = flight, log
        self._data = [data for data in log.data_list if len(data.data.get("timestamp", ()))]
        self._damaged = _drop_damaged_rows(self._data)
        first_times = [int(data.data["timestamp"][0]) for data in self._data]
        self._began_us = min([int(log.start_timestamp), *first_times])

    def read(self) -> None:
        flight, log = self._flight, self._log
        flight.autopilot = "PX4"
        flight.vehicle = _version(log)
        booted_at = utc_at_boot(log)
        flight.begins_at = booted_at + self._began_us / 1e6
        last_us = log.last_timestamp
        if self._damaged:
            flight.notes.append(skipped_rows_note(self._damaged))
            last_us = max([int(data.data["timestamp"][-1]) for data in self._data], default=self._began_us)
        flight.ends_at = booted_at + last_us / 1e6
        if not booted_at:
            flight.notes.append("no GNSS time in the log: times count from power-on")
        flight.system_id = int(log.initial_parameters.get("MAV_SYS_ID", 1))
        for text in log.logged_messages:
            time_s, logged = self._time(text.timestamp), clean_text(str(text.message))
            flight.texts.append(LoggedText(time_s, severity_of(text), logged))
        initial = [(log.start_timestamp, name, value) for name, value in log.initial_parameters.items()]
        for time_us, name, value in (*initial, *log.changed_parameters):
            if isinstance(value, (int, float)):
                flight.set_parameter(self._time(time_us), str(name), float(value))
        self._read_status()
        self._read_movement()
        self._read_targets()
        self._read_equipment()

    def _time(self, time_us: int) -> float:
        """Return the seconds since the start of the log; 0 for earlier times."""
        return max((int(time_us) - self._began_us) / 1e6, 0.0)

    def _topics(self, *names: str) -> list[tuple[int, _Topic]]:
        """Return the numbered instances of the first topic in ``names`` that the log has."""
        for name in names:
            instances = [data for data in self._data if data.name == name]
            if instances:
                return [(data.multi_id, _Topic(data.data, self._began_us)) for data in instances]
        return []

    def _topic(self, *names: str) -> _Topic | None:
        return next((topic for _, topic in self._topics(*names)), None)

    def _read_status(self) -> None:
        flight, status = self._flight, self._topic("vehicle_status")
        if status is not None:
            self._read_modes(status)
            for time_s, state in status.changes("arming_state"):
                flight.set_armed(time_s, state == _ARMING_STATE_ARMED)
            for time_s, failsafe in status.changes("failsafe"):
                if failsafe == 1:
                    flight.failsafe_evidence.append(
                        FailsafeEvidence(time_s, "general", "failsafe active (vehicle_status.failsafe)", is_action=True)
                    )
        self._read_failsafe_flags()

    def _read_modes(self, status: _Topic) -> None:
        fields = ("nav_state", "nav_state_user_intention", "failsafe")
        for time_s, state, intended_state, failsafe in status.rows(*fields):
            name = _NAV_STATES.get(int(state), f"MODE {int(state)}")
            # If the mode is not the one that the pilot or a program requested, the autopilot itself has changed it.
            by_autopilot = None if math.isnan(intended_state) else bool(state != intended_state)
            reason = ""
            if failsafe == 1:
                reason = "failsafe"
            elif by_autopilot:
                reason = "autopilot"
            self._flight.add_mode(time_s, name, reason, by_autopilot)

    def _read_failsafe_flags(self) -> None:
        flight, flags = self._flight, self._topic("failsafe_flags")
        if flags is None:
            return

        # Flags are ignored until one second after arming, because many flags are set on the ground.
        def is_armed(time_s: float) -> bool:
            return any(begin + 1 < time_s <= end for begin, end in flight.armed)

        for name, (kind, text) in _FAILSAFE_FLAGS.items():
            if name in flags:
                flight.failsafe_evidence += [
                    FailsafeEvidence(time_s, kind, f"{text} ({name})")
                    for time_s, value in flags.changes(name)
                    if value == 1 and is_armed(time_s)
                ]
        for time_s, warning in flags.changes("battery_warning"):
            if warning in _BATTERY_WARNINGS and is_armed(time_s):
                flight.failsafe_evidence.append(
                    FailsafeEvidence(time_s, "battery", f"battery {_BATTERY_WARNINGS[int(warning)]} (battery_warning)")
                )

    def _read_movement(self) -> None:
        flight = self._flight
        home = self._topic("home_position")
        if home is not None:
            for time_s, home_latitude, home_longitude, home_amsl in home.rows("lat", "lon", "alt"):
                flight.set_home(time_s, home_latitude, home_longitude, home_amsl)
        position = self._topic("vehicle_global_position")
        if position is not None:
            latitude, longitude = (position.valid_array(field, "lat_lon_valid") for field in ("lat", "lon"))
            amsl = position.valid_array("alt", "alt_valid")
            _extend(flight.track, position.times, latitude_deg=latitude, longitude_deg=longitude, altitude_amsl_m=amsl)
        else:
            self._read_receiver_track()
        local = self._topic("vehicle_local_position")
        if local is not None:
            north, east = (local.valid_array(field, "v_xy_valid") for field in ("vx", "vy"))
            down = local.valid_array("vz", "v_z_valid")
            _extend(flight.velocity, local.times, north_m_s=north, east_m_s=east, down_m_s=down)
        self._add_angles(flight.attitude, self._topic("vehicle_attitude"), "q")
        air = self._topic("airspeed_validated")
        if air is not None:
            speed = air.array("calibrated_airspeed_m_s")
            _extend(flight.air, air.times, air_speed_m_s=speed)

    def _read_receiver_track(self) -> None:
        receiver = self._topic("vehicle_gps_position", "sensor_gps")
        if receiver is not None:
            has_integers = "lat" in receiver  # old versions of PX4 log 1e-7 degrees and millimetres
            fields = ("lat", "lon", "alt") if has_integers else ("latitude_deg", "longitude_deg", "altitude_msl_m")
            per_degree, per_metre = (1e7, 1e3) if has_integers else (1, 1)
            for time_s, fix_type, latitude, longitude, amsl in receiver.rows("fix_type", *fields):
                if fix_type >= GpsFixType.TYPE_3D_FIX:
                    self._flight.track.add(time_s, latitude / per_degree, longitude / per_degree, amsl / per_metre, NAN)

    def _add_angles(self, series: TimeSeries, topic: _Topic | None, field: str) -> None:
        """Add the roll, pitch and yaw angles of the quaternions in a field."""
        if topic is None or f"{field}[0]" not in topic:
            return
        numpy = import_module("numpy")
        w, x, y, z = (topic.array(f"{field}[{number}]") for number in range(4))
        roll = numpy.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = numpy.arcsin(numpy.clip(2 * (w * y - z * x), -1, 1))
        yaw = numpy.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        angles = {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}
        _extend(series, topic.times, **{name: numpy.degrees(angle) for name, angle in angles.items()})

    def _read_targets(self) -> None:
        flight = self._flight
        self._add_angles(flight.attitude_target, self._topic("vehicle_attitude_setpoint"), "q_d")
        setpoint = self._topic("vehicle_local_position_setpoint")
        if setpoint is None:
            return
        _extend(
            flight.velocity_target,
            setpoint.times,
            north_m_s=setpoint.array("vx"),
            east_m_s=setpoint.array("vy"),
            down_m_s=setpoint.array("vz"),
        )
        # PX4 logs positions in metres from the local origin.
        origin = self._origin(self._topic("vehicle_local_position"))
        if origin is None:
            return
        latitude, longitude, amsl = origin
        plane = TangentPlane(latitude, longitude)
        _extend(
            flight.position_target,
            setpoint.times,
            latitude_deg=latitude + setpoint.array("x") / plane.north_m_per_deg,
            longitude_deg=longitude + setpoint.array("y") / plane.east_m_per_deg,
            altitude_amsl_m=amsl - setpoint.array("z"),
        )

    def _origin(self, local: _Topic | None) -> tuple[float, float, float] | None:
        # PX4 may move the origin on the ground, before the flight, so the last one is returned.
        origin = None
        if local is not None:
            for _, latitude, longitude, altitude in local.rows("ref_lat", "ref_lon", "ref_alt"):
                if latitude and not math.isnan(latitude):
                    origin = latitude, longitude, altitude
        return origin

    def _read_equipment(self) -> None:
        flight = self._flight
        for number, battery in self._topics("battery_status"):
            remaining = battery.array("remaining") * 100
            remaining[remaining < 0] = NAN
            current = battery.array("current_a")
            current[current < 0] = NAN  # -1 means unknown
            voltage, used = battery.array("voltage_v"), battery.array("discharged_mah")
            voltage[voltage <= 0] = NAN  # 0 means unknown
            used[used < 0] = NAN
            _extend(
                flight.battery(number),
                battery.times,
                voltage_v=voltage,
                current_a=current,
                used_mah=used,
                remaining_percent=remaining,
            )
        for number, gps in self._topics("vehicle_gps_position", "sensor_gps"):
            _extend(
                flight.receiver(number),
                gps.times,
                fix_type=gps.array("fix_type"),
                satellites=gps.array("satellites_used"),
                hdop=gps.array("hdop"),
                accuracy_m=gps.array("eph"),
            )
        status = self._topic("estimator_status")
        if status is not None:
            _extend(
                flight.estimator,
                status.times,
                velocity=status.array("vel_test_ratio"),
                horizontal_position=status.array("pos_test_ratio"),
                vertical_position=status.array("hgt_test_ratio"),
                compass=status.array("mag_test_ratio", "hdg_test_ratio"),
                height_or_airspeed=status.array("tas_test_ratio"),
            )
        imu = self._topic("vehicle_imu_status")
        if imu is not None:
            clips = sum(imu.array(f"accel_clipping[{axis}]") for axis in range(3))
            _extend(flight.vibration, imu.times, x_m_s2=imu.array("accel_vibration_metric"), clips=clips)
        self._read_links()

    def _read_links(self) -> None:
        # PX4 may have several links. The data of the link that received the most messages is used.
        links = [topic for _, topic in self._topics("telemetry_status") if "rx_message_lost_rate" in topic]
        if links:
            busiest = max(links, key=lambda topic: float(topic.array("rx_message_count")[-1]))
            lost = busiest.array("rx_message_lost_rate") * 100
            _extend(self._flight.link, busiest.times, lost_percent=lost)
        radio = self._topic("radio_status")
        if radio is not None:
            _extend(
                self._flight.radio,
                radio.times,
                rssi=radio.array("rssi"),
                remote_rssi=radio.array("remote_rssi"),
                noise=radio.array("noise"),
                remote_noise=radio.array("remote_noise"),
            )


def _drop_damaged_rows(topics: list[Any]) -> int:
    """Drop rows with an impossible time, and topics that are then empty. Return the number of these rows."""
    numpy = import_module("numpy")
    all_times = [topic.data["timestamp"].astype("int64") for topic in topics]
    # The last row of a topic may itself be damaged.
    last_us = max((int(times[-2]) for times in all_times if len(times) > 1), default=_MAX_TIME_US)
    damaged = 0
    for topic, times in zip(topics, all_times, strict=True):
        previous_us, next_us = numpy.append(times[:1], times[:-1]), numpy.append(times[1:], times[-1:])
        # Rows have no checksum. A time is impossible if it is far outside the neighbours' times, or far after the end
        # of the log.
        is_outlier = (times > next_us + _MAX_DISORDER_US) | (times < previous_us - _MAX_DISORDER_US)
        neighbours_agree = previous_us <= next_us + _MAX_DISORDER_US  # otherwise one of them may be the outlier
        is_damaged = (is_outlier & neighbours_agree) | (times > last_us + _MAX_LATE_US)
        if is_damaged.any():
            damaged += int(is_damaged.sum())
            topic.data = {name: values[~is_damaged] for name, values in topic.data.items()}
    topics[:] = [topic for topic in topics if len(topic.data["timestamp"])]
    return damaged


def _extend(series: TimeSeries, times: Sequence[float], **values: Any) -> None:
    series.extend(times, **{name: array("d", value.astype("float64").tobytes()) for name, value in values.items()})


def _version(log: Any) -> str:
    release = log.msg_info_dict.get("ver_sw_release")
    if not isinstance(release, int) or not release:
        return Px4.name
    # The bytes are major, minor, patch and type.
    return f"{Px4.name} {release >> 24 & 0xFF}.{release >> 16 & 0xFF}.{release >> 8 & 0xFF}"


def utc_at_boot(log: Any) -> float:
    """Return the Unix time at which PX4 booted; 0 if the log has no GNSS time."""
    for data in log.data_list:
        is_gps = data.name in ("vehicle_gps_position", "sensor_gps")
        if is_gps and {"time_utc_usec", "timestamp"} <= data.data.keys():
            utc_us, boot_us = data.data["time_utc_usec"], data.data["timestamp"]
            (rows_with_utc,) = utc_us.nonzero()
            if len(rows_with_utc):
                row = rows_with_utc[0]
                return (int(utc_us[row]) - int(boot_us[row])) / 1e6
    return 0.0
