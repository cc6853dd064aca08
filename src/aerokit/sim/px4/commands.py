"""Handlers of the commands (MAV_CMD) of a simulated PX4, with the conditions and results of the firmware."""

from __future__ import annotations

import math
from functools import partial

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    FailureType,
    FailureUnit,
    MavDoRepositionFlags,
    MavFrame,
    MavModeFlag,
    MavResult,
    MavSeverity,
    MavType,
    MavVtolState,
)
from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.sim.commands import CommandHandler, CommandProgress, ReceivedCommand, to_int
from aerokit.sim.px4 import modes
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.modes import Px4Mode
from aerokit.sim.px4.payload import gimbal_commands
from aerokit.sim.px4.telemetry import available_modes

# Commands that PX4 accepts, without an effect that a client could see.
_ACCEPTED = (
    Cmd.NAV_ROI, Cmd.NAV_VTOL_TAKEOFF, Cmd.DO_SET_ACTUATOR, Cmd.DO_SET_ROI_LOCATION, Cmd.DO_SET_ROI_WPNEXT_OFFSET,
    Cmd.DO_SET_ROI_NONE, Cmd.DO_SET_ROI, Cmd.DO_SET_SAFETY_SWITCH_STATE,
)  # fmt: skip

# Commands that PX4 does not answer, because the modules that handle them do not run in this configuration.
_UNANSWERED = (
    Cmd.NAV_DELAY, Cmd.DO_DIGICAM_CONTROL, Cmd.DO_MOUNT_CONFIGURE, Cmd.DO_MOUNT_CONTROL, Cmd.DO_SET_CAM_TRIGG_DIST,
    Cmd.DO_SET_CAM_TRIGG_INTERVAL, Cmd.PREFLIGHT_UAVCAN, Cmd.REQUEST_CAMERA_INFORMATION, Cmd.SET_CAMERA_MODE,
    Cmd.SET_CAMERA_ZOOM, Cmd.SET_CAMERA_FOCUS, Cmd.DO_GIMBAL_MANAGER_PITCHYAW, Cmd.DO_GIMBAL_MANAGER_CONFIGURE,
    Cmd.DO_TRIGGER_CONTROL, Cmd.DO_WINCH,
)  # fmt: skip

_GRIP_DURATION_S = 1.3
_TUNING_STEP_S, _TUNING_PROGRESS = 2.0, (0, 20, 40, 60, 80, 95)
_TRANSITION_DURATION_S = 4.0
_NO_TRANSITION = frozenset({modes.TAKEOFF, modes.LAND, modes.RTL, modes.ORBIT})
_UNKNOWN_PROGRESS = 255
_STORAGE_ACTIONS = range(5)
_MOTORS, _SERVOS, _FIRST_OUTPUT_FUNCTION = range(1, 13), range(33, 41), 1000  # param 5 of ACTUATOR_TEST


# Units that can fail in SIH, with their failure types: the motors (FailureInjector.cpp) and the battery
# (BatterySimulator.cpp).
_FAILURES = {
    FailureUnit.SYSTEM_MOTOR: (FailureType.OK, FailureType.OFF, FailureType.STUCK, FailureType.WRONG),
    FailureUnit.SYSTEM_BATTERY: (FailureType.OK, FailureType.OFF),
}


def _inject_failure(px4: Px4Vehicle, command: ReceivedCommand) -> int | None:
    if not px4.parameters.get("SYS_FAILURE_EN", 0):
        return MavResult.DENIED
    # The answers are those of PX4's own simulation (SIH). The failures have no effect.
    unit, failure_type = to_int(command.param1), to_int(command.param2)
    if unit not in _FAILURES:
        return None
    return MavResult.ACCEPTED if failure_type in _FAILURES[FailureUnit(unit)] else MavResult.UNSUPPORTED


def _refuse_high_latency(px4: Px4Vehicle) -> int:
    px4.send_text(MavSeverity.CRITICAL, "Control high latency failed! Telemetry unavailable")
    return MavResult.FAILED


def _test_actuator(px4: Px4Vehicle, command: ReceivedCommand) -> int | None:
    if px4.is_armed:
        return MavResult.DENIED
    function = to_int(command.x)
    is_known = function in _MOTORS or function in _SERVOS or function >= _FIRST_OUTPUT_FUNCTION
    return MavResult.ACCEPTED if is_known else None


def _store(px4: Px4Vehicle, command: ReceivedCommand) -> int | None:
    if px4.is_armed:
        return MavResult.TEMPORARILY_REJECTED
    return MavResult.ACCEPTED if to_int(command.param1) in _STORAGE_ACTIONS else None


_FORCE_MAGIC = 21196.0
_REBOOT_DELAY_S = 0.2
_ALIASES: dict[Px4Mode, Px4Mode] = {(modes.AUTO, 0): modes.MISSION, modes.ORBIT: modes.POSITION}
# In the x and y of COMMAND_INT, INT32_MAX means "unspecified". PX4 refuses 0x7FF80000, the upper half of a double NaN.
_INT32_MAX, _NAN_AS_INT = 0x7FFFFFFF, 0x7FF80000
# In the floats of COMMAND_LONG, INT32_MAX is rounded to 2^31. PX4 refuses 2^31 and the floats next to it
# (mavlink_receiver.cpp, handle_message_command_long).
_BEFORE_INT32_MAX, _AFTER_INT32_MAX = 2.0**31 - 128, 2.0**31 + 256


def px4_commands(px4: Px4Vehicle) -> dict[int, CommandHandler]:
    flight, requests = _FlightCommands(px4), _MessageRequests(px4)
    return {
        Cmd.REQUEST_MESSAGE: requests.request_message,
        Cmd.SET_MESSAGE_INTERVAL: requests.set_interval,
        Cmd.GET_MESSAGE_INTERVAL: requests.get_interval,
        **{command: partial(requests.send_now, message) for command, message in _LEGACY_REQUESTS.items()},
        **dict.fromkeys(_ACCEPTED, lambda _: MavResult.ACCEPTED),
        **dict.fromkeys(_UNANSWERED, lambda _: None),  # None sends no acknowledgement.
        **px4.camera_trigger.commands(),
        **gimbal_commands(px4.gimbal),
        Cmd.COMPONENT_ARM_DISARM: flight.arm_or_disarm,
        Cmd.DO_SET_MODE: flight.set_mode,
        Cmd.NAV_TAKEOFF: flight.take_off,
        Cmd.DO_SET_STANDARD_MODE: flight.set_standard_mode,
        Cmd.NAV_LAND: lambda _: flight.change_to(modes.LAND, "Landing at current position"),
        Cmd.NAV_LAND_LOCAL: lambda _: flight.change_to(modes.PRECISION_LAND, "Precision landing"),
        Cmd.DO_ORBIT: flight.orbit,
        Cmd.DO_VTOL_TRANSITION: flight.transition,
        Cmd.DO_AUTOTUNE_ENABLE: flight.tune,
        Cmd.DO_CHANGE_ALTITUDE: flight.change_altitude,
        Cmd.DO_FLIGHTTERMINATION: flight.terminate,
        Cmd.NAV_RETURN_TO_LAUNCH: lambda _: flight.change_to(modes.RTL, "Returning to launch"),
        Cmd.DO_REPOSITION: flight.reposition,
        Cmd.DO_CHANGE_SPEED: flight.change_speed,
        Cmd.MISSION_START: flight.start_mission,
        Cmd.DO_SET_HOME: flight.set_home,
        Cmd.EXTERNAL_WIND_ESTIMATE: px4.external.set_wind,
        Cmd.PREFLIGHT_CALIBRATION: lambda command: px4.calibration.command(command),  # A reboot replaces `calibration`.
        Cmd.RUN_PREARM_CHECKS: flight.run_prearm_checks,
        Cmd.PREFLIGHT_REBOOT_SHUTDOWN: flight.reboot,
        Cmd.DO_LAND_START: lambda _: MavResult.CANCELLED,
        Cmd.CONTROL_HIGH_LATENCY: lambda _: _refuse_high_latency(px4),
        Cmd.INJECT_FAILURE: partial(_inject_failure, px4),
        Cmd.LOGGING_START: px4.log_stream.start,
        Cmd.LOGGING_STOP: px4.log_stream.stop,
        Cmd.DO_GRIPPER: lambda _: CommandProgress((_UNKNOWN_PROGRESS,), _GRIP_DURATION_S),
        Cmd.ACTUATOR_TEST: partial(_test_actuator, px4),
        Cmd.PREFLIGHT_STORAGE: partial(_store, px4),
    }


def refusal_by_place(command: ReceivedCommand, *, checks_frame: bool) -> int | None:
    """Return the MAV_RESULT that refuses an invalid position or frame, or None."""
    if command.is_long:
        is_int32_max = all(_BEFORE_INT32_MAX <= value <= _AFTER_INT32_MAX for value in (command.x, command.y))
        return MavResult.DENIED if is_int32_max else None
    if command.x == command.y == _NAN_AS_INT:
        return MavResult.DENIED
    is_wrong_frame = checks_frame and command.frame != MavFrame.GLOBAL_INT
    return MavResult.COMMAND_UNSUPPORTED_MAV_FRAME if is_wrong_frame else None


def set_mode(px4: Px4Vehicle, base_mode: int, mode: Px4Mode) -> int:
    if not base_mode & MavModeFlag.CUSTOM_MODE_ENABLED:
        px4.send_text(MavSeverity.CRITICAL, "Unsupported base mode")
        return MavResult.TEMPORARILY_REJECTED
    mode = _ALIASES.get(mode, mode)
    if mode not in modes.SELECTABLE:
        main_mode, _ = mode
        level = "auto" if main_mode == modes.AUTO else "main"
        px4.send_text(MavSeverity.CRITICAL, f"Unsupported {level} mode")
        # PX4 1.16 accepts an unknown mode, but does not enter the mode.
        return MavResult.ACCEPTED if px4.version.startswith("1.16") else MavResult.TEMPORARILY_REJECTED
    return _change(px4, mode)


def _change(px4: Px4Vehicle, mode: Px4Mode) -> int:
    if px4.change_mode(mode):
        return MavResult.ACCEPTED
    px4.send_text(MavSeverity.CRITICAL, f"Switching to {modes.MODES[mode].name} is currently not available")
    return MavResult.TEMPORARILY_REJECTED


class _FlightCommands:
    """Handlers of the commands that arm, move or restart the vehicle."""

    def __init__(self, px4: Px4Vehicle) -> None:
        self._px4 = px4
        self._tuning_since = math.nan  # start of the autotuning; NaN while it does not run

    def arm_or_disarm(self, command: ReceivedCommand) -> int | None:
        force = command.param2 == _FORCE_MAGIC
        arm = round(command.param1) if math.isfinite(command.param1) else None
        if arm == 1:
            is_done = self._px4.arming.arm()  # `force` is not passed, because PX4 checks even forced arm commands.
        elif arm == 0:
            is_done = self._px4.arming.disarm("external command", force=force)
        else:
            self._px4.send_text(MavSeverity.CRITICAL, f"Unsupported ARM_DISARM param: {command.param1:.3f}")
            return None  # PX4 does not acknowledge this command.
        return MavResult.ACCEPTED if is_done else MavResult.TEMPORARILY_REJECTED

    def set_mode(self, command: ReceivedCommand) -> int:
        # PX4's link module always accepts. Then the commander sends the result.
        self._px4.commands.answer(command, MavResult.ACCEPTED)
        return set_mode(self._px4, to_int(command.param1), (to_int(command.param2), to_int(command.param3)))

    def set_standard_mode(self, command: ReceivedCommand) -> int:
        mode = modes.STANDARD_MODES.get(to_int(command.param1))
        if mode is None:
            return MavResult.FAILED
        return MavResult.ACCEPTED if self._px4.change_mode(mode) else MavResult.TEMPORARILY_REJECTED

    def change_to(self, mode: Px4Mode, text: str = "") -> int:
        result = _change(self._px4, mode)
        if text and result == MavResult.ACCEPTED:
            self._px4.info(text)
        return result

    def take_off(self, command: ReceivedCommand) -> int:
        px4 = self._px4
        result = self.change_to(modes.TAKEOFF)
        # Without an altitude, the mode TAKEOFF climbs to MIS_TAKEOFF_ALT.
        if result == MavResult.ACCEPTED and math.isfinite(command.z):
            down = px4.frame.origin.altitude_m - command.z
            if px4.is_armed and down > px4.motion.down and not px4.is_landed:
                px4.send_text(MavSeverity.CRITICAL, "Already higher than takeoff altitude")
                down = px4.motion.down
            px4.flight.plan_take_off(down)
        return result

    def start_mission(self, command: ReceivedCommand) -> int:
        px4 = self._px4
        if not px4.mission.is_valid:
            px4.send_text(MavSeverity.CRITICAL, "Mission start denied! No valid mission")
            return MavResult.DENIED
        if not -1 <= command.param1 < px4.mission.count:
            return MavResult.DENIED
        if command.param1 >= 0 and to_int(command.param1) != px4.mission.current:
            px4.mission.set_current(to_int(command.param1))  # even if PX4 refuses the mode below (navigator_main.cpp)
        result = self.change_to(modes.MISSION)
        if result == MavResult.ACCEPTED and not px4.arming.arm("mission start"):
            return MavResult.TEMPORARILY_REJECTED
        return result

    def reposition(self, command: ReceivedCommand) -> int:
        if to_int(command.param2) != MavDoRepositionFlags.CHANGE_MODE:  # PX4 requires this flag, and no other flag.
            return MavResult.UNSUPPORTED
        result = self.change_to(modes.HOLD)
        if result != MavResult.ACCEPTED:
            return result
        if self._px4.failsafes.fence.allows(self._destination(command)):
            self._go_to(command)
        else:  # PX4 checks the fence only after the acknowledgement, and stays in HOLD (navigator_main.cpp).
            self._px4.send_text(MavSeverity.CRITICAL, "Reposition is outside geofence")
        return MavResult.ACCEPTED

    def _destination(self, command: ReceivedCommand) -> tuple[float, float, float]:
        """Return the position in a command. The vehicle's position replaces missing values."""
        px4, motion = self._px4, self._px4.motion
        north, east, down = motion.north, motion.east, motion.down
        has_place = math.isfinite(command.x) and math.isfinite(command.y) and _INT32_MAX not in (command.x, command.y)
        if has_place:
            north, east = px4.frame.to_local(*command.place())
        if math.isfinite(command.z):
            down = px4.frame.origin.altitude_m - command.z
        return (north, east, down)

    def _go_to(self, command: ReceivedCommand) -> None:
        px4 = self._px4
        px4.flight.target = self._destination(command)
        px4.flight.heading = command.param4 if math.isfinite(command.param4) else None
        if command.param1 > 0:
            px4.flight.speed_m_s = command.param1

    def orbit(self, command: ReceivedCommand) -> int:
        px4, orbit = self._px4, self._px4.flight.orbit
        north, east, down = self._destination(command)
        has_radius = math.isfinite(command.param1)
        # A plane has no ORBIT, but circles its target in HOLD. It ignores the speed.
        if px4.VEHICLE_TYPE == MavType.FIXED_WING:
            result = self.change_to(modes.HOLD)  # sets the target to the current position
            if result == MavResult.ACCEPTED:
                px4.flight.target = (north, east, down)
                px4.flight.radius_m = command.param1 if has_radius else px4.parameters["NAV_LOITER_RAD"]
            return result
        radius = command.param1 if has_radius else orbit.radius_m
        speed = abs(command.param2) if math.isfinite(command.param2) else orbit.speed_m_s
        if not orbit.plan(radius, speed, (north, east), down):
            px4.send_text(MavSeverity.CRITICAL, "Orbit radius limit exceeded")
            return MavResult.ACCEPTED  # PX4 checks the radius only after the acknowledgement (FlightTaskOrbit.cpp).
        return self.change_to(modes.ORBIT)

    def tune(self, command: ReceivedCommand) -> int | None:
        px4 = self._px4
        if command.param1 != 1.0 or command.param2 != 0.0:
            return MavResult.DENIED
        if not px4.is_armed:
            self._tuning_since = math.nan
        elif not self._tuning_since >= px4.arming.armed_at:  # no tuning since the last arming
            self._tuning_since = px4.now
        # The last step waits for disarming (MC_AT_APPLY 1).
        steps = (px4.now - self._tuning_since) / _TUNING_STEP_S  # NaN while disarmed
        progress = 0 if math.isnan(steps) else _TUNING_PROGRESS[min(int(steps), len(_TUNING_PROGRESS) - 1)]
        px4.commands.answer(command, MavResult.IN_PROGRESS, progress)
        return None  # The progress is the only answer.

    def transition(self, command: ReceivedCommand) -> int | None:
        px4 = self._px4
        requested_state = to_int(command.param1)
        if not px4.vtol_state:
            return None
        if requested_state not in (MavVtolState.MC, MavVtolState.FW) or px4.mode in _NO_TRANSITION:
            return MavResult.TEMPORARILY_REJECTED
        is_forward = requested_state == MavVtolState.FW
        if px4.vtol_state != requested_state:
            transition = MavVtolState.TRANSITION_TO_FW if is_forward else MavVtolState.TRANSITION_TO_MC
            px4.vtol_state = transition

            def finish() -> None:
                if px4.vtol_state == transition:  # No request has reversed the transition.
                    px4.vtol_state = requested_state

            px4.call_later(_TRANSITION_DURATION_S, finish)
        return MavResult.ACCEPTED

    def change_altitude(self, command: ReceivedCommand) -> int:
        result = self.change_to(modes.HOLD)
        if result == MavResult.ACCEPTED and math.isfinite(command.param1):
            flight = self._px4.flight
            north, east, _ = flight.target
            flight.target = (north, east, self._px4.frame.origin.altitude_m - command.param1)
        return result

    def terminate(self, command: ReceivedCommand) -> int:
        if command.param1 != 1.0 or not self._px4.is_armed:
            return MavResult.DENIED
        self._px4.terminate()
        return MavResult.ACCEPTED

    def change_speed(self, command: ReceivedCommand) -> int:
        if command.param2 > 0:
            self._px4.flight.speed_m_s = min(command.param2, self._px4.flight.top_speed_m_s)
        return MavResult.ACCEPTED

    def set_home(self, command: ReceivedCommand) -> int:
        px4, motion = self._px4, self._px4.motion
        uses_current_place = command.param1 > 0.5
        if uses_current_place:
            px4.home = motion.place
        elif not all(map(math.isfinite, (command.x, command.y, command.z))):
            return MavResult.DENIED
        else:
            north, east = px4.frame.to_local(*command.place())
            px4.home = (north, east, px4.frame.origin.altitude_m - command.z)
        px4.home_is_set_by_client = True
        return MavResult.ACCEPTED

    def run_prearm_checks(self, _: ReceivedCommand) -> int:
        self._px4.arming.report_reasons()
        return MavResult.ACCEPTED

    def reboot(self, command: ReceivedCommand) -> int:
        if command.param1 == 0.0:
            return MavResult.ACCEPTED
        if self._px4.is_armed or command.param1 not in (1.0, 2.0):
            return MavResult.DENIED
        action = self._px4.restart if command.param1 == 1.0 else self._px4.shut_down
        self._px4.call_later(_REBOOT_DELAY_S, action)  # later, so that the acknowledgement is still sent
        return MavResult.ACCEPTED


_NOT_ON_REQUEST = frozenset({m.MissionCurrent.ID, m.CurrentEventSequence.ID})
_ACKNOWLEDGED_ONLY = frozenset({m.Heartbeat.ID})


# The message that each of these older commands requests.
_LEGACY_REQUESTS = {
    Cmd.REQUEST_AUTOPILOT_CAPABILITIES: m.AutopilotVersion.ID,
    Cmd.REQUEST_PROTOCOL_VERSION: m.ProtocolVersion.ID,
    Cmd.REQUEST_STORAGE_INFORMATION: m.StorageInformation.ID,
    Cmd.REQUEST_FLIGHT_INFORMATION: m.FlightInformation.ID,
    Cmd.GET_HOME_POSITION: m.HomePosition.ID,
}


class _MessageRequests:
    """Handlers of the commands that request messages once or periodically."""

    def __init__(self, px4: Px4Vehicle) -> None:
        self._px4 = px4

    def send_now(self, message_id: int, command: ReceivedCommand) -> int:
        """Send a message before the acknowledgement."""
        message = None if message_id in _NOT_ON_REQUEST else self._px4.build(message_id)
        self._px4.rates.on_requested(command.channel, message_id)
        if message is None:
            return MavResult.DENIED
        if message_id not in _ACKNOWLEDGED_ONLY:
            self._px4.send(message, command.channel)
        return MavResult.ACCEPTED

    def request_message(self, command: ReceivedCommand) -> int:
        message_id = _number(command.param1)
        if message_id == m.MessageInterval.ID:
            return self._send_interval(_number(command.param2), command)
        if message_id != m.AvailableModes.ID:
            return self.send_now(message_id, command)
        index = _number(command.param2)
        messages = available_modes(self._px4)
        if not 0 <= index <= len(messages):
            return MavResult.DENIED
        for message in messages:
            if index in (0, message.mode_index):  # The index 0 selects all modes.
                self._px4.send(message, command.channel)
        return MavResult.ACCEPTED

    def set_interval(self, command: ReceivedCommand) -> int:
        message_id = _number(command.param1)
        return self._px4.rates.set_interval_us(command.channel, message_id, command.param2, self._px4.now)

    def get_interval(self, command: ReceivedCommand) -> int:
        return self._send_interval(_number(command.param1), command)

    def _send_interval(self, message_id: int, command: ReceivedCommand) -> int:
        interval_us = self._px4.rates.interval_us(command.channel, message_id)
        if 0 <= message_id < 1 << 16:
            self._px4.send(m.MessageInterval(message_id, interval_us), command.channel)
        return MavResult.ACCEPTED


def _number(value: float) -> int:
    return round(value) if abs(value) < 2**31 else -1
