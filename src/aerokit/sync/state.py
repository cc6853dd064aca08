"""What a program without ``async`` reads of a vehicle."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

from aerokit.sync.cells import StateCell

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.runtime.cells import StateCell as AsyncStateCell
    from aerokit.runtime.events import LinkReport
    from aerokit.runtime.link_state import LinkState
    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.state.values import (
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
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["VehicleState"]

T = TypeVar("T")


class VehicleState:
    """The state of a vehicle, one cell for each thing; as those of :class:`aerokit.Vehicle`."""

    def __init__(self, loop: LoopThread, vehicle: AsyncVehicle) -> None:
        self._loop = loop
        self.aio = vehicle
        """The asynchronous vehicle, for code that runs on the loop."""

    # ---------------------------------------------------------------------------- who it is

    @property
    def system_id(self) -> int:
        """MAVLink system id, 1–255."""
        return self.aio.system_id

    @property
    def component_id(self) -> int:
        """Component id of its autopilot, usually 1."""
        return self.aio.component_id

    @property
    def vehicle_type(self) -> int:
        """MAV_TYPE of the first heartbeat (https://mavlink.io/en/messages/minimal.html#MAV_TYPE)."""
        return self.aio.vehicle_type

    @property
    def autopilot(self) -> Autopilot:
        """What differs between ArduPilot, PX4 and others."""
        return self.aio.autopilot

    # -------------------------------------------------------------------- what is known of it

    @cached_property
    def mode(self) -> StateCell[Mode]:
        """Flight mode by HEARTBEAT; ``vehicle.mode.value.name`` is its name."""
        return self._cell(self.aio.mode)

    @cached_property
    def armed(self) -> StateCell[bool]:
        """Whether the motors are armed, by HEARTBEAT."""
        return self._cell(self.aio.armed)

    @cached_property
    def landed_state(self) -> StateCell[int]:
        """MAV_LANDED_STATE: 1 on the ground, 2 in the air, 3 taking off, 4 landing (EXTENDED_SYS_STATE)."""
        return self._cell(self.aio.landed_state)

    @cached_property
    def vtol_state(self) -> StateCell[int]:
        """MAV_VTOL_STATE: 1 to fixed wing, 2 to multicopter, 3 multicopter, 4 fixed wing (EXTENDED_SYS_STATE)."""
        return self._cell(self.aio.vtol_state)

    @cached_property
    def system_status(self) -> StateCell[int]:
        """MAV_STATE by HEARTBEAT: 3 standby, 4 active, 5 critical, 6 emergency."""
        return self._cell(self.aio.system_status)

    @cached_property
    def attitude(self) -> StateCell[Attitude]:
        """Roll, pitch, yaw in degrees, turn rates, quaternion (ATTITUDE, ATTITUDE_QUATERNION)."""
        return self._cell(self.aio.attitude)

    @cached_property
    def position(self) -> StateCell[Position]:
        """Latitude, longitude in degrees, altitude above sea and above home in metres (GLOBAL_POSITION_INT)."""
        return self._cell(self.aio.position)

    @cached_property
    def local_position(self) -> StateCell[LocalPosition]:
        """Metres and m/s north, east, down of the estimator's origin (LOCAL_POSITION_NED)."""
        return self._cell(self.aio.local_position)

    @cached_property
    def velocity(self) -> StateCell[Velocity]:
        """Velocity over ground in m/s, north, east, down (GLOBAL_POSITION_INT)."""
        return self._cell(self.aio.velocity)

    @cached_property
    def heading_deg(self) -> StateCell[float]:
        """Where the nose points, 0 to 360 degrees clockwise from north (GLOBAL_POSITION_INT, VFR_HUD)."""
        return self._cell(self.aio.heading_deg)

    @cached_property
    def ground_speed_m_s(self) -> StateCell[float]:
        """Ground speed in m/s (VFR_HUD)."""
        return self._cell(self.aio.ground_speed_m_s)

    @cached_property
    def air_speed_m_s(self) -> StateCell[float]:
        """Air speed in m/s (VFR_HUD)."""
        return self._cell(self.aio.air_speed_m_s)

    @cached_property
    def climb_m_s(self) -> StateCell[float]:
        """Climb rate in m/s, up is positive (VFR_HUD)."""
        return self._cell(self.aio.climb_m_s)

    @cached_property
    def throttle_percent(self) -> StateCell[float]:
        """Throttle, 0 to 100 (VFR_HUD)."""
        return self._cell(self.aio.throttle_percent)

    @cached_property
    def gps(self) -> StateCell[tuple[GpsReceiver, ...]]:
        """Every satellite receiver, the first one first (GPS_RAW_INT, GPS2_RAW)."""
        return self._cell(self.aio.gps)

    @cached_property
    def batteries(self) -> StateCell[tuple[Battery, ...]]:
        """Every battery (BATTERY_STATUS, else SYS_STATUS)."""
        return self._cell(self.aio.batteries)

    @cached_property
    def estimator(self) -> StateCell[EstimatorHealth]:
        """Health of the state estimator (EKF_STATUS_REPORT, ESTIMATOR_STATUS)."""
        return self._cell(self.aio.estimator)

    @cached_property
    def sensors(self) -> StateCell[SensorHealth]:
        """Health of the sensors and the pre-arm checks (SYS_STATUS)."""
        return self._cell(self.aio.sensors)

    @cached_property
    def home(self) -> StateCell[Home]:
        """Where it returns to (HOME_POSITION)."""
        return self._cell(self.aio.home)

    @cached_property
    def origin(self) -> StateCell[Position]:
        """Origin of the estimator's local frame (GPS_GLOBAL_ORIGIN)."""
        return self._cell(self.aio.origin)

    @cached_property
    def rc_channels(self) -> StateCell[RcChannels]:
        """Remote control, pulse widths in µs (RC_CHANNELS)."""
        return self._cell(self.aio.rc_channels)

    @cached_property
    def servo_outputs(self) -> StateCell[ServoOutputs]:
        """Outputs to motors and servos, pulse widths in µs (SERVO_OUTPUT_RAW)."""
        return self._cell(self.aio.servo_outputs)

    @cached_property
    def wind(self) -> StateCell[Wind]:
        """Wind speed in m/s and where it comes from in degrees (WIND, WIND_COV)."""
        return self._cell(self.aio.wind)

    @cached_property
    def range_finders(self) -> StateCell[tuple[RangeFinder, ...]]:
        """Every distance sensor (DISTANCE_SENSOR, RANGEFINDER)."""
        return self._cell(self.aio.range_finders)

    @cached_property
    def vibration(self) -> StateCell[Vibration]:
        """Vibration levels in m/s² (VIBRATION)."""
        return self._cell(self.aio.vibration)

    @cached_property
    def system_time(self) -> StateCell[SystemTime]:
        """The vehicle's clock (SYSTEM_TIME)."""
        return self._cell(self.aio.system_time)

    @cached_property
    def version(self) -> StateCell[AutopilotVersion]:
        """Firmware and hardware (AUTOPILOT_VERSION)."""
        return self._cell(self.aio.version)

    @cached_property
    def capabilities(self) -> StateCell[int]:
        """MAV_PROTOCOL_CAPABILITY bits (AUTOPILOT_VERSION)."""
        return self._cell(self.aio.capabilities)

    @cached_property
    def mission_current(self) -> StateCell[MissionProgress]:
        """Current mission item (MISSION_CURRENT)."""
        return self._cell(self.aio.mission_current)

    @cached_property
    def mission_reached(self) -> StateCell[int]:
        """The mission item that was reached last (MISSION_ITEM_REACHED)."""
        return self._cell(self.aio.mission_reached)

    @cached_property
    def status_text(self) -> StateCell[StatusText]:
        """The last thing it said (STATUSTEXT, chunks joined)."""
        return self._cell(self.aio.status_text)

    @cached_property
    def link_quality(self) -> StateCell[LinkReport]:
        """Loss, delay and rates of the last second."""
        return self._cell(self.aio.link_quality)

    @cached_property
    def link_state(self) -> StateCell[LinkState]:
        """CONNECTED, SILENT (no heartbeat for more than 3.5 seconds) or LOST (the link has gone)."""
        return self._cell(self.aio.link_state)

    @property
    def mode_name(self) -> str:
        """Name of the flight mode, ``"unknown"`` before the first heartbeat."""
        return self.aio.mode_name

    @property
    def is_vtol(self) -> bool:
        """Whether it can hover and cruise on wings: EXTENDED_SYS_STATE tells a VTOL state."""
        return self.aio.is_vtol

    @property
    def is_armed(self) -> bool:
        """Whether the last heartbeat says armed; False before the first, and after a reboot until the next one."""
        return self.aio.is_armed

    @property
    def is_surely_disarmed(self) -> bool:
        """Whether the last heartbeat says disarmed; False while it is not known."""
        return self.aio.is_surely_disarmed

    @property
    def heartbeat_age(self) -> float:
        """Seconds since the last heartbeat of the autopilot."""
        return self.aio.heartbeat_age

    @property
    def is_silent(self) -> bool:
        """Whether no heartbeat comes: none for more than 3.5 seconds, or the link has gone."""
        return self.aio.is_silent

    def distance_to(self, target: Position) -> float:
        """Metres from where the vehicle is to ``target``; see :meth:`aerokit.Vehicle.distance_to`."""
        return self.aio.distance_to(target)

    def missing_for_flight(self) -> list[str]:
        """What is still missing before the vehicle can fly, as far as it is known already; talks to nobody."""
        return self._loop.call(self.aio.missing_for_flight)

    def texts_since(self, at: float) -> tuple[str, ...]:
        """What the vehicle said (STATUSTEXT) since this time on the loop's clock, oldest first."""
        return self._loop.call(self.aio.texts_since, at)

    def describe_now(self) -> str:
        """What it does, as far as it was heard: mode, armed or not, height above home."""
        return self.aio.describe_now()

    def describe_link(self) -> str:
        """One line on how well the vehicle is heard, for error texts."""
        return self._loop.call(self.aio.describe_link)

    def _cell(self, cell: AsyncStateCell[T]) -> StateCell[T]:
        return StateCell(self._loop, cell)
