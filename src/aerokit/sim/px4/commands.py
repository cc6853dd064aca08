"""The commands (MAV_CMD) that a simulated PX4 knows, with the real one's answers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, MavSeverity
from aerokit.mavlink.messages import AutopilotVersion, AvailableModes, HomePosition, MessageInterval
from aerokit.sim.commands import Command, CommandHandler, Progress
from aerokit.sim.px4.modes import HOLD, KNOWN, LAND, MISSION, RTL, TAKEOFF, Px4Mode
from aerokit.sim.px4.telemetry import BUILDERS, DEFAULT_RATES_HZ, available_modes

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["px4_commands"]

_FORCE = 21196.0
_AUTOTUNE_PERCENTS = (0, 20, 40, 60, 80, 95)


def px4_commands(px4: SimulatedPx4) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    flight, link = _Flight(px4), _Requests(px4)
    return {
        MavCmd.COMPONENT_ARM_DISARM: flight.arm_or_disarm,
        MavCmd.DO_SET_MODE: flight.set_mode,
        MavCmd.NAV_TAKEOFF: flight.take_off,
        MavCmd.NAV_LAND: flight.land,
        MavCmd.NAV_RETURN_TO_LAUNCH: flight.return_to_launch,
        MavCmd.DO_REPOSITION: flight.reposition,
        MavCmd.DO_CHANGE_SPEED: flight.change_speed,
        MavCmd.MISSION_START: flight.start_mission,
        MavCmd.DO_SET_HOME: flight.set_home,
        MavCmd.DO_AUTOTUNE_ENABLE: lambda _: Progress(_AUTOTUNE_PERCENTS, 2.0),
        MavCmd.PREFLIGHT_CALIBRATION: flight.calibrate,
        MavCmd.RUN_PREARM_CHECKS: flight.run_prearm_checks,
        MavCmd.PREFLIGHT_REBOOT_SHUTDOWN: flight.reboot,
        MavCmd.REQUEST_MESSAGE: link.request_message,
        MavCmd.SET_MESSAGE_INTERVAL: link.set_interval,
        MavCmd.GET_MESSAGE_INTERVAL: link.get_interval,
        MavCmd.REQUEST_AUTOPILOT_CAPABILITIES: lambda c: link.send_now(AutopilotVersion.ID, c),
        MavCmd.GET_HOME_POSITION: lambda c: link.send_now(HomePosition.ID, c),
    }


class _Flight:
    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4

    def arm_or_disarm(self, command: Command) -> int:
        force = command.param2 == _FORCE
        if round(command.param1) == 1:
            done = self._px4.arm()  # external commands are always checked, by force or not
        elif round(command.param1) == 0:
            done = self._px4.disarm("external command", force=force)
        else:
            self._px4.send_text(MavSeverity.CRITICAL, f"Unsupported ARM_DISARM param: {command.param1:.3f}")
            return MavResult.UNSUPPORTED
        return MavResult.ACCEPTED if done else MavResult.TEMPORARILY_REJECTED

    def set_mode(self, command: Command) -> int:
        """Two answers: the link's own, which is always ACCEPTED, and the real one."""
        self._px4.commands.answer(command, MavResult.ACCEPTED)
        return self.set_mode_numbers(int(command.param1), (int(command.param2), int(command.param3)))

    def set_mode_numbers(self, base_mode: int, mode: Px4Mode) -> int:
        if not base_mode & MavModeFlag.CUSTOM_MODE_ENABLED:
            return MavResult.TEMPORARILY_REJECTED
        if mode[0] == 4 and mode[1] == 0:
            mode = MISSION
        if mode not in KNOWN:
            return self._refuse_unknown(mode)
        return MavResult.ACCEPTED if self._px4.change_mode(mode) else MavResult.TEMPORARILY_REJECTED

    def _refuse_unknown(self, mode: Px4Mode) -> int:
        what = "auto" if mode[0] == 4 else "main"
        self._px4.send_text(MavSeverity.CRITICAL, f"Unsupported {what} mode")
        return MavResult.ACCEPTED if self._px4.accepts_unknown_modes else MavResult.TEMPORARILY_REJECTED

    def _change(self, mode: Px4Mode, text: str = "") -> int:
        if not self._px4.change_mode(mode):
            self._px4.send_text(
                MavSeverity.CRITICAL, f"Switching to {KNOWN[mode]} is currently not available"
            )
            return MavResult.TEMPORARILY_REJECTED
        if text:
            self._px4.info(text)
        return MavResult.ACCEPTED

    def take_off(self, command: Command) -> int:
        """``param7`` is AMSL; without it MIS_TAKEOFF_ALT above home counts."""
        result = self._change(TAKEOFF)
        if result == MavResult.ACCEPTED:
            px4 = self._px4
            down = px4.frame.origin.altitude_m - command.z
            if not math.isfinite(command.z):
                altitude = px4.parameters["MIS_TAKEOFF_ALT"]
                down = px4.home[2] - altitude
                px4.info(f"Using default takeoff altitude: {altitude:.1f} m")
            px4.flight.target = (px4.motion.north, px4.motion.east, down)
        return result

    def land(self, _: Command) -> int:
        return self._change(LAND, "Landing at current position")

    def return_to_launch(self, _: Command) -> int:
        return self._change(RTL, "Returning to launch")

    def start_mission(self, command: Command) -> int:
        """Changes the mode and arms."""
        px4 = self._px4
        if not px4.mission.is_valid:
            px4.send_text(MavSeverity.CRITICAL, "Mission start denied! No valid mission")
            return MavResult.DENIED
        if not -1 <= command.param1 < px4.mission.count:
            return MavResult.DENIED
        result = self._change(MISSION)
        if result == MavResult.ACCEPTED and not px4.arm():
            return MavResult.TEMPORARILY_REJECTED
        return result

    def reposition(self, command: Command) -> int:
        """Latitude and longitude NaN (INT32_MAX) keep the place, altitude NaN the height; altitude is AMSL."""
        if int(command.param2) != 1:
            return MavResult.UNSUPPORTED
        result = self._change(HOLD)
        if result != MavResult.ACCEPTED:
            return result
        if self._px4.failsafes.fence.allows(self._destination(command)):
            self._go_to(command)
        else:
            self._px4.send_text(MavSeverity.CRITICAL, "Reposition is outside geofence")
        return result

    def _destination(self, command: Command) -> tuple[float, float, float]:
        px4, motion = self._px4, self._px4.motion
        north, east, down = motion.north, motion.east, motion.down
        keeps_place = 0x7FFFFFFF in (command.x, command.y) or not math.isfinite(command.x + command.y)
        if not keeps_place:
            north, east = px4.frame.to_local(*command.place())
        if math.isfinite(command.z):
            down = px4.frame.origin.altitude_m - command.z
        return (north, east, down)

    def _go_to(self, command: Command) -> None:
        px4 = self._px4
        px4.flight.target = self._destination(command)
        px4.flight.heading = command.param4 if math.isfinite(command.param4) else None
        if command.param1 > 0:
            px4.flight.speed_m_s = command.param1

    def change_speed(self, command: Command) -> int:
        if command.param2 > 0:
            self._px4.flight.speed_m_s = min(command.param2, self._px4.flight.top_speed_m_s)
        return MavResult.ACCEPTED

    def set_home(self, command: Command) -> int:
        px4, motion = self._px4, self._px4.motion
        if command.param1 > 0.5:
            px4.home = (motion.north, motion.east, motion.down)
        elif not math.isfinite(command.x + command.y + command.z):
            return MavResult.DENIED
        else:
            north, east = px4.frame.to_local(*command.place())
            px4.home = (north, east, px4.frame.origin.altitude_m - command.z)
        px4.home_is_set_by_hand = True
        return MavResult.ACCEPTED

    def calibrate(self, _: Command) -> int:
        """Answered at once; the progress is in the texts."""
        px4 = self._px4
        if px4.is_armed:
            return MavResult.TEMPORARILY_REJECTED
        for number, percent in enumerate((0, 40, 80, 100)):
            px4.call_later(number * 0.5, lambda percent=percent: px4.info(f"[cal] progress <{percent}>"))  # type: ignore[misc]
        px4.call_later(2.0, lambda: px4.info("[cal] calibration done: gyro"))
        return MavResult.ACCEPTED

    def run_prearm_checks(self, _: Command) -> int:
        self._px4.report_reasons()
        return MavResult.ACCEPTED

    def reboot(self, command: Command) -> int:
        if self._px4.is_armed:
            return MavResult.TEMPORARILY_REJECTED
        if command.param1 != 1.0:
            return MavResult.DENIED
        self._px4.call_later(0.2, self._px4.restart)
        return MavResult.ACCEPTED


class _Requests:
    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4

    def send_now(self, message_id: int, command: Command) -> int:
        """The message goes out before its acknowledgement; DENIED when there is none."""
        builder = BUILDERS.get(message_id)
        message = None if builder is None else builder(self._px4)
        if message is None:
            return MavResult.DENIED
        self._px4.send(message, command.channel)
        return MavResult.ACCEPTED

    def request_message(self, command: Command) -> int:
        message_id = round(command.param1)
        if message_id == MessageInterval.ID:
            return self._send_interval(round(command.param2), command)
        if message_id != AvailableModes.ID:
            return self.send_now(message_id, command)
        modes, index = available_modes(self._px4), round(command.param2)
        for message in modes if index == 0 else modes[index - 1 : index]:
            self._px4.send(message, command.channel)
        return MavResult.ACCEPTED if index <= len(modes) else MavResult.DENIED

    def set_interval(self, command: Command) -> int:
        message_id, interval_us = round(command.param1), command.param2
        if message_id not in BUILDERS:
            return MavResult.FAILED
        interval = max(0.0, interval_us) / 1e6
        if interval_us == 0.0:
            rate = DEFAULT_RATES_HZ.get(message_id, 0.0)
            interval = 1.0 / rate if rate else 0.0
        command.channel.streams.set_interval(message_id, interval, self._px4.now)
        return MavResult.ACCEPTED

    def get_interval(self, command: Command) -> int:
        return self._send_interval(round(command.param1), command)

    def _send_interval(self, message_id: int, command: Command) -> int:
        interval_us = round(command.channel.streams.interval(message_id) * 1e6) or (
            -1 if message_id in BUILDERS else 0
        )
        if 0 <= message_id < 1 << 16:
            self._px4.send(MessageInterval(message_id, interval_us), command.channel)
        return MavResult.ACCEPTED
