"""`SimulatedSub`: an ArduSub 4.7 with vectored thrusters that uses no sockets, threads or system clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Any, ClassVar

from aerokit.mavlink.enums import MavCmd, MavModeFlag, MavResult, MavSeverity, MavType, SpeedType, SubMode
from aerokit.sim.ardupilot.commands import commanded_heading
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes
from aerokit.sim.ardupilot.host import RC_THROTTLE, ArduPilotMode, ArduPilotMotors
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.radio import ArduPilotJoystick, SubJoystick
from aerokit.sim.ardupilot.requests import DISPLAY_VALUES
from aerokit.sim.ardupilot.sub_modes import SUB_MODES, SubAuto, SubGuided, SubHost
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND, Builders
from aerokit.sim.commands import CommandHandler, ReceivedCommand
from aerokit.sim.motion import SimulatedWind
from aerokit.sim.vehicle_motion import UnderwaterMotion

_BUTTONS = range(16)
# Values of the parameters BTNn_FUNCTION.
_SHIFT, _ARM_TOGGLE, _DISARM = 1, 2, 4
_DISARMS = frozenset({_ARM_TOGGLE, _DISARM})


class SubArming(ArduPilotArming[SubHost]):
    """ArduSub's arming checks. By default, they do not require a position."""

    ARMED_TEXT: ClassVar[str] = "Arming motors"
    DISARMED_TEXT: ClassVar[str] = "Disarming motors"

    def reasons(self) -> list[str]:
        if self.vehicle.is_initialised and not self._has_disarm_button():
            return ["Must assign a disarm or arm_toggle button or disarm aux function"]
        return super().reasons()

    def _has_disarm_button(self) -> bool:
        parameters = self.vehicle.parameters
        prefixes = [f"BTN{number}_" for number in _BUTTONS if f"BTN{number}_FUNCTION" in parameters]
        functions = {int(parameters[f"{prefix}FUNCTION"]) for prefix in prefixes}
        if not prefixes or functions & _DISARMS:  # A vehicle without parameters of buttons passes the check.
            return True
        return _SHIFT in functions and any(int(parameters[f"{prefix}SFUNCTION"]) in _DISARMS for prefix in prefixes)


# Values of FS_GCS_ENABLE. The value 1 only warns.
_FAILSAFE_DISARM, _HOLD, _SURFACE = 2, 3, 4
_GCS_MODES = {_HOLD: SubMode.ALT_HOLD, _SURFACE: SubMode.SURFACE}
_BATTERY_NONE, _BATTERY_WARN, _BATTERY_DISARM, _BATTERY_SURFACE = range(4)  # the battery actions
# Values of FS_PILOT_INPUT, FS_LEAK_ENABLE and FS_THR_ENABLE.
_PILOT_DISARM, _LEAK_SURFACE, _RADIO_SURFACE = 2, 2, 2
_GCS_REPORT_INTERVAL_S, _LEAK_REPORT_INTERVAL_S, _HULL_REPORT_INTERVAL_S = 30.0, 20.0, 30.0
_HULL_TIMEOUT_S = 2.0
_RADIO_TIMEOUT_S = 1.0
_STICKS, _STICK_MIDDLE = 6, 1500


class SubFailsafes(ArduPilotFailsafes[SubHost]):
    """ArduSub's failsafes, except those of terrain, estimator and crash. Most of them act only while armed."""

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = (_BATTERY_DISARM, _BATTERY_SURFACE, _BATTERY_WARN, _BATTERY_NONE)

    def __init__(self, sub: SubHost) -> None:
        super().__init__(sub)
        # True while neither RC pulses nor MANUAL_CONTROL have arrived for FS_PILOT_TIMEOUT.
        self.is_pilot_lost: bool = False
        self.is_leak_detected: bool = False
        self.pressure: _HullLimit = _HullLimit("pressure", "FS_PRESS")
        self.temperature: _HullLimit = _HullLimit("temperature", "FS_TEMP")
        self._gcs_reported_at = self._leak_reported_at = -math.inf

    @property
    def is_any_active(self) -> bool:
        # On Sub, a lost radio does not cause MAV_STATE_CRITICAL.
        hull = self.pressure.is_exceeded or self.temperature.is_exceeded
        return self.is_pilot_lost or self.battery_is_low or self.is_ground_station_lost or self.is_leak_detected or hull

    def update(self) -> None:
        self._check_radio()
        self._check_pilot()
        self._check_ground_station()
        self._check_leak()
        self.pressure.update(self.vehicle, self.vehicle.hull_pressure_pa)
        self.temperature.update(self.vehicle, self.vehicle.hull_temperature_c)
        super().update()

    def _check_radio(self) -> None:
        sub, enabled = self.vehicle, int(self.vehicle.parameters["FS_THR_ENABLE"])
        is_receiving = sub.rc.is_receiving
        if is_receiving:
            self.radio_received_at: float = sub.now
        is_throttle_low = is_receiving and sub.rc[RC_THROTTLE] < sub.parameters["FS_THR_VALUE"]
        is_lost = is_throttle_low or sub.now - self.radio_received_at >= _RADIO_TIMEOUT_S
        if not enabled:
            is_lost = False
        elif not is_receiving and not is_lost:  # A silence below `_RADIO_TIMEOUT_S` changes nothing.
            return
        if is_lost == self.is_radio_lost:
            return
        self.is_radio_lost = is_lost
        self.warn("RC Failsafe" if is_lost else "Radio Failsafe Cleared")
        if is_lost and enabled == _RADIO_SURFACE:
            sub.set_mode(SubMode.SURFACE)

    def _check_pilot(self) -> None:
        sub, enabled = self.vehicle, int(self.vehicle.parameters["FS_PILOT_INPUT"])
        silence = sub.now - self.radio_received_at
        is_silent = silence >= sub.parameters["FS_PILOT_TIMEOUT"]  # False before the first input (NaN).
        if not enabled or not is_silent:
            self.is_pilot_lost = False
            return
        if self.is_pilot_lost:
            return
        self.is_pilot_lost = True
        self.warn("Lost manual control", MavSeverity.CRITICAL)
        for index in range(_STICKS):  # Center the sticks, so that their last positions no longer move the vehicle.
            sub.rc[index] = _STICK_MIDDLE
        if enabled == _PILOT_DISARM:
            sub.arming.disarm()

    def _check_ground_station(self) -> None:
        sub, action = self.vehicle, int(self.vehicle.parameters["FS_GCS_ENABLE"])
        if not action or math.isnan(self.vehicle.ground_station_seen_at):
            return
        if self.ground_station_silence < sub.parameters["FS_GCS_TIMEOUT"]:
            if self.is_ground_station_lost:
                self.is_ground_station_lost = False
                self.warn("GCS Failsafe Cleared")
            return
        if sub.now - self._gcs_reported_at > _GCS_REPORT_INTERVAL_S:
            self._gcs_reported_at = sub.now
            self.warn(f"MYGCS: {int(sub.parameters['MAV_GCS_SYSID'])}, heartbeat lost")
        if self.is_ground_station_lost or not sub.is_armed:
            return
        self.is_ground_station_lost: bool = True
        must_disarm = action == _FAILSAFE_DISARM
        if action in _GCS_MODES:
            is_entered = sub.set_mode(_GCS_MODES[action])
            must_disarm = not is_entered
        if must_disarm:
            sub.arming.disarm()

    def act_on_battery(self, action: int) -> None:
        if action == _BATTERY_SURFACE:
            self.vehicle.set_mode(SubMode.SURFACE)
        elif action == _BATTERY_DISARM:
            self.vehicle.arming.disarm()

    def _check_leak(self) -> None:
        sub, action = self.vehicle, int(self.vehicle.parameters["FS_LEAK_ENABLE"])
        if not sub.faults.leak or not action:
            self.is_leak_detected = False
            return
        if sub.now - self._leak_reported_at > _LEAK_REPORT_INTERVAL_S:
            self._leak_reported_at = sub.now
            self.warn("Leak Detected", MavSeverity.CRITICAL)
        if not self.is_leak_detected:  # Surface only once, so that the pilot can change the mode afterwards.
            self.is_leak_detected = True
            if action == _LEAK_SURFACE and sub.is_armed:
                sub.set_mode(SubMode.SURFACE)


class _HullLimit:
    """A limit of the hull, FS_PRESS_MAX (Pa) or FS_TEMP_MAX (°C).

    The failsafe triggers when the limit was exceeded for two seconds, and then warns every 30 s.
    """

    def __init__(self, quantity: str, prefix: str) -> None:
        self.is_exceeded: bool = False
        self._quantity, self._prefix = quantity, prefix
        self._good_at = 0.0  # last time at which the value was below the limit
        self._reported_at = 0.0

    def update(self, sub: SubHost, value: float) -> None:
        if not sub.parameters[f"{self._prefix}_ENABLE"]:
            return
        if value < sub.parameters[f"{self._prefix}_MAX"]:
            self._good_at = sub.now
            self._reported_at = sub.now  # The interval also delays the first warning.
            self.is_exceeded = False
            return
        if sub.now - self._good_at > _HULL_TIMEOUT_S:
            self.is_exceeded = True
        if self.is_exceeded and sub.now - self._reported_at > _HULL_REPORT_INTERVAL_S:
            self._reported_at = sub.now
            sub.send_text(MavSeverity.WARNING, f"Internal {self._quantity} critical!")


_HOLDING_THROTTLE, _THROTTLE_PER_CLIMB_M_S = 0.45, 0.44
_AMPERES_AT_FULL = 26.3


class SubMotors(ArduPilotMotors):
    """The thrusters, which hold the depth or follow the throttle stick. At a throttle of 0.5 they do not push."""

    @property
    def current_a(self) -> float:
        follows_stick = self.is_armed and self.vehicle.mode.has_manual_throttle
        thrust = abs(2.0 * self.throttle - 1.0) if follows_stick else self.throttle
        return float(thrust**2.7) * _AMPERES_AT_FULL

    def update(self, dt: float, *, landed: bool) -> None:
        throttle = _HOLDING_THROTTLE - _THROTTLE_PER_CLIMB_M_S * self.vehicle.motion.velocity_down
        if self.vehicle.mode.has_manual_throttle:
            throttle = (self.vehicle.rc[RC_THROTTLE] - 1000) / 1000.0
        self.throttle: float = max(0.0, min(1.0, throttle)) if self.is_armed else 0.0


_BASE = MavModeFlag.CUSTOM_MODE_ENABLED | MavModeFlag.STABILIZE_ENABLED | MavModeFlag.MANUAL_INPUT_ENABLED


class SimulatedSub(SubHost):
    """ArduSub, as far as a client can observe it. `UnderwaterMotion` is the motion model.

    Takes the arguments of `ArduPilotVehicle`. ``home`` is at the surface, so altitudes above home are negative. The
    vehicle has 1,386 parameters. Simulated modes: MANUAL, STABILIZE, ACRO, ALT_HOLD and POSHOLD (driven by the
    sticks), GUIDED, AUTO and SURFACE. By default, the vehicle can be armed without a position. Take-off is UNSUPPORTED.

    CIRCLE, SURFTRAK and MOTORDETECT behave like ALT_HOLD. Currents are not simulated. A reboot moves the vehicle to
    the surface.
    """

    guided: SubGuided  # pyright: ignore[reportIncompatibleVariableOverride]

    KIND: ClassVar[Kind] = "sub"
    FIRMWARE: ClassVar[str] = "ArduSub"
    MAV_TYPE: ClassVar[int] = MavType.SUBMARINE
    BASE_FLAGS: ClassVar[int] = int(_BASE)
    GUIDED_MODES: ClassVar[frozenset[str]] = frozenset({"AUTO", "GUIDED", "CIRCLE", "POSHOLD"})
    CAPABILITIES: ClassVar[int] = 0xF9E7
    BUILDERS: ClassVar[Builders] = BUILDERS_OF_KIND["sub"]
    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]] = SUB_MODES
    ARMING: ClassVar[type[ArduPilotArming[Any]]] = SubArming
    FAILSAFES: ClassVar[type[ArduPilotFailsafes[Any]]] = SubFailsafes
    MOTORS: ClassVar[type[ArduPilotMotors]] = SubMotors
    JOYSTICK: ClassVar[type[ArduPilotJoystick]] = SubJoystick

    def make_motion(self, wind: SimulatedWind | None) -> UnderwaterMotion:
        """Create the motion model. Each unit of SIM_BUOYANCY accelerates upwards by 0.1 m/s². Wind has no effect."""
        return UnderwaterMotion(self.rng, buoyancy_m_s2=self.parameters["SIM_BUOYANCY"] / 10.0)

    def reset_controllers(self) -> None:
        self.display_names: cycle[str] = cycle(DISPLAY_VALUES)
        for index in range(len(self.rc)):
            self.rc[index] = _STICK_MIDDLE

    @property
    def first_mode(self) -> int:
        return SubMode.MANUAL

    @property
    def is_standby(self) -> bool:
        return not self.motors.is_armed

    def refusal_text(self, mode: ArduPilotMode, reason: str) -> str:
        if reason == "requires position":
            return f"Mode change failed: {mode.name} requires position"
        return f"Flight mode change failed {mode.name}"

    def make_commands(self) -> dict[int, CommandHandler]:
        return {
            **super().make_commands(),
            MavCmd.DO_CHANGE_SPEED: self._change_speed_at_any_time,
            MavCmd.NAV_LAND: lambda _: self.change_to(SubMode.SURFACE),
            MavCmd.NAV_LOITER_UNLIM: lambda _: self.change_to(SubMode.POSHOLD),
            MavCmd.CONDITION_YAW: self._turn,
        }

    def _change_speed_at_any_time(self, command: ReceivedCommand) -> int:
        if not command.param2 > 0 or command.param1 not in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED):
            return MavResult.DENIED
        # Every mode accepts a speed, although only GUIDED and AUTO use it.
        if isinstance(self.mode, SubGuided | SubAuto):
            self.mode.speed = command.param2
        return MavResult.ACCEPTED

    def _turn(self, command: ReceivedCommand) -> int:
        heading = commanded_heading(command, self.motion.yaw)
        if heading is None:
            return MavResult.FAILED
        if self.mode is self.guided:
            self.guided.face(heading)
        return MavResult.ACCEPTED
