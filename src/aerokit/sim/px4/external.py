"""Measurements that a companion computer sends to a simulated PX4."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.message import Message
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.channel import Channel
from aerokit.sim.commands import ReceivedCommand
from aerokit.sim.motion import GlobalPoint

_SENSORS = (m.ObstacleDistance, m.DistanceSensor, m.OpticalFlowRad)
_VISION_TIMEOUT_S = 5.0
_HORIZONTAL, _GPS_POSITION = 1, 1


class Px4External:
    """Measurements of external sensors. Only vision and landing targets affect the vehicle."""

    def __init__(self, px4: SimulatedAutopilot) -> None:
        self._px4 = px4
        self.latest: dict[type[Message], Message] = {}
        self.clock_answers: int = 0
        """Number of answers to the vehicle's TIMESYNC requests."""
        self.origin: GlobalPoint | None = None
        """Origin set by SET_GPS_GLOBAL_ORIGIN."""
        self._vision_at = self._target_at = -math.inf  # times of the last measurements
        self._target: tuple[float, float] = (0.0, 0.0)  # (north, east) of the landing target
        self.wind: tuple[float, float] | None = None
        """Wind of EXTERNAL_WIND_ESTIMATE: the speed in m/s, and the direction in degrees from which it comes."""
        px4.on(m.Odometry, self._on_vision)
        px4.on(m.VisionPositionEstimate, self._on_vision)
        px4.on(m.LandingTarget, self._on_target)
        px4.on(m.SetGpsGlobalOrigin, self._on_origin)
        px4.observe(m.Timesync, self._on_timesync)
        for sensor in _SENSORS:
            px4.on(sensor, self._on_sensor)

    @property
    def has_gps(self) -> bool:
        is_used = int(self._px4.parameters["EKF2_GPS_CTRL"]) & _GPS_POSITION
        return bool(is_used) and not self._px4.faults.gps_lost

    @property
    def has_vision(self) -> bool:
        is_used = int(self._px4.parameters["EKF2_EV_CTRL"]) & _HORIZONTAL
        return bool(is_used) and self._px4.now - self._vision_at <= _VISION_TIMEOUT_S

    @property
    def target(self) -> tuple[float, float] | None:
        """Landing target (north, east) in the world frame."""
        is_fresh = self._px4.now - self._target_at <= self._px4.parameters["PLD_BTOUT"]
        return self._target if is_fresh else None

    def set_wind(self, command: ReceivedCommand) -> int:
        # The wind has no effect on the flight.
        self.wind = (command.param1, command.param3)
        return MavResult.ACCEPTED

    def _on_vision(self, message: Message, _: Channel) -> None:
        self.latest[type(message)] = message
        if not isinstance(message, m.Odometry) or math.isfinite(message.x):
            self._vision_at = self._px4.now

    def _on_sensor(self, message: Message, _: Channel) -> None:
        self.latest[type(message)] = message

    def _on_target(self, target: m.LandingTarget, _: Channel) -> None:
        if target.position_valid and target.frame == MavFrame.LOCAL_NED:
            self.latest[type(target)] = target
            self._target = (target.x, target.y)
            self._target_at = self._px4.now

    def _on_origin(self, message: m.SetGpsGlobalOrigin, channel: Channel) -> None:
        if message.target_system == self._px4.system_id:
            self.origin = GlobalPoint(message.latitude, message.longitude, message.altitude / 1000)
            self._px4.send_built(m.GpsGlobalOrigin.ID, channel)

    def _on_timesync(self, message: m.Timesync, _: Channel) -> None:
        is_answer = message.tc1 != 0
        if is_answer:
            self.clock_answers += 1
