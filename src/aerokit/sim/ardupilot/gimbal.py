"""A servo gimbal (MNT1_TYPE 1) with three axes on a simulated ArduPilot.

Servos tell nothing: what the vehicle tells is what it has the servos do, at once. Pitch and roll are from the
horizon, yaw is from the vehicle's nose or from north. With MNT1_TYPE 0 there is none, and orders FAIL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GimbalDeviceFlags,
    GimbalManagerCapFlags,
    GimbalManagerFlags,
    MavFrame,
    MavMountMode,
    MavResult,
    MavSeverity,
)
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import Ned
from aerokit.sim.motion import quaternion_from_euler
from aerokit.sim.vehicle import sender_of

_DEVICE_ID = 1
_Can = GimbalManagerCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL | _Can.HAS_RC_INPUTS
    | _Can.CAN_POINT_LOCATION_LOCAL | _Can.CAN_POINT_LOCATION_GLOBAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_FOLLOW | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_FOLLOW | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
)  # fmt: skip
_FROM_NORTH = frozenset({MavMountMode.GPS_POINT, MavMountMode.SYSID_TARGET, MavMountMode.HOME_LOCATION})


DEFAULTS = {
    "MNT1_DEFLT_MODE": 3.0,
    "MNT1_ROLL_MIN": -30.0,
    "MNT1_ROLL_MAX": 30.0,
    "MNT1_PITCH_MIN": -90.0,
    "MNT1_PITCH_MAX": 20.0,
    "MNT1_YAW_MIN": -180.0,
    "MNT1_YAW_MAX": 180.0,
    **dict.fromkeys((f"MNT1_{place}_{axis}" for place in ("RETRACT", "NEUTRAL") for axis in "XYZ"), 0.0),
}
"""Of parameters that a small table may be without."""
_UNTURNED = frozenset({MavMountMode.RETRACT, MavMountMode.NEUTRAL})


@dataclass(frozen=True)
class Target:
    """Where it is to point: degrees; ``rates`` in degrees per second change them from ``since`` on."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    is_from_north: bool = False
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    since: float = 0.0


class Gimbal:
    """Mode, target and who is in control; :attr:`angles` is where it points now."""

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.mode: int = int(self.setting("MNT1_DEFLT_MODE"))
        """MAV_MOUNT_MODE."""
        self.is_yaw_locked: bool = False
        """Whether the pilot's stick turns it from north."""
        self.in_control: tuple[int, int] = (0, 0)
        """System and component id of who has said that he is."""
        self._target = Target()
        self._region: Ned | None = None
        self._followed = 0
        self._follows: Ned | None = None
        vehicle.overhear(GlobalPositionInt, self._hear_place)

    @property
    def is_fitted(self) -> bool:
        return self._vehicle.parameters["MNT1_TYPE"] != 0

    def setting(self, name: str) -> float:
        """A parameter."""
        parameters = self._vehicle.parameters
        return parameters[name] if name in parameters else DEFAULTS[name]

    @property
    def angles(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw in degrees that the servos are to make, yaw from the nose."""
        if self.mode in _UNTURNED:
            return (self.target.roll, self.target.pitch, self.target.yaw)
        target, motion = self.target, self._vehicle.motion
        yaw = self._limited("YAW", self._from_nose(target))
        lean = (math.degrees(motion.roll), math.degrees(motion.pitch))
        cos, sin = math.cos(math.radians(-yaw)), math.sin(math.radians(-yaw))
        roll = target.roll - (lean[0] * cos - lean[1] * sin)
        pitch = target.pitch - (lean[0] * sin + lean[1] * cos)
        return self._limited("ROLL", roll), self._limited("PITCH", pitch), yaw

    @property
    def target(self) -> Target:
        if self.mode == MavMountMode.RC_TARGETING:  # no stick turns it: all of them are in the middle
            return Target(self._middle("ROLL"), self._middle("PITCH"), 0.0, self.is_yaw_locked)
        if self.mode in _UNTURNED:
            place = MavMountMode(self.mode).name
            roll, pitch, yaw = (self.setting(f"MNT1_{place}_{axis}") for axis in "XYZ")
            return Target(roll, pitch, yaw)
        if self.mode == MavMountMode.GPS_POINT:
            return self._towards(self._region)
        if self.mode == MavMountMode.SYSID_TARGET:
            return self._towards(self._follows)
        if self.mode == MavMountMode.HOME_LOCATION:
            return self._towards(self._vehicle.navigation.home)
        return self._moved(self._target)

    def _moved(self, target: Target) -> Target:
        if not any(target.rates):
            return target
        seconds = self._vehicle.now - target.since
        roll = self._limited("ROLL", target.roll + target.rates[0] * seconds)
        pitch = self._limited("PITCH", target.pitch + target.rates[1] * seconds)
        yaw = target.yaw + target.rates[2] * seconds
        yaw = math.remainder(yaw, 360.0) if target.is_from_north else self._limited("YAW", yaw)
        return replace(target, roll=roll, pitch=pitch, yaw=yaw)

    def _towards(self, place: Ned | None) -> Target:
        """Of a place that is not known, or without a position, it stays as it was."""
        motion = self._vehicle.motion
        if place is not None and self._vehicle.navigation.has_position:
            north, east, down = place[0] - motion.north, place[1] - motion.east, place[2] - motion.down
            pitch = math.degrees(math.atan2(-down, math.hypot(north, east)))
            self._target = Target(0.0, pitch, math.degrees(math.atan2(east, north)), True)
        return self._target

    def _from_nose(self, target: Target) -> float:
        if not target.is_from_north:
            return target.yaw
        return math.remainder(target.yaw - math.degrees(self._vehicle.motion.yaw), 360.0)

    def _limited(self, axis: str, angle: float) -> float:
        return max(self.setting(f"MNT1_{axis}_MIN"), min(self.setting(f"MNT1_{axis}_MAX"), angle))

    def _middle(self, axis: str) -> float:
        return (self.setting(f"MNT1_{axis}_MIN") + self.setting(f"MNT1_{axis}_MAX")) / 2.0

    def set_mode(self, mode: int) -> None:
        """A MAV_MOUNT_MODE; others are ignored."""
        if mode in list(MavMountMode):
            self._target = self.target
            self.mode = mode

    def point(self, roll: float, pitch: float, yaw: float, *, from_north: bool) -> None:
        """Turn to these angles, in degrees, as far as it goes."""
        if not from_north:
            yaw = self._limited("YAW", yaw - 360.0 if yaw > 180.0 else yaw)
        self._target = Target(self._limited("ROLL", roll), self._limited("PITCH", pitch), yaw, from_north)
        self.mode = MavMountMode.MAVLINK_TARGETING

    def turn(self, roll: float, pitch: float, yaw: float, *, from_north: bool) -> None:
        """Keep turning at these rates, in degrees per second, from where it points."""
        now = self.target
        start = self._from_nose(now)
        if from_north:
            start = now.yaw if now.is_from_north else start + math.degrees(self._vehicle.motion.yaw)
        self._target = Target(now.roll, now.pitch, start, from_north, (roll, pitch, yaw), self._vehicle.now)
        self.mode = MavMountMode.MAVLINK_TARGETING

    def look_at(self, place: Ned | None) -> None:
        """Keep pointing at a place; None ends it."""
        self._region = place
        if place is not None:
            self.set_mode(MavMountMode.GPS_POINT)
        elif self.mode == MavMountMode.GPS_POINT:
            self.set_mode(int(self.setting("MNT1_DEFLT_MODE")))

    def follow(self, system_id: int) -> None:
        """Keep pointing at another vehicle, from when it tells where it is."""
        self._followed, self._follows = system_id, None
        self.set_mode(MavMountMode.SYSID_TARGET)

    def _hear_place(self, told: GlobalPositionInt, _: Channel) -> None:
        if sender_of(told)[0] == self._followed:
            place = self._vehicle.point(told.lat, told.lon, told.alt * 1e-3, MavFrame.GLOBAL)
            self._follows = self._follows if place is None else place

    def set_control(self, sender: tuple[int, int], system: int, component: int) -> bool:
        """As MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE says it; False for numbers that mean nothing."""
        if not (-3 <= system <= 255 and -3 <= component <= 255):
            return False
        before = self.in_control
        if system == -2:
            self.in_control = sender
        elif system == -3:
            self.in_control = (0, 0) if before == sender else before
        elif system != -1:
            self.in_control = (system, component)
        if self.in_control != before:
            self._vehicle.call_later(0.0, self._tell_control)
        return True

    def _tell_control(self) -> None:
        status = self.manager_status()
        if status is not None:
            self._vehicle.send(status)

    def manage(
        self, flags: int, angles: tuple[float, float, float], rates: tuple[float, float, float]
    ) -> int:
        """Flags (GIMBAL_MANAGER_FLAGS) and either angles or rates, roll, pitch, yaw, the others NaN; a MAV_RESULT."""
        from_north = bool(flags & GimbalManagerFlags.YAW_LOCK)
        if flags & GimbalManagerFlags.RETRACT:
            self.set_mode(MavMountMode.RETRACT)
        elif flags & GimbalManagerFlags.NEUTRAL:
            self.set_mode(MavMountMode.NEUTRAL)
        elif not any(map(math.isnan, angles)):
            self.point(*angles, from_north=from_north)
        elif not any(map(math.isnan, rates)):
            self.turn(*rates, from_north=from_north)
        elif all(map(math.isnan, (*angles[1:], *rates[1:]))):
            self.is_yaw_locked = from_north
        else:
            return MavResult.FAILED
        return MavResult.ACCEPTED

    def warn(self) -> None:
        """Of angles that are none, in hundredths of degrees for example."""
        self._vehicle.send_text(MavSeverity.WARNING, "Mount: invalid angle targets")

    def attitude_status(self) -> m.GimbalDeviceAttitudeStatus | None:
        if not self.is_fitted:
            return None
        roll, pitch, yaw = map(math.radians, self.angles)
        return m.GimbalDeviceAttitudeStatus(
            0,
            0,
            self._vehicle.time_boot_ms,
            _device_flags(self),
            quaternion_from_euler(roll, pitch, yaw),
            math.nan,
            math.nan,
            math.nan,
            0,
            math.nan,
            math.nan,
            _DEVICE_ID,
        )

    def manager_information(self) -> m.GimbalManagerInformation | None:
        if not self.is_fitted:
            return None
        limits = (
            math.radians(self.setting(f"MNT1_{axis}_{end}"))
            for axis in ("ROLL", "PITCH", "YAW")
            for end in ("MIN", "MAX")
        )
        return m.GimbalManagerInformation(self._vehicle.time_boot_ms, _CAPABILITIES, _DEVICE_ID, *limits)

    def manager_status(self) -> m.GimbalManagerStatus | None:
        """GIMBAL_MANAGER_STATUS: who is in control."""
        if not self.is_fitted:
            return None
        flags = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK
        if self.is_yaw_locked:
            flags |= GimbalManagerFlags.YAW_LOCK
        system, component = self.in_control
        return m.GimbalManagerStatus(self._vehicle.time_boot_ms, flags, _DEVICE_ID, system, component, 0, 0)


def _device_flags(gimbal: Gimbal) -> int:
    """Yaw is told from the nose whatever it is locked to."""
    flags = (
        GimbalDeviceFlags.ROLL_LOCK | GimbalDeviceFlags.PITCH_LOCK | GimbalDeviceFlags.YAW_IN_VEHICLE_FRAME
    )
    if gimbal.mode == MavMountMode.RETRACT:
        flags |= GimbalDeviceFlags.RETRACT
    elif gimbal.mode == MavMountMode.NEUTRAL:
        flags |= GimbalDeviceFlags.NEUTRAL
    elif gimbal.mode in _FROM_NORTH or gimbal.target.is_from_north:
        flags |= GimbalDeviceFlags.YAW_LOCK
    return flags
