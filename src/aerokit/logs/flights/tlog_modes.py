"""Attributes the mode changes of a recording to the commands that it contains."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import defaultdict
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd

if TYPE_CHECKING:
    from aerokit.autopilots import Autopilot
    from aerokit.logs.flights.flight import FlightLog, ModeChange

# A mode change counts as commanded if it happens within this time after a command that changes to the mode.
_COMMAND_MAX_AGE_S = 5.0
_ANY_MODE = ""
_MODE_COMMANDS = frozenset(
    (
        MavCmd.DO_SET_MODE,
        MavCmd.NAV_RETURN_TO_LAUNCH,
        MavCmd.NAV_LAND,
        MavCmd.NAV_TAKEOFF,
        MavCmd.MISSION_START,
        MavCmd.DO_REPOSITION,
        MavCmd.NAV_LOITER_UNLIM,
    )
)


class RecordedModeCommands:
    """The commands of a recording that change the vehicle's mode."""

    def __init__(self, flight: FlightLog, autopilot: Autopilot) -> None:
        self._flight, self._autopilot = flight, autopilot
        # Maps a mode to the times of commands that may change to this mode. The key _ANY_MODE is for commands that may
        # change to any mode.
        self._command_times: dict[str, list[float]] = defaultdict(list)
        self.has_commands: bool = False
        """True if the recording contains any command to the vehicle."""

    def on_command(self, time_s: float, message: m.CommandLong | m.CommandInt) -> None:
        if message.target_system in (0, self._flight.system_id):
            self.has_commands = True
            if message.command in _MODE_COMMANDS:
                params = (message.param1, message.param2, message.param3, message.param4)
                names = [mode.name for mode in self._autopilot.modes_of_command(message.command, params)]
                for name in names or [_ANY_MODE]:
                    self._command_times[name].append(time_s)

    def on_set_mode(self, time_s: float, message: m.SetMode) -> None:
        if message.target_system in (0, self._flight.system_id):
            self.has_commands = True
            mode = self._autopilot.mode(message.custom_mode, message.base_mode)
            self._command_times[mode.name].append(time_s)

    def attribute_modes(self, speed: float) -> None:
        """Mark the mode changes that were commanded. ``speed`` is the vehicle's seconds in a recorded second."""
        for times in self._command_times.values():
            times.sort()
        changes: list[ModeChange] = []
        for change in self._flight.modes:
            age_s = min(self._command_age_s(change, _ANY_MODE), self._command_age_s(change, change.name))
            # `age_s` is in recorded seconds, _COMMAND_MAX_AGE_S in the vehicle's. In a fast simulation, they differ.
            is_commanded = age_s * speed < _COMMAND_MAX_AGE_S
            changes.append(change.replace(reason="ordered", by_autopilot=False) if is_commanded else change)
        self._flight.modes = changes

    def _command_age_s(self, change: ModeChange, mode: str) -> float:
        """Return the seconds from the last order of ``mode`` to the change; infinity if ``mode`` was not ordered."""
        times = self._command_times.get(mode, [])
        index = bisect_right(times, change.time_s)
        return change.time_s - times[index - 1] if index else math.inf
