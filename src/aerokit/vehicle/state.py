"""What a program reads of a vehicle: one cell for each thing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.vehicle.health import VehicleHealth

if TYPE_CHECKING:
    from aerokit.runtime.cells import StateCell
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

__all__ = ["VehicleState"]


class VehicleState(VehicleHealth):
    """Every cell gives ``.value`` (ValueUnknownError before the first), ``.latest`` (None before), ``.age`` in seconds,
    ``.source`` (who said it), ``.fresh(within=s)``, ``await .wait_until(predicate, held_for=s)``, ``.changes()``.
    """

    @property
    def mode(self) -> StateCell[Mode]:
        """Flight mode by HEARTBEAT; ``vehicle.mode.value.name`` is its name."""
        return self.telemetry.mode

    @property
    def armed(self) -> StateCell[bool]:
        """Whether the motors are armed, by HEARTBEAT."""
        return self.telemetry.armed

    @property
    def landed_state(self) -> StateCell[int]:
        """MAV_LANDED_STATE: 1 on the ground, 2 in the air, 3 taking off, 4 landing (EXTENDED_SYS_STATE)."""
        return self.telemetry.landed_state

    @property
    def vtol_state(self) -> StateCell[int]:
        """MAV_VTOL_STATE: 1 to fixed wing, 2 to multicopter, 3 multicopter, 4 fixed wing (EXTENDED_SYS_STATE)."""
        return self.telemetry.vtol_state

    @property
    def system_status(self) -> StateCell[int]:
        """MAV_STATE by HEARTBEAT: 3 standby, 4 active, 5 critical, 6 emergency."""
        return self.telemetry.system_status

    @property
    def attitude(self) -> StateCell[Attitude]:
        """Roll, pitch, yaw in degrees, turn rates, quaternion (ATTITUDE, ATTITUDE_QUATERNION)."""
        return self.telemetry.attitude

    @property
    def position(self) -> StateCell[Position]:
        """Latitude, longitude in degrees, altitude above sea and above home in metres (GLOBAL_POSITION_INT)."""
        return self.telemetry.position

    @property
    def local_position(self) -> StateCell[LocalPosition]:
        """Metres and m/s north, east, down of the estimator's origin (LOCAL_POSITION_NED)."""
        return self.telemetry.local_position

    @property
    def velocity(self) -> StateCell[Velocity]:
        """Velocity over ground in m/s, north, east, down (GLOBAL_POSITION_INT)."""
        return self.telemetry.velocity

    @property
    def heading_deg(self) -> StateCell[float]:
        """Where the nose points, 0 to 360 degrees clockwise from north (GLOBAL_POSITION_INT, VFR_HUD)."""
        return self.telemetry.heading_deg

    @property
    def ground_speed_m_s(self) -> StateCell[float]:
        """Ground speed in m/s (VFR_HUD)."""
        return self.telemetry.ground_speed_m_s

    @property
    def air_speed_m_s(self) -> StateCell[float]:
        """Air speed in m/s (VFR_HUD)."""
        return self.telemetry.air_speed_m_s

    @property
    def climb_m_s(self) -> StateCell[float]:
        """Climb rate in m/s, up is positive (VFR_HUD)."""
        return self.telemetry.climb_m_s

    @property
    def throttle_percent(self) -> StateCell[float]:
        """Throttle, 0 to 100 (VFR_HUD)."""
        return self.telemetry.throttle_percent

    @property
    def gps(self) -> StateCell[tuple[GpsReceiver, ...]]:
        """Every satellite receiver, the first one first (GPS_RAW_INT, GPS2_RAW)."""
        return self.telemetry.gps

    @property
    def batteries(self) -> StateCell[tuple[Battery, ...]]:
        """Every battery (BATTERY_STATUS, else SYS_STATUS)."""
        return self.telemetry.batteries

    @property
    def estimator(self) -> StateCell[EstimatorHealth]:
        """Health of the state estimator (EKF_STATUS_REPORT, ESTIMATOR_STATUS)."""
        return self.telemetry.estimator

    @property
    def sensors(self) -> StateCell[SensorHealth]:
        """Health of the sensors and the pre-arm checks (SYS_STATUS)."""
        return self.telemetry.sensors

    @property
    def home(self) -> StateCell[Home]:
        """Where it returns to (HOME_POSITION)."""
        return self.telemetry.home

    @property
    def origin(self) -> StateCell[Position]:
        """Origin of the estimator's local frame (GPS_GLOBAL_ORIGIN)."""
        return self.telemetry.origin

    @property
    def rc_channels(self) -> StateCell[RcChannels]:
        """Remote control, pulse widths in µs (RC_CHANNELS)."""
        return self.telemetry.rc_channels

    @property
    def servo_outputs(self) -> StateCell[ServoOutputs]:
        """Outputs to motors and servos, pulse widths in µs (SERVO_OUTPUT_RAW)."""
        return self.telemetry.servo_outputs

    @property
    def wind(self) -> StateCell[Wind]:
        """Wind speed in m/s and where it comes from in degrees (WIND, WIND_COV)."""
        return self.telemetry.wind

    @property
    def range_finders(self) -> StateCell[tuple[RangeFinder, ...]]:
        """Every distance sensor (DISTANCE_SENSOR, RANGEFINDER)."""
        return self.telemetry.range_finders

    @property
    def vibration(self) -> StateCell[Vibration]:
        """Vibration levels in m/s² (VIBRATION)."""
        return self.telemetry.vibration

    @property
    def system_time(self) -> StateCell[SystemTime]:
        """The vehicle's clock (SYSTEM_TIME)."""
        return self.telemetry.system_time

    @property
    def version(self) -> StateCell[AutopilotVersion]:
        """Firmware and hardware (AUTOPILOT_VERSION)."""
        return self.telemetry.version

    @property
    def capabilities(self) -> StateCell[int]:
        """MAV_PROTOCOL_CAPABILITY bits (AUTOPILOT_VERSION)."""
        return self.telemetry.capabilities

    @property
    def mission_current(self) -> StateCell[MissionProgress]:
        """Current mission item (MISSION_CURRENT)."""
        return self.telemetry.mission_current

    @property
    def mission_reached(self) -> StateCell[int]:
        """The mission item that was reached last (MISSION_ITEM_REACHED)."""
        return self.telemetry.mission_reached

    @property
    def status_text(self) -> StateCell[StatusText]:
        """The last thing it said (STATUSTEXT, chunks joined)."""
        return self.telemetry.status_text

    @property
    def mode_name(self) -> str:
        """Name of the flight mode, ``"unknown"`` before the first heartbeat."""
        mode = self.telemetry.mode.latest
        return "unknown" if mode is None else mode.name

    def describe_now(self) -> str:
        """What it does, as far as it was heard: ``holding in BRAKE, still armed, 9 m above home, heard 0.3 s ago``."""
        hold, mode = self.autopilot.mode_for("hold", is_vtol=self.is_vtol), self.telemetry.mode.latest
        armed = "still armed" if self.is_armed else "disarmed" if self.is_surely_disarmed else "perhaps armed"
        position = self.telemetry.position.latest
        height = None if position is None else position.altitude_relative_m
        return (
            f"{'holding in' if mode is not None and mode == hold else 'in'} {self.mode_name}, {armed},"
            f" {'' if height is None else f'{height:.1f} m above home, '}heard {self.heartbeat_age:.1f} s ago"
        )

    @property
    def is_vtol(self) -> bool:
        """Whether it can hover and cruise on wings: EXTENDED_SYS_STATE tells a VTOL state."""
        return bool(self.telemetry.vtol_state.latest)
