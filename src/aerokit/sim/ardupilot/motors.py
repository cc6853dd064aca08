"""Arming delay, spool-up and what the motors draw, as ArduCopter's clients see it."""

from __future__ import annotations

import math

from aerokit.sim.motion import GRAVITY_M_S2, Motion

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
