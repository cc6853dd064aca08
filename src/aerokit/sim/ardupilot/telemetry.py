"""Everything that each simulated ArduPilot can send when it is asked for it by id."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import PlaneMode
from aerokit.mavlink.message import Message
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.ardupilot.plane.host import PlaneHost
from aerokit.sim.ardupilot.requests import DISPLAY_VALUES
from aerokit.sim.ardupilot.rover.host import RoverHost
from aerokit.sim.ardupilot.sub.host import SubHost
from aerokit.sim.ardupilot.telemetry_motion import ATTITUDE_BUILDERS, POSITION_BUILDERS
from aerokit.sim.ardupilot.telemetry_state import STATE_BUILDERS
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

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


def plane_outputs(plane: PlaneHost) -> m.ServoOutputRaw:
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


def rover_outputs(rover: RoverHost) -> m.ServoOutputRaw:
    """Steering is output 1, also disarmed, the motor output 3."""
    if rover.mode.has_manual_throttle:
        steering = _MIDDLE + _beyond_deadzone(rover.rc[0])
    else:
        steering = _MIDDLE + round(_STICK_RANGE * rover.motion.yaw_rate / rover.motion.wheels.turn_rate_rad_s)
    throttle = _MIDDLE + round(_STICK_RANGE * rover.motors.throttle)
    return _message(rover, steering, 0, throttle)


def sub_outputs(sub: SubHost) -> m.ServoOutputRaw:
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


Builders = Mapping[int, Callable[[Any], "Message | None"]]

_NOTHING_REACHED = 0xFFFF
_NO_TEMPERATURE = 32767
_AIR_DENSITY = 1.225


def _hwstatus(_: ArduPilotVehicle) -> m.Hwstatus:
    return m.Hwstatus(5000, 0)


def _reached(_: ArduPilotVehicle) -> m.MissionItemReached:
    return m.MissionItemReached(_NOTHING_REACHED)


def _flight(vehicle: ArduPilotVehicle) -> m.FlightInformation:
    return m.FlightInformation(vehicle.time_boot_ms, 0, 0, 0)


_GRID_M, _GRID_CORNER = 100, (0.0115, 0.0104)


def _relays(vehicle: ArduPilotVehicle) -> m.RelayStatus:
    accessories = vehicle.accessories
    return m.RelayStatus(vehicle.time_boot_ms, accessories.relays, (1 << accessories.relay_count) - 1)


def angles_of_flow(plane: PlaneHost) -> m.AoaSsa:
    """Angle of attack and side slip in degrees; zeros on the ground."""
    motion = plane.motion
    slope = math.atan2(-motion.velocity_down, max(motion.airspeed_m_s, 1.0))
    attack = 0.0 if plane.is_landed else math.degrees(motion.pitch - slope)
    return m.AoaSsa(plane.time_boot_us, attack, 0.0)


def terrain_request(vehicle: ArduPilotVehicle) -> m.TerrainRequest | None:
    """It has no terrain at all: the whole block around it is missing."""
    place = vehicle.navigation.position
    if place is None:
        return None
    south, west = (round(1e7 * degrees) for degrees in _GRID_CORNER)
    return m.TerrainRequest(place.latitude_e7 - south, place.longitude_e7 - west, _GRID_M, (1 << 56) - 1)


def outside_pressure(sub: SubHost) -> m.ScaledPressure3:
    """The third barometer, a thermometer only."""
    return m.ScaledPressure3(sub.time_boot_ms, 0.0, 0.0, 3620, 0)


EXTRA_BUILDERS: Builders = {
    m.Hwstatus.ID: _hwstatus,
    m.MissionItemReached.ID: _reached,
    m.RelayStatus.ID: _relays,
    m.FlightInformation.ID: _flight,
}
"""Message id → what every kind sends when it is asked for it."""


def airspeed(plane: PlaneHost) -> m.Airspeed:
    speed = plane.motion.airspeed_m_s
    return m.Airspeed(0, speed, _NO_TEMPERATURE, 0.5 * _AIR_DENSITY * speed * speed / 100.0, 2)


def display_value(sub: SubHost) -> m.NamedValueFloat:
    """The next of `DISPLAY_VALUES`."""
    name = next(sub.display_names)
    return m.NamedValueFloat(sub.time_boot_ms, name, DISPLAY_VALUES[name])


def scaled_channels(rover: ArduPilotVehicle) -> m.RcChannelsScaled:
    return m.RcChannelsScaled(rover.time_boot_ms, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255)


def rover_hud(rover: RoverHost) -> m.VfrHud:
    """Without airspeed and climb; the throttle is positive also backwards."""
    motion, place = rover.motion, rover.navigation.position
    heading = int(math.degrees(motion.yaw) % 360.0)
    throttle = round(abs(rover.motors.throttle) * 100)
    altitude = 0.0 if place is None else place.altitude_m
    return m.VfrHud(0.0, motion.ground_speed_m_s, heading, throttle, altitude, 0.0)


def no_landed_state(_: ArduPilotVehicle) -> m.ExtendedSysState:
    """Neither on the ground nor in the air, as far as it tells."""
    return m.ExtendedSysState(0, 0)


_ALL: Builders = {
    **STATE_BUILDERS,
    **ATTITUDE_BUILDERS,
    **POSITION_BUILDERS,
    m.GimbalDeviceAttitudeStatus.ID: lambda vehicle: vehicle.gimbal.attitude_status(),
    m.GimbalManagerInformation.ID: lambda vehicle: vehicle.gimbal.manager_information(),
    m.GimbalManagerStatus.ID: lambda vehicle: vehicle.gimbal.manager_status(),
    m.CameraInformation.ID: lambda vehicle: vehicle.camera.information(),
    m.CameraSettings.ID: lambda vehicle: vehicle.camera.settings(),
    m.CameraCaptureStatus.ID: lambda vehicle: vehicle.camera.capture_status(),
    m.CameraFeedback.ID: lambda vehicle: vehicle.camera.last_feedback(),
    **EXTRA_BUILDERS,
    m.FenceStatus.ID: lambda vehicle: vehicle.fence.status(),
    m.MagCalProgress.ID: lambda vehicle: vehicle.calibrations.compasses.progress(),
    m.MagCalReport.ID: lambda vehicle: vehicle.calibrations.compasses.report(),
}
_FLYING = (m.Wind.ID, m.TerrainReport.ID, m.EscTelemetry1To4.ID)
_COPTER_TARGETS = (m.AttitudeTarget.ID, m.PositionTargetLocalNed.ID)


def _without(*message_ids: int) -> dict[int, Any]:
    return {number: builder for number, builder in _ALL.items() if number not in message_ids}


BUILDERS_OF_KIND: dict[Kind, Builders] = {
    "copter": {
        **_ALL,
        m.ServoOutputRaw.ID: copter_outputs,
        m.TerrainRequest.ID: terrain_request,
    },
    "plane": {
        **_without(*_COPTER_TARGETS),
        m.ServoOutputRaw.ID: plane_outputs,
        m.TerrainRequest.ID: terrain_request,
        m.Airspeed.ID: airspeed,
        m.AoaSsa.ID: angles_of_flow,
    },
    "rover": {
        **_without(*_FLYING, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: rover_outputs,
        m.RcChannelsScaled.ID: scaled_channels,
        m.VfrHud.ID: rover_hud,
        m.ExtendedSysState.ID: no_landed_state,
    },
    "sub": {
        **_without(m.Wind.ID, m.EscTelemetry1To4.ID, *_COPTER_TARGETS),
        m.ServoOutputRaw.ID: sub_outputs,
        m.NamedValueFloat.ID: display_value,
        m.ScaledPressure3.ID: outside_pressure,
        m.ExtendedSysState.ID: no_landed_state,
    },
}
"""Kind → builders; what is not there is not sent."""
