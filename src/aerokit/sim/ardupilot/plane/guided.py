"""GUIDED of a simulated ArduPlane: a place to circle at, and what a program changes of height, speed and course."""

from __future__ import annotations

import math
from dataclasses import dataclass

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import AttitudeTargetTypemask as Mask
from aerokit.mavlink.enums import HeadingType, MavCmd, MavFrame, MavResult, MavSeverity, PlaneMode, SpeedType
from aerokit.mavlink.enums import PositionTargetTypemask as PositionMask
from aerokit.sim.ardupilot.plane.host import PlaneHost
from aerokit.sim.ardupilot.plane.modes import NavigatingMode
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion

_PATIENCE_S = 3.0
_AT_ONCE_M_S = 1000.0
_RATES = Mask.BODY_ROLL_RATE_IGNORE | Mask.BODY_PITCH_RATE_IGNORE | Mask.BODY_YAW_RATE_IGNORE
_UNCHANGEABLE = (0.0, -1.0)


@dataclass(frozen=True)
class _Order:
    """A number that holds for three seconds."""

    value: float
    since: float


class Guided(NavigatingMode):
    """Circles around the place it was sent to; where it was switched on until then.

    A commanded course holds until a place or no course is ordered. Bank, pitch and throttle of SET_ATTITUDE_TARGET hold
    for three seconds each.
    """

    number: int = PlaneMode.GUIDED
    name = "GUIDED"
    can_change_speed = True

    def enter(self, *, force: bool) -> bool:
        self._climb_limit = _AT_ONCE_M_S
        self._course: float | None = None
        self._bank = self._pitch = self._throttle = _Order(0.0, -math.inf)
        return super().enter(force=force)

    def go_to(self, position: Ned) -> None:
        """Fly to a point of the world and circle there."""
        self._place, self._course, self._climb_limit = position, None, _AT_ONCE_M_S

    def change_altitude(self, down: float, climb_m_s: float = _AT_ONCE_M_S) -> None:
        """Circle at the same place in another height."""
        if self._place is not None:
            self._place = (self._place[0], self._place[1], down)
            self._climb_limit = climb_m_s

    def change_course(self, course: float | None) -> None:
        """Fly straight on, in radians from north; None circles again."""
        self._course = course

    def take_attitude(self, message: m.SetAttitudeTarget) -> None:
        """As much of it as its mask leaves; a rate that is not ignored stands for its angle."""
        ignored, now = message.type_mask, self.plane.now
        roll, pitch, _ = euler_from_quaternion(*message.q)
        whole = not ignored & Mask.ATTITUDE_IGNORE and ignored & _RATES == _RATES
        if whole or not ignored & Mask.BODY_ROLL_RATE_IGNORE:
            self._bank = _Order(roll, now)
        if whole or not ignored & Mask.BODY_PITCH_RATE_IGNORE:
            self._pitch = _Order(pitch, now)
        if not ignored & Mask.THROTTLE_IGNORE:
            self._throttle = _Order(max(0.0, min(1.0, message.thrust)), now)

    def update(self, dt: float) -> None:
        wing, now = self.plane.wing, self.plane.now
        banks, pitches, throttles = (
            now - order.since < _PATIENCE_S for order in (self._bank, self._pitch, self._throttle)
        )
        if self.plane.is_landed or not (banks or pitches or throttles or self._course is not None):
            super().update(dt)
            return
        speed = 2.0 * self._throttle.value * self.plane.cruise_m_s if throttles else self.airspeed
        climb = self._climb()
        if pitches:
            climb = max(-wing.wing.sink_m_s, min(wing.wing.climb_m_s, speed * math.sin(self._pitch.value)))
        if banks:
            wing.bank_and_climb(
                speed, max(-wing.wing.bank_rad, min(wing.wing.bank_rad, self._bank.value)), climb
            )
        elif self._course is not None:
            wing.head(self._course, speed, climb)
        else:
            wing.bank_and_climb(speed, 0.0, climb)

    def _climb(self) -> float:
        wing = self.plane.wing
        climb = wing.climb_to(wing.down if self._place is None else self._place[2])
        return max(-self._climb_limit, min(self._climb_limit, climb))


class PlaneSetpoints:
    """Of the position messages an aeroplane takes only heights; outside GUIDED it takes nothing, without a word."""

    def __init__(self, plane: PlaneHost) -> None:
        self._plane = plane
        plane.on(m.SetPositionTargetLocalNed, self._on_local)
        plane.on(m.SetPositionTargetGlobalInt, self._on_global)
        plane.on(m.SetAttitudeTarget, self._on_attitude)

    @property
    def _is_guided(self) -> bool:
        return self._plane.mode is self._plane.mode_of(Guided)

    def _on_local(self, message: m.SetPositionTargetLocalNed, _: Channel) -> None:
        """Metres down from the present target; the rest is ignored."""
        plane = self._plane
        target = plane.mode_of(Guided).destination
        if not self._is_guided or message.coordinate_frame != MavFrame.LOCAL_OFFSET_NED or target is None:
            return
        down = target[2] + message.z
        plane.mode_of(Guided).change_altitude(down)
        home = plane.navigation.home or (0.0, 0.0, plane.wing.ground_down)
        plane.info(f"Change alt to {home[2] - down:.1f}")

    def _on_global(self, message: m.SetPositionTargetGlobalInt, _: Channel) -> None:
        plane = self._plane
        if not self._is_guided:
            return
        point = plane.point(0, 0, message.alt, message.coordinate_frame)
        if point is None:
            plane.info(f"Unknown mavlink coordinate frame {message.coordinate_frame}")
            plane.send_text(MavSeverity.WARNING, "Invalid coord frame in SET_POSTION_TARGET_GLOBAL_INT")
        elif not message.type_mask & PositionMask.Z_IGNORE:
            plane.mode_of(Guided).change_altitude(point[2])

    def _on_attitude(self, message: m.SetAttitudeTarget, _: Channel) -> None:
        if self._is_guided:
            self._plane.mode_of(Guided).take_attitude(message)


def guided_commands(plane: PlaneHost) -> dict[int, CommandHandler]:
    """MAV_CMD → handler: speed, height and course with rates of change; in GUIDED only."""
    handlers: dict[int, CommandHandler] = {
        MavCmd.GUIDED_CHANGE_SPEED: lambda command: _change_speed(plane, command),
        MavCmd.GUIDED_CHANGE_ALTITUDE: lambda command: _change_altitude(plane, command),
        MavCmd.GUIDED_CHANGE_HEADING: lambda command: _change_heading(plane, command),
    }

    def in_guided(handler: CommandHandler) -> CommandHandler:
        return lambda command: handler(command) if plane.mode is plane.mode_of(Guided) else MavResult.FAILED

    return {
        **{command: in_guided(handler) for command, handler in handlers.items()},
        MavCmd.DO_CHANGE_ALTITUDE: lambda command: _change_target_altitude(plane, command),
    }


def _change_speed(plane: PlaneHost, command: Command) -> int:
    """Params: SPEED_TYPE, of which only the airspeed is taken; m/s."""
    if whole(command.param1) != SpeedType.AIRSPEED:
        return MavResult.DENIED
    if not plane.can_fly_at(command.param2):
        return MavResult.FAILED
    plane.mode_of(Guided).speed = command.param2
    return MavResult.ACCEPTED


def _change_altitude(plane: PlaneHost, command: Command) -> int:
    """Param 3: climb in m/s, 0 as fast as it can; neither 0 nor -1 is taken as an altitude."""
    point = plane.point(0, 0, command.z, command.altitude_frame)
    if command.z in _UNCHANGEABLE or point is None:
        return MavResult.DENIED
    plane.mode_of(Guided).change_altitude(point[2], abs(command.param3) or _AT_ONCE_M_S)
    return MavResult.ACCEPTED


def _change_heading(plane: PlaneHost, command: Command) -> int:
    """Params: HEADING_TYPE, degrees. Course over ground and heading are the same here; the default ends it."""
    if not 0.0 <= command.param2 < 360.0:
        return MavResult.DENIED
    if command.param1 == HeadingType.DEFAULT:
        plane.mode_of(Guided).change_course(None)
        return MavResult.ACCEPTED
    if command.param1 not in (HeadingType.COURSE_OVER_GROUND, HeadingType.HEADING):
        return MavResult.DENIED
    plane.mode_of(Guided).change_course(math.radians(command.param2))
    return MavResult.ACCEPTED


def _change_target_altitude(plane: PlaneHost, command: Command) -> int:
    """Params: metres, MAV_FRAME. What it changes is the target of GUIDED."""
    point = plane.point(0, 0, command.param1, whole(command.param2))
    if point is None:
        return MavResult.DENIED
    if plane.mode is plane.mode_of(Guided):
        plane.mode_of(Guided).change_altitude(point[2])
    return MavResult.ACCEPTED
