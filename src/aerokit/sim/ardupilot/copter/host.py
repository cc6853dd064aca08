"""What the parts of a simulated ArduCopter use of it beside what every ArduPilot has: its heading and its way back."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.sim.ardupilot.smart_path import SmartPath
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import wrap_pi

_LOOK_AHEAD_FROM_M_S = 0.5


class AutoYaw:
    """One of: hold the heading, look ahead, a fixed heading, a turn rate, a region of interest."""

    def __init__(self, copter: ArduPilotVehicle) -> None:
        self._copter = copter
        self._apply: Callable[[], None] = self._hold
        self._roi: tuple[float, float] | None = None
        self._heading = 0.0
        self._rate = 0.0

    def hold(self) -> None:
        self._apply = self._hold
        self._copter.motion.turn(0.0)

    def default(self, *, returning: bool = False) -> None:
        """As WP_YAW_BEHAVIOR says: hold (0), look ahead (1), look ahead but on the way home (2).

        Every new guided target does this, and so ends a heading or a region of interest that was commanded
        before.
        """
        behaviour = int(self._copter.parameters["WP_YAW_BEHAVIOR"])
        if behaviour == 1 or (behaviour == 2 and not returning):
            self._apply = self._look_ahead
        else:
            self.hold()

    def fixed(self, heading: float, rate: float = 0.0, direction: int = 0) -> None:
        """Turn to a heading in radians; ``rate`` 0 is the default, ``direction`` -1 or 1 the way round."""
        self._heading, self._apply = wrap_pi(heading), self._go_to_heading
        self._rate = 0.0
        offset = wrap_pi(self._heading - self._copter.motion.yaw)
        if direction and math.copysign(1, offset) != direction and abs(offset) > 0.02:
            self._rate = direction * (rate or self._copter.motion.limits.turn_rate_rad_s)

    def keep_fixed(self, tolerance: float) -> bool:
        """Go back to the heading of `fixed`, whatever came since; whether it is reached, within radians."""
        self._apply = self._go_to_heading
        return abs(wrap_pi(self._heading - self._copter.motion.yaw)) <= tolerance

    @property
    def has_region_of_interest(self) -> bool:
        return self._apply == self._look_at_roi

    def turn(self, rate: float) -> None:
        """Keep turning, in radians per second."""
        self._rate, self._apply = rate, self._turn

    def region_of_interest(self, point: Ned | None) -> None:
        """Look at a place until the next target; None ends it. A gimbal does so in the vehicle's place."""
        gimbal = self._copter.gimbal
        gimbal.look_at(point)
        if point is None:
            self.default()
        elif not gimbal.is_fitted:
            self._roi = point[:2]
            self._apply = self._look_at_roi

    def stop_turning(self) -> None:
        """What a lost stream of turn rates leads to."""
        if self._apply == self._turn:
            self.hold()

    def update(self) -> None:
        """Tell the motion what to do now."""
        self._apply()

    def _hold(self) -> None:
        pass

    def _turn(self) -> None:
        self._copter.motion.turn(self._rate)

    def _look_ahead(self) -> None:
        motion = self._copter.motion
        if motion.ground_speed_m_s > _LOOK_AHEAD_FROM_M_S:
            motion.face(math.atan2(motion.velocity_east, motion.velocity_north))

    def _go_to_heading(self) -> None:
        motion = self._copter.motion
        offset = wrap_pi(self._heading - motion.yaw)
        if self._rate and math.copysign(1, offset) != math.copysign(1, self._rate):
            motion.turn(self._rate)  # the long way round
            return
        self._rate = 0.0
        motion.face(self._heading)

    def _look_at_roi(self) -> None:
        assert self._roi is not None
        motion = self._copter.motion
        motion.face(math.atan2(self._roi[1] - motion.east, self._roi[0] - motion.north))


class CopterHost(ArduPilotVehicle):
    """A copter, as its modes and failsafes see it."""

    def reset_controllers(self) -> None:
        """Where it points its nose, and the way back of SMART_RTL."""
        self.yaw: AutoYaw = AutoYaw(self)
        self.path: SmartPath = SmartPath(self, only_armed=True)

    def _become_ready(self) -> None:
        super()._become_ready()
        self.path.start()

    def look_at(self, place: Ned | None) -> None:
        self.yaw.region_of_interest(place)
