"""Manual control of a simulated PX4: MANUAL_CONTROL, and RC_CHANNELS_OVERRIDE where channels are assigned.

As on a real vehicle without a calibrated receiver, RC_CHANNELS_OVERRIDE is told in RC_CHANNELS and flies nothing until
RC_MAP_ROLL, RC_MAP_PITCH, RC_MAP_YAW and RC_MAP_THROTTLE name channels. https://mavlink.io/en/services/manual_control.html
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["Sticks", "curved"]

_NO_MANUAL_CONTROL = 4
_UNUSED = 65535
_CHANNELS = 18
_MAPS = ("RC_MAP_ROLL", "RC_MAP_PITCH", "RC_MAP_YAW", "RC_MAP_THROTTLE")


class Sticks:
    """The latest position of the sticks, -1 to 1 each: right, forward, clockwise and up are positive."""

    def __init__(self, px4: SimulatedPx4) -> None:
        self._px4 = px4
        self.roll: float = 0.0
        self.pitch: float = 0.0
        self.yaw: float = 0.0
        self.throttle: float = -1.0
        self.channels: tuple[int, ...] = ()
        """What RC_CHANNELS_OVERRIDE said last, in µs."""
        self._at = self._channels_at = -math.inf
        px4.on(m.ManualControl, self._on_manual_control)
        px4.on(m.RcChannelsOverride, self._on_override)

    @property
    def are_fresh(self) -> bool:
        """Whether they are wanted and keep coming; COM_RC_LOSS_T is the patience."""
        return self.are_wanted and self._px4.now - self._at <= self._px4.parameters["COM_RC_LOSS_T"]

    @property
    def are_wanted(self) -> bool:
        """False with COM_RC_IN_MODE 4."""
        return round(self._px4.parameters["COM_RC_IN_MODE"]) != _NO_MANUAL_CONTROL

    @property
    def has_channels(self) -> bool:
        """Whether RC_CHANNELS_OVERRIDE keeps coming."""
        return self._px4.now - self._channels_at <= self._px4.parameters["COM_RC_LOSS_T"]

    def _on_manual_control(self, control: m.ManualControl, _: Channel) -> None:
        if control.target not in (0, self._px4.system_id):
            return
        values = (control.x, control.y, control.z, control.r)
        if any(not -1000 <= value <= 1000 for value in values):
            return
        self._move(control.y / 1000, control.x / 1000, control.r / 1000, control.z / 500 - 1.0)

    def _on_override(self, override: m.RcChannelsOverride, _: Channel) -> None:
        values = [getattr(override, f"chan{number}_raw") for number in range(1, _CHANNELS + 1)]
        self.channels, self._channels_at = tuple(values), self._px4.now
        numbers = [round(self._px4.parameters[name]) for name in _MAPS]
        if all(0 < number <= _CHANNELS for number in numbers):
            roll, pitch, yaw, throttle = (_share(values[number - 1]) for number in numbers)
            self._move(roll, pitch, yaw, throttle)

    def _move(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        before, were_fresh = (self.roll, self.pitch, self.yaw, self.throttle), self.are_fresh
        self.roll = roll
        self.pitch = pitch
        self.yaw = yaw
        self.throttle = throttle
        self._at = self._px4.now
        if were_fresh:
            moved = max(abs(new - old) for new, old in zip((roll, pitch, yaw, throttle), before, strict=True))
            self._px4.sticks_moved(moved)


def _share(pulse_us: int) -> float:
    """-1 to 1 of the 1000 to 2000 µs that a channel is calibrated to; the centre for one that is not used."""
    if pulse_us in (0, _UNUSED):
        return 0.0
    return max(-1.0, min(1.0, (pulse_us - 1500) / 500))


def curved(value: float, share: float, dead_zone: float = 0.0) -> float:
    """A stick's value with MPC_HOLD_DZ around the centre, and ``share`` of a cube in it (MPC_XY_MAN_EXPO)."""
    size = abs(value)
    if size <= dead_zone:
        return 0.0
    moved = math.copysign((size - dead_zone) / (1.0 - dead_zone), value)
    return share * moved**3 + (1.0 - share) * moved
