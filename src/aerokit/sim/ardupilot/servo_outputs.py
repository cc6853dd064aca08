"""SERVO_OUTPUT_RAW of each simulated ArduPilot: what its motors and control surfaces are told."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import PlaneMode

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.plane.vehicle import SimulatedPlane
    from aerokit.sim.ardupilot.rover.vehicle import SimulatedRover
    from aerokit.sim.ardupilot.sub.vehicle import SimulatedSub
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["copter_outputs", "plane_outputs", "rover_outputs", "sub_outputs"]

_MIDDLE = 1500
_STICK_RANGE = 500
_SURFACE_RANGE = 400
"""A surface or thruster goes from 1100 to 1900."""
_ROVER_DEADZONE = 30
_OUTPUTS = 16
_FULL_ROLL_RATE = 1.5
_FULL_PITCH_RATE = 0.5
_PITCH, _ROLL, _THROTTLE, _YAW, _FORWARD, _LATERAL = range(6)


def copter_outputs(vehicle: ArduPilotVehicle) -> m.ServoOutputRaw:
    """Four motors, all alike."""
    pwm = vehicle.motors.pwm
    return _message(vehicle, pwm, pwm, pwm, pwm)


def plane_outputs(plane: SimulatedPlane) -> m.ServoOutputRaw:
    """Aileron, elevator, throttle, rudder; in MANUAL the sticks, disarmed too, the throttle only when armed."""
    wing, throttle = plane.wing, 1000
    if plane.motors.is_armed:
        throttle += round(1000 * plane.motors.throttle)
    if plane.mode.number == PlaneMode.MANUAL:
        aileron, elevator, rudder = (_surface(_stick(plane.rc[index])) for index in (0, 1, 3))
        throttle = max(1000, min(2000, plane.rc[2])) if plane.motors.is_armed else 1000
    else:
        aileron = _surface(wing.roll_rate / _FULL_ROLL_RATE)
        elevator = _surface(-wing.pitch_rate / _FULL_PITCH_RATE)
        rudder = _surface(wing.roll_rate / _FULL_ROLL_RATE / 2.0)
    return _message(plane, aileron, elevator, throttle, rudder)


def rover_outputs(rover: SimulatedRover) -> m.ServoOutputRaw:
    """Steering is output 1, also disarmed, the motor output 3."""
    if rover.mode.has_manual_throttle:
        steering = _MIDDLE + _beyond_deadzone(rover.rc[0])
    else:
        steering = _MIDDLE + round(_STICK_RANGE * rover.motion.yaw_rate / rover.motion.wheels.turn_rate_rad_s)
    throttle = _MIDDLE + round(_STICK_RANGE * rover.motors.throttle)
    return _message(rover, steering, 0, throttle)


def sub_outputs(sub: SimulatedSub) -> m.ServoOutputRaw:
    """Four thrusters aslant on the level, two upright, and the camera's two axes on 8 and 10."""
    one = two = three = four = left = right = _MIDDLE
    if sub.motors.is_armed:
        yaw, forward, lateral, roll = (_stick(sub.rc[index]) for index in (_YAW, _FORWARD, _LATERAL, _ROLL))
        up = 1.0 - 2.0 * sub.motors.throttle
        one, two = _surface(yaw - forward + lateral), _surface(-yaw - forward - lateral)
        three, four = _surface(-yaw + forward + lateral), _surface(yaw + forward - lateral)
        left, right = _surface(up + roll), _surface(up - roll)
    return _message(sub, one, two, three, four, left, right, 0, _MIDDLE, 0, _MIDDLE)


def _message(vehicle: ArduPilotVehicle, *pulses: int) -> m.ServoOutputRaw:
    outputs = [*pulses, *(0,) * (_OUTPUTS - len(pulses))]
    for number, pulse in vehicle.accessories.servos.items():
        if 1 <= number <= _OUTPUTS:
            outputs[number - 1] = pulse
    return m.ServoOutputRaw(vehicle.time_boot_us & 0xFFFFFFFF, 0, *outputs)


def _stick(pwm: int) -> float:
    return (pwm - _MIDDLE) / _STICK_RANGE


def _surface(share: float) -> int:
    return _MIDDLE + round(_SURFACE_RANGE * max(-1.0, min(1.0, share)))


def _beyond_deadzone(pwm: int) -> int:
    """A rover's stick: nothing near the middle, all of the range outside."""
    away = abs(pwm - _MIDDLE) - _ROVER_DEADZONE
    if away <= 0:
        return 0
    size = min(_STICK_RANGE, int(away * _STICK_RANGE / (_STICK_RANGE - _ROVER_DEADZONE)))
    return size if pwm > _MIDDLE else -size
