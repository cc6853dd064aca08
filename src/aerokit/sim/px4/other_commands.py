"""Commands whose answer is all that a client sees of them on a simulated PX4."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity
from aerokit.sim.commands import Progress, whole

if TYPE_CHECKING:
    from aerokit.sim.commands import Command, CommandHandler
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["other_commands"]

_C = MavCmd
_ACCEPTED = (
    _C.NAV_ROI,
    _C.NAV_VTOL_TAKEOFF,
    _C.DO_SET_ACTUATOR,
    _C.DO_GO_AROUND,
    _C.DO_SET_ROI_LOCATION,
    _C.DO_SET_ROI_WPNEXT_OFFSET,
    _C.DO_SET_ROI_NONE,
    _C.DO_SET_ROI,
    _C.DO_SET_SAFETY_SWITCH_STATE,
    _C.EXTERNAL_POSITION_ESTIMATE,
    _C.LOGGING_START,
)
"""Taken, with nothing to be seen of it."""

_SILENT = (
    _C.NAV_DELAY,
    _C.DO_DIGICAM_CONTROL,
    _C.DO_MOUNT_CONFIGURE,
    _C.DO_MOUNT_CONTROL,
    _C.DO_SET_CAM_TRIGG_DIST,
    _C.DO_SET_CAM_TRIGG_INTERVAL,
    _C.DO_MOUNT_CONTROL_QUAT,
    _C.PREFLIGHT_SET_SENSOR_OFFSETS,
    _C.PREFLIGHT_UAVCAN,
    _C.OBLIQUE_SURVEY,
    _C.CONFIGURE_ACTUATOR,
    _C.INJECT_FAILURE,
    _C.START_RX_PAIR,
    _C.REQUEST_CAMERA_INFORMATION,
    _C.SET_CAMERA_MODE,
    _C.SET_CAMERA_ZOOM,
    _C.SET_CAMERA_FOCUS,
    _C.DO_GIMBAL_MANAGER_PITCHYAW,
    _C.DO_GIMBAL_MANAGER_CONFIGURE,
    _C.DO_TRIGGER_CONTROL,
    _C.DO_VTOL_TRANSITION,
    _C.DO_WINCH,
    _C.PAYLOAD_PREPARE_DEPLOY,
    _C.PAYLOAD_CONTROL_DEPLOY,
)
"""Left to a part of the vehicle that does not run here: nobody answers."""

_NO_FIGURE_EIGHT = "Figure 8 command only available for fixed wing and vtol vehicles."
_GRIPS_FOR_S = 1.3
_LOG_STOPS_AFTER_S = 2.0
_UNKNOWN_PROGRESS = 255
_STORAGE_ACTIONS = range(5)
_ACTUATORS, _FIRST_OUTPUT_FUNCTION = (range(1, 13), range(33, 41)), 1000


def other_commands(px4: SimulatedPx4) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    handlers: dict[int, CommandHandler] = dict.fromkeys(_ACCEPTED, lambda _: MavResult.ACCEPTED)
    handlers |= dict.fromkeys(_SILENT, lambda _: None)
    handlers[_C.DO_LAND_START] = lambda _: MavResult.CANCELLED
    handlers[_C.DO_FIGURE_EIGHT] = lambda _: px4.send_text(MavSeverity.CRITICAL, _NO_FIGURE_EIGHT)
    handlers[_C.CONTROL_HIGH_LATENCY] = _with_text(px4)
    handlers[_C.EXTERNAL_WIND_ESTIMATE] = lambda command: _answer_twice(px4, command)
    handlers[_C.FIXED_MAG_CAL_YAW] = lambda command: _calibrate_by_yaw(px4, command)
    handlers[_C.DO_GRIPPER] = lambda _: Progress((_UNKNOWN_PROGRESS,), _GRIPS_FOR_S)
    handlers[_C.ACTUATOR_TEST] = lambda command: _test_actuator(px4, command)
    handlers[_C.PREFLIGHT_STORAGE] = lambda command: _store(px4, command)
    handlers[_C.LOGGING_STOP] = lambda _: Progress((), _LOG_STOPS_AFTER_S)
    return handlers


def _with_text(px4: SimulatedPx4) -> Callable[[Command], int]:
    def fail(_: Command) -> int:
        px4.send_text(MavSeverity.CRITICAL, "Control high latency failed! Telemetry unavailable")
        return MavResult.FAILED

    return fail


def _calibrate_by_yaw(px4: SimulatedPx4, command: Command) -> int:
    if px4.is_armed:
        return MavResult.TEMPORARILY_REJECTED
    px4.info(f"Assuming vehicle is facing heading {command.param1:.1f} degrees")
    px4.info("Mag quick calibration finished")
    return MavResult.ACCEPTED


def _test_actuator(px4: SimulatedPx4, command: Command) -> int | None:
    """Nothing is seen of it; param 5 is a motor, a servo, or from 1000 on any function of an output."""
    if px4.is_armed:
        return MavResult.DENIED
    function = whole(command.x)
    is_known = any(function in each for each in _ACTUATORS) or function >= _FIRST_OUTPUT_FUNCTION
    return MavResult.ACCEPTED if is_known else None


def _store(px4: SimulatedPx4, command: Command) -> int | None:
    """Nothing is seen of it; an action that it does not know is not answered."""
    if px4.is_armed:
        return MavResult.TEMPORARILY_REJECTED
    return MavResult.ACCEPTED if whole(command.param1) in _STORAGE_ACTIONS else None


def _answer_twice(px4: SimulatedPx4, command: Command) -> int:
    """The estimator takes it, the commander does not know it."""
    px4.commands.answer(command, MavResult.ACCEPTED)
    return MavResult.UNSUPPORTED
