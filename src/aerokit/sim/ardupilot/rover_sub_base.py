"""Base of the simulated Rover and Sub, which neither take off nor land: guided targets and missions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavFrame, MavResult, MavSeverity, SpeedType
from aerokit.mavlink.messages import (
    MissionItemReached,
    SetAttitudeTarget,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.commands import common_commands
from aerokit.sim.ardupilot.host import GuidedMode
from aerokit.sim.ardupilot.mission_run import MissionMode, SupportedCommand, place_of
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, PositionTarget, ReceivedCommand, Setpoint, is_finite, rotated
from aerokit.sim.motion import Ned
from aerokit.sim.vehicle_motion import GroundMotion, UnderwaterMotion

_BODY = frozenset({MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED})
_FIXED = frozenset({MavFrame.LOCAL_NED, MavFrame.LOCAL_OFFSET_NED})


@dataclass(frozen=True)
class GuidedTarget:
    """Target of a set-point message in the world frame. A value that the message does not give is None."""

    position: Ned | None = None
    velocity: Ned | None = None
    backwards: bool = False
    """True to drive backwards: the message has a negative vx (or thrust), and a heading or a turn rate."""
    yaw: float | None = None
    yaw_rate: float | None = None
    timeout_s: float = 3.0
    """Seconds after which a target without a position expires."""


class GuidedTargetMode(GuidedMode):
    """Base of the guided modes: goes to a place, or follows a target without a place until the target expires.

    Invalid set-points are ignored. A subclass selects what a firmware supports.
    """

    BODY_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs whose vectors are relative to the heading."""
    RELATIVE_YAW_FRAMES: ClassVar[frozenset[int]] = _BODY
    """MAV_FRAMEs whose yaw is relative to the heading."""
    GLOBAL_YAW: ClassVar[bool] = True
    """True if the firmware uses the yaw and the turn rate of SET_POSITION_TARGET_GLOBAL_INT."""

    def __init__(self, vehicle: RoverSubVehicle) -> None:
        super().__init__(vehicle)
        self.speed: float = 0.0
        self._target: GuidedTarget | None = None  # followed while `_place` is None; without it, the vehicle stops
        self._target_at = 0.0

    def go_to(self, position: Ned) -> None:
        self._place = position
        self._target = None

    def set_target(self, target: GuidedTarget) -> None:
        if target.position is not None:
            self.go_to(target.position)
        else:
            self._place = None
            self._target = target
            self._target_at = self.vehicle.now

    def refuse_acceleration(self, message: PositionTarget) -> None: ...

    def steer(self, message: SetAttitudeTarget) -> None:
        raise NotImplementedError

    def accepts(self, target: GuidedTarget) -> bool:
        """Return True if the firmware accepts this combination of values."""
        return target.position is not None or target.velocity is not None

    def on_attitude_target(self, message: SetAttitudeTarget, _: Channel) -> None:
        if self.is_active and all(map(math.isfinite, (*message.q, message.thrust, message.body_yaw_rate))):
            self.steer(message)

    def on_local_target(self, message: SetPositionTargetLocalNed, _: Channel) -> None:
        if message.coordinate_frame in _FIXED | self.BODY_FRAMES:
            self._set_target_from(message, self.vehicle.local_point(message, self.BODY_FRAMES), uses_yaw=True)

    def on_global_target(self, message: SetPositionTargetGlobalInt, _: Channel) -> None:
        frame = message.coordinate_frame
        point = self.vehicle.world_point(message.lat_int, message.lon_int, message.alt, frame)
        if point is not None or not Setpoint.of(message).has_position:
            self._set_target_from(message, point, uses_yaw=self.GLOBAL_YAW)

    def _set_target_from(self, message: PositionTarget, point: Ned | None, *, uses_yaw: bool) -> None:
        """Follow a set-point in GUIDED. ``point`` is its position in the world frame."""
        setpoint, frame = Setpoint.of(message), message.coordinate_frame
        if not self.is_active:
            return
        if setpoint.has_acceleration:
            self.refuse_acceleration(message)
            return
        position = point if setpoint.has_position else None
        velocity = setpoint.velocity if setpoint.has_velocity else None
        if not is_finite(position, velocity):
            return
        yaw = yaw_rate = None
        if uses_yaw:
            yaw, yaw_rate = setpoint.yaw, setpoint.yaw_rate
        if yaw is not None and frame in self.RELATIVE_YAW_FRAMES:
            yaw += self.vehicle.motion.yaw
        # Only a target with a yaw or a yaw rate can move the vehicle backwards. Without them, the vehicle turns to the
        # direction of travel. Like the firmware, use the sign of vx in every frame, even where vx is north.
        backwards = message.vx < 0 and (yaw is not None or yaw_rate is not None)
        if velocity is not None and frame in self.BODY_FRAMES:
            velocity = rotated(velocity, self.vehicle.motion.yaw)
        target = GuidedTarget(position, velocity, backwards=backwards, yaw=yaw, yaw_rate=yaw_rate)
        if self.accepts(target):
            self.set_target(target)


class RoverSubVehicle(ArduPilotVehicle):
    """Base of Rover and Sub. Takes the arguments of `ArduPilotVehicle`."""

    motion: GroundMotion | UnderwaterMotion  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def waypoint_speed(self) -> float:
        """Speed between waypoints in m/s, which parameters define."""
        raise NotImplementedError

    @property
    def is_standby(self) -> bool:
        """True if the heartbeat reports STANDBY instead of ACTIVE."""
        raise NotImplementedError

    @property
    def is_landed(self) -> bool:
        return self.is_standby

    @is_landed.setter
    def is_landed(self, _: bool) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Ignore the assigned value, because these vehicles do not take off."""

    def tick(self, dt: float) -> None:
        if self.motors.is_armed:
            self.mode.update(dt)
        self.motors.update(dt, landed=False)  # Rovers and submarines do not land.
        self.move(dt)
        self.battery.drain(self.motors.current_a, dt)
        if not self.motors.is_armed and self.motion.is_still:
            self.set_ticking(False)

    def make_commands(self) -> dict[int, CommandHandler]:
        return {**common_commands(self), Cmd.DO_CHANGE_SPEED: self._change_speed}

    def _change_speed(self, command: ReceivedCommand) -> int:
        if command.param1 in (SpeedType.CLIMB_SPEED, SpeedType.DESCENT_SPEED):
            return MavResult.DENIED
        is_horizontal = command.param1 in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED)
        is_valid = is_horizontal and command.param2 > 0
        if not self.mode.can_change_speed or not is_valid:
            return MavResult.FAILED
        self.mode.speed = command.param2
        return MavResult.ACCEPTED


_WAYPOINTS = frozenset({Cmd.NAV_WAYPOINT, Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME})

_WITHOUT_EFFECT = (Cmd.DO_SET_ROI, Cmd.DO_SET_ROI_LOCATION, Cmd.DO_SET_ROI_NONE, Cmd.DO_GUIDED_LIMITS)


class RoverSubAuto(MissionMode):
    """AUTO of Rover and Sub. A subclass moves the vehicle and reports its progress."""

    vehicle: RoverSubVehicle

    def __init__(self, vehicle: RoverSubVehicle) -> None:
        super().__init__(vehicle)
        self._stops = True  # True if the vehicle stops at `_place`
        self._reached_at: float | None = None  # time of arrival at `_place`; None before
        self._wait_until = 0.0  # end of a delay command
        self.commands.update(
            {
                **dict.fromkeys(_WAYPOINTS, SupportedCommand(self._go, self._has_stayed)),
                Cmd.NAV_RETURN_TO_LAUNCH: SupportedCommand(
                    self._go, lambda *_: self._place is None or self.has_arrived(self._place)
                ),
                **dict.fromkeys(
                    (Cmd.NAV_DELAY, Cmd.CONDITION_DELAY),
                    SupportedCommand(self._wait, lambda *_: vehicle.now >= self._wait_until),
                ),
                Cmd.CONDITION_DISTANCE: SupportedCommand(
                    is_done=lambda _, item: self.distance_to_destination < item.param1
                ),
                Cmd.DO_CHANGE_SPEED: SupportedCommand(self._change_speed),
                **dict.fromkeys(_WITHOUT_EFFECT, SupportedCommand()),
            }
        )

    def travel(self, place: Ned, *, stops: bool) -> None:
        raise NotImplementedError

    def has_arrived(self, place: Ned) -> bool:
        raise NotImplementedError

    def reached_text(self, index: int, seconds: float) -> str:
        raise NotImplementedError

    def enter(self, *, force: bool) -> bool:
        if self.vehicle.mode is self:  # Arming enters the current mode again, which must not restart the mission.
            return True
        if not self.vehicle.mission.is_present:
            if self.vehicle.KIND == "rover":
                self.vehicle.send_text(MavSeverity.NOTICE, "No Mission. Can't set AUTO.")
            return False
        self.speed = self.vehicle.waypoint_speed
        self._place = None
        self.wait_for_origin()
        return True

    def update(self, dt: float) -> None:
        self.start_if_origin_known()
        if not self.is_waiting_for_origin:
            self.vehicle.mission.update()
        if self.vehicle.mode is not self:  # The mission has changed the mode.
            return
        if self._place is None:
            self.vehicle.motion.stop()
        else:
            self.travel(self._place, stops=self._stops)

    def is_complete(self, index: int, item: MissionItem) -> bool:
        if self.vehicle.mode is not self or not self._is_done(index, item):
            return False
        self.vehicle.call_later(0.0, lambda: self.vehicle.send(MissionItemReached(index)))
        return True

    def end_mission(self) -> None:
        self._place = None
        if self.vehicle.KIND == "rover":  # The rover stops, because only MIS_DONE_BEHAVE 0 (hold) is simulated.
            self.vehicle.send_text(MavSeverity.NOTICE, "Mission Complete")

    def _has_stayed(self, index: int, item: MissionItem) -> bool:
        if self._place is None:
            return False
        now = self.vehicle.now
        if self._reached_at is None:
            if not self.has_arrived(self._place):
                return False
            self._reached_at = now
            self.vehicle.info(self.reached_text(index, item.param1))
        delay_s = max(0.0, item.param1)
        # NAV_LOITER_UNLIM never ends, but its arrival is reported.
        return now - self._reached_at >= delay_s and item.command != Cmd.NAV_LOITER_UNLIM

    def _go(self, item: MissionItem) -> None:
        vehicle = self.vehicle
        current: Ned = self._place or vehicle.motion.place  # where the previous command ended
        self._reached_at = None
        if item.command == Cmd.NAV_RETURN_TO_LAUNCH:
            self._place = vehicle.navigation.home or current
            self._stops = True
            return
        self._place = place_of(vehicle, item, current)
        following = next(vehicle.mission.navigation_from(vehicle.mission.nav_index + 1), None)
        is_waypoint_next = following is not None and following.item.command in _WAYPOINTS
        has_delay = item.param1 > 0
        self._stops = has_delay or not is_waypoint_next

    def _wait(self, item: MissionItem) -> None:
        self._wait_until = self.vehicle.now + max(0.0, item.param1)
        if item.command == Cmd.NAV_DELAY:
            self._place = None
            self.vehicle.info(f"Delaying {int(item.param1)} sec")

    def _change_speed(self, item: MissionItem) -> None:
        if item.param1 in (SpeedType.AIRSPEED, SpeedType.GROUNDSPEED) and item.param2 > 0:
            self.speed: float = item.param2
