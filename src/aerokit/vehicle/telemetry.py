"""What a vehicle tells, message by message, kept in state cells."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from aerokit.autopilots import DEFAULT_RATES_HZ, Autopilot, autopilot_for, is_armed
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavLandedState, MavProtocolCapability, MavState, MavVtolState
from aerokit.runtime.cells import Source, StateCell
from aerokit.runtime.diagnosis import is_autopilot
from aerokit.vehicle import decoding
from aerokit.vehicle.feeds import FEEDS, MESSAGE_IDS, message_type
from aerokit.vehicle.status_text import StatusTextAssembler
from aerokit.vehicle.streamed import STREAMED, StreamedMessage
from aerokit.vehicle.values import (
    Attitude,
    AutopilotVersion,
    Battery,
    EstimatorHealth,
    GpsReceiver,
    Home,
    LocalPosition,
    MissionProgress,
    Mode,
    Position,
    RangeFinder,
    RcChannels,
    SensorHealth,
    ServoOutputs,
    StatusText,
    SystemTime,
    Velocity,
    Vibration,
    Wind,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

__all__ = ["Telemetry"]

BETTER_SOURCE_S = 2.0
"""For so long the second-best source of a value keeps quiet after the best one."""
OUTPUTS_PER_PORT = 16
SAME_ALTITUDE_MM = 100

Handler = Callable[[Any, Source], None]


MOST_MODE_NAMES = 256


class Telemetry:
    """All state cells of one vehicle, and what each message does to them.

    Only messages of system ``system_id``, component ``component_id`` (the autopilot) change anything; messages that
    the program built itself are let through. ``handles`` has the entry point for each message id, ``streams`` those
    that frames of streamed messages are given to. ``clock`` gives seconds; without ``autopilot`` the first HEARTBEAT
    says which it is.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        *,
        system_id: int = 1,
        component_id: int = 1,
        autopilot: Autopilot | None = None,
    ) -> None:
        self.system_id, self.component_id = system_id, component_id
        self.autopilot = autopilot or Autopilot(0)
        self._knows_autopilot = autopilot is not None
        self._clock = clock
        self._lock = threading.RLock()  # any thread may look, and what is looked at is worked out then
        self._arrived_at: float | None = None
        self._texts = StatusTextAssembler()
        self._base_mode = 0
        self._mode_names: dict[int, str] = {}
        self._cells: dict[str, StateCell[Any]] = {}
        self._make_cells()
        self._handlers = {messages.Heartbeat.ID: self._entry("Heartbeat", self._on_heartbeat)}
        table = self._table()
        self._handlers.update(
            {MESSAGE_IDS[name]: self._entry(name, handler) for name, handler in table.items()}
        )
        self._streams = {MESSAGE_IDS[name]: self._streamed(name, table[name]) for name in STREAMED}
        for cell in self._cells.values():
            cell._feed_from(
                *(self._streams[MESSAGE_IDS[name]] for name in STREAMED if cell.name in STREAMED[name])
            )

    def _make_cells(self) -> None:
        """Names are those on ``Vehicle``; each cell's documentation is its value's."""
        cell = self._cell
        estimator, wind = self.autopilot.estimator_message, self.autopilot.wind_message
        self.mode: StateCell[Mode] = cell("mode", "HEARTBEAT")
        self.armed: StateCell[bool] = cell("armed", "HEARTBEAT")
        self.system_status: StateCell[int] = cell("system_status", "HEARTBEAT")
        self.landed_state: StateCell[int] = cell("landed_state", "EXTENDED_SYS_STATE")
        self.vtol_state: StateCell[int] = cell("vtol_state", "EXTENDED_SYS_STATE")
        self.attitude: StateCell[Attitude] = cell("attitude", "ATTITUDE")
        self.position: StateCell[Position] = cell("position", "GLOBAL_POSITION_INT with a fix")
        self.local_position: StateCell[LocalPosition] = cell("local_position", "LOCAL_POSITION_NED")
        self.velocity: StateCell[Velocity] = cell("velocity", "GLOBAL_POSITION_INT with a fix")
        self.heading_deg: StateCell[float] = cell("heading_deg", "GLOBAL_POSITION_INT or VFR_HUD")
        self.ground_speed_m_s: StateCell[float] = cell("ground_speed_m_s", "VFR_HUD")
        self.air_speed_m_s: StateCell[float] = cell("air_speed_m_s", "VFR_HUD with an air speed")
        self.climb_m_s: StateCell[float] = cell("climb_m_s", "VFR_HUD")
        self.throttle_percent: StateCell[float] = cell("throttle_percent", "VFR_HUD")
        self.gps: StateCell[tuple[GpsReceiver, ...]] = cell("gps", "GPS_RAW_INT")
        self.batteries: StateCell[tuple[Battery, ...]] = cell("batteries", "BATTERY_STATUS or SYS_STATUS")
        self.estimator: StateCell[EstimatorHealth] = cell("estimator", estimator)
        self.sensors: StateCell[SensorHealth] = cell("sensors", "SYS_STATUS")
        self.home: StateCell[Home] = cell("home", "HOME_POSITION")
        self.origin: StateCell[Position] = cell("origin", "GPS_GLOBAL_ORIGIN")
        self.rc_channels: StateCell[RcChannels] = cell("rc_channels", "RC_CHANNELS")
        self.servo_outputs: StateCell[ServoOutputs] = cell("servo_outputs", "SERVO_OUTPUT_RAW")
        self.wind: StateCell[Wind] = cell("wind", wind)
        self.range_finders: StateCell[tuple[RangeFinder, ...]] = cell("range_finders", "DISTANCE_SENSOR")
        self.vibration: StateCell[Vibration] = cell("vibration", "VIBRATION")
        self.system_time: StateCell[SystemTime] = cell("system_time", "SYSTEM_TIME")
        self.version: StateCell[AutopilotVersion] = cell("version", "AUTOPILOT_VERSION")
        self.capabilities: StateCell[int] = cell("capabilities", "AUTOPILOT_VERSION")
        self.mission_current: StateCell[MissionProgress] = cell("mission_current", "MISSION_CURRENT")
        self.mission_reached: StateCell[int] = cell("mission_reached", "MISSION_ITEM_REACHED")
        self.status_text: StateCell[StatusText] = cell("status_text", "STATUSTEXT")

    def _table(self) -> Mapping[str, Handler]:
        """Message class → what it does."""
        return {
            "SysStatus": self._on_sys_status,
            "SystemTime": self._simply(self.system_time, decoding.system_time),
            "GpsRawInt": lambda message, source: self._on_gps(message, source, 0),
            "Gps2Raw": lambda message, source: self._on_gps(message, source, 1),
            "Attitude": self._simply(self.attitude, decoding.attitude),
            "AttitudeQuaternion": self._simply(self.attitude, decoding.attitude_of_quaternion),
            "LocalPositionNed": self._on_local_position,
            "GlobalPositionInt": self._on_global_position,
            "RcChannels": self._simply(self.rc_channels, decoding.rc_channels),
            "ServoOutputRaw": self._on_servo_outputs,
            "MissionCurrent": self._simply(self.mission_current, decoding.mission_progress),
            "MissionItemReached": self._simply(self.mission_reached, lambda message: message.seq),
            "GpsGlobalOrigin": self._simply(self.origin, decoding.origin),
            "VfrHud": self._on_vfr_hud,
            "DistanceSensor": self._on_distance_sensor,
            "BatteryStatus": self._on_battery_status,
            "AutopilotVersion": self._on_version,
            "Wind": self._simply(self.wind, decoding.wind),
            "Rangefinder": self._on_range_finder,
            "EkfStatusReport": self._on_ekf_status,
            "EstimatorStatus": self._on_estimator_status,
            "WindCov": self._simply(self.wind, decoding.wind_of_covariance),
            "Vibration": self._simply(self.vibration, decoding.vibration),
            "HomePosition": self._simply(self.home, decoding.home),
            "ExtendedSysState": self._on_extended_state,
            "Statustext": self._on_status_text,
            "AvailableModes": self._on_available_modes,
            "CurrentMode": self._on_current_mode,
        }

    # ------------------------------------------------------------------------------- feeding

    @property
    def handles(self) -> Mapping[int, Callable[[Any], None]]:
        """Message id → what takes a message of this kind."""
        return self._handlers

    @property
    def streams(self) -> Mapping[int, StreamedMessage]:
        """Message id → what takes frames of this kind: they are worked out when somebody looks at their cells."""
        return self._streams

    def accepts(self, frame: Frame) -> bool:
        """Whether this is the vehicle's own autopilot talking."""
        return frame.system_id == self.system_id and frame.component_id == self.component_id

    def receive(self, message: Message) -> None:
        """Take any message; those that say nothing about the state are passed over."""
        handler = self._handlers.get(message.ID)
        if handler is not None:
            handler(message)

    def expire(self, now: float) -> None:
        """Tell status texts whose ends have not come; call it about once a second."""
        self._tell(self._texts.expire(now), self._source("Statustext"))

    def forget(self) -> None:
        """Make everything unknown again, as after a reboot; texts are remembered."""
        for stream in self._streams.values():
            stream.forget()
        for cell in self._cells.values():
            cell.forget()

    def close(self, error: BaseException) -> None:
        """Nothing will come any more: whoever waits gets ``error``."""
        for cell in self._cells.values():
            cell.close(error)

    # ------------------------------------------------------------------------------- reading

    @property
    def cells(self) -> Mapping[str, StateCell[Any]]:
        """Name → cell."""
        return self._cells

    @property
    def mode_names(self) -> Mapping[int, str]:
        """custom_mode → name of the modes that the vehicle told by AVAILABLE_MODES and no table knows."""
        return self._mode_names

    @property
    def default_rates(self) -> Mapping[type[Message], float]:
        """Message class → Hz, for a program that asks for nothing special."""
        known = {message_type(name): hz for name, hz in DEFAULT_RATES_HZ.items()}
        return {message: hz for message, hz in known.items() if self.autopilot.sends(message)}

    def required_messages(self, name: str) -> tuple[type[Message], ...]:
        """The messages to ask for when a program wants the cell of this name."""
        types = (message_type(feed) for feed in FEEDS[name])
        return tuple(message for message in types if self.autopilot.sends(message))

    def texts_since(self, at: float) -> tuple[StatusText, ...]:
        """What the vehicle said since then (64 texts at most), oldest first."""
        return self._texts.recent(at)

    # -------------------------------------------------------------------------- the machinery

    def _cell(self, name: str, waits_for: str) -> StateCell[Any]:
        cell = self._cells[name] = StateCell(name, self._clock, waits_for, stamp=self._time_of_arrival)
        return cell

    def _time_of_arrival(self) -> float:
        """Of the message that is being worked out."""
        return self._clock() if self._arrived_at is None else self._arrived_at

    def _source(self, class_name: str) -> Source:
        return Source(self.system_id, self.component_id, message_type(class_name).NAME)

    def _entry(self, class_name: str, handler: Handler) -> Callable[[Any], None]:
        source = self._source(class_name)
        system_id, component_id = self.system_id, self.component_id

        def take(message: Message) -> None:
            frame = message.received_frame
            if frame is None or (frame.system_id == system_id and frame.component_id == component_id):
                with self._lock:
                    handler(message, source)

        return take

    def _streamed(self, class_name: str, handler: Handler) -> StreamedMessage:
        source, decode = self._source(class_name), message_type(class_name).decode_body

        def apply(frame: Frame) -> None:
            before, self._arrived_at = self._arrived_at, frame.received_at
            try:
                handler(decode(frame.body, frame), source)
            finally:
                self._arrived_at = before

        cells = [self._cells[name] for name in STREAMED[class_name]]
        return StreamedMessage(class_name, self.component_id, cells, apply, self._lock)

    @staticmethod
    def _simply(cell: StateCell[Any], decode: Callable[[Any], Any]) -> Handler:
        """A message that says one thing; None when it does not know it."""

        def handler(message: Any, source: Source) -> None:
            value = decode(message)
            if value is not None:
                cell.set(value, source)

        return handler

    def _has_better(self, cell: StateCell[Any], source: Source) -> bool:
        """Whether another message has told this value lately; that one is the better source."""
        return (
            cell.source is not None
            and cell.source.message != source.message
            and self._time_of_arrival() - cell.updated_at < BETTER_SOURCE_S
        )

    # ------------------------------------------------------------------------- mode and state

    def _on_heartbeat(self, message: messages.Heartbeat, source: Source) -> None:
        if not is_autopilot(message):  # a ground station or a companion that took the autopilot's ids
            return
        if not self._knows_autopilot:
            self._learn_autopilot(message)
        self._base_mode = message.base_mode
        self.mode.set(self.autopilot.mode_of(message, self._mode_names), source)
        self.armed.set(is_armed(message.base_mode), source)
        self.system_status.set(decoding.member(MavState, message.system_status), source)
        landed_state = self.autopilot.landed_state_of(message)
        if landed_state is not None and not self._has_better(self.landed_state, source):
            self.landed_state.set(MavLandedState(landed_state), source)

    def _learn_autopilot(self, heartbeat: messages.Heartbeat) -> None:
        self.autopilot, self._knows_autopilot = autopilot_for(heartbeat), True
        self.estimator.waits_for = self.autopilot.estimator_message
        self.wind.waits_for = self.autopilot.wind_message

    def _on_current_mode(self, message: messages.CurrentMode, source: Source) -> None:
        if message.custom_mode and self.mode.is_known:
            mode = self.autopilot.mode(message.custom_mode, self._base_mode, self._mode_names)
            self.mode.set(mode, source)

    def _on_available_modes(self, message: messages.AvailableModes, source: Source) -> None:
        name = self.autopilot.learn_mode_name(message.custom_mode, message.mode_name)
        if name is not None and (
            message.custom_mode in self._mode_names or len(self._mode_names) < MOST_MODE_NAMES
        ):
            self._mode_names[message.custom_mode] = name

    def _on_extended_state(self, message: messages.ExtendedSysState, source: Source) -> None:
        self.vtol_state.set(decoding.member(MavVtolState, message.vtol_state), source)
        if message.landed_state != MavLandedState.UNDEFINED:
            self.landed_state.set(decoding.member(MavLandedState, message.landed_state), source)

    def _on_version(self, message: messages.AutopilotVersion, source: Source) -> None:
        self.version.set(self.autopilot.version_of(message), source)
        self.capabilities.set(MavProtocolCapability(message.capabilities), source)

    # --------------------------------------------------------------------------- movement

    def _on_global_position(self, message: messages.GlobalPositionInt, source: Source) -> None:
        heading = decoding.heading_deg(message)
        if heading is not None:
            self.heading_deg.set(heading, source)
        position = decoding.position(message, relative_is_known=self._relative_is_known(message))
        if position is not None:
            self.position.set(position, source)
            self.velocity.set(decoding.global_velocity(message), source)

    def _relative_is_known(self, message: messages.GlobalPositionInt) -> bool:
        """Until home is set, ``relative_alt`` is no more than the altitude above the sea once again."""
        return self.home.is_known or abs(message.relative_alt - message.alt) > SAME_ALTITUDE_MM

    def _on_local_position(self, message: messages.LocalPositionNed, source: Source) -> None:
        self.local_position.set(decoding.local_position(message), source)
        if not self._has_better(self.velocity, source):
            self.velocity.set(Velocity(message.vx, message.vy, message.vz), source)

    def _on_vfr_hud(self, message: messages.VfrHud, source: Source) -> None:
        self.ground_speed_m_s.set(message.groundspeed, source)
        self.climb_m_s.set(message.climb, source)
        self.throttle_percent.set(float(message.throttle), source)
        if math.isfinite(message.airspeed):
            self.air_speed_m_s.set(message.airspeed, source)
        if not self._has_better(self.heading_deg, source):
            self.heading_deg.set(float(message.heading % 360), source)

    # -------------------------------------------------------------------- several of a kind

    def _on_gps(self, message: messages.GpsRawInt | messages.Gps2Raw, source: Source, index: int) -> None:
        receivers = _with(self.gps.latest, decoding.gps_receiver(message, index), _index_of)
        self.gps.set(receivers, source)

    def _on_battery_status(self, message: messages.BatteryStatus, source: Source) -> None:
        self.batteries.set(
            _with(self.batteries.latest, decoding.battery(message, self.autopilot), _id_of), source
        )

    def _on_sys_status(self, message: messages.SysStatus, source: Source) -> None:
        self.sensors.set(decoding.sensor_health(message, self.autopilot), source)
        battery = decoding.main_battery(message, self.autopilot)
        if battery is not None and not self._has_better(self.batteries, source):
            self.batteries.set(_with(self.batteries.latest, battery, _id_of), source)

    def _on_distance_sensor(self, message: messages.DistanceSensor, source: Source) -> None:
        sensors = _with(self.range_finders.latest, decoding.distance_sensor(message), _id_of)
        self.range_finders.set(sensors, source)

    def _on_range_finder(self, message: messages.Rangefinder, source: Source) -> None:
        if not self._has_better(self.range_finders, source):
            sensors = _with(self.range_finders.latest, decoding.range_finder(message), _id_of)
            self.range_finders.set(sensors, source)

    def _on_servo_outputs(self, message: messages.ServoOutputRaw, source: Source) -> None:
        before = self.servo_outputs.latest.outputs_us if self.servo_outputs.latest is not None else ()
        begin = message.port * OUTPUTS_PER_PORT
        head = (*before[:begin], *(0,) * (begin - len(before)))
        outputs = decoding.servo_outputs(message)
        self.servo_outputs.set(ServoOutputs((*head, *outputs, *before[begin + len(outputs) :])), source)

    # -------------------------------------------------------------------- health and texts

    def _on_ekf_status(self, message: messages.EkfStatusReport, source: Source) -> None:
        self.estimator.set(decoding.ekf_health(message, self.autopilot), source)

    def _on_estimator_status(self, message: messages.EstimatorStatus, source: Source) -> None:
        self.estimator.set(decoding.estimator_health(message, self.autopilot), source)

    def _on_status_text(self, message: messages.Statustext, source: Source) -> None:
        self._tell(self._texts.receive(message, self._clock()), source)

    def _tell(self, texts: Iterable[StatusText], source: Source) -> None:
        for text in texts:
            self.status_text.set(text, source)


def _with(items: tuple[Any, ...] | None, item: Any, key: Callable[[Any], int]) -> tuple[Any, ...]:
    """The items in the order of their numbers, with this one in the place of the former of its number."""
    number = key(item)
    return tuple(sorted((item, *(each for each in items or () if key(each) != number)), key=key))


def _id_of(item: Battery | RangeFinder) -> int:
    return item.id


def _index_of(receiver: GpsReceiver) -> int:
    return receiver.index
