"""State values and decoders: mode, health, mission, status texts."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.autopilots import is_armed
from aerokit.autopilots.modes import Mode
from aerokit.autopilots.telemetry import AutopilotVersion
from aerokit.mavlink.enums import (
    MavLandedState,
    MavProtocolCapability,
    MavSeverity,
    MavState,
    MavVtolState,
    MissionState,
)
from aerokit.vehicle.state.field import U16, Context, enum_member, finite, known

if TYPE_CHECKING:
    from aerokit.mavlink import messages

__all__ = [
    "EstimatorHealth",
    "MissionProgress",
    "SensorHealth",
    "StatusText",
    "SystemTime",
    "armed",
    "capabilities",
    "current_mode",
    "ekf_health",
    "estimator_health",
    "landed_state",
    "landed_state_of_heartbeat",
    "mission_progress",
    "mission_reached",
    "mode",
    "sensor_health",
    "system_status",
    "system_time",
    "version",
    "vtol_state",
]

SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")
# A time before this one (September 2001) shows that the vehicle's clock is not set.
EARLIEST_UNIX_S = 1_000_000_000
# Flags of EKF_STATUS_REPORT and ESTIMATOR_STATUS, which have the same values.
ATTITUDE, HORIZONTAL_VELOCITY, RELATIVE_POSITION, ABSOLUTE_POSITION, ALTITUDE = 1, 2, 8, 16, 32


class SystemTime(Snapshot):
    """The vehicle's clock. ``unix_s`` is UTC in seconds since 1970, None while the vehicle does not know it."""

    unix_s: float | None
    since_boot_s: float


class SensorHealth(Snapshot):
    """Sensor health from SYS_STATUS (https://mavlink.io/en/messages/common.html#SYS_STATUS).

    ``present``, ``enabled`` and ``healthy`` are MAV_SYS_STATUS_SENSOR bits. ``failing`` has the names of the sensors
    that are enabled but not healthy. ``prearm_checks_pass`` is None if the vehicle does not report it. ``load_percent``
    is the load of the processor.
    """

    present: int
    enabled: int
    healthy: int
    failing: tuple[str, ...]
    prearm_checks_pass: bool | None
    load_percent: float

    @property
    def blocks_arming(self) -> tuple[str, ...]:
        """The failing sensors, which may block arming; empty if the pre-arm checks pass."""
        return () if self.prearm_checks_pass else self.failing


class EstimatorHealth(Snapshot):
    """State estimator health from EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (PX4).

    ``message`` is the name of the message and ``flags`` its flags. ``missing`` names the estimates that are not
    good yet, but needed to fly to a position. Ratios are innovations divided by their limits: below 1 is good.
    Accuracies are one standard deviation, in metres.
    """

    message: str
    flags: int
    missing: tuple[str, ...]
    velocity_ratio: float | None = None
    horizontal_position_ratio: float | None = None
    vertical_position_ratio: float | None = None
    compass_ratio: float | None = None
    terrain_ratio: float | None = None
    airspeed_ratio: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None

    @property
    def has_attitude(self) -> bool:
        """True if the attitude estimate is good."""
        return bool(self.flags & ATTITUDE)

    @property
    def has_horizontal_velocity(self) -> bool:
        """True if the horizontal velocity estimate is good."""
        return bool(self.flags & HORIZONTAL_VELOCITY)

    @property
    def has_relative_position(self) -> bool:
        """True if the position relative to the starting point is good."""
        return bool(self.flags & RELATIVE_POSITION)

    @property
    def has_absolute_position(self) -> bool:
        """True if the global position estimate is good."""
        return bool(self.flags & ABSOLUTE_POSITION)

    @property
    def has_altitude(self) -> bool:
        """True if the altitude estimate is good."""
        return bool(self.flags & ALTITUDE)


class MissionProgress(Snapshot):
    """Index of the current mission item (the first is 0), and number of items.

    A value is None if the vehicle has no mission, or does not report the value. ``state`` is a MISSION_STATE: 0
    unknown, 1 no mission, 2 not started, 3 active, 4 paused, 5 complete.
    """

    current: int | None
    total: int | None = None
    state: int = 0


class StatusText(Snapshot):
    """One status text. ``severity`` is a MAV_SEVERITY, 0 emergency to 7 debug. "…" replaces a part that was lost."""

    severity: int
    text: str
    at: float = 0.0
    """Time at which the last part of the text was processed, in seconds of the event loop's clock."""

    @property
    def is_error(self) -> bool:
        """True for severity ERROR or worse."""
        return self.severity <= MavSeverity.ERROR

    def __str__(self) -> str:
        name = SEVERITIES[self.severity] if self.severity < len(SEVERITIES) else str(self.severity)
        return f"{name}: {self.text}"


def mode(message: messages.Heartbeat, context: Context) -> Mode:
    """Return the flight mode in HEARTBEAT."""
    return context.autopilot.mode_of(message, context.mode_names)


def current_mode(message: messages.CurrentMode, context: Context) -> Mode | None:
    """Return the flight mode in CURRENT_MODE, which reports a change earlier than HEARTBEAT but lacks ``base_mode``."""
    # A custom_mode of 0 may mean "no mode", so only HEARTBEAT sets it. `base_mode` is known once HEARTBEAT has arrived.
    if not message.custom_mode or context.previous_value is None:
        return None
    return context.autopilot.mode(message.custom_mode, context.base_mode, context.mode_names)


def armed(message: messages.Heartbeat) -> bool:
    """Return True if the motors are armed."""
    return is_armed(message.base_mode)


def system_status(message: messages.Heartbeat) -> int:
    """Return the MAV_STATE in HEARTBEAT."""
    return enum_member(MavState, message.system_status)


def vtol_state(message: messages.ExtendedSysState) -> int:
    """Return the MAV_VTOL_STATE in EXTENDED_SYS_STATE."""
    return enum_member(MavVtolState, message.vtol_state)


def landed_state(message: messages.ExtendedSysState) -> int | None:
    """Return the MAV_LANDED_STATE in EXTENDED_SYS_STATE; None if the vehicle does not know it."""
    if message.landed_state == MavLandedState.UNDEFINED:
        return None
    return enum_member(MavLandedState, message.landed_state)


def landed_state_of_heartbeat(message: messages.Heartbeat, context: Context) -> int | None:
    """Return the landed state that some autopilots encode in HEARTBEAT."""
    state = context.autopilot.landed_state_of(message)
    return None if state is None else MavLandedState(state)


def version(message: messages.AutopilotVersion, context: Context) -> AutopilotVersion:
    """Return firmware and hardware versions."""
    return context.autopilot.version_of(message)


def capabilities(message: messages.AutopilotVersion) -> int:
    """Return the MAV_PROTOCOL_CAPABILITY bits."""
    return MavProtocolCapability(message.capabilities)


def system_time(message: messages.SystemTime) -> SystemTime:
    """Return time since boot, and UTC if the vehicle's clock is set."""
    unix_s = message.time_unix_usec / 1e6
    return SystemTime(unix_s if unix_s > EARLIEST_UNIX_S else None, message.time_boot_ms / 1e3)


def sensor_health(message: messages.SysStatus, context: Context) -> SensorHealth:
    """Return the sensor health. The meaning of the bits depends on the autopilot."""
    present = message.onboard_control_sensors_present
    enabled = message.onboard_control_sensors_enabled
    healthy = message.onboard_control_sensors_health
    return SensorHealth(
        present=present,
        enabled=enabled,
        healthy=healthy,
        failing=context.autopilot.failing_sensors(present, enabled, healthy),
        prearm_checks_pass=context.autopilot.prearm_checks_pass(present, enabled, healthy),
        load_percent=message.load / 10,
    )


def ekf_health(message: messages.EkfStatusReport, context: Context) -> EstimatorHealth:
    """Return the health of ArduPilot's estimator from EKF_STATUS_REPORT."""
    # The fields called variances are ratios of innovations to their limits (NavEKF3_core::getVariances).
    return EstimatorHealth(
        message=message.NAME,
        flags=message.flags,
        missing=context.autopilot.missing_estimates(message.flags),
        velocity_ratio=finite(message.velocity_variance),
        horizontal_position_ratio=finite(message.pos_horiz_variance),
        vertical_position_ratio=finite(message.pos_vert_variance),
        compass_ratio=finite(message.compass_variance),
        terrain_ratio=finite(message.terrain_alt_variance),
        airspeed_ratio=finite(message.airspeed_variance),
    )


def estimator_health(message: messages.EstimatorStatus, context: Context) -> EstimatorHealth:
    """Return the health of PX4's estimator from ESTIMATOR_STATUS."""
    return EstimatorHealth(
        message=message.NAME,
        flags=message.flags,
        missing=context.autopilot.missing_estimates(message.flags),
        velocity_ratio=finite(message.vel_ratio),
        horizontal_position_ratio=finite(message.pos_horiz_ratio),
        vertical_position_ratio=finite(message.pos_vert_ratio),
        compass_ratio=finite(message.mag_ratio),
        terrain_ratio=finite(message.hagl_ratio),
        airspeed_ratio=finite(message.tas_ratio),
        horizontal_accuracy_m=finite(message.pos_horiz_accuracy),
        vertical_accuracy_m=finite(message.pos_vert_accuracy),
    )


def mission_progress(message: messages.MissionCurrent) -> MissionProgress:
    """Return the mission progress in MISSION_CURRENT."""
    return _mission_progress(message.seq, message.total, message.mission_state)


@lru_cache(maxsize=16)  # MISSION_CURRENT repeats its values, and every MISSION_CURRENT is decoded.
def _mission_progress(seq: int, total: int, mission_state: int) -> MissionProgress:
    state = enum_member(MissionState, mission_state)
    if total == U16:  # There is no mission. A total of 0 means that the vehicle does not report the total.
        return MissionProgress(current=None, total=None, state=state)
    return MissionProgress(known(seq, unknown=U16), known(total, unknown=0), state)


def mission_reached(message: messages.MissionItemReached) -> int:
    """Return the index of the mission item that was reached."""
    return message.seq
