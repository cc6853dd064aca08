"""What simulated rovers and submarines have in common: no take-off, no landing, targets and missions on the level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, cast

from aerokit.mavlink.enums import AttitudeTargetTypemask as AttitudeMask
from aerokit.mavlink.enums import MavCmd, MavDoRepositionFlags, MavFrame, MavResult, MavSeverity, SpeedType
from aerokit.mavlink.messages import (
    MissionItemReached,
    SetAttitudeTarget,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.commands import common_commands
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import euler_from_quaternion
from aerokit.sim.setpoints import PositionTarget, Setpoint, is_finite, rotated

_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_FIXED = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED})


@dataclass(frozen=True)
class Target:
    """What one message wants; None is left out. Positions and velocities are north, east, down of the world."""

    position: Ned | None = None
    velocity: Ned | None = None
    backwards: bool = False
    """It is to move with its tail first: a velocity against the first axis, with a heading or a turn beside it."""
    yaw: float | None = None
    yaw_rate: float | None = None
    patience_s: float = 3.0
    """For how long it holds; a position stays."""


class TargetMode(Protocol):
    """The mode that follows targets."""

    number: int
    """The vehicle's number for it."""

    def take(self, target: Target) -> None:
        """Follow it from now on."""
        ...


class Targets:
    """Hears the messages; those with nonsense in them are ignored."""

    BODY_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs in which vectors are relative to the nose."""
    RELATIVE_YAW_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs in which a yaw is."""
    GLOBAL_YAW: ClassVar[bool] = True
    """Whether yaw and turn of a global target are taken."""

    def __init__(self, vehicle: ArduPilotVehicle, mode: TargetMode) -> None:
        self.vehicle: ArduPilotVehicle = vehicle
        self.mode: TargetMode = mode
        vehicle.on(SetPositionTargetLocalNed, self._on_local)
        vehicle.on(SetPositionTargetGlobalInt, self._on_global)
        vehicle.on(SetAttitudeTarget, self._on_attitude)

    def refuse_acceleration(self, message: PositionTarget) -> None:
        """What it says to a message that has one."""

    def steer(self, message: SetAttitudeTarget) -> None:
        """Do as SET_ATTITUDE_TARGET wants it."""

    def is_complete(self, target: Target) -> bool:
        """Whether there is enough in it to move by."""
        return target.position is not None or target.velocity is not None

    @property
    def _is_guided(self) -> bool:
        return self.vehicle.mode.number == self.mode.number

    def _on_attitude(self, message: SetAttitudeTarget, _: Channel) -> None:
        if self._is_guided and all(map(math.isfinite, (*message.q, message.thrust, message.body_yaw_rate))):
            self.steer(message)

    def _on_local(self, message: SetPositionTargetLocalNed, _: Channel) -> None:
        if message.coordinate_frame in _FIXED | self.BODY_FRAMES:
            self._take(message, self._local_point(message), has_yaw=True)

    def _on_global(self, message: SetPositionTargetGlobalInt, _: Channel) -> None:
        frame = message.coordinate_frame
        point = self.vehicle.point(message.lat_int, message.lon_int, message.alt, frame)
        if point is not None or not Setpoint.of(message).has_position:
            self._take(message, point, has_yaw=self.GLOBAL_YAW)

    def _take(self, message: PositionTarget, point: Ned | None, *, has_yaw: bool) -> None:
        asked, frame = Setpoint.of(message), message.coordinate_frame
        if not self._is_guided:
            return
        if asked.has_acceleration:
            self.refuse_acceleration(message)
            return
        position = point if asked.has_position else None
        velocity = asked.velocity if asked.has_velocity else None
        if not is_finite(position, velocity):
            return
        here = self.vehicle.motion.yaw if frame in self.RELATIVE_YAW_FRAMES else 0.0
        yaw = None if asked.yaw is None or not has_yaw else asked.yaw + here
        rate = asked.yaw_rate if has_yaw else None
        backwards = message.vx < 0 and not (yaw is None and rate is None)
        if velocity is not None and frame in self.BODY_FRAMES:
            velocity = rotated(velocity, self.vehicle.motion.yaw)
        target = Target(position, velocity, backwards, yaw, rate)
        if self.is_complete(target):
            self.mode.take(target)

    def _local_point(self, message: SetPositionTargetLocalNed) -> Ned:
        offset, motion = (message.x, message.y, message.z), self.vehicle.motion
        if message.coordinate_frame == MavFrame.LOCAL_NED:
            return self.vehicle.navigation.world(offset)
        if message.coordinate_frame in self.BODY_FRAMES:
            offset = rotated(offset, motion.yaw)
        return (motion.north + offset[0], motion.east + offset[1], motion.down + offset[2])


class RoverTargets(Targets):
    """A heading or a turn alone is enough; thrust is a share of the usual speed."""

    def refuse_acceleration(self, message: PositionTarget) -> None:
        self.vehicle.info(f"Ignoring {message.NAME}; set ACC_IGNORE in mask")

    def is_complete(self, target: Target) -> bool:
        """Of a heading and a turn without a velocity it cannot do both."""
        return super().is_complete(target) or (target.yaw is None) != (target.yaw_rate is None)

    def steer(self, message: SetAttitudeTarget) -> None:
        """The turn counts more than the heading; without thrust it is ignored."""
        if message.type_mask & AttitudeMask.THROTTLE_IGNORE:
            return
        parameters = self.vehicle.parameters
        speed = (parameters["WP_SPEED"] or parameters["CRUISE_SPEED"]) * max(-1.0, min(1.0, message.thrust))
        heading = euler_from_quaternion(*message.q)[2]
        velocity = (abs(speed) * math.cos(heading), abs(speed) * math.sin(heading), 0.0)
        if message.type_mask & AttitudeMask.BODY_YAW_RATE_IGNORE:
            self.mode.take(Target(None, velocity, speed < 0, heading))
        else:
            self.mode.take(Target(None, velocity, speed < 0, None, message.body_yaw_rate))


class SubTargets(Targets):
    """Thrust is a climb: 0.5 holds the depth; lean angles move nothing here. A yaw is relative in one frame only."""

    BODY_FRAMES: ClassVar[frozenset[int]] = _BODY | {MavFrame.BODY_FRD}
    RELATIVE_YAW_FRAMES = frozenset({MavFrame.BODY_OFFSET_NED})
    GLOBAL_YAW: ClassVar[bool] = False

    def steer(self, message: SetAttitudeTarget) -> None:
        """Only with both attitude and thrust; it holds for one second."""
        if message.type_mask & (AttitudeMask.ATTITUDE_IGNORE | AttitudeMask.THROTTLE_IGNORE):
            return
        share = 2.0 * (max(0.0, min(1.0, message.thrust)) - 0.5)
        parameters = self.vehicle.parameters
        climb = share * parameters["WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN"] / 100.0
        _, _, yaw = euler_from_quaternion(*message.q)
        self.mode.take(Target(None, (0.0, 0.0, -climb), False, yaw, patience_s=1.0))


_STICK_MIDDLE = 1500


class LevelVehicle(ArduPilotVehicle):
    """Its arguments are those of `ArduPilotVehicle`."""

    def own_commands(self) -> dict[int, CommandHandler]:
        """Commands beside those of every ArduPilot."""
        return {}

    @property
    def is_at_rest(self) -> bool:
        """Whether nothing moves while it is disarmed."""
        raise NotImplementedError

    def reset_controllers(self) -> None:
        """The throttle stick rests in the middle."""
        self.rc[2] = _STICK_MIDDLE

    def tick(self, dt: float) -> None:
        if self.motors.is_armed:
            self.mode.update(dt)
        self.motors.update(self.now, dt, self.motion, landed=False)
        self.move(dt)
        self.battery.drain(self.motors.current_a, dt)
        if not self.motors.is_armed and self.is_at_rest:
            self.set_ticking(False)

    def move(self, dt: float) -> None:
        self.motion.step(dt, powered=self.motors.is_armed and not self.faults.motor_failed)

    def make_commands(self) -> dict[int, CommandHandler]:
        return {
            **common_commands(self),
            MavCmd.MISSION_START: self._start_mission,
            MavCmd.DO_REPOSITION: self._reposition,
            MavCmd.DO_CHANGE_SPEED: self._change_speed,
            **self.own_commands(),
        }

    def _start_mission(self, command: Command) -> int:
        if command.param1 or command.param2:
            return MavResult.DENIED
        result = self.change_to(cast("VehicleMode", self.auto).number)
        if result == MavResult.ACCEPTED and not self.mission.is_running:
            self.mission.start_or_resume()
        return result

    def _reposition(self, command: Command) -> int:
        """Only as COMMAND_INT: ArduPilot knows no frame for it in COMMAND_LONG."""
        if command.is_long:
            return MavResult.UNSUPPORTED
        guided = self.guided
        if self.mode is not guided and not whole(command.param2) & MavDoRepositionFlags.CHANGE_MODE:
            return MavResult.DENIED
        point = self.point(*command.place(), command.z, command.altitude_frame)
        if point is None:
            return MavResult.DENIED
        if not self.set_mode(guided.number):
            return MavResult.FAILED
        self.guided.go_to(point)
        return MavResult.ACCEPTED

    def _change_speed(self, command: Command) -> int:
        if command.param1 in (SpeedType.CLIMB_SPEED, SpeedType.DESCENT_SPEED):
            return MavResult.DENIED
        kinds = (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED)
        if not self.mode.can_change_speed or command.param1 not in kinds or not command.param2 > 0:
            return MavResult.FAILED
        cast("Any", self.mode).speed = command.param2
        return MavResult.ACCEPTED


_C = MavCmd
_WAYS = frozenset({_C.NAV_WAYPOINT, _C.NAV_LOITER_UNLIM, _C.NAV_LOITER_TIME})
_HOME = _C.NAV_RETURN_TO_LAUNCH
_IN_PASSING = frozenset(
    {_C.DO_SET_ROI, _C.DO_SET_ROI_LOCATION, _C.DO_SET_ROI_NONE, _C.DO_FENCE_ENABLE, _C.DO_GUIDED_LIMITS}
)
_KNOWN = (
    _WAYS
    | {_HOME, _C.NAV_DELAY, _C.CONDITION_DELAY, _C.CONDITION_DISTANCE, _C.DO_CHANGE_SPEED, _C.DO_SET_HOME}
    | _IN_PASSING
)


class LevelAuto(VehicleMode):
    """Goes where the mission leads; a subclass says how it moves and what it says on arrival."""

    needs_mission = True
    can_change_speed = True

    def __init__(self, vehicle: LevelVehicle) -> None:
        self.vehicle = vehicle
        self.speed: float = 0.0
        """In m/s."""
        self.may_lift_off = False
        self.is_paused = False
        self._place: Ned | None = None
        self._stops = True
        self._is_waiting = False
        self._reached_at: float | None = None
        self._wait_until = 0.0

    def default_speed(self) -> float:
        """In m/s, as parameters say it."""
        raise NotImplementedError

    def refuse(self) -> None:
        """There is no mission."""

    def travel(self, place: Ned, *, stops: bool) -> None:
        """Go on towards a point for one tick."""
        raise NotImplementedError

    def has_arrived(self, place: Ned) -> bool:
        raise NotImplementedError

    def stay(self) -> None:
        raise NotImplementedError

    def reached_text(self, index: int, seconds: float) -> str:
        raise NotImplementedError

    def finish(self) -> None:
        """The mission is over."""

    @property
    def destination(self) -> Ned | None:
        return self._place

    def enter(self, *, force: bool) -> bool:
        if self.vehicle.mode is self:
            return True
        if not self.vehicle.mission.is_present:
            self.refuse()
            return False
        self.speed, self._place, self._is_waiting = self.default_speed(), None, True
        self.vehicle.call_later(0.0, self._start_if_waiting)
        return True

    def leave(self) -> None:
        """The mission stops where it is."""
        self._is_waiting = False
        self.vehicle.mission.stop()

    def disarmed(self) -> None:
        """A mission that was not over begins once more, and waits."""
        if self.vehicle.mode is self:
            self.vehicle.mission.update()

    def _start_if_waiting(self) -> None:
        if self._is_waiting and self.vehicle.mode is self and self.vehicle.navigation.origin is not None:
            self._is_waiting = False
            self.vehicle.mission.start_or_resume()

    def update(self, dt: float) -> None:
        self._start_if_waiting()
        if not self._is_waiting:
            self.vehicle.mission.update()
        if self.vehicle.mode is not self:
            return
        if self._place is None:
            self.stay()
        else:
            self.travel(self._place, stops=self._stops)

    def start_command(self, index: int, item: MissionItem) -> bool:
        command = item.command
        if command not in _KNOWN:
            return False
        if command in _WAYS or command == _HOME:
            self._go(item)
        elif command in (_C.NAV_DELAY, _C.CONDITION_DELAY):
            self._wait_until = self.vehicle.now + max(0.0, item.param1)
        elif command == _C.DO_CHANGE_SPEED:
            self._change_speed(item)
        elif command == _C.DO_SET_HOME:
            self._set_home(item)
        if command == _C.NAV_DELAY:
            self._place = None
            self.vehicle.info(f"Delaying {int(item.param1)} sec")
        return True

    def is_complete(self, index: int, item: MissionItem) -> bool:
        if self.vehicle.mode is not self or not self._is_done(index, item):
            return False
        self.vehicle.call_later(0.0, lambda: self.vehicle.send(MissionItemReached(index)))
        return True

    def end_mission(self) -> None:
        self._place = None
        self.finish()

    def _is_done(self, index: int, item: MissionItem) -> bool:
        command, now = item.command, self.vehicle.now
        if command in _WAYS:
            return self._has_stayed(index, item) and command != _C.NAV_LOITER_UNLIM
        if command == _HOME:
            return self._place is None or self.has_arrived(self._place)
        if command in (_C.NAV_DELAY, _C.CONDITION_DELAY):
            return now >= self._wait_until
        if command == _C.CONDITION_DISTANCE:
            return self._distance() < item.param1
        if command not in _KNOWN:
            self.vehicle.send_text(MavSeverity.WARNING, f"Skipping invalid cmd #{command}")
        return True

    def _has_stayed(self, index: int, item: MissionItem) -> bool:
        if self._place is None or (self._reached_at is None and not self.has_arrived(self._place)):
            return False
        now = self.vehicle.now
        if self._reached_at is None:
            self._reached_at = now
            self.vehicle.info(self.reached_text(index, item.param1))
        return now - self._reached_at >= max(0.0, item.param1)

    def _distance(self) -> float:
        if self._place is None:
            return 0.0
        motion = self.vehicle.motion
        return math.hypot(self._place[0] - motion.north, self._place[1] - motion.east)

    def _go(self, item: MissionItem) -> None:
        vehicle, motion = self.vehicle, self.vehicle.motion
        here: Ned = self._place or motion.place
        self._reached_at = None
        if item.command == _HOME:
            self._place, self._stops = vehicle.navigation.home or here, True
            return
        point = vehicle.point(int(item.x), int(item.y), item.z, item.frame)
        north, east = here[:2] if point is None or (item.x, item.y) == (0, 0) else point[:2]
        self._place = (north, east, here[2] if point is None or item.z == 0 else point[2])
        following = next(vehicle.mission.navigation_from(vehicle.mission.nav_index + 1), None)
        self._stops = item.param1 > 0 or following is None or following[1].command not in _WAYS

    def _change_speed(self, item: MissionItem) -> None:
        if item.param1 in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED) and item.param2 > 0:
            self.speed = item.param2

    def _set_home(self, item: MissionItem) -> None:
        motion = self.vehicle.motion
        point: Ned | None = motion.place
        if item.param1 != 1 and (item.x, item.y, item.z) != (0, 0, 0):
            point = self.vehicle.point(int(item.x), int(item.y), item.z, item.frame)
        if point is not None:
            self.vehicle.navigation.set_home(point, lock=False)
