"""RC channels of a simulated ArduPilot: transmitter, RC_CHANNELS_OVERRIDE and MANUAL_CONTROL."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from aerokit.mavlink import messages as m
from aerokit.sim.ardupilot.host import (
    RC_PITCH,
    RC_ROLL,
    RC_THROTTLE,
    RC_YAW,
    SUB_FORWARD,
    SUB_LATERAL,
    SUB_PITCH,
    SUB_ROLL,
    ArduPilotHost,
)
from aerokit.sim.channel import Channel
from aerokit.sim.vehicle import sender_of

_AT_REST = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
_OVERRIDABLE, _CHANNELS = 16, 18
# Values of SIM_RC_FAIL.
_NO_PULSES, _LOW_THROTTLE = 1, 2
_LOW_THROTTLE_PWM = 950
# Values of RC_CHANNELS_OVERRIDE: `_UNCHANGED` keeps a channel, `_RELEASE_UPPER` releases a channel from 9 to 18.
_UNCHANGED, _RELEASE_UPPER = 0xFFFF, 0xFFFE


class ArduPilotRadio:
    """The RC channels. ``radio[2]`` is the pulse width of the throttle in microseconds, with overrides applied.

    Assigning an item moves a stick or switch of the simulated transmitter, which has eight channels.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self._sticks: list[int] = list(_AT_REST)
        # Maps a channel index to the pulse width (0 if released) and the time at which it was received.
        self._overrides: dict[int, tuple[int, float]] = {}
        vehicle.on(m.RcChannelsOverride, self._on_override)

    def __len__(self) -> int:
        return len(self._sticks)

    def __getitem__(self, index: int) -> int:
        if index in self._overrides:
            value, received_at = self._overrides[index]
            if value and self._vehicle.now - received_at < self._override_time():
                return value
        if index == RC_THROTTLE and self._failure == _LOW_THROTTLE:  # set by SIM_RC_FAIL
            return _LOW_THROTTLE_PWM
        return self._sticks[index] if index < len(self._sticks) else 0

    def __setitem__(self, index: int, value: int) -> None:
        self._sticks[index] = value

    def __iter__(self) -> Iterator[int]:
        return (self[index] for index in range(len(self._sticks)))

    @property
    def channels(self) -> tuple[int, ...]:
        if not self._overrides and self._failure != _LOW_THROTTLE:  # Without overrides, a copy is faster.
            return (*self._sticks, *(0,) * (_CHANNELS - len(self._sticks)))
        return tuple(self[index] for index in range(_CHANNELS))

    @property
    def is_receiving(self) -> bool:
        vehicle = self._vehicle
        if not (vehicle.faults.rc_lost or self._failure == _NO_PULSES):
            return True
        expired_before = vehicle.now - self._override_time()
        return any(value and received_at > expired_before for value, received_at in self._overrides.values())

    def override(self, pulses: Mapping[int, int]) -> None:
        """Override channels. ``pulses`` maps channel indices to microseconds. 0 releases a channel."""
        for index, value in pulses.items():
            self._overrides[index] = (value, self._vehicle.now)

    @property
    def _failure(self) -> float:
        return self._vehicle.parameters.get("SIM_RC_FAIL", 0.0)

    def release_overrides(self) -> None:
        self._overrides.clear()

    def _override_time(self) -> float:
        seconds = self._vehicle.parameters["RC_OVERRIDE_TIME"]
        return math.inf if seconds < 0 else seconds

    def _on_override(self, override: m.RcChannelsOverride, _: Channel) -> None:
        vehicle = self._vehicle
        sender_system, _component = sender_of(override)
        if sender_system != vehicle.parameters["MAV_GCS_SYSID"]:
            return
        vehicle.ground_station_seen_at = vehicle.now
        for index in range(_OVERRIDABLE):
            value = getattr(override, f"chan{index + 1}_raw")
            is_upper = index >= len(self._sticks)  # one of the channels 9 to 16
            is_unchanged = value == _UNCHANGED or (is_upper and value == 0)
            is_release = value == _RELEASE_UPPER if is_upper else value == 0
            if not is_unchanged:
                self._overrides[index] = (0 if is_release else value, vehicle.now)


_NO_VALUE = 0x7FFF
_CENTER, _SUB_MIN_PWM, _SUB_MAX_PWM, _SUB_SCALE = 1500, 1100, 1900, 0.4


class ArduPilotJoystick:
    """MANUAL_CONTROL of Copter and Plane: x is pitch, y roll, r yaw (each -1000 to 1000), z throttle (0 to 1000).

    Only messages from the ground station MAV_GCS_SYSID to this vehicle are used. They also count as heartbeats of that
    station. An axis overrides its channel like RC_CHANNELS_OVERRIDE. An axis without a value releases its channel.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        vehicle.on(m.ManualControl, self._on_message)

    def _on_message(self, axes: m.ManualControl, _: Channel) -> None:
        vehicle = self._vehicle
        sender_system, _component = sender_of(axes)
        if sender_system != vehicle.parameters["MAV_GCS_SYSID"] or axes.target != vehicle.system_id:
            return
        vehicle.rc.override(self.sticks(axes))
        vehicle.ground_station_seen_at = vehicle.now

    def sticks(self, axes: m.ManualControl) -> Mapping[int, int]:
        """Return the commanded pulses in microseconds, by channel index. 0 releases a channel."""
        if axes.z < 0:  # Copter ignores a message with negative thrust (GCS_MAVLink_Copter.cpp).
            return {}
        return {
            RC_ROLL: self.pulse(RC_ROLL, axes.y),
            RC_PITCH: self.pulse(RC_PITCH, axes.x, reverse=True),
            RC_THROTTLE: self.pulse(RC_THROTTLE, axes.z, lowest=0),
            RC_YAW: self.pulse(RC_YAW, axes.r),
        }

    def pulse(self, channel: int, value: int, *, lowest: int = -1000, reverse: bool = False) -> int:
        """Scale the value of an axis to RCn_MIN … RCn_MAX. Return 0 if the message has no value for the axis."""
        if value == _NO_VALUE:
            return 0
        parameters = self._vehicle.parameters
        low = parameters.get(f"RC{channel + 1}_MIN", 1100.0)
        high = parameters.get(f"RC{channel + 1}_MAX", 1900.0)
        if reverse:
            value = -value
        share = (value - lowest) / (1000 - lowest)
        # Like the firmware, do not limit an axis that is out of range. The mask keeps the 16 bits of a pulse.
        return int(low + (high - low) * share) & 0xFFFF


class RoverJoystick(ArduPilotJoystick):
    """MANUAL_CONTROL of Rover: y is the steering and z the throttle, both from -1000 to 1000."""

    def sticks(self, axes: m.ManualControl) -> Mapping[int, int]:
        return {RC_ROLL: self.pulse(RC_ROLL, axes.y), RC_THROTTLE: self.pulse(RC_THROTTLE, axes.z)}


class SubJoystick(ArduPilotJoystick):
    """MANUAL_CONTROL of Sub: x is forward, y sideways, z vertical (500 is the middle), r yaw, s pitch and t roll.

    x, y, z and r are scaled by JS_GAIN_DEFAULT, z also by JS_THR_GAIN. Buttons are ignored.
    """

    def sticks(self, axes: m.ManualControl) -> Mapping[int, int]:
        parameters = self._vehicle.parameters
        gain = max(0.1, min(1.0, parameters.get("JS_GAIN_DEFAULT", 0.5)))
        scale = _SUB_SCALE * gain
        throttle_scale = 2 * scale * parameters.get("JS_THR_GAIN", 1.0)
        throttle = axes.z * throttle_scale + _CENTER - 500 * throttle_scale  # 500 is the middle of the axis z.
        # The firmware does not scale pitch and roll, and does not check that the message contains them (joystick.cpp).
        offsets = {
            SUB_PITCH: axes.s, SUB_ROLL: axes.t, RC_YAW: axes.r * scale, SUB_FORWARD: axes.x * scale,
            SUB_LATERAL: axes.y * scale,
        }  # fmt: skip
        pulses = {channel: _CENTER + offset for channel, offset in offsets.items()} | {RC_THROTTLE: throttle}
        return {channel: int(max(_SUB_MIN_PWM, min(_SUB_MAX_PWM, pulse))) for channel, pulse in pulses.items()}
