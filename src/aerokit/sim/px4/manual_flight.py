"""How a simulated PX4 multicopter flies by hand: POSITION, ALTITUDE, and simply MANUAL, STABILIZED and ACRO.

POSITION: sticks are velocities, and the centre stays where it is. ALTITUDE: the right stick leans it, the left one
climbs. MANUAL and STABILIZED: it leans, and the left stick is thrust. ACRO leans like STABILIZED, which is not so in
reality. https://docs.px4.io/main/en/flight_modes_mc/
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.sim.motion import GRAVITY_M_S2
from aerokit.sim.px4.modes import ALTITUDE, ALTITUDE_CRUISE, POSITION, POSITION_SLOW, STICK_MODES
from aerokit.sim.px4.sticks import curved

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["ManualFlight"]

_EXPO, _DEAD_ZONE = 0.6, 0.1
_SLOW_SHARE = 0.3
_LIFTS_OFF_ABOVE = 0.05
_AT_REST_M_S = 0.3
_THRUST_AHEAD_S = 0.3
"""The time constant with which the motion follows a velocity."""

_HOLDS_HEIGHT = frozenset({ALTITUDE, ALTITUDE_CRUISE, POSITION, POSITION_SLOW})
_HOLDS_PLACE = frozenset({POSITION, POSITION_SLOW})


class ManualFlight:
    """Sticks to motion. `update` is called fifty times a second in a mode flown by hand."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self._place: tuple[float, float] | None = None
        self._down: float | None = None
        self._turn_rate_rad_s = px4.motion.limits.turn_rate_rad_s

    def enter(self) -> None:
        """A mode begins: nothing is held yet."""
        self._place = self._down = None
        self._px4.motion.limits.turn_rate_rad_s = self._turn_rate_rad_s

    @property
    def wants_up(self) -> bool:
        """Whether the left stick leaves the ground."""
        px4 = self._px4
        if px4.mode not in STICK_MODES or not px4.sticks.are_fresh:
            return False
        if px4.mode in _HOLDS_HEIGHT:
            return curved(px4.sticks.throttle, _EXPO, _DEAD_ZONE) > _LIFTS_OFF_ABOVE
        return self._thrust > 1.0

    def update(self) -> None:
        """Tell the motion what to do until the next tick."""
        px4, sticks = self._px4, self._px4.sticks
        fastest = math.radians(px4.parameters["MPC_MAN_Y_MAX"])
        px4.motion.limits.turn_rate_rad_s = fastest
        px4.motion.turn(fastest * curved(sticks.yaw, _EXPO, _DEAD_ZONE))
        if px4.mode in _HOLDS_PLACE:
            self._fly_velocity()
            return
        down = self._height_velocity() if px4.mode in _HOLDS_HEIGHT else self._velocity_of_thrust()
        tilt = math.radians(px4.parameters["MPC_MAN_TILT_MAX"])
        px4.motion.seek_attitude(tilt * sticks.roll, -tilt * sticks.pitch, down)

    # ------------------------------------------------------------------------------------- by velocity

    def _fly_velocity(self) -> None:
        px4, sticks, motion = self._px4, self._px4.sticks, self._px4.motion
        fastest = px4.parameters["MPC_VEL_MANUAL"] * (_SLOW_SHARE if px4.mode == POSITION_SLOW else 1.0)
        forward = fastest * curved(sticks.pitch, _EXPO, _DEAD_ZONE)
        right = fastest * curved(sticks.roll, _EXPO, _DEAD_ZONE)
        down = self._height_velocity()
        if forward or right:
            self._place = None
            cos_yaw, sin_yaw = math.cos(motion.yaw), math.sin(motion.yaw)
            motion.seek_velocity(
                forward * cos_yaw - right * sin_yaw, forward * sin_yaw + right * cos_yaw, down
            )
        else:
            self._stay(down)

    def _stay(self, down: float) -> None:
        """Brake, and then hold the place."""
        motion = self._px4.motion
        if self._place is None:
            if motion.ground_speed_m_s > _AT_REST_M_S:
                motion.seek_velocity(0.0, 0.0, down)
                return
            self._place = (motion.north, motion.east)
        offset_north, offset_east = self._place[0] - motion.north, self._place[1] - motion.east
        motion.seek_velocity(offset_north, offset_east, down)

    def _height_velocity(self) -> float:
        """Down, in m/s: as the stick says, or what holds the height."""
        px4, motion = self._px4, self._px4.motion
        wanted = curved(px4.sticks.throttle, _EXPO, _DEAD_ZONE)
        if wanted > 0:
            self._down = None
            return -wanted * px4.parameters["MPC_Z_VEL_MAX_UP"]
        if wanted < 0:
            self._down = None
            return -wanted * px4.parameters["MPC_Z_VEL_MAX_DN"]
        if self._down is None:
            if abs(motion.velocity_down) > _AT_REST_M_S:
                return 0.0
            self._down = motion.down
        return self._down - motion.down

    # --------------------------------------------------------------------------------------- by thrust

    @property
    def _thrust(self) -> float:
        """In parts of what hovers: the stick's centre hovers, MPC_MANTHR_MIN is its lower end."""
        values, throttle = self._px4.parameters, self._px4.sticks.throttle
        hover, least = values["MPC_THR_HOVER"], values["MPC_MANTHR_MIN"]
        thrust = hover + (throttle * (1.0 - hover) if throttle > 0 else throttle * (hover - least))
        return thrust / hover

    def _velocity_of_thrust(self) -> float:
        """What thrust makes of the vertical speed."""
        motion = self._px4.motion
        lift = self._thrust * math.cos(motion.roll) * math.cos(motion.pitch)
        return motion.velocity_down + (1.0 - lift) * GRAVITY_M_S2 * _THRUST_AHEAD_S
