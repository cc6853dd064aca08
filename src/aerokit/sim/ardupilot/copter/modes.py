"""ArduCopter's flight modes: what each needs and what it makes the vehicle do.

A mode is one object per vehicle. The simple ones are here; GUIDED and the ways home have files of their own, and the
table of all is beside `SimulatedCopter`. SPORT and AUTOROTATE are unknown, as in the firmware for quadrotors.
"""

from __future__ import annotations

import math

from aerokit.mavlink.enums import CopterMode, MavSeverity
from aerokit.sim.ardupilot.copter.host import CopterHost
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.local_frame import Ned
from aerokit.sim.setpoints import rotated

_MID_STICK, _STICK_RANGE, _THROTTLE_DEADZONE = 1500, 500, 100
_FULL_STICK_LEAN_RAD = math.radians(30.0)
_FULL_STICK_TURN_RAD_S = math.radians(200.0)
_LOITER_SPEED_M_S = 12.5
_STABILIZE_CLIMB_M_S = 6.0


class Mode(VehicleMode):
    """A mode of a copter."""

    def __init__(self, copter: CopterHost) -> None:
        self.copter = copter

    def stay(self) -> None:
        """Keep still; on the ground the motors idle."""
        self.copter.motors.wanted = not self.copter.is_landed
        self.copter.motion.seek_velocity(0.0, 0.0, 0.0)


class TakeOff:
    """A climb straight up that waits for the motors; shared by the modes that take off by command."""

    def __init__(self, copter: CopterHost, altitude_m: float) -> None:
        self._copter = copter
        home = copter.navigation.home
        ground = copter.motion.ground_down if home is None else home[2]
        self.target: Ned = (copter.motion.north, copter.motion.east, ground - altitude_m)
        self.is_complete: bool = False

    def update(self, climb_m_s: float) -> None:
        copter, motion = self._copter, self._copter.motion
        copter.motors.wanted = True
        if copter.is_landed:
            if copter.motors.can_lift:
                copter.is_landed = False
            return
        motion.seek_position(*self.target, speed=2.0, climb=climb_m_s, descent=1.0)
        if abs(motion.down - self.target[2]) < 0.1 and abs(motion.velocity_down) < 0.2:
            self.is_complete = True


class PilotedMode(Mode):
    """Modes that the sticks fly; the sticks stay where RC_CHANNELS_OVERRIDE or the test put them."""

    def __init__(self, copter: CopterHost) -> None:
        super().__init__(copter)
        self._take_off: TakeOff | None = None

    def enter(self, *, force: bool) -> bool:
        self._take_off = None
        self.is_taking_off = False
        return True

    def climb_from_stick(self) -> float:
        """Wanted climb in m/s; the throttle stick in the middle keeps the height."""
        stick = self.copter.rc[2] - _MID_STICK
        if abs(stick) <= _THROTTLE_DEADZONE:
            return 0.0
        share = (abs(stick) - _THROTTLE_DEADZONE) / (_STICK_RANGE - _THROTTLE_DEADZONE)
        return math.copysign(min(1.0, share) * self.copter.parameters["PILOT_SPEED_UP"] / 100.0, stick)

    def sticks(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw sticks, -1 to 1."""
        roll, pitch, _, yaw = ((self.copter.rc[i] - _MID_STICK) / _STICK_RANGE for i in range(4))
        return roll, pitch, yaw

    def update(self, dt: float) -> None:
        """A take-off by command, else the sticks."""
        if self._take_off is not None:
            self._take_off.update(self.copter.parameters["PILOT_SPEED_UP"] / 100.0)
            if self._take_off.is_complete:
                self._take_off, self.is_taking_off = None, False
            return
        climb = self.climb_from_stick()
        if not self.lift_off_by_stick(climb):
            return
        roll, pitch, yaw = self.sticks()
        self.fly(roll, pitch, climb)
        self.copter.motion.turn(yaw * _FULL_STICK_TURN_RAD_S)

    def lift_off_by_stick(self, climb: float) -> bool:
        """Whether the vehicle is in the air, lifting off when the stick says so."""
        copter = self.copter
        copter.motors.wanted = not copter.is_landed or climb > 0
        if copter.is_landed and climb > 0 and copter.motors.can_lift:
            copter.is_landed = False
        return not copter.is_landed

    def fly(self, roll: float, pitch: float, climb: float) -> None:
        self.copter.motion.seek_attitude(roll * _FULL_STICK_LEAN_RAD, pitch * _FULL_STICK_LEAN_RAD, -climb)

    def start_take_off(self, altitude_m: float) -> bool:
        """Begin the climb."""
        self._take_off = TakeOff(self.copter, altitude_m)
        self.is_taking_off: bool = True
        return True


class Stabilize(PilotedMode):
    """Attitude and throttle by stick; with the throttle stick low it comes down fast."""

    number: int = CopterMode.STABILIZE
    name = "STABILIZE"
    needs_position = False
    has_manual_throttle = True

    def climb_from_stick(self) -> float:
        """Throttle, not climb: half a stick hovers."""
        throttle = self.copter.rc[2]
        if self.copter.is_landed and throttle <= _MID_STICK:
            return 0.0
        return _STABILIZE_CLIMB_M_S * (throttle - _MID_STICK) / _STICK_RANGE


class AltHold(PilotedMode):
    """Attitude by stick, height held."""

    takes_off = True

    number: int = CopterMode.ALT_HOLD
    name = "ALT_HOLD"
    needs_position = False

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        """Only when the command leaves the horizontal part to the pilot."""
        return self.takes_off and not must_navigate and self.start_take_off(altitude_m)


class Loiter(PilotedMode):
    """Position and height held, sticks move them. A low throttle stick descends, and lands."""

    takes_off = True
    """By command."""

    number: int = CopterMode.LOITER
    name = "LOITER"

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        return self.takes_off and self.start_take_off(altitude_m)

    def fly(self, roll: float, pitch: float, climb: float) -> None:
        wanted = (-pitch * _LOITER_SPEED_M_S, roll * _LOITER_SPEED_M_S, -climb)
        self.copter.motion.seek_velocity(*rotated(wanted, self.copter.motion.yaw))


class Holding(Mode):
    """Stays where it is."""

    def update(self, dt: float) -> None:
        self.stay()


class Throw(Holding):
    """Waits to be thrown, with motors that stand still; thrown it would hold, as it does here in the air."""

    number: int = CopterMode.THROW
    name = "THROW"
    _told_at = -math.inf

    def update(self, dt: float) -> None:
        """Says so once after each arming."""
        if self._told_at < self.copter.motors.armed_at:
            self._told_at = self.copter.now
            self.copter.info("waiting for throw")
        super().update(dt)


class Follow(Holding):
    """FOLL_ENABLE lets it in; it holds, as the real one does without somebody to follow."""

    number: int = CopterMode.FOLLOW
    name = "FOLLOW"
    can_arm = False

    def enter(self, *, force: bool) -> bool:
        if self.copter.parameters["FOLL_ENABLE"]:
            return True
        self.copter.send_text(MavSeverity.WARNING, "Set FOLL_ENABLE = 1")
        return False


class Refusing(Mode):
    """What it needs is never there; says what."""

    needs_position = False
    can_arm = False
    text: str = ""

    def enter(self, *, force: bool) -> bool:
        if self.text:
            self.copter.send_text(MavSeverity.WARNING, self.text)
        return False
