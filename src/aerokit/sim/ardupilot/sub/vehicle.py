"""`SimulatedSub`: an ArduSub 4.7 with vectored thrusters, without sockets, threads or a clock of its own.

Beside it what it checks before arming and what it does by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Any, ClassVar

from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, MavSeverity, MavType, SpeedType, SubMode
from aerokit.sim.ardupilot.arming import Arming
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.level import SubTargets
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.radio import SubJoystick
from aerokit.sim.ardupilot.requests import DISPLAY_VALUES
from aerokit.sim.ardupilot.sub.host import SubHost
from aerokit.sim.ardupilot.sub.modes import SUB_MODES, SubAuto, SubGuided
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import Command, CommandHandler
from aerokit.sim.ground_motion import UnderwaterMotion
from aerokit.sim.motion import Motion, Wind

_BUTTONS = range(16)
_SHIFT, _ARM_TOGGLE, _DISARM = 1, 2, 4
"""BTNn_FUNCTION."""
_DISARMS = frozenset({_ARM_TOGGLE, _DISARM})


class SubArming(Arming):
    """Radio and battery only by default (ARMING_CHECK 448), a position never; a joystick button must disarm it."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        self._sub = sub

    def reasons(self) -> list[str]:
        if self._sub.is_initialised and not self._has_disarm_button():
            return ["Must assign a disarm or arm_toggle button or disarm aux function"]
        return super().reasons()

    def disarm(self, *, force: bool = True) -> bool:
        return super().disarm(force=True)

    def _has_disarm_button(self) -> bool:
        parameters = self._sub.parameters
        names = [f"BTN{number}_" for number in _BUTTONS if f"BTN{number}_FUNCTION" in parameters]
        plain = {int(parameters[f"{name}FUNCTION"]) for name in names}
        if not names or plain & _DISARMS:
            return True
        return _SHIFT in plain and any(int(parameters[f"{name}SFUNCTION"]) in _DISARMS for name in names)


_FAILSAFE_DISARM, _HOLD, _SURFACE = 2, 3, 4
"""FS_GCS_ENABLE; 1 only warns."""
_BATTERY_DISARM, _BATTERY_SURFACE = 2, 3
_PILOT_DISARM, _LEAK_SURFACE, _RADIO_SURFACE = 2, 2, 2
_GCS_WARNING_S, _LEAK_WARNING_S, _HULL_WARNING_S = 30.0, 20.0, 30.0
_HULL_PATIENCE_S = 2.0
_SILENT_S = 1.0
_STICKS, _STICK_MIDDLE = 6, 1500


class SubFailsafes(Failsafes):
    """Most act only while it is armed. Terrain, estimator and crash are not watched."""

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (_BATTERY_DISARM, _BATTERY_SURFACE, 1, 0)

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        self._sub = sub
        self.pilot: bool = False
        """Whether nobody steers: neither pulses nor MANUAL_CONTROL for FS_PILOT_TIMEOUT."""
        self.leak: bool = False
        self.pressure: _HullLimit = _HullLimit("pressure", "FS_PRESS")
        self.temperature: _HullLimit = _HullLimit("temperature", "FS_TEMP")
        self._gcs_warned_at = self._leak_warned_at = -math.inf

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state; the radio alone is none."""
        hull = self.pressure.is_exceeded or self.temperature.is_exceeded
        return self.pilot or self.battery_is_low or self.ground_station or self.leak or hull

    def watch(self) -> None:
        self._watch_radio()
        self._watch_pilot()
        self._watch_ground_station()
        self._watch_leak()
        inside = self._sub.hull_pressure_pa, self._sub.hull_temperature_c
        for limit, value in zip((self.pressure, self.temperature), inside, strict=True):
            limit.watch(self._sub, value)
        super().watch()

    def _watch_radio(self) -> None:
        """FS_THR_ENABLE: 1 warns, 2 surfaces."""
        sub, enabled = self._sub, int(self._sub.parameters["FS_THR_ENABLE"])
        hears = sub.rc.is_heard
        if hears:
            self.radio_heard_at: float = sub.now
        low = hears and sub.rc[2] < sub.parameters["FS_THR_VALUE"]
        lost = low or sub.now - self.radio_heard_at >= _SILENT_S
        if not enabled:
            lost = False
        elif not hears and not lost:
            return
        if lost == self.radio:
            return
        self.radio = lost
        self.say("RC Failsafe" if lost else "Radio Failsafe Cleared")
        if lost and enabled == _RADIO_SURFACE:
            sub.set_mode(SubMode.SURFACE)

    def _watch_pilot(self) -> None:
        sub, enabled = self._sub, int(self._sub.parameters["FS_PILOT_INPUT"])
        silence = sub.now - self.radio_heard_at
        if not enabled or not silence >= sub.parameters["FS_PILOT_TIMEOUT"]:
            self.pilot = False
            return
        if self.pilot:
            return
        self.pilot = True
        self.say("Lost manual control", MavSeverity.CRITICAL)
        for index in range(_STICKS):
            sub.rc[index] = _STICK_MIDDLE
        if enabled == _PILOT_DISARM:
            sub.arming.disarm()

    def _watch_ground_station(self) -> None:
        sub, action = self._sub, int(self._sub.parameters["FS_GCS_ENABLE"])
        if not action or math.isnan(self.ground_station_seen_at):
            return
        if self.ground_station_silence < sub.parameters["FS_GCS_TIMEOUT"]:
            if self.ground_station:
                self.ground_station = False
                self.say("GCS Failsafe Cleared")
            return
        if sub.now - self._gcs_warned_at > _GCS_WARNING_S:
            self._gcs_warned_at = sub.now
            self.say(f"MYGCS: {int(sub.parameters['MAV_GCS_SYSID'])}, heartbeat lost")
        if self.ground_station or not sub.is_armed:
            return
        self.ground_station: bool = True
        modes = {_HOLD: SubMode.ALT_HOLD, _SURFACE: SubMode.SURFACE}
        if action == _FAILSAFE_DISARM or (action in modes and not sub.set_mode(modes[action])):
            sub.arming.disarm()

    def act_on_battery(self, action: int) -> None:
        if action == _BATTERY_SURFACE:
            self._sub.set_mode(SubMode.SURFACE)
        elif action == _BATTERY_DISARM:
            self._sub.arming.disarm()

    def _watch_leak(self) -> None:
        sub, action = self._sub, int(self._sub.parameters["FS_LEAK_ENABLE"])
        if not sub.faults.leak or not action:
            self.leak = False
            return
        if sub.now - self._leak_warned_at > _LEAK_WARNING_S:
            self._leak_warned_at = sub.now
            self.say("Leak Detected", MavSeverity.CRITICAL)
        if not self.leak:
            self.leak = True
            if action == _LEAK_SURFACE and sub.is_armed:
                sub.set_mode(SubMode.SURFACE)


class _HullLimit:
    """Two seconds above FS_PRESS_MAX (Pa) or FS_TEMP_MAX (°C) are too much; it is told every 30 s."""

    def __init__(self, what: str, prefix: str) -> None:
        self.is_exceeded: bool = False
        self._what, self._prefix = what, prefix
        self._good_at = self._warned_at = 0.0

    def watch(self, sub: SubHost, value: float) -> None:
        if not sub.parameters[f"{self._prefix}_ENABLE"]:
            return
        if value < sub.parameters[f"{self._prefix}_MAX"]:
            self._good_at = self._warned_at = sub.now
            self.is_exceeded = False
            return
        if sub.now - self._good_at > _HULL_PATIENCE_S:
            self.is_exceeded = True
        if self.is_exceeded and sub.now - self._warned_at > _HULL_WARNING_S:
            self._warned_at = sub.now
            sub.send_text(MavSeverity.WARNING, f"Internal {self._what} critical!")


_GUIDED_MODES = frozenset({"AUTO", "GUIDED", "CIRCLE", "POSHOLD"})
_BASE = MavModeFlag.CUSTOM_MODE_ENABLED | MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED
_HOLDING_THROTTLE, _PER_CLIMB = 0.45, 0.44
_AMPERES_AT_FULL = 26.3
_STICK_COUNT, _THROTTLE = 8, 2


class _Motors(Motors):
    """The thrusters that hold the depth, or follow the stick; 0.5 is no thrust at all."""

    def __init__(self, sub: SubHost) -> None:
        super().__init__()
        self._sub = sub

    @property
    def current_a(self) -> float:
        thrust = abs(2.0 * self.throttle - 1.0) if self._follows_stick else self.throttle
        return float(thrust**2.7) * _AMPERES_AT_FULL

    @property
    def _follows_stick(self) -> bool:
        return self._sub.mode.has_manual_throttle

    def update(self, now: float, dt: float, motion: Motion, *, landed: bool) -> None:
        wanted = _HOLDING_THROTTLE - _PER_CLIMB * motion.velocity_down
        if self._follows_stick:
            wanted = (self._sub.rc[_THROTTLE] - 1000) / 1000.0
        self.throttle = max(0.0, min(1.0, wanted)) if self.is_armed else 0.0


class SimulatedSub(SubHost):
    """Speaks and behaves as ArduSub does where a client can see it; moves as `UnderwaterMotion` does.

    Its arguments are those of `ArduPilotVehicle`; ``home`` is at the surface, so altitudes above home are negative.
    It has 1,386 parameters. Simulated: MANUAL, STABILIZE, ACRO, ALT_HOLD and POSHOLD by the sticks, GUIDED, AUTO and
    SURFACE; it can be armed without a position in the modes that need none. Take-off is an unknown command.

    Not simulated yet: CIRCLE, SURFTRAK and MOTORDETECT (they hold still), currents. Waking up after a
    reboot it is at the surface.
    """

    KIND: ClassVar[Kind] = "sub"
    FIRMWARE: ClassVar[str] = "ArduSub"
    MAV_TYPE: ClassVar[int] = MavType.SUBMARINE
    CAPABILITIES: ClassVar[int] = 0xF9E7
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["sub"]
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]] = SUB_MODES
    FAILSAFES: ClassVar[type[Failsafes]] = SubFailsafes

    def make_motion(self, wind: Wind | None) -> UnderwaterMotion:
        """SIM_BUOYANCY 1 lifts it with 0.1 m/s; wind does not reach it."""
        return UnderwaterMotion(self.rng, buoyancy_m_s2=self.parameters["SIM_BUOYANCY"] / 10.0)

    def make_motors(self) -> Motors:
        return _Motors(self)

    def make_arming(self) -> Arming:
        return SubArming(self)

    def hear_setpoints(self) -> None:
        SubTargets(self, self.guided)

    def make_joystick(self) -> SubJoystick:
        return SubJoystick(self)

    def reset_controllers(self) -> None:
        """All sticks rest in the middle."""
        self.display_names: cycle[str] = cycle(DISPLAY_VALUES)
        for index in range(_STICK_COUNT):
            self.rc[index] = 1500

    @property
    def first_mode(self) -> int:
        return SubMode.MANUAL

    @property
    def is_landed(self) -> bool:
        """What STANDBY in the heartbeat means here: disarmed."""
        return not self.motors.is_armed

    @is_landed.setter
    def is_landed(self, _: bool) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """It never is."""

    @property
    def guided(self) -> SubGuided:
        return self.mode_of(SubGuided)

    @property
    def auto(self) -> SubAuto:
        return self.mode_of(SubAuto)

    @property
    def base_mode(self) -> int:
        """Guided in the modes that know where they are."""
        base = int(_BASE)
        if self.mode.name in _GUIDED_MODES:
            base |= MavModeFlag.GUIDED_ENABLED
        return base | MavModeFlag.SAFETY_ARMED if self.motors.is_armed else base

    @property
    def is_at_rest(self) -> bool:
        return self.motion.is_still

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        """Why a mode is not entered."""
        if reason == "requires position":
            return f"Mode change failed: {mode.name} requires position"
        return f"Flight mode change failed {mode.name}"

    def own_commands(self) -> dict[int, CommandHandler]:
        """LAND is the surface, LOITER_UNLIM holds the place; there is no way home by command."""
        return {
            MavCmd.DO_CHANGE_SPEED: self._change_speed_at_any_time,
            MavCmd.NAV_LAND: lambda _: self.change_to(SubMode.SURFACE),
            MavCmd.NAV_LOITER_UNLIM: lambda _: self.change_to(SubMode.POSHOLD),
            MavCmd.CONDITION_YAW: self._turn,
        }

    def _change_speed_at_any_time(self, command: Command) -> int:
        """Also in modes that have no use for it."""
        if not command.param2 > 0 or command.param1 not in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED):
            return MavResult.DENIED
        if isinstance(self.mode, SubGuided | SubAuto):
            self.mode.speed = command.param2
        return MavResult.ACCEPTED

    def _turn(self, command: Command) -> int:
        angle, relative = command.param1, command.param4
        if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
            return MavResult.FAILED
        if self.mode is not self.guided:
            return MavResult.ACCEPTED
        heading = math.radians(angle)
        if relative:
            heading = self.motion.yaw + math.copysign(heading, command.param3 or 1.0)
        self.guided.face(heading)
        return MavResult.ACCEPTED
