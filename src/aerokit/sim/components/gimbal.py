"""`SimulatedGimbal`: a gimbal that speaks the MAVLink gimbal protocol v2 with a component id of its own.

https://mavlink.io/en/services/gimbal_v2.html
"""

from __future__ import annotations

import math
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    GimbalDeviceCapFlags,
    GimbalDeviceFlags,
    GimbalManagerCapFlags,
    MavCmd,
    MavFrame,
    MavResult,
    MavType,
)
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler, whole
from aerokit.sim.components.component import Builder, SimulatedComponent, pose_of
from aerokit.sim.local_frame import GlobalPoint
from aerokit.sim.motion import euler_from_quaternion, quaternion_from_euler
from aerokit.sim.vehicle import sender_of

_Can = GimbalDeviceCapFlags
_CAPABILITIES = (
    _Can.HAS_RETRACT | _Can.HAS_NEUTRAL
    | _Can.HAS_ROLL_AXIS | _Can.HAS_ROLL_LOCK
    | _Can.HAS_PITCH_AXIS | _Can.HAS_PITCH_LOCK
    | _Can.HAS_YAW_AXIS | _Can.HAS_YAW_FOLLOW | _Can.HAS_YAW_LOCK
    | _Can.SUPPORTS_YAW_IN_EARTH_FRAME
)  # fmt: skip
_FIRMWARE = 1 << 24


def gimbal_builders(gimbal: SimulatedGimbal) -> dict[int, Builder]:
    """Message id → what to send."""
    return {
        m.GimbalDeviceInformation.ID: lambda _: [_device_information(gimbal)],
        m.GimbalDeviceAttitudeStatus.ID: lambda _: [_attitude_status(gimbal)],
        m.GimbalManagerInformation.ID: lambda _: [_manager_information(gimbal)],
        m.GimbalManagerStatus.ID: lambda _: [gimbal_manager_status(gimbal)],
    }


def gimbal_manager_status(gimbal: SimulatedGimbal) -> m.GimbalManagerStatus:
    """GIMBAL_MANAGER_STATUS: who is in control."""
    device = gimbal.component_id
    return m.GimbalManagerStatus(
        gimbal.time_boot_ms, _flags(gimbal), device, *gimbal.primary, *gimbal.secondary
    )


def _flags(gimbal: SimulatedGimbal) -> int:
    """Roll and pitch are always from the horizon."""
    flags = gimbal.flags & (Flags.RETRACT | Flags.NEUTRAL) | Flags.ROLL_LOCK | Flags.PITCH_LOCK
    if gimbal.is_yaw_locked:
        return flags | Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME
    return flags | Flags.YAW_IN_VEHICLE_FRAME


def _attitude_status(gimbal: SimulatedGimbal) -> m.GimbalDeviceAttitudeStatus:
    is_from_north = gimbal.is_yaw_locked
    angles = gimbal.angles_from_north() if is_from_north else gimbal.angles()
    return m.GimbalDeviceAttitudeStatus(
        target_system=0,
        target_component=0,
        time_boot_ms=gimbal.time_boot_ms,
        flags=_flags(gimbal) | GimbalDeviceFlags.ACCEPTS_YAW_IN_EARTH_FRAME,
        q=quaternion_from_euler(*angles),
        angular_velocity_x=math.nan,
        angular_velocity_y=math.nan,
        angular_velocity_z=math.nan,
        failure_flags=0,
        delta_yaw=gimbal.heading(),
        delta_yaw_velocity=math.nan,
        gimbal_device_id=0,
    )


def _device_information(gimbal: SimulatedGimbal) -> m.GimbalDeviceInformation:
    (roll_min, roll_max), (pitch_min, pitch_max), (yaw_min, yaw_max) = gimbal.limits
    return m.GimbalDeviceInformation(
        time_boot_ms=gimbal.time_boot_ms,
        vendor_name="aerokit",
        model_name="Simulated gimbal",
        custom_name="",
        firmware_version=_FIRMWARE,
        hardware_version=_FIRMWARE,
        uid=gimbal.component_id,
        cap_flags=_CAPABILITIES,
        custom_cap_flags=0,
        roll_min=roll_min,
        roll_max=roll_max,
        pitch_min=pitch_min,
        pitch_max=pitch_max,
        yaw_min=yaw_min,
        yaw_max=yaw_max,
    )


def _manager_information(gimbal: SimulatedGimbal) -> m.GimbalManagerInformation:
    capabilities = int(_CAPABILITIES) | GimbalManagerCapFlags.CAN_POINT_LOCATION_GLOBAL
    limits = (end for axis in gimbal.limits for end in axis)
    return m.GimbalManagerInformation(gimbal.time_boot_ms, capabilities, gimbal.component_id, *limits)


_UNCHANGED, _ME, _RELEASE = -1, -2, -3
_DOWN_WHEN_RETRACTED = (0.0, 0.0, 0.0)
_ABSOLUTE = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})

Owner = tuple[int, int]
Angles = tuple[float, float, float]


def gimbal_commands(gimbal: SimulatedGimbal) -> dict[int, CommandHandler]:
    """MAV_CMD → handler."""
    orders = _Orders(gimbal)
    return {
        MavCmd.DO_GIMBAL_MANAGER_CONFIGURE: orders.configure,
        MavCmd.DO_GIMBAL_MANAGER_PITCHYAW: orders.pitch_and_yaw,
        MavCmd.DO_SET_ROI_LOCATION: orders.look_at,
        MavCmd.DO_SET_ROI_SYSID: orders.follow,
        MavCmd.DO_SET_ROI_NONE: orders.look_ahead,
    }


def hear_gimbal_orders(gimbal: SimulatedGimbal) -> None:
    """Messages in the place of commands; nobody answers them."""
    orders = _Orders(gimbal)
    gimbal.on(m.GimbalManagerSetAttitude, orders.on_attitude)
    gimbal.on(m.GimbalManagerSetPitchyaw, orders.on_pitch_and_yaw)
    gimbal.on(m.GimbalManagerSetManualControl, orders.on_manual_control)
    gimbal.on(m.GimbalDeviceSetAttitude, orders.on_device_attitude)
    gimbal.on(m.GlobalPositionInt, orders.on_place)


class _Orders:
    """Of one gimbal."""

    def __init__(self, gimbal: SimulatedGimbal) -> None:
        self._gimbal = gimbal

    def _is_mine(self, device_id: float) -> bool:
        return whole(device_id) in (0, self._gimbal.component_id)

    def configure(self, command: Command) -> int:
        """Params 1 and 2 are who is in control, 3 and 4 who besides: ids, -1 unchanged, -2 who asks, -3 let go."""
        gimbal, sender = self._gimbal, command.sender
        numbers = [command.param1, command.param2, command.param3, command.param4]
        if not self._is_mine(command.z) or not all(_RELEASE <= number <= 255 for number in numbers):
            return MavResult.DENIED
        primary = _owner(gimbal.primary, (int(numbers[0]), int(numbers[1])), sender)
        secondary = _owner(gimbal.secondary, (int(numbers[2]), int(numbers[3])), sender)
        gimbal.set_control(primary, secondary)
        return MavResult.ACCEPTED

    def pitch_and_yaw(self, command: Command) -> int:
        """Degrees, and degrees per second; those that are not meant are NaN."""
        if not self._is_mine(command.z) or not self._gimbal.obeys(command.sender):
            return MavResult.DENIED
        pitch, yaw, pitch_rate, yaw_rate = map(
            math.radians, (command.param1, command.param2, command.param3, command.param4)
        )
        done = self.obey(whole(command.x), (0.0, pitch, yaw), (0.0, pitch_rate, yaw_rate))
        return MavResult.ACCEPTED if done else MavResult.DENIED

    def look_at(self, command: Command) -> int:
        """Of a COMMAND_LONG the altitude is above the sea."""
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        frame = MavFrame.GLOBAL if command.is_long else command.altitude_frame
        altitude = command.z
        if frame not in _ABSOLUTE:
            pose = pose_of(gimbal.vehicle)
            altitude += 0.0 if pose is None else pose.place.altitude_m - pose.height_m
        gimbal.look_at(GlobalPoint(*command.place(), altitude))
        return MavResult.ACCEPTED

    def follow(self, command: Command) -> int:
        """Param 1 is whom."""
        gimbal = self._gimbal
        if not self._is_mine(command.param2) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        gimbal.follow(whole(command.param1))
        return MavResult.ACCEPTED

    def on_place(self, told: m.GlobalPositionInt, _: Channel) -> None:
        """Of the vehicle that it looks at."""
        self._gimbal.note_place(sender_of(told)[0], GlobalPoint(told.lat, told.lon, told.alt * 1e-3))

    def look_ahead(self, command: Command) -> int:
        gimbal = self._gimbal
        if not self._is_mine(command.param1) or not gimbal.obeys(command.sender):
            return MavResult.DENIED
        gimbal.look_at(None)
        return MavResult.ACCEPTED

    def obey(self, flags: int, angles: Angles, rates: Angles) -> bool:
        """Angles count more than rates; False when neither are given."""
        gimbal = self._gimbal
        locked = bool(flags & (Flags.YAW_LOCK | Flags.YAW_IN_EARTH_FRAME))
        if flags & (Flags.RETRACT | Flags.NEUTRAL):
            gimbal.point(_DOWN_WHEN_RETRACTED, flags, locked=False)
        elif not any(map(math.isnan, angles)):
            gimbal.point(angles, flags, locked=locked)
        elif not any(map(math.isnan, rates)):
            gimbal.turn(rates, flags, locked=locked)
        else:
            return False
        return True

    def on_attitude(self, order: m.GimbalManagerSetAttitude, _: Channel) -> None:
        if self._is_mine(order.gimbal_device_id) and self._gimbal.obeys(sender_of(order)):
            self._attitude(order)

    def on_device_attitude(self, order: m.GimbalDeviceSetAttitude, _: Channel) -> None:
        """Of another manager, such as an autopilot: only while nobody else is in control."""
        if self._gimbal.primary in ((0, 0), sender_of(order)):
            self._attitude(order)

    def _attitude(self, order: m.GimbalManagerSetAttitude | m.GimbalDeviceSetAttitude) -> None:
        has_angles = not any(map(math.isnan, order.q))
        angles = euler_from_quaternion(*order.q) if has_angles else (math.nan,) * 3
        rates = (order.angular_velocity_x, order.angular_velocity_y, order.angular_velocity_z)
        self.obey(order.flags, (angles[0], angles[1], angles[2]), rates)

    def on_pitch_and_yaw(self, order: m.GimbalManagerSetPitchyaw, _: Channel) -> None:
        if self._is_mine(order.gimbal_device_id) and self._gimbal.obeys(sender_of(order)):
            self.obey(order.flags, (0.0, order.pitch, order.yaw), (0.0, order.pitch_rate, order.yaw_rate))

    def on_manual_control(self, order: m.GimbalManagerSetManualControl, _: Channel) -> None:
        """Rates are shares, -1 to 1, of how fast it turns."""
        gimbal = self._gimbal
        if self._is_mine(order.gimbal_device_id) and gimbal.obeys(sender_of(order)):
            rates = (0.0, order.pitch_rate * gimbal.slew_rad_s, order.yaw_rate * gimbal.slew_rad_s)
            self.obey(order.flags, (0.0, order.pitch, order.yaw), rates)


def _owner(before: Owner, wanted: tuple[int, int], sender: Owner) -> Owner:
    """Whoever is in control after one pair of params."""
    if _ME in wanted:
        return sender
    if _RELEASE in wanted:
        return (0, 0) if before == sender else before
    if _UNCHANGED in wanted:
        return before
    return wanted


_STATUS_S = 1.0
_STILL: Angles = (0.0, 0.0, 0.0)


class SimulatedGimbal(SimulatedComponent):
    """A gimbal device that is its own manager; it turns with limited speed and points at places by itself.

    Orders are taken from who is in control, and nobody is at first: MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE claims it.
    Other people's orders are DENIED, their messages ignored.

    - ``component_id``: 154, 171 to 175 are MAVLink's gimbals; ``system_id``: None is the vehicle's own
    - ``roll_deg``, ``pitch_deg``, ``yaw_deg``: lowest and highest angle; roll and pitch are from the horizon
    - ``slew_deg_s``: how fast it turns
    - ``attitude_rate_hz``: of GIMBAL_DEVICE_ATTITUDE_STATUS, without being asked

    Not simulated: the vehicle's lean, which a real one evens out, motors that fail, a second manager.
    """

    TYPE: ClassVar[int] = MavType.GIMBAL

    def __init__(
        self,
        component_id: int = 154,
        *,
        system_id: int | None = None,
        roll_deg: tuple[float, float] = (-30.0, 30.0),
        pitch_deg: tuple[float, float] = (-90.0, 25.0),
        yaw_deg: tuple[float, float] = (-180.0, 180.0),
        slew_deg_s: float = 60.0,
        attitude_rate_hz: float = 5.0,
    ) -> None:
        super().__init__(component_id, system_id=system_id)
        self.limits: tuple[tuple[float, float], ...] = tuple(
            (math.radians(low), math.radians(high)) for low, high in (roll_deg, pitch_deg, yaw_deg)
        )
        """Lowest and highest roll, pitch, yaw in radians."""
        self.slew_rad_s: float = math.radians(slew_deg_s)
        self._attitude_rate_hz = attitude_rate_hz
        self._forget()

    def _forget(self) -> None:
        self.primary: tuple[int, int] = (0, 0)
        self.secondary: tuple[int, int] = (0, 0)
        """System and component ids of who is in control; zeros are nobody."""
        self.flags: int = 0
        """GIMBAL_MANAGER_FLAGS of the latest order."""
        self.region: GlobalPoint | None = None
        """The place that it looks at."""
        self.followed: int = 0
        """The system id of the vehicle that it looks at, wherever that is; 0: none."""
        self._from: Angles = _STILL
        self._since = 0.0
        self._target: Angles = _STILL
        self._rates: Angles = _STILL
        self._is_locked = False

    def start(self) -> None:
        """The power comes on: nobody is in control, and it looks ahead."""
        self._forget()
        self._since = self.now
        self.stream(m.GimbalManagerStatus.ID, _STATUS_S)
        if self._attitude_rate_hz > 0:
            self.stream(m.GimbalDeviceAttitudeStatus.ID, 1.0 / self._attitude_rate_hz)

    def commands(self) -> dict[int, CommandHandler]:
        return gimbal_commands(self)

    def builders(self) -> dict[int, Builder]:
        return gimbal_builders(self)

    def listen(self) -> None:
        hear_gimbal_orders(self)

    @property
    def is_yaw_locked(self) -> bool:
        """Whether its yaw keeps its direction while the vehicle turns."""
        return self._is_locked or self.region is not None

    def angles(self) -> Angles:
        """Roll, pitch and yaw in radians; roll and pitch from the horizon, yaw from the vehicle's nose."""
        moved = [
            _towards(start, target, self.slew_rad_s * (self.now - self._since))
            for start, target in zip(self._from, self._wanted(), strict=True)
        ]
        return (moved[0], moved[1], moved[2])

    def angles_from_north(self) -> Angles:
        """The same with the yaw from north."""
        roll, pitch, yaw = self.angles()
        return (roll, pitch, math.remainder(yaw + self.heading(), math.tau))

    def heading(self) -> float:
        """The vehicle's, in radians; 0 when nobody knows."""
        pose = pose_of(self.vehicle)
        return 0.0 if pose is None else pose.yaw

    def _wanted(self) -> Angles:
        target = self._target if self.region is None else self._look(self.region)
        seconds = self.now - self._since
        roll, pitch, yaw = (angle + rate * seconds for angle, rate in zip(target, self._rates, strict=True))
        if self.is_yaw_locked:
            yaw = math.remainder(yaw - self.heading(), math.tau)
        return (self._limited(0, roll), self._limited(1, pitch), self._limited(2, yaw))

    def _look(self, region: GlobalPoint) -> Angles:
        """Yaw from north; of a vehicle that is nowhere it stays as it is."""
        pose = pose_of(self.vehicle)
        if pose is None:
            return self._target
        frame = self.vehicle.frame  # type: ignore[attr-defined]
        north, east = frame.to_local(region.latitude_e7, region.longitude_e7)
        here = frame.to_local(pose.place.latitude_e7, pose.place.longitude_e7)
        north, east = north - here[0], east - here[1]
        pitch = math.atan2(region.altitude_m - pose.place.altitude_m, math.hypot(north, east))
        return (0.0, pitch, math.atan2(east, north))

    def _limited(self, axis: int, angle: float) -> float:
        low, high = self.limits[axis]
        return max(low, min(high, angle))

    def point(self, angles: Angles, flags: int, *, locked: bool) -> None:
        """Turn to angles in radians; ``locked``: yaw is from north and stays so, else from the nose."""
        self._begin(flags)
        self._target, self._is_locked = angles, locked

    def turn(self, rates: Angles, flags: int, *, locked: bool) -> None:
        """Keep turning, in radians per second, no faster than it can."""
        here = self.angles_from_north() if locked else self.angles()
        self._begin(flags)
        fastest = self.slew_rad_s
        roll, pitch, yaw = (max(-fastest, min(fastest, rate)) for rate in rates)
        self._target, self._rates, self._is_locked = here, (roll, pitch, yaw), locked

    def look_at(self, place: GlobalPoint | None) -> None:
        """Keep pointing at a place; None: ahead again."""
        self._begin(0)
        self.region = place

    def follow(self, system_id: int) -> None:
        """Keep pointing at another vehicle, from when it tells where it is; until then it stays as it is."""
        here = self.angles_from_north()
        self.point(here, Flags.YAW_LOCK, locked=True)
        self.followed = system_id

    def note_place(self, system_id: int, place: GlobalPoint) -> None:
        """Another vehicle tells where it is."""
        if system_id == self.followed:
            self._from, self._since = self.angles(), self.now
            self.region = place

    def _begin(self, flags: int) -> None:
        self._from, self._since = self.angles(), self.now
        self._target = _STILL
        self._rates = _STILL
        self.region = None
        self.followed = 0
        self.flags = flags
        self._is_locked = False

    def set_control(self, primary: tuple[int, int], secondary: tuple[int, int]) -> None:
        """Give it to somebody; a change is told at once."""
        if (primary, secondary) != (self.primary, self.secondary):
            self.primary = primary
            self.secondary = secondary
            self.send(gimbal_manager_status(self))

    def obeys(self, sender: tuple[int, int]) -> bool:
        """Whether somebody is in control."""
        return sender in (self.primary, self.secondary) and sender != (0, 0)


def _towards(start: float, target: float, most: float) -> float:
    return start + max(-most, min(most, target - start))
