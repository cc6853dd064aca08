"""Reads a `FlightLog` from a ``.tlog``. Only the messages that a flight needs are checked and decoded."""

from __future__ import annotations

import math
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from aerokit.autopilots import Autopilot, autopilot_for, is_armed
from aerokit.connection.heartbeats import is_autopilot
from aerokit.errors import FileFormatError
from aerokit.logs.flights.codes import clean_text
from aerokit.logs.flights.flight import FailsafeEvidence, LoggedText, TimeSeries
from aerokit.logs.flights.recording import MIN_SILENCE_S, ClockComparison, LinkCounter, is_real_time, use_simulated_time
from aerokit.logs.flights.tlog_missions import RecordedMission
from aerokit.logs.flights.tlog_modes import RecordedModeCommands
from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavBatteryChargeState, MavFrame, MavState, MavType
from aerokit.mavlink.frame import MAGIC_V2, Frame, x25
from aerokit.mavlink.tlog import read_tlog
from aerokit.missions.item import canonical_frame
from aerokit.parameters.encoding import value_of
from aerokit.vehicle.state.equipment import cell_voltages_mv, current
from aerokit.vehicle.state.movement import Attitude
from aerokit.vehicle.state.status_text import StatusTextAssembler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.logs.flights.flight import FlightLog
    from aerokit.mavlink.message import Message

NAN = math.nan
_U16, _E7, _METRES_PER_DEGREE = 0xFFFF, 1e7, 111_319.5
# A position within this distance of 0° N 0° E is not real: the estimator has no position yet.
_NULL_ISLAND_E7 = 100_000
_HEARTBEAT_ID = b"\0\0\0"
# Bits of a set-point's type mask. If they are set, the position, velocity or attitude is ignored.
_NO_POSITION, _NO_VELOCITY, _NO_ATTITUDE = 0x7, 0x38, 0x80
# If a record is earlier than the previous one by more than this, the recording's clock was set back.
_MAX_DISORDER_S = 1.0
# A record is skipped as damaged if its time differs from the previous record's by more than this. If the next record
# has about the same time as the skipped one, the clock has jumped, and reading continues with the new time.
_DOUBTFUL_JUMP_S = 3600.0
# If no HEARTBEAT arrives for longer than this, the arming state is unknown.
_MAX_HEARTBEAT_INTERVAL_S = 5.0
# A local set-point is converted to a global one only with a position that is at most this old.
_POSITION_MAX_AGE_S = 2.0
_ALARM_STATES = {MavState.CRITICAL: "critical", MavState.EMERGENCY: "emergency"}


def read_tlog_flight(flight: FlightLog, system_id: int | None, on_bytes: Callable[[int], object]) -> None:
    """Fill a flight from its file, with the data of ``system_id`` or, if that is None, of the first autopilot.

    Raises:
        FileFormatError: the log has no heartbeat of an autopilot with this system id.
    """
    heartbeat, frame = _first_autopilot(flight, system_id)
    flight.system_id = frame.system_id
    _Reader(flight, frame.component_id, heartbeat).read(on_bytes)


def _first_autopilot(flight: FlightLog, system_id: int | None) -> tuple[m.Heartbeat, Frame]:
    """Return the first valid heartbeat of an autopilot, and its frame. A ``system_id`` of None means any."""
    records = 0
    for _, raw in read_tlog(flight.path):
        records += 1
        # The header of MAVLink 2 ends with three bytes for the message id, the one of MAVLink 1 with a single byte.
        message_id = raw[7:10] if raw[0] == MAGIC_V2 else raw[5:6] + b"\0\0"
        if message_id == _HEARTBEAT_ID and _is_valid(raw):
            frame = Frame.parse(raw)
            message = m.Heartbeat.decode_body(frame.body, frame)
            if is_autopilot(message) and system_id in (None, frame.system_id):
                return message, frame
    missing = "no MAVLink messages" if not records else "no heartbeat of an autopilot"
    restriction = "" if system_id is None else f" with system id {system_id}"
    raise FileFormatError(f"{flight.path} contains {missing}{restriction}, so there is no flight")


def _is_valid(raw: bytes) -> bool:
    try:
        frame = Frame.parse(raw)
        return x25(frame.body + STANDARD.extras[frame.message_id]) == frame.checksum
    except (KeyError, IndexError, ValueError):
        return False


class _Reader:
    """Fills a flight with the messages of one vehicle."""

    def __init__(self, flight: FlightLog, component_id: int, heartbeat: m.Heartbeat) -> None:
        self._flight = flight
        self._source = bytes((flight.system_id, component_id))
        self._autopilot: Autopilot = autopilot_for(heartbeat)
        flight.autopilot, flight.vehicle = self._autopilot.name, self._autopilot.firmware
        self._texts = StatusTextAssembler()
        self._other_vehicles: set[int] = set()
        self._capabilities: int | None = None
        self._mode_commands = RecordedModeCommands(flight, self._autopilot)
        self._system_status = 0
        self._last_heartbeat_s, self._was_armed = 0.0, False
        self._armed_gaps: list[tuple[float, float]] = []  # times without HEARTBEAT while armed
        self._has_battery_status = False
        self._charge_states: dict[int, int] = {}  # MAV_BATTERY_CHARGE_STATE by battery
        self._position = (NAN, NAN, NAN)  # latitude, longitude and altitude above sea level
        self._local_position = (NAN, NAN, NAN)  # metres north, east and down of the estimator's origin
        self._position_at = self._local_position_at = -math.inf
        self._relative_m = NAN
        self._clocks = ClockComparison()
        self._is_breached = False
        self._destinations = TimeSeries(*flight.position_target.names)
        self._link = LinkCounter(flight)
        self._mission = RecordedMission(flight.system_id)
        self._damaged = 0  # number of skipped records
        self._doubtful_unix_s = math.inf  # time of the last record that was skipped because of _DOUBTFUL_JUMP_S
        # Commands that the vehicle itself has sent are ignored, because they are for its own components. For
        # example, PX4 informs its components when it has decided to return.
        commands: dict[type[Message], Callable[[float, Any], None]] = {
            m.CommandLong: self._mode_commands.on_command,
            m.CommandInt: self._mode_commands.on_command,
            m.SetMode: self._mode_commands.on_set_mode,
        }
        handlers: dict[type[Message], Callable[[float, Any], None]] = {
            **dict.fromkeys(RecordedMission.MESSAGES, self._mission.on_message),
            # Telemetry radios insert these with ids of their own.
            m.RadioStatus: self._on_radio,
            m.Radio: self._on_radio,
        }
        self._handlers_of_other_senders = {
            _message_id_bytes(kind): call for kind, call in {**commands, **handlers}.items()
        }
        handlers.update(self._vehicle_handlers())
        self._handlers_of_vehicle = {_message_id_bytes(kind): handler for kind, handler in handlers.items()}

    def read(self, on_bytes: Callable[[int], object]) -> None:
        # This loop is optimised, because a log has millions of messages. Most of them are not decoded: only the fields
        # of the header are read.
        flight, source, link = self._flight, self._source, self._link
        handlers_of_vehicle, handlers_of_other_senders = self._handlers_of_vehicle, self._handlers_of_other_senders
        records = 0
        begins_at, ends_at = 0.0, 0.0
        new_frames = 0  # the vehicle's frames since the last call of link.count()
        next_second_unix_s, expected_sequence = 0.0, -1
        last_frame_at = math.nan  # time of the record with the vehicle's last frame
        previous_unix_s = math.nan
        paused_s = 0.0  # seconds without any record since the vehicle's last frame
        set_back_s = 0.0  # sum of the jumps by which the recording's clock was set back
        with flight.path.open("rb") as file:
            for recorded_unix_s, raw in read_tlog(file):
                unix_s = recorded_unix_s + set_back_s
                if not records:
                    begins_at = previous_unix_s = unix_s
                elif not -_MAX_DISORDER_S <= unix_s - previous_unix_s < MIN_SILENCE_S:
                    step_s = unix_s - previous_unix_s
                    if abs(step_s) > _DOUBTFUL_JUMP_S and not self._accept_jump(unix_s):
                        continue
                    if step_s > 0:
                        paused_s += step_s
                    else:
                        self._note_clock_jump(-step_s, previous_unix_s - begins_at)
                        set_back_s -= step_s
                        unix_s = previous_unix_s
                previous_unix_s = unix_s
                records += 1
                if records % 16_384 == 0:
                    on_bytes(file.tell())
                if unix_s > ends_at:
                    ends_at = unix_s
                # Offsets: https://mavlink.io/en/guide/serialization.html. The sender is its system and component id.
                if raw[0] == MAGIC_V2:
                    message_id, sender, sequence = raw[7:10], raw[5:7], raw[4]
                else:
                    message_id, sender, sequence = raw[5:6] + b"\0\0", raw[3:5], raw[2]
                if sender == source:
                    new_frames += 1
                    # To save calls, frames are counted together until a frame is missing or a second ends.
                    if sequence != expected_sequence or unix_s >= next_second_unix_s:
                        if unix_s - last_frame_at >= MIN_SILENCE_S:
                            link.add_silence(last_frame_at - begins_at, unix_s - begins_at, paused_s)
                        next_second_s = link.count(unix_s - begins_at, sequence, expected_sequence, new_frames)
                        next_second_unix_s, new_frames = begins_at + next_second_s, 0
                    last_frame_at, paused_s = unix_s, 0.0
                    expected_sequence = (sequence + 1) & 0xFF
                    if message_id not in handlers_of_vehicle:
                        continue
                    handle = handlers_of_vehicle[message_id]
                elif message_id in handlers_of_other_senders:
                    handle = handlers_of_other_senders[message_id]
                else:
                    if message_id == _HEARTBEAT_ID:
                        self._record_other_heartbeat(unix_s - begins_at, sender[0], raw)
                    continue
                message = _decode_frame(raw, unix_s)
                if message is None:
                    self._damaged += 1
                else:
                    handle(unix_s - begins_at, message)
            on_bytes(file.tell())
        flight.begins_at, flight.ends_at = begins_at, ends_at
        link.end(new_frames, last_frame_at - begins_at, flight.duration_s, paused_s)
        self._finish()

    def _accept_jump(self, unix_s: float) -> bool:
        """Return True if the clock has jumped to this time: the last skipped record has about the same time.

        Otherwise, count the record with this time as damaged.
        """
        if abs(unix_s - self._doubtful_unix_s) <= _DOUBTFUL_JUMP_S:
            self._damaged -= 1  # The skipped record was not damaged.
            return True
        self._doubtful_unix_s = unix_s
        self._damaged += 1
        return False

    def _note_clock_jump(self, set_back_s: float, time_s: float) -> None:
        self._flight.notes.append(
            f"the recording's clock was set back by {set_back_s:.0f} s, {time_s:.0f} s after the log began: the times"
            " in this report continue without this jump"
        )

    def _finish(self) -> None:
        flight = self._flight
        self._add_texts(flight.duration_s, self._texts.expire(math.inf))
        self._note_missing_heartbeats()
        self._add_destinations()
        flight.mission = self._mission.waypoints
        if self._damaged:
            flight.notes.append(f"{self._damaged} messages are damaged and were skipped")
        if self._other_vehicles:
            others = ", ".join(map(str, sorted(self._other_vehicles)))
            flight.notes.append(
                f"this is system {flight.system_id}; the log contains other vehicles too: system {others}"
            )
        if not self._mode_commands.has_commands:
            flight.notes.append(
                "the log contains no commands to the vehicle, so the causes of mode changes are unknown"
            )
        if self._clocks.missing_s >= 1.0 and is_real_time(self._clocks.speed):
            flight.notes.append(
                f"by the vehicle's clock, {self._clocks.missing_s:.0f} s are missing in this recording, as if its"
                " computer had slept: the durations in this report do not contain them"
            )
        self._mode_commands.attribute_modes(self._clocks.speed)
        use_simulated_time(flight, self._clocks.speed)

    def _add_destinations(self) -> None:
        setpoints, destinations = self._flight.position_target, self._destinations
        # POSITION_TARGET_GLOBAL_INT has the place to which the vehicle flies. It is used only if no other message has
        # logged the places of set-points.
        if setpoints.has_values("latitude_deg"):
            return
        # The rows of `setpoints` without places have heights from NAV_CONTROLLER_OUTPUT. If there are any, the heights
        # from POSITION_TARGET_GLOBAL_INT are not used.
        has_heights = setpoints.has_values()
        rows = list(_rows_of(setpoints))
        for time, latitude, longitude, amsl, relative in _rows_of(destinations):
            heights = (NAN, NAN) if has_heights else (amsl, relative)
            rows.append((time, latitude, longitude, *heights))
        merged = TimeSeries(*setpoints.names)
        for row in sorted(rows, key=itemgetter(0)):  # by time
            merged.add(*row)
        self._flight.position_target = merged

    def _vehicle_handlers(self) -> dict[type[Message], Callable[[float, Any], None]]:
        """Return the handlers of messages that count only if the vehicle itself sent them."""
        return {
            m.Heartbeat: self._on_heartbeat,
            m.GlobalPositionInt: self._on_global_position,
            m.LocalPositionNed: self._on_local_position,
            m.Attitude: self._on_attitude,
            m.VfrHud: self._on_vfr_hud,
            m.Statustext: self._on_status_text,
            m.SysStatus: self._on_sys_status,
            m.BatteryStatus: self._on_battery_status,
            m.GpsRawInt: lambda time_s, message: self._on_gps(time_s, message, number=0),
            m.Gps2Raw: lambda time_s, message: self._on_gps(time_s, message, number=1),
            m.Vibration: self._on_vibration,
            m.EkfStatusReport: self._on_ekf_status_report,
            m.EstimatorStatus: self._on_estimator_status,
            m.NavControllerOutput: self._on_nav_controller_output,
            m.AttitudeTarget: self._on_attitude_target,
            m.PositionTargetGlobalInt: self._on_global_target,
            m.PositionTargetLocalNed: self._on_local_target,
            m.ParamValue: self._on_parameter,
            m.AutopilotVersion: self._on_version,
            m.HomePosition: self._on_home,
            m.FenceStatus: self._on_fence,
            m.ServoOutputRaw: self._on_servo_output,
        }

    def _on_vfr_hud(self, time_s: float, message: m.VfrHud) -> None:
        self._flight.air.add(time_s, message.airspeed, message.throttle)

    def _on_vibration(self, time_s: float, message: m.Vibration) -> None:
        clips = message.clipping_0 + message.clipping_1 + message.clipping_2
        self._flight.vibration.add(time_s, message.vibration_x, message.vibration_y, message.vibration_z, clips)

    def _on_ekf_status_report(self, time_s: float, message: m.EkfStatusReport) -> None:
        self._flight.estimator.add(
            time_s,
            message.velocity_variance,
            message.pos_horiz_variance,
            message.pos_vert_variance,
            message.compass_variance,
            max(message.terrain_alt_variance, message.airspeed_variance),
        )

    def _on_estimator_status(self, time_s: float, message: m.EstimatorStatus) -> None:
        self._flight.estimator.add(
            time_s,
            message.vel_ratio,
            message.pos_horiz_ratio,
            message.pos_vert_ratio,
            message.mag_ratio,
            max(message.hagl_ratio, message.tas_ratio),
        )

    def _on_heartbeat(self, time_s: float, message: m.Heartbeat) -> None:
        flight = self._flight
        flight.add_mode(time_s, self._autopilot.mode_of(message).name)
        armed = is_armed(message.base_mode)
        flight.set_armed(time_s, armed)
        self._end_heartbeat_gap(time_s)
        self._was_armed = armed
        status = message.system_status
        if armed and status in _ALARM_STATES and status != self._system_status:
            name = _ALARM_STATES[MavState(status)]
            text = f"system status {name} (HEARTBEAT)"
            flight.failsafe_evidence.append(FailsafeEvidence(time_s, "general", text))
        self._system_status = status

    def _end_heartbeat_gap(self, time_s: float) -> None:
        if self._was_armed and time_s - self._last_heartbeat_s > _MAX_HEARTBEAT_INTERVAL_S:
            self._armed_gaps.append((self._last_heartbeat_s, time_s))
        self._last_heartbeat_s = time_s

    def _note_missing_heartbeats(self) -> None:
        self._end_heartbeat_gap(self._flight.duration_s)

        def silent_s(begin_s: float, end_s: float) -> float:
            silences = self._flight.silences
            overlaps = (min(end_s, silence.ends_s) - max(begin_s, silence.begins_s) for silence in silences)
            return sum(max(overlap_s, 0.0) for overlap_s in overlaps)

        # Silences, in which no message at all arrived, are left out: the report describes them separately.
        missing_s = sum(end - begin - silent_s(begin, end) for begin, end in self._armed_gaps)
        if missing_s > _MAX_HEARTBEAT_INTERVAL_S:
            self._flight.notes.append(
                f"for {missing_s:.0f} s, other messages arrived, but no HEARTBEAT: this time counts as armed, although"
                " it is unknown whether the vehicle was armed, and in which mode"
            )

    def _record_other_heartbeat(self, time_s: float, system_id: int, raw: bytes) -> None:
        # The type follows the header (10 bytes, or 6 in MAVLink 1) and custom_mode. It is empty in a frame that is too
        # short.
        vehicle_type = raw[14:15] if raw[0] == MAGIC_V2 else raw[10:11]
        if vehicle_type == bytes((MavType.GCS,)):
            self._flight.gcs_heartbeats.append(time_s)
            return
        if system_id != self._flight.system_id and system_id not in self._other_vehicles and _is_valid(raw):
            frame = Frame.parse(raw)
            if is_autopilot(m.Heartbeat.decode_body(frame.body, frame)):
                self._other_vehicles.add(system_id)

    def _on_status_text(self, time_s: float, message: m.Statustext) -> None:
        joins_id_0 = self._autopilot.has_status_text_id_0
        self._add_texts(time_s, self._texts.receive(message, time_s, joins_id_0=joins_id_0))

    def _add_texts(self, time_s: float, texts: list[Any]) -> None:
        self._flight.texts += [LoggedText(time_s, text.severity, clean_text(text.text)) for text in texts]

    def _on_parameter(self, time_s: float, message: m.ParamValue) -> None:
        bytewise = self._autopilot.encodes_parameters_bytewise(self._capabilities)
        if message.param_id and not message.param_id.startswith("_HASH"):  # PX4's _HASH_CHECK is not a parameter
            self._flight.set_parameter(time_s, message.param_id, float(value_of(message, bytewise)))

    def _on_version(self, time_s: float, message: m.AutopilotVersion) -> None:
        self._capabilities = message.capabilities
        number = message.flight_sw_version
        if number:  # The bytes are major, minor, patch and type.
            version = ".".join(str(number >> shift & 0xFF) for shift in (24, 16, 8))
            self._flight.vehicle = f"{self._autopilot.firmware} {version}"

    def _on_home(self, time_s: float, message: m.HomePosition) -> None:
        self._flight.set_home(time_s, message.latitude / _E7, message.longitude / _E7, message.altitude / 1e3)

    def _on_fence(self, time_s: float, message: m.FenceStatus) -> None:
        if message.breach_status and not self._is_breached:
            self._flight.failsafe_evidence.append(FailsafeEvidence(time_s, "fence", "outside the fence (FENCE_STATUS)"))
        self._is_breached = bool(message.breach_status)

    def _on_attitude(self, time_s: float, message: m.Attitude) -> None:
        self._clocks.compare(time_s, message.time_boot_ms)
        self._flight.attitude.add(
            time_s, math.degrees(message.roll), math.degrees(message.pitch), math.degrees(message.yaw)
        )

    def _on_global_position(self, time_s: float, message: m.GlobalPositionInt) -> None:
        self._clocks.compare(time_s, message.time_boot_ms)
        if abs(message.lat) < _NULL_ISLAND_E7 and abs(message.lon) < _NULL_ISLAND_E7:
            return
        if abs(message.lat) > 90 * _E7 or abs(message.lon) > 180 * _E7:
            return
        self._position = message.lat / _E7, message.lon / _E7, message.alt / 1e3
        self._relative_m = message.relative_alt / 1e3
        self._position_at = time_s
        self._flight.track.add(time_s, *self._position, self._relative_m)
        self._flight.velocity.add(time_s, message.vx / 100, message.vy / 100, message.vz / 100)

    def _on_local_position(self, time_s: float, message: m.LocalPositionNed) -> None:
        self._local_position = message.x, message.y, message.z
        self._local_position_at = time_s

    def _on_nav_controller_output(self, time_s: float, message: m.NavControllerOutput) -> None:
        if self._autopilot.name == "ArduPilot":
            # The yaw is NaN, because a fixed wing reports its course in `nav_bearing`, not a yaw.
            self._flight.attitude_target.add(time_s, message.nav_roll, message.nav_pitch, NAN)
            if -180 <= message.nav_bearing <= 360 and not math.isnan(self._relative_m):
                self._flight.position_target.add(time_s, NAN, NAN, NAN, self._relative_m + message.alt_error)

    def _on_attitude_target(self, time_s: float, message: m.AttitudeTarget) -> None:
        if not message.type_mask & _NO_ATTITUDE and all(math.isfinite(part) for part in message.q):
            w, x, y, z = message.q
            target = Attitude.from_quaternion(w, x, y, z, rates_deg_s=(None, None, None))
            self._flight.attitude_target.add(time_s, target.roll_deg, target.pitch_deg, target.yaw_deg)

    def _on_global_target(self, time_s: float, message: m.PositionTargetGlobalInt) -> None:
        if message.type_mask & _NO_POSITION != _NO_POSITION and (message.lat_int or message.lon_int):
            frame = canonical_frame(message.coordinate_frame)  # altitudes above terrain are not recorded
            self._destinations.add(
                time_s,
                message.lat_int / _E7,
                message.lon_int / _E7,
                message.alt if frame == MavFrame.GLOBAL else NAN,
                message.alt if frame == MavFrame.GLOBAL_RELATIVE_ALT else NAN,
            )
        self._add_velocity_target(time_s, message)

    def _on_local_target(self, time_s: float, message: m.PositionTargetLocalNed) -> None:
        if message.type_mask & _NO_POSITION != _NO_POSITION:
            # The set-point is converted with the vehicle's newest local and global positions.
            is_recent = time_s - min(self._position_at, self._local_position_at) <= _POSITION_MAX_AGE_S
            local_north, local_east, local_down = self._local_position if is_recent else (NAN, NAN, NAN)
            north, east, down = message.x - local_north, message.y - local_east, message.z - local_down
            latitude, longitude, amsl = self._position
            east_per_degree = _METRES_PER_DEGREE * math.cos(math.radians(latitude))
            self._flight.position_target.add(
                time_s,
                latitude + north / _METRES_PER_DEGREE,
                longitude + east / east_per_degree,
                amsl - down,
                self._relative_m - down,
            )
        self._add_velocity_target(time_s, message)

    def _add_velocity_target(
        self, time_s: float, message: m.PositionTargetLocalNed | m.PositionTargetGlobalInt
    ) -> None:
        if message.type_mask & _NO_VELOCITY != _NO_VELOCITY:
            self._flight.velocity_target.add(time_s, message.vx, message.vy, message.vz)

    def _on_sys_status(self, time_s: float, message: m.SysStatus) -> None:
        # BATTERY_STATUS takes precedence. A voltage of 0 or UINT16_MAX is unknown.
        if self._has_battery_status or message.voltage_battery in (0, _U16):
            return
        current_a = current(message.current_battery, self._autopilot)
        self._flight.battery(0).add(
            time_s,
            message.voltage_battery / 1e3,
            NAN if current_a is None else current_a,
            NAN,
            NAN if message.battery_remaining < 0 else message.battery_remaining,
        )

    def _on_battery_status(self, time_s: float, message: m.BatteryStatus) -> None:
        cells_mv = cell_voltages_mv(message)
        if message.id == 0 and cells_mv:
            self._has_battery_status = True
        state = message.charge_state
        is_low = MavBatteryChargeState.LOW <= state <= MavBatteryChargeState.EMERGENCY
        if is_low and state > self._charge_states.get(message.id, 0):
            text = f"charge state {MavBatteryChargeState(state).name.lower()} (BATTERY_STATUS)"
            self._flight.failsafe_evidence.append(FailsafeEvidence(time_s, "battery", text))
        self._charge_states[message.id] = state
        current_a = current(message.current_battery, self._autopilot)
        # PX4 without a current sensor sends a consumed charge of 0.
        is_charge_unknown = message.current_consumed < 0 or (message.current_consumed == 0 and current_a is None)
        self._flight.battery(message.id).add(
            time_s,
            sum(cells_mv) / 1e3 if cells_mv else NAN,
            NAN if current_a is None else current_a,
            NAN if is_charge_unknown else message.current_consumed,
            message.battery_remaining if message.battery_remaining >= 0 else NAN,
        )

    def _on_gps(self, time_s: float, message: m.GpsRawInt | m.Gps2Raw, number: int) -> None:
        self._flight.receiver(number).add(
            time_s,
            message.fix_type,
            # UINT8_MAX satellites and a dilution of UINT16_MAX are unknown.
            NAN if message.satellites_visible == 0xFF else message.satellites_visible,
            NAN if message.eph == _U16 else message.eph / 100,
            message.h_acc / 1e3 if message.h_acc else NAN,
        )

    def _on_servo_output(self, time_s: float, message: m.ServoOutputRaw) -> None:
        if message.port == 0:  # the main outputs
            pulses = (getattr(message, f"servo{number}_raw") for number in range(1, 9))
            self._flight.outputs.add(time_s, *(pulse or NAN for pulse in pulses))  # 0 means an unused output

    def _on_radio(self, time_s: float, message: m.RadioStatus | m.Radio) -> None:
        self._flight.radio.add(time_s, message.rssi, message.remrssi, message.noise, message.remnoise)


def _rows_of(series: TimeSeries) -> Iterator[tuple[float, ...]]:
    """Yield the time and the values of each row."""
    return zip(series.times, *(series[name] for name in series.names), strict=True)


def _message_id_bytes(kind: type[Message]) -> bytes:
    # The id has three bytes in the header of MAVLink 2.
    return kind.ID.to_bytes(3, "little")


def _decode_frame(raw: bytes, unix_s: float) -> Message | None:
    """Decode the frame of a record; None if its checksum is wrong."""
    frame = Frame.parse(raw, unix_s)
    if x25(frame.body + STANDARD.extras[frame.message_id]) != frame.checksum:
        return None
    return STANDARD.decode(frame)
