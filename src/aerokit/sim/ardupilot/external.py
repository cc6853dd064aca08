"""Measurements that a companion computer sends to a simulated ArduPilot: poses, landing targets, sensors."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.message import Message
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.channel import Channel
from aerokit.sim.commands import ReceivedCommand, rotated
from aerokit.sim.motion import velocity_to_landing_target

_EXTERNAL_NAVIGATION = (m.Odometry, m.VisionPositionEstimate, m.AttPosMocap)
_SENSORS = (
    *(m.VisionSpeedEstimate, m.GpsInput, m.ObstacleDistance, m.ObstacleDistance3d),
    *(m.DistanceSensor, m.OpticalFlow),
)
_PLND_TYPE_MAVLINK = 1
_TARGET_TIMEOUT_S = 2.0


class ArduPilotExternal:
    """Measurements of external sensors. Only poses and landing targets affect the vehicle."""

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self.reset()
        for navigation_message in _EXTERNAL_NAVIGATION:
            vehicle.on(navigation_message, self._on_navigation)
        for sensor_message in _SENSORS:
            vehicle.on(sensor_message, self._on_sensor)
        vehicle.on(m.LandingTarget, self._on_target)

    def reset(self) -> None:
        self.latest: dict[type[Message], Message] = {}
        self._navigation_at = self._target_at = -math.inf  # times of the last measurements
        self._target: tuple[float, float] = (0.0, 0.0)  # (north, east) of the landing target
        # Wind speed in m/s, and the direction in degrees from which the wind comes. The flight is not affected.
        self.wind: tuple[float, float] | None = None

    @property
    def navigation_age_s(self) -> float:
        return self._vehicle.now - self._navigation_at

    def velocity_to_target(self) -> tuple[float, float]:
        """Return the velocity (north, east) in m/s towards the landing target, or zero without a recent target."""
        if self._vehicle.now - self._target_at > _TARGET_TIMEOUT_S:
            return (0.0, 0.0)
        north, east = self._target
        motion = self._vehicle.motion
        return velocity_to_landing_target(north - motion.north, east - motion.east)

    def _on_navigation(self, message: Message, _: Channel) -> None:
        if not self._vehicle.parameters.get("VISO_TYPE", 0.0):
            return
        frames = (MavFrame.LOCAL_FRD, MavFrame.BODY_FRD)  # The firmware ignores ODOMETRY in other frames.
        if isinstance(message, m.Odometry) and (message.frame_id, message.child_frame_id) != frames:
            return
        self.latest[type(message)] = message
        self._navigation_at = self._vehicle.now

    def _on_sensor(self, message: Message, _: Channel) -> None:
        self.latest[type(message)] = message

    def _on_target(self, target: m.LandingTarget, _: Channel) -> None:
        parameters, motion = self._vehicle.parameters, self._vehicle.motion
        is_enabled = parameters.get("PLND_ENABLED", 0.0) and parameters.get("PLND_TYPE", 0.0) == _PLND_TYPE_MAVLINK
        if not is_enabled or target.frame not in (MavFrame.BODY_FRD, MavFrame.LOCAL_FRD):
            return
        if target.position_valid and not target.distance > 0:  # The firmware would divide by 0.
            return
        self.latest[type(target)] = target
        offset = (target.x, target.y, target.z)
        if not target.position_valid:  # Only the angles from the downward axis are known.
            height = motion.ground_down - motion.down
            offset = (-math.tan(target.angle_y) * height, math.tan(target.angle_x) * height, height)
        north, east, _down = rotated(offset, motion.yaw)  # The offset is relative to the nose.
        self._target = (motion.north + north, motion.east + east)
        self._target_at = self._vehicle.now

    def set_wind(self, command: ReceivedCommand) -> int:
        if command.param1 < 0 or not 0 <= command.param3 <= 360:
            return MavResult.DENIED
        self.wind = (command.param1, command.param3)
        return MavResult.ACCEPTED
