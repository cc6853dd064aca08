"""MANUAL_CONTROL: a joystick in the place of the pilot's radio, as each kind of ArduPilot maps its axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.messages import ManualControl
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.channel import Channel

__all__ = ["Joystick", "LevelJoystick", "SubJoystick"]

_NO_VALUE = 0x7FFF
_ROLL, _PITCH, _THROTTLE, _YAW, _FORWARD, _LATERAL = range(6)
_CENTRE, _SUB_LOWEST, _SUB_HIGHEST = 1500, 1100, 1900


class Joystick:
    """Copter and Plane: x is pitch, y roll, z throttle (0 to 1000), r yaw, each -1000 to 1000 else.

    Only of the vehicle's own ground station, and for this vehicle; it counts as a heartbeat of it. An axis that has no
    value is given back to the radio. It holds as long as RC_CHANNELS_OVERRIDE does.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
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
        """Two channels."""
        return {_ROLL: self.pulse(_ROLL, axes.y), _THROTTLE: self.pulse(_THROTTLE, axes.z)}


class SubJoystick(Joystick):
    """Sub: x is forward, y sideways, z up and down (500 is the middle), r yaw; s and t pitch and roll.

    Scaled by JS_GAIN_DEFAULT, and z by JS_THR_GAIN besides. Buttons do nothing.
    """

    _SCALE: ClassVar[float] = 0.4

    def sticks(self, axes: ManualControl) -> Mapping[int, int]:
        """Six channels; the first two are pitch and roll."""
        gain = max(0.1, min(1.0, self.setting("JS_GAIN_DEFAULT", 0.5)))
        throttle_scale = 2 * self._SCALE * gain * self.setting("JS_THR_GAIN", 1.0)
        throttle = axes.z * throttle_scale + _CENTRE - 500 * throttle_scale
        levers = {
            _ROLL: axes.s, _PITCH: axes.t, _YAW: axes.r * self._SCALE * gain,
            _FORWARD: axes.x * self._SCALE * gain, _LATERAL: axes.y * self._SCALE * gain,
        }  # fmt: skip
        pulses = {channel: _CENTRE + value for channel, value in levers.items()} | {_THROTTLE: throttle}
        return {channel: int(max(_SUB_LOWEST, min(_SUB_HIGHEST, pulse))) for channel, pulse in pulses.items()}
