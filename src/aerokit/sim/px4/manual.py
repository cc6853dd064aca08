"""Manual control of a simulated PX4: stick positions and the manual modes."""

from __future__ import annotations

import math

from aerokit.mavlink import messages as m
from aerokit.sim.channel import Channel
from aerokit.sim.commands import rotated
from aerokit.sim.motion import GRAVITY_M_S2
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.modes import ALTITUDE, ALTITUDE_CRUISE, POSITION, POSITION_SLOW, STICK_MODES

_NO_MANUAL_CONTROL = 4
_UNUSED = 65535
_CHANNELS = 18
_CHANNEL_PARAMETERS = ("RC_MAP_ROLL", "RC_MAP_PITCH", "RC_MAP_YAW", "RC_MAP_THROTTLE")


class Px4Sticks:
    """The latest stick positions, from -1 to 1. Right, forward, clockwise and up are positive."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self.roll: float = 0.0
        self.pitch: float = 0.0
        self.yaw: float = 0.0
        self.throttle: float = -1.0
        self.channels: tuple[int, ...] = ()  # Pulses of the latest RC_CHANNELS_OVERRIDE in µs.
        self._moved_at = self._channels_at = -math.inf
        px4.on(m.ManualControl, self._on_manual_control)
        px4.on(m.RcChannelsOverride, self._on_override)

    @property
    def are_fresh(self) -> bool:
        return self.are_wanted and self._px4.now - self._moved_at <= self._px4.parameters["COM_RC_LOSS_T"]

    @property
    def are_wanted(self) -> bool:
        return round(self._px4.parameters["COM_RC_IN_MODE"]) != _NO_MANUAL_CONTROL

    @property
    def has_channels(self) -> bool:
        return self._px4.now - self._channels_at <= self._px4.parameters["COM_RC_LOSS_T"]

    def _on_manual_control(self, control: m.ManualControl, _: Channel) -> None:
        if control.target not in (0, self._px4.system_id):
            return
        values = (control.x, control.y, control.z, control.r)
        if any(not -1000 <= value <= 1000 for value in values):  # PX4 ignores a message with an axis out of range.
            return
        self._move(roll=control.y / 1000, pitch=control.x / 1000, yaw=control.r / 1000, throttle=control.z / 500 - 1.0)

    def _on_override(self, override: m.RcChannelsOverride, _: Channel) -> None:
        values = [getattr(override, f"chan{number}_raw") for number in range(1, _CHANNELS + 1)]
        self.channels = tuple(values)
        self._channels_at = self._px4.now
        numbers = [round(self._px4.parameters[name]) for name in _CHANNEL_PARAMETERS]
        if all(0 < number <= _CHANNELS for number in numbers):
            roll, pitch, yaw, throttle = (_stick_position(values[number - 1]) for number in numbers)
            self._move(roll, pitch, yaw, throttle)

    def _move(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        previous = (self.roll, self.pitch, self.yaw, self.throttle)
        were_fresh = self.are_fresh
        self.roll = roll
        self.pitch = pitch
        self.yaw = yaw
        self.throttle = throttle
        self._moved_at = self._px4.now
        if were_fresh:  # The first positions after a silence are not compared with the old positions.
            present = (roll, pitch, yaw, throttle)
            largest_movement = max(abs(new - old) for new, old in zip(present, previous, strict=True))
            self._px4.on_sticks_moved(largest_movement)


def _stick_position(pulse_us: int) -> float:
    """Scale a pulse in microseconds to the range from -1 to 1."""
    if pulse_us in (0, _UNUSED):
        return 0.0
    return max(-1.0, min(1.0, (pulse_us - 1500) / 500))


def curved(value: float, share: float, dead_zone: float = 0.0) -> float:
    """Apply a dead zone and a curve to a stick position. ``share`` is 0 for a line, 1 for a cubic curve."""
    size = abs(value)
    if size <= dead_zone:
        return 0.0
    deflection = math.copysign((size - dead_zone) / (1.0 - dead_zone), value)
    return share * deflection**3 + (1.0 - share) * deflection


_EXPO, _DEAD_ZONE = 0.6, 0.1
_SLOW_SHARE = 0.3
_LIFTS_OFF_ABOVE = 0.05
_AT_REST_M_S = 0.3
_VELOCITY_TIME_CONSTANT_S = 0.3  # as in `Motion`

_HOLDS_HEIGHT = frozenset({ALTITUDE, ALTITUDE_CRUISE, POSITION, POSITION_SLOW})
_HOLDS_PLACE = frozenset({POSITION, POSITION_SLOW})


class Px4ManualFlight:
    """Converts stick positions to motion targets. In manual modes, `update` is called at every tick."""

    def __init__(self, px4: Px4Host) -> None:
        self._px4 = px4
        self._place: tuple[float, float] | None = None  # place to hold; None while the vehicle moves
        self._down: float | None = None  # down coordinate to hold; None while the vehicle moves vertically
        self._turn_rate_rad_s = px4.motion.limits.turn_rate_rad_s

    def enter(self) -> None:
        self._place = self._down = None
        # Restore the limit, which `update` changes.
        self._px4.motion.limits.turn_rate_rad_s = self._turn_rate_rad_s

    @property
    def wants_up(self) -> bool:
        px4 = self._px4
        if px4.mode not in STICK_MODES or not px4.sticks.are_fresh:
            return False
        if px4.mode in _HOLDS_HEIGHT:
            return curved(px4.sticks.throttle, _EXPO, _DEAD_ZONE) > _LIFTS_OFF_ABOVE
        return self._thrust > 1.0

    def update(self) -> None:
        px4, sticks = self._px4, self._px4.sticks
        max_rate = math.radians(px4.parameters["MPC_MAN_Y_MAX"])
        px4.motion.limits.turn_rate_rad_s = max_rate
        px4.motion.turn(max_rate * curved(sticks.yaw, _EXPO, _DEAD_ZONE))
        if px4.mode in _HOLDS_PLACE:
            self._fly_velocity()
            return
        down = self._height_velocity() if px4.mode in _HOLDS_HEIGHT else self._velocity_of_thrust()
        tilt = math.radians(px4.parameters["MPC_MAN_TILT_MAX"])
        pitch = -tilt * sticks.pitch  # A stick pushed forward (positive) lowers the nose (negative).
        px4.motion.seek_attitude(tilt * sticks.roll, pitch, down)

    def _fly_velocity(self) -> None:
        px4, sticks, motion = self._px4, self._px4.sticks, self._px4.motion
        max_speed = px4.parameters["MPC_VEL_MANUAL"] * (_SLOW_SHARE if px4.mode == POSITION_SLOW else 1.0)
        forward = max_speed * curved(sticks.pitch, _EXPO, _DEAD_ZONE)
        right = max_speed * curved(sticks.roll, _EXPO, _DEAD_ZONE)
        down = self._height_velocity()
        if forward or right:
            self._place = None  # The pilot moves the vehicle, so no place is held.
            motion.seek_velocity(*rotated((forward, right, down), motion.yaw))
        else:
            self._hold_position(down)

    def _hold_position(self, down: float) -> None:
        """Hold the horizontal place, with the vertical velocity ``down``."""
        motion = self._px4.motion
        if self._place is None:  # After a movement, the vehicle first stops, and then holds the place of its stop.
            if motion.ground_speed_m_s > _AT_REST_M_S:
                motion.seek_velocity(0.0, 0.0, down)
                return
            self._place = (motion.north, motion.east)
        north, east = self._place
        motion.seek_velocity(north - motion.north, east - motion.east, down)  # 1 m/s for each metre of distance

    def _height_velocity(self) -> float:
        """Return the vertical velocity in m/s (down) that the throttle stick commands."""
        px4, motion = self._px4, self._px4.motion
        throttle = curved(px4.sticks.throttle, _EXPO, _DEAD_ZONE)
        if throttle:
            self._down = None
            return -throttle * px4.parameters["MPC_Z_VEL_MAX_UP" if throttle > 0 else "MPC_Z_VEL_MAX_DN"]
        if self._down is None:
            if abs(motion.velocity_down) > _AT_REST_M_S:  # First stop, then hold the height of the stop.
                return 0.0
            self._down = motion.down
        return self._down - motion.down  # 1 m/s for each metre of distance

    @property
    def _thrust(self) -> float:
        """Thrust divided by the hover thrust."""
        parameters, throttle = self._px4.parameters, self._px4.sticks.throttle
        hover, min_thrust = parameters["MPC_THR_HOVER"], parameters["MPC_MANTHR_MIN"]
        thrust_range = 1.0 - hover if throttle > 0 else hover - min_thrust
        return (hover + throttle * thrust_range) / hover

    def _velocity_of_thrust(self) -> float:
        """Convert the thrust to a target velocity (m/s down) that gives the same vertical acceleration."""
        motion = self._px4.motion
        lift = self._thrust * math.cos(motion.roll) * math.cos(motion.pitch)
        return motion.velocity_down + (1.0 - lift) * GRAVITY_M_S2 * _VELOCITY_TIME_CONSTANT_S
