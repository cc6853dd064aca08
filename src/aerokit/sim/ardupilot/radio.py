"""The pilot's radio, and what RC_CHANNELS_OVERRIDE puts in its place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.messages import ManualControl
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import sender_of

_AT_REST = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
_OVERRIDABLE, _CHANNELS = 16, 18
_NO_PULSES, _LOW_THROTTLE = 1, 2
"""SIM_RC_FAIL."""
_LOW_THROTTLE_PWM = 950
_SAME_AS_BEFORE, _RELEASE_UPPER = 0xFFFF, 0xFFFE


class Radio:
    """What the vehicle hears: ``radio[2]`` is the throttle, in microseconds, overridden or not.

    Setting an item moves a stick or switch of the transmitter, of which there are eight.
    """

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self._sticks: list[int] = list(_AT_REST)
        self._overrides: dict[int, tuple[int, float]] = {}

    def __len__(self) -> int:
        return len(self._sticks)

    def __getitem__(self, index: int) -> int:
        if index in self._overrides:
            value, since = self._overrides[index]
            if value and self._vehicle.now - since < self._override_time():
                return value
        if index == _THROTTLE and self._failure == _LOW_THROTTLE:
            return _LOW_THROTTLE_PWM
        return self._sticks[index] if index < len(self._sticks) else 0

    def __setitem__(self, index: int, value: int) -> None:
        self._sticks[index] = value

    def __iter__(self) -> Iterator[int]:
        return (self[index] for index in range(len(self._sticks)))

    @property
    def channels(self) -> tuple[int, ...]:
        """All 18 that RC_CHANNELS has; those that nobody sends are 0."""
        if not self._overrides and self._failure != _LOW_THROTTLE:
            return (*self._sticks, *(0,) * (_CHANNELS - len(self._sticks)))
        return tuple(self[index] for index in range(_CHANNELS))

    @property
    def is_heard(self) -> bool:
        """Whether there are pulses: of the transmitter, or of RC_CHANNELS_OVERRIDE in its place."""
        vehicle = self._vehicle
        if not (vehicle.faults.rc_lost or self._failure == _NO_PULSES):
            return True
        limit = vehicle.now - self._override_time()
        return any(value and since > limit for value, since in self._overrides.values())

    def override(self, pulses: Mapping[int, int]) -> None:
        """Put these in the place of channels, from 0, as long as RC_OVERRIDE_TIME says; 0 gives one back."""
        for index, value in pulses.items():
            self._overrides[index] = (value, self._vehicle.now)

    @property
    def _failure(self) -> float:
        return self._vehicle.parameters.get("SIM_RC_FAIL", 0.0)

    def release_overrides(self) -> None:
        """Forget what was overridden, as a lost ground station makes the vehicle do."""
        self._overrides.clear()

    def listen(self) -> None:
        """Hear RC_CHANNELS_OVERRIDE."""
        self._vehicle.on(m.RcChannelsOverride, self._on_override)

    def reset(self) -> None:
        """Forget what was overridden, as a reboot does."""
        self._overrides.clear()

    def _override_time(self) -> float:
        """Seconds for which an override holds; below 0 means for ever."""
        seconds = self._vehicle.parameters["RC_OVERRIDE_TIME"]
        return math.inf if seconds < 0 else seconds

    def _on_override(self, override: m.RcChannelsOverride, _: Channel) -> None:
        """Only of the vehicle's own ground station. 0 leaves channels above 8 as they are, and releases the others."""
        vehicle = self._vehicle
        if sender_of(override)[0] != vehicle.parameters["MAV_GCS_SYSID"]:
            return
        vehicle.failsafes.ground_station_seen_at = vehicle.now
        for index in range(_OVERRIDABLE):
            value = getattr(override, f"chan{index + 1}_raw")
            if value == _SAME_AS_BEFORE or (value == 0 and index >= len(self._sticks)):
                continue
            if value == _RELEASE_UPPER and index >= len(self._sticks):
                value = 0
            self._overrides[index] = (value, vehicle.now)


_NO_VALUE = 0x7FFF
_ROLL, _PITCH, _THROTTLE, _YAW, _FORWARD, _LATERAL = range(6)
_CENTRE, _SUB_LOWEST, _SUB_HIGHEST = 1500, 1100, 1900


class Joystick:
    """Copter and Plane: x is pitch, y roll, z throttle (0 to 1000), r yaw, each -1000 to 1000 else.

    Only of the vehicle's own ground station, and for this vehicle; it counts as a heartbeat of it. An axis that has no
    value is given back to the radio. It holds as long as RC_CHANNELS_OVERRIDE does.
    """

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        vehicle.on(ManualControl, self._on_message)

    def _on_message(self, axes: ManualControl, _: Channel) -> None:
        vehicle = self._vehicle
        if sender_of(axes)[0] != vehicle.parameters["MAV_GCS_SYSID"] or axes.target != vehicle.system_id:
            return
        vehicle.rc.override(self.sticks(axes))
        vehicle.failsafes.ground_station_seen_at = vehicle.now

    def sticks(self, axes: ManualControl) -> Mapping[int, int]:
        """Channel, from 0, → pulse in microseconds; 0 gives it back."""
        if axes.z < 0:
            return {}
        return {
            _ROLL: self.pulse(_ROLL, axes.y),
            _PITCH: self.pulse(_PITCH, axes.x, reverse=True),
            _THROTTLE: self.pulse(_THROTTLE, axes.z, lowest=0),
            _YAW: self.pulse(_YAW, axes.r),
        }

    def pulse(self, channel: int, value: int, *, lowest: int = -1000, reverse: bool = False) -> int:
        """Between RCn_MIN and RCn_MAX; 0 of an axis without a value."""
        if value == _NO_VALUE:
            return 0
        low, high = self.setting(f"RC{channel + 1}_MIN", 1100.0), self.setting(f"RC{channel + 1}_MAX", 1900.0)
        share = ((-value if reverse else value) - lowest) / (1000 - lowest)
        return int(low + (high - low) * share) & 0xFFFF  # nothing checks the range of an axis

    def setting(self, name: str, default: float) -> float:
        """A parameter that a small table may be without."""
        return self._vehicle.parameters.get(name, default)


class LevelJoystick(Joystick):
    """Rover: y steers, z drives, -1000 to 1000."""

    def sticks(self, axes: ManualControl) -> Mapping[int, int]:
        return {
            _ROLL: self.pulse(_ROLL, axes.y),
            _THROTTLE: self.pulse(_THROTTLE, axes.z),
        }


class SubJoystick(Joystick):
    """Sub: x is forward, y sideways, z up and down (500 is the middle), r yaw; s and t pitch and roll.

    Scaled by JS_GAIN_DEFAULT, and z by JS_THR_GAIN besides. Buttons do nothing.
    """

    _SCALE: ClassVar[float] = 0.4

    def sticks(self, axes: ManualControl) -> Mapping[int, int]:
        gain = max(0.1, min(1.0, self.setting("JS_GAIN_DEFAULT", 0.5)))
        throttle_scale = 2 * self._SCALE * gain * self.setting("JS_THR_GAIN", 1.0)
        throttle = axes.z * throttle_scale + _CENTRE - 500 * throttle_scale
        levers = {
            _ROLL: axes.s, _PITCH: axes.t, _YAW: axes.r * self._SCALE * gain,
            _FORWARD: axes.x * self._SCALE * gain, _LATERAL: axes.y * self._SCALE * gain,
        }  # fmt: skip
        pulses = {channel: _CENTRE + value for channel, value in levers.items()} | {_THROTTLE: throttle}
        return {channel: int(max(_SUB_LOWEST, min(_SUB_HIGHEST, pulse))) for channel, pulse in pulses.items()}
