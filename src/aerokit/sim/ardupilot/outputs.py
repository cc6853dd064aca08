"""What a simulated ArduPilot drives: its motors, servos, relays and switches."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavResult, MavSeverity
from aerokit.sim.commands import whole
from aerokit.sim.motion import GRAVITY_M_S2, Motion

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.parameter_tables import Kind
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.commands import Command

__all__ = ["Accessories", "Motors"]


_ARMING_DELAY_S = 2.0
_SPOOL_UP_S = 1.3
_SPOOL_DOWN_S = 1.1
_HOVER_THROTTLE = 0.36
_AMPERES_AT_FULL = 78.0
_STOPPED_PWM, _IDLE_PWM, _FULL_PWM = 1000, 1100, 2000


class Motors:
    """``spool`` is 0 while the motors idle or stand, 1 when they can lift; ``wanted`` asks for that."""

    def __init__(self) -> None:
        self.is_armed: bool = False
        self.armed_at: float = -math.inf
        self.disarmed_at: float = -math.inf
        self.may_turn: bool = False
        """Whether the arming delay is over."""
        self.wanted: bool = False
        self.spool: float = 0.0
        self.throttle: float = 0.0
        """0 to 1, as VFR_HUD says it in percent."""

    @property
    def can_lift(self) -> bool:
        """Whether the propellers turn fast enough to fly."""
        return self.is_armed and self.spool >= 1.0

    @property
    def is_idle(self) -> bool:
        """Whether they turn at their lowest speed, or not at all."""
        return self.spool <= 0.0

    @property
    def current_a(self) -> float:
        """What the battery gives to all of them and the electronics."""
        return 0.08 * self.is_armed + self.throttle * _AMPERES_AT_FULL

    @property
    def pwm(self) -> int:
        """What SERVO_OUTPUT_RAW shows for each; they begin to turn when the arming delay is over."""
        if not (self.is_armed and self.may_turn):
            return _STOPPED_PWM
        return round(_IDLE_PWM + 20 * self.spool + self.throttle * (_FULL_PWM - _IDLE_PWM) * 1.3)

    def set_armed(self, armed: bool, now: float) -> None:
        """Arm or stop them."""
        if self.is_armed and not armed:
            self.disarmed_at = now
        self.is_armed = armed
        self.armed_at = now
        self.may_turn = False
        self.spool = self.throttle = 0.0
        self.wanted = False

    def update(self, now: float, dt: float, motion: Motion, *, landed: bool) -> None:
        """Follow what is wanted."""
        self.may_turn = self.is_armed and now - self.armed_at >= _ARMING_DELAY_S
        if self.may_turn and self.wanted:
            if self.spool < 1.0:
                self.spool = min(1.0, self.spool + dt / _SPOOL_UP_S)
        else:
            self.spool = max(0.0, self.spool - dt / _SPOOL_DOWN_S)
        if landed or not self.is_armed:
            self.throttle = 0.05 * self.spool
            return
        lean = math.cos(motion.roll) * math.cos(motion.pitch)
        lift = 1.0 - motion.acceleration_down / GRAVITY_M_S2
        throttle = _HOVER_THROTTLE * lift / (lean if lean > 0.5 else 0.5)
        self.throttle = 0.0 if throttle < 0.0 else throttle if throttle < 1.0 else 1.0


_SERVOS = 32
_RELAYS = {"rover": 2}
_FUNCTIONS = 320
_SAVE_WAYPOINT = 7
_NOT_THERE: dict[Kind, tuple[int, ...]] = {
    "copter": (0,),
    "plane": (0, _SAVE_WAYPOINT),
    "rover": (),
    "sub": (0, _SAVE_WAYPOINT),
}
"""RC options that were refused, of those that were tried."""
_FREE_FUNCTIONS = frozenset({0, 1, *range(51, 67)})
_AUX_POSITIONS = (0.0, 1.0, 2.0)


class Accessories:
    """What DO_SET_SERVO, DO_SET_RELAY and DO_AUX_FUNCTION set; a reboot forgets it."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.servos: dict[int, int] = {}
        """Output, from 1 on → its pulse in microseconds."""
        self.relays: int = 0
        """A bit for each that is on."""
        self.functions: dict[int, int] = {}
        """RC option → position of its switch: 0 low, 1 middle, 2 high."""

    @property
    def relay_count(self) -> int:
        """How many relays there are."""
        return _RELAYS.get(self._vehicle.KIND, 1)

    def is_free(self, output: int) -> bool:
        """Whether an output has no function (SERVOn_FUNCTION), or follows a stick."""
        name, parameters = f"SERVO{output}_FUNCTION", self._vehicle.parameters
        return name not in parameters or parameters[name] in _FREE_FUNCTIONS

    def set_servo(self, command: Command) -> int:
        """DO_SET_SERVO, and DO_REPEAT_SERVO, of which only the first pulse is simulated."""
        output = whole(command.param1)
        if not 1 <= output <= _SERVOS:
            return MavResult.FAILED
        if not self.is_free(output):
            self._vehicle.info(f"ServoRelayEvent: Channel {output} is already in use")
            return MavResult.FAILED
        self.servos[output] = whole(command.param2)
        return MavResult.ACCEPTED

    def set_relay(self, command: Command) -> int:
        """DO_SET_RELAY."""
        if not 0 <= command.param1 < self.relay_count:
            return MavResult.FAILED
        bit = 1 << whole(command.param1)
        self.relays = self.relays | bit if command.param2 else self.relays & ~bit
        return MavResult.ACCEPTED

    def repeat_relay(self, command: Command) -> int:
        """DO_REPEAT_RELAY: it is back where it was when it is over, and that is all."""
        known = 0 <= command.param1 < self.relay_count
        return MavResult.ACCEPTED if known else MavResult.FAILED

    def switch(self, command: Command) -> int:
        """DO_AUX_FUNCTION is heard; what the function does is not simulated."""
        function = whole(command.param1)
        if command.param2 not in _AUX_POSITIONS:
            return MavResult.DENIED
        if not 0 <= function < _FUNCTIONS or function in _NOT_THERE[self._vehicle.KIND]:
            self._vehicle.send_text(MavSeverity.INFO, f"Invalid channel option ({function})")
            return MavResult.FAILED
        self.functions[function] = whole(command.param2)
        return MavResult.ACCEPTED
